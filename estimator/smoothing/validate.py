"""A user's own proof: marks fixed to the tank are smoothed as if they were bubbles.

A mark stands still in the laboratory. `validate` withholds marks in turn and adds the motion of a
bubble, which is then known, to the pixels of each. The mark is smoothed as the only bubble of the
run. Its smoothed path less the known motion must stand still; whatever it does is an error of the
calibration, of a clock, of a sensor, or of the smoother, and is compared with the stated standard
deviations.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.random import Generator

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import of_run
from telerig.estimator.smoothing.graph.solve import Options, Solution
from telerig.estimator.smoothing.graph.stage_travel import considered_variance
from telerig.estimator.smoothing.results_folder import run_sources, with_followed_references
from telerig.estimator.smoothing.smooth import smooth
from telerig.estimator.smoothing.verdict.contradiction import speed_warnings
from telerig.estimator.tracking.tracks import Tracks
from telerig.io.results.inputs import fingerprints
from telerig.io.results.manifest import replaced_results
from telerig.io.results.smoothing import Verdict
from telerig.io.results.validation import (
    Rest,
    Stillness,
    ValidationFile,
    WithheldMark,
    overall,
)

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.smoothing.result import Smoothing
    from telerig.io.dataset.run import RunData
    from telerig.rig.camera import Camera

_UP = np.array([0.0, -1.0, 0.0])
FEWEST_FRAMES = 30
"""Fewest frames of a mark that is withheld: a path of fewer says little."""
MARKS = 6
"""How many marks are withheld unless the user says otherwise."""
_SIGMA_PX = 0.1
_UNSEEN_PX = 1e4
"""Standard deviation of the pixel of a camera that does not see the mark."""
_MOST_STORED = 300
_VELOCITY_MM_S, _VELOCITY_TAU_S = 10.0, 0.3
_ZIGZAG_HZ, _ZIGZAG_MM, _VERTICAL_MM = (5.0, 8.0), (1.0, 3.0), 0.2
"""The motion that a mark is given: an Ornstein-Uhlenbeck velocity, a zigzag across the rise, and
its second harmonic along it."""
_PIXEL = ("u_px", "v_px")


@dataclass(frozen=True)
class Seen:
    """The pixels (N, 2) of one mark in one camera or more, with frames, cameras and sd (N,)."""

    mark: str
    cameras: tuple[int, ...]
    frame: Ints
    camera: Ints
    uv_px: Array
    sigma_px: Array

    @property
    def frames(self) -> int:
        """Number of frames from the first to the last."""
        return int(self.frame.max() - self.frame.min() + 1)


@dataclass(frozen=True)
class Motion:
    """Hold the known motion of a mark: position_mm and velocity_mm_s (F, 3) in each frame."""

    position_mm: Array
    velocity_mm_s: Array


def validate(
    run: RunData,
    calibration: Calibration,
    *,
    marks: int = MARKS,
    model: str = "auto",
    accept: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> ValidationFile:
    """Withhold marks of a run in turn, and smooth each as a bubble whose own motion is known.

    Each mark is smoothed beside the other marks and all sensors, and, if the run has
    accelerometers, also beside the sensors only. A mark that several cameras see is a bubble that
    these see; of any other mark only the two axes of its image count.

    marks : how many are withheld, those that are seen longest, of each camera in turn. model,
    accept : see `telerig.smooth`.
    seed : of the motions.
    progress : called with the name of the step and the share that is done.

    Raises InputError if no mark is seen long enough, and what `telerig.smooth` raises.
    """
    calibration = of_run(calibration, run.cameras)
    every = seen_marks(run, calibration)
    chosen = longest(every, marks)
    rests = [Rest.MARKS] if len(every) > 1 else []
    if run.accelerometers is not None or not rests:
        rests.append(Rest.SENSORS)
    done: list[WithheldMark] = []
    warnings: list[str] = []
    described = None if run.rig is None else run.rig.stage
    up = _UP if described is None else np.asarray(described.up, float)
    for rest in rests:
        for i, mark in enumerate(chosen):
            motion = bubble_motion(run.t_s, up, np.random.default_rng([seed, i]))
            if progress is not None:
                progress(f"mark {mark.mark}", len(done) / (len(rests) * len(chosen)))
            bubble = moved(mark, motion, calibration.cameras)
            found = smooth(
                track_of(bubble, calibration, run.t_s), calibration,
                stage=_without(run, mark, rest), model=model, accept=accept,
                options=Options(frames=run.frame_count),
            )  # fmt: skip
            solved = _solution(found)
            of_rise = speed_warnings(solved.graph.problem, solved.state.means)  # marks do not rise
            warnings += [w for w in found.summary["warnings"] if w not in of_rise]
            done.append(judged(mark, rest, found, motion, calibration.cameras))
    entries = tuple(overall(done, rest) for rest in rests)
    failed = any(entry.verdict is Stillness.FAILED for entry in entries)
    content = {
        "kind": ValidationFile.KIND, "schema": ValidationFile.SCHEMA, "run": run.name,
        "verdict": Stillness.FAILED if failed else Stillness.PASSED,
        "overall": [entry.content() for entry in entries],
        "marks": [mark.content() for mark in done],
        "warnings": list(dict.fromkeys(warnings)),
    }  # fmt: skip
    return ValidationFile.of(content, Path("validation.json"))


def validate_run(
    run: RunData,
    calibration: Calibration,
    folder: Path,
    *,
    marks: int = MARKS,
    model: str = "auto",
    accept: Sequence[str] = (),
    seed: int = 0,
    inputs: Sequence[Path] = (),
    report: bool = True,
    stage: Callable[[str, float, int], None] | None = None,
    again: str = "",
) -> ValidationFile:
    """Validate a run and write validation.json and validation.html into its results folder.

    The marks are those of the run's references.csv, or else those that `telerig track` followed in
    its images and wrote into the folder. The other arguments are those of `validate`.

    inputs : the files of the calibration.
    report : whether the page is written.
    stage : function that is called with the name of the step, the share that is done, and 1.
    again : the command line that makes the files again; "" for `telerig validate` of the run.

    Returns what was written. Both files appear together. Raises InputError as `validate` does.
    """
    run, followed = with_followed_references(run, folder)
    fingerprint = fingerprints(folder, [*run_sources(run), *followed, *inputs])
    shares = None if stage is None else lambda what, share: stage(what, float(share), 1)
    again = again or f"telerig validate {shlex.quote(str(run.path))}"
    with replaced_results(folder, "validate", again=again, inputs=fingerprint) as staged:
        found = validate(
            run, calibration, marks=marks, model=model, accept=accept, seed=seed, progress=shares
        )
        found.write(staged / "validation.json")
        if report:
            from telerig.io.report.validation import write_validation_report

            write_validation_report(staged)
    return found


def seen_marks(run: RunData, calibration: Calibration) -> list[Seen]:
    """Return the marks of a run; InputError without marks.

    A mark counts as seen by several cameras if two or more see it in `FEWEST_FRAMES` frames;
    otherwise the camera that sees it most often counts.
    """
    table = run.references
    if table is None or not len(table):
        raise InputError(
            "the run has no marks, so there is nothing that is known to stand still",
            where=str(run.path),
            todo="record a run with marks or a target fixed to the tank, and give them in "
            "references.csv or as [references] in rig.toml",
        )
    index = {camera.name: i for i, camera in enumerate(calibration.cameras)}
    sigma = table["sigma_px"] if "sigma_px" in table else pd.Series(_SIGMA_PX, table.index)
    table = table.assign(
        number=table["camera"].map(index), sigma_px=sigma.fillna(_SIGMA_PX), mark=table["mark"]
    ).sort_values(["frame", "number"])
    out = []
    for name, rows in table.groupby(table["mark"].astype(str), sort=False):
        counts = np.bincount(rows["number"].to_numpy(np.int64))
        each = rows.groupby("frame")["number"].nunique()
        shared = each.index[each >= 2]
        if len(shared) >= FEWEST_FRAMES:
            rows = rows[rows["frame"].between(shared.min(), shared.max())]
            cameras = tuple(np.unique(rows["number"].to_numpy(np.int64)).tolist())
        else:
            cameras = (int(counts.argmax()),)
            rows = rows[rows["number"].isin(cameras)]
        out.append(
            Seen(
                str(name), cameras, rows["frame"].to_numpy(np.int64),
                rows["number"].to_numpy(np.int64), rows[list(_PIXEL)].to_numpy(float),
                rows["sigma_px"].to_numpy(float),
            )
        )  # fmt: skip
    return out


def longest(every: Sequence[Seen], count: int) -> list[Seen]:
    """Return the marks that are seen in most frames, of each set of cameras in turn.

    Raises InputError if none is seen in `FEWEST_FRAMES` frames.
    """
    ranked: dict[tuple[int, ...], int] = {}
    order: list[tuple[int, int, Seen]] = []
    for mark in sorted(every, key=lambda mark: -mark.frames):
        if len(mark.frame) >= FEWEST_FRAMES * min(len(mark.cameras), 2):
            ranked[mark.cameras] = ranked.get(mark.cameras, 0) + 1
            order.append((ranked[mark.cameras], len(order), mark))
    if not order:
        most = max(mark.frames for mark in every)
        raise InputError(
            f"no mark is seen in {FEWEST_FRAMES} frames or more, the most frequent one in {most}",
            where="references.csv",
            todo="let the stage travel more slowly, or follow the marks longer",
        )
    return [mark for _, _, mark in sorted(order, key=lambda entry: entry[:2])[:count]]


def bubble_motion(t_s: Array, up: Array, rng: Generator) -> Motion:
    """Return a motion as of a bubble, without its mean rise.

    t_s : (F,) times.  up : (3,) upwards in the rig frame.
    """
    step = np.diff(t_s, prepend=t_s[0])[:, None]
    kept = np.exp(-step / _VELOCITY_TAU_S)
    push = _VELOCITY_MM_S * np.sqrt(1 - kept**2) * rng.standard_normal((len(t_s), 3))
    velocity = np.empty((len(t_s), 3))
    now = _VELOCITY_MM_S * rng.standard_normal(3)
    for k in range(len(t_s)):
        now = kept[k] * now + push[k]
        velocity[k] = now
    position = np.cumsum(step * (velocity + np.vstack([velocity[:1], velocity[:-1]])) / 2, axis=0)
    across = np.linalg.svd(up[None] / np.linalg.norm(up))[2]
    along, first, second = across
    w = 2 * np.pi * rng.uniform(*_ZIGZAG_HZ)
    azimuth, phase = rng.uniform(0, 2 * np.pi, 2)
    sideways = rng.uniform(*_ZIGZAG_MM) * (np.cos(azimuth) * first + np.sin(azimuth) * second)
    for frequency, amplitude in ((w, sideways), (2 * w, _VERTICAL_MM * along)):
        turn = (frequency * t_s + phase)[:, None]
        position += np.sin(turn) * amplitude
        velocity += frequency * np.cos(turn) * amplitude
    return Motion(position, velocity)


def moved(mark: Seen, motion: Motion, cameras: Sequence[Camera]) -> Seen:
    """Return the pixels that the mark would have if it moved so in the laboratory."""
    uv = mark.uv_px.copy()
    for i in mark.cameras:
        mine = mark.camera == i
        points = _nearest(*cameras[i].unproject(uv[mine]))
        uv[mine] = cameras[i].project(points + motion.position_mm[mark.frame[mine]])
    return replace(mark, uv_px=uv)


def _nearest(origin: Array, direction: Array) -> Array:
    """Return the points (N, 3) of rays nearest to the origin of the rig frame."""
    return np.asarray(origin - (origin * direction).sum(-1, keepdims=True) * direction)


def track_of(mark: Seen, calibration: Calibration, t_s: Array) -> Tracks:
    """Return a mark's pixels as a track, which begins and ends with pixels of two cameras or more.

    Where only one camera sees the mark, the others' pixels are guesses with an sd of `_UNSEEN_PX`.
    """
    cameras, several = calibration.cameras, len(mark.cameras) > 1
    frames, times = np.unique(mark.frame, return_counts=True)
    frames = frames[times > 1] if several else frames[[0, -1]]
    uv = [np.full((len(frames), 2), np.nan) for _ in cameras]
    sigma = [np.full(len(frames), np.nan if several else _UNSEEN_PX) for _ in cameras]
    for i in mark.cameras:
        mine = (mark.camera == i) & np.isin(mark.frame, frames)
        at = np.searchsorted(frames, mark.frame[mine])
        uv[i][at], sigma[i][at] = mark.uv_px[mine], mark.sigma_px[mine]
    if several:
        by_name = {camera.name: pixels for camera, pixels in zip(cameras, uv)}
        points = calibration.triangulate(
            by_name, sigma_px=float(np.median(mark.sigma_px)), include_calibration=False
        ).points_mm
    else:
        (seeing,) = mark.cameras
        points = _nearest(*cameras[seeing].unproject(uv[seeing]))
        uv = [pixels if i == seeing else cameras[i].project(points) for i, pixels in enumerate(uv)]
    columns: dict[str, Any] = {"frame": frames, "particle": 0, "t_s": t_s[frames]}
    columns |= {f"{a}_mm": points[:, i] for i, a in enumerate("xyz")}
    for camera, px, sd in zip(cameras, uv, sigma):
        columns |= {f"{camera.name}_u_px": px[:, 0], f"{camera.name}_v_px": px[:, 1]}
        for name, value in (("suu", sd**2), ("suv", 0.0 * sd), ("svv", sd**2)):
            columns[f"{camera.name}_{name}_px2"] = value
    detections = pd.DataFrame(
        {
            "frame": mark.frame, "camera": [cameras[i].name for i in mark.camera], "particle": 0.0,
            "u_px": mark.uv_px[:, 0], "v_px": mark.uv_px[:, 1], "suu_px2": mark.sigma_px**2,
            "suv_px2": 0.0, "svv_px2": mark.sigma_px**2,
        }
    )  # fmt: skip
    return Tracks(f"mark {mark.mark}", detections, pd.DataFrame(columns), pd.DataFrame())


def _without(run: RunData, mark: Seen, rest: Rest) -> RunData:
    """Return the run without a mark, or without all marks."""
    if rest is Rest.SENSORS or run.references is None:
        return replace(run, references=None)
    others = run.references[run.references["mark"].astype(str) != mark.mark]
    return replace(run, references=others.reset_index(drop=True))


def _solution(found: Smoothing) -> Solution:
    assert found.solution is not None, "the smoothing was read from a folder"
    return found.solution


def judged(
    mark: Seen, rest: Rest, found: Smoothing, motion: Motion, cameras: Sequence[Camera]
) -> WithheldMark:
    """Return errors and NEES of the smoothed path of a withheld mark.

    The true path is ``motion``, which was added to the mark's pixels. The mean of the path is
    subtracted, because the mark's place is not known; this makes NEES of the position a little too
    small.

    rest : which measurements the smoothing used besides. found : the result of the smoothing.
    """
    solution = _solution(found)
    graph, covariances = solution.graph, solution.covariances
    if covariances is None:
        raise InputError("the smoothing has no covariances", where=f"mark {mark.mark}")
    seen = np.eye(3)
    if len(mark.cameras) == 1:
        seen = cameras[mark.cameras[0]].camera_from_rig.rotation[:2]
    wider = np.diag(found.verdict.get("inflation", (1.0, 1.0, 1.0)))

    def covariance(row: Array, extra: Array) -> Array:
        stated = row @ covariances.bubbles @ row.T + extra[:, :, None] * np.eye(3)
        return np.asarray(seen @ wider @ stated @ wider @ seen.T)

    place, speed = considered_variance(solution)
    states, at = solution.state.bubbles, graph.frame_of_row
    path = (states @ graph.bubble.position.T - motion.position_mm[at]) @ seen.T
    off, of_off = path - path.mean(0), covariance(graph.bubble.position, place)
    fast = (states @ graph.bubble.velocity.T - motion.velocity_mm_s[at]) @ seen.T
    of_fast = covariance(graph.bubble.velocity, speed)
    some = np.unique(np.linspace(0, len(off) - 1, min(len(off), _MOST_STORED)).astype(int))
    sd = np.sqrt(np.diagonal(of_off, axis1=1, axis2=2))
    return WithheldMark(
        mark=mark.mark, beside=rest, cameras=tuple(cameras[i].name for i in mark.cameras),
        frames=len(off), error_um=1e3 * _rms(off), sd_um=1e3 * _rms(sd), nees=_nees(off, of_off),
        velocity_error_mm_s=_rms(fast),
        velocity_sd_mm_s=_rms(np.sqrt(np.diagonal(of_fast, axis1=1, axis2=2))),
        velocity_nees=_nees(fast, of_fast), unsmoothed_um=1e3 * _unsmoothed(mark, found, cameras),
        smoothing=Verdict(found.verdict["verdict"]) if "verdict" in found.verdict else None,
        t_s=tuple(graph.problem.t_s[at][some].tolist()),
        off_um=tuple(map(tuple, (1e3 * off[some]).T.tolist())),
        sd_um_of_time=tuple(map(tuple, (1e3 * sd[some]).T.tolist())),
    )  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _nees(off: Array, covariance: Array) -> float:
    """Return the mean of e' C^-1 e per dimension; off (N, D), covariance (N, D, D)."""
    whole = np.linalg.solve(covariance, off[..., None])[..., 0]
    return float(np.mean((off * whole).sum(-1)) / off.shape[1])


def _unsmoothed(mark: Seen, found: Smoothing, cameras: Sequence[Camera]) -> float:
    """RMS of the places of the pixels about their mean, in mm along the axes of each image, with
    the encoder's travel added."""
    problem = _solution(found).graph.problem
    parts = []
    for i in mark.cameras:
        mine = mark.camera == i
        origin, _ = cameras[i].unproject(mark.uv_px[mine])
        lab = origin + problem.encoder_mm[mark.frame[mine], None] * problem.axis
        across = lab @ cameras[i].camera_from_rig.rotation[:2].T
        parts.append((across - across.mean(0)).ravel())
    return _rms(np.concatenate(parts))
