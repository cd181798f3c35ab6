"""Whether the axes of a sensor, or its place, contradict the images and the other sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.gravity import Gravity, axes_remedy
from telerig.estimator.sensors.image_motion import directions
from telerig.estimator.sensors.mounting import Expected, Mounting, Regression, is_clear, mounting
from telerig.estimator.smoothing.problem.problem import CARRIAGE, Accelerometer, SmoothingProblem
from telerig.estimator.smoothing.sensor_alignment.images import Images, read_at_frames, shared_rows

LogEvidence = Callable[[SmoothingProblem], float]


def mounting_findings(
    problem: SmoothingProblem, images: Images, refused: Sequence[Finding],
    log_evidence: LogEvidence,
) -> list[Finding]:  # fmt: skip
    """Return findings about sensors whose axes or place contradict the other measurements.

    The clearest contradiction comes first. Axes that gravity allows are judged by the images of the
    sensor's own camera, with the other sensors where these images prefer other axes, and a
    correction has to make all measurements together at least as likely as before; where gravity
    excludes those stated, the encoder and the other sensors, corrected so far, help to choose.
    Scales are judged by gravity alone: in a short record a bubble that swings as fast as the rig
    shakes shows any.

    refused : earlier findings. Axes are not tested without gravity.
    """
    without = {f.fix.get("sensor") for f in refused if f.code == Code.SENSOR_GRAVITY}
    sensors = [
        s
        for s in problem.accelerometers
        if s.confirmed and not s.unused_axes and s.name not in without
    ]
    read = {s.name: read_at_frames(images, s) for s in sensors}
    images = images.at_frames()
    exchanged = _exchanged(problem, images, sensors, read, log_evidence)
    if exchanged is not None:
        return [exchanged]
    axes = {s.name: s.axes for s in sensors}
    findings: list[Finding] = []

    def judge(sensor: Accelerometer) -> Mounting:
        expected = _expected(problem, images, sensor, axes, read)
        gravity = Gravity.of(sensor.reading_mm_s2)
        return mounting(sensor.axes, gravity, problem.up, *read[sensor.name], expected)

    def log_evidence_of(axes: dict[str, Array]) -> float:
        return log_evidence(
            replace(problem, accelerometers=tuple(replace(s, axes=axes[s.name]) for s in sensors))
        )

    judged = {s.name: judge(s) for s in sensors}
    for sensor in sorted(sensors, key=lambda s: -judged[s.name].lead):
        found = judge(sensor)
        if not found.clear:
            continue
        corrected = axes | {sensor.name: found.axes}
        if np.isfinite(found.lead) and log_evidence_of(corrected) < log_evidence_of(axes):
            continue
        axes = corrected
        todo, fix = axes_remedy(sensor.name, found.axes)
        words = "its axes do not fit what images, encoder and gravity show"
        where = f"accelerometer {sensor.name}"
        findings.append(Finding(words, where, todo, Code.SENSOR_AXES, fix))
    return findings


def _expected(
    problem: SmoothingProblem,
    images: Images,
    sensor: Accelerometer,
    axes: dict[str, Array],
    read: dict[str, tuple[Array, Bools]],
) -> list[Expected]:
    """Return the accelerations that a sensor should measure, by images, encoder and other
    sensors."""
    out = []
    for camera, _, seen in images.cameras:
        if sensor.camera in (camera, CARRIAGE):
            out += [
                Expected(d, seen.values[:, k], seen.known, whole=sensor.camera == camera)
                for k, d in enumerate(directions(problem.cameras[camera]))
            ]
    if images.encoder is not None:
        out.append(
            Expected(
                problem.axis,
                images.encoder.values[:, 0],
                images.encoder.known,
                whole=sensor.camera == CARRIAGE,
            )
        )
    for other in problem.accelerometers:
        if other.name != sensor.name and other.name in read:
            values, known = read[other.name]
            force = values @ axes[other.name]
            out += [Expected(d, force @ d, known, whole=False) for d in np.eye(3)]
    return out


def _exchanged(
    problem: SmoothingProblem,
    images: Images,
    sensors: Sequence[Accelerometer],
    read: dict[str, tuple[Array, Bools]],
    log_evidence: LogEvidence,
) -> Finding | None:
    """Return a finding if the records of two cameras' sensors fit better when exchanged.

    In a short record a bubble's own motion fits either; all measurements together have to, too.
    """

    def log_evidence_of(*exchanged: Accelerometer) -> float:
        others = {s.name: s for s in (*sensors, *exchanged)}
        return log_evidence(replace(problem, accelerometers=tuple(others.values())))

    for i, one in enumerate(sensors):
        for two in sensors[i + 1 :]:
            if CARRIAGE in (one.camera, two.camera) or one.camera == two.camera:
                continue
            new_one = replace(one, camera=two.camera, axes=two.axes)
            new_two = replace(two, camera=one.camera, axes=one.axes)
            if (
                _fits_exchanged(problem, images, one, two, read)
                and log_evidence_of(new_one, new_two) > log_evidence_of()
            ):
                names = f"{one.name} and {two.name}"
                return Finding(
                    "the images of each camera fit the readings of the other camera's sensor",
                    f"accelerometers {names}",
                    f"exchange mounted_on of {names}, or their records",
                    Code.SENSOR_MOUNT,
                    {"exchange": [one.name, two.name]},
                )
    return None


def _fits_exchanged(
    problem: SmoothingProblem,
    images: Images,
    one: Accelerometer,
    two: Accelerometer,
    read: dict[str, tuple[Array, Bools]],
) -> bool:
    """Return whether two cameras' sensors fit clearly better with their records exchanged."""
    known = read[one.name][1] & read[two.name][1]
    readings = np.concatenate([read[one.name][0], read[two.name][0]], 1)
    axes = {one.camera: one.axes, two.camera: two.axes}
    seen = [
        (values.values[:, k], values.known, {c: d})
        for c, _, values in images.cameras
        if c in axes
        for k, d in enumerate(directions(problem.cameras[c]))
    ]
    for differences, there, pair in images.differences(problem):
        if set(pair) == set(axes):
            weights = np.split(shared_rows(problem, *pair), 2)
            rows = (w @ directions(problem.cameras[c]) for c, w in zip(pair, weights))
            seen.append((differences, there, dict(zip(pair, rows))))
    fits = []
    for values, there, along in seen:
        fit = Regression.of(values, there & known, readings)
        if fit is not None:
            mounts = [axes[c] @ along.get(c, np.zeros(3)) for c in (one.camera, two.camera)]
            fits.append((fit, np.array([np.concatenate(mounts[::-1]), np.concatenate(mounts)])))
    return is_clear(lambda shift: sum((f.log_ratios(h, shift) for f, h in fits), np.zeros(2)))
