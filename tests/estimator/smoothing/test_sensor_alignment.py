"""Clocks and scales of sensors and encoder, against the images of short runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from shake_runs import run_of
from sound_runs import drawn

import telerig
from telerig.estimator.sensors.findings import Finding
from telerig.estimator.smoothing.problem.problem import Accelerometer
from telerig.estimator.smoothing.smooth import _log_evidence, problem_of, with_sensors_aligned

ARMS = {"arm_left": "left", "arm_right": "right"}


def long(*cases: tuple[Any, ...]) -> Iterable[Any]:
    """Cases that repeat what others test, with other seeds or scenarios."""
    return (pytest.param(*case, marks=pytest.mark.slow) for case in cases)


def placed(
    seed: int,
    information: str,
    change: Any = None,
    *,
    every: int = 1,
    scenario: str = "S6",
    encoder: float = 1.0,
    frames: int | None = None,
    around_s: float = 2.0,
    clock: str = "unknown",
) -> tuple[dict[str, Accelerometer], list[Finding]]:
    """The sensors on the clock of the frames, and what was found."""
    run = run_of(scenario, seed, frames, around_s=around_s)
    inputs: dict[str, Any] = run.inputs(information)
    table, sensors = run.accelerometers, {}
    for name, camera in ARMS.items():
        rows = table[table["sensor"] == name]
        t = rows["t_s"].to_numpy(float)
        reading = rows[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy(float)
        if change is not None:
            t, reading = change(name, t, reading.copy())
        sensors[name] = {
            "t_s": t[::every], "a_m_s2": reading[::every], "mounted_on": camera,
            "axes": np.eye(3), "noise_density_ug_sqrt_hz": 22.5, "clock": clock,
        }  # fmt: skip
    stage = run.stage.assign(position_mm=encoder * run.stage["position_mm"])
    given = inputs | {"accelerometers": sensors, "stage": stage}
    tracks, calibration = given.pop("tracks"), given.pop("calibration")
    problem, _, _, known = problem_of(tracks, calibration, **given)
    problem, found = with_sensors_aligned(problem, known)
    return {s.name: s for s in problem.accelerometers}, found


@pytest.mark.parametrize("seed", [905, *long((906,))])
def test_a_clock_that_keeps_time_has_no_drift(seed: int) -> None:
    """Parts of a run, with readings of 0.1 s missing, may fit the images a period off."""

    def frozen(name: str, t: Any, reading: Any) -> Any:
        if name == "arm_left":
            first, last = np.searchsorted(t, [0.6, 0.7])
            reading[first:last] = reading[first]
        return t, reading

    sensors, _ = placed(seed, "one", frozen)
    assert {name: s.drift_ppm for name, s in sensors.items()} == dict.fromkeys(ARMS, 0.0)


@pytest.mark.parametrize(
    ("seed", "scenario", "information", "within", "frames"),
    [
        (905, "S6", "references", 0.02, None), (1, "S2", "one", 0.1, 300),
        *long((907, "S3", "one", 0.1, None)),
    ],
)  # fmt: skip
def test_a_wrong_rate_is_found(
    seed: int, scenario: str, information: str, within: float, frames: int | None
) -> None:
    """Beside one bubble of S3, the last third of the run alone shows no offset."""

    def fast(_: str, t: Any, reading: Any) -> Any:
        return t[0] + 1.01 * (t - t[0]), reading

    sensors, said = placed(seed, information, fast, scenario=scenario, frames=frames)
    for sensor in sensors.values():
        assert sensor.drift_ppm == pytest.approx(1e6 * (1 - 1 / 1.01), rel=within)
    assert sum("drifts by +" in f.warning for f in said) == 2


@pytest.mark.parametrize("rate", [1.0, 1.01])
def test_a_wrong_rate_of_a_clock_that_starts_with_the_frames_is_found(rate: float) -> None:
    """At 1 %, 8 ms at the end of the run, the path was RESOLVED and 3 standard deviations off."""
    sensors, said = placed(
        1, "one", lambda _, t, reading: (rate * t, reading), scenario="S2", frames=400,
        clock="frames",
    )  # fmt: skip
    for sensor in sensors.values():
        assert sensor.drift_ppm == pytest.approx(1e6 * (1 - 1 / rate), rel=0.1)
    assert sum("drifts by" in f.warning for f in said) == 2 * (rate != 1)


def test_a_sensor_of_another_time_is_left_out() -> None:
    """Its record is turned round and 1,000 s away; that of the other arm is where it belongs."""

    def elsewhere(name: str, t: Any, reading: Any) -> Any:
        return (t + 1000.0, reading[::-1]) if name == "arm_left" else (t, reading)

    sensors, said = placed(905, "one", elsewhere, frames=300, scenario="S2", around_s=0.05)
    assert list(sensors) == ["arm_right"] and sensors["arm_right"].confirmed
    assert [f.where for f in said] == ["accelerometer arm_left"]


def test_a_record_of_two_samples_leaves_the_other_sensor_aligned() -> None:
    def short(name: str, t: Any, reading: Any) -> Any:
        return (t[:2], reading[:2]) if name == "arm_left" else (t, reading)

    sensors, said = placed(905, "one", short)
    assert list(sensors) == ["arm_right"] and sensors["arm_right"].confirmed
    assert ["arm_left" in f.where for f in said if "not used" in f.words] == [True]


def test_a_sensor_slower_than_the_frames_is_told() -> None:
    _, said = placed(905, "one", every=8)
    words = [f.warning for f in said if "fewer than the 500 frames" in f.warning]
    assert len(words) == 2 and "above 125 Hz" in words[0]


def test_a_scale_that_is_roughly_known_is_taken_for_the_nearest_unit() -> None:
    """One bubble shows 1,355 ± 200 times the motion of an encoder in metres.

    25 times could be a resonance of the arms at the single line of S2.
    """
    _, said = placed(905, "one", scenario="S2", encoder=1e-3)
    assert [f.fix for f in said if f.code is not None] == [{"encoder_factor": 1e3}]


@pytest.mark.parametrize(("scenario", "information"), [("S1", "one"), *long(("S2", "references"))])
def test_a_turned_encoder_is_told_from_one_that_is_right(scenario: str, information: str) -> None:
    """By the images in three octaves, or by marks. The single line of S2 could be a resonance."""
    _, said = placed(905, information, scenario=scenario, encoder=-1.0)
    assert [f.code for f in said if f.code is not None] == ["ENCODER_SIGN"]
    _, said = placed(905, information, scenario=scenario)
    assert all(f.code is None for f in said)


def test_marks_show_the_unit_of_an_encoder_that_seems_to_stand() -> None:
    """In metres it moves by 0.4."""
    _, said = placed(906, "references", scenario="S2", encoder=1e-3)
    assert [f.fix for f in said if f.code is not None] == [{"encoder_factor": 1e3}]


def test_an_encoder_of_another_clock_unit_hardly_moves() -> None:
    """Times in microseconds: a factor would be the noise of its numbers."""
    _, said = placed(905, "one", scenario="S2", encoder=1e-9)
    (finding,) = [f for f in said if f.code is not None]
    assert finding.code == "ENCODER_SCALE" and not finding.fix
    assert "hardly any motion" in finding.warning and "t_s is in s" in finding.todo


@pytest.mark.parametrize(
    ("information", "begin_s"), [("references", 0.0), ("references", 0.8), ("one", 0.0)]
)
def test_a_stuck_encoder_whose_reading_changes_by_noise_is_refused(
    information: str, begin_s: float
) -> None:
    """Paths were RESOLVED 210 mm off. A bubble that rests in all images moves with the carriage."""
    run = run_of("S6", 905, None, around_s=2.0)
    inputs = run.inputs(information)
    rng, t = np.random.default_rng(0), run.stage["t_s"].to_numpy()
    position = run.stage["position_mm"].to_numpy().copy()
    stuck = t >= begin_s
    position[stuck] = position[stuck][0] + 1e-3 * rng.standard_normal(stuck.sum())
    given = inputs | {"accelerometers": None, "stage": run.stage.assign(position_mm=position)}
    problem, _, _, known = problem_of(given.pop("tracks"), given.pop("calibration"), **given)
    _, said = with_sensors_aligned(problem, known)
    assert [f.code for f in said if f.code is not None] == ["ENCODER_STUCK"]


def test_a_scale_that_is_no_unit_is_proposed_where_it_is_well_known() -> None:
    """By marks. Beside one bubble 4 times could be a resonance of the arms."""
    _, said = placed(906, "references", scenario="S2", encoder=1 / 4, around_s=10.0)
    (finding,) = [f for f in said if f.code is not None]
    assert finding.code == "ENCODER_SCALE"
    assert finding.fix == {"encoder_factor": pytest.approx(4.0, rel=2e-3)}


@pytest.mark.parametrize(
    ("scenario", "seed", "information", "blamed", "frames"),
    [
        ("S2", 908, "references", "accelerometer arm_left", 300),
        *long(("S3", 907, "one", "accelerometer arm_left", None)),
    ],
)
def test_an_arm_is_blamed_only_where_all_measurements_tell_it_from_the_other(
    scenario: str, seed: int, information: str, blamed: str, frames: int | None
) -> None:
    """Marks that contradict the arm are no outliers.

    In S1 one bubble tells too little of the left arm's motion along x, and what the other arm and
    the encoder do tells nothing: arms with resonances move apart in sound rigs, too.
    """

    def turned(name: str, t: Any, reading: Any) -> Any:
        return t, reading * [-1, 1, 1] if name == "arm_left" else reading

    _, said = placed(seed, information, turned, scenario=scenario, frames=frames)
    (finding,) = [f for f in said if f.code is not None]
    assert finding.code == "SENSOR_AXES" and finding.where.startswith(blamed)
    if scenario != "S1":
        assert np.array_equal(finding.fix["axes"], np.diag([-1, 1, 1]))


@pytest.mark.parametrize(
    ("scenario", "seed", "around_s"),
    [
        ("S6", 951, 10.0),
        *long(("stick-slip", 950, 0.05), ("S1", 972, 0.05), ("S1", 980, 0.05)),
    ],
)
def test_a_short_sound_run_is_no_fault(scenario: str, seed: int, around_s: float) -> None:
    """0.24 s. S6: other axes explain the accelerations better, and all measurements together worse.
    Stick-slip: arms that flex accelerate 2.5 ± 0.2 times as much as the carriage. S1: other axes of
    one arm are a little more likely than those stated.
    """
    _, said = placed(seed, "five", frames=120, scenario=scenario, around_s=around_s, clock="frames")
    assert all(f.code is None for f in said)


@pytest.mark.parametrize(
    "number",
    [12, 30, 45, 620, 643, 5004, 20206, 20446, 31102, *long((0,), (6,), (21,), (24,), (650,))],
)
def test_a_sound_run_of_an_unusual_rig_is_no_fault(number: int) -> None:
    """Arms that resonate beside a servo that hunts; 20 frames a second, whose straight lines make
    the motion in the images smaller; a pump whose harmonic moves the median of the readings by
    6 m/s^2; an encoder that shows nothing but its noise beside a bubble; a sensor on the carriage
    of arms that resonate; 0.1 s of a slow shake, which half of
    the frames' times fit as well, and which the other arm's sensor fits better beside a bubble; 0.2
    s of five bubbles, which fit an encoder 81 ms ahead 2.2 times as well as any other."""
    problem, _, _, known = problem_of(**drawn(number).inputs)
    assert all(f.code is None for f in with_sensors_aligned(problem, known)[1])


def test_the_harmonic_of_a_pump_that_marks_show_is_no_contradiction() -> None:
    """The prior of the arm's shake is too small at its frequency, and no sensor measures it."""
    assert telerig.smooth(**drawn(20582).inputs).verdict["verdict"] == "RESOLVED"


