"""Dots fixed to the tank followed through a run, and erased from its bubble images.

The camera's shake shifts all dots of a frame alike against the stage's position. The shift of a
frame is the most likely one: most dots agree on it, and it is near the last one. Where another
shift is nearly as likely, such as one spacing further on an evenly spaced strip, the dots cannot be
told apart, and following starts again with new marks.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.errors import GeometryError
from telerig.estimator.dots.thresholds import (
    DOT_LOST,
    FALSE,
    LEAST_FRAMES,
    OUTLIER_SD,
    TOUCHED,
    WRONG_ODDS,
)
from telerig.estimator.marks.strip_dots import DotLook, DotSightings
from telerig.rig.camera import Camera


@dataclass(frozen=True)
class TankView:
    """Coordinates of the tank as one camera sees it: (2,) in mm, along and across the travel.

    axis_rig : (3,) direction of the stage's travel in rig axes.
    basis : (2, 3) unit vectors of the coordinates in rig axes, perpendicular to the ray of the
        image's middle.
    origin : (3,) point of this ray in the rig frame, in mm.
    """

    camera: Camera
    axis_rig: Array
    basis: Array
    origin: Array

    @staticmethod
    def of(camera: Camera, axis_rig: Array) -> TankView:
        """Return the coordinates for a camera.

        Raises GeometryError for a camera that looks along the travel.
        """
        width, height = camera.image_size_px
        origin, ray = camera.unproject(np.array([(width - 1) / 2, (height - 1) / 2]))
        along = axis_rig - ray * (axis_rig @ ray)
        if np.linalg.norm(along) < 0.1:
            raise GeometryError(
                f"camera {camera.name!r} looks along the stage's travel, so marks fixed to the "
                "tank do not pass through its image",
                todo="check [stage] axis in rig.toml, or leave out [references]",
            )
        along = along / np.linalg.norm(along)
        return TankView(camera, axis_rig, np.stack([along, np.cross(ray, along)]), origin)

    @property
    def px_per_mm(self) -> float:
        """The scale in px/mm in the middle of the image."""
        steps = self.origin + 1e-2 * np.concatenate([self.basis, -self.basis])
        uv = self.camera.project(steps)
        return float(np.sqrt(abs(np.linalg.det((uv[:2] - uv[2:]) / 2e-2))))

    @property
    def travel_px_per_mm(self) -> Array:
        """How far the tank moves in the image, (2,) in px, per mm of travel, in its middle."""
        step_mm = 1e-3
        before, after = (self.origin + s * step_mm * self.axis_rig for s in (1, -1))
        return (self.camera.project(after) - self.camera.project(before)) / (2 * step_mm)

    def lab_mm(self, uv_px: Array, position_mm: float) -> Array:
        """Return the places (n, 2) in mm on the tank of pixels (n, 2).

        position_mm : position of the stage.
        """
        if not len(uv_px):
            return np.zeros((0, 2))
        rig = self.camera.unproject(uv_px)[0] - self.origin
        return np.asarray((rig + self.axis_rig * position_mm) @ self.basis.T)

    def pixels(self, lab_mm: Array, position_mm: float) -> Array:
        """Return the pixels (n, 2) of places (n, 2) in mm on the tank.

        position_mm : position of the stage.
        """
        if not len(lab_mm):
            return np.zeros((0, 2))
        across = lab_mm - self.basis @ self.axis_rig * position_mm
        return np.asarray(self.camera.project(self.origin + across @ self.basis))

    def in_image(
        self, lab_mm: Array, position_mm: float, margin_px: float = 0.0
    ) -> tuple[list[int], Array]:
        """Return the indices of marks in the image or a margin round it, and their pixels (k, 2).

        lab_mm : (n, 2) places of the marks in the strip's plane. position_mm : of the stage.
        """
        width, height = self.camera.image_size_px
        offset = lab_mm - self.basis @ self.axis_rig * position_mm
        reach = 0.6 * np.hypot(width, height) / self.px_per_mm
        near = np.flatnonzero(np.linalg.norm(offset, axis=1) < reach)
        uv = self.pixels(lab_mm[near], position_mm)
        low, high = -margin_px, np.array([width, height]) - 1 + margin_px
        inside = np.all((uv > low) & (uv < high), axis=1)
        return near[inside].tolist(), uv[inside]


HIDDEN = "hidden, touched by a bubble, or unlike the other dots"
BORDER = "cut by the image's border"
MOVED = "off its place against the other dots"
AMBIGUOUS = "the strip's motion between two frames is ambiguous"
LOST = "no dot is where it was expected"

_FIRST_STEP_MM = 0.3
_LEAST_STEP_MM = 0.1
_LEARN = 0.1
_UNMATCHED, _MISSED, _SURE = (-float(np.log(p)) for p in (FALSE, DOT_LOST, WRONG_ODDS))
"""Log-likelihood that a stray dot, a mark in view without a dot, and a second shift cost at most:
with the probabilities by which the dots of a target are numbered."""
_TOLERANCE = 0.06
"""Standard deviation of a dot's place against the other dots', in diameters."""
_PLACE_PX = 0.1
_FORGET, _MOVED_PX = 50, 2.0
_FIRST_SHARE = 0.2


@dataclass
class Mark:
    """A dot, fixed to the tank, that one camera follows.

    number : identifies the mark within the camera.
    place_mm : (2,) on the tank, see `TankView`.
    epoch : index of the part of the run in which the mark is followed without a break.
    last_frame : the last frame in which it was measured.
    low_px, high_px : (2,) smallest and largest u and v at which it was measured.
    sightings : number of frames in which it was measured.
    left_out : number of frames in which it was not measured, for each reason.
    """

    number: int
    place_mm: Array
    epoch: int
    last_frame: int
    low_px: Array
    high_px: Array
    sightings: int = 0
    left_out: Counter[str] = field(default_factory=Counter)

    @property
    def travelled_px(self) -> float:
        """Return the length of the way that the mark has moved in the image, in px."""
        return float(np.linalg.norm(self.high_px - self.low_px))

    @property
    def always_seen(self) -> bool:
        """Whether the dot was measured in every frame in which it was whole in the image."""
        return not self.left_out[HIDDEN]


@dataclass(frozen=True)
class _Shift:
    """mm : (2,) of this frame. pairs : (dot, mark) that agree on it. sure : no other is as good."""

    mm: Array
    pairs: list[tuple[int, int]]
    sure: bool


class Follower:
    """Follows the dots of the strip through the frames of one camera.

    diameter_mm : diameter of a dot.
    margin_px : least distance of a whole dot's centre from the border of the image.
    held_mm : position of the stage that is assumed until one is known: the first known one, so that
        a record that begins late is no travel.
    """

    def __init__(
        self,
        view: TankView,
        *,
        diameter_mm: float,
        margin_px: float,
        frame_count: int,
        held_mm: float = 0.0,
    ) -> None:
        self.view, self.diameter_mm, self.margin_px = view, diameter_mm, margin_px
        self.marks: list[Mark] = []
        self.finished: list[Mark] = []
        self.shift_mm = np.full((frame_count, 2), np.nan)
        self.epoch_starts = [0]
        self.breaks: list[tuple[int, str]] = []
        self._scale = view.px_per_mm
        self._number = 0
        self._last: tuple[int, Array, bool] | None = None
        self._speed = np.zeros(2)
        self._step_mm: float | None = None
        self._held_mm = held_mm

    def add(
        self, frame: int, dots: DotSightings, position_mm: float | None
    ) -> list[tuple[int, int]]:
        """Take the dots of the next frame, and return which of them are which marks.

        Frames have to come in order. dots : the n dots of the frame. position_mm : position of the
        stage, None or NaN if unknown.
        Returns pairs (index of the dot, number of the mark).
        """
        known = position_mm is not None and bool(np.isfinite(position_mm))
        if known and position_mm is not None:
            self._held_mm = position_mm
        if self._last is not None and self._last[2] != known:
            self._restart(frame, "the stage's record begins or ends")
        place = self.view.lab_mm(dots.uv_px, self._held_mm)
        if not len(place):
            self._count_missing(frame, [], known)
            return []
        predicted, sd = self._prediction(frame, place, known)
        if self.marks:
            shift = self._best(place, predicted, sd)
            if shift is not None and shift.sure:
                self._learn(shift.mm - predicted, sd)
                self._accept(frame, shift.mm, known)
                return self._sighted(frame, place - shift.mm, dots, shift)
            if shift is None and known and len(self._expected(predicted)) < 2:
                return self._new_marks(frame, place - predicted, dots, range(len(place)))
            self._restart(frame, LOST if shift is None else AMBIGUOUS)
            predicted = predicted if known else np.zeros(2)
        self._accept(frame, predicted, known)
        return self._new_marks(frame, place - predicted, dots, range(len(place)))

    def kept(self, *, moved: bool) -> list[Mark]:
        """Return the marks that stayed at one place of the tank while the tank passed the image.

        moved : whether the stage moved. A mark must then have moved through the image by a dot's
        diameter, or have been measured whenever it was whole in the image.
        """
        far = self.diameter_mm * self._scale if moved else 0.0
        return [
            m
            for m in [*self.finished, *self.marks]
            if m.sightings >= LEAST_FRAMES and (m.travelled_px >= far or m.always_seen)
        ]

    def brief(self, kept: list[Mark]) -> list[Mark]:
        """Return further dots of the strip, which were seen in too few frames to be kept.

        They lie in line with the kept marks. They were measured whenever they were whole in the
        image, or moved with the tank in three frames. They occur at the beginning and at the end of
        a run.
        """
        if not kept:
            return []
        across = np.array([m.place_mm[1] for m in kept])
        low, high = across.min() - self.diameter_mm / 2, across.max() + self.diameter_mm / 2
        taken = {m.number for m in kept}
        return [
            m
            for m in [*self.finished, *self.marks]
            if m.number not in taken
            and low < m.place_mm[1] < high
            and (m.always_seen or (m.sightings >= LEAST_FRAMES and m.travelled_px > _MOVED_PX))
        ]

    def _prediction(self, frame: int, place: Array, known: bool) -> tuple[Array, float]:
        """Return the expected shift (2,) in mm and its standard deviation."""
        step = self._step_mm or (_FIRST_STEP_MM if known else self._first_step_mm(place))
        if self._last is None:
            return np.zeros(2), step
        last, shift, _ = self._last
        gap = frame - last
        return shift + (0 if known else gap) * self._speed, step * np.sqrt(gap)

    def _first_step_mm(self, place: Array) -> float:
        """Return the sd of the first motion without an encoder: well below half a spacing."""
        if len(place) < 2:
            return self.diameter_mm
        apart = np.linalg.norm(place[:, None] - place, axis=-1)
        return _FIRST_SHARE * float(apart[apart > 0].min())

    def _expected(self, shift: Array) -> list[int]:
        """Return the marks that should be whole in the image."""
        inside, uv = self._in_image(shift)
        return [k for k, whole in zip(inside, self._are_whole(uv, self.margin_px + 1)) if whole]

    def _are_whole(self, uv: Array, margin: float) -> list[bool]:
        size = np.array(self.view.camera.image_size_px) - 1
        return list(np.all((uv > margin) & (uv < size - margin), axis=1).tolist())

    def _in_image(self, shift: Array) -> tuple[list[int], Array]:
        """Return the marks whose centre is in the image, and these centres (n, 2) in px."""
        places = np.array([m.place_mm for m in self.marks]).reshape(-1, 2) + shift
        return self.view.in_image(places, self._held_mm)

    def _best(self, place: Array, predicted: Array, sd: float) -> _Shift | None:
        """Return the likeliest shift; None if no dot is near a mark."""
        known = np.array([m.place_mm for m in self.marks])
        apart = place[:, None] - known
        reach = max(OUTLIER_SD * sd, self.diameter_mm / 2)
        near = np.linalg.norm(apart - predicted, axis=-1) < reach
        tries = apart[near]
        if not len(tries):
            return None
        costs = np.array([self._cost(apart, t, predicted, sd) for t in tries])
        best = int(costs.argmin())
        pairs = self._pairs(apart, tries[best])
        shift = np.mean([apart[i, k] for i, k in pairs], axis=0)
        other = np.linalg.norm(tries - tries[best], axis=-1) > self.diameter_mm / 2
        sure = not other.any() or float(costs[other].min() - costs[best]) > _SURE
        return _Shift(shift, pairs, sure)

    def _cost(self, apart: Array, shift: Array, predicted: Array, sd: float) -> float:
        """Return minus the log-likelihood of a shift: stray dots, missed marks, a large step."""
        distance = np.linalg.norm(apart - shift, axis=-1).min(1)
        square = (distance / (_TOLERANCE * self.diameter_mm)) ** 2
        seen = {k for _, k in self._pairs(apart, shift)}
        missed = sum(k not in seen for k in self._expected(shift))
        step = float(np.sum((shift - predicted) ** 2)) / (2 * sd**2)
        return float(np.minimum(square / 2, _UNMATCHED).sum()) + _MISSED * missed + step

    def _pairs(self, apart: Array, shift: Array) -> list[tuple[int, int]]:
        """Return the dots and marks that are each other's nearest and agree with a shift."""
        distance = np.linalg.norm(apart - shift, axis=-1)
        nearest, back = distance.argmin(1), distance.argmin(0)
        limit = 3 * _TOLERANCE * self.diameter_mm
        return [
            (i, int(k)) for i, k in enumerate(nearest) if back[k] == i and distance[i, k] < limit
        ]

    def _learn(self, step: Array, sd: float) -> None:
        """Update the RMS step of the shift from frame to frame."""
        before = self._step_mm or sd
        square = (1 - _LEARN) * before**2 + _LEARN * float(np.sum(step**2))
        self._step_mm = max(_LEAST_STEP_MM, float(np.sqrt(square)))

    def _accept(self, frame: int, shift: Array, known: bool) -> None:
        if self._last is not None and not known:
            self._speed = (shift - self._last[1]) / (frame - self._last[0])
        self.shift_mm[frame] = shift
        self._last = (frame, shift, known)

    def _sighted(
        self, frame: int, place: Array, dots: DotSightings, shift: _Shift
    ) -> list[tuple[int, int]]:
        """Return the sightings of marks at their places; dots elsewhere may be new marks."""
        out, used = [], set()
        off = np.array([place[i] - self.marks[k].place_mm for i, k in shift.pairs])
        middle = np.median(off, axis=0) if len(off) > 2 else np.zeros(2)
        seen = []
        for (i, k), residual in zip(shift.pairs, off - middle):
            mark, sigma = self.marks[k], float(dots.sigma_px[i])
            used.add(i)
            seen.append(k)
            if np.linalg.norm(residual) * self._scale > OUTLIER_SD * np.hypot(sigma, _PLACE_PX):
                mark.left_out[MOVED] += 1
                continue
            mark.sightings, mark.last_frame = mark.sightings + 1, frame
            mark.place_mm = mark.place_mm + residual / mark.sightings
            mark.low_px = np.minimum(mark.low_px, dots.uv_px[i])
            mark.high_px = np.maximum(mark.high_px, dots.uv_px[i])
            out.append((i, mark.number))
        self._count_missing(frame, seen, True)
        known = np.array([m.place_mm for m in self.marks])
        free = [
            i
            for i in range(len(place))
            if i not in used
            and np.linalg.norm(known - place[i], axis=-1).min() > self.diameter_mm / 2
        ]
        return out + self._new_marks(frame, place, dots, free)

    def _new_marks(
        self, frame: int, place: Array, dots: DotSightings, chosen: list[int] | range
    ) -> list[tuple[int, int]]:
        out = []
        for i in chosen:
            uv = dots.uv_px[i]
            mark = Mark(self._number, place[i], len(self.epoch_starts) - 1, frame, uv, uv, 1)
            self.marks.append(mark)
            out.append((i, mark.number))
            self._number += 1
        # Dots that are not seen again where they had been are bubbles or dirt on the lens.
        self.marks = [
            m
            for m in self.marks
            if m.sightings >= LEAST_FRAMES or m.always_seen or frame - m.last_frame < _FORGET
        ]
        return out

    def _count_missing(self, frame: int, seen: list[int], known: bool) -> None:
        if self._last is None or not self.marks:
            return
        gap = 0 if known else frame - self._last[0]
        inside, uv = self._in_image(self._last[1] + gap * self._speed)
        for k, whole in zip(inside, self._are_whole(uv, self.margin_px)):
            if k not in seen:
                self.marks[k].left_out[HIDDEN if whole else BORDER] += 1

    def _restart(self, frame: int, why: str) -> None:
        """Start again with new marks; the marks so far are not seen again."""
        self.breaks.append((frame, why))
        self.finished += self.marks
        self.marks = []
        self.epoch_starts.append(frame)
        self._speed, self._step_mm = np.zeros(2), None


