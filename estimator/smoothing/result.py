"""The result of a smoothing: tables, verdict, numbers, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.graph.stage_travel import (
    considered_variance,
    scale_sigma,
    total_scale,
)
from telerig.estimator.smoothing.problem.problem import ShakeModel
from telerig.estimator.smoothing.verdict.whiteness import accelerometer_spectra, pixel_whiteness
from telerig.io.results.smoothing import SmoothingFile

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Smoothing:
    """What `telerig.smooth` returns.

    trajectories, shake : see docs/files.md.  verdict : the content of smoothing.json that says
    how far bubble motion and shake could be told apart; empty when nothing judged it.
    summary : the rest of smoothing.json.  solution : states, covariances, the graph's layout.
    """

    trajectories: pd.DataFrame
    shake: pd.DataFrame
    verdict: Mapping[str, Any]
    summary: Mapping[str, Any]
    model: ShakeModel
    solution: Solution = field(repr=False)

    def save(self, folder: str | Path) -> None:
        """Write trajectories.csv, shake.csv, smoothing.json and results.h5."""
        from telerig.io.files.csv_table import write_table

        out = Path(folder)
        write_table(self.trajectories, out / "trajectories.csv")
        write_table(self.shake, out / "shake.csv")
        file = out / "smoothing.json"
        SmoothingFile.of({**self.verdict, **self.summary}, file).write(file)
        write_hdf5(self, out / "results.h5")


def summary_of(solution: Solution) -> dict[str, Any]:
    """Hyper-parameters, constants with their standard deviations, residuals, in numbers."""
    graph = solution.graph
    problem, model = graph.problem, graph.model
    names = [c.name for c in problem.cameras]
    return {
        "schema": SmoothingFile.SCHEMA,
        "cameras": names,
        "frames": len(problem.t_s),
        "bubbles": len(problem.bubbles),
        "model": asdict(model),
        "log_evidence": solution.log_evidence,
        "passes": solution.passes,
        "states": {"shake": list(graph.shake.labels), "nodes": len(graph.nodes.t_s)},
        "unseen": {
            n: f"along its depth, {_direction(c.camera_from_rig.rotation[2])} in rig axes"
            for n, c in zip(names, problem.cameras)
        },
        "depth_axes": {n: c.camera_from_rig.rotation[2] for n, c in zip(names, problem.cameras)},
        "residuals": {
            "bubbles": _residuals(solution, 0),
            "references": _residuals(solution, 1),
        },
        "whiteness": pixel_whiteness(solution),
        "accelerometer_spectra": accelerometer_spectra(solution),
        "encoder": _encoder(solution),
        "travel": _travel(solution),
        "accelerometers": _sensors(solution),
        "bubble_means": _means(solution),
    }


def _direction(vector: Array) -> str:
    return "(" + ", ".join(f"{v:.3g}" for v in vector) + ")"


def _residuals(solution: Solution, which: int) -> dict[str, Any]:
    values, weights = solution.residuals[which], solution.weights[which]
    kept = weights > 0.5
    if not len(values):
        return {"pixels": 0}
    square = (values[kept] ** 2).sum(-1)
    return {
        "pixels": len(values),
        "outliers": int((~kept).sum()),
        "rms_sigmas": float(np.sqrt(square.mean() / 2)) if kept.any() else None,
        "median_sigmas": float(np.sqrt(np.median(square) / (2 * np.log(2))))
        if kept.any()
        else None,
    }


def _encoder(solution: Solution) -> dict[str, Any]:
    """Scale and delay; ``scale_from`` : "run" where marks told it, else where it was known from."""
    graph, block = solution.graph, _block(solution, "encoder")
    if graph.problem.stage is None:
        return {}
    travel = graph.problem.travel
    known = "given" if travel is None else travel.source
    out: dict[str, Any] = {
        "scale": total_scale(solution),
        "sscale": scale_sigma(solution),
        "scale_from": "run" if graph.encoder_flags[0] else known,
    }
    if graph.encoder_flags[1]:
        out["delay_s"] = float(solution.state.encoder[-1])
        if block is not None:
            out["sdelay_s"] = float(np.sqrt(block[-1, -1]))
    return out


def _travel(solution: Solution) -> dict[str, Any]:
    travel = solution.graph.problem.travel
    if travel is None or solution.graph.problem.stage is None:
        return {}
    place, _ = considered_variance(solution)
    return {
        "axis": travel.axis.tolist(),
        "axis_from": "stage_axis" if travel.source == "stage_axis" else "rig.toml",
        "axis_sd_deg": np.degrees(np.sqrt(np.diagonal(travel.covariance)[:2])).tolist(),
        "left_open_mm": np.sqrt(np.median(place, axis=0)).tolist() if len(place) else [0.0] * 3,
    }


def _sensors(solution: Solution) -> dict[str, Any]:
    graph = solution.graph
    names = ["bias_x_mm_s2", "bias_y_mm_s2", "bias_z_mm_s2"]
    names += ["scale"] * graph.sensor_flags[0]
    out = {}
    for i, sensor in enumerate(graph.problem.accelerometers):
        block, clocks = _block(solution, "sensors"), _block(solution, "clocks")
        found = _with_sd(names, solution.state.sensors[i], None if block is None else block[i])
        found["delay_s"] = float(solution.delays_s[i])
        if clocks is not None and graph.sensor_flags[1]:
            found["sdelay_s"] = float(np.sqrt(clocks[graph.clock_of[i], 0, 0]))
        out[sensor.name] = found
    return out


def _means(solution: Solution) -> dict[str, Any]:
    names = ["x_mm_s", "y_mm_s", "z_mm_s"]
    block = _block(solution, "means")
    return {
        str(b.particle): _with_sd(
            names, solution.state.means[i], None if block is None else block[i]
        )
        for i, b in enumerate(solution.graph.problem.bubbles)
    }


def _block(solution: Solution, name: str) -> Array | None:
    found = solution.covariances
    return None if found is None else np.asarray(getattr(found, name))


def _with_sd(names: list[str], values: Array, covariance: Array | None) -> dict[str, Any]:
    out = {n: float(v) for n, v in zip(names, values)}
    if covariance is not None:
        out |= {f"s{n}": float(np.sqrt(covariance[i, i])) for i, n in enumerate(names)}
    return out


def write_hdf5(smoothing: Smoothing, path: Path) -> None:
    """Both tables as columns, states and covariances as arrays, and how to read them."""
    import h5py

    from telerig.io.files.atomic import atomic_path

    solution = smoothing.solution
    layout = solution.graph
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        for name, table in (("trajectories", smoothing.trajectories), ("shake", smoothing.shake)):
            group = file.create_group(name)
            for column in table.columns:
                group.create_dataset(column, data=table[column].to_numpy(), compression="gzip")
        states = file.create_group("states")
        arrays = {
            "shake": layout.shake_at_frames(solution.state.shake),
            "bubbles": solution.state.bubbles,
            "shake_offset_rows": layout.shake.offset,
            "bubble_position_rows": layout.bubble.position,
            "bubble_velocity_rows": layout.bubble.velocity,
        }
        found = solution.covariances
        if found is not None:
            arrays |= {"shake_covariance": found.shake, "bubble_covariance": found.bubbles}
        for name, array in arrays.items():
            states.create_dataset(name, data=array, compression="gzip")
        file.attrs["schema"] = SmoothingFile.SCHEMA
        file.attrs["rows"] = "a state times its rows gives mm, mm/s in the lab (rig axes)"
