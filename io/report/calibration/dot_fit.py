"""One dot and its fit: as an image, as a grey surface, as a profile across its edge."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from telerig.arrays import Array
from telerig.io.report.page.figures import (
    LEFT_OUT,
    MODEL,
    WIDTH_IN,
    Picture,
    drawing,
    png,
)
from telerig.short_text import number

_MESH = 40
_MOST_SHAPES = 1500


def edge_distance_px(example: Mapping[str, Array]) -> Array:
    """Return the signed distance (h, w) of pixels from the ellipse, positive outside."""
    height, width = example["patch"].shape
    u = float(example["u0"]) + np.arange(width) - float(example["u_px"])
    v = float(example["v0"]) + np.arange(height)[:, None] - float(example["v_px"])
    cos, sin = np.cos(float(example["angle_rad"])), np.sin(float(example["angle_rad"]))
    a, b = float(example["a_px"]), float(example["b_px"])
    x, y = u * cos + v * sin, -u * sin + v * cos
    rho = np.maximum(np.hypot(x / a, y / b), 1e-9)
    return np.asarray((rho - 1) * rho / np.maximum(np.hypot(x / a**2, y / b**2), 1e-12))


def dot_pictures(example: Mapping[str, Array]) -> list[Picture]:
    """Draw image, surface and profile of the example; nothing without an example."""
    if not example:
        return []
    near = _cropped(example)
    return [_image(near), _surface(near), _profile(near)]


def _cropped(example: Mapping[str, Array]) -> dict[str, Array]:
    """Return the part of the patch no farther from the ellipse than its neighbours might be."""
    near = edge_distance_px(example) <= _reach_px(example)
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if len(rows) < 3 or len(columns) < 3:
        return dict(example)
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    images = {name: example[name][part] for name in ("patch", "model")}
    corner = {"u0": example["u0"] + columns[0], "v0": example["v0"] + rows[0]}
    return {**example, **images, **corner}


def _reach_px(example: Mapping[str, Array]) -> float:
    return max(5.0, 0.8 * float(example["b_px"]))


def _extent(example: Mapping[str, Array]) -> tuple[float, float, float, float]:
    height, width = example["patch"].shape
    u, v = float(example["u0"]), float(example["v0"])
    return u - 0.5, u + width - 0.5, v + height - 0.5, v - 0.5


def _image(example: Mapping[str, Array]) -> Picture:
    turn = np.linspace(0, 2 * np.pi, 120)
    x, y = float(example["a_px"]) * np.cos(turn), float(example["b_px"]) * np.sin(turn)
    cos, sin = np.cos(float(example["angle_rad"])), np.sin(float(example["angle_rad"]))
    u, v = float(example["u_px"]), float(example["v_px"])
    with drawing(3.6) as sheet:
        grey = {"cmap": "gray", "extent": _extent(example), "interpolation": "nearest"}
        sheet.axes.imshow(example["patch"], **grey)
        sheet.axes.plot(u + x * cos - y * sin, v + x * sin + y * cos, color=LEFT_OUT, linewidth=1)
        sheet.axes.plot(u, v, "+", color=LEFT_OUT, markersize=9)
        sheet.axes.set(xlabel="u / px", ylabel="v / px")
    caption = (
        f"The pixels of one dot and the fitted ellipse, centre ({u:.3f}, {v:.3f}) px; the line "
        "should run through the middle of the blurred edge all the way round."
    )
    return Picture("One dot", sheet.source, caption)


def _surface(example: Mapping[str, Array]) -> Picture:
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

    patch = example["patch"]
    left, right, bottom, top = _extent(example)
    u, v = np.arange(left + 0.5, right), np.arange(top + 0.5, bottom)
    with rc_context({"font.size": 8}):
        figure = Figure(figsize=(WIDTH_IN, 3.6))
        axes = Axes3D(figure, rect=(-0.04, 0.06, 1.0, 1.0))
        figure.add_axes(axes)
        axes.plot_surface(
            *np.meshgrid(u, v), patch, rcount=_MESH, ccount=_MESH, cmap="gray", edgecolor="#5577aa",
            linewidth=0.25,
        )  # fmt: skip
        axes.view_init(elev=38, azim=-60)
        axes.set(xlabel="u / px", ylabel="v / px", zlabel="grey value")
        axes.invert_yaxis()
        source = png(figure)
    caption = (
        "The same pixels as a grey-level surface: a flat plateau, an edge of even width, a flat "
        "background; bumps are dirt or glare, a leaning plateau is uneven light."
    )
    return Picture("Grey-level surface", source, caption)


def _profile(example: Mapping[str, Array]) -> Picture:
    distance = edge_distance_px(example)
    near = distance <= _reach_px(example)
    distance, patch, model = distance[near], example["patch"][near], example["model"][near]
    noise = float(example["noise"])
    order = np.argsort(distance)
    with drawing(3.6, legend="best", ylabel="grey value") as sheet:
        box = sheet.axes.get_position()
        sheet.axes.set_position((box.x0, box.y0 + 0.3 * box.height, box.width, 0.7 * box.height))
        place = (box.x0, box.y0, box.width, 0.22 * box.height)
        lower = sheet.figure.add_axes(place, sharex=sheet.axes)
        pixels = {"color": "#666666", "rasterized": len(patch) > _MOST_SHAPES}
        sheet.axes.plot(distance, patch, ".", markersize=3, label="pixels", **pixels)
        sheet.axes.plot(distance[order], model[order], color=MODEL, linewidth=1, label="model")
        sheet.axes.tick_params(labelbottom=False)
        lower.plot(distance, (patch - model) / (noise or 1.0), ".", markersize=2.5, **pixels)
        lower.axhline(0, color=MODEL, linewidth=0.8)
        lower.set(xlabel="distance from the ellipse / px (outside > 0)", ylabel="misfit")
    rms = float(np.sqrt(np.mean((patch - model) ** 2)))
    caption = (
        "Every pixel against its distance from the ellipse, and the model; misfits over "
        f"the noise should be a level band within ±3 (RMS {number(rms)} grey values, noise "
        f"{number(noise)})."
    )
    return Picture("Profile and model", sheet.source, caption)