_LARGEST = 1.6
_PAD_PX = 2.0


@dataclass(frozen=True)
class StripInImages:
    """Where one camera sees the K dots of the strip in F frames, also those not measured.

    places_mm : (K, 2) on the tank, see `TankView`.
    epochs : (K,) index of the part of the run in which each place is valid.
    epoch_starts : first frame of each part.
    shift_mm : (F, 2) shift of the whole strip in each frame.
    position_mm : (F,) of the stage.
    line_mm : smallest and largest place of a dot across the travel.
    diameter_mm : of a dot.
    """

    view: TankView
    look: DotLook
    places_mm: Array
    epochs: Ints
    epoch_starts: Ints
    shift_mm: Array
    position_mm: Array
    line_mm: tuple[float, float]
    diameter_mm: float

    @staticmethod
    def of(
        follower: Follower, look: DotLook, kept: list[Mark], position_mm: Array
    ) -> StripInImages:
        """Return where the strip of the kept marks (at least one) is in all frames.

        position_mm : (F,) position of the stage in each frame.
        """
        marks = [*kept, *follower.brief(kept)]
        across = [float(m.place_mm[1]) for m in kept]
        shift, starts = follower.shift_mm.copy(), [*follower.epoch_starts, len(position_mm)]
        for first, last in pairwise(starts):
            part = shift[first:last]
            known = np.flatnonzero(np.isfinite(part[:, 0]))
            for axis in (0, 1) if known.size else ():
                part[:, axis] = np.interp(np.arange(len(part)), known, part[known, axis])
        return StripInImages(
            follower.view,
            look,
            np.array([m.place_mm for m in marks]).reshape(-1, 2),
            np.array([m.epoch for m in marks], np.int64),
            np.array(follower.epoch_starts, np.int64),
            np.nan_to_num(shift),
            position_mm,
            (min(across), max(across)),
            follower.diameter_mm,
        )

    def centres_px(self, frame: int) -> Array:
        """Return the centres (n, 2) of the dots that reach into a frame."""
        epoch = int(np.searchsorted(self.epoch_starts, frame, side="right")) - 1
        places = self.places_mm[self.epochs == epoch] + self.shift_mm[frame]
        margin = self.look.a_px + 3 * self.look.blur_px
        return self.view.in_image(places, float(self.position_mm[frame]), margin)[1]

    def erased(self, image: NDArray[Any], frame: int) -> NDArray[Any]:
        """Return a copy of an image in which the strip's dots have the grey level of the screen.

        A dot stays if something dark, such as a bubble, touches it.
        """
        centres = self.centres_px(frame)
        if not len(centres):
            return image
        out = image.copy()
        radius = self.look.a_px + 2.5 * self.look.blur_px + _PAD_PX
        for centre in centres:
            _erase(out, centre, radius)
        return out

    def are_dots(self, frame: int, bubbles: pd.DataFrame) -> Bools:
        """Return (n,) which of n detected bubbles are in truth dots of the strip.

        They are small and lie at the place of a dot; or they are cut by the image's border and lie
        on the line of the strip.
        """
        uv = bubbles[["u_px", "v_px"]].to_numpy(float)
        size, centres = bubbles["d_eq_px"].to_numpy(float), self.centres_px(frame)
        if not len(uv):
            return np.zeros(0, bool)
        small = size < _LARGEST * 2 * self.look.a_px
        apart = np.linalg.norm(uv[:, None] - centres, axis=-1)
        near = apart.min(1, initial=np.inf) < self.look.a_px + _PAD_PX
        across = self.view.lab_mm(uv, float(self.position_mm[frame])) - self.shift_mm[frame]
        low, high = self.line_mm[0] - self.diameter_mm / 2, self.line_mm[1] + self.diameter_mm / 2
        in_line = (across[:, 1] > low) & (across[:, 1] < high)
        cut = bubbles["flags"].astype(str).str.contains("border").to_numpy(bool)
        return np.asarray(small & (near | (cut & in_line)))


def _erase(image: NDArray[Any], centre: Array, radius: float, ring_px: float = 4.0) -> None:
    """Replace the dot, in place, by a plane through the ring round it if the ring is free."""
    reach = radius + ring_px
    low = np.maximum(np.floor(centre - reach).astype(int), 0)
    high = np.minimum(np.ceil(centre + reach).astype(int) + 1, image.shape[::-1])
    if np.any(high <= low):
        return
    window = image[low[1] : high[1], low[0] : high[0]]
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(float) - centre[::-1, None, None]
    distance = np.hypot(u, v)
    ring, disc = (distance > radius) & (distance <= reach), distance <= radius
    if np.count_nonzero(ring) < 10 or not disc.any():
        return
    grey = window[ring].astype(float)
    if np.quantile(grey, 0.05) < (1 - TOUCHED) * np.median(grey):
        return
    terms = np.column_stack([np.ones(grey.size), u[ring], v[ring]])
    plane, *_ = np.linalg.lstsq(terms, grey, rcond=None)
    level = plane[0] + plane[1] * u[disc] + plane[2] * v[disc]
    window[disc] = np.rint(level) if image.dtype.kind in "ui" else level
