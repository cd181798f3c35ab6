"""What a simulated calibration or run is like: every number that can be set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from telerig.errors import InputError
from telerig.rig.target import Target

Range = tuple[float, float]
Vector = tuple[float, float, float]
Oscillation = tuple[float, float, float]
"""RMS (mm), frequency (Hz), damping of a stochastic oscillation."""

GRAVITY_M_S2 = 9.80665
"""The unit g, and the gravity of a laboratory that states none; the simulator's own constant."""

MARKS_AT = 0.88
"""Where a strip of marks stands, from the image's middle over half its width."""

MARKS_JITTER = 0.25
"""Unevenness of a strip of marks, over their spacing."""


@dataclass(frozen=True)
class CameraConfig:
    """A true camera, and what the rig file will say of it.

    scale_px_per_mm : true; nominal_scale_px_per_mm : in `rig.toml`.
    centre_offset_px : of the optical axis from the image's centre.
    parameters : further true parameters by their names in `telerig.rig.lens_parameters.PARAMETERS`.
    nominal_telecentricity_per_mm : in `rig.toml`; None leaves it out.
    """

    name: str
    image_size_px: tuple[int, int] = (512, 512)
    scale_px_per_mm: float = 10.0
    nominal_scale_px_per_mm: float = 10.0
    centre_offset_px: Range = (0.0, 0.0)
    parameters: Mapping[str, float] = field(default_factory=dict)
    nominal_telecentricity_per_mm: float | None = None


@dataclass(frozen=True)
class SimulationConfig:
    """A rig, a target, hand-held poses and the quality of the images.

    Rig: each camera is turned by ``angle_deg`` about the rig's y axis against the one before, then
    by the mounting error ``mount_rotvec_deg`` (of alternating sign), which the rig file does not
    know; the optical axes pass each other at ``axis_gap_mm``. One to four cameras.

    Target: true dots are off by ``target.print_sigma_mm`` in the plane and
    ``target.flatness_sigma_mm`` out of it, times ``print_factor``. The known distance is measured
    on the true dots, within ``target.scale_sigma_mm``. Of an unbounded grid, ``margin_dots``
    beyond the block exist. ``ring_hole_ratio`` is a ring's hole over its diameter.

    Poses: the angle between each optical axis and the plate's normal is within ``tilt_deg``, the
    roll within +-``roll_deg``, the middle of the target within +-``shift_mm`` of the rig's origin
    along the rig's axes. At least ``visible_fraction`` of the dots lie wholly inside the images,
    ``border_px`` from their border, and the marks too if ``marks_visible``. All cameras see every
    view, or the groups of ``seen_by`` (names of cameras) in turn; the plate is tilted towards those
    that see it. The last ``single_camera_views`` views are seen by one camera only, in turn.

    Dot tables (no images): ``sigma_px`` per coordinate; a share ``outlier_fraction`` is off by
    ``outlier_px`` (standard deviation) besides. With ``sigma_px`` 0 the table is exact.

    Images: ``blur_px`` (Gaussian sigma); ``noise`` is that of reading over the contrast between
    dot and plate; ``shot_noise`` at full scale, over full scale; ``white``, ``black`` and
    ``background`` are fractions of full scale. ``light_gradient`` per half diagonal in a random
    direction, ``vignetting`` in the corners, ``exposure_spread`` from image to image (relative),
    ``glare`` (strength over full scale) at a random place, ``dirt`` specks per plate.
    """

    name: str
    cameras: tuple[CameraConfig, ...]
    target: Target
    views: int = 12
    angle_deg: float = 90.0
    mount_rotvec_deg: Vector = (0.4, -0.7, 0.5)
    axis_gap_mm: float = 0.3
    print_factor: float = 1.0
    margin_dots: int = 0
    plate_margin_mm: float = 4.0
    ring_hole_ratio: float = 0.4
    tilt_deg: Range = (25.0, 65.0)
    roll_deg: float = 180.0
    shift_mm: Vector = (15.0, 15.0, 15.0)
    visible_fraction: float = 1.0
    marks_visible: bool = True
    border_px: float = 6.0
    seen_by: tuple[tuple[str, ...], ...] = ()
    single_camera_views: int = 0
    sigma_px: float = 0.01
    outlier_fraction: float = 0.0
    outlier_px: float = 10.0
    blur_px: float = 0.8
    noise: float = 0.01
    shot_noise: float = 0.0
    bit_depth: int = 8
    white: float = 0.7
    black: float = 0.1
    background: float = 0.22
    light_gradient: float = 0.15
    vignetting: float = 0.1
    exposure_spread: float = 0.05
    glare: float = 0.0
    glare_radius_px: float = 20.0
    dirt: int = 0
    dirt_diameter_mm: Range = (0.1, 0.5)

    def __post_init__(self) -> None:
        """Check the fields. Raises InputError if a value is outside its range."""
        low, high = self.tilt_deg
        faults = {
            "views": (self.views < 1, "at least 1"),
            "tilt_deg": (not 0 <= low < high <= 85, "0 <= low < high <= 85"),
            "visible_fraction": (not 0 <= self.visible_fraction <= 1, "between 0 and 1"),
            "outlier_fraction": (not 0 <= self.outlier_fraction <= 1, "between 0 and 1"),
            "single_camera_views": (not 0 <= self.single_camera_views <= self.views, "0 to views"),
        }
        amounts = (
            *("sigma_px", "outlier_px", "blur_px", "noise", "shot_noise", "print_factor"),
            *("margin_dots", "dirt", "exposure_spread", "glare"),
        )
        faults |= {name: (not getattr(self, name) >= 0, "0 or more") for name in amounts}
        _refuse(self.name, {name: getattr(self, name) for name in faults}, faults)


