"""What accuracy an experiment can reach, before anything is recorded.

The covariances of a smoothing depend on what is measured when and how well, not on the readings. So
the smoothing graph of the planned run, with the shake's true spectrum as its prior, gives the exact
posterior. Where marks or an accelerometer on each arm measure the shake, it is 0.79-1.16 times the
error of runs that are smoothed without knowing the spectrum (docs/decisions/038).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.command_options import Experiment
from telerig.errors import InputError
from telerig.estimator.calibration.quality.uncertainty_map import uncertainty_map
from telerig.estimator.calibration.result.calibration import (
    Calibration,
    load_calibration,
    of_run,
)
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.estimator.sensors.checks import Mounting
from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.graph.stage_travel import default_scale_sigma, travel_of
from telerig.estimator.smoothing.problem.calibration_share import calibration_share
from telerig.estimator.smoothing.problem.marks import MARK_SIGMA_MM
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    Accelerometer,
    Bubble,
    CarriageModel,
    Mark,
    Observations,
    RigMode,
    ShakeModel,
    SmoothingProblem,
    Stage,
)
from telerig.estimator.smoothing.result import trajectories
from telerig.estimator.smoothing.verdict.identifiability import expected_shake, verdicts
from telerig.factors.bubble_motion import BubbleModel, Zigzag
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.results.smoothing import AxisVerdict, Verdict, vertical_axis, worst_of
from telerig.io.results.verdict_words import number_words
from telerig.io.rig_file.description import RigDescription
from telerig.io.simulation.calibration.scene import (
    TrueTarget,
    hand_held_views,
    true_cameras,
    true_target,
)
from telerig.io.simulation.calibration_files import exact_dots
from telerig.io.simulation.config import CameraConfig, SimulationConfig
from telerig.io.tables.smoothing import AXES
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.units import MICRO_G_M_S2
from telerig.short_text import counted, share

_TILTS_OF_MANY_DEG = (8.0, 65.0)
"""Tilts of a plate that three cameras or more see."""
_SAMPLE_HZ = 2000.0
_DAMPING = 0.03
_COMMON, _ARM_RATIO = 0.75, 1.6
_EDGE = 0.1
_INSIDE = 0.8
_DENSITY_UG = 25.0
_BLUR_PX, _IMAGE_NOISE = 1.0, 0.01
MOST_STATES = 20_000
"""Largest product of frames and bubbles: the covariances of more would take minutes."""


def check(planned: Experiment) -> None:
    """Raise InputError for a value that is impossible or beyond what can be planned."""
    positive = ("rate_hz", "seconds", "diameter_mm", "sigma_px", "zigzag_hz", "shake_hz")
    for name in (*positive, "mark_sigma_px"):
        value = getattr(planned, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}", where="plan", todo="give a positive number")
    for name in ("rise_mm_s", "zigzag_mm", "shake_mm", "marks"):
        value = getattr(planned, name)
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"{name} is {value}", where="plan", todo="give 0 or more")
    if planned.bubbles < 1 or planned.frames < 10 or planned.frames * planned.bubbles > MOST_STATES:
        raise InputError(
            f"{counted(planned.bubbles, 'bubble')} in {planned.frames:.6g} frames",
            where="plan",
            todo="plan 1 or more bubbles in 10 or more frames, bubbles times frames at most "
            f"{MOST_STATES}; a longer run will be at least as accurate as this plan says",
        )


@dataclass(frozen=True)
class Expected:
    """Hold the standard deviations that a planned run is expected to have.

    All are medians over the run without its first and last tenth.

    axes : the verdict along "x", "y" and "z" with its numbers, as of a run.
    vertical : the axis nearest to the vertical.
    position_um, velocity_mm_s : (3,) standard deviations of positions and velocities along the
        rig's axes.
    sigma_px : standard deviation of a bubble's centre in the images that was assumed.
    """

    axes: dict[str, AxisVerdict]
    vertical: str
    position_um: Array
    velocity_mm_s: Array
    sigma_px: float

    @property
    def verdict(self) -> Verdict:
        """The verdict on the worst axis."""
        return worst_of(self.axes)

    @property
    def known_um(self) -> Array:
        """Standard deviations (3,) that positions would have if the shake were known."""
        return np.array([1e3 * (axis.sigma_shake_known_mm or 0.0) for axis in self.axes.values()])


def centre_sigma_px(diameter_px: float) -> float:
    """Return the standard deviation in px of the centre of a bubble's outline.

    It consists of two parts. One is the Cramer-Rao bound for a disc with a blur of 1 px in white
    noise of 1 % of the contrast. The other is an assumed 1 % of the radius, because the centre of
    an outline wanders when the body oscillates: 1.6 sigma_3 R in docs/decisions/006, for a sigma_3
    of 0.6 %.
    """
    radius, blur = diameter_px / 2, np.hypot(_BLUR_PX, np.sqrt(1 / 12))
    noise = _IMAGE_NOISE * np.sqrt(2 * blur / (np.sqrt(np.pi) * radius))
    return float(np.hypot(noise, 0.01 * radius))


def expected_calibration(
    rig: RigDescription, views: int = 12, sigma_px: float = 0.01, seed: int = 0
) -> Calibration:
    """Return the calibration that hand-held views of the target of rig.toml are expected to give.

    The cameras are the nominal ones, and the covariance is the Cramer-Rao bound.

    views : number of views.
    sigma_px : standard deviation of a dot's centre.
    seed : of the random poses of the target.

    Raises InputError if the target does not fit into the views.
    """
    turns = {name: np.radians(turn) for name, turn in rig.rotvec_from_first_deg.items()}
    cameras = tuple(
        CameraConfig(c.name, c.image_size_px, c.scale_px_per_mm, c.scale_px_per_mm)
        for c in rig.cameras.values()
    )
    field_mm = min(min(c.image_size_px) / c.scale_px_per_mm for c in cameras)
    reach = 0.2 * field_mm
    config = SimulationConfig(
        rig.name, cameras, rig.target, views=views,
        mount_rotvec_deg=(0.0, 0.0, 0.0), axis_gap_mm=0.0, shift_mm=(reach,) * 3,
        visible_fraction=0.5, marks_visible=False, print_factor=0.0,
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    target = true_target(config, rng)
    true = {
        name: replace(camera, camera_from_rig=Pose.from_rotvec(turns[name]))
        if name in turns
        else camera
        for name, camera in true_cameras(config).items()
    }
    if len(cameras) > 2:
        wide = replace(config, tilt_deg=_TILTS_OF_MANY_DEG)
        config = replace(wide, seen_by=_seen_together(wide, true, target))
    dots = exact_dots(config, true, target, hand_held_views(config, true, target, rng))
    dots = dots[dots["inside"] == 1].reset_index(drop=True)
    dots[["suu_px2", "svv_px2"]], dots["suv_px2"] = sigma_px**2, 0.0
    noise = sigma_px * rng.standard_normal((len(dots), 2))
    dots[["u_px", "v_px"]] = dots[["u_px", "v_px"]].to_numpy() + noise
    first = true[rig.first].camera_from_rig
    return self_calibrate(
        dots, [replace(camera, camera_from_rig=first) for camera in true.values()], rig.target,
        name=rig.name, model="radial", nominal_rotvec_deg=rig.rotvec_from_first_deg,
    )  # fmt: skip


def _seen_together(
    config: SimulationConfig, cameras: Mapping[str, Camera], target: TrueTarget
) -> tuple[tuple[str, ...], ...]:
    """Return the groups of cameras that can see one view of the target, the largest first.

    Raises InputError if no two cameras can.
    """
    found = []
    for count in range(len(cameras), 1, -1):
        for group in combinations(cameras, count):
            one = replace(config, views=1, seen_by=(group,))
            with suppress(InputError):
                hand_held_views(one, cameras, target, np.random.default_rng(0))
                found.append(group)
    if not found:
        raise InputError(
            "no two cameras can see one side of the target together", where="rig.toml [stereo]",
            todo="correct the cameras' nominal rotations, choose a smaller target, or give the "
            "rig's calibration (--calibration)",
        )  # fmt: skip
    return tuple(found)


def calibration_of(
    dataset: Path, rig: RigDescription, given: Path | None = None, views: int = 12
) -> Calibration:
    """Return the given calibration, or else the dataset's own, or else the expected one.

    views : number of views of the target for the expected one.

    Raises InputError for a calibration that cannot be read, for a rig with one camera, and for a
    target that does not fit into the views.
    """
    own = dataset / "results" / "calibration"
    if given is not None or (own / "calibration.json").is_file():
        return load_calibration(given or own)
    if len(rig.cameras) < 2:
        raise InputError(
            "a rig with one camera", where=str(dataset / "rig.toml"),
            todo="describe two cameras: one camera alone does not show depth",
        )  # fmt: skip
    return expected_calibration(rig, views)


def expect(rig: RigDescription, calibration: Calibration, planned: Experiment) -> Expected:
    """Return what a planned run is expected to reach.

    rig : the description in rig.toml: stage, accelerometers, cameras of the tracking.
    calibration : the rig's calibration, or `expected_calibration`.

    Raises InputError for an impossible experiment.
    """
    check(planned)
    calibration = of_run(calibration, rig.tracking_cameras)
    sigma_px = planned.sigma_px
    if sigma_px is None:
        sigma_px = centre_sigma_px(planned.diameter_mm * calibration.cameras[0]["scale_px_per_mm"])
    problem = planned_problem(rig, calibration, planned, sigma_px)
    model = planned_model(problem, rig, planned)
    solution = solve(problem, model, Options(robust=False))
    table = trajectories(solution, None).iloc[_inner(solution)]
    return Expected(
        verdicts(solution, expected_shake(solution)),
        vertical_axis(problem.up),
        1e3 * table[[f"s{a}_mm" for a in AXES]].median().to_numpy(float),
        table[[f"sv{a}_mm_s" for a in AXES]].median().to_numpy(float),
        sigma_px,
    )


def planned_problem(
    rig: RigDescription, calibration: Calibration, planned: Experiment, sigma_px: float
) -> SmoothingProblem:
    """Return the smoothing problem of a simulated run without noise and without shake.

    The bubbles rise along straight lines at places spread over the field of view, and the stage
    follows them.
    sigma_px : standard deviation that is stated for a bubble's centre.
    """
    cameras, travel = calibration.cameras, travel_of(calibration.stage, rig.stage)
    mounting = Mounting.of(rig.stage, travel.axis)
    t_s = np.arange(planned.frames) / planned.rate_hz
    encoder = planned.rise_mm_s * t_s
    field = min(min(c.image_size_px) / c["scale_px_per_mm"] for c in cameras)
    rng = np.random.default_rng(0)
    first = rng.uniform(-0.25 * field, 0.25 * field, (planned.bubbles, 3))
    paths = first[:, None] + (encoder[:, None] * travel.axis)[None]
    bubbles = tuple(Bubble(k, 0, len(t_s) - 1, path[0], path) for k, path in enumerate(paths))
    item, frame, camera = (
        a.ravel()
        for a in np.meshgrid(
            np.arange(planned.bubbles), np.arange(len(t_s)), np.arange(len(cameras)), indexing="ij"
        )
    )
    seen = paths[item, frame] - encoder[frame, None] * travel.axis
    observations = _observed(cameras, item, frame, camera, seen, sigma_px)
    marks, references = _marks(cameras, t_s, encoder, travel.axis, planned)
    stage = Stage(t_s, encoder) if rig.stage is not None else None
    return SmoothingProblem(
        tuple(cameras), t_s, travel.axis, mounting.up, bubbles, observations, stage,
        _accelerometers(rig, [c.name for c in cameras], t_s, mounting, planned.arms), marks,
        references, calibration_share(calibration, first, sigma_px), travel,
        mounting.gravity_m_s2,
    )  # fmt: skip


def _observed(
    cameras: Sequence[Camera], item: Ints, frame: Ints, camera: Ints, seen_mm: Array, sd: float
) -> Observations:
    uv = np.empty((len(item), 2))
    for index, one in enumerate(cameras):
        uv[camera == index] = one.project(seen_mm[camera == index])
    covariance = np.broadcast_to(sd**2 * np.eye(2), (len(item), 2, 2))
    return Observations(item, frame, camera, uv, covariance)


def _marks(
    cameras: Sequence[Camera], t_s: Array, encoder: Array, axis: Array, planned: Experiment
) -> tuple[tuple[Mark, ...], Observations]:
    """Return marks along the tank, so that each view always has its number of them inside."""
    if not planned.marks:
        return (), Observations.none()
    marks: list[Mark] = []
    parts = []
    for index, camera in enumerate(cameras):
        half = _INSIDE * min(camera.image_size_px) / camera["scale_px_per_mm"] / 2
        pitch = 2 * half / planned.marks
        for height in np.arange(-half + pitch / 2, encoder[-1] + half, pitch):
            frames = np.flatnonzero(np.abs(height - encoder) <= half)
            if len(frames) > 1:
                seen = (height - encoder[frames])[:, None] * axis
                ones = np.ones(len(frames), np.int64)
                parts.append(
                    _observed(
                        cameras, len(marks) * ones, frames, index * ones, seen,
                        planned.mark_sigma_px,
                    )
                )  # fmt: skip
                name = f"{camera.name}{len(marks)}"
                marks.append(Mark(name, height * axis, MARK_SIGMA_MM))
    fields = ("item", "frame", "camera", "uv_px", "covariance_px2")
    joined = (np.concatenate([getattr(part, name) for part in parts]) for name in fields)
    return tuple(marks), Observations(*joined)


def _accelerometers(
    rig: RigDescription, cameras: list[str], t_s: Array, mounting: Mounting, arms: bool
) -> tuple[Accelerometer, ...]:
    """Return the sensors of rig.toml, and one for each arm that has none if ``arms``."""
    planned: list[tuple[str, str, Array, float | None]] = [
        (one.name, one.mounted_on, np.asarray(one.axes, float), one.noise_density_ug_sqrt_hz)
        for one in rig.accelerometers.values()
    ]
    bare = [c for c in cameras if c not in [mount for _, mount, *_ in planned]] if arms else []
    planned += [(f"arm_{c}", c, np.eye(3), None) for c in bare]
    times = np.arange(t_s[0], t_s[-1] + 1 / _SAMPLE_HZ, 1 / _SAMPLE_HZ)
    at_rest = 1000 * mounting.gravity_m_s2 * mounting.up
    return tuple(
        Accelerometer(
            name, CARRIAGE if mount not in cameras else cameras.index(mount), times,
            np.broadcast_to(axes @ at_rest, (len(times), 3)).copy(), axes,
            (density or _DENSITY_UG) * 1e3 * MICRO_G_M_S2 * np.sqrt(_SAMPLE_HZ / 2),
        )
        for name, mount, axes, density in planned
    )  # fmt: skip


def planned_model(
    problem: SmoothingProblem, rig: RigDescription, planned: Experiment
) -> ShakeModel:
    """Return the hyper-parameters of the planned run, which count as true."""
    across, up = 1 - np.abs(problem.up), np.abs(problem.up)

    def triple(values: Array) -> tuple[float, float, float]:
        x, y, z = values.tolist()
        return x, y, z

    rms = planned.shake_mm * (up + 0.5 * across)
    modes: tuple[RigMode, ...] = (
        RigMode(planned.shake_hz, _DAMPING, triple(np.sqrt(_COMMON) * rms), CARRIAGE),
    )
    modes += tuple(
        RigMode(_ARM_RATIO * planned.shake_hz, _DAMPING, triple(np.sqrt(1 - _COMMON) * rms), j)
        for j in range(len(problem.cameras))
    )
    zigzags = (
        Zigzag(planned.zigzag_hz, _DAMPING, triple(planned.zigzag_mm * across)),
        Zigzag(2 * planned.zigzag_hz, _DAMPING, triple(0.1 * planned.zigzag_mm * up)),
    )
    marked = len(problem.references) > 0 and problem.stage is not None
    carriage = CarriageModel()
    if problem.accelerometers:
        carriage = CarriageModel("force", acceleration_rms_mm_s2=300.0)
    return ShakeModel(
        bubble=BubbleModel(zigzags=zigzags),
        modes=modes if planned.shake_mm else (),
        carriage=carriage,
        encoder_sigma_mm=0.005 if rig.stage is None else float(rig.stage.position_sigma_mm),
        encoder_scale_sigma=default_scale_sigma(problem.travel) if marked else 0.0,
        name="planned",
    )


def _inner(solution: Solution) -> Ints:
    """Return the rows of a solution without the first and the last tenth of the frames."""
    frames = solution.graph.frame_of_row
    edge = int(_EDGE * (frames.max() + 1))
    return np.flatnonzero((frames >= edge) & (frames <= frames.max() - edge))


def variants(rig: RigDescription, planned: Experiment) -> dict[str, Experiment]:
    """Return the planned experiment and the same with one addition each, keyed by a description.

    Only what the plan lacks is added: marks, accelerometers on the arms, both, twice the frame
    rate, and four more bubbles.
    """
    out = {"as planned": planned}
    has_arms = set(rig.tracking_cameras) <= {a.mounted_on for a in rig.accelerometers.values()}
    lacks_arms = not (planned.arms or has_arms)
    marks = 4 if not planned.marks else 2 * planned.marks
    out[f"{marks} marks in each view"] = replace(planned, marks=marks)
    if lacks_arms:
        out["an accelerometer on each arm"] = replace(planned, arms=True)
        out[f"both ({marks} marks)"] = replace(planned, marks=marks, arms=True)
    more = {
        "twice the frame rate": replace(planned, rate_hz=2 * planned.rate_hz),
        "four more bubbles": replace(planned, bubbles=planned.bubbles + 4),
    }
    return out | {
        name: one for name, one in more.items() if one.frames * one.bubbles <= MOST_STATES
    }


def plan_table(expected: dict[str, Expected]) -> pd.DataFrame:
    """Return a table with a row for each variant: its verdict and standard deviations per axis.

    expected : what `expect` returned, by the name of the variant.
    """
    rows = [
        {
            "variant": name, "verdict": str(one.verdict), "sigma_px": one.sigma_px,
            **{f"s{a}_um": v for a, v in zip(AXES, one.position_um)},
            **{f"sv{a}_mm_s": v for a, v in zip(AXES, one.velocity_mm_s)},
            **{f"s{a}_shake_known_um": v for a, v in zip(AXES, one.known_um)},
            **{f"eta_{a}": one.axes[a].eta for a in AXES},
        }
        for name, one in expected.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


def plan_words(
    rig: RigDescription,
    calibration: Calibration,
    chosen: dict[str, Experiment],
    expected: dict[str, Expected],
) -> list[str]:
    """Return the plan in words: the calibration's share, a table of the variants, and advice.

    chosen, expected : the variants, the planned run first, and what each is expected to reach.
    """
    planned, first = next(iter(chosen.values())), next(iter(expected.values()))
    sensors = ", ".join(rig.accelerometers) or "none"
    lines = [
        f"{counted(planned.bubbles, 'bubble')} for {planned.seconds:g} s at "
        f"{planned.rate_hz:g} Hz; a centre is good to {first.sigma_px:.2g} px; the rig shakes by "
        f"{planned.shake_mm:g} mm RMS at {planned.shake_hz:g} Hz",
        f"encoder: {'yes' if rig.stage else 'no'}; accelerometers: {sensors}; marks in each view: "
        f"{planned.marks}",
        _common_words(calibration),
        f"as planned: {number_words(first.axes, first.vertical)} {first.verdict}",
        "",
        f"{'':30}{'position, µm':>20}{'velocity, mm/s':>22}   of the shake",
        f"{'standard deviation':30}{'x':>7}{'y':>7}{'z':>7}{'x':>8}{'y':>7}{'z':>7}   removed in "
        f"{first.vertical}  verdict",
    ]
    for name, one in expected.items():
        place = "".join(f" {v:6.3g}" for v in one.position_um)
        speed = "".join(f" {v:6.2g}" for v in one.velocity_mm_s)
        eta = one.axes[one.vertical].eta
        removed = "" if eta is None else share(eta, 1.0)
        lines.append(f"{name:30}{place} {speed}  {removed:>13}  {one.verdict}")
    known = "".join(f" {v:6.3g}" for v in first.known_um)
    lines += [f"{'(as planned, shake known)':30}{known}", "", _advice(chosen, expected)]
    return lines


def _common_words(calibration: Calibration) -> str:
    """Return the sentence on the errors of the calibration, which all points have in common."""
    if not calibration.covariance_known:
        return NO_COVARIANCE
    share = uncertainty_map(calibration).calibration_mm2
    um = 1e3 * np.sqrt(np.trace(share, axis1=1, axis2=2) / 3)
    return (
        f"the calibration moves all points together by {np.median(um):.2g} µm per axis, in the "
        f"worst corner of the working volume by {um.max():.2g} µm"
    )


def _advice(chosen: dict[str, Experiment], expected: dict[str, Expected]) -> str:
    """Return the sentence that names the variants with fewest additions that are RESOLVED."""
    planned = asdict(next(iter(chosen.values())))
    additions = {
        name: sum(planned[key] != value for key, value in asdict(chosen[name]).items())
        for name, one in expected.items()
        if one.verdict is Verdict.RESOLVED
    }
    enough = [name for name, count in additions.items() if count == min(additions.values())]
    if enough and not additions[enough[0]]:
        return "The plan separates the bubbles' motion from the shake."
    if not enough:
        return (
            "None of these additions separates the bubbles' motion from the shake: record for "
            "longer, or stiffen the rig."
        )
    return f"To separate the bubbles' motion from the shake, add: {' or '.join(enough)}."
