"""The smoother's scenarios S0-S6 (vertical axis): data of any number of runs, and the reference.

Data come from the product's simulator of motions (`telerig.io.simulation.run.motion`), the estimate
from `shake_reference`, which shares no code with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shake_reference import (
    Model,
    Part,
    Posterior,
    Readings,
    constant,
    mode,
    resonator,
    rising,
    smooth,
)

from telerig.io.simulation.run.motion import (
    LinearProcess,
    mode_acceleration,
    ornstein_uhlenbeck,
    oscillator,
    rig_mode,
)

Array = NDArray[np.float64]

MM_PER_PX = 0.1
RISE_MM_S = 280.0
ENCODER_MM = 0.001
SAMPLE_HZ = 2000.0
SAMPLE_SIGMA = 22.5e-6 * 9806.65 * np.sqrt(SAMPLE_HZ / 2)
BIAS_SIGMA = 200.0
MARKS = 4
MARK_PX = 0.1
MARK_LIFE_S = 0.3
COMMON, ARM_RATIO, DAMPING, FORCE_HZ = 0.75, 1.6, 0.03, 60.0
SERVO = (0.1, 15.0, 0.3)
ZIGZAG = (0.177, 12.0, 0.03)
WANDER = (10.0, 0.3)
INFORMATION = ("one", "five", "carriage", "arms", "references", "oracle", "rts")


@dataclass(frozen=True)
class Scenario:
    """rate_hz of frames, shake hz, amplitude A mm, noise px."""

    name: str
    rate_hz: float
    hz: float
    amplitude_mm: float
    noise_px: float
    frames: int

    @property
    def common_mm(self) -> float:
        return self.amplitude_mm * float(np.sqrt(COMMON / 2))

    @property
    def own_mm(self) -> float:
        return self.amplitude_mm * float(np.sqrt((1 - COMMON) / 2))

    @property
    def sigma_mm(self) -> float:
        return self.noise_px * MM_PER_PX

    @property
    def t_s(self) -> Array:
        return np.arange(self.frames) / self.rate_hz


SCENARIOS = {
    name: Scenario(name, *numbers)
    for name, numbers in {
        "S0": (100.0, 12.0, 0.2, 1.5, 59),
        "S1": (500.0, 8.0, 0.2, 0.5, 750),
        "S2": (500.0, 20.0, 0.2, 0.5, 750),
        "S3": (500.0, 12.0, 0.2, 0.5, 750),
        "S4": (1000.0, 40.0, 0.5, 0.1, 1500),
        "S5": (100.0, 8.0, 0.05, 1.5, 150),
        "S6": (500.0, 8.0, 0.5, 0.5, 750),
    }.items()
}


@dataclass(frozen=True)
class Runs:
    """S runs of a scenario with 5 bubbles, F frames, N samples at 2 kHz; the last axis is S.

    height, velocity, image : (5, F, S), (5, F, S), (5, 2, F, S).  servo, encoder : (F, S), the
    carriage beyond its steady rise.  offset : (2, F, S).  felt : (3, N, S) accelerometers of the
    two arms and of the carriage.  marks : (2, 4, F, S) images of references, mm.
    """

    t_s: Array
    height: Array
    velocity: Array
    image: Array
    servo: Array
    encoder: Array
    offset: Array
    felt: Array
    marks: Array


def generate(scenario: Scenario, runs: int, rng: np.random.Generator) -> Runs:
    """Runs at a steady 280 mm/s of carriage and, in the mean, of bubbles; lab heights less that."""
    thin = round(SAMPLE_HZ / scenario.rate_hz)
    steps, frames = (scenario.frames - 1) * thin + 1, scenario.frames
    h = 1 / SAMPLE_HZ

    def moved(process: LinearProcess, count: int, start: Array | None = None) -> Array:
        paths = process.paths(h, steps, rng, paths=count * runs, start_covariance=start)
        return paths.reshape(count, runs, steps, -1).transpose(0, 2, 1, 3)

    wander = moved(ornstein_uhlenbeck(*WANDER), 5, np.diag([0.0, WANDER[0] ** 2]))[:, ::thin]
    zigzag = moved(oscillator(*ZIGZAG), 5)[:, ::thin]
    servo_mode = rig_mode(*SERVO, FORCE_HZ)
    common_mode = rig_mode(scenario.common_mm, scenario.hz, DAMPING, FORCE_HZ)
    own_mode = rig_mode(scenario.own_mm, ARM_RATIO * scenario.hz, DAMPING, FORCE_HZ)
    servo, common, own = moved(servo_mode, 1)[0], moved(common_mode, 1)[0], moved(own_mode, 2)
    start = rng.uniform(-5, 5, (5, 1, runs))
    height, velocity = start + wander[..., 0] + zigzag[..., 0], wander[..., 1] + zigzag[..., 1]
    offset = common[..., 0] + own[..., 0]
    rig = (servo[..., 0] + offset)[:, ::thin]
    image = height[:, None] - rig + scenario.sigma_mm * rng.standard_normal((5, 2, frames, runs))
    rigid = mode_acceleration(servo, servo_mode) + mode_acceleration(common, common_mode)
    felt = np.concatenate([rigid + mode_acceleration(own, own_mode), rigid[None]])
    felt += BIAS_SIGMA * rng.standard_normal((3, 1, runs))
    felt += SAMPLE_SIGMA * rng.standard_normal(felt.shape)
    generation = mark_generation(scenario.t_s)
    places = rng.uniform(-40, 40, (2, MARKS, generation[-1] + 1, runs))
    marks = places[:, :, generation] - rig[:, None]
    marks += MARK_PX * MM_PER_PX * rng.standard_normal(marks.shape)
    at_frames = servo[::thin, :, 0]
    encoder = at_frames + ENCODER_MM * rng.standard_normal(at_frames.shape)
    return Runs(
        scenario.t_s, height, velocity, image, at_frames, encoder, offset[:, ::thin], felt, marks
    )


def mark_generation(t_s: Array) -> NDArray[np.int64]:
    """(F,) how often the marks in view have been replaced."""
    return np.floor((t_s - t_s[0]) / MARK_LIFE_S + 1e-9).astype(np.int64)


def parts_of(scenario: Scenario, information: str, bubbles: int) -> dict[str, Part]:
    parts: dict[str, Part] = {}
    for k in range(bubbles):
        # heights are less the steady rise, the prior of the mean velocity is 300 mm/s all the same
        parts[f"bubble{k}"] = rising(*WANDER, 100.0, 300.0)
        parts[f"zigzag{k}"] = resonator(*ZIGZAG)
    parts["servo"] = mode(*SERVO, FORCE_HZ)
    if information not in ("oracle", "rts"):
        parts["common"] = mode(scenario.common_mm, scenario.hz, DAMPING, FORCE_HZ)
        for j in range(2):
            parts[f"own{j}"] = mode(scenario.own_mm, ARM_RATIO * scenario.hz, DAMPING, FORCE_HZ)
    sensors = {"arms": (0, 1), "carriage": (2,)}.get(information, ())
    parts |= {f"bias{i}": constant(BIAS_SIGMA) for i in sensors}
    if information == "references":
        parts |= {f"mark{j}{m}": constant(100.0) for j in range(2) for m in range(MARKS)}
    return parts


@dataclass(frozen=True)
class Reference:
    """model, posterior at the frames, and rows that read bubble k's height and velocity."""

    model: Model
    posterior: Posterior

    def row(self, what: str, bubble: int = 0) -> Array:
        return self.model.read(what, f"bubble{bubble}", f"zigzag{bubble}")

    def offset_row(self, camera: int) -> Array:
        return self.model.read("position", "common", f"own{camera}")