def test_a_sensor_without_a_sample_in_the_middle_of_a_run_is_left_out_of_its_likelihood() -> None:
    run = run_of("S2", 905, 60, around_s=0.05)
    given: dict[str, Any] = run.inputs("arms")
    problem = problem_of(given.pop("tracks"), given.pop("calibration"), **given)[0]
    first, *others = problem.accelerometers
    gone = replace(problem, accelerometers=(first.of(first.t_s < -1.0), *others))
    assert _log_evidence(gone) == _log_evidence(replace(problem, accelerometers=tuple(others)))


def test_samples_that_are_masked_at_the_end_of_one_record_leave_two_sensors_comparable() -> None:
    """The left arm's logger stops at the last frame; the right one's goes on."""

    def frozen(name: str, t: Any, reading: Any) -> Any:
        if name == "arm_left":
            reading[slice(*np.searchsorted(t, [0.6, 0.7]))] = reading[np.searchsorted(t, 0.6)]
        return t, reading

    sensors, _ = placed(900, "one", frozen, scenario="S3", frames=300, clock="frames")
    assert all(s.confirmed for s in sensors.values()) and len(sensors) == 2


def test_a_clock_of_the_frames_is_not_moved_by_chance() -> None:
    """A very still rig: 1.8 s seemed to fit one sensor of two 1.41 times as well as the rest."""
    problem, _, _, findings = problem_of(**drawn(20539).inputs)
    aligned, _ = with_sensors_aligned(problem, findings)[:2]
    assert [a.offset_s for a in aligned.accelerometers] == [0.0, 0.0]
    assert not any(a.confirmed for a in aligned.accelerometers)


def test_a_vibration_beyond_the_frames_does_not_shift_the_clock_of_a_run() -> None:
    """A carriage that vibrates at 17-21 Hz before frames at 20 Hz: clocks were 7.8 ms off."""
    problem, _, _, findings = problem_of(**drawn(24045).inputs)
    aligned, _ = with_sensors_aligned(problem, findings)[:2]
    assert [a.confirmed for a in aligned.accelerometers] == [True, True]
    assert all(abs(a.offset_s) < 3e-4 for a in aligned.accelerometers)
