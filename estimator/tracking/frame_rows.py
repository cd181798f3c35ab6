"""Frames of detections on their way to the tables: which row shows which particle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.filter.rts_smoother import Readings
from telerig.estimator.tracking.filter.types import (
    NO_PARTICLE,
    FrameIds,
    FrameMeasurements,
    Ids,
    Motion,
    SeenAlone,
)
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Pixels = tuple[Array, Array]
"""(N, 2) centres and (N, 2, 2) covariances of a view's detections."""


@dataclass(frozen=True)
class Pairs:
    """Rows of the two tables that show the same bubble.

    particle : (M,) ids given by the user, -1 where the pair was found here.
    """

    first: Ids
    second: Ids
    confidence: Array
    ambiguous: NDArray[np.bool_]
    particle: Ids

    def rows(self, camera: int) -> Ids:
        return (self.first, self.second)[camera]


@dataclass(frozen=True)
class Single:
    """A particle that one camera sees by itself: its row there, and about where it is."""

    particle: int
    camera: int
    row: int
    point_mm: Array
    d_eq_mm: float


@dataclass
class Frame:
    """offset_px : (2, 2) per camera, how far off it shows what both see; the cameras shake.

    lonely : rows of the tables without a partner; measured, alone : into and out of the tracker.

    particle : (M,) of the pairs, singles : of detections of one camera alone; once `settle`d.
    """

    number: int
    t_s: float
    tables: tuple[pd.DataFrame, pd.DataFrame]
    pixels: tuple[Pixels, Pixels]
    offset_px: Array
    pairs: Pairs
    lonely: tuple[Ids, Ids]
    measured: FrameMeasurements
    alone: SeenAlone
    motion: Motion | None
    particle: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    singles: list[Single] = field(default_factory=list)
    points_mm: Array = field(default_factory=lambda: np.zeros((0, 3)))
    covariance_mm2: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    d_eq_mm: Array = field(default_factory=lambda: np.zeros(0))

    def settle(self, ids: FrameIds) -> None:
        """Take over the tracker's final ids."""
        self.particle = ids.particle.copy()
        self.points_mm = self.measured.points_mm
        self.covariance_mm2 = self.measured.covariance_mm2
        self.d_eq_mm = self.measured.d_eq_mm
        cameras = np.repeat([0, 1], [len(rows) for rows in self.lonely])
        rows = np.concatenate(self.lonely)
        known = {int(s): k for k, s in enumerate(self.alone.single)}
        for index in np.flatnonzero(ids.single != NO_PARTICLE).tolist():
            k = known[index]
            self.singles.append(
                Single(
                    int(ids.single[index]),
                    int(cameras[index]),
                    int(rows[index]),
                    self.alone.points_mm[k],
                    float(self.alone.d_eq_mm[k]),
                )
            )

    def owners(self, camera: int) -> Ids:
        """(N,) particle of each of a camera's rows, -1 for none."""
        out = given_ids(self.tables[camera]).copy()
        taken = self.particle != NO_PARTICLE
        out[self.pairs.rows(camera)[taken]] = self.particle[taken]
        for single in self.singles:
            if single.camera == camera:
                out[single.row] = single.particle
        return out

    def column(self, particle: int) -> int:
        """Index of the particle's pair, -1 if it has none."""
        found = np.flatnonzero(self.particle == particle)
        return int(found[0]) if len(found) else -1

    def of(self, particle: int) -> list[Single]:
        return [s for s in self.singles if s.particle == particle]

    def hidden(self) -> list[Single]:
        """Particles that exactly one camera sees."""
        return [s for s in self.singles if len(self.of(s.particle)) == 1]

    def release(self, particle: int) -> None:
        """Its singles are nobody's again."""
        self.singles = [s for s in self.singles if s.particle != particle]

    def claim(
        self, particle: int, rows: tuple[int, int], point_mm: Array, covariance_mm2: Array,
        d_eq_mm: float, confidence: float,
    ) -> None:  # fmt: skip
        """The two rows are the particle's; pairs that held one of them with another are undone."""
        pairs = self.pairs
        same = (pairs.first == rows[0]) & (pairs.second == rows[1])
        if same.any():
            self.particle[same] = particle
            return
        keep = (pairs.first != rows[0]) & (pairs.second != rows[1])
        self.pairs = Pairs(
            np.append(pairs.first[keep], rows[0]),
            np.append(pairs.second[keep], rows[1]),
            np.append(pairs.confidence[keep], confidence),
            np.append(pairs.ambiguous[keep], True),
            np.append(pairs.particle[keep], NO_PARTICLE),
        )
        self.particle = np.append(self.particle[keep], particle)
        self.points_mm = np.concatenate([self.points_mm[keep], point_mm[None]])
        self.covariance_mm2 = np.concatenate([self.covariance_mm2[keep], covariance_mm2[None]])
        self.d_eq_mm = np.append(self.d_eq_mm[keep], d_eq_mm)


def given_ids(table: pd.DataFrame) -> Ids:
    """(N,) ids that came with the detections, -1 for none."""
    if "particle" not in table:
        return np.full(len(table), NO_PARTICLE)
    return table["particle"].to_numpy(np.int64)


def readings_of(
    frames: Sequence[Frame], particles: Sequence[int], cameras: tuple[Camera, Camera]
) -> Readings:
    """What the frames say of the particles, in their order."""
    place = {p: k for k, p in enumerate(particles)}
    out = Readings.none(len(frames), len(place))
    for i, frame in enumerate(frames):
        for column in np.flatnonzero(np.isin(frame.particle, list(place))):
            k = place[int(frame.particle[column])]
            out.add(i, k, frame.points_mm[column], frame.covariance_mm2[column], np.eye(3))
        for single in frame.singles:
            if single.particle not in place:
                continue
            uv, by_point, _ = stacked_jacobian((cameras[single.camera],), single.point_mm[None])
            measured, covariance = frame.pixels[single.camera]
            value = (
                measured[single.row]
                - frame.offset_px[single.camera]
                - uv[0]
                + by_point[0] @ single.point_mm
            )
            k = place[single.particle]
            out.add(i, k, value, covariance[single.row], by_point[0])
    return out
