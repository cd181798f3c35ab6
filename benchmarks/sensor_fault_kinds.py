"""Faults of sensors and clocks, as a user would make them: each changes the arguments of
`telerig.smooth`.

`FAULTS` lists them; `inputs_of` makes the arguments of an undisturbed run, and `repaired` applies
the correction that an error of `telerig.smooth` proposes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from shake_cases import SAMPLE_HZ
from shake_scene import Run, description

from telerig.rig.units import STANDARD_GRAVITY_M_S2

Array = NDArray[np.float64]
Inputs = dict[str, Any]
Change = Callable[[Inputs, Generator], None]

CONFIGURATIONS = ("one", "five", "marks")
ARMS = {"arm_left": "left", "arm_right": "right"}
READING, TIME = "a_m_s2", "t_s"


@dataclass(frozen=True)
class Fault:
    """A fault of an input.

    group : "clock", "unit", "axes", "samples", "encoder" or "frames".  words : what is wrong.
    change : changes the arguments in place.  names : words of which a message that names the cause
    has at least one, in lower case.  hidden : configurations in which design 7 says that nothing in
    the data can show the fault.
    """

    name: str
    group: str
    words: str
    change: Change
    names: tuple[str, ...]
    hidden: tuple[str, ...] = ()


def inputs_of(run: Run, configuration: str, clock: str) -> Inputs:
    """Arguments of `telerig.smooth` with arm accelerometers as mappings.

    configuration : one of ``CONFIGURATIONS``; marks are seen beside one bubble.
    clock : "frames" or "unknown", which the mappings state.
    """
    information = {"marks": "references"}.get(configuration, configuration)
    inputs = run.inputs(information)
    table = run.accelerometers
    sensors = {}
    for name, camera in ARMS.items():
        rows = table[table["sensor"] == name]
        sensors[name] = {
            TIME: rows["t_s"].to_numpy(float),
            READING: rows[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy(float),
            "mounted_on": camera,
            "axes": np.eye(3),
            "noise_density_ug_sqrt_hz": 22.5,
            "clock": clock,
        }
    return inputs | {"accelerometers": sensors, "stage": run.stage.copy()}


def copied(inputs: Inputs) -> Inputs:
    """Arguments whose tables and sensors can be changed without changing the given ones."""
    sensors = {name: dict(sensor) for name, sensor in inputs["accelerometers"].items()}
    tables = {key: inputs[key].copy() for key in ("tracks", "stage")}
    return inputs | tables | {"accelerometers": sensors}


def _sensors(change: Callable[[Inputs, Generator], None], *names: str) -> Change:
    def applied(inputs: Inputs, rng: Generator) -> None:
        for name in names or tuple(ARMS):
            change(inputs["accelerometers"][name], rng)

    return applied


def _late(by_s: float, *names: str, ppm: float = 0.0) -> Change:
    """Stamps that are late by so much, and drift from the record's begin."""

    def shifted(sensor: Inputs, rng: Generator) -> None:
        t = sensor[TIME]
        sensor[TIME] = t + by_s + 1e-6 * ppm * (t - t[0])

    return _sensors(shifted, *names)


def _sampled(up: int, down: int) -> Change:
    """The same motion recorded at another rate."""

    def resampled(sensor: Inputs, rng: Generator) -> None:
        from scipy.signal import resample_poly

        reading, t = sensor[READING], sensor[TIME]
        middle = reading.mean(0)
        sensor[READING] = resample_poly(reading - middle, up, down, axis=0) + middle
        sensor[TIME] = t[0] + np.arange(len(sensor[READING])) * down / (up * SAMPLE_HZ)

    return _sensors(resampled)


def _readings(change: Callable[[Array, Array, Generator], Array], *names: str) -> Change:
    """change : of readings (N, 3) at times (N,)."""

    def changed(sensor: Inputs, rng: Generator) -> None:
        sensor[READING] = change(sensor[READING].copy(), sensor[TIME], rng)

    return _sensors(changed, *names)


def _times(factor: float, *names: str) -> Change:
    return _readings(lambda a, t, rng: factor * a, *names)


def _turned(rows: Any, *names: str) -> Change:
    return _readings(lambda a, t, rng: a @ np.asarray(rows, float).T, *names)


def _without_gravity(share: float, *names: str) -> Change:
    """share : of the mean reading that is taken away; -1 doubles it."""
    return _readings(lambda a, t, rng: a - share * a.mean(0), *names)


def _swapped(inputs: Inputs, rng: Generator) -> None:
    sensors = inputs["accelerometers"]
    left, right = (sensors[name] for name in ARMS)
    left["mounted_on"], right["mounted_on"] = right["mounted_on"], left["mounted_on"]


