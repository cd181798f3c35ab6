"""bubble_summary.csv: one row per bubble, every mean with its standard deviation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.physics.means import SD, Lasting, mean_of_body, parts_of_body
from telerig.estimator.physics.oscillation import LIKELY, Oscillation, dominant_oscillation, zigzag
from telerig.io.tables.smoothing import AXES, SUMMARY
from telerig.rig.bubble_physics import Liquid

_ABOVE_ZIGZAG = 2.6
"""Shape oscillations are sought above the zigzag's second harmonic, with which the aspect ratio
follows the bubble's speed."""
_TURNING_HZ = 10.0
"""How far from the shape's frequency the spectral lines of equator and pole may be: they turn with
the body and the path, a few times a second."""


def summary_table(
    frames: pd.DataFrame,
    up: Array,
    liquid: Liquid | None = None,
    ways: Mapping[tuple[int, int], Array] | None = None,
    lasting: Lasting | None = None,
) -> pd.DataFrame:
    """Return the content of bubble_summary.csv, one row per bubble.

    frames : what `telerig.bubble_table` returns.
    up : (3,) unit vector against gravity in the rig frame.
    liquid : properties of the liquid; if it is None, the dimensionless numbers are NaN.
    ways : by particle and number of its rows, standard deviations (4,) in mm of the displacement
        from the first row to the last one, and of the path's length; other bubbles get an upper
        bound.
    lasting : what the run tells of errors that all frames of a bubble have; None if nothing.
    """
    groups = frames.groupby("particle", sort=True)
    known, common = ways or {}, lasting or Lasting()
    rows = [
        _row(mine, up, liquid, known.get((int(mine["particle"].iloc[0]), len(mine))), common)
        for _, mine in groups
    ]
    table = pd.DataFrame(rows, columns=SUMMARY.names())
    return table.astype({c.name: np.int64 for c in SUMMARY.columns if c.kind == "whole"})


def _row(
    mine: pd.DataFrame,
    up: Array,
    liquid: Liquid | None,
    way_sd_mm: Array | None,
    lasting: Lasting,
) -> dict[str, Any]:
    t = mine["t_s"].to_numpy(float)
    row: dict[str, Any] = {
        "particle": mine["particle"].iloc[0],
        "first_frame": mine["frame"].iloc[0],
        "last_frame": mine["frame"].iloc[-1],
        "frames": int((mine["observed"] != 0).sum()),
        "lifetime_s": t[-1] - t[0],
    }
    for value, sd in SD.items():
        row[value], row[sd] = mean_of_body(mine, value, lasting)
    row["rise_mm_s"], row["s_rise_mm_s"] = _mean_rise(t, mine, up, way_sd_mm)
    row["slip_mm_s"] = _mean(mine["slip_mm_s"])
    # noise across the motion makes a mean speed too large
    noise = (mine[[f"sv{a}_mm_s" for a in AXES]] ** 2).sum(axis=1) / (2 * mine["slip_mm_s"])
    steady = row["s_rise_mm_s"]
    if way_sd_mm is not None and t[-1] > t[0]:
        steady = way_sd_mm[3] / (t[-1] - t[0])
    row["s_slip_mm_s"] = float(np.hypot(steady, _mean(noise)))
    swing = zigzag(t, _across(mine, "v{}_mm_s", up))
    if swing is not None:
        row["zigzag_hz"], row["s_zigzag_hz"] = swing.frequency_hz, swing.s_frequency_hz
        row["zigzag_mm"], row["s_zigzag_mm"] = swing.major, swing.s_major
        row["zigzag_minor_mm"], row["s_zigzag_minor_mm"] = swing.minor, swing.s_minor
    shape = _shape_oscillation(t, mine, up, _ABOVE_ZIGZAG * row.get("zigzag_hz", 0.0), lasting)
    if shape is not None:
        row["shape_hz"], row["s_shape_hz"] = shape.frequency_hz, shape.s_frequency_hz
        row["shape_amplitude"], row["s_shape_amplitude"] = shape.major, shape.s_major
    return row | _numbers(row, mine, liquid, lasting.scale)


def _mean(values: pd.Series[Any]) -> float:
    known = values.to_numpy(float)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else float("nan")


def _along(mine: pd.DataFrame, pattern: str, direction: Array) -> Array:
    return np.asarray(
        np.stack([mine[pattern.format(a)].to_numpy(float) for a in AXES], -1) @ direction
    )


def _across(mine: pd.DataFrame, pattern: str, up: Array) -> Array:
    """Return the components (N, 2) perpendicular to the vertical."""
    horizontal = np.linalg.svd(np.atleast_2d(up))[2][1:]
    return np.stack([_along(mine, pattern, direction) for direction in horizontal], -1)


