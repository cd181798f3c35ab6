"""A simulated run before any camera looks: bubbles, carriage and shaking arms in time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.io.simulation.config import BubbleConfig, MotionConfig, Range, RunConfig
from telerig.io.simulation.images.bodies import MODES, Bodies, bodies_about
from telerig.io.simulation.images.bubbles import Look
from telerig.io.simulation.run.motion import (
    POSITION,
    VELOCITY,
    Forces,
    Path,
    Shake,
    added_mass_along,
    constant_speed_path,
    constant_speed_rise_mm_s,
    driven_paths,
    mode_acceleration,
    rig_mode,
    rig_shake,
    stage_trajectory,
    stochastic_paths,
)
from telerig.rig.bubble_physics import (
    Liquid,
    clift_velocity,
    mendelson_velocity,
    tomiyama_velocity,
    wellek_aspect,
)
from telerig.rig.camera import Camera

AXIS_RIG = np.array([0.0, -1.0, 0.0])
"""True travel of the stage in rig axes: upwards."""
_ACROSS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_TRIES = 400
_CLEARANCE = 1.1


@dataclass(frozen=True)
class Carriage:
    """The motion of the stage on a fine time grid, from the first frame to one after the last.

    t_s, position_mm, velocity_mm_s, acceleration_mm_s2 : (N,) at the N samples of the grid.
    shake : of each of C cameras, with arrays (C, N, 3).
    stride : number of samples per frame.
    frames : which of the N samples are frames.
    """

    t_s: Array
    stride: int
    position_mm: Array
    velocity_mm_s: Array
    acceleration_mm_s2: Array
    shake: Shake

    @property
    def frames(self) -> slice:
        """Return the samples at which the cameras expose."""
        return slice(0, len(self.t_s) - 1, self.stride)


@dataclass(frozen=True)
class RunScene:
    """The truth of a simulated run with B bubbles, F frames and C cameras.

    t_s, position_mm, velocity_mm_s : (F,) times, and position and velocity of the stage.
    shake_mm, shake_mm_s : (C, F, 3) offset of each camera due to the shake, and its velocity.
    lab_mm, lab_mm_s : (B, F, 3) centres of volume in the laboratory, and their velocities.
    lab_mm_s2, forces : (B, F, 3) accelerations, and the forces; None unless the path is "forces".
    closest_s : (pairs,) time at which the two bubbles of each pair pass; empty without pairs.
    """

    config: RunConfig
    cameras: Mapping[str, Camera]
    carriage: Carriage
    population: Population
    lab_mm: Array
    lab_mm_s: Array
    closest_s: Array
    lab_mm_s2: Array | None = None
    forces: Forces | None = None

    @property
    def t_s(self) -> Array:
        """Return the times (F,) of the frames in s."""
        return self.carriage.t_s[self.carriage.frames]

    @property
    def position_mm(self) -> Array:
        """Return the carriage's travel (F,) in the frames, without the shake."""
        return self.carriage.position_mm[self.carriage.frames]

    @property
    def velocity_mm_s(self) -> Array:
        """Return the carriage's velocity (F,) in the frames."""
        return self.carriage.velocity_mm_s[self.carriage.frames]

    @property
    def shake_mm(self) -> Array:
        """Return the shake (C, F, 3) of each camera in the frames, in rig axes."""
        return self.carriage.shake.offset_mm[:, self.carriage.frames]

    @property
    def shake_mm_s(self) -> Array:
        """Return the velocity (C, F, 3) of the shake in the frames."""
        return self.carriage.shake.velocity_mm_s[:, self.carriage.frames]

    def rig_from_lab_mm(self, camera: int, frame: int) -> Array:
        """Return the vector (3,) from a lab point to its place before a moving, shaken camera.

        It is in mm along the axes of the rig: minus the stage's position and the shake.
        """
        return np.asarray(-AXIS_RIG * self.position_mm[frame] - self.shake_mm[camera, frame])

    def bodies_lab(self, frame: int, chosen: Ints) -> Bodies:
        """Return M bubbles in the laboratory frame. chosen : (M,) their indices."""
        population, t = self.population, self.t_s[frame]
        swing = np.cos(2 * np.pi * population.swing_hz[chosen] * t + population.swing_rad[chosen])
        modes = population.modes_static[chosen] + population.modes_swing[chosen] * swing
        spin = 2 * np.pi * population.spin_hz[chosen] * t + population.spin_rad[chosen]
        # lab_from_body (bubbles, 3, 3) has z along the velocity and is turned about it.
        z = _unit(self.lab_mm_s[chosen, frame])
        start = np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
        x = _unit(start - z * np.sum(start * z, -1, keepdims=True))
        y = np.cross(z, x)
        cosine, sine = np.cos(spin)[:, None], np.sin(spin)[:, None]
        rotation = np.stack([x * cosine + y * sine, y * cosine - x * sine, z], -1)
        return bodies_about(
            self.lab_mm[chosen, frame],
            rotation,
            population.semi_axes_mm[chosen],
            modes,
            d_eq_mm=population.d_eq_mm[chosen],
        )


