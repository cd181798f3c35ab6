"""Frames of detections on their way to the tables: which row shows which particle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.filter.rts_smoother import Readings
from telerig.estimator.tracking.filter.types import NO_PARTICLE, FrameIds, Ids, Motion, SeenAlone
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Tables = tuple["pd.DataFrame", "pd.DataFrame"]
"""One frame's detections in the two cameras."""

Pixels = tuple[Array, Array]
"""(N, 2) centres and (N, 2, 2) covariances of a view's detections."""

COVARIANCE_MM2 = ["sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2"]
CENTRE_PX = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]


@dataclass(frozen=True)
class Pairs:
    """Rows of the two tables that show the same bubble, M of them.

    rows : (M, 2); confidence, ambiguous : (M,); given : (M,) ids given by the user, -1 where the
    pair was found here; points_mm (M, 3), covariance_mm2 (M, 3, 3), d_eq_mm (M,), NaN if unknown;
    particle : (M,) of its track, -1 for none; known once the frame is settled.
    """

    rows: Ids
    confidence: Array
    ambiguous: NDArray[np.bool_]
    given: Ids
    points_mm: Array
    covariance_mm2: Array
    d_eq_mm: Array
    particle: Ids

    def __len__(self) -> int:
        return len(self.rows)

    def of(self, keep: NDArray[np.bool_]) -> Pairs:
        return Pairs(*(getattr(self, f.name)[keep] for f in fields(self)))

    def and_also(self, other: Pairs) -> Pairs:
        both = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return Pairs(*(np.concatenate(columns) for columns in both))


@dataclass(frozen=True)
class Single:
    """A particle that one camera sees alone: its row there, and its approximate position."""

    particle: int
    camera: int
    row: int
    point_mm: Array
    d_eq_mm: float


@dataclass
class Frame:
    """offset_px : (2, 2) per camera, shift of all that both cameras see; the cameras shake.

    lonely : rows of the tables without a partner; alone : by index into these (first the first
    camera's), tracks that one camera continued. singles : those in the end, after `settle`.
    """

    number: int
    t_s: float
    tables: Tables
    pixels: tuple[Pixels, Pixels]
    offset_px: Array
    pairs: Pairs
    lonely: tuple[Ids, Ids]
    alone: Mapping[int, SeenAlone]
    motion: Motion | None
    singles: list[Single] = field(default_factory=list)

    def settle(self, ids: FrameIds) -> None:
        """Take over the tracker's final ids."""
        self.pairs.particle[:] = ids.particle
        cameras = np.repeat([0, 1], [len(rows) for rows in self.lonely])
        rows = np.concatenate(self.lonely)
        for index in np.flatnonzero(ids.single != NO_PARTICLE).tolist():
            seen = self.alone[index]
            camera, row = int(cameras[index]), int(rows[index])
            self.singles.append(
                Single(int(ids.single[index]), camera, row, seen.point_mm, seen.d_eq_mm)
            )

    @property
    def particle(self) -> Ids:
        """(M,) of the pairs."""
        return self.pairs.particle

    def owners(self, camera: int) -> Ids:
        """(N,) particle of each of a camera's rows, -1 for none."""
        out = given_ids(self.tables[camera]).copy()
        taken = self.particle != NO_PARTICLE
        out[self.pairs.rows[taken, camera]] = self.particle[taken]
        for single in self.singles:
            if single.camera == camera:
                out[single.row] = single.particle
        return out

    def of(self, particle: int) -> list[Single]:
        return [s for s in self.singles if s.particle == particle]

    def hidden(self) -> list[Single]:
        """Particles that exactly one camera sees."""
        return [s for s in self.singles if len(self.of(s.particle)) == 1]

    def release(self, particle: int) -> None:
        """Its singles belong to no track again."""
        self.singles = [s for s in self.singles if s.particle != particle]

    def claim(self, pair: Pairs) -> None:
        """Give the rows of one pair to its particle; pairs with only one of them are undone."""
        same = self.pairs.rows == pair.rows
        if same.all(1).any():
            self.particle[same.all(1)] = pair.particle
        else:
            self.pairs = self.pairs.of(~same.any(1)).and_also(pair)


def given_ids(table: pd.DataFrame) -> Ids:
    """(N,) ids that came with the detections, -1 for none."""
    if "particle" not in table:
        return np.full(len(table), NO_PARTICLE)
    return table["particle"].to_numpy(np.int64)


def readings_of(
    frames: Sequence[Frame], particles: Sequence[int], cameras: tuple[Camera, Camera]
) -> Readings:
    """The frames' measurements of the particles, in the particles' order."""
    place = {p: k for k, p in enumerate(particles)}
    out = Readings.none(len(frames), len(place))
    for i, frame in enumerate(frames):
        pairs = frame.pairs
        for column in np.flatnonzero(np.isin(pairs.particle, list(place))):
            k = place[int(pairs.particle[column])]
            out.add(i, k, pairs.points_mm[column], pairs.covariance_mm2[column], np.eye(3))
        for single in frame.singles:
            if single.particle not in place:
                continue
            uv, by_point, _ = stacked_jacobian((cameras[single.camera],), single.point_mm[None])
            measured, covariance = frame.pixels[single.camera]
            left = measured[single.row] - frame.offset_px[single.camera] - uv[0]
            value = left + by_point[0] @ single.point_mm
            out.add(i, place[single.particle], value, covariance[single.row], by_point[0])
    return out
