"""The detections and bubbles of a frame of a run, as arrays, from linking to the tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Sized
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.estimator.bubbles.outline.ellipse_geometry import columns, flag_words
from telerig.estimator.bubbles.pairing.groups import Groups, Rays, View
from telerig.estimator.bubbles.shape.body import Bodies
from telerig.estimator.bubbles.shape.sightings import Sightings, sightings_from_table
from telerig.rig.camera import Camera

NO_PARTICLE = -1

Tables = tuple["pd.DataFrame", ...]
"""One frame's detections in each camera."""

CENTRE_PX = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]


@dataclass(frozen=True)
class Seen(Rows):
    """N detections: those of a frame camera by camera, frame after frame.

    sightings : their outlines. centre_px : (N, 5) the columns CENTRE_PX as they were measured.
    unknown_px2 : (N,) variance of each coordinate of the centre by the unknown shape.
    a_px, d_eq_px : (N,) major semi-axes and equivalent diameters.
    given : (N,) ids given by the user, -1 for none. flags : (N,) texts.
    """

    sightings: Sightings
    centre_px: Array
    unknown_px2: Array
    a_px: Array
    d_eq_px: Array
    given: Ints
    flags: NDArray[Any]

    @staticmethod
    def of(table: pd.DataFrame, camera: int, view: View, cameras: Sequence[Camera]) -> Seen:
        """Return the detections of one camera. view : the same for pairing."""
        centre, (a, d_eq) = columns(table, CENTRE_PX), columns(table, ["a_px", "d_eq_px"]).T
        flags = np.array(["|".join(words) for words in flag_words(table)], object)
        return Seen(
            sightings_from_table(table, camera, cameras), centre,
            view.covariance_px2[:, 0, 0] - centre[:, 2], a, d_eq, given_ids(table), flags,
        )  # fmt: skip


def given_ids(table: pd.DataFrame) -> Ints:
    """Return the ids (N,) that came with N detections, -1 for none."""
    if "particle" not in table:
        return np.full(len(table), NO_PARTICLE)
    return table["particle"].to_numpy(np.int64)


def moved(rows: Ints, by: Ints | int) -> Ints:
    """Return the positions ``rows`` plus ``by`` (broadcast), and -1 where they are -1."""
    return np.where(rows >= 0, rows + by, -1)


@dataclass(frozen=True)
class Bubbles(Rows):
    """M bubbles, each of which at least one camera sees.

    rows : (M, C) position among the detections of the frame, -1 where a camera does not see it.
    hidden_px : (M, C, 5) as CENTRE_PX, where a camera should see it but for a bubble in front; NaN.
    confidence : (M,) probability that all detections of the bubble are its own.
    ambiguous : (M,) whether another group is nearly as probable.
    given : (M,) id that the user gave to the detections, -1 for none.
    points_mm, covariance_mm2 : (M, 3), (M, 3, 3) position of the outlines' centres with the
        covariance of a bubble of unknown shape.
    d_eq_mm : (M,) equivalent diameters, NaN where unknown.
    body : (M,) row among the bodies of the frame, -1 for none.
    particle : (M,) id of the track, -1 for none; it is known when the frame is final.
    """

    rows: Ints
    hidden_px: Array
    confidence: Array
    ambiguous: Bools
    given: Ints
    points_mm: Array
    covariance_mm2: Array
    d_eq_mm: Array
    body: Ints
    particle: Ints

    @staticmethod
    def of(
        rows: Ints, points_mm: Array, covariance_mm2: Array, given: Ints, d_eq_mm: Array
    ) -> Bubbles:
        """Return bubbles without tracks and bodies."""
        many, cameras = rows.shape
        none = np.full(many, NO_PARTICLE)
        return Bubbles(
            rows, np.full((many, cameras, 5), np.nan), np.ones(many), np.zeros(many, bool), given,
            points_mm, covariance_mm2, d_eq_mm, none, none.copy(),
        )  # fmt: skip

    @cached_property
    def alone(self) -> Bools:
        """Whether one camera alone sees the bubble (M,)."""
        return np.asarray((self.rows >= 0).sum(1) < 2)


