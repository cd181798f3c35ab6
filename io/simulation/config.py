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
"""Place of a strip of marks: its distance from the image's middle, divided by half the width of the
image."""

MARKS_JITTER = 0.25
"""Largest deviation of a mark's place along a strip from even spacing, divided by the spacing."""


@dataclass(frozen=True)
class CameraConfig:
    """A true camera, and what `rig.toml` states about it.

    scale_px_per_mm : true scale.
    nominal_scale_px_per_mm : the scale in `rig.toml`.
    centre_offset_px : offset of the optical axis from the image's centre.
    parameters : further true parameters by their names in `telerig.rig.lens_parameters.PARAMETERS`.
    nominal_telecentricity_per_mm : the value in `rig.toml`; None leaves the key out.
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

    *Rig.* It has one to four ``cameras``. Each camera is turned by ``angle_deg`` about the rig's y
    axis relative to the camera before it, and then by the mounting error ``mount_rotvec_deg`` (with
    alternating sign), which `rig.toml` does not state. The optical axes pass each other at a
    distance of ``axis_gap_mm``.

    *Target.* The true dots deviate from the nominal ``target`` with the standard deviations
    ``print_factor * target.print_sigma_mm`` in the plane and ``print_factor *
    target.flatness_sigma_mm`` perpendicular to it. The known distance is that of the true dots plus
    an error with the standard deviation ``target.scale_sigma_mm``. An unbounded grid has
    ``margin_dots`` more rows and columns of dots on each side of the block of rows and columns. The
    plate ends ``plate_margin_mm`` beyond the dots. ``ring_hole_ratio`` is the diameter of a ring's
    hole divided by that of the ring.

    *Poses.* There are ``views`` poses. The angle between each optical axis and the plate's normal
    lies in the range ``tilt_deg``, the roll within +-``roll_deg``, and the middle of the target
    within +-``shift_mm`` of the rig's origin along each axis of the rig. At least
    ``visible_fraction`` of the dots, and all marks if ``marks_visible``, lie completely inside the
    images and ``border_px`` or more from their border. If ``seen_by`` is given, its groups (names
    of cameras) see the views in turn, and the plate is tilted towards the cameras of the group;
    otherwise all cameras see every view. Each of the last ``single_camera_views`` views is seen by
    one camera only, in turn.

    *Tables of dots, in place of images.* Each coordinate has noise of the standard deviation
    ``sigma_px``; the share ``outlier_fraction`` of the dots has a further error of the standard
    deviation ``outlier_px``. With ``sigma_px`` 0 the table is exact.

    *Images.* ``blur_px`` is the standard deviation of a Gaussian blur. ``noise`` is the standard
    deviation of the read noise divided by the contrast between dot and plate. ``shot_noise`` is the
    standard deviation of the shot noise at full scale, as a share of full scale. ``bit_depth`` is
    the number of bits of a pixel. ``white``, ``black`` and ``background`` are grey levels as shares
    of full scale. The light changes relatively by ``light_gradient`` over half the diagonal in a
    random direction, by ``vignetting`` towards the corners, and by ``exposure_spread`` (standard
    deviation) from image to image. ``glare`` is the strength, as a share of full scale, of a bright
    spot of ``glare_radius_px`` at a random place. ``dirt`` is the number of specks on the plate, of
    diameters in the range ``dirt_diameter_mm``.
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
    """Sizes, shapes and appearance of bubbles.

    For each bubble, a number is drawn from every range with equal probability.

    d_eq_mm : diameter of the sphere of equal volume.
    aspect : large over small semi-axis; "wellek" for that of contaminated bubbles in the run's
        liquid (Wellek 1966). The small semi-axis lies along the path.
    triaxial : relative difference of the two large semi-axes.
    modes_static, modes_oscillating : by degree (2, 3, 4), the largest relative amplitude of each
        shape mode that is constant, and of each that oscillates. The frequency of oscillation is
        the one that surface tension gives (Lamb), multiplied by ``tone``.
    spin_hz : rotation about the small semi-axis.
    rim, heart, heart_radius, heart_sharpness, heart_offset, ring : appearance, see
        `telerig.io.simulation.images.bubbles.Look`; with heart 0 bubbles are dark all over.
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

    path : kind of the paths.
        "forces" integrates the equation of motion in the run's liquid (`FluidConfig`): buoyancy,
        added mass, drag, and a lift across the velocity. The lift oscillates at ``lateral_hz`` with
        the amplitude ``lift`` times the buoyancy, which causes the zigzag, and has noise of the RMS
        ``lift_noise`` times the buoyancy and the correlation time ``lift_tau_s``. The speed follows
        from the sizes; ``rise_mm_s`` only determines how many bubbles there are and the speed of
        the stage.
        "zigzag" and "helix" have a constant speed ``rise_mm_s`` along the path, and a lateral
        amplitude ``lateral_mm`` at the frequency ``lateral_hz``.
        "stochastic" has the mean rise velocity ``rise_mm_s`` and the stochastic oscillations
        ``height_oscillation`` and ``lateral_oscillation``.
    wander_mm_s, wander_tau_s : RMS and correlation time of an Ornstein-Uhlenbeck velocity along
        every axis, which is added to any path.
    spread : half the size (x, z) of the space in which bubbles start, divided by half the width of
        the image.
    pairs : whether two bubbles each share a path. They pass each other at the distance
        ``closest_mm``, and are ``apart_mm`` apart ``apart_s`` later.
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
    """The liquid, which is at rest. It is written into rig.toml and drives paths of "forces".

    law : the law of the terminal velocity (`telerig.rig.bubble_physics`) from which the drag
        coefficient of each bubble follows. The coefficient depends only on the size of the bubble.
    """

    density_kg_m3: float = 998.2
    viscosity_pa_s: float = 1.0e-3
    surface_tension_n_m: float = 0.0728
    law: Literal["clift", "mendelson", "tomiyama"] = "clift"