def run_scene(config: RunConfig, cameras: Mapping[str, Camera], rng: Generator) -> RunScene:
    """Return a random run: carriage, shake, and the bubbles with their paths and shapes.

    Raises InputError when the bubbles that ``config`` asks for do not fit into the view.
    """
    stage_rng, path_rng, place_rng, shape_rng = rng.spawn(4)
    speed = config.stage.follow * _mean_rise(config.motion)
    carriage = _carriage(config, len(cameras), speed, stage_rng)
    position = carriage.position_mm[carriage.frames]
    # size_mm (2,): nominal width and height of the first camera's view.
    first = config.calibration.cameras[0]
    size_mm = np.array(first.image_size_px) / first.nominal_scale_px_per_mm
    count = _bubble_count(config, position, size_mm)
    population = random_population(config, count, shape_rng)
    if config.motion.path == "forces":
        forces = _forces(config, population, path_rng)
        paths = driven_paths(1 / config.frame_rate_hz, config.frames, forces, path_rng)
    else:
        paths, forces = _paths(config, count, path_rng), None
    lab, velocity, closest = _lab_paths(config, paths, path_rng)
    acceleration = None
    if paths.height_mm_s2 is not None and paths.lateral_mm_s2 is not None:
        acceleration = paths.height_mm_s2[..., None] * AXIS_RIG + paths.lateral_mm_s2 @ _ACROSS
    start = _starts(config, lab, position, population.d_eq_mm, size_mm, place_rng)
    return RunScene(
        config, cameras, carriage, population, lab + start[:, None], velocity, closest,
        acceleration, forces,
    )  # fmt: skip


def liquid(config: RunConfig) -> Liquid:
    """Return the run's liquid; there must be one."""
    fluid = config.fluid
    assert fluid is not None, "RunConfig checks it"
    return Liquid(
        fluid.density_kg_m3, fluid.viscosity_pa_s, fluid.surface_tension_n_m,
        config.stage.gravity_m_s2,
    )  # fmt: skip


_LAWS = {
    "clift": clift_velocity,
    "mendelson": mendelson_velocity,
    "tomiyama": tomiyama_velocity,
}


def _forces(config: RunConfig, population: Population, rng: Generator) -> Forces:
    """Return the forces on each bubble.

    Raises InputError for bubbles so small that the law does not hold.
    """
    motion, fluid, count = config.motion, liquid(config), len(population.d_eq_mm)
    assert config.fluid is not None
    d = 1e-3 * population.d_eq_mm
    drag = fluid.terminal_drag(d, _LAWS[config.fluid.law](d, fluid))
    if not np.isfinite(drag).all():
        raise InputError(
            f"bubbles of {1e3 * d[~np.isfinite(drag)].max():.2g} mm are too small for the law "
            f"{config.fluid.law!r}",
            where=f"simulation {config.name!r}",
            todo="ask for larger ones, or another law",
        )
    gravity = 1000 * config.stage.gravity_m_s2
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return Forces(
        0.75 * drag / population.d_eq_mm,
        np.array([added_mass_along(a) for a in population.aspect]),
        gravity * rng.uniform(*motion.lift, count),
        rng.uniform(*motion.lateral_hz, count),
        rng.uniform(0, 2 * np.pi, count),
        np.stack([np.cos(azimuth), np.sin(azimuth)], -1),
        gravity * motion.lift_noise,
        motion.lift_tau_s,
        gravity,
    )