def reference(
    scenario: Scenario,
    information: str,
    runs: Runs,
    *,
    parts: Callable[[Scenario, str, int], dict[str, Part]] = parts_of,
    real: type = np.float64,
) -> Reference:
    """The reference smoother with one of the information sets, true hyper-parameters.

    parts : may replace "servo" by a height anew at each frame, about what the encoder reads there,
    or add a "carriage" of free motion, about the encoder's first reading.
    """
    bubbles = 5 if information == "five" else 1
    model = Model(parts(scenario, information, bubbles))
    thin = round(SAMPLE_HZ / scenario.rate_hz)
    sampled = information in ("arms", "carriage")
    frames = np.arange(scenario.frames) * (thin if sampled else 1)
    times = np.arange(frames[-1] + 1) / (SAMPLE_HZ if sampled else scenario.rate_hz)
    moving = [name for name in ("carriage", "servo") if name in model.parts]
    nominal = runs.encoder * model.parts["servo"].anew
    if "carriage" in model.parts:
        nominal = runs.encoder[:1]
    readings = Readings()
    readings.add(frames, model.read("position", *moving), runs.encoder - nominal, ENCODER_MM)
    for j in range(2):
        rig = model.read("position", *moving)
        seen = runs.image + nominal
        if information == "oracle":
            seen = seen + runs.offset[j]
        elif information != "rts":
            rig = rig + model.read("position", "common", f"own{j}")
        for k in range(bubbles):
            row = model.read("position", f"bubble{k}", f"zigzag{k}") - rig
            readings.add(frames, row, seen[k, j], scenario.sigma_mm)
        if information == "references":
            for m in range(MARKS):
                row = model.read("value", f"mark{j}{m}") - rig
                readings.add(frames, row, runs.marks[j, m] + nominal, MARK_PX * MM_PER_PX)
        if information == "arms":
            row = model.read("acceleration", *moving, "common", f"own{j}")
            row = row + model.read("value", f"bias{j}")
            readings.add(range(len(times)), row, runs.felt[j], SAMPLE_SIGMA)
    if information == "carriage":
        row = model.read("acceleration", *moving, "common") + model.read("value", "bias2")
        readings.add(range(len(times)), row, runs.felt[2], SAMPLE_SIGMA)
    renewed = {}
    if information == "references":
        changes = np.flatnonzero(np.diff(mark_generation(scenario.t_s))) + 1
        names = tuple(f"mark{j}{m}" for j in range(2) for m in range(MARKS))
        renewed = {int(frames[n]): names for n in changes}
    return Reference(model, smooth(model, times, readings, frames, renewed=renewed, real=real))


def middle(frames: int) -> slice:
    """The middle 80 % of the frames."""
    return slice(round(0.1 * frames), round(0.9 * frames))


def naive(runs: Runs) -> tuple[Array, Array]:
    """(F, S) height of the first bubble by triangulation and encoder, velocity by differences."""
    height = runs.image[0].mean(0) + runs.encoder
    return height, np.gradient(height, runs.t_s, axis=0)