@dataclass(frozen=True)
class StageConfig:
    """The stage and how it shakes.

    follow : speed of the stage divided by the bubbles' mean rise velocity.
    ramp_s : duration of the start from rest at t = 0.
    servo_hz, servo_damping, servo_rms_mm : frequency, damping ratio and RMS of the servo's
        following error, which the encoder measures.
    encoder_sigma_mm, encoder_rate_hz : noise and sampling rate of the encoder.
    encoder_scale : its relative scale error; it reads 1 + encoder_scale times the travel.
    scale_sigma : what rig.toml states of it, 0 for an exact encoder; None to state nothing.
    axis_views, axis_travel_mm : number of views of a target at rest from different positions of the
        stage, 0 for none, and the travel that they span.
    shake_mm : amplitude A of the shake: the offset of every camera along the axis of travel has the
        RMS A / sqrt(2).
    shake_lateral : RMS across the axis, divided by that along it.
    shake_hz, shake_common, shake_arm_ratio, shake_damping, force_hz : see
        `telerig.io.simulation.run.motion.rig_shake`.
    accelerometers : what carries an accelerometer: names of cameras, for their arms, or "carriage".
    accelerometer_rate_hz, accelerometer_density_ug, accelerometer_bias_m_s2 : sampling rate, noise
        density in micro-g per root hertz, and standard deviation of the bias.
    accelerometer_delay_s : delay of the sensors; a reading with the time t describes t - delay.
    gravity_m_s2 : gravity in the laboratory; it is written into rig.toml.
    """

    follow: float = 1.0
    ramp_s: float = 0.1
    servo_hz: float = 15.0
    servo_damping: float = 0.3
    servo_rms_mm: float = 0.1
    encoder_sigma_mm: float = 0.001
    encoder_rate_hz: float = 1000.0
    encoder_scale: float = 0.0
    scale_sigma: float | None = None
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

    screen : brightness of the backlit screen, as a share of full scale.
    screen_fixed_to : "rig" if the screen moves with the stage, so that it stands still in the
        image; "lab" if it stands still in the laboratory.
    texture, gradient, vignetting : relative variations of its brightness: RMS of a random texture,
        change over half the diagonal, loss in the corners.
    exposure_s : exposure time, during which bubbles are smeared.
    blur_px : standard deviation of the Gaussian blur in focus.
    defocus_px_per_mm : standard deviation of a further blur per mm of depth, added in quadrature.
    window_dirt : number of specks in the area of an image that are fixed to the laboratory.
    lens_dirt : number of specks that stand still in the image.
    flicker : relative standard deviation of the brightness from frame to frame.
    read_noise, shot_noise : standard deviations as shares of full scale, the latter at full scale.
    bit_depth : number of bits of a pixel.
    dropped : share of frames that a camera loses; the column missing of `frames.csv` names them.
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
    dropped: float = 0.0


@dataclass(frozen=True)
class TableConfig:
    """The tables `detections.csv`, which replaces images, and `references.csv`.

    sigma_px : standard deviation of a detection's pixel coordinates.
    centre : the point that is detected: "silhouette", the centroid of the silhouette's area, or
        "volume", the projected centre of volume.
    missed : share of bubbles that are not detected.
    false_per_image : mean number of false detections at random places.
    particle_ids : whether the table states which bubble each detection belongs to.
    noisy_axes : whether the semi-axes and angles have noise, too, as those of an outline whose
        centre has the noise ``sigma_px``.
    references : number of marks fixed to the tank that each camera sees at a time, 0 for none.
    reference_sigma_px : standard deviation of a mark's pixel coordinates.
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

    dots : number of dots in view at a time.
    diameter_mm : of a dot.
    transmission : share of light that the ink lets through.
    at, jitter : place of the strip and unevenness of the dots, as `MARKS_AT`, `MARKS_JITTER`.
    depth_mm : the depth of the strip is drawn between -depth_mm and depth_mm.
    """

    dots: int = 6
    diameter_mm: float = 1.0
    transmission: float = 0.08
    at: float = MARKS_AT
    jitter: float = MARKS_JITTER
    depth_mm: float = 0.0


@dataclass(frozen=True)
class RunConfig:
    """A run and its calibration.

    frames, frame_rate_hz : number of frames, and their rate.
    bubbles : number of bubbles in view at a time.
    bubble, motion, stage, image, table : the parts of the configuration.
    strip : strip of dots that is drawn into the images; None for none.
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
            "encoder_scale": (not abs(self.stage.encoder_scale) < 1, "between -1 and 1"),
        }
        driven = self.motion.path == "forces"
        faults["fluid"] = (
            self.fluid is None and (driven or self.bubble.aspect == "wellek"),
            'given for the path "forces" and the aspect "wellek"',
        )
        faults["pairs"] = (driven and self.motion.pairs, 'False for the path "forces"')
        parts = (self.bubble, self.image, self.motion, self.stage, self)
        values = {name: value for part in parts for name, value in vars(part).items()}
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