def _mean_rise(motion: MotionConfig) -> float:
    rise = float(np.mean(motion.rise_mm_s))
    if motion.path in ("stochastic", "forces"):
        return rise
    amplitude = float(np.mean(motion.lateral_mm))
    both = (amplitude, amplitude if motion.path == "helix" else 0.0)
    return constant_speed_rise_mm_s(rise, float(np.mean(motion.lateral_hz)), both)


def _carriage(config: RunConfig, cameras: int, speed_mm_s: float, rng: Generator) -> Carriage:
    stage = config.stage
    rate = max(stage.encoder_rate_hz, stage.accelerometer_rate_hz if stage.accelerometers else 0)
    stride = max(1, int(np.ceil(rate / config.frame_rate_hz - 1e-9)))
    step = 1 / (config.frame_rate_hz * stride)
    steps = config.frames * stride + 1
    t = np.asarray(step * np.arange(steps), float)
    position, velocity, acceleration = stage_trajectory(t, speed_mm_s, stage.ramp_s)
    servo_rng, shake_rng = rng.spawn(2)
    if stage.servo_rms_mm > 0:
        servo = rig_mode(stage.servo_rms_mm, stage.servo_hz, stage.servo_damping, stage.force_hz)
        states = servo.paths(step, steps, servo_rng)[0]
        position, velocity = position + states[:, POSITION], velocity + states[:, VELOCITY]
        acceleration = acceleration + mode_acceleration(states, servo)
    along = np.abs(AXIS_RIG)
    rms = stage.shake_mm / np.sqrt(2) * (along + stage.shake_lateral * (1 - along))
    shake = rig_shake(
        step,
        steps,
        shake_rng,
        cameras=cameras,
        rms_mm=rms,
        frequency_hz=stage.shake_hz,
        common_share=stage.shake_common,
        arm_ratio=stage.shake_arm_ratio,
        damping=stage.shake_damping,
        force_hz=stage.force_hz,
    )
    return Carriage(t, stride, position, velocity, acceleration, shake)


def _drift(config: RunConfig, position_mm: Array) -> float:
    """Return how far bubbles rise through the view during the run, in the mean."""
    duration = (config.frames - 1) / config.frame_rate_hz
    return _mean_rise(config.motion) * duration - float(position_mm[-1] - position_mm[0])


def _passing(config: RunConfig) -> bool:
    """Whether bubbles pass through the view, or the stage follows them."""
    return config.stage.follow != 1.0


def _bubble_count(config: RunConfig, position_mm: Array, size_mm: Array) -> int:
    """Return how many bubbles exist, so that ``config.bubbles`` are in view at a time."""
    if not _passing(config):
        return config.bubbles
    height = float(size_mm[1])
    reach = height + abs(_drift(config, position_mm)) + config.bubble.d_eq_mm[1]
    pairs = 2 if config.motion.pairs else 1
    return pairs * round(config.bubbles * reach / height / pairs)


def _paths(config: RunConfig, count: int, rng: Generator) -> Path:
    """Return one path for each bubble, or for each pair."""
    motion = config.motion
    paths = count // 2 if motion.pairs else count
    random_rng, regular_rng = rng.spawn(2)
    rise = regular_rng.uniform(*motion.rise_mm_s, paths)
    regular = motion.path != "stochastic"
    still = (0.0, 1.0, 1.0)
    random = stochastic_paths(
        1 / config.frame_rate_hz,
        config.frames,
        random_rng,
        rise_mm_s=0 * rise if regular else rise,
        wander_mm_s=motion.wander_mm_s,
        wander_tau_s=motion.wander_tau_s,
        height_oscillation=still if regular else motion.height_oscillation,
        lateral_oscillation=still if regular else motion.lateral_oscillation,
    )
    if not regular or paths == 0:
        return random
    each = [_regular_path(config, float(speed), regular_rng) for speed in rise]
    return Path(
        random.height_mm + np.stack([p.height_mm for p in each]),
        random.lateral_mm + np.stack([p.lateral_mm for p in each]),
        random.height_mm_s + np.stack([p.height_mm_s for p in each]),
        random.lateral_mm_s + np.stack([p.lateral_mm_s for p in each]),
    )


