"""The rig and all poses of the target, in 3-D and in plan, and how to hold the target next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.io.report.page.figures import (
    MODEL,
    MUTED,
    WIDTH_IN,
    Picture,
    camera_colour,
    drawing,
    image_axes,
)
from telerig.io.report.page.page import Trace, lines, scene_text, xyz
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS
from telerig.short_text import short_names

_BEFORE, _BEHIND = 1.7, 1.2
"""How far a drawn field reaches before and behind the poses, in radii of the poses."""


@dataclass(frozen=True)
class CameraOutline:
    """Corners (2, 4, 3) of the seen field and of a box, and ends (2, 3) of the optical axis, in mm.

    The body's distance is drawn, not measured.
    """

    name: str
    field_mm: Array
    body_mm: Array
    axis_mm: Array


@dataclass(frozen=True)
class RigOutline:
    """plates_mm : (V, 4, 3) corners of the target in each view; dots_mm : (V, N, 3)."""

    cameras: tuple[CameraOutline, ...]
    view_names: tuple[str, ...]
    plates_mm: Array
    dots_mm: Array


def rig_outline(results: CalibrationResults) -> RigOutline:
    """Return everything that the drawings show, in the rig frame (mm)."""
    plate = plate_corners(results.points_mm)
    poses = list(results.views.values())
    plates = np.array([pose.apply(plate) for pose in poses]).reshape(-1, 4, 3)
    dots = np.array([pose.apply(results.points_mm) for pose in poses])
    dots = dots.reshape(len(poses), -1, 3)
    cameras = tuple(camera_outline(camera, plates.reshape(-1, 3)) for camera in results.cameras)
    return RigOutline(cameras, tuple(results.views), plates, dots)


def plate_corners(points_mm: Array, margin: float = 0.0) -> Array:
    """Return corners (4, 3) of the rectangle round dots (N, 3) of a target, widened by a share."""
    low, high = points_mm[:, :2].min(axis=0), points_mm[:, :2].max(axis=0)
    wider = margin * float((high - low).max())
    (x0, y0), (x1, y1) = low - wider, high + wider
    return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])


def common_plane(results: CalibrationResults) -> Array:
    """Return unit vectors (2, 3), across and along the first axis, of the plane of both axes.

    Across points to the first camera's right, or down where the axes lie one above the other. For
    one camera or parallel axes they are the first camera's x and z.
    """
    right, down, along = results.cameras[0].camera_from_rig.rotation
    across = results.cameras[-1].camera_from_rig.rotation[2]
    across = across - (across @ along) * along
    if np.linalg.norm(across) < 0.05:
        across = right
    if across @ max(right, down, key=lambda side: abs(across @ side)) < 0:
        across = -across
    return np.array([across / np.linalg.norm(across), along])


def camera_outline(camera: Camera, points_mm: Array) -> CameraOutline:
    """Return what is drawn of a camera that sees points (N, 3) in the rig frame (mm)."""
    depth = camera.camera_from_rig.apply(points_mm)[:, 2]
    middle = float(depth.mean())
    half_field = 0.5 * min(camera.image_size_px) / camera["scale_px_per_mm"]
    reach = max(float(np.abs(depth - middle).max()), half_field)
    # The near end stays well in front of the centre of perspective, if there is one.
    wanted_mm = middle - _BEFORE * reach
    kappa = camera["kappa_per_mm"]
    near = max(wanted_mm, -0.95 / kappa) if kappa > 0 else wanted_mm
    field = np.array([_section(camera, z) for z in (near, middle + _BEHIND * reach)])
    centre = _on_axis(camera, near)
    face = centre + 0.55 * (field[0] - centre)
    back = camera.camera_from_rig.rotation[2] * 0.7 * half_field
    axis = [_on_axis(camera, near), _on_axis(camera, middle + _BEHIND * reach)]
    return CameraOutline(camera.name, field, np.array([face - back, face]), np.array(axis))


def _section(camera: Camera, depth_mm: float) -> Array:
    """Return points (4, 3) that the image's corners see at a depth, without distortion and tilt."""
    bent = PARAMETERS[PARAMETERS.index("k1") :]
    width, height = camera.image_size_px
    u, v = width - 0.5, height - 0.5
    corners = [[-0.5, -0.5], [u, -0.5], [u, v], [-0.5, v]]
    origin, direction = camera.with_parameters(**dict.fromkeys(bent, 0.0)).unproject(corners)
    return np.asarray(origin + direction * (depth_mm / (direction @ _axis(camera)))[:, None])


def _axis(camera: Camera) -> Array:
    return np.asarray(camera.camera_from_rig.rotation[2])