@dataclass(frozen=True)
class BubbleConfig:
    """Sizes, shapes and looks of bubbles; a range is drawn from evenly, once for each bubble.

    d_eq_mm : diameter of the sphere of equal volume; aspect : large over small semi-axis, or
    "wellek" for that of contaminated bubbles in the run's liquid (Wellek 1966); the small one along
    the path, and half of ``triaxial`` more or less between the two large ones.
    modes_static, modes_oscillating : greatest relative amplitude of each mode of a degree
    (2, 3, 4), constant and swinging at the frequency that surface tension gives (Lamb), times
    ``tone``. spin_hz : about the small axis.
    heart_radius, heart : see `telerig.io.simulation.images.bubbles.Look`; heart 0 makes
        bubbles dark all over.
    """

    d_eq_mm: Range = (4.0, 5.0)
    aspect: Range | Literal["wellek"] = (1.3, 1.6)
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
    """Paths of the bubbles in the laboratory.

    path : "forces" integrates the equation of motion in the run's liquid (`FluidConfig`): buoyancy,
    added mass, drag, and a lift across the velocity. The lift is ``lift`` times the buoyancy,
    swinging at ``lateral_hz``, which makes the zigzag, and noise of RMS ``lift_noise`` times it,
    which forgets within ``lift_tau_s``. Sizes decide the speed; ``rise_mm_s`` tells only how many
    bubbles exist and how fast the stage is.
    "zigzag" and "helix" have a constant speed ``rise_mm_s`` along the path and the lateral
    amplitude ``lateral_mm``; "stochastic" rises at ``rise_mm_s`` in the mean, with the stochastic
    oscillations ``height_oscillation`` and ``lateral_oscillation``.
    wander_mm_s, wander_tau_s : Ornstein-Uhlenbeck velocity on every axis, added to any path.
    spread : half size (x, z) of the space in which bubbles start, over half the image's width.
    pairs : two bubbles share a path, pass at ``closest_mm``, and are ``apart_mm`` apart ``apart_s``
    later.
    """

    path: Literal["zigzag", "helix", "stochastic", "forces"] = "zigzag"
    rise_mm_s: Range = (280.0, 280.0)
    lateral_mm: Range = (2.5, 3.5)
    lateral_hz: Range = (5.5, 6.5)
    wander_mm_s: float = 3.0
    wander_tau_s: float = 0.3
    height_oscillation: Oscillation = (0.177, 12.0, 0.03)
    lateral_oscillation: Oscillation = (2.0, 6.0, 0.03)
    lift: Range = (0.25, 0.45)
    lift_noise: float = 0.1
    lift_tau_s: float = 0.02
    spread: tuple[float, float] = (0.15, 0.15)
    pairs: bool = False
    closest_mm: float = 0.25
    apart_mm: float = 0.3
    apart_s: float = 0.01