def _regular_path(config: RunConfig, speed_mm_s: float, rng: Generator) -> Path:
    motion = config.motion
    amplitude = float(rng.uniform(*motion.lateral_mm))
    hand = float(rng.choice([-1.0, 1.0]))
    helix = motion.path == "helix"
    path = constant_speed_path(
        np.arange(config.frames) / config.frame_rate_hz,
        speed_mm_s,
        float(rng.uniform(*motion.lateral_hz)),
        (amplitude, amplitude if helix else 0.0),
        azimuth_rad=float(rng.uniform(0, 2 * np.pi)),
        phase_rad=float(rng.uniform(0, 2 * np.pi)),
    )
    mirror = np.array([1.0, hand])
    return Path(
        path.height_mm, path.lateral_mm * mirror, path.height_mm_s, path.lateral_mm_s * mirror
    )


def _lab_paths(config: RunConfig, paths: Path, rng: Generator) -> tuple[Array, Array, Array]:
    """Return (B, F, 3) places from each start and velocities, and when each pair passes."""
    place = paths.height_mm[..., None] * AXIS_RIG + paths.lateral_mm @ _ACROSS
    speed = paths.height_mm_s[..., None] * AXIS_RIG + paths.lateral_mm_s @ _ACROSS
    if not config.motion.pairs:
        return place, speed, np.zeros(0)
    return _pair_paths(config, place, speed, rng)


def _pair_paths(
    config: RunConfig, place: Array, speed: Array, rng: Generator
) -> tuple[Array, Array, Array]:
    """Return paths of bubbles 2k and 2k + 1 about path k, which pass on a straight line."""
    motion, pairs = config.motion, len(place)
    t = np.arange(config.frames) / config.frame_rate_hz
    middle = rng.uniform(0.25, 0.75, pairs) * t[-1]
    gap = motion.closest_mm * (across := _unit(rng.standard_normal((pairs, 3))))
    along = _unit(np.cross(across, rng.standard_normal((pairs, 3))))
    closing = np.sqrt(motion.apart_mm**2 - motion.closest_mm**2) / motion.apart_s
    half_gap = (gap[:, None] + closing * (t - middle[:, None])[..., None] * along[:, None]) / 2
    half_speed = np.broadcast_to(closing * along[:, None] / 2, speed.shape)
    shape = (2 * pairs, *place.shape[1:])
    places = np.stack([place + half_gap, place - half_gap], 1).reshape(shape)
    speeds = np.stack([speed + half_speed, speed - half_speed], 1).reshape(shape)
    return places, speeds, middle


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _starts(
    config: RunConfig, lab: Array, position: Array, d_eq: Array, size_mm: Array, rng: Generator
) -> Array:
    """Return (B, 3) offsets so that bubbles fill the view and never touch; pairs share theirs."""
    group = 2 if config.motion.pairs else 1
    rise = lab @ AXIS_RIG - position + position[0]
    some = np.unique(np.linspace(0, config.frames - 1, 60).astype(int))
    starts = np.zeros((len(lab), 3))
    for first in range(0, len(lab), group):
        member = slice(first, first + group)
        mean_rise = float(rise[member].mean())
        others = lab[:first, some] + starts[:first, None]
        least_gap = _CLEARANCE * (d_eq[:first] + d_eq[member].max()) / 2
        for _ in range(_TRIES):
            start = _start(config, size_mm, position[0], mean_rise, rng)
            gaps = [
                np.linalg.norm(others - lab[i, some] - start, axis=-1).min(-1)
                for i in range(first, first + group)
            ]
            if all(np.all(gap > least_gap) for gap in gaps):
                break
        else:
            raise InputError(
                f"{len(lab)} bubbles do not fit the view without touching each other",
                where=f"simulation {config.name!r}",
                todo="ask for fewer or smaller bubbles, or a larger spread",
            )
        starts[member] = start
    return starts