def _on_axis(camera: Camera, depth_mm: float) -> Array:
    return np.asarray(camera.rig_from_camera.translation_mm + depth_mm * _axis(camera))


MOST_DOTS = 6000
"""Above this number only the outlines of the target are drawn, and the caption says so."""

_BOX = [0, 1, 2, 3, 0, 4, 5, 1, 5, 6, 2, 6, 7, 3, 7, 4]
_BOX_FACES = [[0, 0, 4, 4, 0, 0, 1, 1, 2, 2, 3, 3], [1, 2, 6, 7, 1, 5, 2, 6, 3, 7, 0, 4],
              [2, 3, 5, 6, 5, 4, 6, 5, 7, 6, 4, 7]]  # fmt: skip


def scene_json(results: CalibrationResults) -> str:
    """Return the traces and layout for ``Plotly.newPlot``, safe inside a script element."""
    outline = rig_outline(results)
    traces = [t for i, c in enumerate(outline.cameras) for t in _camera_traces(c, i)]
    traces += _target_traces(outline)
    return scene_text(traces)


def dots_are_drawn(results: CalibrationResults) -> bool:
    return len(results.views) * len(results.dot_ids) <= MOST_DOTS


def _camera_traces(camera: CameraOutline, index: int) -> list[Trace]:
    colour = camera_colour(index)
    body, field = camera.body_mm.reshape(8, 3), camera.field_mm.reshape(8, 3)
    shared = {"legendgroup": camera.name, "hoverinfo": "name", "name": f"camera {camera.name}"}
    i, j, k = _BOX_FACES
    return [
        xyz("mesh3d", body) | shared
        | {"i": i, "j": j, "k": k, "color": colour, "opacity": 0.55, "flatshading": True},
        lines(field[_BOX], colour, 1.5) | shared | {"showlegend": True, "opacity": 0.5},
        lines(camera.axis_mm, colour, 5) | shared | {"showlegend": False},
    ]  # fmt: skip


def _target_traces(outline: RigOutline) -> list[Trace]:
    if not len(outline.plates_mm):
        return []
    loops = np.full((len(outline.plates_mm), 6, 3), np.nan)
    loops[:, :5] = outline.plates_mm[:, [0, 1, 2, 3, 0]]
    names = [name for name in outline.view_names for _ in range(6)]
    traces = [
        lines(loops.reshape(-1, 3), MUTED, 2)
        | {"name": "target, every view", "text": names, "hoverinfo": "text", "showlegend": True},
        xyz("scatter3d", outline.plates_mm[:, 0])
        | {"mode": "text", "text": short_names(outline.view_names), "hoverinfo": "skip",
           "textfont": {"size": 10, "color": "#444444"}, "name": "names of the views"},
    ]  # fmt: skip
    corners = outline.plates_mm.reshape(-1, 3)
    if np.linalg.matrix_rank(corners - corners.mean(axis=0), tol=0.1) == 3:
        traces.append(
            xyz("mesh3d", corners)
            | {"alphahull": 0, "color": "#3aa0a0", "opacity": 0.08, "hoverinfo": "skip",
               "name": "calibrated volume", "showlegend": True}
        )  # fmt: skip
    if outline.dots_mm[..., 0].size <= MOST_DOTS:
        marker = {"size": 2, "color": "#333333"}
        traces.append(
            xyz("scatter3d", outline.dots_mm.reshape(-1, 3))
            | {"mode": "markers", "marker": marker, "name": "dots", "hoverinfo": "x+y+z"}
        )
    return traces


def rig_plan(results: CalibrationResults) -> Picture:
    """Draw cameras, fields and targets, projected along the common perpendicular of the axes."""
    with drawing(4.2, legend="above") as sheet:
        draw_plan(sheet.axes, results)
    caption = (
        "The plane of the optical axes, seen along their common perpendicular: the targets (grey) "
        "should fill where the fields overlap. Where the boxes stand along their axes is drawn, "
        "not measured."
    )
    return Picture("The rig in plan", sheet.source, caption)


