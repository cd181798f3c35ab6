"""The result of a smoothing: its tables, verdict and numbers, and how they are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.estimator.smoothing.graph.accelerations import Accelerations
from telerig.estimator.smoothing.graph.layout import points_in_rig, variances
from telerig.estimator.smoothing.graph.linear import MARKS
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.graph.stage_travel import (
    carriage,
    carriage_sigma,
    considered_variance,
    scale_sigma,
    total_scale,
)
from telerig.estimator.smoothing.problem.problem import ShakeModel
from telerig.estimator.smoothing.results_file import StoredTables, Tables
from telerig.estimator.smoothing.verdict.evidence import BUBBLES, Evidence, Pixels, Span
from telerig.estimator.smoothing.verdict.whiteness import accelerometer_spectra
from telerig.factors.bubble_motion import BubbleModel
from telerig.factors.state_space import discretise, distinct_steps, ou_velocity
from telerig.io.tables.smoothing import AXES
from telerig.rig.units import STANDARD_GRAVITY_M_S2
from telerig.short_text import ShortText, counted, first_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray

    from telerig.estimator.calibration.result.calibration import Calibration


@dataclass(frozen=True, repr=False)
class Smoothing(ShortText):
    """Hold what `telerig.smooth` returns, or what `telerig.load_smoothing` reads from a folder.

    trajectories : table of positions and velocities of the bubbles; `docs/files.md` describes it.
    shake : table of the cameras' shake in each frame; `docs/files.md` describes it.
    verdict : the part of smoothing.json that states how far the data separate the bubbles' motion
        from the shake; empty if this was not judged.
    summary : the rest of smoothing.json.
    model : the hyper-parameters that were used.
    tables : object that holds ``trajectories``, ``shake``, ``states`` and ``bodies``. The tables of
        a long run, which was smoothed in pieces, are read from files when they are asked for.
    states : the estimated states of the bubbles, one row for each row of ``trajectories``, and of
        the shake, one row for each frame, with their covariances and with the rows that give
        positions and velocities from them: the group "states" of results.h5. Empty if a folder has
        no results.h5.
    bodies : table of the bubbles' sizes, aspect ratios and poles by frame, measured from their
        outlines (`telerig.estimator.physics.bodies`); None if there are no bubbles.
    solution : the solution of the graph; None if the smoothing was read from a folder, and of a
        long run.
    name : name of the run; "" if it is not known.
    """

    verdict: Mapping[str, Any]
    summary: Mapping[str, Any]
    model: ShakeModel
    tables: Tables | StoredTables
    solution: Solution | None = None
    name: str = ""

    @property
    def trajectories(self) -> pd.DataFrame:
        """The table of the bubbles."""
        return self.tables.trajectories

    @property
    def shake(self) -> pd.DataFrame:
        """The table of the cameras' shake."""
        return self.tables.shake

    @property
    def states(self) -> Mapping[str, Array]:
        """The states and their covariances."""
        return self.tables.states

    @property
    def bodies(self) -> pd.DataFrame | None:
        """The table of the bubbles' bodies."""
        return self.tables.bodies

    def title(self) -> str:
        """Return the name of the run, to what its paths are good, and the verdict."""
        from telerig.io.results.smoothing import SmoothingFile
        from telerig.io.results.verdict_words import number_words

        file = SmoothingFile.model_validate(self.verdict)
        flags = f" ({', '.join(file.flags)})" if file.flags else ""
        words = f"{number_words(file.axes, file.vertical, file.verdict)} "
        words += f"{file.verdict or 'not judged'}{flags}"
        return f"Smoothing{self.name and f' of run {self.name!r}'}: {words.strip()}"

    def facts(self) -> dict[str, str]:
        """Return the size, the verdict along each axis, the accuracy and the warnings, in words."""
        axes, (bubbles, frames) = self.verdict.get("axes", {}), self.tables.sizes()
        facts = {"bubbles": f"{counted(bubbles, 'bubble')} in {counted(frames, 'frame')}"}
        facts["axes"] = ", ".join(f"{name} {axis['verdict']}" for name, axis in axes.items())
        for name, pattern, factor, unit in (
            ("position sd", "s{}_mm", 1e3, "µm"), ("velocity sd", "sv{}_mm_s", 1.0, "mm/s")
        ):  # fmt: skip
            columns = [pattern.format(axis) for axis in AXES]
            table = self.tables.typical(columns)
            if len(table) and set(columns) <= set(table):
                x, y, z = factor * table[columns].median()
                facts[name] = f"x {x:.3g}, y {y:.3g}, z {z:.3g} {unit} (median)"
        facts["remedy"] = str(self.verdict.get("remedy", ""))
        facts["warnings"] = first_of(list(self.summary.get("warnings", ())))
        return facts

    def to_pandas(self) -> pd.DataFrame:
        """Return ``trajectories`` indexed by particle and frame: ``.loc[3]`` is one bubble."""
        return self.trajectories.set_index(["particle", "frame"]).sort_index()

    def to_xarray(self) -> xarray.Dataset:
        """Return the trajectories as an `xarray.Dataset` with the names and units of the CF
        conventions.

        Its dimension ``obs`` has the rows of ``trajectories``, sorted by particle and frame;
        ``trajectory`` has the bubbles, with the number of their rows in ``rowSize``.
        ``covariance`` (obs, axis, axis_of) in mm^2 is missing if there are no states. Raises
        InputError if xarray is not installed.
        """
        from telerig.io.exchange.export.netcdf import to_xarray
        from telerig.io.exchange.export.run_results import LAB, RunResults

        verdict = self.title().partition(": ")[2]
        results = RunResults(self.name, LAB, self.trajectories, self.shake, verdict, "smoothed")
        return to_xarray(results, self.covariance_mm2())

    def covariance_mm2(self) -> Array | None:
        """Return the covariances (N, 3, 3) in mm^2 of the N positions of ``trajectories``.

        The correlations are those of the states; what the encoder's scale, the travel axis and
        contradictions add to the variances is added here, too, so the diagonal has the squares of
        sx_mm, sy_mm and sz_mm. Returns None without states or standard deviations.
        """
        columns = [f"s{axis}_mm" for axis in AXES]
        if "bubble_covariance" not in self.states or not set(columns) <= set(self.trajectories):
            return None
        rows, covariance = self.states["bubble_position_rows"], self.states["bubble_covariance"]
        inflation = np.asarray(self.verdict.get("inflation") or (1.0, 1.0, 1.0))
        out = rows @ covariance @ np.swapaxes(rows, -1, -2) * np.outer(inflation, inflation)
        out[:, range(3), range(3)] = self.trajectories[columns].to_numpy(float) ** 2
        return np.asarray(out)

    def save(self, folder: str | Path) -> None:
        """Write trajectories.csv, shake.csv, bubbles.csv, bubble_summary.csv, smoothing.json and
        results.h5 (HDF5) into a folder.

        All files appear together.
        """
        from telerig.io.results.manifest import replaced_results

        place = Path(folder)
        with replaced_results(place, "smooth", again="Smoothing.save", inputs={}) as staged:
            self.write_files(staged)

    def write_files(self, out: Path) -> None:
        """Write the files of `save` into an existing folder, one after the other."""
        import pandas as pd

        from telerig.io.files.csv_table import append_table, write_table
        from telerig.io.results.smoothing import SmoothingFile

        self.tables.write(out, self.verdict.get("inflation", (1.0, 1.0, 1.0)))
        open_, ended = list[pd.DataFrame](), list[pd.DataFrame]()
        last = self.tables.last_parts()
        for number, part in enumerate(self.tables.parts()):
            bubbles = bubble_table(replace(self, tables=part))
            if not len(bubbles):
                continue
            append_table(bubbles, out / "bubbles.csv")
            known = pd.concat([*open_, bubbles], ignore_index=True)
            going_on = known["particle"].map(last) > number
            open_ = [known[going_on]]
            if not going_on.all():
                ended.append(bubble_summary(self, known[~going_on]))
        if ended:
            summary = pd.concat(ended, ignore_index=True)
            summary = summary.sort_values("particle", kind="stable", ignore_index=True)
            write_table(summary, out / "bubble_summary.csv")
        file = out / "smoothing.json"
        SmoothingFile.of({**self.verdict, **self.summary}, file).write(file)