def _start(
    config: RunConfig, size_mm: Array, position_mm: float, mean_rise_mm: float, rng: Generator
) -> Array:
    width, height = size_mm
    spread = np.asarray(config.motion.spread) * width / 2
    across = rng.uniform(-1, 1, 2) * spread
    if _passing(config):
        reach = 2 * mean_rise_mm
        margin = config.bubble.d_eq_mm[1] / 2
        low, high = -height / 2 - max(reach, 0) - margin, height / 2 - min(reach, 0) + margin
        up = rng.uniform(low, high)
    else:
        up = rng.uniform(-0.5, 0.5) * height * min(config.motion.spread) - mean_rise_mm
    return np.asarray((up + position_mm) * AXIS_RIG + across @ _ACROSS)


_SURFACE_TENSION_N_M = 0.072
_DENSITY_KG_M3 = 998.0


@dataclass(frozen=True)
class Population:
    """The properties of each of B bubbles that do not change with time.

    d_eq_mm, aspect : (B,) equivalent diameter, and large over small semi-axis.
    semi_axes_mm : (B, 3) semi-axes up to a common factor, the third along the path.
    modes_static, modes_swing : (B, 21) relative amplitudes of constant and oscillating modes.
    swing_hz, swing_rad : (B, 21) frequency and phase of the oscillating modes.
    spin_hz, spin_rad : (B,) frequency and phase of the rotation about the third semi-axis.
    looks : appearance of each bubble.
    """

    d_eq_mm: Array
    aspect: Array
    semi_axes_mm: Array
    modes_static: Array
    modes_swing: Array
    swing_hz: Array
    swing_rad: Array
    spin_hz: Array
    spin_rad: Array
    looks: tuple[Look, ...]


def lamb_frequency_hz(degree: int, d_eq_mm: float) -> float:
    """Return the natural frequency of a shape mode of a bubble (Lamb, Hydrodynamics, sec. 275)."""
    radius = d_eq_mm / 2000
    n = degree
    square = (n - 1) * (n + 1) * (n + 2) * _SURFACE_TENSION_N_M / (_DENSITY_KG_M3 * radius**3)
    return float(np.sqrt(square) / (2 * np.pi))


def random_population(run: RunConfig, count: int, rng: Generator) -> Population:
    """Draw ``count`` bubbles."""
    config = run.bubble
    d_eq = rng.uniform(*config.d_eq_mm, count)
    if config.aspect == "wellek":
        aspect = wellek_aspect(liquid(run).eotvos(1e-3 * d_eq))
    else:
        aspect = rng.uniform(*config.aspect, count)
    uneven = rng.uniform(-config.triaxial, config.triaxial, count)
    axes = np.stack([1 + uneven / 2, 1 - uneven / 2, 1 / aspect], -1)
    degrees = np.array([degree for degree, _ in MODES])
    static = rng.uniform(-1, 1, (count, len(MODES)))
    swing = rng.uniform(-1, 1, (count, len(MODES)))
    for modes, amplitude in (
        (static, config.modes_static),
        (swing, config.modes_oscillating),
    ):
        modes *= np.array([amplitude.get(int(degree), 0.0) for degree in degrees])
    hertz = [[config.tone * lamb_frequency_hz(int(n), d) for n in degrees] for d in d_eq]
    phase = rng.uniform(0, 2 * np.pi, (count, len(MODES)))
    spin = rng.uniform(*config.spin_hz, count)
    turn = rng.uniform(0, 2 * np.pi, count)
    looks = tuple(_look(config, rng) for _ in range(count))
    swing_hz = np.reshape(hertz, (count, len(MODES)))
    return Population(d_eq, aspect, axes, static, swing, swing_hz, phase, spin, turn, looks)


def _look(config: BubbleConfig, rng: Generator) -> Look:
    def drawn(low_high: Range) -> float:
        return float(rng.uniform(*low_high))

    offset = config.heart_offset * rng.standard_normal(2)
    return Look(
        rim=drawn(config.rim),
        heart=drawn(config.heart),
        heart_radius=drawn(config.heart_radius),
        heart_sharpness=config.heart_sharpness,
        heart_offset=(float(offset[0]), float(offset[1])),
        ring=config.ring * float(rng.uniform(0.4, 1.4)),
    )
