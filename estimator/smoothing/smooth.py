"""`telerig.smooth`: the motion of the bubbles, separated from the shake of the rig."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from telerig.errors import LOAD, CalibrationError, InputError, need_kind
from telerig.estimator.calibration.result.calibration import of_run
from telerig.estimator.sensors.checks import Mounting, check_tracks, files_of, read_sensors
from telerig.estimator.sensors.findings import Finding, accepted_codes, settled
from telerig.estimator.sensors.given import AccelerometerRecord, times
from telerig.estimator.smoothing.graph.solve import Options, Progress, Solution, drawn, solve
from telerig.estimator.smoothing.graph.stage_travel import carriage, scale_warnings, travel_of
from telerig.estimator.smoothing.learning.cross_validation import learning_record
from telerig.estimator.smoothing.learning.default_priors import (
    adapted,
    default_model,
    encoder_noise_mm,
    guessed_modes,
)
from telerig.estimator.smoothing.learning.learn import learn
from telerig.estimator.smoothing.learning.likelihood import (
    with_hyperparameter_uncertainty,
)
from telerig.estimator.smoothing.learning.low_pass import LEARNED_ROWS, learned_inertia
from telerig.estimator.smoothing.learning.window import MOST_FRAMES, first_of_most_seen
from telerig.estimator.smoothing.phases import Phases
from telerig.estimator.smoothing.pieces import (
    Constants,
    Piece,
    Told,
    first_round,
    piece_with_most,
    pieces_of,
    solved_pieces,
    with_clock_numbers,
)
from telerig.estimator.smoothing.problem.calibration_share import calibration_share
from telerig.estimator.smoothing.problem.marks import references_of
from telerig.estimator.smoothing.problem.problem import (
    ARMS,
    Bubble,
    Observations,
    ShakeModel,
    SmoothingProblem,
    check_increasing,
)
from telerig.estimator.smoothing.problem.sensor_records import (
    accelerometers_of,
    near_frames,
    stage_of,
    thinned,
)
from telerig.estimator.smoothing.problem.tracks import (
    Tracked,
    bubbles_of,
    frames_between,
    parts_of,
    read_tracks,
)
from telerig.estimator.smoothing.problem.window import Window, all_of, cut_out
from telerig.estimator.smoothing.refined_pose import (
    Refinement,
    change_words,
    for_learning,
    refined_change,
    refinement_of,
    with_wander,
)
from telerig.estimator.smoothing.result import (
    Smoothing,
    sensors_of,
    states_of,
    summary_of,
    trajectories,
)
from telerig.estimator.smoothing.result import shake as shake_table
from telerig.estimator.smoothing.results_file import StoredTables, Tables, results_file
from telerig.estimator.smoothing.sensor_alignment.aligned import aligned
from telerig.estimator.smoothing.unfinished import Notes, UnfinishedPieces
from telerig.estimator.smoothing.verdict.evidence import Evidence, Span, evidence_of
from telerig.factors.bubble_motion import INERTIA_S, Inertia
from telerig.io.machine.room import check_room
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.progress import Progress as Steps
from telerig.progress import showing_progress
from telerig.short_text import counted

if TYPE_CHECKING:
    import pandas as pd

    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.rig_drift.movement import DriftPrior, Movement
    from telerig.io.dataset.run import RunData
    from telerig.io.rig_file.description import RigDescription

Learn = Callable[[SmoothingProblem], ShakeModel]

_COARSE_STEP_S = 2e-3
_ROW_BYTES = 4000
"""On the disk for a bubble in a frame of a run in pieces. Pieces, results.h5 and tables have 5,500
of two cameras."""
_MOST_ALIGNED, _MOST_PIXELS = 20_000, 500_000
_MOST_COMPARED, _BUBBLES_COMPARED = 1500, 3
_LEAST_LEARNED_S = 0.2
"""Shortest time of a bubble for which shake is learned. In less time a slow shake shows no period,
and learning would find no shake.
"""
_SIZED_FRAMES, _SIZING_PASSES, _BAND_PASSES = 600, 3, 8
"""Frames in the middle of a run that set the RMS of guessed modes, and passes over them; the most
passes that set broad bands where no marks show them, each of which halves what is off."""


@showing_progress
def smooth(
    tracks: Any,
    calibration: Calibration,
    *,
    stage: RunData | pd.DataFrame | Mapping[str, ArrayLike] | None = None,
    accelerometers: pd.DataFrame | Mapping[str, AccelerometerRecord] | None = None,
    references: pd.DataFrame | None = None,
    model: ShakeModel | Learn | str = "auto",
    rig: RigDescription | None = None,
    t_s: ArrayLike | None = None,
    options: Options | None = None,
    progress: Steps | bool = False,
    refine_rig: bool | DriftPrior = False,
    accept: Iterable[str] = (),
    folder: Path | None = None,
    unfinished: UnfinishedPieces | None = None,
) -> Smoothing:
    """Smooth a run: estimate every bubble's motion in the laboratory frame and every camera's
    shake.

    The laboratory frame has the axes of the rig frame (x right, y down, z away from the first
    camera), lengths are mm, times s. F is the number of frames.

    tracks : `Tracks`, or a table with the columns of tracks.csv: frame, particle, t_s, x_mm, y_mm,
        z_mm, and for each camera the pixel <camera>_u_px, <camera>_v_px and its covariance
        <camera>_suu_px2, <camera>_suv_px2, <camera>_svv_px2. None to estimate only the shake.
    calibration : calibration of the cameras.
    stage : the encoder: a table or a mapping with t_s (E,) and position_mm (E,), which increases
        where the stage moves along its axis; or the `RunData` of the run (`telerig.load_run`),
        whose other records are then used as well where nothing else is given, and of whose frames
        only those that were tracked (``telerig track --frames``); None without an encoder.
    accelerometers : a mapping of the sensor's name to a mapping (`AccelerometerRecord`) with
        "t_s" (N,), which increases; the readings (N, 3) along the sensor's x, y, z, either "a_m_s2"
        or "a" with "unit" ("m/s^2", "g", "mg", "mm/s^2", "cm/s^2" or "ft/s^2"); "mounted_on", the
        camera whose arm carries it, or "carriage"; "axes" (3, 3), whose rows are the sensor's x, y,
        z in rig coordinates; and if known "noise_density_ug_sqrt_hz", "bias_sigma_m_s2" (0.2 if
        missing) and "range_m_s2". "clock" is "frames" if t_s is the time of the frames, or
        "unknown" (the default) if its offset is to be found from the images; a sensor whose offset
        they do not show is left out, with a warning. Keys that are missing are taken from ``rig``.
        Readings contain gravity: at rest, +9.81 m/s^2 along the axis that points up. Or a table
        with the columns t_s, sensor, ax_m_s2, ay_m_s2, az_m_s2 (or ax_g, ...), on the clock of the
        frames, whose sensors ``rig`` describes. None for none.
    references : a table of marks fixed to the tank with the columns frame, camera, mark, u_px, v_px
        and possibly sigma_px (0.1 px if missing); None to take those of ``tracks``, if it has any.
    model : "auto" (default hyper-parameters for the available measurements; modes are learned if
        only images are available), "default", a `ShakeModel`, or a function that returns one for a
        `SmoothingProblem`.
    rig : the description in rig.toml. It gives the travel axis if the calibration has none, how
        well the encoder's scale is known, which way is up, and the sensors. None if there is no
        description; then up is upwards in the first camera's image.
    t_s : (F,) times of the frames, which increase; None to take those of the tracks or of the run.
    options : settings of the solver; None for the defaults.
    progress : True to show a progress bar; or a function that is called with the name of the step,
        the share that is done (0 to 1), and 1.
    refine_rig : whether to estimate also how a camera has moved against the others since the
        calibration (``summary["rig_change"]``); a `DriftPrior` states how far it may have moved.
    accept : codes of faults, like ["SENSOR_AXES"], that are used as they are, where they would be
        refused (the error names its code): SENSOR_UNIT, SENSOR_GRAVITY, SENSOR_AXES, SENSOR_MOUNT,
        SENSOR_SCALE, SENSOR_CLOCK, ENCODER_SIGN, ENCODER_UNIT, ENCODER_STUCK, ENCODER_SCALE,
        ENCODER_JUMP, ENCODER_CLOCK, STAGE_AXIS, CAMERA_SCALE, FRAME_TIMES, RISE_SPEED.
    folder : an existing folder for results.h5 of a run that is too long for memory; None for a
        temporary one, which lasts as long as what is returned.
    unfinished : where the finished pieces of such a run are kept, so that an interrupted call goes
        on. Its key has to differ for other arguments. None for a temporary folder.

    A run of more than 12,000 frames, or of more than 60,000 of all bubbles together, is smoothed
    in pieces; its tables are read from results.h5 when they are asked for.

    Returns a `Smoothing`: the table ``trajectories`` (t_s, x_mm, vx_mm_s, their standard deviations
    sx_mm, svx_mm_s and so on, by frame and particle), the table ``shake`` of the cameras, the
    ``verdict``, whose "verdict" is RESOLVED, PARTIAL, UNRESOLVED or CONTRADICTED, and ``summary``,
    whose "warnings" say what the checks found, what was assumed and which samples are not used, and
    whose "accelerometers" hold the estimates for each sensor.

    Raises InputError for arguments that are not as described, and its subclass `SensorError`, with
    ``code`` and ``findings``, for a sensor that contradicts gravity, the images or another sensor.
    """
    accepted, phases = accepted_codes(accept), Phases(progress)
    _check_kinds(tracks, calibration, rig)
    folder = None if folder is None else Path(folder)
    with phases.phase("checks", "checking tracks and sensors"):
        table = getattr(tracks, "table", tracks)
        calibration = of_run(calibration, _cameras_of(table, calibration, stage, rig))
        refinement = None
        if refine_rig:
            tables = (part for part, _ in parts_of(tracks) if part is not None)
            refinement = refinement_of(tables, calibration, refine_rig)
        problem, tracked, encoder_sigma, findings = problem_of(
            tracks, calibration, stage=stage, accelerometers=accelerometers,
            references=references, rig=rig, t_s=t_s,
            drift=None if refinement is None else refinement.movement,
        )  # fmt: skip
        if isinstance(model, ShakeModel):
            problem = _with_held_scale(problem, model)
        problem, findings = with_sensors_aligned(problem, findings)
        warnings = settled(findings, accepted)
    options = replace(options or Options(), draws=True)
    with phases.phase("learning", "learning the shake") as step:
        chosen = _chosen(problem, model, encoder_sigma, refinement, step)
        learned: dict[str, Any] = {}
        if chosen.learned and len(problem.t_s) > MOST_FRAMES:
            learned, more = learning_record(problem, chosen)
            warnings = [*warnings, *more]
    given, pieces = isinstance(model, ShakeModel), pieces_of(problem, chosen, options.frames)
    problem = with_clock_numbers(problem)
    run = _Run(problem, calibration, tracks, tracked, chosen, given, options, phases)
    if len(pieces) == 1:
        done = run.smoothed()
    else:
        keep = None if folder else TemporaryDirectory(prefix="telerig-")
        place = folder or Path(keep.name if keep else "")
        rows = sum(map(len, problem.bubbles))
        check_room(
            "smooth", "smooth fewer frames (telerig track --frames)", disk=_ROW_BYTES * rows,
            folder=place,
        )  # fmt: skip
        with ExitStack() as stack:
            if unfinished is None:
                own = stack.enter_context(TemporaryDirectory(prefix=".pieces-", dir=place))
                unfinished = UnfinishedPieces(Path(own), "")
            done = run.in_pieces(pieces, StoredTables(place, keep), unfinished)
    from telerig.estimator.smoothing.verdict.contradiction import sample_warnings, speed_warnings

    verdict, evidence, solution = done.verdict, done.evidence, done.solution
    frames = None if len(pieces) == 1 else len(problem.t_s)
    summary = summary_of(solution, evidence, frames, done.sensors)
    summary["accepted"] = sorted(accepted)
    summary["warnings"] = [
        *warnings, *sample_warnings(evidence), *speed_warnings(problem, evidence.mean_velocities),
        *scale_warnings(solution),
        *([] if calibration.covariance_known else [NO_COVARIANCE]),
    ]  # fmt: skip
    change = refined_change(solution, calibration)
    if change is not None:
        words = change_words(change)
        summary["rig_change"] = {**change.as_dict(), "words": words}
    described = rig or getattr(stage, "rig", None)
    summary["bodies"] = _shapes_of(tracks)
    if done.swarm is not None and not getattr(described, "bubbles", None):  # else a part counts
        summary["swarm"] = done.swarm
    fluid = getattr(described, "fluid", None)
    summary["fluid"] = {} if fluid is None else asdict(fluid)
    summary["learning"], summary["seconds"] = learned, phases.seconds
    whole = solution if len(pieces) == 1 else None
    name = getattr(tracks, "name", "")
    return Smoothing(verdict, summary, solution.graph.model, done.tables, whole, name)


class _Done(NamedTuple):
    """verdict, evidence : of the run.  All others: of it, or of the piece in its middle.

    swarm : what `swarm_numbers` returns.
    sensors : estimates of every sensor by its name, from all pieces.
    """

    verdict: dict[str, Any]
    evidence: Evidence
    solution: Solution
    tables: Tables | StoredTables
    swarm: dict[str, Any] | None
    sensors: dict[str, Any]


@dataclass(frozen=True)
class _Run:
    """A run whose hyper-parameters are chosen.

    given : whether they are as they are, and not set again from a first solution.
    """

    problem: SmoothingProblem
    calibration: Calibration
    tracks: Any
    tracked: Tracked | None
    model: ShakeModel
    given: bool
    options: Options
    phases: Phases

    def smoothed(self) -> _Done:
        """Smooth it as a whole."""
        problem = self.problem
        with self.phases.phase("smoothing", _smoothing_words(problem)) as step:
            solution = _adapted_solution(problem, self.model, self.options, step, given=self.given)
            if solution.graph.model.learned:
                step("uncertainty of what was learned", 0.9)
                solution = with_hyperparameter_uncertainty(solution)
        with self.phases.phase("verdict", "judging the result"):
            from telerig.estimator.smoothing.verdict.judge import judge

            evidence = Evidence.of(solution, drawn(solution))
            verdict = judge(problem, solution.graph.model, solution, evidence)
            solution = replace(solution, draws=None)
        with self.phases.phase("tables", "making the tables"):
            inflation = verdict.get("inflation", (1.0, 1.0, 1.0))
            table = None if self.tracked is None else self.tracked.between(0, len(problem.t_s))
            paths = trajectories(solution, table, inflation, calibration=self.calibration)
            offsets = shake_table(solution, inflation)
            tracks = self.tracks
            if hasattr(tracks, "between"):
                tracks = tracks.between(0, len(problem.t_s))
            bodies = self._bodies(tracks)
            swarm = self._swarm(solution, paths, bodies, Span.whole(solution))
        tables = Tables(paths, offsets, states_of(solution), bodies)
        return _Done(verdict, evidence, solution, tables, swarm, {})

    def _bodies(self, tracks: Any) -> pd.DataFrame | None:
        """Return the bubbles' bodies; None without tracks."""
        if self.tracked is None:
            return None
        from telerig.estimator.physics.bodies import bodies_table

        return bodies_table(tracks)

    def _swarm(
        self, solution: Solution, paths: pd.DataFrame, bodies: pd.DataFrame | None, span: Span
    ) -> dict[str, Any] | None:
        """Return numbers of the swarm in some frames."""
        if bodies is None:
            return None
        from telerig.estimator.physics.means import Lasting
        from telerig.estimator.physics.swarm import swarm_numbers

        first, problem = span.first + span.own.start, self.problem
        return swarm_numbers(
            paths.assign(frame=paths["frame"] - first),
            bodies.assign(frame=bodies["frame"] - first),
            carriage(solution)[0][span.own.start : span.own.stop], problem.axis, problem.up,
            problem.cameras, Lasting.of(_shapes_of(self.tracks)),
        )  # fmt: skip

    def in_pieces(
        self, pieces: Sequence[Piece], tables: StoredTables, kept: UnfinishedPieces
    ) -> _Done:
        """Smooth it piece by piece, each of which is written as it comes.

        Hyper-parameters that are not given are set by the piece in the middle, which is solved
        last: the verdict takes from its solution what does not add up over pieces. If far more is
        seen in another piece, it takes the place of that in the middle.

        kept : other pieces that an interrupted call has finished are not solved again.
        """
        from telerig.estimator.smoothing.verdict.judge import judge

        problem, model = self.problem, self.model
        kept.begin()
        with self.phases.phase("smoothing", _smoothing_words(problem)) as step:
            middle = piece_with_most(problem, pieces)
            step("a piece in the middle", 0.0)
            model = _adapted_solution(
                pieces[middle].cut(problem).problem, self.model, self.options, _silent,
                given=self.given,
            ).graph.model  # fmt: skip
            own = [piece.without_margin() for piece in pieces]
            for piece, told in first_round(
                problem, model, own, self.options,
                lambda what, share: step(f"what is constant along the run, {what}", share),
                kept.missing(Told, own),
            ):  # fmt: skip
                kept.keep(piece, told)
            constants = Constants.of(
                problem, model, pieces, (kept.notes(Told, piece) for piece in own)
            )
            swarm, rest = None, [n for n in kept.missing(Notes, pieces) if n != middle]
            for piece, window, solution in solved_pieces(
                problem, model, pieces, self.options, step, constants, [*rest, middle]
            ):
                solution = with_hyperparameter_uncertainty(solution)
                span = Span(piece.own, piece.low, problem.t_s)
                evidence = Evidence.of(solution, drawn(solution), span)
                paths, offsets = self._tables(piece, window, solution, span)
                bodies = self._bodies(frames_between(self.tracks, piece.first, piece.end))
                last = piece == pieces[middle]
                if last:
                    swarm = self._swarm(solution, paths, bodies, span)
                kept.keep(
                    piece, Notes(evidence, sensors_of(solution)),
                    Tables(paths, offsets, states_of(solution, span), _beside(paths, bodies)),
                )  # fmt: skip
                del paths, offsets, bodies
                if not last:
                    del window, solution
        with self.phases.phase("verdict", "judging the result"):
            notes = [kept.notes(Notes, piece) for piece in pieces]
            evidence = evidence_of([one.evidence for one in notes])
            verdict = judge(window.problem, model, solution, evidence)
        with self.phases.phase("tables", "writing the tables"):
            inflation = verdict.get("inflation", (1.0, 1.0, 1.0))
            with results_file(tables.folder) as file:
                kept.append_to(file, pieces, inflation)
                file.finish(inflation)
        sensors = {name: found for one in notes for name, found in one.sensors.items()}
        solution = replace(solution, draws=None)
        return _Done(verdict, evidence, solution, tables, swarm, sensors)

    def _tables(
        self, piece: Piece, window: Window, solution: Solution, span: Span
    ) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return rows of the trajectories and of the shake in a piece's own frames."""
        table = None
        if self.tracked is not None:
            table = self.tracked.between(piece.low, piece.high)
            there = {bubble.particle for bubble in window.problem.bubbles}
            table = table[table["particle"].isin(there)]
            table = table.assign(frame=table["frame"] - piece.low)
        rows = trajectories(solution, table, rts=piece.first == 0, calibration=self.calibration)
        every = rows, shake_table(solution)
        own = (part[span.holds(part["frame"].to_numpy())] for part in every)
        paths, offsets = (part.assign(frame=part["frame"] + piece.low) for part in own)
        return paths, offsets