def _spiked(a: Array, t: Array, rng: Generator) -> Array:
    """One sample in the middle of the run off by 300 m/s^2."""
    a[np.searchsorted(t, 0.7)] += 300.0 * rng.choice([-1, 1], 3)
    return a


def _crackling(a: Array, t: Array, rng: Generator) -> Array:
    """0.3 % of the samples off by up to 100 m/s^2."""
    hit = np.flatnonzero(rng.random(len(a)) < 3e-3)
    a[hit] += rng.uniform(-100, 100, (len(hit), 3))
    return a


def _frozen(a: Array, t: Array, rng: Generator) -> Array:
    """The last reading repeated for 0.1 s."""
    first, last = np.searchsorted(t, [0.6, 0.7])
    a[first:last] = a[first]
    return a


def _shifted(a: Array, t: Array, rng: Generator) -> Array:
    """3 m/s^2 too much along all axes for 10 ms, as of a cable that is touched."""
    a[slice(*np.searchsorted(t, [0.6, 0.61]))] += 3.0
    return a


def _gap(sensor: Inputs, rng: Generator) -> None:
    """No samples for 0.1 s."""
    t = sensor[TIME]
    kept = (t < 0.6) | (t > 0.7)
    sensor[TIME], sensor[READING] = t[kept], sensor[READING][kept]


def _repeated(sensor: Inputs, rng: Generator) -> None:
    """0.2 % of the samples have the stamp of the sample before; two are a little earlier."""
    t = sensor[TIME].copy()
    again = rng.choice(np.arange(10, len(t)), len(t) // 500, replace=False)
    t[again] = t[again - 1]
    inside = np.searchsorted(t, [0.5, 0.9])
    t[inside] = t[inside - 1] - 2e-4
    sensor[TIME] = t


def _encoder(change: Callable[[Array, Array], Array]) -> Change:
    def changed(inputs: Inputs, rng: Generator) -> None:
        table = inputs["stage"]
        position = change(table["position_mm"].to_numpy(float).copy(), table["t_s"].to_numpy())
        inputs["stage"] = table.assign(position_mm=position)

    return changed


def _stuck(p: Array, t: Array) -> Array:
    return np.where(t >= 0.6, p[np.searchsorted(t, 0.6)], p)


def _jumping(p: Array, t: Array) -> Array:
    p[np.searchsorted(t, 0.7)] += 5.0
    return p


def _scaled(inputs: Inputs, rng: Generator) -> None:
    """1 % too much; nobody has stated that the scale is exact."""
    _encoder(lambda p, t: 1.01 * p)(inputs, rng)
    inputs["rig"] = description(None)


def _frames(factor: float) -> Change:
    def changed(inputs: Inputs, rng: Generator) -> None:
        inputs["t_s"] = factor * np.asarray(inputs["t_s"])
        inputs["tracks"] = inputs["tracks"].assign(t_s=lambda table: factor * table["t_s"])

    return changed


_SENSOR = ("arm_left", "arm_right", "accelerometer")
_ENCODER = ("encoder", "stage", "position_mm")
_FRAMES = ("frame times", "frames.csv", "frame_times", "t_s", "frame rate")
_SWAP_XY = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]

