"""Runs for the smoother, in three dimensions and with the truth, made without its models.

Bubbles, carriage and shake come from the simulator of motions (`telerig.io.simulation.run.motion`),
the nonlinear ones from equations of motion integrated here; pixels from the cameras' projection.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from numpy.random import Generator
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from shake_cases import (
    ARM_RATIO,
    COMMON,
    DAMPING,
    ENCODER_MM,
    FORCE_HZ,
    MARK_PX,
    MARKS,
    MM_PER_PX,
    RISE_MM_S,
    SAMPLE_HZ,
    SCENARIOS,
    SERVO,
    WANDER,
    ZIGZAG,
    Scenario,
    mark_generation,
)
from shake_forces import NONLINEAR as FORCED
from shake_forces import nonlinear_shake

from telerig.estimator.calibration.result.calibration import Calibration
from telerig.io.rig_file.description import AccelerometerDescription, StageDescription
from telerig.io.simulation.run.motion import (
    Path as Motion,
)
from telerig.io.simulation.run.motion import (
    Shake,
    accelerometer_readings,
    constant_speed_path,
    mode_acceleration,
    ornstein_uhlenbeck,
    rig_mode,
    rig_shake,
    stochastic_paths,
)
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Array = NDArray[np.float64]

UP = np.array([0.0, -1.0, 0.0])
Motions = tuple[Array, Array, Shake, Shake]
"""Position and acceleration (N,) of the carriage, shake common to the cameras and of their arms."""

LATERAL = (2.0, 6.0, 0.03)
LATERAL_SHAKE = 0.5
NONLINEAR = ("zigzag", *FORCED)
H = 1 / SAMPLE_HZ


@dataclass(frozen=True)
class Case:
    """A scenario, and what is unlike S0-S6 in it.

    scale_sigma : what rig.toml states of the encoder's scale, 0 exact, None nothing.
    angle_deg between the cameras.  kappa_per_mm of both.  nonlinear : one of ``NONLINEAR``.
    force_hz : corner of what shakes the rig.  around_s : how long encoder and accelerometers record
    before the first and after the last frame; the stage starts and stops within that time.
    bubbles : how many there are.
    """

    scenario: Scenario
    angle_deg: float = 90.0
    kappa_per_mm: float = 0.0
    nonlinear: str = ""
    outliers: float = 0.0
    dropped: float = 0.0
    delay_s: float = 0.0
    encoder_scale: float = 0.0
    scale_sigma: float | None = 0.0
    ramp_s: float = 0.0
    force_hz: float = FORCE_HZ
    around_s: float = 0.0
    bubbles: int = 5

    @property
    def name(self) -> str:
        return self.nonlinear or self.scenario.name


@dataclass(frozen=True)
class Run:
    """Tables as a user has them, and truth: position_mm, velocity_mm_s (B, F, 3) lab.

    offset_mm : (2, F, 3) rig axes.  oracle : tracks of a rig without shake, the same noise.
    """

    case: Case
    t_s: Array
    calibration: Calibration
    tracks: pd.DataFrame
    oracle: pd.DataFrame
    stage: pd.DataFrame
    accelerometers: pd.DataFrame
    references: pd.DataFrame
    position_mm: Array
    velocity_mm_s: Array
    offset_mm: Array

    def inputs(self, information: str) -> dict[str, Any]:
        """Keyword arguments of `telerig.smooth`, with its first two."""
        tracks = self.oracle if information == "oracle" else self.tracks
        if information != "five":
            tracks = tracks[tracks["particle"] == 0]
        sensor = self.accelerometers["sensor"]
        sensors = self.accelerometers[(sensor == "carriage") == (information == "carriage")]
        used = information in ("arms", "carriage")
        return {
            "tracks": tracks.reset_index(drop=True),
            "calibration": self.calibration,
            "stage": self.stage,
            "accelerometers": sensors if used else None,
            "references": self.references if information == "references" else None,
            "rig": description(self.case.scale_sigma),
            "t_s": self.t_s,
        }


def description(scale_sigma: float | None = 0.0) -> SimpleNamespace:
    """What rig.toml says of stage and sensors; an encoder whose scale is known unless said."""
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    sensors = {
        name: AccelerometerDescription(name, mount, axes, 22.5)
        for name, mount in (("arm_left", "left"), ("arm_right", "right"), ("carriage", "carriage"))
    }
    up = (0.0, -1.0, 0.0)
    stage = StageDescription(up, up, ENCODER_MM, scale_sigma)
    return SimpleNamespace(stage=stage, accelerometers=sensors)


def cameras(case: Case) -> tuple[Camera, Camera]:
    turn = Pose.from_rotvec([0.0, np.deg2rad(case.angle_deg), 0.0])
    size, scale = (1024, 1024), 1 / MM_PER_PX
    kappa = {"kappa_per_mm": case.kappa_per_mm}
    return (
        Camera.create("left", size, scale, **kappa),
        Camera.create("right", size, scale, camera_from_rig=turn, **kappa),
    )


def simulate(
    case: Case,
    rng: Generator,
    rig: tuple[tuple[Camera, Camera], Calibration] | None = None,
    bubbles: Callable[[Array], tuple[Array, Array]] | None = None,
    motion: Callable[[Array, Generator], Motions] | None = None,
) -> Run:
    """One run. rig : true cameras and what the estimator is told, by default the truth.

    bubbles : positions and velocities (B, N, 3) at times (N,), in place of those of the case.
    motion : motions of carriage and cameras at times (N,), in place of those of the case.
    """
    scenario = case.scenario
    true = cameras(case) if rig is None else rig[0]
    thin = round(SAMPLE_HZ / scenario.rate_hz)
    steps, lead = (scenario.frames - 1) * thin + 1, round(case.around_s * scenario.rate_hz) * thin
    t = np.arange(-lead, steps + lead) * H
    told = Calibration(true, np.zeros(0, int), np.zeros((0, 3)), {}, np.zeros((6, 6)), (), ((), ()))
    if motion is None:
        carriage, push = _carriage(case, t, rng)
        common, own = random_shake(case, t - t[0], rng)
    else:
        carriage, push, common, own = motion(t, rng)
    offset = common.offset_mm + own.offset_mm
    seen_s = t[lead : lead + steps]
    moving = _bubbles(case, seen_s, rng) if bubbles is None else bubbles(seen_s)
    place, velocity = (each[:, ::thin] for each in moving)
    frames = slice(lead, lead + steps, thin)
    moved = carriage[frames, None] * UP + offset[:, frames]
    count = len(place)
    noise = scenario.noise_px * rng.standard_normal((2, count, scenario.frames, 2))
    spoiled = rng.random((2, count, scenario.frames)) < case.outliers
    noise += spoiled[..., None] * rng.uniform(-20, 20, noise.shape)
    kept = rng.random((count, scenario.frames)) >= case.dropped
    kept[:, [0, -1]] = True
    calibration = told if rig is None else rig[1]
    seen, calm = (
        _tracks(calibration, true, t[frames], place, away, noise, kept, scenario)
        for away in (moved, np.broadcast_to(carriage[frames, None] * UP, moved.shape))
    )
    return Run(
        case, t[frames], calibration, seen, calm,
        _stage(case, t, carriage, rng),
        _accelerometers(case, t, push, common, own, rng),
        _references(true, t[frames], moved, rng),
        place, velocity, offset[:, frames],
    )  # fmt: skip


def _carriage(case: Case, t: Array, rng: Generator) -> tuple[Array, Array]:
    """Position and acceleration along the axis, the servo's error included."""
    place, push = RISE_MM_S * t, np.zeros_like(t)
    if case.around_s > 0:
        place, push = started_and_stopped(t, case.around_s)
    elif case.ramp_s > 0:
        from telerig.io.simulation.run.motion import stage_trajectory

        place, _, push = stage_trajectory(t, RISE_MM_S, case.ramp_s)
    servo = rig_mode(*SERVO, FORCE_HZ)
    states = servo.paths(H, len(t), rng)[0]
    return place + states[:, 0], push + mode_acceleration(states, servo)


