"""The target as it is: how its dots deviate from a perfect flat grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.io.report.page.figures import WIDTH_IN, Picture, drawing
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.short_text import nice_below, number

_MOST_LABELS = 40
_MOST_SHAPES = 1500


@dataclass(frozen=True)
class TargetShape:
    """Dots against the best perfect target.

    place_mm : (N, 2) where the best target has them.
    off_um, sd_um : (N, 3) estimated minus best.
    stretch : per mille, along two principal directions, or None.
    in_plane : False when only flatness is known.
    """

    place_mm: Array
    off_um: Array
    sd_um: Array
    in_plane: bool


def target_shape(results: CalibrationResults) -> TargetShape | None:
    """Return deviations from an affinely fitted nominal target; None for under five dots.

    Nominal places come from row and column of each dot, up to the pitch that the fit finds.
    """
    lattice = results.row_column
    known = np.isfinite(lattice).all(axis=1)
    points = results.points_mm
    in_plane = bool(known.all()) and len(points) > 4 and bool(np.ptp(lattice, axis=0).min() > 0)
    design = np.c_[lattice if in_plane else points[:, :2], np.ones(len(points))]
    if len(points) < 5 or np.linalg.matrix_rank(design) < 3:
        return None
    basis, _ = np.linalg.qr(design)
    best = basis @ (basis.T @ points)
    off = 1e3 * (points - best)
    return TargetShape(best[:, :2], off, 1e3 * _sd_mm(results, basis), in_plane)


def _sd_mm(results: CalibrationResults, basis: Array) -> Array:
    """Return (N, 3) standard deviations of the deviations: the fitted part's share is taken out."""
    names = [[f"dot {dot}.{axis}_mm" for axis in "xyz"] for dot in results.dot_ids]
    index = np.array([[results.component.get(name, -1) for name in row] for row in names])
    out = np.zeros((len(names), 3))
    if index.size == 0 or index.min() < 0:
        return out
    for axis in range(3):
        covariance = results.joint[np.ix_(index[:, axis], index[:, axis])]
        shared = basis.T @ covariance
        variance = np.diag(covariance) - 2 * np.sum(basis * shared.T, axis=1)
        variance = variance + np.sum((basis @ (shared @ basis)) * basis, axis=1)
        out[:, axis] = np.sqrt(np.maximum(variance, 0))
    return out


def target_pictures(results: CalibrationResults) -> list[Picture]:
    """Draw in-plane deviations as arrows and heights as colours; nothing for too few dots."""
    shape = target_shape(results)
    if shape is None:
        return []
    return [*([_in_plane(shape)] if shape.in_plane else []), _heights(shape)]


def _axes_height_in(place_mm: Array) -> float:
    width, height = np.ptp(place_mm, axis=0) + 0.2 * np.ptp(place_mm, axis=0).max()
    return float(np.clip(0.57 + (WIDTH_IN - 0.7) * height / width, 1.6, 6.0))


def _target_axes(axes: Any, place_mm: Array) -> None:
    margin = 0.1 * np.ptp(place_mm, axis=0).max()
    low, high = place_mm.min(axis=0) - margin, place_mm.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    axes.set(xlabel="x on the target / mm", ylabel="y / mm")
    axes.set_aspect("equal")


def _in_plane(shape: TargetShape) -> Picture:
    from matplotlib.collections import EllipseCollection

    off, sd = shape.off_um[:, :2], shape.sd_um[:, :2]
    extent = np.ptp(shape.place_mm, axis=0).max()
    typical = max(float(np.quantile(np.hypot(*off.T), 0.9)), 1e-9)
    per_um = nice_below(0.08 * extent / typical * 1e3) / 1e3
    height = _axes_height_in(shape.place_mm) + 0.25
    with drawing(height) as sheet:
        axes = sheet.axes
        _target_axes(axes, shape.place_mm)
        box = axes.get_position()
        axes.set_position((box.x0, box.y0, box.width, box.height - 0.25 / height))
        quiver = axes.quiver(
            *shape.place_mm.T, *(off * per_um).T, angles="xy", scale_units="xy", scale=1,
            color="#1f5fa8", width=0.005,
        )  # fmt: skip
        if sd.any() and len(sd) <= _MOST_SHAPES:
            tip, (wide, high) = shape.place_mm + off * per_um, 2 * sd.T * per_um
            rings = EllipseCollection(
                wide, high, np.zeros(len(sd)), units="xy", offsets=tip, linewidths=0.8,
                offset_transform=axes.transData, facecolors="none", edgecolors="#c2570c",
            )  # fmt: skip
            axes.add_collection(rings)
        key = nice_below(1.5 * typical)
        axes.quiverkey(
            quiver, 0.5, 1 + 0.12 / height, key * per_um, f"{number(key, 1)} µm", labelpos="E"
        )
    caption = (
        f"Arrows (drawn {1e3 * per_um:,.0f} times as long) from a perfect, evenly stretched grid "
        f"to the estimated dots: RMS {number(_rms(off))} µm per axis, known to {_known(sd)}; rings "
        "are one sd."
    )
    return Picture("Print errors in the plane", sheet.source, caption)


def _heights(shape: TargetShape) -> Picture:
    height, sd = shape.off_um[:, 2], shape.sd_um[:, 2]
    limit = max(float(np.abs(height).max()), 1e-9)
    with drawing(_axes_height_in(shape.place_mm) + 0.7) as sheet:
        _target_axes(sheet.axes, shape.place_mm)
        size = np.clip(9000 / len(height), 12, 320)
        dots = sheet.axes.scatter(
            *shape.place_mm.T, c=height, s=size, cmap="RdBu_r", vmin=-limit, vmax=limit,
            edgecolors="#555555", linewidths=0.4, rasterized=len(height) > _MOST_SHAPES,
        )  # fmt: skip
        if len(height) <= _MOST_LABELS:
            for place, z in zip(shape.place_mm, height):
                shade = "white" if abs(z) > 0.65 * limit else "black"
                words = {"ha": "center", "va": "center", "fontsize": 7, "color": shade}
                sheet.axes.text(*place, f"{z:.0f}", **words)
        below = {"orientation": "horizontal", "fraction": 0.06, "pad": 0.2}
        sheet.figure.colorbar(dots, ax=sheet.axes, label="height / µm", **below)
    caption = (
        f"Height of each dot over the best plane along the target's z: RMS {number(_rms(height))} "
        f"µm, known to {_known(sd)}; a smooth bow is bending, a patchwork is the print."
    )
    return Picture("Out of the plane", sheet.source, caption)


def _known(sd_um: Array) -> str:
    return f"{number(float(np.median(sd_um)), 2)} µm (1 sd)" if sd_um.any() else "an unknown degree"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
