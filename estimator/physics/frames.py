"""bubbles.csv: what is known of each bubble in each frame, with standard deviations.

Errors are propagated to first order, by differences over one standard deviation of every input.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.rig_file.fluid import liquid_of, liquid_velocity
from telerig.io.tables.smoothing import AXES, BODY_COLUMNS, BUBBLES, NUMBERS
from telerig.rig.bubble_physics import Liquid, added_mass, drag_coefficient

_M = 1e-3


@np.errstate(divide="ignore", invalid="ignore")
def frames_table(
    trajectories: pd.DataFrame,
    bodies: pd.DataFrame | None,
    up: Array,
    gravity_m_s2: float,
    fluid: Any = None,
    along: tuple[float, float] = (1.0, 1.0),
) -> pd.DataFrame:
    """Return the content of bubbles.csv: one row for each row of trajectories.csv.

    bodies : the table that `bodies_table` returns; None if no size is known.
    up : (3,) unit vector against gravity in the rig frame.
    gravity_m_s2 : its magnitude.
    fluid : as for `liquid_of`; if it is None, the dimensionless numbers are NaN.
    along : variances of velocity and acceleration along the slip velocity, divided by those that
        errors independent along the axes would have.
    """
    liquid = liquid_of(fluid, gravity_m_s2)
    size = BODY_COLUMNS[2:]
    keys = ["frame", "particle"]
    motion = trajectories.drop(columns=[c for c in size if c in trajectories])
    shapes = pd.DataFrame(columns=BODY_COLUMNS) if bodies is None else bodies
    shapes = shapes.astype(dict.fromkeys(keys, np.int64))
    table = motion.merge(shapes, "left", on=keys, sort=False)
    state = {}
    for name, unit in (("{}", "mm"), ("v{}", "mm_s"), ("a{}", "mm_s2")):
        for prefix in ("", "s"):
            for axis in AXES:
                column = f"{prefix}{name.format(axis)}_{unit}"
                state[column] = _column(table, column)
    velocity, velocity_sd = (_vectors(state, f"{p}v", "mm_s") for p in ("", "s"))
    acceleration, acceleration_sd = (_vectors(state, f"{p}a", "mm_s2") for p in ("", "s"))
    flow = liquid_velocity(None if liquid is None else liquid[1], up)
    slip = velocity - flow
    inputs = [
        (slip, _errors(velocity_sd, slip, along[0])),
        (acceleration, _errors(acceleration_sd, slip, along[1])),
    ]
    curvature, curvature_sd = propagated(_curvature, [(velocity, inputs[0][1]), inputs[1]])
    speed, speed_sd = propagated(lambda v: np.linalg.norm(v, axis=-1), inputs[:1])
    shape = {name: _column(table, name) for name in size}
    out = {name: table[name].to_numpy() for name in ("frame", "particle", "t_s")} | state | shape
    out |= _numbers(shape, inputs, up, None if liquid is None else liquid[0])
    out |= {"slip_mm_s": speed, "s_slip_mm_s": speed_sd}
    out |= {"curvature_1_mm": curvature, "s_curvature_1_mm": curvature_sd}
    out["observed"] = _column(table, "observed")
    return pd.DataFrame(out)[BUBBLES.names()]


def _column(table: pd.DataFrame, name: str) -> Array:
    if name not in table:
        return np.full(len(table), np.nan)
    return table[name].to_numpy(float)


def _vectors(columns: Mapping[str, Array], name: str, unit: str) -> Array:
    return np.stack([columns[f"{name}{axis}_{unit}"] for axis in AXES], -1)


def _errors(sd: Array, direction: Array, share: float) -> Array:
    """Return three independent errors (N, 3, 3) of one standard deviation each.

    sd : (N, 3) along the axes. share : of the variance along the directions (N, 3) that is left.
    """
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    unit = np.divide(direction, length, out=np.full_like(direction, np.nan), where=length > 0)
    away = np.eye(3) - (1 - np.sqrt(share)) * unit[:, :, None] * unit[:, None, :]
    return np.asarray(sd[..., None] * away)


def _curvature(velocity: Array, acceleration: Array) -> Array:
    """Return the curvature (...) of a path in 1/mm: |v x a| / |v|^3."""
    turn = np.linalg.norm(np.cross(velocity, acceleration), axis=-1)
    return np.asarray(turn / np.linalg.norm(velocity, axis=-1) ** 3)


def _numbers(
    shape: Mapping[str, Array],
    motion: list[tuple[Array, Array]],
    up: Array,
    liquid: Liquid | None,
) -> dict[str, Array]:
    count = len(shape["d_eq_mm"])
    if liquid is None:
        nan = np.full(count, np.nan)
        return {p + name: nan for name in NUMBERS for p in ("", "s_")} | {"added_mass": nan}
    # A body of unknown shape counts as a sphere, of known volume.
    flat = np.isfinite(shape["aspect"])
    aspect = np.where(flat, np.log(shape["aspect"]), 0.0)
    pole = np.stack([shape[f"pole_{axis}"] for axis in AXES], -1)
    pole = np.where(flat[:, None], pole, up)
    d_sd = shape["sd_eq_mm"] / shape["d_eq_mm"]
    aspect_sd = np.where(flat, shape["s_aspect"] / shape["aspect"], 0.0)
    shared = np.where(flat, shape["r_size_aspect"], 0.0)
    # (M, 2) log size and log aspect, and a square root of their covariance as two directions
    body = np.stack([np.log(shape["d_eq_mm"] * _M), aspect], -1)
    root = np.zeros((count, 2, 2))
    root[:, 0, 0], root[:, 0, 1] = d_sd, shared * aspect_sd
    root[:, 1, 1] = aspect_sd * np.sqrt(np.maximum(1 - shared**2, 0))

    def mass(slip: Array, body: Array) -> Array:
        along, across = added_mass(np.exp(body[..., 1]))
        cosine2 = (pole * slip).sum(-1) ** 2 / (slip * slip).sum(-1)
        return np.asarray(across + (along - across) * cosine2)

    def speed(slip: Array) -> Array:
        return np.asarray(np.linalg.norm(slip, axis=-1) * _M)

    def drag(slip: Array, acceleration: Array, body: Array) -> Array:
        d = np.exp(body[..., 0])
        return drag_coefficient(d, slip * _M, acceleration * _M, up, mass(slip, body), liquid)

    laws: dict[str, Callable[..., Array]] = {
        "reynolds": lambda slip, _, body: liquid.reynolds(np.exp(body[..., 0]), speed(slip)),
        "weber": lambda slip, _, body: liquid.weber(np.exp(body[..., 0]), speed(slip)),
        "eotvos": lambda slip, _, body: liquid.eotvos(np.exp(body[..., 0])),
        "drag": drag,
    }
    out = {}
    for name, law in laws.items():
        out[name], out[f"s_{name}"] = propagated(law, [*motion, (body, root)])
    out["added_mass"] = mass(motion[0][0], body)
    return out


def propagated(law: Callable[..., Array], inputs: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return a law's values and their standard deviations.

    Errors are propagated by central differences of one standard deviation to either side; the
    errors of different arguments are independent.

    inputs : for each argument of the law, its values (..., k) and its errors: either the standard
        deviations (..., k) of k independent components, or m independent error vectors
        (..., m, k) of one standard deviation each, when the components are correlated.
    """
    values = [value for value, _ in inputs]
    variance = np.zeros(1)
    for i, (value, sd) in enumerate(inputs):
        steps = sd[..., None] * np.eye(value.shape[-1]) if sd.ndim == value.ndim else sd
        for k in range(steps.shape[-2]):
            ends = []
            for sign in (1, -1):
                moved = [*values]
                moved[i] = value + sign * steps[..., k, :]
                ends.append(law(*moved))
            # a step that does not enter the law, although it is unknown, adds nothing
            change = np.where(ends[0] == ends[1], 0.0, (ends[0] - ends[1]) / 2)
            variance = variance + change**2
    with np.errstate(invalid="ignore"):
        return law(*values), np.asarray(np.sqrt(variance))