def started_and_stopped(t: Array, around_s: float) -> tuple[Array, Array]:
    """Position (0 at t = 0) and acceleration of a stage that starts and stops in 0.3 s, 1 s away
    from the run or half of around_s if this is less, and rises at a steady speed between."""
    ramp, margin = 0.3, min(1.0, around_s / 2)
    first, last = -margin, t[-1] - around_s + margin

    def risen(s: Array) -> tuple[Array, Array]:
        """Travel and acceleration for a speed that rises from 0 to 1 between s = 0 and s = ramp."""
        w = np.pi / ramp
        during = (s > 0) & (s < ramp)
        travel = np.where(s >= ramp, s - ramp / 2, 0.0)
        travel = np.where(during, s / 2 - np.sin(w * s) / (2 * w), travel)
        return travel, np.where(during, w / 2 * np.sin(w * s), 0.0)

    up, faster = risen(t - first + ramp)
    down, slower = risen(t - last)
    start = np.interp(0.0, t, up - down)
    return RISE_MM_S * (up - down - start), RISE_MM_S * (faster - slower)


def _bubbles(case: Case, t: Array, rng: Generator) -> tuple[Array, Array]:
    """Positions and velocities (B, N, 3) in the lab."""
    count = case.bubbles
    if case.nonlinear == "zigzag":
        paths = []
        for _ in range(count):
            hz, reach = rng.uniform(5, 8), rng.uniform(2, 5)
            turns = {k: rng.uniform(0, 2 * np.pi) for k in ("azimuth_rad", "phase_rad")}
            paths.append(constant_speed_path(t, RISE_MM_S, hz, (reach, 0.0), **turns))
        columns = ("height_mm", "lateral_mm", "height_mm_s", "lateral_mm_s")
        motion = Motion(*(np.stack([getattr(p, c) for p in paths]) for c in columns))
        extra = ornstein_uhlenbeck(3.0, 0.3).paths(
            H, len(t), rng, paths=3 * count, start_covariance=np.diag([0.0, 9.0])
        )
        wander = extra.reshape(3, count, len(t), 2)
    else:
        motion = stochastic_paths(
            H, len(t), rng,
            rise_mm_s=np.full(count, RISE_MM_S), wander_mm_s=WANDER[0], wander_tau_s=WANDER[1],
            height_oscillation=ZIGZAG, lateral_oscillation=LATERAL,
        )  # fmt: skip
        wander = np.zeros((3, count, len(t), 2))
    start = rng.uniform(-5, 5, (count, 1, 3))
    across = np.stack([motion.lateral_mm, motion.lateral_mm_s])
    upwards = np.stack([motion.height_mm, motion.height_mm_s])
    both = np.stack([across[..., 0], -upwards, across[..., 1]], -1)
    both += wander.transpose(3, 1, 2, 0)
    return start + both[0], both[1]


