"""The marks of a run as a smoothing problem has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.sensors.findings import Finding
from telerig.estimator.sensors.given import times
from telerig.estimator.smoothing.problem.problem import Mark, Observations
from telerig.rig.camera import Camera

MARK_SIGMA_MM = 100.0
"""Prior standard deviation of a mark's place."""


def references_of(
    table: Any, cameras: Sequence[Camera], t_s: Array, positions_mm: Array, axis: Array
) -> tuple[tuple[Mark, ...], Observations, list[Finding]]:
    """Return marks at their triangulated positions, their pixels, and warnings.

    table : marks.csv.
    t_s, positions_mm : (F,) times of the frames and positions of the carriage.
    axis : (3,) travel axis in the rig frame.

    Raises InputError for a table that cannot be used.
    """
    if table is None:
        return (), Observations.none(), []
    _check_references(table, cameras)
    if not len(table):
        return (), Observations.none(), []
    names = [c.name for c in cameras]
    inside = ((table["frame"] >= 0) & (table["frame"] < len(t_s))).to_numpy()
    findings = []
    if not inside.all():
        words = f"{np.count_nonzero(~inside)} rows are of frames outside 0 to {len(t_s) - 1}"
        findings.append(Finding(f"{words} and are not used", "references"))
    table = table[inside]
    attributions = sorted(set(table["mark"].astype(str)))
    number = {m: i for i, m in enumerate(attributions)}
    item = table["mark"].astype(str).map(number).to_numpy(np.int64)
    frame = table["frame"].to_numpy(np.int64)
    camera = table["camera"].map({n: i for i, n in enumerate(names)}).to_numpy(np.int64)
    uv = table[["u_px", "v_px"]].to_numpy(float)
    sigma = table["sigma_px"].to_numpy(float) if "sigma_px" in table else np.full(len(uv), 0.1)
    observations = Observations(item, frame, camera, uv, sigma[:, None, None] ** 2 * np.eye(2))
    guesses = _marks(observations, cameras, positions_mm, axis, len(attributions))
    marks = (Mark(name, g, MARK_SIGMA_MM) for name, g in zip(attributions, guesses))
    return tuple(marks), observations, findings


def _check_references(table: Any, cameras: Sequence[Camera]) -> None:
    """Raise InputError for a table of marks that cannot be used."""
    where, todo = "references", "give a table with the columns frame, camera, mark, u_px, v_px"
    if not hasattr(table, "columns"):
        raise InputError(f"is {type(table).__name__}, not a table", where=where, todo=todo)
    missing = [c for c in ("frame", "camera", "mark", "u_px", "v_px") if c not in table]
    if missing:
        raise InputError(f"has no column {', '.join(missing)}", where=where, todo=todo)
    names = [c.name for c in cameras]
    unknown = sorted(set(table["camera"].astype(str)) - set(names))
    if unknown:
        raise InputError(
            f"there is no camera {unknown[0]!r} in the calibration",
            where=where,
            todo=f"it has {', '.join(names)}",
        )
    for column in ("frame", "u_px", "v_px", *(["sigma_px"] if "sigma_px" in table else [])):
        values = times(table[column], where, column)
        bad = {"frame": values % 1 != 0, "sigma_px": values <= 0}.get(column, np.zeros(0, bool))
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"{column} is {values[row]:g} at row {row}", where=where,
                todo="give whole numbers of frames, and standard deviations above 0",
            )  # fmt: skip


def _marks(
    seen: Observations, cameras: Sequence[Camera], positions_mm: Array, axis: Array, count: int
) -> Array:
    """Return the laboratory points (count, 3) nearest to all rays of each mark.

    Along directions that no camera resolves they are nearest to the origin.
    """
    normal, right = np.tile(1e-6 * np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    for c, camera in enumerate(cameras):
        mine = seen.camera == c
        origin, direction = camera.unproject(seen.uv_px[mine])
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        lab = origin + positions_mm[seen.frame[mine], None] * axis
        np.add.at(normal, seen.item[mine], across)
        np.add.at(right, seen.item[mine], np.einsum("mij,mj->mi", across, lab))
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])