FAULTS = {
    fault.name: fault
    for fault in (
        Fault("clock -60 ms", "clock", "stamps 60 ms early", _late(-0.06), _SENSOR),
        Fault("clock 60 ms", "clock", "stamps 60 ms late", _late(0.06), _SENSOR),
        Fault("clock 300 ms", "clock", "stamps 300 ms late", _late(0.3), _SENSOR),
        Fault("clock -2 s", "clock", "stamps 2 s early", _late(-2.0), _SENSOR),
        Fault("clock 17 s", "clock", "stamps 17 s late", _late(17.0), _SENSOR),
        Fault("clock of one arm", "clock", "left arm 60 ms late", _late(0.06, "arm_left"), _SENSOR),
        Fault("drift", "clock", "200 ppm from the record's begin", _late(0, ppm=200), _SENSOR),
        Fault("1 % fast", "clock", "stamps made with a wrong rate", _late(0, ppm=1e4), _SENSOR),
        Fault("1600 Hz", "clock", "another sampling rate", _sampled(4, 5), _SENSOR),
        Fault("400 Hz", "clock", "a low sampling rate", _sampled(1, 5), _SENSOR),
        Fault("in g", "unit", "given as m/s^2", _times(1 / STANDARD_GRAVITY_M_S2), _SENSOR),
        Fault("in mg", "unit", "given as m/s^2", _times(1e3 / STANDARD_GRAVITY_M_S2), _SENSOR),
        Fault("in mm/s^2", "unit", "given as m/s^2", _times(1e3), _SENSOR),
        Fault("x and y swapped", "axes", "left arm", _turned(_SWAP_XY, "arm_left"), _SENSOR),
        Fault("x and z swapped", "axes", "left arm", _turned([[0, 0, 1], [0, 1, 0], [1, 0, 0]],
              "arm_left"), _SENSOR),
        Fault("sign turned", "axes", "left arm, all axes", _times(-1.0, "arm_left"), _SENSOR),
        Fault("sign of x turned", "axes", "left arm", _turned(np.diag([-1, 1, 1]), "arm_left"),
              _SENSOR),
        Fault("arms swapped", "axes", "each is said to be on the other arm", _swapped, _SENSOR),
        Fault("gravity missing", "axes", "both arms, as of an AC-coupled logger",
              _without_gravity(1.0), _SENSOR),
        Fault("gravity doubled", "axes", "left arm", _without_gravity(-1.0, "arm_left"), _SENSOR),
        Fault("clipped", "samples", "both arms at 9.9 m/s^2",
              _readings(lambda a, t, rng: a.clip(-9.9, 9.9)), _SENSOR),
        Fault("one spike", "samples", "left arm, 300 m/s^2", _readings(_spiked, "arm_left"),
              _SENSOR),
        Fault("spikes", "samples", "0.3 % of both arms' samples, to 100 m/s^2",
              _readings(_crackling), _SENSOR),
        Fault("frozen", "samples", "left arm for 0.1 s", _readings(_frozen, "arm_left"), _SENSOR),
        Fault("shifted", "samples", "left arm for 10 ms, by 3 m/s^2",
              _readings(_shifted, "arm_left"), _SENSOR),
        Fault("gap", "samples", "left arm for 0.1 s", _sensors(_gap, "arm_left"), _SENSOR),
        Fault("repeated stamps", "samples", "0.2 % of both arms', two of them backward",
              _sensors(_repeated), _SENSOR),
        Fault("encoder sign", "encoder", "turned", _encoder(lambda p, t: -p), _ENCODER,
              ("one", "five")),
        Fault("encoder in metres", "encoder", "given as mm", _encoder(lambda p, t: p / 1000),
              _ENCODER, ("one", "five")),
        Fault("encoder in inches", "encoder", "given as mm", _encoder(lambda p, t: p / 25.4),
              _ENCODER, ("one", "five")),
        Fault("encoder stuck", "encoder", "from the middle of the run on", _encoder(_stuck),
              _ENCODER),
        Fault("encoder spike", "encoder", "one reading off by 5 mm", _encoder(_jumping), _ENCODER),
        Fault("encoder scale", "encoder", "1 % too much", _scaled, _ENCODER, ("one", "five")),
        Fault("frames in ms", "frames", "given as s", _frames(1e3), _FRAMES),
        Fault("frame times halved", "frames", "twice the true rate", _frames(0.5), _FRAMES),
        Fault("frame times doubled", "frames", "half the true rate", _frames(2.0), _FRAMES),
    )
}  # fmt: skip


def repaired(inputs: Inputs, fix: Mapping[str, Any]) -> Inputs | None:
    """The arguments with the correction that a finding proposes; None for a key that is unknown.

    fix : as `telerig.estimator.sensors.findings.Finding` describes it.
    """
    out, left = copied(inputs), dict(fix)
    if "exchange" in left:
        one, two = (out["accelerometers"][name] for name in left.pop("exchange"))
        one["mounted_on"], two["mounted_on"] = two["mounted_on"], one["mounted_on"]
    if left.get("sensor") == "encoder":
        left["encoder_offset_s"] = -left.pop("offset_s", 0.0)
        left.pop("sensor")
    if "sensor" in left:
        sensor = out["accelerometers"][left.pop("sensor")]
        if "unit" in left:
            sensor["a"], sensor["unit"] = sensor.pop(READING, sensor.get("a")), left.pop("unit")
        if "axes" in left:
            sensor["axes"] = left.pop("axes")
        key = READING if READING in sensor else "a"
        sensor[key] = sensor[key] + np.asarray(left.pop("add_m_s2", 0.0))
        sensor[TIME] = sensor[TIME] + left.pop("offset_s", 0.0)
    if "encoder_factor" in left:
        table = out["stage"]
        factor = left.pop("encoder_factor")
        out["stage"] = table.assign(position_mm=factor * table["position_mm"])
    if "encoder_offset_s" in left:
        shift = left.pop("encoder_offset_s")
        out["stage"] = out["stage"].assign(t_s=lambda table: table["t_s"] - shift)
    if "frame_time_factor" in left:
        _frames(left.pop("frame_time_factor"))(out, np.random.default_rng(0))
    return None if left or not fix else out
