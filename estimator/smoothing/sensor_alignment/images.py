"""The accelerations that images and encoder show, on the grid on which sensors are compared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.accelerations import Accelerations, Grid, of_positions, of_readings
from telerig.estimator.sensors.alignment import LEAST_SAMPLES, Channel
from telerig.estimator.sensors.image_motion import accelerations, directions, frame_grid, seen_of
from telerig.estimator.smoothing.problem.problem import CARRIAGE, Accelerometer, SmoothingProblem

SLOWEST_S = 0.05
"""A pace of frames or samples above this shows no shake."""

_MOST_STEPS = 3e6


@dataclass(frozen=True)
class Images:
    """Accelerations that images and encoder show, on a common time grid.

    grid : n times.
    cameras : (camera index, "marks" or "bubbles", accelerations (n, 2)).
    encoder : acceleration (n, 1) of the carriage along its axis; None without an encoder.
    """

    grid: Grid
    cameras: tuple[tuple[int, str, Accelerations], ...]
    encoder: Accelerations | None

    @classmethod
    def of(cls, problem: SmoothingProblem) -> Images | None:
        """Return the accelerations of a problem.

        Returns None for a run that is too short, a frame rate too low to show shake, or no
        detections.
        """
        noise = _noise_mm(problem)
        pace = float(np.median(np.diff(problem.t_s)))
        if noise is None or pace > SLOWEST_S or np.ptp(problem.t_s) > _MOST_STEPS * pace:
            return None

        sensors = [s for s in problem.accelerometers if len(s.t_s) >= LEAST_SAMPLES]

        def sensed_rms(grid: Grid) -> float:
            return min(float(readings_on(grid, s).values.std(0).max()) for s in sensors)

        grid = frame_grid(problem.t_s, noise, sensed_rms if sensors else None)
        if grid.count < 8 * grid.knots:
            return None
        seen = (("marks", problem.references), ("bubbles", problem.observations))
        cameras = []
        for index, camera in enumerate(problem.cameras):
            for source, observed in seen:
                mine = observed.camera == index
                if mine.any():
                    part = observed.of(mine)
                    found = accelerations(
                        grid, problem.t_s, camera, part.item, part.frame, part.uv_px
                    )
                    if found.known.any():
                        cameras.append((index, source, found))
        stage, encoder = problem.stage, None
        if stage is not None and len(stage.t_s) > 1:
            encoder = of_positions(grid, stage.t_s, stage.position_mm[:, None])
            if not encoder.known.any() or not np.ptp(stage.position_mm) > 0:
                encoder = None
        return cls(grid, tuple(cameras), encoder) if cameras else None

    def at_frames(self) -> Images:
        """Return the same with the accelerations at the F times of frames alone."""

        def picked(shown: Accelerations) -> Accelerations:
            at = shown.grid.at_frame
            return replace(shown, values=shown.values[at], known=shown.known[at])

        cameras = tuple((index, source, picked(seen)) for index, source, seen in self.cameras)
        encoder = None if self.encoder is None else picked(self.encoder)
        return replace(self, cameras=cameras, encoder=encoder)

    def read_by(self, sensor: Accelerometer) -> tuple[Array, Bools]:
        """Return a sensor's smoothed readings (n, 3) on the grid, and which are known (n,)."""
        found = readings_on(self.grid, sensor)
        if found.grid.count < 2:
            return np.zeros((self.grid.count, 3)), np.zeros(self.grid.count, bool)
        return found.at(self.grid.t_s)

    def channels(
        self, problem: SmoothingProblem, group: Sequence[int], *, images_alone: bool = False
    ) -> list[Channel]:
        """Return the accelerations that a group of sensors has to explain: images and encoder.

        group : indices of the sensors.
        images_alone : leave out the encoder.
        """
        mounts = {i: problem.accelerometers[i].camera for i in group}
        number = {i: n for n, i in enumerate(group)}
        out = []
        for camera, _, seen in self.cameras:
            mounted = tuple(number[i] for i in group if mounts[i] in (camera, CARRIAGE))
            if mounted:
                out += [self.channel(v, seen.known, mounted) for v in seen.values.T]
        for values, known, two in self.differences(problem):
            carried = [i for i in group if mounts[i] in two]
            if {mounts[i] for i in carried} == set(two):
                out.append(self.channel(values, known, tuple(number[i] for i in carried)))
        if self.encoder is not None and not images_alone:
            values, known = self.encoder.values[:, 0], self.encoder.known
            out += [self.channel(values, known, (number[i],)) for i in group]
        return out

    def channel(self, values: Array, known: Bools, sensors: tuple[int, ...]) -> Channel:
        """Return what sensors have to explain of values (n,): those at frames, where positions
        show the same of any frequency as readings do."""
        return Channel(values, known & self.grid.at_frame, sensors, self.grid.pace)

    def differences(
        self, problem: SmoothingProblem
    ) -> Iterator[tuple[Array, Bools, tuple[int, int]]]:
        """Yield the differential accelerations of each pair of cameras along their shared
        direction, of marks and of bubbles.

        In the difference the motion of the observed points cancels.

        Yields (values (n,), known (n,), indices of both cameras).
        """
        for (first, kind, one), (second, other, two) in combinations(self.cameras, 2):
            if kind == other:
                both = np.concatenate([one.values, two.values], 1)
                values = both @ shared_rows(problem, first, second)
                yield values, one.known & two.known, (first, second)


def shared_rows(problem: SmoothingProblem, first: int, second: int) -> Array:
    """Return the combination (4,) of two cameras' image directions in which a point's motion
    cancels.
    """
    seen = np.concatenate([directions(problem.cameras[c]) for c in (first, second)])
    return np.asarray(np.linalg.svd(seen)[0][:, 3])


def along_axis(problem: SmoothingProblem, camera: int, seen: Accelerations) -> Array | None:
    """Return a camera's acceleration (n,) along the travel axis; None if it looks along that
    axis."""
    weights = seen_of(problem.cameras[camera], problem.axis)
    return None if weights is None else np.asarray(seen.values @ weights)


def _noise_mm(problem: SmoothingProblem) -> float | None:
    """Return the smaller sd of the mean position of marks or bubbles in a frame."""
    found = []
    for observed in (problem.references, problem.observations):
        if len(observed):
            scale = np.mean([c["scale_px_per_mm"] for c in problem.cameras])
            sd = np.sqrt(np.median(observed.covariance_px2[:, 0, 0])) / scale
            each = len(observed) / (len(np.unique(observed.frame)) * len(problem.cameras))
            found.append(float(sd / np.sqrt(max(each, 1.0))))
    return min(found, default=None)


def readings_on(grid: Grid, sensor: Accelerometer) -> Accelerations:
    used = sensor if sensor.kept is None else sensor.of(sensor.kept)
    readings = used.reading_mm_s2.copy()
    readings[:, list(used.unused_axes)] = 0.0
    return of_readings(grid, used.t_s, readings, sensor.t_s)


def read_at_frames(images: Images, sensor: Accelerometer) -> tuple[Array, Bools]:
    """Return a sensor's smoothed readings (F, 3) at the times of frames, and which are known."""
    values, known = images.read_by(sensor)
    return values[images.grid.at_frame], known[images.grid.at_frame]
