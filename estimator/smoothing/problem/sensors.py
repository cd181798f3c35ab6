"""Encoder, accelerometers and marks as the smoother takes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array, Bools
from telerig.errors import InputError
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    Accelerometer,
    CalibrationShare,
    Mark,
    Observations,
    Stage,
    check_increasing,
)
from telerig.rig.camera import Camera
from telerig.rig.units import STANDARD_GRAVITY_M_S2

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration


_MICRO_G_MM_S2 = 1e-3 * STANDARD_GRAVITY_M_S2
_MARGIN_S = 0.25
_MARK_SIGMA_MM = 100.0
_FELT_PX = 2e-3


def stage_of(table: Any, t_s: Array) -> Stage | None:
    """The encoder's record around the frames. Raises InputError when it does not overlap them."""
    if table is None:
        return None
    t = _column(table, "t_s", "stage")
    position = _column(table, "position_mm", "stage")
    check_increasing(t, "stage", 2)
    if t[-1] < t_s[0] or t[0] > t_s[-1]:
        raise InputError(
            f"the record ({t[0]:.6g} to {t[-1]:.6g} s) does not overlap the frames "
            f"({t_s[0]:.6g} to {t_s[-1]:.6g} s)",
            where="stage",
            todo="put both on one clock",
        )
    near = _near(t, t_s)
    return Stage(t[near], position[near])


def accelerometers_of(
    given: Any, rig: Any, cameras: Sequence[Camera], t_s: Array
) -> tuple[Accelerometer, ...]:
    """Sensors from a table (t_s, sensor, ax_m_s2, ...) or from a mapping of name to fields.

    A mapping's fields: t_s (N,), a_m_s2 (N, 3), and, where the rig does not describe the sensor,
    mounted_on, axes, noise_density_ug_sqrt_hz, bias_sigma_m_s2.
    Raises InputError for a sensor that is not described, unknown mounts, NaN.
    """
    if given is None:
        return ()
    described = {} if rig is None else dict(rig.accelerometers)
    sources = dict(given) if isinstance(given, Mapping) else _split(given)
    out = []
    for name, source in sources.items():
        fields = _description(str(name), source, described)
        t = np.asarray(source["t_s"], float)
        reading = np.asarray(source["a_m_s2"], float).reshape(-1, 3) * 1000
        if not (np.all(np.isfinite(t)) and np.all(np.isfinite(reading))):
            raise InputError(
                "readings are not finite", where=f"accelerometer {name}", todo="leave them out"
            )
        near = _near(t, t_s)
        if near.sum() < 2:
            raise InputError(
                "its record does not overlap the frames",
                where=f"accelerometer {name}",
                todo="put both on one clock",
            )
        rate = (near.sum() - 1) / (t[near][-1] - t[near][0])
        sigma = fields["noise_density_ug_sqrt_hz"] * _MICRO_G_MM_S2 * np.sqrt(rate / 2)
        out.append(
            Accelerometer(
                str(name), _mount(str(name), fields["mounted_on"], cameras), t[near],
                reading[near], np.asarray(fields["axes"], float), float(sigma),
                1000 * float(fields.get("bias_sigma_m_s2", 0.2)),
            )
        )  # fmt: skip
    return tuple(out)