def _mean_rise(
    t: Array, mine: pd.DataFrame, up: Array, way_sd_mm: Array | None
) -> tuple[float, float]:
    """Return the height gained over the time, and its standard deviation.

    Where that of the way is not known, an upper bound: errors of both ends have a positive
    correlation, and so have those of the velocities, so that the smaller of the two is taken.
    """
    if len(t) < 2:
        velocity = _along(mine, "v{}_mm_s", up)[0]
        return float(velocity), float(np.sqrt(_along_variance(mine, "sv{}_mm_s", up)[0]))
    height = _along(mine, "{}_mm", up)
    duration = t[-1] - t[0]
    rise = float((height[-1] - height[0]) / duration)
    if way_sd_mm is not None:
        return rise, float(np.linalg.norm(way_sd_mm[:3] * up) / duration)
    ends = _along_variance(mine, "s{}_mm", up)[[0, -1]].sum() / duration**2
    steady = np.sqrt(_along_variance(mine, "sv{}_mm_s", up)).mean() ** 2
    bound = np.fmin(ends, steady)
    return rise, float(np.sqrt(bound))


def _along_variance(mine: pd.DataFrame, pattern: str, direction: Array) -> Array:
    sd = np.stack([mine[pattern.format(a)].to_numpy(float) for a in AXES], -1)
    return np.asarray(sd**2 @ direction**2)


def _shape_oscillation(
    t: Array, mine: pd.DataFrame, up: Array, low_hz: float, lasting: Lasting
) -> Oscillation | None:
    """Return the strongest oscillation of the log aspect ratio above a frequency.

    What is not seen of the shape swings with it, and causes errors of the aspect ratio near the
    same frequency, with the spectrum of what is seen of it, ``stretch``. None if the equator or the
    pole swing by more at half the frequency, or at half its alias: the aspect ratio follows the
    square of these swings, and shows twice the frequency of the shape.
    """
    log_aspect = np.log(mine["aspect"].to_numpy(float))
    stretch = mine["stretch"].to_numpy(float)
    noise, _, _, unseen = parts_of_body(mine, "aspect") / mine["aspect"].to_numpy(float) ** 2
    seen = np.isfinite(log_aspect)
    if not seen.any():
        return None
    white, slow = np.sqrt([noise[seen].mean(), unseen[seen].mean()])
    alike = np.nan_to_num(stretch)[:, None] * slow / (2 * lasting.triaxial)
    found = dominant_oscillation(t, log_aspect[:, None], low_hz, noise=white, alike=alike)
    if found is None:
        return None
    lean = log_aspect[:, None] * _across(mine, "pole_{}", up)
    rate = 1 / float(np.median(np.diff(t[seen])))
    for half in (found.frequency_hz / 2, (rate - found.frequency_hz) / 2):
        if abs(half - found.frequency_hz) < 2 * _TURNING_HZ:
            continue
        for series in (stretch[:, None] / 2, lean):
            band = (half - _TURNING_HZ, half + _TURNING_HZ)
            swing = dominant_oscillation(t, series, *band, significant=LIKELY)
            if swing is not None and swing.major > found.major:
                return None
    return found


def _numbers(
    row: dict[str, Any], mine: pd.DataFrame, liquid: Liquid | None, scale: float
) -> dict[str, float]:
    """Dimensionless numbers of the means, and the mean drag coefficient.

    scale : relative standard deviation of lengths, an error that size and speed have in common.
    """
    d, slip = row["d_eq_mm"], row["slip_mm_s"] or float("nan")
    size, speed = row["sd_eq_mm"] / d, row["s_slip_mm_s"] / slip
    common = min(scale**2, size * speed)

    def relative(d_power: int, slip_power: int, *others: float) -> float:
        squares = (d_power * size) ** 2 + (slip_power * speed) ** 2
        squares += 2 * d_power * slip_power * common + sum(o**2 for o in others)
        return float(np.sqrt(max(squares, 0.0)))

    out = {}
    if "zigzag_hz" in row:
        out["strouhal"] = row["zigzag_hz"] * d / slip
        swing = row["s_zigzag_hz"] / row["zigzag_hz"]
        out["s_strouhal"] = out["strouhal"] * relative(1, -1, swing)
    if liquid is None:
        return out
    metres, metres_s = 1e-3 * d, 1e-3 * slip
    for name, value, powers in (
        ("reynolds", liquid.reynolds(metres, metres_s), (1, 1)),
        ("weber", liquid.weber(metres, metres_s), (1, 2)),
        ("eotvos", liquid.eotvos(metres), (2, 0)),
    ):
        out[name] = float(value)
        out[f"s_{name}"] = float(value) * relative(*powers)
    out["drag"] = _mean(mine["drag"])
    # The mean of the acceleration is a difference of two velocities over the lifetime.
    ends = mine["s_slip_mm_s"].to_numpy(float)[[0, -1]]
    inertia = float(np.hypot(*ends)) / (row["lifetime_s"] or float("nan"))
    inertia *= _mean(mine["added_mass"]) * 1e-3 / liquid.gravity
    out["s_drag"] = abs(out["drag"]) * relative(1, -2, inertia)
    return out
