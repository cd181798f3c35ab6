"""The rig and all poses of the target as one 3-D scene that needs nothing but the page itself."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.calibration.results import CalibrationResults
from telerig.io.report.calibration.rig_outline import CameraOutline, RigOutline, rig_outline
from telerig.io.report.page.figures import MUTED, camera_colour
from telerig.io.report.page.number_format import short_names

Array = NDArray[np.float64]
Trace = dict[str, Any]

MOST_DOTS = 6000
"""Above this number only the outlines of the target are drawn, and the caption says so."""

_FEW_TICKS = 6
_BOX = [0, 1, 2, 3, 0, 4, 5, 1, 5, 6, 2, 6, 7, 3, 7, 4]
_BOX_FACES = [[0, 0, 4, 4, 0, 0, 1, 1, 2, 2, 3, 3], [1, 2, 6, 7, 1, 5, 2, 6, 3, 7, 0, 4],
              [2, 3, 5, 6, 5, 4, 6, 5, 7, 6, 4, 7]]  # fmt: skip


def scene_json(results: CalibrationResults) -> str:
    """Traces and layout for ``Plotly.newPlot``, safe inside a script element."""
    outline = rig_outline(results)
    traces = [t for i, c in enumerate(outline.cameras) for t in _camera_traces(c, i)]
    traces += _target_traces(outline)
    return scene_text(traces)


def scene_text(
    traces: list[Trace],
    up: Sequence[float] = (0.0, -1.0, 0.0),
    distance: float = 1.0,
    ratio: Sequence[float] | None = None,
) -> str:
    """Traces with a layout for them, safe inside a script element.

    up : (3,) unit vector, up on the screen. distance : of the eye; from afar it looks a little
    lower, where tilted boxes reach farthest. ratio : of the box' sides, None: true proportions.
    """
    layout = _layout(up, distance)
    if ratio is not None:
        layout["scene"] |= {"aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio))}
        for name in ("xaxis", "yaxis", "zaxis"):
            layout["scene"][name] |= {"nticks": _FEW_TICKS}
    text = json.dumps({"data": traces, "layout": layout}, allow_nan=False)
    return text.replace("</", "<\\/")


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


def xyz(kind: str, points_mm: Array) -> Trace:
    """Micrometre digits; NaN, which interrupts a line, is null in JSON."""
    columns = [[None if np.isnan(c) else round(float(c), 3) for c in axis] for axis in points_mm.T]
    return {"type": kind, **dict(zip("xyz", columns))}


def lines(points_mm: Array, colour: str, width: float) -> Trace:
    return xyz("scatter3d", points_mm) | {
        "mode": "lines", "line": {"color": colour, "width": width}, "connectgaps": False,
    }  # fmt: skip


def _eye(up: Sequence[float], distance: float) -> list[float]:
    """From above, off the two horizontal axes."""
    axis = int(np.argmax(np.abs(up)))
    eye = 0.8 * np.array(up, float)
    eye[[i for i in range(3) if i != axis]] += (0.85, -1.0)
    return [float(part) for part in distance * eye]


def _layout(up: Sequence[float], distance: float) -> dict[str, Any]:
    axes = {f"{a}axis": {"title": {"text": f"{a} / mm"}, "showspikes": False} for a in "xyz"}
    lower = [-min(0.3 * (distance - 1), 0.12) * float(part) for part in up]
    view = {
        "up": dict(zip("xyz", up)),
        "center": dict(zip("xyz", lower)),
        "eye": dict(zip("xyz", _eye(up, distance))),
    }
    return {
        "scene": axes | {"aspectmode": "data", "camera": view},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"orientation": "h", "x": 0, "y": 0, "yanchor": "top"},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": MUTED, "activecolor": "#333333"},
        "paper_bgcolor": "rgba(0,0,0,0)",
    }
