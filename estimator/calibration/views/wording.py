"""How to hold the target, in words for a person at the rig: as the first camera sees it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.views.poses import (
    TILT_LIMIT_DEG,
    Candidates,
    bases,
    dots_seen,
    middle_mm,
    new_cells,
    optical_axes,
    volume_centre_mm,
)
from telerig.factors.projection import State

Array = NDArray[np.float64]

_WAYS = ("to the right", "to the lower right", "down", "to the lower left",
         "to the left", "to the upper left", "up", "to the upper right")  # fmt: skip
_NEARLY_DEG = 3.0
_NEARLY_MM = 0.5
_MORE_TILT_DEG = 4.0
_CORNER_CELLS = 2


def hold_words(problem: Problem, state: State, one: Candidates) -> str:
    """Turn, lean, roll and place of one pose, as its pair of cameras sees it."""
    pair, rig_from_target = one.pair[0], one.rig_from_target[0]
    axes, facing = optical_axes(state)[pair], one.facing[0][pair]
    alike, along, across = bases(axes, facing)
    first, second = (problem.cameras[c].name for c in pair)
    # the side that the first camera sees looks against its axis
    looks = -facing[0] * rig_from_target[:3, 2]
    middle = -facing[0] * alike
    to_first = -axes[0] - (-axes[0] @ middle) * middle
    to_first = to_first / max(np.linalg.norm(to_first), 1e-9)
    if np.linalg.norm(np.cross(axes[0], axes[1])) < 0.1:
        to_first = along
    turn = np.degrees(np.arctan2(looks @ to_first, looks @ middle))
    upright = abs(across[1]) >= abs(across[0])
    across = across * np.sign(-across[1] if upright else across[0])
    lean = np.degrees(np.arcsin(np.clip(looks @ across, -1, 1)))
    parts = [_start_words(problem, facing, (first, second))]
    if abs(turn) >= _NEARLY_DEG:
        way = "towards" if facing[0] == facing[1] else "squarer to"
        parts.append(
            f"turn it {abs(turn):.0f} degrees {way} camera {first if turn > 0 else second}"
        )
    if abs(lean) >= _NEARLY_DEG:
        edge = "top" if upright else "right edge"
        parts.append(f"tilt its {edge} {abs(lean):.0f} degrees {'back' if lean > 0 else 'forward'}")
    parts.append(_roll_words(problem, rig_from_target))
    parts.append(_place_words(problem, state, rig_from_target))
    return ", ".join(parts)


def _start_words(problem: Problem, facing: Array, pair: tuple[str, str]) -> str:
    first, second = pair
    side = {1.0: "front", -1.0: "back"}
    if facing[0] != facing[1]:
        return (
            f"hold the plate with its {side[facing[0]]} towards camera {first} and its "
            f"{side[facing[1]]} towards camera {second}, at the same angle to both cameras"
        )
    between = "the cameras"
    if len(problem.cameras) > 2:
        between = f"cameras {first} and {second}"
    which = f"'s {side[facing[0]]}" if problem.target.two_sided else ""
    return f"face the plate{which} midway between {between}"


def _roll_words(problem: Problem, rig_from_target: Array) -> str:
    """Where the first row points in the first camera's image."""
    u, v = -rig_from_target[:2, 1]
    way = _WAYS[int(np.round(np.arctan2(v, u) / (np.pi / 4))) % 8]
    if problem.target.layout == "points":
        return f"its smaller y {way}"
    return f"row 0 {way}"


def _place_words(problem: Problem, state: State, rig_from_target: Array) -> str:
    place = rig_from_target[:3, :3] @ middle_mm(state) + rig_from_target[:3, 3]
    x, y, z = place - volume_centre_mm(problem, state)
    camera = problem.cameras[0].name
    parts = [
        f"{abs(value):.0f} mm {ways[int(value > 0)]}"
        for value, ways in (
            (y, ("above", "below")), (x, ("left of", "right of")), (z, ("nearer than", "beyond")),
        )
        if abs(value) >= _NEARLY_MM
    ]  # fmt: skip
    if not parts:
        return "its middle in the middle of the field"
    joined = parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]
    return f"its middle {joined} the middle of the field as camera {camera} sees it"


def reason_words(problem: Problem, state: State, one: Candidates) -> tuple[str, ...]:
    """What a pose has that the views so far have not."""
    out = []
    seen = np.unique(problem.view[problem.weight > 0])
    cosine = np.abs(optical_axes(state) @ state.rig_from_target[seen, :3, 2].T)
    then = np.abs(optical_axes(state) @ one.rig_from_target[0, :3, 2])
    visible, uv = dots_seen(problem, state, one, np.arange(len(state.dots_mm)))
    new = new_cells(problem, visible[0], uv[0])
    for c, camera in enumerate(problem.cameras):
        most, tilt = (float(np.degrees(np.arccos(np.clip(v, 0, 1)))) for v in
                      (cosine[c].min(), then[c]))  # fmt: skip
        if one.sees[0, c] and tilt > most + _MORE_TILT_DEG:
            out.append(
                f"a tilt of {tilt:.0f} degrees to camera {camera.name}, so far {most:.0f} at most"
            )
        if new[c].any():
            out.append(f"fills {_where(new[c])} of camera {camera.name}'s image")
    return tuple(out)


def _where(cells: Array) -> str:
    """Empty parts that are filled, (columns, rows)."""
    near, far = slice(0, _CORNER_CELLS), slice(-_CORNER_CELLS, None)
    names = [
        f"{upper} {left}"
        for v, upper in ((near, "upper"), (far, "lower"))
        for u, left in ((near, "left"), (far, "right"))
        if cells[u, v].any()
    ]
    if not names:
        return "empty parts"
    return "the empty " + " and ".join(names)


def first_views(
    first: str, second: str, angle_deg: float, *, alone: bool = True
) -> tuple[str, ...]:
    """Words for the first views, before any calibration can say more.

    first, second : the cameras' names.  angle_deg : between their axes.  alone : whether the rig
    has no other cameras.
    """
    between = "the cameras" if alone else f"cameras {first} and {second}"
    turn = max(0, min(20, int(TILT_LIMIT_DEG - angle_deg / 2 - 5) // 5 * 5))
    aside = {
        c: f"turn it {turn} degrees towards camera {c}, " if turn else "" for c in (first, second)
    }
    start = f"face the plate midway between {between}, "
    return (
        start + "its middle in the middle of the field",
        start + "tilt its top 30 degrees back, hold it towards the upper left",
        start + "tilt its top 30 degrees forward, roll it a quarter turn, towards the lower right",
        start + aside[first] + "hold it towards the lower left, nearer",
        start + aside[second] + "roll it half a turn, towards the upper right, farther away",
        start + aside[first] + "tilt its top 40 degrees back, roll it by 45 degrees",
    )