def _beside(paths: pd.DataFrame, bodies: pd.DataFrame | None) -> pd.DataFrame | None:
    """Return the bodies in the rows of the trajectories, NaN where there are none."""
    if bodies is None:
        return None
    keys = ["frame", "particle"]
    return paths[keys].merge(bodies, "left", on=keys).drop(columns=keys)


def _shapes_of(tracks: Any) -> dict[str, float]:
    """Return what tracking told of the shapes of the run's bubbles."""
    return dict(getattr(tracks, "summary", {}).get("shapes", {}))


def _silent(_what: str, _share: float) -> None:
    """Report nothing."""


def with_sensors_aligned(
    problem: SmoothingProblem, findings: list[Finding]
) -> tuple[SmoothingProblem, list[Finding]]:
    """Return the problem with its sensors on the clock of the frames, and what was found.

    A long run without accelerometers has nothing to be moved; the encoder is compared with the
    images in the middle of it.
    """
    count = len(problem.t_s)
    if problem.accelerometers or count <= _MOST_ALIGNED:
        return aligned(problem, findings, _log_evidence)
    first = (count - _MOST_ALIGNED) // 2
    part = all_of(problem, first, first + _MOST_ALIGNED).problem
    placed, findings = aligned(part, findings, _log_evidence)
    if placed.stage is None or problem.stage is None:
        return problem, findings
    late = placed.stage.delay_sigma_s
    return replace(problem, stage=replace(problem.stage, delay_sigma_s=late)), findings