@dataclass(frozen=True)
class Sight:
    """Hold what one frame shows: its detections, together and by themselves, their possible groups
    (G), and the bodies (G) of those that are likely without tracks, or chosen."""

    seen: Seen
    rays: Rays
    groups: Groups
    bodies: Bodies

    def together(self, chosen: Ints, groups: Groups) -> Bubbles:
        """Return M groups as bubbles. chosen : (M,) their positions among all."""
        first = np.searchsorted(self.seen.sightings.camera, np.arange(groups.rows.shape[1]))
        rows = moved(groups.rows, first)
        given = np.append(self.seen.given, NO_PARTICLE)[rows].max(1)
        sizes = self.bodies.d_eq_mm[chosen]
        bubbles = Bubbles.of(rows, groups.points_mm, groups.covariance_mm2, given, sizes)
        sure, unsure = groups.probability, groups.ambiguous
        return replace(bubbles, body=chosen, confidence=sure, ambiguous=unsure)

    def alone(self, offset_px: Array) -> Bubbles:
        """Return each detection as a bubble that no other camera sees: a point of unknown depth.

        offset_px : (C, 2) shift of all detections of each camera.
        """
        camera = self.seen.sightings.camera
        points, covariances, by_pixel = map(np.concatenate, zip(*self.rays))
        points = points - (by_pixel @ offset_px[camera, :, None])[..., 0]
        mm_per_px = np.linalg.det(by_pixel.mT @ by_pixel) ** 0.25
        rows = np.full((len(camera), len(offset_px)), -1)
        rows[np.arange(len(camera)), camera] = np.arange(len(camera))
        sizes = self.seen.d_eq_px * mm_per_px
        return Bubbles.of(rows, points, covariances, self.seen.given.copy(), sizes)


@dataclass(frozen=True)
class Motion:
    """Describe the motion of every bubble from the frame before to this frame.

    A bubble's state x (see `motion`) becomes matrix @ x + offset, plus random noise.

    matrix : (12, 12).
    noise : (12, 12) covariance of the random part.
    offset : (12,) effect of the stage's travel and of the shift that all bubbles share.
    """

    matrix: Array
    noise: Array
    offset: Array

    def shifted(self, shift: Array, covariance_mm2: Array) -> Motion:
        """Return this motion with the shift of a frame added, which all bubbles share.

        shift : (12,) is added to the offset.
        covariance_mm2 : (3, 3) covariance of the shift's position, which is added to the noise.
        """
        noise = self.noise.copy()
        noise[:3, :3] += covariance_mm2
        return Motion(self.matrix, noise, self.offset + shift)


@dataclass
class Frame:
    """One frame of a run while its tracks may still change.

    tables : its detections in each camera. seen : the same as arrays.
    offset_px : (C, 2) for each camera the shift of all detections, because the cameras shake.
    rays : each detection by itself, as `Sight.alone` returns them.
    bubbles : those that several cameras see, and those that one camera alone sees.
    bodies : the bodies of some of the bubbles.
    motion : motion of all bubbles since the frame before; None for the first frame.
    """

    number: int
    t_s: float
    tables: Tables
    seen: Seen
    offset_px: Array
    rays: Bubbles
    bubbles: Bubbles
    bodies: Bodies
    motion: Motion | None

    @property
    def particle(self) -> Ints:
        """The ids (M,) of the tracks of M bubbles, -1 for none."""
        return self.bubbles.particle

    def owners(self) -> Ints:
        """Return the id (N,) of the track of each detection, -1 for none."""
        out = self.seen.given.copy()
        taken = (self.bubbles.rows >= 0) & (self.particle != NO_PARTICLE)[:, None]
        out[self.bubbles.rows[taken]] = np.repeat(self.particle, taken.sum(1))
        return out

    def claim(self, one: Bubbles) -> None:
        """Add one bubble with its track. Earlier ones with one of its detections are removed."""
        same = (self.bubbles.rows == one.rows) & (one.rows >= 0)
        known = (self.bubbles.rows == one.rows).all(1)
        if known.any():
            self.particle[known] = one.particle
        else:
            self.bubbles = Bubbles.concat([self.bubbles.take(~same.any(1)), one])


def starts(parts: Iterable[Sized]) -> Ints:
    """Return the position (F,) of the first item of each part among those of all."""
    many = np.array([len(part) for part in parts], np.int64)
    return np.asarray(np.cumsum(many) - many)