def bubble_table(smoothing: Smoothing, fluid: Any = None) -> pd.DataFrame:
    """Return size, shape, motion and forces of each bubble in each frame.

    The table has one row for each row of ``smoothing.trajectories``; `docs/bubbles.md` describes
    the columns.
    fluid : a mapping with the keys of [fluid] in rig.toml (density_kg_m3, viscosity_pa_s,
        surface_tension_n_m, and if known velocity_mm_s, gas_density_kg_m3); None for the one of the
        run's rig.toml. Without one the dimensionless numbers are NaN.

    Raises InputError for a fluid that lacks a key or has an impossible value, and for anything but
    a Smoothing.
    """
    from telerig.estimator.physics.frames import frames_table

    up, gravity, known = _surroundings(smoothing, fluid)
    if not len(smoothing.trajectories):
        return smoothing.trajectories
    along = smoothing.summary.get("along_path") or {}
    return frames_table(
        smoothing.trajectories, smoothing.bodies, up, gravity, known,
        (along.get("velocity", 1.0), along.get("acceleration", 1.0)),
    )  # fmt: skip


def bubble_summary(
    smoothing: Smoothing, bubbles: pd.DataFrame | None = None, fluid: Any = None
) -> pd.DataFrame:
    """Return a table with one row per bubble: mean size, rise velocity, oscillations and forces.

    bubbles : what `bubble_table` returned for the same fluid; None to compute it.
    fluid : as for `bubble_table`. `docs/bubbles.md` describes the columns.
    """
    from telerig.estimator.physics.means import Lasting
    from telerig.estimator.physics.summary import summary_table
    from telerig.io.rig_file.fluid import liquid_of

    up, gravity, known = _surroundings(smoothing, fluid)
    frames = bubble_table(smoothing, fluid) if bubbles is None else bubbles
    liquid, inflation = liquid_of(known, gravity), smoothing.verdict.get("inflation", (1.0,) * 3)
    ways = {
        (int(particle), int(mean["frames"])): np.array(
            [*np.multiply(mean["way_sd_mm"], inflation), mean["length_sd_mm"] * max(inflation)]
        )
        for particle, mean in smoothing.summary.get("bubble_means", {}).items()
        if "length_sd_mm" in mean
    }
    lasting = Lasting.of(smoothing.summary.get("bodies"))
    return summary_table(frames, up, None if liquid is None else liquid[0], ways, lasting)


