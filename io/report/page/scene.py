"""Traces and layout of a 3-D scene that plotly draws in the browser."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.io.report.page.figures import MUTED

Trace = dict[str, Any]

_FEW_TICKS = 6


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
    axes = {f"{a}axis": {"title": {"text": f"{a} / mm"}, "showspikes": False} for a in "xyz"}
    lower = [-min(0.3 * (distance - 1), 0.12) * float(part) for part in up]
    view = {
        "up": dict(zip("xyz", up)),
        "center": dict(zip("xyz", lower)),
        "eye": dict(zip("xyz", _eye(up, distance))),
    }
    layout: dict[str, Any] = {
        "scene": axes | {"aspectmode": "data", "camera": view},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"orientation": "h", "x": 0, "y": 0, "yanchor": "top"},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": MUTED, "activecolor": "#333333"},
        "paper_bgcolor": "rgba(0,0,0,0)",
    }
    if ratio is not None:
        layout["scene"] |= {"aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio))}
        for name in ("xaxis", "yaxis", "zaxis"):
            layout["scene"][name] |= {"nticks": _FEW_TICKS}
    text = json.dumps({"data": traces, "layout": layout}, allow_nan=False)
    return text.replace("</", "<\\/")


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