@dataclass(frozen=True)
class FluidConfig:
    """The liquid, at rest: written into rig.toml, and what drives bubbles of the path "forces".

    law : whose terminal velocity gives each bubble's drag coefficient, which depends on its size
    alone: `telerig.rig.bubble_physics`.
    """

    density_kg_m3: float = 998.2
    viscosity_pa_s: float = 1.0e-3
    surface_tension_n_m: float = 0.0728
    law: Literal["clift", "mendelson", "tomiyama"] = "clift"


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
    gravity_m_s2 : of the laboratory; written into rig.toml.
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
    gravity_m_s2: float = GRAVITY_M_S2


@dataclass(frozen=True)
class ImageConfig:
    """The images of a run.

    screen : brightness over full scale; screen_fixed_to : "rig" (the screen rides on the stage and
    stands still in the image) or "lab" (it stays behind). texture (RMS), gradient, vignetting:
    relative. blur_px : Gaussian sigma in focus; defocus_px_per_mm : further sigma, added in
    quadrature, per mm of depth. window_dirt : specks per image area, fixed to the lab;
    lens_dirt : specks fixed in the image. flicker : relative, from frame to frame.
    dropped : share of frames that a camera loses, named in the column missing of `frames.csv`.
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
    particle_ids : whether the table says which detection is which bubble. noisy_axes : whether the
    semi-axes and angles are noisy, too, as those of an outline whose centre has ``sigma_px``.
    references : marks fixed to the tank that each camera sees at a time, 0 for none.
    """

    sigma_px: float = 0.1
    centre: Literal["silhouette", "volume"] = "silhouette"
    missed: float = 0.0
    false_per_image: float = 0.0
    particle_ids: bool = False
    noisy_axes: bool = False
    references: int = 0
    reference_sigma_px: float = 0.1


@dataclass(frozen=True)
class StripConfig:
    """A strip of dots fixed to the tank for each camera, drawn into the images.

    dots : in view at a time. diameter_mm. transmission : of the ink. at, jitter : as `MARKS_AT`,
    `MARKS_JITTER`. depth_mm : its depth is drawn from -depth_mm to depth_mm.
    """

    dots: int = 6
    diameter_mm: float = 1.0
    transmission: float = 0.08
    at: float = MARKS_AT
    jitter: float = MARKS_JITTER
    depth_mm: float = 0.0


@dataclass(frozen=True)
class RunConfig:
    """A run and its calibration; ``bubbles`` in view at a time; ``strip`` drawn into images.

    fluid : the liquid; None leaves it out of rig.toml.
    """

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
    fluid: FluidConfig | None = None

    def __post_init__(self) -> None:
        """Raise InputError for values that no run can have."""
        lone = self.motion.pairs and self.bubbles % 2
        faults = {
            "frames": (self.frames < 1, "at least 1"),
            "bubbles": (self.bubbles < 0 or lone, "even: pairs" if lone else "0 or more"),
            "frame_rate_hz": (not self.frame_rate_hz > 0, "positive"),
            "d_eq_mm": (not self.bubble.d_eq_mm[0] > 0, "positive"),
            "blur_px": (not self.image.blur_px >= 0.2, "at least 0.2"),
            "dropped": (not 0 <= self.image.dropped < 1, "within 0 and 1"),
        }
        driven = self.motion.path == "forces"
        faults["fluid"] = (
            self.fluid is None and (driven or self.bubble.aspect == "wellek"),
            'given for the path "forces" and the aspect "wellek"',
        )
        faults["pairs"] = (driven and self.motion.pairs, 'False for the path "forces"')
        values = vars(self.bubble) | vars(self.image) | vars(self.motion) | vars(self)
        _refuse(self.name, values, faults)


def _refuse(name: str, values: Mapping[str, Any], faults: Mapping[str, tuple[Any, str]]) -> None:
    """Raise InputError for the first setting that is wrong; says what it must be."""
    for setting, (wrong, wanted) in faults.items():
        if wrong:
            raise InputError(
                f"{setting} is {values[setting]}",
                where=f"simulation {name!r}",
                todo=f"must be {wanted}",
            )