def _surroundings(smoothing: Smoothing, fluid: Any) -> tuple[Array, float, Any]:
    """Return up (3,), gravity in m/s^2, and the liquid: the given one or the run's."""
    if not isinstance(smoothing, Smoothing):
        raise InputError(
            f"tables of bubbles are made from a Smoothing, not from {type(smoothing).__name__}",
            todo="give what telerig.smooth or telerig.load_smoothing returns",
        )
    summary = smoothing.summary
    up = np.asarray(summary.get("up") or (0.0, -1.0, 0.0), float)
    gravity = float(summary.get("gravity_m_s2") or STANDARD_GRAVITY_M_S2)
    return up, gravity, (summary.get("fluid") or None) if fluid is None else fluid


def summary_of(
    solution: Solution,
    evidence: Evidence,
    frames: int | None = None,
    sensors: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the content of smoothing.json without the verdict.

    It holds the hyper-parameters, the estimated constants with their standard deviations, and
    numbers about the residuals.

    evidence : of the run.
    frames : of a run of which the solution is the piece in the middle; None for a whole run's.
    sensors : estimates of sensors that are not in this piece, from `sensors_of` of others.
    """
    from telerig.io.results.cameras import CameraRecord, wall_records
    from telerig.io.results.smoothing import SmoothingFile

    graph, whole = solution.graph, frames is None
    problem, model = graph.problem, graph.model
    names = [c.name for c in problem.cameras]
    return {
        "schema": SmoothingFile.SCHEMA,
        "cameras": names,
        "rig": {n: CameraRecord.of_camera(c).content() for n, c in zip(names, problem.cameras)},
        "walls": wall_records(problem.cameras),
        "frames": len(problem.t_s) if whole else frames,
        "bubbles": len(evidence.means),
        "model": asdict(model),
        "log_evidence": solution.log_evidence if whole else None,
        "passes": evidence.passes,
        "states": {"shake": list(graph.shake.labels), "nodes": evidence.nodes},
        "unseen": {
            n: f"along its depth, {_direction(c.camera_from_rig.rotation[2])} in rig axes"
            for n, c in zip(names, problem.cameras)
        },
        "up": np.asarray(problem.up, float).tolist(),
        "gravity_m_s2": float(problem.gravity_m_s2),
        "depth_axes": {n: c.camera_from_rig.rotation[2] for n, c in zip(names, problem.cameras)},
        "residuals": {
            "bubbles": _residuals(evidence.pixels[BUBBLES]),
            "references": _residuals(evidence.pixels[MARKS]),
        },
        "whiteness": {
            name: found for name, one in evidence.lagged.items() if (found := one.compared())
        },
        "accelerometer_spectra": accelerometer_spectra(solution),
        "encoder": _encoder(solution),
        "travel": _travel(solution),
        "accelerometers": {
            name: found | {"masked_samples": evidence.lost[name].masked}
            for name, found in {**(sensors or {}), **sensors_of(solution)}.items()
        },
        "bubble_means": _means(evidence),
        **_accelerations(solution),
    }


def _accelerations(solution: Solution) -> dict[str, Any]:
    found = solution.accelerations
    if found is None:
        return {}
    band = dict(zip(AXES, found.bandwidth_hz.tolist(), strict=True))
    return {
        "acceleration_bandwidth_hz": band,
        "inertia_s": max(found.inertia.time_s),
        "inertia_by_axis_s": dict(zip(AXES, found.inertia.time_s, strict=True)),
        "force_intensity": dict(zip(AXES, found.inertia.forces, strict=True)),
        "swing_damping": dict(zip(AXES, found.inertia.swings, strict=True)),
        "white_noise": dict(zip(("along", "across"), found.inertia.noise, strict=True)),
        "along_path": _along_path(solution, found),
    }


def _along_path(solution: Solution, found: Accelerations) -> dict[str, float]:
    """Return the variances of velocity and acceleration along the paths, divided by those of errors
    that are independent along the axes; 1 where bubbles are seen once only, without a path.

    Both are those of the middle of a track, where most frames are; near its ends both are larger.
    """
    square = solution.velocities_mm_s**2
    share = square / np.maximum(square.sum(-1, keepdims=True), 1e-18)
    speed = solution.velocity_variances() + considered_variance(solution)[1]
    totals = np.array([np.median((share * v).sum(-1)) for v in (speed, found.sd_mm_s2**2)])
    cancelled = np.array(found.inertia.cancelled, float)
    left = 1 - np.divide(cancelled, totals, out=np.zeros(2), where=totals > 0)
    return dict(zip(("velocity", "acceleration"), left.clip(_LEAST_LEFT, 1).tolist(), strict=True))


def _direction(vector: Array) -> str:
    return "(" + ", ".join(f"{v:.3g}" for v in vector) + ")"


def _residuals(pixels: Pixels) -> dict[str, Any]:
    if not pixels.count:
        return {"pixels": 0}
    kept = pixels.count - pixels.lost
    return {
        "pixels": pixels.count,
        "outliers": pixels.lost,
        "rms_sigmas": float(np.sqrt(pixels.total / kept / 2)) if kept else None,
        "median_sigmas": float(np.sqrt(np.median(pixels.some) / (2 * np.log(2)))) if kept else None,
    }


def _encoder(solution: Solution) -> dict[str, Any]:
    """Return the estimated scale of the encoder; empty without an encoder.

    ``scale_from`` is "run" if marks determined the scale in this run, otherwise it names where the
    scale was known from.
    """
    graph = solution.graph
    if graph.problem.stage is None:
        return {}
    travel = graph.problem.travel
    known = "given" if travel is None else travel.source
    return {
        "scale": total_scale(solution),
        "sscale": scale_sigma(solution),
        "scale_from": "run" if graph.encoder_size else known,
    }


def _travel(solution: Solution) -> dict[str, Any]:
    travel = solution.graph.problem.travel
    if travel is None or solution.graph.problem.stage is None:
        return {}
    out = {"axis": travel.axis.tolist()}
    if travel.source == "stage_axis":  # one that is stated counts as exact
        out["axis_sd_deg"] = np.degrees(np.sqrt(np.diagonal(travel.covariance)[:2])).tolist()
    return out


def sensors_of(solution: Solution) -> dict[str, Any]:
    """Return the estimates of bias, scale and clock of each sensor by its name."""
    graph, known = solution.graph, solution.covariances
    names = ["bias_x_mm_s2", "bias_y_mm_s2", "bias_z_mm_s2"]
    names += ["scale"] * graph.sensor_flags[0]
    out = {}
    for i, sensor in enumerate(graph.problem.accelerometers):
        found: dict[str, Any] = dict(zip(names, solution.state.sensors[i].tolist()))
        if known is not None:
            sds = np.sqrt(np.diagonal(known.sensors[i])).tolist()
            found |= {f"s{name}": sd for name, sd in zip(names, sds)}
        if known is not None and graph.sensor_flags[1]:
            found["sdelay_s"] = float(np.sqrt(known.clocks[graph.clock_of[i], 0, 0]))
        found["delay_s"] = found["offset_s"] = float(solution.delays_s[i]) + sensor.offset_s
        found["offset_sd_s"] = found.get("sdelay_s", sensor.offset_sd_s)
        found["drift_ppm"] = sensor.drift_ppm
        found["confirmed"] = sensor.confirmed
        out[sensor.name] = found
    return out


def _means(evidence: Evidence) -> dict[str, Any]:
    names, out = ["x_mm_s", "y_mm_s", "z_mm_s"], {}
    for particle, mean in evidence.means.items():
        found = dict(zip(names, mean.velocity_mm_s.tolist()))
        if mean.sigma_mm_s is not None:
            found |= {f"s{n}": s for n, s in zip(names, mean.sigma_mm_s.tolist())}
        if mean.way_sigma_mm is not None:
            found |= {"frames": mean.frames, "way_sd_mm": mean.way_sigma_mm.tolist()}
            found["length_sd_mm"] = mean.length_sigma_mm
        out[str(particle)] = found
    return out


def states_of(solution: Solution, span: Span | None = None) -> dict[str, Array]:
    """Return the ``states`` of a `Smoothing`; span : its frames, None for all."""
    layout, found = solution.graph, solution.covariances
    frames: Any = slice(None)
    rows: Any = slice(None)
    if span is not None:
        frames = slice(span.own.start, span.own.stop)
        rows = np.flatnonzero(span.holds(layout.frame_of_row))
    arrays = {
        "shake": layout.shake_at_frames(solution.state.shake)[frames],
        "bubbles": solution.state.bubbles[rows],
        "shake_offset_rows": np.asarray(layout.shake.offset),
        "bubble_position_rows": np.asarray(layout.bubble.position),
        "bubble_velocity_rows": np.asarray(layout.bubble.velocity),
    }
    if found is not None:
        arrays["shake_covariance"] = found.shake[frames]
        arrays["bubble_covariance"] = found.bubbles[rows]
    moved = solution.accelerations
    if moved is not None:
        arrays["bubble_acceleration"] = moved.value_mm_s2[rows]
        arrays["bubble_acceleration_covariance"] = moved.covariance[rows]
    return arrays


def load_smoothing(folder: str | Path) -> Smoothing:
    """Read the files that `telerig smooth` or `Smoothing.save` wrote into a folder.

    Returns a `Smoothing` without ``solution``; its name is that of the folder. Without results.h5,
    ``states`` is empty. Of a run that was smoothed in pieces, the tables are read from results.h5
    when they are asked for.
    Raises InputError when trajectories.csv, shake.csv or smoothing.json is missing, when a file
    cannot be read, or when the files belong to different results.
    """
    from pydantic import TypeAdapter, ValidationError

    from telerig.io.files.hdf5 import read_arrays
    from telerig.io.files.names import absent
    from telerig.io.results.folders.smoothing import SmoothingResults
    from telerig.io.results.manifest import reading
    from telerig.io.results.smoothing import SmoothingFile
    from telerig.io.tables.smoothing import BODY_COLUMNS

    place = Path(folder)
    if not place.is_dir():
        raise absent(place, "folder of results", f"run `{SmoothingFile.MAKE}` first")
    tables: Tables | StoredTables = StoredTables(place)
    found = SmoothingResults(place)
    with reading(place, (*SmoothingResults.FILES[:-1], "results.h5")):
        record, file = found.file, place / "results.h5"
        if not (file.is_file() and StoredTables(place).of_pieces()):
            states = read_arrays(file, "states") if file.is_file() else {}
            there = (place / "bubbles.csv").is_file()
            bodies = found.bubble_frames[BODY_COLUMNS] if there else None
            tables = Tables(found.rows, found.shake, states, bodies)
    content = record.content()
    verdict = {name: content.pop(name) for name in record.VERDICT if name in content}
    try:
        model = TypeAdapter(ShakeModel).validate_python(content.get("model", {}))
    except ValidationError as error:
        raise InputError(
            f"has a fault at 'model': {error.errors()[0]['msg']}",
            where=str(place / "smoothing.json"),
            todo=SmoothingFile.AGAIN,
        ) from error
    return Smoothing(verdict, content, model, tables, name=place.resolve().name)


_LEAST_LEFT = 0.1
"""The pixels' noise alone leaves about a sixth of an acceleration's variance."""
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
    *,
    rts: bool = True,
    calibration: Calibration | None = None,
) -> pd.DataFrame:
    """Return the table of the bubbles' positions (mm), velocities (mm/s) and accelerations (mm/s^2)
    in the laboratory frame.

    The table has one row for every frame from a bubble's first to its last detection. The standard
    deviations include the uncertainty of the encoder's scale and of the travel axis; their columns
    are missing if the solution has no covariances.

    tracks : table with the columns of tracks.csv, from which the triangulated positions, the result
        of a plain RTS smoother and the diameters are added; None to leave these columns out.
    inflation : (3,) factor of the standard deviations along each axis where measurements disagree.
    rts : whether the result of a plain RTS smoother is computed; otherwise it is NaN.
    calibration : its share of the errors is stated in columns of its own; None to leave them out.
    """
    import pandas as pd

    graph, problem = solution.graph, solution.graph.problem
    if not problem.bubbles:
        none = np.zeros(0, np.int64)
        return pd.DataFrame({"frame": none, "particle": none, "t_s": np.zeros(0)})
    layout, covariances = graph.bubble, solution.covariances
    states = solution.state.bubbles
    columns: dict[str, Any] = {
        "frame": graph.frame_of_row,
        "particle": np.array([b.particle for b in problem.bubbles])[graph.bubble_of_row],
        "t_s": problem.t_s[graph.frame_of_row],
    }
    columns |= _named(states @ layout.position.T, "{}_mm")
    columns |= _named(solution.velocities_mm_s, "v{}_mm_s")
    if covariances is not None:
        place, speed = considered_variance(solution)
        sigma = _sigma(layout.position, covariances.bubbles)
        columns |= _named(np.sqrt(sigma**2 + place) * inflation, "s{}_mm")
        columns |= _named(np.sqrt(solution.velocity_variances() + speed) * inflation, "sv{}_mm_s")
    columns["observed"] = _observed(solution)
    if tracks is not None:
        columns |= _baselines(solution, tracks, rts=rts)
    found = solution.accelerations
    if found is not None:
        columns |= _named(found.value_mm_s2, "a{}_mm_s2")
        columns |= _named(found.sd_mm_s2 * inflation, "sa{}_mm_s2")
    if calibration is not None:
        columns |= calibration.share_columns(points_in_rig(graph, solution.state))
    return pd.DataFrame(columns)


def _named(values: Array, pattern: str) -> dict[str, Array]:
    return {pattern.format(axis): values[:, i] for i, axis in enumerate(AXES)}


def _sigma(rows: Array, covariance: Array) -> Array:
    """Return the roots of `variances`."""
    return np.asarray(np.sqrt(variances(rows, covariance).clip(0)))


def _observed(solution: Solution) -> Ints:
    """Return for each row 1 if a camera saw the bubble and the pixel was no outlier, else 0."""
    graph, obs = solution.graph, solution.graph.problem.observations
    out = np.zeros(graph.rows, np.int64)
    kept = solution.weights[0] > 0.5
    out[graph.row(obs.item[kept], obs.frame[kept])] = 1
    return out


def _baselines(solution: Solution, tracks: pd.DataFrame, *, rts: bool) -> dict[str, Array]:
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
    read_mm = np.where(problem.in_encoder_record, problem.encoder_mm, np.nan)
    naive[rows] += read_mm[seen, None] * problem.axis
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
        if rts and 1 < len(t) <= LONGEST_RTS and mine.stop <= MOST_RTS_ROWS:
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
    """Return a table with one row per frame: the carriage's position and the shake of each camera,
    its offset from where this position puts it, in mm along the axes of the rig frame.

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