def _with_held_scale(problem: SmoothingProblem, model: ShakeModel) -> SmoothingProblem:
    """Return the problem with an encoder's scale that is stated if a given model holds it."""
    travel = problem.travel
    if travel is None or travel.source != "assumed" or model.encoder_scale_sigma > 0:
        return problem
    return replace(problem, travel=replace(travel, source="given"))


def _log_evidence(problem: SmoothingProblem) -> float:
    """Return the log marginal likelihood of the middle of a run by the default hyper-parameters.

    It is -inf if there is no solution: sensors that are wrong may not let one converge.
    """
    first = max((len(problem.t_s) - _MOST_COMPARED) // 2, 0)
    part = cut_out(problem, first, first + _MOST_COMPARED, most_bubbles=_BUBBLES_COMPARED).problem
    near = (near_frames(s, part.t_s) for s in part.accelerometers)
    sensors = tuple(s for s in near if len(s.t_s) > 1)
    part = replace(part, accelerometers=thinned(sensors, _COARSE_STEP_S))
    options = Options(covariances=False, robust=False)
    try:
        return solve(part, default_model(part), options).log_evidence
    except CalibrationError:
        return -np.inf


def _smoothing_words(problem: SmoothingProblem) -> str:
    bubbles = counted(len(problem.bubbles), "bubble")
    return f"smoothing {bubbles} in {counted(len(problem.t_s), 'frame')}"


def _check_kinds(tracks: Any, calibration: Any, rig: Any) -> None:
    """Raise InputError for a path, or anything else, in place of what would be read from it."""
    need_kind(calibration, "cameras", "telerig.smooth", LOAD)
    if tracks is not None and not hasattr(getattr(tracks, "table", tracks), "columns"):
        raise InputError(
            f"tracks is {type(tracks).__name__}",
            where="smooth",
            todo="give Tracks (telerig.load_tracks(folder)), a table like tracks.csv, or None",
        )
    if rig is not None and not (hasattr(rig, "stage") and hasattr(rig, "accelerometers")):
        raise InputError(
            f"rig is {type(rig).__name__}",
            where="smooth",
            todo="give the description: telerig.load_dataset(path).rig",
        )


def _cameras_of(table: Any, calibration: Calibration, stage: Any, rig: Any) -> list[str]:
    """Return the cameras with pixels in a table of tracks, or those of the run."""
    known = [camera.name for camera in calibration.cameras]
    if table is not None:
        return [name for name in known if f"{name}_u_px" in table.columns]
    of_rig = getattr(rig or getattr(stage, "rig", None), "tracking_cameras", known)
    return list(getattr(stage, "cameras", of_rig))


def _chosen(
    problem: SmoothingProblem,
    model: ShakeModel | Learn | str,
    encoder_sigma_mm: float,
    refinement: Refinement | None,
    progress: Progress,
) -> ShakeModel:
    if refinement is None or isinstance(model, ShakeModel):
        return choose_model(problem, model, encoder_sigma_mm, progress)
    held = for_learning(problem, refinement)
    chosen = choose_model(held, model, encoder_sigma_mm, progress)
    return with_wander(chosen, refinement)


def problem_of(
    tracks: Any,
    calibration: Calibration,
    *,
    stage: Any = None,
    accelerometers: Any = None,
    references: Any = None,
    rig: Any = None,
    t_s: ArrayLike | None = None,
    drift: Movement | None = None,
) -> tuple[SmoothingProblem, Tracked | None, float, list[Finding]]:
    """Return the smoothing problem of these tables, the tracks that were read, the standard
    deviation of the encoder in mm, and what the checks found.

    The accelerometers' records are whole; `near_frames` cuts them.

    The arguments are those of `smooth`. The tracks are None if none were given.

    drift : a movement of a camera since the calibration; None if none has moved.
    """
    files = ("stage", "")
    if hasattr(stage, "frame_count"):
        run = stage
        of_stage, of_sensors = files_of(run)
        files = of_stage, of_sensors if accelerometers is None else ""
        if t_s is not None and not np.array_equal(np.asarray(t_s), run.t_s):
            raise InputError(
                "t_s differs from the times of the run",
                where="smooth",
                todo="give the run without t_s, or give its tables (stage=run.stage, ...) "
                "together with t_s",
            )
        of_tracks = getattr(tracks, "summary", None) or {}
        run = run.first(of_tracks.get("frames") or run.frame_count)  # track --frames
        stage, rig, t_s = run.stage, run.rig if rig is None else rig, run.t_s
        accelerometers = run.accelerometers if accelerometers is None else accelerometers
        references = run.references if references is None else references
    if references is None:
        references = getattr(tracks, "references", None)
    cameras = calibration.cameras
    frame_times = None if t_s is None else times(t_s, "frames")
    tracked = None if tracks is None else read_tracks(tracks, cameras, frame_times)
    at_frames = frame_times if tracked is None else tracked.t_s
    if at_frames is None:
        raise InputError(
            "there are no tracks, so the times of the frames are unknown",
            where="smooth",
            todo="give t_s, the times of the frames",
        )
    check_increasing(at_frames, "frames")
    described = None if rig is None else rig.stage
    encoder_sigma = ShakeModel.encoder_sigma_mm
    if described is not None:
        encoder_sigma = float(described.position_sigma_mm)
    travel = travel_of(calibration.stage, described)
    axis, mounting = travel.axis, Mounting.of(described, travel.axis)
    sensors = read_sensors(
        stage, accelerometers, rig, [c.name for c in cameras], at_frames, mounting, files=files
    )
    findings = list(sensors.findings)
    if tracked is not None:
        findings += check_tracks(tracked.sample, calibration)
    record = stage_of(sensors.encoder, at_frames, described)
    if record is not None and travel.scale:
        record = replace(record, position_mm=record.position_mm / (1 + travel.scale))
    positions = np.zeros(len(at_frames))
    if record is not None:
        stated, encoder_sigma = encoder_sigma, encoder_noise_mm(record, encoder_sigma)
        if encoder_sigma > stated:
            words = (
                f"the readings scatter by {encoder_sigma:.2g} mm about a smooth motion, and "
                f"position_sigma_mm is {stated:.2g}: counts are coarse, or times not exact"
            )
            todo = f"state position_sigma_mm = {encoder_sigma:.2g}, which is used, in rig.toml"
            findings.append(Finding(words, files[0], todo))
        positions = np.interp(at_frames, record.t_s, record.position_mm)
    marks, seen, found = references_of(references, cameras, at_frames, positions, axis)
    findings += found
    bubbles: tuple[Bubble, ...] = ()
    share = None
    if tracked is not None:
        bubbles, tracked = bubbles_of(tracked, positions, axis), replace(tracked, places=[])
        points = tracked.sample[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        some = points[np.linspace(0, len(points) - 1, min(len(points), 200)).astype(int)]
        step = len(tracked.observations) // _MOST_PIXELS + 1
        noise = np.median(np.sqrt(tracked.observations.covariance_px2[::step, 0, 0]))
        share = calibration_share(calibration, some, float(noise), drift)
    problem = SmoothingProblem(
        cameras, at_frames, axis, mounting.up, bubbles,
        Observations.none() if tracked is None else tracked.observations,
        record, accelerometers_of(sensors.accelerometers, cameras), marks, seen, share,
        travel, mounting.gravity_m_s2,
    )  # fmt: skip
    return problem, tracked, encoder_sigma, findings


def choose_model(
    problem: SmoothingProblem,
    model: ShakeModel | Learn | str,
    encoder_sigma_mm: float,
    progress: Progress | None = None,
) -> ShakeModel:
    """Return the hyper-parameters: the given, the default or the learned ones.

    model : as for `smooth`.  encoder_sigma_mm : standard deviation of one encoder reading.

    Raises InputError for an unknown word.
    """
    made = model(problem) if callable(model) else model
    if isinstance(made, ShakeModel):
        if problem.accelerometers and problem.stage and made.carriage.kind == "readings":
            raise InputError(
                "the model's carriage has no acceleration, which accelerometers measure",
                where="smooth",
                todo='give the ShakeModel carriage=CarriageModel("force"), or leave out the '
                "accelerometers",
            )
        return made
    if callable(model):
        raise InputError(
            f"the function given as model returns {type(made).__name__}",
            where="smooth",
            todo="return a ShakeModel",
        )
    if not isinstance(model, str) or model not in ("auto", "default"):
        raise InputError(
            f"model is {model!r}", where="smooth", todo='give "auto", "default" or a ShakeModel'
        )
    default = default_model(problem, encoder_sigma_mm)
    if model == "auto" and not problem.measures_shake and _longest_s(problem) >= _LEAST_LEARNED_S:
        return learn(problem, default, progress=progress)
    return default


def _longest_s(problem: SmoothingProblem) -> float:
    """Return the longest time from a bubble's first to its last frame; 0 without bubbles."""
    t = problem.t_s
    return max((float(t[b.last] - t[b.first]) for b in problem.bubbles), default=0.0)


def _adapted_solution(
    problem: SmoothingProblem,
    model: ShakeModel,
    options: Options,
    progress: Progress | None,
    *,
    given: bool,
) -> Solution:
    """Return the solution whose hyper-parameters have been set from a first solution.

    These are noise, RMS and delays, unless the model is given, and the low-pass of the bubbles'
    forces. With broad bands the first solutions use few samples of the sensors. If an arm has no
    sensor, they hold the delays, which priors that do not fit yet can put wrong by a period of the
    shake. The RMS of guessed modes is set by frames in which much is seen, in the middle if
    possible, and so is the low-pass where nothing else is.
    """
    guessed, part, last = guessed_modes(model) and not given, problem, None
    learned = model.bubble.inertia is None and options.covariances
    if learned:
        expected = Inertia((INERTIA_S.median,) * 3)
        model = replace(model, bubble=replace(model.bubble, inertia=expected))
    in_sight = sum(map(len, problem.bubbles)) / len(problem.t_s)
    frames = max(_SIZED_FRAMES, int(LEARNED_ROWS / max(in_sight, 1e-9)))
    if model.broad_bands and not given:
        if problem.accelerometers:
            few = thinned(problem.accelerometers, _COARSE_STEP_S)
            part = replace(problem, accelerometers=few)
    elif frames < len(problem.t_s):
        begin = first_of_most_seen(problem, frames)
        part = all_of(problem, begin, begin + frames).problem
    first, unfelt = model, not given and any(b.camera == ARMS for b in model.broad_bands)
    if unfelt:
        model = replace(model, accelerometer_delay_sigma_s=0.0)
    passes = _SIZING_PASSES if guessed else 1
    if model.broad_bands and not len(problem.references):
        passes = _BAND_PASSES
    for _ in range(passes):
        bare = None if last is None else replace(last, covariances=None, draws=None)
        last = solve(part, model, options, progress, start=bare)
        better = None if given else adapted(last, first)
        if better is None:
            break
        model = better
    assert last is not None
    model = replace(model, accelerometer_delay_sigma_s=first.accelerometer_delay_sigma_s)
    if learned:
        model = replace(model, bubble=replace(model.bubble, inertia=learned_inertia(last)))
    if model == last.graph.model and part is problem:
        return last
    bare = None
    if len(part.t_s) == len(problem.t_s):
        bare = replace(last, covariances=None, draws=None)
    return solve(problem, model, options, progress, start=bare)