def random_shake(case: Case, t: Array, rng: Generator) -> tuple[Shake, Shake]:
    """Common shake and that of the arms, each (2, N, 3)."""
    scenario = case.scenario
    rms = scenario.amplitude_mm / np.sqrt(2) * np.array([LATERAL_SHAKE, 1.0, LATERAL_SHAKE])
    if case.nonlinear in FORCED:
        return nonlinear_shake(case.nonlinear, t, rms, COMMON, rng)
    options: dict[str, Any] = {
        "frequency_hz": scenario.hz,
        "arm_ratio": ARM_RATIO,
        "damping": DAMPING,
        "force_hz": case.force_hz,
    }
    common = rig_shake(
        H, len(t), rng, cameras=2, rms_mm=rms * np.sqrt(COMMON), common_share=1.0, **options
    )
    own = rig_shake(
        H, len(t), rng, cameras=2, rms_mm=rms * np.sqrt(1 - COMMON), common_share=0.0, **options
    )
    return common, own


def _tracks(
    calibration: Calibration,
    true: tuple[Camera, Camera],
    t: Array,
    place: Array,
    rig: Array,
    noise: Array,
    kept: NDArray[np.bool_],
    scenario: Scenario,
) -> pd.DataFrame:
    """tracks.csv of a perfect tracker."""
    uv = [c.project(place - rig[j]) + noise[j] for j, c in enumerate(true)]
    bubble, frame = np.nonzero(kept)
    pixels = [a[bubble, frame] for a in uv]
    points = calibration.triangulate(*pixels, sigma_px=scenario.noise_px)
    columns: dict[str, Any] = {"frame": frame, "particle": bubble, "t_s": t[frame]}
    columns |= {f"{a}_mm": points.points_mm[:, i] for i, a in enumerate("xyz")}
    for i, a in enumerate("xyz"):
        for j in range(i, 3):
            columns[f"s{a}{'xyz'[j]}_mm2"] = points.covariance_mm2[:, i, j]
    for camera, px in zip(true, pixels):
        columns |= {f"{camera.name}_u_px": px[:, 0], f"{camera.name}_v_px": px[:, 1]}
        variance = scenario.noise_px**2
        for name, value in (("suu", variance), ("suv", 0.0), ("svv", variance)):
            columns[f"{camera.name}_{name}_px2"] = value
    return pd.DataFrame(columns)