def _split(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    columns = ["ax_m_s2", "ay_m_s2", "az_m_s2"]
    missing = [c for c in ("t_s", "sensor", *columns) if c not in table]
    if missing:
        raise InputError(
            f"the table has no column {', '.join(missing)}",
            where="accelerometers",
            todo="its columns are t_s,sensor,ax_m_s2,ay_m_s2,az_m_s2",
        )
    return {
        str(name): {"t_s": rows["t_s"].to_numpy(float), "a_m_s2": rows[columns].to_numpy(float)}
        for name, rows in table.groupby("sensor", sort=False)
    }


def _description(
    name: str, source: Mapping[str, Any], described: Mapping[str, Any]
) -> dict[str, Any]:
    needed = ("mounted_on", "axes", "noise_density_ug_sqrt_hz")
    fields: dict[str, Any] = {}
    if name in described:
        entry = described[name]
        fields = {key: getattr(entry, key) for key in (*needed, "bias_sigma_m_s2")}
    fields |= {k: source[k] for k in (*needed, "bias_sigma_m_s2") if k in source}
    missing = [key for key in needed if key not in fields]
    if missing:
        raise InputError(
            f"nothing says its {', '.join(missing)}",
            where=f"accelerometer {name}",
            todo=f"describe it under [accelerometers.{name}] in rig.toml",
        )
    return fields


def _mount(name: str, mounted_on: str, cameras: Sequence[Camera]) -> int:
    if mounted_on == "carriage":
        return CARRIAGE
    names = [c.name for c in cameras]
    if mounted_on not in names:
        raise InputError(
            f"is mounted on {mounted_on!r}, which is no camera",
            where=f"accelerometer {name}",
            todo=f'use one of {", ".join(names)} or "carriage"',
        )
    return names.index(mounted_on)


def thinned(sensors: tuple[Accelerometer, ...], step_s: float) -> tuple[Accelerometer, ...]:
    """Samples averaged in blocks no longer than step_s, each at its mean time; none over a gap.

    An average over T of a motion at w is too small by (w T)^2 / 24: 0.6 % at 60 Hz and 1 ms.
    """
    return tuple(_thinned(sensor, step_s) for sensor in sensors)


def _thinned(sensor: Accelerometer, step_s: float) -> Accelerometer:
    block = int(step_s / np.median(np.diff(sensor.t_s)) + 1e-6)
    count = len(sensor.t_s) // block if block > 1 else 0
    if count < 2:
        return sensor
    used = count * block
    t = sensor.t_s[:used].reshape(count, block)
    whole = np.ptp(t, axis=1) < 1.5 * step_s
    reading = sensor.reading_mm_s2[:used].reshape(count, block, 3)
    return replace(
        sensor,
        t_s=t.mean(1)[whole],
        reading_mm_s2=reading.mean(1)[whole],
        sigma_mm_s2=sensor.sigma_mm_s2 / float(np.sqrt(block)),
    )


def references_of(
    table: Any, cameras: Sequence[Camera], t_s: Array, positions_mm: Array, axis: Array
) -> tuple[tuple[Mark, ...], Observations]:
    """Marks fixed to the tank: where they were seen, and where their rays come closest."""
    if table is None or not len(table):
        return (), Observations.none()
    names = [c.name for c in cameras]
    unknown = sorted(set(table["camera"]) - set(names))
    if unknown:
        raise InputError(
            f"there is no camera {unknown[0]!r} in the calibration",
            where="references",
            todo=f"it has {', '.join(names)}",
        )
    table = table[(table["frame"] >= 0) & (table["frame"] < len(t_s))]
    attributions = sorted(set(table["mark"].astype(str)))
    number = {m: i for i, m in enumerate(attributions)}
    item = table["mark"].astype(str).map(number).to_numpy(np.int64)
    frame = table["frame"].to_numpy(np.int64)
    camera = table["camera"].map({n: i for i, n in enumerate(names)}).to_numpy(np.int64)
    uv = table[["u_px", "v_px"]].to_numpy(float)
    sigma = table["sigma_px"].to_numpy(float) if "sigma_px" in table else np.full(len(uv), 0.1)
    observations = Observations(item, frame, camera, uv, sigma[:, None, None] ** 2 * np.eye(2))
    guesses = _marks(observations, cameras, positions_mm, axis, len(attributions))
    marks = (Mark(name, g, _MARK_SIGMA_MM) for name, g in zip(attributions, guesses))
    return tuple(marks), observations


def _marks(
    seen: Observations, cameras: Sequence[Camera], positions_mm: Array, axis: Array, count: int
) -> Array:
    """(count, 3) lab points nearest to all rays, and to the rig's origin where depth is unseen."""
    normal, right = np.tile(1e-6 * np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    for c, camera in enumerate(cameras):
        mine = seen.camera == c
        origin, direction = camera.unproject(seen.uv_px[mine])
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        lab = origin + positions_mm[seen.frame[mine], None] * axis
        np.add.at(normal, seen.item[mine], across)
        np.add.at(right, seen.item[mine], np.einsum("mij,mj->mi", across, lab))
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def calibration_share(
    calibration: Calibration, points_mm: Array, sigma_px: float, drift: Array | None = None
) -> CalibrationShare | None:
    """The directions of the calibration's covariance that move the pixels of these rig points.

    A direction whose effect stays far below the noise of a mean over the run is left out.
    drift : (6, 6) prior of a movement of the second camera since the calibration.
    """
    from telerig.estimator.calibration.solver.covariance import rig_jacobian
    from telerig.estimator.rig_drift.drift import rig_block, with_drift

    covariance, free = calibration.covariance, calibration.free
    if drift is not None:
        covariance, free = rig_block(calibration)
        covariance = with_drift(covariance, drift)
    if not len(points_mm) or not covariance.size:
        return None
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.clip(values, 0, None))
    rows = rig_jacobian(calibration.cameras, free, points_mm) @ root
    flat = rows.reshape(-1, root.shape[1])
    _, strength, turn = np.linalg.svd(flat, full_matrices=False)
    felt = strength / np.sqrt(len(flat)) > min(_FELT_PX, 0.02 * sigma_px)
    if not felt.any():
        return None
    return CalibrationShare(root @ turn[felt].T, free, covariance, drift)


def _near(t: Array, t_s: Array) -> Bools:
    return np.asarray((t >= t_s[0] - _MARGIN_S) & (t <= t_s[-1] + _MARGIN_S))


def _column(table: Any, name: str, where: str) -> Array:
    if name not in table:
        raise InputError(
            f"the table has no column {name}", where=where, todo="give t_s,position_mm"
        )
    values = np.asarray(table[name], float)
    if not np.all(np.isfinite(values)):
        raise InputError(f"{name} is not finite everywhere", where=where, todo="leave rows out")
    return values