def draw_plan(axes: Any, results: CalibrationResults) -> None:
    """Draw cameras, fields and all targets so far, in `common_plane`."""
    outline = rig_outline(results)
    plane = common_plane(results).T
    for plate in outline.plates_mm @ plane:
        axes.plot(*plate[[0, 1, 2, 3, 0]].T, color=MUTED, linewidth=0.7)
    for i, camera in enumerate(outline.cameras):
        colour = camera_colour(i)
        for box, alpha in ((camera.body_mm, 0.75), (camera.field_mm, 0.07)):
            corners = box.reshape(8, 3) @ plane
            low, high = np.split(corners, 2)
            quad = [low[np.argmin(low @ [1, -1])], low[np.argmax(low @ [1, -1])]]
            quad += [high[np.argmax(high @ [1, -1])], high[np.argmin(high @ [1, -1])]]
            axes.fill(*np.transpose(quad), color=colour, alpha=alpha, linewidth=0)
        axes.plot(*(camera.axis_mm @ plane).T, color=colour, linewidth=1.2, label=camera.name)
    axes.set(xlabel="across the first axis / mm", ylabel="along the first axis / mm")
    axes.set_aspect("equal", adjustable="datalim")


_MOST_MARKERS = 2000
_GAP = 0.06
"""Between the two images, as a share of the width."""


_MARGIN = 1 / 12
"""Round the dots of the plate, over its longer side: about half a spacing."""


def next_pictures(results: CalibrationResults) -> list[Picture]:
    """Return two pictures of the best pose; none for old folders, or when no pose was found."""
    advice = results.file.diagnostics.next_view
    if not advice.get("poses") or len(results.cameras) < 2:
        return []
    pose = np.array(advice["poses"][0]["rig_from_target"], float).reshape(4, 4)
    return [_images(results, pose, advice), _plan(results, pose)]


def _moved(pose: Array, points_mm: Array) -> Array:
    return np.asarray(points_mm @ pose[:3, :3].T + pose[:3, 3])


def _images(results: CalibrationResults, pose: Array, advice: Mapping[str, Any]) -> Picture:
    corners = _moved(pose, plate_corners(results.points_mm, _MARGIN))
    dots = _moved(pose, results.points_mm)
    marked = np.isin(results.dot_ids, advice.get("marks") or [])
    count = len(results.cameras)
    share = (1 - (count + 1) * _GAP) / count
    ratio = max(c.image_size_px[1] / c.image_size_px[0] for c in results.cameras)
    height_in = WIDTH_IN * share * ratio + 0.45
    table = results.residuals
    with drawing(height_in) as sheet:
        more = [sheet.figure.add_axes((0, 0, 1, 1), label=c.name) for c in results.cameras[1:]]
        for i, (camera, axes) in enumerate(zip(results.cameras, [sheet.axes, *more])):
            axes.set_position((_GAP + i * (share + _GAP), 0.03, share, 1 - 0.45 / height_in))
            image_axes(axes, camera.image_size_px)
            axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
            axes.set_title(f"camera {camera.name} sees", fontsize=8.5)
            uv = table.loc[(table["camera"] == camera.name) & table["kept"], ["u_px", "v_px"]]
            dot = {"markeredgewidth": 0, "rasterized": len(uv) > _MOST_MARKERS}
            axes.plot(*uv.to_numpy().T, ".", color=MUTED, alpha=0.45, markersize=3, **dot)
            outline = camera.project(corners)
            axes.fill(*outline.T, color=camera_colour(i), alpha=0.12, linewidth=0)
            axes.plot(*outline[[0, 1, 2, 3, 0]].T, color=camera_colour(i), linewidth=0.8)
            seen = camera.project(dots)
            for which, size in ((~marked, 4.0), (marked, 7.0)):
                axes.plot(*seen[which].T, "o", color=camera_colour(i), markersize=size, **dot)
            axes.plot(*outline[:2].T, color=MODEL, linewidth=2.2, solid_capstyle="butt")
    caption = (
        f"The target as {'both' if count == 2 else 'the'} cameras would see it (large: marks; "
        "red: the edge beside row 0, or of "
        "smallest y); grey: where dots were so far. Some degrees and millimetres more or less do "
        "not matter."
    )
    return Picture("How to hold it next", sheet.source, caption)


def _plan(results: CalibrationResults, pose: Array) -> Picture:
    corners = _moved(pose, plate_corners(results.points_mm, _MARGIN)) @ common_plane(results).T
    with drawing(4.2, legend="above") as sheet:
        draw_plan(sheet.axes, results)
        sheet.axes.fill(*corners.T, color=MODEL, alpha=0.15, linewidth=0)
        sheet.axes.plot(*corners[[0, 1, 2, 3, 0]].T, color=MODEL, linewidth=1.4, label="next")
        sheet.axes.plot(*corners[:2].T, color=MODEL, linewidth=3.0, solid_capstyle="butt")
    caption = (
        "The same in plan, seen along the common perpendicular of the optical axes, left and right "
        f"as camera {results.cameras[0].name} sees them; grey: the views so far."
    )
    return Picture("Where to hold it next", sheet.source, caption)