def _stage(case: Case, t: Array, carriage: Array, rng: Generator) -> pd.DataFrame:
    """Read at the frames (at 500 Hz, every 2 ms), as in the reference of the design."""
    thin = round(SAMPLE_HZ / case.scenario.rate_hz)
    read = carriage[::thin] * (1 + case.encoder_scale)
    read = read + ENCODER_MM * rng.standard_normal(len(read))
    return pd.DataFrame({"t_s": t[::thin], "position_mm": read})


def _accelerometers(
    case: Case, t: Array, push: Array, common: Shake, own: Shake, rng: Generator
) -> pd.DataFrame:
    shared = push[:, None] * UP + common.acceleration_mm_s2[0]
    tables = []
    for name, felt in (
        ("arm_left", shared + own.acceleration_mm_s2[0]),
        ("arm_right", shared + own.acceleration_mm_s2[1]),
        ("carriage", shared),
    ):
        reading = accelerometer_readings(
            felt, UP, np.eye(3), rng, rate_hz=SAMPLE_HZ, density_ug_sqrt_hz=22.5,
            bias_m_s2=0.2 * rng.standard_normal(3),
        )  # fmt: skip
        columns: dict[str, Any] = {"t_s": t + case.delay_s, "sensor": name}
        columns |= {f"a{a}_m_s2": reading[:, i] for i, a in enumerate("xyz")}
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def _references(true: tuple[Camera, Camera], t: Array, rig: Array, rng: Generator) -> pd.DataFrame:
    """Four marks a camera, all replaced every 0.3 s, at heights nobody knows."""
    generation = mark_generation(t)
    tables = []
    for j, camera in enumerate(true):
        middle = np.array([rig[j, generation == g].mean(0) for g in range(generation[-1] + 1)])
        spread = rng.uniform(-1, 1, (len(middle), MARKS, 3)) * np.array([40.0, 8.0, 40.0])
        places = middle[:, None] + spread
        seen = camera.project(places[generation] - rig[j][:, None])
        seen = seen + MARK_PX * rng.standard_normal(seen.shape)
        frame = np.repeat(np.arange(len(t)), MARKS)
        mark = [f"{camera.name}{g}_{m}" for g in generation for m in range(MARKS)]
        flat = seen.reshape(-1, 2)
        tables.append(
            pd.DataFrame(
                {
                    "frame": frame,
                    "camera": camera.name,
                    "mark": mark,
                    "u_px": flat[:, 0],
                    "v_px": flat[:, 1],
                    "sigma_px": MARK_PX,
                }
            )
        )
    return pd.concat(tables, ignore_index=True)


def cases() -> dict[str, Case]:
    """S0-S6 and the nonlinear suite (500 Hz, 0.5 px, 0.2 mm; the zigzag's rig shakes at 20 Hz)."""
    out = {name: Case(s) for name, s in SCENARIOS.items()}
    out |= {kind: Case(SCENARIOS["S2"], nonlinear=kind) for kind in NONLINEAR}
    return out


def oblique(case: Case) -> Case:
    """The same with 40 degrees between cameras that are not quite telecentric."""
    return replace(case, angle_deg=40.0, kappa_per_mm=2e-4)
