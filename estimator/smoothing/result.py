"""The result of a smoothing: its tables, verdict and numbers, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.graph.stage_travel import (
    carriage,
    carriage_sigma,
    considered_variance,
    scale_sigma,
    total_scale,
)
from telerig.estimator.smoothing.problem.problem import ShakeModel
from telerig.estimator.smoothing.verdict.whiteness import accelerometer_spectra, pixel_whiteness
from telerig.factors.bubble_motion import BubbleModel
from telerig.factors.state_space import discretise, distinct_steps, ou_velocity

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Smoothing:
    """Hold what `telerig.smooth` returns.

    trajectories : table of positions and velocities of the bubbles; `docs/files.md` describes it.
    shake : table of the cameras' shake in each frame; `docs/files.md` describes it.
    verdict : the part of smoothing.json that states how far the data separate the bubbles' motion
        from the shake; empty if this was not judged.
    summary : the rest of smoothing.json.
    model : the hyper-parameters that were used.
    solution : the estimated states and their covariances.
    """

    trajectories: pd.DataFrame
    shake: pd.DataFrame
    verdict: Mapping[str, Any]
    summary: Mapping[str, Any]
    model: ShakeModel
    solution: Solution = field(repr=False)

    def save(self, folder: str | Path) -> None:
        """Write trajectories.csv, shake.csv, smoothing.json and results.h5 (HDF5) into a folder.

        All files appear together.
        """
        from telerig.io.results.manifest import replaced_results

        place = Path(folder)
        with replaced_results(place, "smooth", again="Smoothing.save", inputs={}) as staged:
            self.write_files(staged)

    def write_files(self, out: Path) -> None:
        """Write the files of `save` into an existing folder, one after the other."""
        from telerig.io.files.csv_table import write_table
        from telerig.io.results.smoothing import SmoothingFile

        write_table(self.trajectories, out / "trajectories.csv")
        write_table(self.shake, out / "shake.csv")
        file = out / "smoothing.json"
        SmoothingFile.of({**self.verdict, **self.summary}, file).write(file)
        write_hdf5(self, out / "results.h5")


def summary_of(solution: Solution) -> dict[str, Any]:
    """Return the content of smoothing.json without the verdict.

    It holds the hyper-parameters, the estimated constants with their standard deviations, and
    numbers about the residuals.
    """
    from telerig.io.results.smoothing import SmoothingFile

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
    """Return the estimated scale and delay of the encoder; empty without an encoder.

    ``scale_from`` is "run" if marks determined the scale in this run, otherwise it names where the
    scale was known from.
    """
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
        found["masked_samples"] = sensor.masked_samples
        weight = solution.sample_weights[i] if solution.sample_weights else None
        if weight is not None:
            found["masked_samples"] = int(np.count_nonzero(weight < _USED))
        found["delay_s"] += sensor.offset_s
        found["offset_s"] = found["delay_s"]
        found["offset_sd_s"] = found.get("sdelay_s", sensor.offset_sd_s)
        found["drift_ppm"] = sensor.drift_ppm
        found["confirmed"] = sensor.confirmed
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
    """Write both tables, the states and their covariances into an HDF5 file.

    The file's attribute ``rows`` explains how positions and velocities follow from the states. The
    covariances are those of the solution; the attribute ``inflation`` holds the factors of the
    standard deviations along x, y and z by which contradicting measurements widen the tables'.
    """
    from telerig.io.files.hdf5 import hdf5_file
    from telerig.io.results.smoothing import SmoothingFile

    solution = smoothing.solution
    layout = solution.graph
    with hdf5_file(path) as file:
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
            # level 1 of shuffled bytes is three times as fast as the default, and not larger
            states.create_dataset(
                name, data=array, compression="gzip", compression_opts=1, shuffle=True
            )
        file.attrs["schema"] = SmoothingFile.SCHEMA
        file.attrs["inflation"] = smoothing.verdict.get("inflation", (1.0, 1.0, 1.0))
        file.attrs["rows"] = "a state times its rows gives mm, mm/s in the lab (rig axes)"


_USED = 0.5

AXES = ("x", "y", "z")
LONGEST_RTS = 5000
MOST_RTS_ROWS = 40_000
"""Largest number of frames of a track, and of frames of all tracks in their order, for which the
result of a plain RTS smoother is also computed. For more filterpy would need more time than the
whole smoothing graph.
"""


def trajectories(
    solution: Solution,
    tracks: pd.DataFrame | None,
    inflation: Sequence[float] = (1.0, 1.0, 1.0),
) -> pd.DataFrame:
    """Return the table of the bubbles' positions (mm) and velocities (mm/s) in the laboratory
    frame.

    The table has one row for every frame from a bubble's first to its last detection. The standard
    deviations include the uncertainty of the encoder's scale and of the travel axis; their columns
    are missing if the solution has no covariances.

    tracks : table with the columns of tracks.csv, from which the triangulated positions, the result
        of a plain RTS smoother and the diameters are added; None to leave these columns out.
    inflation : (3,) factor of the standard deviations along each axis where measurements disagree.
    """
    import pandas as pd

    graph, problem = solution.graph, solution.graph.problem
    if not problem.bubbles:
        return pd.DataFrame({name: [] for name in ("frame", "particle", "t_s")})
    layout, covariances = graph.bubble, solution.covariances
    states = solution.state.bubbles
    columns: dict[str, Any] = {
        "frame": graph.frame_of_row,
        "particle": np.array([b.particle for b in problem.bubbles])[graph.bubble_of_row],
        "t_s": problem.t_s[graph.frame_of_row],
    }
    columns |= _named(states @ layout.position.T, "{}_mm")
    columns |= _named(states @ layout.velocity.T, "v{}_mm_s")
    if covariances is not None:
        place, speed = considered_variance(solution)
        sigma = _sigma(layout.position, covariances.bubbles)
        columns |= _named(np.sqrt(sigma**2 + place) * inflation, "s{}_mm")
        sigma = _sigma(layout.velocity, covariances.bubbles)
        columns |= _named(np.sqrt(sigma**2 + speed) * inflation, "sv{}_mm_s")
    columns["observed"] = _observed(solution)
    if tracks is not None:
        columns |= _baselines(solution, tracks)
    return pd.DataFrame(columns)


def _named(values: Array, pattern: str) -> dict[str, Array]:
    return {pattern.format(axis): values[:, i] for i, axis in enumerate(AXES)}


def _sigma(rows: Array, covariance: Array) -> Array:
    """Return the standard deviations (n, 3) of linear combinations of n states with d components.

    rows : (3, d) or (n, 3, d) coefficients.  covariance : (n, d, d) covariances of the states.
    """
    return np.asarray(np.sqrt(((rows @ covariance) * rows).sum(-1).clip(0)))


def _observed(solution: Solution) -> Ints:
    """Return for each row 1 if a camera saw the bubble and the pixel was no outlier, else 0."""
    graph, obs = solution.graph, solution.graph.problem.observations
    out = np.zeros(graph.rows, np.int64)
    kept = solution.weights[0] > 0.5
    out[graph.row(obs.item[kept], obs.frame[kept])] = 1
    return out


def _baselines(solution: Solution, tracks: pd.DataFrame) -> dict[str, Array]:
    """Return columns for comparison: triangulated ("naive") positions, the result of a plain RTS
    smoother, and the diameters that the tracker found.
    """
    graph, problem = solution.graph, solution.graph.problem
    number = {b.particle: i for i, b in enumerate(problem.bubbles)}
    item = tracks["particle"].map(number).to_numpy(np.int64)
    seen = tracks["frame"].to_numpy(np.int64)
    rows = graph.row(np.asarray(item), np.asarray(seen))
    naive = np.full((graph.rows, 3), np.nan)
    naive[rows] = tracks[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    naive[rows] += problem.encoder_mm[seen, None] * problem.axis
    covariance = np.tile(1e-4 * np.eye(3), (graph.rows, 1, 1))
    names = [["sxx", "sxy", "sxz"], ["sxy", "syy", "syz"], ["sxz", "syz", "szz"]]
    if f"{names[0][0]}_mm2" in tracks:
        for i, line in enumerate(names):
            for j, name in enumerate(line):
                covariance[rows, i, j] = tracks[f"{name}_mm2"].to_numpy(float)
    velocity, plain = np.full_like(naive, np.nan), np.full((2, *naive.shape), np.nan)
    for k in range(len(problem.bubbles)):
        mine = slice(graph.first_row[k], graph.first_row[k + 1])
        t = problem.t_s[graph.frame_of_row[mine]]
        velocity[mine] = _central_velocity(t, naive[mine])
        if 1 < len(t) <= LONGEST_RTS and mine.stop <= MOST_RTS_ROWS:
            plain[:, mine] = _rts(t, naive[mine], covariance[mine], graph.model.bubble)
    out = _named(naive, "naive_{}_mm") | _named(velocity, "naive_v{}_mm_s")
    out |= _named(plain[0], "rts_{}_mm") | _named(plain[1], "rts_v{}_mm_s")
    if "d_eq_mm" in tracks:
        diameter = np.full(graph.rows, np.nan)
        diameter[rows] = tracks["d_eq_mm"].to_numpy(float)
        out["d_eq_mm"] = diameter
    return out


def _central_velocity(t_s: Array, position_mm: Array) -> Array:
    """Return velocities (n, 3) in mm/s as differences between the frame before and the frame after.

    At the ends, the frame itself replaces the missing one. The velocity is NaN beside a missing
    position.

    t_s : (n,) times.  position_mm : (n, 3) positions, NaN where missing.
    """
    if len(t_s) < 2:
        return np.full_like(position_mm, np.nan)
    before, after = (np.clip(np.arange(len(t_s)) + i, 0, len(t_s) - 1) for i in (-1, 1))
    difference = position_mm[after] - position_mm[before]
    return np.asarray(difference / (t_s[after] - t_s[before])[:, None])


def _rts(
    t_s: Array, position_mm: Array, covariance_mm2: Array, model: BubbleModel
) -> tuple[Array, Array]:
    """Return the result of filterpy's Kalman filter and RTS smoother, whose model has no shake.

    t_s : (n,) times.
    position_mm : (n, 3) positions in the laboratory frame, NaN where missing.
    covariance_mm2 : (n, 3, 3) their covariances.

    Returns positions (n, 3) in mm and velocities (n, 3) in mm/s.
    """
    from filterpy.kalman import KalmanFilter

    seen = np.asarray(np.isfinite(position_mm).all(1))
    lengths, index = distinct_steps(np.diff(t_s))
    path = ou_velocity(
        sigma_mm_s=model.velocity_sigma_mm_s,
        tau_s=model.velocity_tau_s,
        start_sigma_mm=model.start_sigma_mm,
    )
    steps = discretise([path], lengths)[0]
    # of one axis: position, velocity, mean velocity
    transition, noise = np.tile(np.eye(3), (len(t_s), 1, 1)), np.zeros((len(t_s), 3, 3))
    transition[1:, :2, :2] = steps.transition[0, index]
    transition[1:, :2, 2] = steps.input[0, index, :, 0]
    noise[1:, :2, :2] = steps.covariance[0, index]
    start = np.diag([model.start_sigma_mm**2, 0.0, 0.0])
    start[1:, 1:] = model.mean_sigma_mm_s**2
    start[1, 1] += model.velocity_sigma_mm_s**2
    filter_: Any = KalmanFilter(dim_x=9, dim_z=3)
    filter_.x = np.r_[position_mm[np.argmax(seen)], np.zeros(6)][:, None]
    filter_.P = np.kron(start, np.eye(3))
    filter_.H = np.eye(3, 9)
    matrices = [np.kron(a, np.eye(3)) for a in (transition, noise)]
    readings = [p[:, None] if s else None for p, s in zip(position_mm, seen)]
    means, covariances, _, _ = filter_.batch_filter(readings, *matrices, Rs=covariance_mm2)
    smooth, *_ = filter_.rts_smoother(means, covariances, *matrices)
    return smooth[:, :3, 0], smooth[:, 3:6, 0]


def shake(solution: Solution, inflation: Sequence[float] = (1.0, 1.0, 1.0)) -> pd.DataFrame:
    """Return a table with one row per frame: the carriage's position and the offset of each camera
    from the carriage, in mm along the axes of the rig frame.

    A camera's own shake along its optical axis cannot be seen. Its estimate is 0 and its standard
    deviation is that of the prior.

    inflation : as for `trajectories`.
    """
    import pandas as pd

    graph, problem, layout = solution.graph, solution.graph.problem, solution.graph.shake
    states, covariances = graph.shake_at_frames(solution.state.shake), solution.covariances
    columns: dict[str, Any] = {"frame": np.arange(len(states)), "t_s": problem.t_s}
    for c, camera in enumerate(problem.cameras):
        columns |= _named(states @ layout.offset[c].T, f"{camera.name}_{{}}_mm")
        if covariances is not None:
            sigma = _sigma(layout.offset[c], covariances.shake)
            unseen = np.diagonal(layout.unseen_variance_mm2[c])
            sd = np.sqrt(sigma**2 + unseen) * inflation
            columns |= _named(sd, f"s{camera.name}_{{}}_mm")
    if problem.stage is not None:
        columns["position_mm"], _ = carriage(solution)
        if covariances is not None:
            sigma = _sigma(layout.position[None], covariances.shake)[:, 0]
            columns["sposition_mm"] = carriage_sigma(solution, sigma)
    return pd.DataFrame(columns)
