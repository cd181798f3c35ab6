"""What a simulated run is like: every number that can be set, and named examples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

from telerig.errors import InputError
from telerig.io.simulation.calibration.presets import (
    PRESETS,
    CameraConfig,
    SimulationConfig,
    preset,
)
from telerig.io.simulation.run.mark_strip_config import StripConfig
from telerig.rig.target import Target

Range = tuple[float, float]
Oscillation = tuple[float, float, float]
"""RMS (mm), frequency (Hz), damping of a stochastic oscillation."""


@dataclass(frozen=True)
class BubbleConfig:
    """Sizes, shapes and looks; a range is drawn from evenly, once for each bubble.

    d_eq_mm : diameter of the sphere of equal volume; aspect : large over small semi-axis, the
    small one along the path, and half of ``triaxial`` more or less between the two large ones.
    modes_static, modes_oscillating : greatest relative amplitude of each mode of a degree
    (2, 3, 4), constant and swinging at the frequency that surface tension gives (Lamb), times
    ``tone``. spin_hz : about the small axis.
    heart_radius, heart : see `telerig.io.simulation.images.bubbles.Look`; heart 0 makes
        bubbles dark all over.
    """

    d_eq_mm: Range = (4.0, 5.0)
    aspect: Range = (1.3, 1.6)
    triaxial: float = 0.06
    modes_static: Mapping[int, float] = field(default_factory=dict)
    modes_oscillating: Mapping[int, float] = field(default_factory=dict)
    tone: float = 1.0
    spin_hz: Range = (-3.0, 3.0)
    rim: Range = (0.09, 0.12)
    heart: Range = (0.84, 0.97)
    heart_radius: Range = (0.32, 0.38)
    heart_sharpness: float = 2.5
    heart_offset: float = 0.04
    ring: float = 0.04


@dataclass(frozen=True)
class MotionConfig:
    """Paths of the bubbles in the lab.

    path : "zigzag" and "helix" have a constant speed ``rise_mm_s`` along the path and the lateral
    amplitude ``lateral_mm``; "stochastic" rises at ``rise_mm_s`` in the mean, with the stochastic
    oscillations ``height_oscillation`` and ``lateral_oscillation``.
    wander_mm_s, wander_tau_s : Ornstein-Uhlenbeck velocity on every axis, added to any path.
    spread : half size (x, z) of the space in which bubbles start, over half the image's width.
    pairs : bubbles come in pairs that share one path and pass each other at ``closest_mm``; they
    are ``apart_mm`` apart ``apart_s`` later.
    """

    path: Literal["zigzag", "helix", "stochastic"] = "zigzag"
    rise_mm_s: Range = (280.0, 280.0)
    lateral_mm: Range = (2.5, 3.5)
    lateral_hz: Range = (5.5, 6.5)
    wander_mm_s: float = 3.0
    wander_tau_s: float = 0.3
    height_oscillation: Oscillation = (0.177, 12.0, 0.03)
    lateral_oscillation: Oscillation = (2.0, 6.0, 0.03)
    spread: tuple[float, float] = (0.15, 0.15)
    pairs: bool = False
    closest_mm: float = 0.25
    apart_mm: float = 0.3
    apart_s: float = 0.01


@dataclass(frozen=True)
class StageConfig:
    """The stage and how it shakes.

    follow : its speed over the bubbles' mean rise; ramp_s : of the start from rest at t = 0.
    servo_* : the following error, seen by the encoder. encoder_sigma_mm, encoder_rate_hz;
    it reads 1 + encoder_scale times the travel. axis_* : views of a target at rest, or none.
    shake_mm : amplitude A; every camera's offset along the axis has RMS A / sqrt 2, across it
    ``shake_lateral`` times that. shake_* : see `telerig.io.simulation.run.motion.rig_shake`.
    accelerometers : mounted on cameras' arms (by name) or on the "carriage"; written if any.
    accelerometer_delay_s : a reading stamped t describes t - delay.
    """

    follow: float = 1.0
    ramp_s: float = 0.1
    servo_hz: float = 15.0
    servo_damping: float = 0.3
    servo_rms_mm: float = 0.1
    encoder_sigma_mm: float = 0.001
    encoder_rate_hz: float = 1000.0
    encoder_scale: float = 0.0
    axis_views: int = 0
    axis_travel_mm: float = 30.0
    shake_mm: float = 0.2
    shake_hz: float = 12.0
    shake_lateral: float = 0.5
    shake_common: float = 0.75
    shake_arm_ratio: float = 1.6
    shake_damping: float = 0.03
    force_hz: float = 60.0
    accelerometers: tuple[str, ...] = ()
    accelerometer_rate_hz: float = 2000.0
    accelerometer_density_ug: float = 22.5
    accelerometer_bias_m_s2: float = 0.2
    accelerometer_delay_s: float = 0.0


@dataclass(frozen=True)
class ImageConfig:
    """The images of a run.

    screen : brightness over full scale; screen_fixed_to : "rig" (the screen rides on the stage and
    stands still in the image) or "lab" (it stays behind). texture (RMS), gradient, vignetting:
    relative. blur_px : Gaussian sigma in focus; defocus_px_per_mm : further sigma, added in
    quadrature, per mm of depth. window_dirt : specks per image area, fixed to the lab;
    lens_dirt : specks fixed in the image. flicker : relative, from frame to frame.
    dropped : share of frames that a camera loses, told in `frames.csv`, column missing.
    pages : one multi-page file per camera.
    """

    screen: float = 0.7
    screen_fixed_to: Literal["rig", "lab"] = "rig"
    texture: float = 0.03
    gradient: float = 0.12
    vignetting: float = 0.08
    exposure_s: float = 1e-4
    blur_px: float = 0.8
    defocus_px_per_mm: float = 0.03
    window_dirt: int = 12
    lens_dirt: int = 10
    flicker: float = 0.01
    read_noise: float = 0.004
    shot_noise: float = 0.012
    bit_depth: int = 8
    left_aligned: bool = False
    dropped: float = 0.0
    pages: bool = False


@dataclass(frozen=True)
class TableConfig:
    """`detections.csv`, which stands in for images, and `references.csv`.

    centre : what the noisy pixel is of, the silhouette's area centroid or the projected centre of
    volume. missed : share of detections left out; false_per_image : added at random places.
    particle_ids : whether the table says which detection is which bubble.
    references : marks fixed to the tank that each camera sees at a time, 0 for none.
    """

    sigma_px: float = 0.1
    centre: Literal["silhouette", "volume"] = "silhouette"
    missed: float = 0.0
    false_per_image: float = 0.0
    particle_ids: bool = False
    references: int = 0
    reference_sigma_px: float = 0.1


@dataclass(frozen=True)
class RunConfig:
    """A run and its calibration; ``bubbles`` in view at a time; ``strip`` drawn into images."""

    name: str
    calibration: SimulationConfig
    frames: int = 59
    frame_rate_hz: float = 100.0
    bubbles: int = 1
    bubble: BubbleConfig = field(default_factory=BubbleConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    stage: StageConfig = field(default_factory=StageConfig)
    image: ImageConfig = field(default_factory=ImageConfig)
    table: TableConfig = field(default_factory=TableConfig)
    strip: StripConfig | None = None

    def __post_init__(self) -> None:
        """Raises InputError for values that no run can have."""
        faults = [
            ("frames", self.frames, self.frames < 1, "at least 1"),
            ("bubbles", self.bubbles, self.bubbles < 0, "0 or more"),
            ("frame_rate_hz", self.frame_rate_hz, not self.frame_rate_hz > 0, "positive"),
            ("d_eq_mm", self.bubble.d_eq_mm, not self.bubble.d_eq_mm[0] > 0, "positive"),
            ("blur_px", self.image.blur_px, not self.image.blur_px >= 0.2, "at least 0.2"),
            ("dropped", self.image.dropped, not 0 <= self.image.dropped < 1, "within 0 and 1"),
            ("bubbles", self.bubbles, self.motion.pairs and self.bubbles % 2, "even: pairs"),
        ]
        for name, value, wrong, wanted in faults:
            if wrong:
                where = f"simulation {self.name!r}"
                raise InputError(f"{name} is {value}", where=where, todo=f"must be {wanted}")


def run_preset(name: str, **changes: Any) -> RunConfig:
    """A named run, with some fields replaced: ``run_preset("swarm", frames=20, bubbles=40)``.

    Raises InputError for an unknown name or field.
    """
    if name not in RUN_PRESETS:
        raise InputError(f"no preset {name!r}", todo=f"choose one of {', '.join(RUN_PRESETS)}")
    unknown = set(changes) - set(RunConfig.__dataclass_fields__)
    if unknown:
        raise InputError(
            f"a simulated run has no setting {sorted(unknown)}",
            todo=f"choose among {', '.join(RunConfig.__dataclass_fields__)}",
        )
    return replace(RUN_PRESETS[name](), **changes)


def any_preset(name: str) -> SimulationConfig | RunConfig:
    """A named calibration or run. Raises InputError for an unknown name."""
    if name in RUN_PRESETS:
        return run_preset(name)
    if name in PRESETS:
        return preset(name)
    raise InputError(
        f"no preset {name!r}", todo=f"choose one of {', '.join([*PRESETS, *RUN_PRESETS])}"
    )


def _calibration(
    name: str, size_px: tuple[int, int], scale_px_per_mm: float, target_scale: float
) -> SimulationConfig:
    """The calibration of `paper` for cameras of another size and scale."""
    paper = preset("paper")
    ratio = scale_px_per_mm / 10
    cameras = tuple(
        CameraConfig(
            c.name,
            size_px,
            c.scale_px_per_mm * ratio,
            scale_px_per_mm,
            c.centre_offset_px,
            c.parameters,
        )
        for c in paper.cameras
    )
    pitch = 7.0 * target_scale
    target = Target(
        rows=3,
        columns=5,
        pitch_mm=(pitch, pitch),
        dot_diameter_mm=2.4 * target_scale,
        marks=((1, 2), (1, 3), (0, 2)),
        mark_diameter_mm=3.6 * target_scale,
        scale_dots=(0, 14),
    )
    reach = 15.0 * target_scale
    return replace(paper, name=name, cameras=cameras, target=target, shift_mm=(reach, reach, reach))


def _rise() -> RunConfig:
    bubble = BubbleConfig(
        modes_static={3: 0.02}, modes_oscillating={2: 0.04, 3: 0.03}, d_eq_mm=(4.0, 5.0)
    )
    return RunConfig("rise", replace(preset("paper"), name="rise"), bubble=bubble)


def _swarm() -> RunConfig:
    bubble = BubbleConfig(
        d_eq_mm=(0.8, 4.0),
        aspect=(1.0, 1.35),
        triaxial=0.04,
        modes_static={3: 0.006, 4: 0.004},
        modes_oscillating={2: 0.02, 3: 0.012},
    )
    motion = MotionConfig(
        "stochastic",
        rise_mm_s=(220.0, 280.0),
        wander_mm_s=10.0,
        lateral_oscillation=(0.8, 6.0, 0.05),
        spread=(0.9, 0.9),
    )
    return RunConfig(
        "swarm",
        _calibration("swarm", (1280, 800), 20.0, 0.8),
        frames=100,
        frame_rate_hz=500.0,
        bubbles=20,
        bubble=bubble,
        motion=motion,
        stage=StageConfig(follow=0.6, ramp_s=0.0, shake_mm=0.05),
        image=ImageConfig(window_dirt=30, lens_dirt=25, defocus_px_per_mm=0.05),
    )


def _crossing() -> RunConfig:
    bubble = BubbleConfig(d_eq_mm=(0.22, 0.24), aspect=(1.0, 1.05), triaxial=0.0)
    motion = MotionConfig(
        "stochastic",
        rise_mm_s=(280.0, 280.0),
        wander_mm_s=10.0,
        height_oscillation=(0.177, 12.0, 0.03),
        lateral_oscillation=(0.5, 6.0, 0.03),
        spread=(0.6, 0.6),
        pairs=True,
    )
    return RunConfig(
        "crossing",
        _calibration("crossing", (1280, 800), 40.0, 0.45),
        frames=30,
        frame_rate_hz=100.0,
        bubbles=10,
        bubble=bubble,
        motion=motion,
        stage=StageConfig(ramp_s=0.0, shake_mm=0.2),
        table=TableConfig(centre="volume"),
    )


def _scenario(
    name: str, frame_rate_hz: float, shake_hz: float, shake_mm: float, sigma_px: float
) -> RunConfig:
    """A benchmark of the smoother: 0.1 mm/px, 1.5 s (S0: 59 frames), everything measured."""
    size = (1024, 1024)
    calibration = replace(_calibration(name, size, 10.0, 1.0), name=name)
    motion = MotionConfig(
        "stochastic", wander_mm_s=10.0, lateral_oscillation=(2.0, 6.0, 0.03), spread=(0.5, 0.5)
    )
    stage = StageConfig(
        ramp_s=0.1, shake_hz=shake_hz, shake_mm=shake_mm, accelerometers=("left", "right")
    )
    table = TableConfig(sigma_px=sigma_px, centre="volume", particle_ids=True, references=4)
    frames = 59 if name == "S0" else round(1.5 * frame_rate_hz)
    return RunConfig(
        name, calibration, frames, frame_rate_hz, 1, motion=motion, stage=stage, table=table
    )


_SCENARIOS = {
    "S0": (100.0, 12.0, 0.2, 1.5),
    "S1": (500.0, 8.0, 0.2, 0.5),
    "S2": (500.0, 20.0, 0.2, 0.5),
    "S3": (500.0, 12.0, 0.2, 0.5),
    "S4": (1000.0, 40.0, 0.5, 0.1),
    "S5": (100.0, 8.0, 0.05, 1.5),
    "S6": (500.0, 8.0, 0.5, 0.5),
}
"""Frame rate, shake frequency, shake amplitude (mm), noise (px) of the smoother's benchmarks."""


RUN_PRESETS: Mapping[str, Callable[[], RunConfig]] = {
    "rise": _rise,
    "swarm": _swarm,
    "crossing": _crossing,
    **{name: partial(_scenario, name, *numbers) for name, numbers in _SCENARIOS.items()},
}
"""Named runs; `run_preset` makes one."""
