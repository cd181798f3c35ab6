"""The bright-field level behind the bubbles, from the run itself.

log image = rig layer(u, v) + lab layer(u + shift_u, v + shift_v) + gain of the frame, with bubbles
as dark outliers. The rig layer is all that is fixed in the image (lens dirt, flat field, a screen
that moves with the rig), the lab layer all that stays behind (a fixed screen, dirt on the tank).

Robust quantiles give a start; then the pixels under bubbles are marked frame by frame, and means
over the rest, one layer after the other, sharpen both. A bubble that the rig follows hides the same
pixels in most frames, so no quantile over frames can see behind it. It is far darker than any
screen is uneven, and that is seen in single frames before any background is known. Dirt is as dark,
but stays still: in the image, or in the lab.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.errors import DetectionError, InputError
from telerig.estimator.bubbles.background.screen import (
    compact_things,
    fill_masked,
    log_cells,
    screen_level,
)
from telerig.statistics import robust_sd

_CELL_PX = 2

DARK = 0.05
"""Relative depth from which on something may be a bubble."""

DEEP = 0.2
"""Depth (of log grey) from which on a dark thing is a bubble, or dirt."""

OFTEN = 0.4
"""Share of frames that hide a pixel from which on quantiles over frames are in danger."""

_STILL, _GONE, _RING_SHARE = 0.9, 0.3, 0.7
_CHANGES = 0.25
_KNOWN_STILL, _FEW = 5, 10


def first_masks(stack: NDArray[np.generic], shifts_px: Array | None, gains: Array) -> Bools:
    """Return (n, H, W) which pixels of n images a bubble probably hides.

    This is done only at places that bubbles hide in many frames. At other places quantiles over
    frames give a better background, because they need no threshold.

    shifts_px : (n, 2) travel (u, v) of what is fixed in the lab; None when nothing moves.
    gains : (n,) log brightness of the frames.
    """
    height, width = stack.shape[1:]
    log = np.stack(
        [log_cells(image, _CELL_PX) - np.float32(gain) for image, gain in zip(stack, gains)]
    )
    surface = np.log(screen_level(np.exp(_quantiles(log, (UPPER,))[0])))
    dark = np.stack([compact_things(surface - frame > DEEP) for frame in log])
    keep = dark & ~_still(dark.mean(0), np.ones(dark.shape[1:], bool), 2)
    places = _lab_places(shifts_px, dark.shape)
    if places:
        share, seen = _share_in_lab(dark, places)
        still = _still(share, seen >= min(_KNOWN_STILL, len(dark)), 3)
        keep &= ~np.stack([still[place] for place in places])
    grow = np.ones((5, 5), np.uint8)
    grown = np.stack([cv2.dilate(mask.astype(np.uint8), grow) for mask in keep])
    often = np.broadcast_to(grown.mean(0) > OFTEN, grown.shape)
    if places:
        share, seen = _share_in_lab(grown, places)
        hidden = (share > OFTEN) & (seen < _FEW)
        often = often | np.stack([hidden[place] for place in places])
    grown *= often
    masks = np.stack([cv2.resize(m, (width, height), interpolation=0) for m in grown]) > 0
    masks &= ~_fringe(stack, gains, masks)
    return masks


def _fringe(stack: NDArray[np.generic], gains: Array, masks: Bools) -> Bools:
    """Return the pixels (H, W) beside what is always hidden that hardly change: dirt.

    A bubble's own border moves, if only by a pixel, and parts its still inside from the outside.
    """
    never = masks.mean(0) > 1 - 1.5 / len(masks)
    values = np.log(np.maximum(stack[:, never].astype(np.float32), 0.5))
    values -= gains.astype(np.float32)[:, None]
    steady = ~never
    low, high = _quantiles(values, (0.1, 0.9))
    steady[never] = np.subtract(high, low) < _CHANGES
    _, labels = cv2.connectedComponents(steady.astype(np.uint8), connectivity=4)
    outside = np.unique(labels[~never])
    return np.asarray(never & np.isin(labels, outside[outside > 0]), bool)


def _still(share: Array, known: Bools, margin: int) -> Bools:
    """Return things dark in nearly all frames, grown by ``margin`` cells."""
    core = (share >= _STILL) & known
    count, labels = cv2.connectedComponents(core.astype(np.uint8))
    still = np.zeros(share.shape, np.uint8)
    for k in range(1, count):
        thing = (labels == k).astype(np.uint8)
        near = cv2.dilate(thing, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
        ring = (cv2.dilate(near, np.ones((3, 3), np.uint8)) > near) & known
        if ring.any() and np.quantile(share[ring], _RING_SHARE) < _GONE:
            still |= near
    return still.astype(bool)


def _lab_places(shifts_px: Array | None, shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Return where each frame's cells lie on a canvas of the lab; [] if nothing moves."""
    if shifts_px is None:
        return []
    shifts = np.rint(shifts_px / _CELL_PX).astype(int)
    return [(slice(v, v + shape[1]), slice(u, u + shape[2])) for u, v in shifts - shifts.min(0)]


def _share_in_lab(marks: Bools, places: list[tuple[slice, slice]]) -> tuple[Array, Array]:
    """Return the share of the frames that mark a cell of the canvas, and how many see it."""
    size = [max(place[axis].stop for place in places) for axis in (0, 1)]
    total, seen = np.zeros(size), np.zeros(size)
    for mask, place in zip(marks, places):
        total[place] += mask
        seen[place] += 1
    return total / np.maximum(seen, 1), seen


UPPER = 0.8
"""Quantile over frames at the start: a bubble may darken a pixel in this share of them."""

STEADY = 0.04
"""A pixel whose brighter frames spread less than this shows the screen, or dirt on it."""

_ROUNDS = 2
_BLOCK_ROWS = 64
_ENOUGH_OF_LAB = 100_000
_LEAST_SEEN = 3
_LEAST_SEEN_LAB = 2
"""In a single frame the lab and a bubble look alike."""


@dataclass(frozen=True)
class Layers:
    """The background of a run as a sum of logarithms: one layer that is fixed in the image (rig),
    one that is fixed in the laboratory (lab), and the brightness of each frame.

    rig : (H, W).
    lab : (Hl, Wl), or None if nothing moves through the image; its pixel (0, 0) is seen at image
        pixel (0, 0) if the shift is ``lab_origin_px``.
    gains : (n,) of n frames.
    """

    rig: Float32
    lab: Float32 | None
    lab_origin_px: tuple[int, int]
    gains: Array

    def lab_in(self, shift_px: Array, rows: slice = slice(None)) -> Float32 | float:
        """Return the lab layer (H, W), or some rows of it, as a frame with this shift sees it."""
        if self.lab is None:
            return 0.0
        first, last, _ = rows.indices(self.rig.shape[0])
        shape, shift = (last - first, self.rig.shape[1]), (shift_px[0], shift_px[1] + first)
        return crop_of_lab(self.lab, self.lab_origin_px, shift, shape, 0.0)


@dataclass(frozen=True)
class _Sample:
    """stack (n, H, W) grey values; shifts (n, 2) px (u, v); table of logarithms."""

    stack: NDArray[np.generic]
    shifts: Array
    table: Float32 | None

    def log(self, frame: int | slice, rows: slice = slice(None), step: int = 1) -> Float32:
        values: NDArray[Any] = self.stack[frame, rows][..., ::step, ::step]
        if self.table is None:
            return np.log(np.maximum(values.astype(np.float32), 1e-6))
        if values.ndim == 2 and values.dtype == np.uint8:
            return np.asarray(cv2.LUT(np.ascontiguousarray(values), self.table))
        return np.take(self.table, values)


def fit_layers(stack: NDArray[np.generic], shifts_px: Array | None) -> tuple[Layers, Bools, float]:
    """Estimate both layers of the background from n images.

    stack : (n, H, W). shifts_px : (n, 2) travel of what is fixed in the laboratory; None for the
    rig layer alone.
    Returns the layers, (H, W) where a bubble hid the screen in all frames, and the relative noise
    of a pixel.
    """
    shifts = np.zeros((len(stack), 2)) if shifts_px is None else shifts_px
    sample = _Sample(stack, shifts, _log_table(stack.dtype))
    gains = _first_gains(sample)
    empty = np.zeros(stack.shape[1:], np.float32)
    masks = first_masks(stack, shifts_px, gains)
    layers, spread, never = _first_rig(sample, Layers(empty, None, (0, 0), gains), masks)
    if shifts_px is not None:
        layers = _first_lab(sample, layers, masks)
        layers, spread, never = _first_rig(sample, layers, masks)
    residuals = np.empty(stack.shape, np.float32)
    layers, marked = _marked(sample, layers, residuals)
    covered, usable = _covered(layers, marked, spread, never)
    if covered.any():
        layers = replace(layers, rig=fill_masked(layers.rig, covered, usable))
        layers, marked = _marked(sample, layers, residuals)
    for turn in range(_ROUNDS):
        if turn:
            layers, marked = _marked(sample, layers, residuals)
        layers, seen = _mean_rig(layers, marked, residuals, covered)
        if layers.lab is not None:
            layers = _mean_lab(sample, layers, marked, residuals)
    noise = _noise(sample, _residuals(sample, layers, residuals))
    hidden = covered & (seen < _least_seen(len(stack)))
    if hidden.any():
        layers = replace(layers, rig=fill_masked(layers.rig, hidden, usable))
    return layers, hidden, noise


def _log_table(kind: np.dtype[Any]) -> Float32 | None:
    if kind not in (np.uint8, np.uint16):
        return None
    return np.log(np.maximum(np.arange(np.iinfo(kind).max + 1), 0.5)).astype(np.float32)


def _step(sample: _Sample) -> int:
    """Between the pixels that stand for the image where a median is all that is asked for."""
    return max(1, int(np.sqrt(np.prod(sample.stack.shape[1:]) / 16_000)))


def _first_gains(sample: _Sample) -> Array:
    log = sample.log(slice(None), step=_step(sample)).reshape(len(sample.stack), -1)
    gains = np.zeros(len(log))
    for _ in range(3):
        gains += np.median(log - gains[:, None] - np.median(log - gains[:, None], axis=0), axis=1)
        gains -= np.median(gains)
    return gains


def _first_rig(sample: _Sample, layers: Layers, masks: Bools) -> tuple[Layers, Float32, Bools]:
    """Return the layers with the frames' upper quantile, and the spread of brighter frames.

    masks : (n, H, W) what is left out. Then (H, W) the pixels that no two frames show, filled.
    """
    rig, spread = np.empty((2, *sample.stack.shape[1:]), np.float32)
    for rows in _blocks(rig.shape[0]):
        log = np.empty((len(sample.stack), *rig[rows].shape), np.float32)
        for k, shift in enumerate(sample.shifts):
            np.subtract(sample.log(k, rows), layers.lab_in(shift, rows), out=log[k])
            log[k] -= np.float32(layers.gains[k])
        log[masks[:, rows]] = np.nan
        low, rig[rows], high = _quantiles(log, (UPPER - 0.1, UPPER, UPPER + 0.1))
        spread[rows] = high - low
    never = np.isnan(rig)
    rig[never] = 0
    layers = replace(layers, rig=rig)
    if never.any():
        layers = replace(layers, rig=fill_masked(rig, never, ~never))
    return layers, np.nan_to_num(spread), never


def _blocks(height: int) -> Iterator[slice]:
    return (slice(r, min(r + _BLOCK_ROWS, height)) for r in range(0, height, _BLOCK_ROWS))


def _quantiles(values: Float32, shares: tuple[float, ...]) -> Float32:
    """Return quantiles (Q, ...) over the first axis without NaN; NaN if fewer than two remain."""
    ordered = np.ascontiguousarray(np.moveaxis(values, 0, -1))
    ordered.sort(axis=-1)
    known = ordered.shape[-1] - np.count_nonzero(np.isnan(ordered), axis=-1)
    at = np.rint(np.multiply.outer(known - 1, shares)).astype(np.int64).clip(0)
    found = np.take_along_axis(ordered, at, axis=-1)
    found[known < _LEAST_SEEN_LAB] = np.nan
    return np.asarray(np.moveaxis(found, -1, 0))


def _first_lab(sample: _Sample, layers: Layers, masks: Bools) -> Layers:
    """Return the layers with the lab layer's quantiles over the frames that saw each place."""
    height, width = layers.rig.shape
    low, high = np.floor(sample.shifts.min(0)), np.ceil(sample.shifts.max(0))
    origin = (int(low[0]), int(low[1]))
    spread = (high - low).astype(int)
    lab = np.zeros((height + spread[1] + 1, width + spread[0] + 1), np.float32)
    for rows in _blocks(len(lab)):
        seen = [
            found
            for k in range(len(sample.stack))
            if (found := _lab_rows(sample, layers, k, masks[k], rows, origin, lab.shape[1]))
            is not None
        ]
        if seen:
            lab[rows] = np.nan_to_num(_quantiles(np.stack(seen), (UPPER,))[0], nan=0.0)
    return _centred(replace(layers, lab=lab, lab_origin_px=origin))


def _lab_rows(
    sample: _Sample,
    layers: Layers,
    k: int,
    mask: Bools,
    rows: slice,
    origin: tuple[int, int],
    width: int,
) -> Float32 | None:
    """Return what frame k shows in these rows of the lab, NaN beside it; None for nothing."""
    left, top = sample.shifts[k] - origin
    column, row = math.floor(left), math.floor(top)
    height = layers.rig.shape[0]
    first, last = max(rows.start - row, 0), min(rows.stop - row, height)
    if first >= last:
        return None
    margin = slice(max(first - 2, 0), min(last + 2, height))
    residual = sample.log(k, margin) - np.float32(layers.gains[k]) - layers.rig[margin]
    residual[mask[margin]] = np.nan
    moved = shifted(residual, (column - left, row - top))
    out = np.full((rows.stop - rows.start, width), np.nan, np.float32)
    place = slice(first + row - rows.start, last + row - rows.start)
    part = moved[first - margin.start : last - margin.start]
    out[place, column : column + part.shape[1]] = part
    return out


def _centred(layers: Layers) -> Layers:
    """Return the same sum of layers with the lab's median at 0."""
    assert layers.lab is not None
    some = layers.lab.ravel()[:: max(1, layers.lab.size // _ENOUGH_OF_LAB)]
    known = some[some != 0]
    middle = np.float32(np.median(known)) if known.size else np.float32(0)
    lab = np.where(layers.lab != 0, layers.lab - middle, 0).astype(np.float32)
    return replace(layers, lab=lab, rig=layers.rig + middle)


def _residuals(sample: _Sample, layers: Layers, out: Float32) -> Float32:
    """Return in ``out`` (n, H, W) what the layers and gains leave of the frames' logarithms."""
    for k, shift in enumerate(sample.shifts):
        np.subtract(sample.log(k), layers.rig, out=out[k])
        out[k] -= np.float32(layers.gains[k])
        out[k] -= layers.lab_in(shift)
    return out


def _noise(sample: _Sample, residuals: Float32) -> float:
    """Return the relative noise of a pixel, from the positive residuals."""
    step = _step(sample)
    some = residuals[:: max(1, len(residuals) // 8), ::step, ::step]
    residual = some - np.median(some)
    return max(0.002, float(robust_sd(residual[residual >= 0])))


def _marked(sample: _Sample, layers: Layers, residuals: Float32) -> tuple[Layers, Bools]:
    """Return the layers with new gains, and the outlier pixels (n, H, W), such as bubbles.

    residuals : (n, H, W) are overwritten by those of the new layers.
    """
    _residuals(sample, layers, residuals)
    sigma = _noise(sample, residuals)
    marked = np.empty(sample.stack.shape, bool)
    gains = layers.gains.copy()
    step = _step(sample)
    for k, residual in enumerate(residuals):
        thin = residual[::step, ::step]
        change = float(np.median(thin))
        near = np.abs(thin - change) < 3 * sigma
        change = float(np.mean(thin[near])) if near.any() else change
        residual -= np.float32(change)
        gains[k] += change
        marked[k] = _outliers(residual, sigma)
    middle = float(np.median(gains))
    layers = replace(layers, gains=gains - middle, rig=layers.rig + np.float32(middle))
    return layers, marked


def _outliers(residual: Float32, sigma: float) -> Bools:
    """Dark things with their soft edges and bright centres, and bright specks."""
    soft = cv2.blur(residual, (5, 5))
    thin = soft[::8, ::8] - np.median(soft[::8, ::8])
    spread = float(robust_sd(thin[thin >= 0]))
    dark = (residual < -4 * sigma) | (soft < -max(5 * spread, 0.01))
    grown = cv2.dilate(dark.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7)))
    outlines, _ = cv2.findContours(grown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(grown, outlines, -1, 1, cv2.FILLED)
    return np.asarray((grown > 0) | (residual > 5 * sigma), bool)


def _covered(layers: Layers, marked: Bools, spread: Float32, never: Bools) -> tuple[Bools, Bools]:
    """(H, W) where a bubble kept the rig layer dark all the time, and what is clean enough to fill
    it from.

    spread, never : (H, W), as `_first_rig` gives them.

    Dirt and a bubble that the rig follows both look dark in the layer, but a bubble's edge
    moves: just outside it the frames differ.
    """
    dark = (np.log(screen_level(np.exp(layers.rig))) - layers.rig > DARK).astype(np.uint8)
    outlines, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    share = marked.mean(0, dtype=np.float32)
    usual = float(np.median(share))
    covered = never.astype(np.uint8)
    for outline in outlines:
        thing = cv2.drawContours(np.zeros_like(dark), [outline], -1, 1, cv2.FILLED)
        around = cv2.dilate(thing, np.ones((7, 7), np.uint8)) > thing
        if np.mean(share[around] > usual + 0.25) > 0.5:
            covered |= thing
    if not covered.any():
        return covered.astype(bool), covered == 0
    edge = cv2.dilate(covered, np.ones((13, 13), np.uint8)) > covered
    hidden = covered.astype(bool) | (edge & (spread > STEADY))
    usable = (cv2.dilate(dark | covered, np.ones((5, 5), np.uint8)) == 0) & ~edge
    return hidden, usable


def _least_seen(frames: int) -> int:
    """Return how many frames must show a usually hidden pixel before they are believed."""
    return max(_LEAST_SEEN, frames // 7)


def _mean_rig(
    layers: Layers, marked: Bools, residuals: Float32, covered: Bools
) -> tuple[Layers, Float32]:
    """Return the rig layer as the mean of unmarked pixels, and their number (H, W).

    residuals : of the layers; they become those of the new layers.
    """
    total, seen = np.zeros(layers.rig.shape, np.float32), np.zeros(layers.rig.shape, np.float32)
    for mask, residual in zip(marked, residuals):
        free = (~mask).view(np.uint8)
        cv2.accumulate(residual, total, free)
        seen += free
    needed = np.where(covered, _least_seen(len(marked)), _LEAST_SEEN)
    change = np.where(seen >= needed, total / np.maximum(seen, 1), 0).astype(np.float32)
    residuals -= change
    return replace(layers, rig=layers.rig + change), seen


def _mean_lab(sample: _Sample, layers: Layers, marked: Bools, residuals: Float32) -> Layers:
    """Return the lab layer as the mean of unmarked residuals, which then become 0."""
    assert layers.lab is not None
    height, width = layers.rig.shape
    total, seen = np.zeros_like(layers.lab), np.zeros_like(layers.lab)
    for k, shift in enumerate(sample.shifts):
        left, top = shift - layers.lab_origin_px
        column, row = math.floor(left), math.floor(top)
        fraction = (column - left, row - top)
        residual = residuals[k]
        residual[marked[k]] = 0
        near = cv2.dilate(marked[k].view(np.uint8), np.ones((3, 3), np.uint8))
        near[: int(fraction[1] < 0)] = 1
        near[:, : int(fraction[0] < 0)] = 1
        place = (slice(row, row + height), slice(column, column + width))
        free = np.equal(near, 0).view(np.uint8)
        cv2.accumulate(shifted(residual, fraction), total[place], free)
        seen[place] += free
    change = np.where(seen >= _LEAST_SEEN_LAB, total / np.maximum(seen, 1), 0)
    return _centred(replace(layers, lab=layers.lab + change.astype(np.float32)))


def crop_of_lab(
    lab: Float32,
    origin_px: tuple[int, int],
    shift_px: tuple[float, float],
    shape: tuple[int, int],
    outside: float,
) -> Float32:
    """Return the part (H, W) of the lab layer that is seen at a shift, by cubic interpolation.

    shift_px : (u, v).
    shape : (H, W).
    outside : value beyond the layer.
    """
    left, top = shift_px[0] - origin_px[0], shift_px[1] - origin_px[1]
    column, row = math.floor(left), math.floor(top)
    window = np.full((shape[0] + 3, shape[1] + 3), outside, np.float32)
    r0, r1 = max(row - 1, 0), min(row + shape[0] + 2, lab.shape[0])
    c0, c1 = max(column - 1, 0), min(column + shape[1] + 2, lab.shape[1])
    if r0 < r1 and c0 < c1:
        part = lab[r0:r1, c0:c1]
        window[r0 - row + 1 : r1 - row + 1, c0 - column + 1 : c1 - column + 1] = part
    return shifted(window, (left - column, top - row))[1:-2, 1:-2]


def shifted(image: Float32, shift_px: tuple[float, float]) -> Float32:
    """Return image(p + shift) for a shift below 1 px, by Catmull-Rom splines.

    Pixels beyond the border are taken equal to those on the border.
    """
    along_u, along_v = (_spline(shift) for shift in shift_px)
    out = cv2.sepFilter2D(image, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.float32)


@lru_cache(maxsize=256)
def _spline(shift: float) -> Float32:
    """Five weights, of the pixels from -2 to +2."""
    base = math.floor(shift)
    x = np.abs(np.arange(-1, 3) - (shift - base))
    near, far = 1 - 2.5 * x**2 + 1.5 * x**3, 2 - 4 * x + 2.5 * x**2 - 0.5 * x**3
    weights = np.zeros(5, np.float32)
    # the fourth weight of a non-negative shift falls on +2, that of a negative one on +1
    weights[base + 1 : base + 5] = np.where(x <= 1, near, np.where(x < 2, far, 0.0))
    return weights


Shift = tuple[float, float]

_FEW_FRAMES_CELL_PX = 8
"""The level from fewer frames is that of square cells: the mean of 64 pixels has little noise."""

LEAST_FRAMES = 4
"""With fewer frames the motion of the bubbles does not separate them from the background."""

_FEWEST_FRAMES, _MOST_FRAMES, _FRAMES_A_PLACE = 21, 41, 13

LEAST_TRAVEL_PX = 2.0
"""Least total travel that separates what is fixed in the lab from what is fixed in the image."""


@dataclass(frozen=True)
class Background:
    """Holds the background of a run in two layers.

    rig_level : (H, W) level of what is fixed in the image, in grey values.
    lab_factor : (Hl, Wl) factor of what is fixed in the laboratory, by which the level is
        multiplied; None if there is none. Its pixel (0, 0) is seen at image pixel (0, 0) if the
        shift is ``lab_origin_px``.
    covered : (H, W) True where a bubble hid the screen in all frames, so that the level there is
        interpolated.
    frames : the frames from which the background was made.
    noise : relative standard deviation of a pixel at the median level.
    shift_px : (F, 2) travel of the rig as seen in the image, for every frame; None if it is 0.
    """

    rig_level: Float32
    covered: Bools
    lab_factor: Float32 | None = None
    lab_origin_px: tuple[int, int] = (0, 0)
    frames: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    noise: float = 0.0
    shift_px: Array | None = None

    def of_frame(self, frame: int) -> Float32:
        """Return the level (H, W) in a frame, at the median brightness."""
        return self.at(tuple(self.shift_px[frame])) if self.shift_px is not None else self.at()

    def at(self, frame_shift_px: Shift = (0.0, 0.0)) -> Float32:
        """Return the level (H, W) at the median brightness, with the lab displaced by (u, v) px.

        What is fixed in the lab and seen at pixel p at shift 0 is seen at p - shift. A shift that
        is not finite, or outside the lab seen in the run, gives the rig layer alone.
        """
        if self.lab_factor is None or not np.all(np.isfinite(frame_shift_px)):
            return self.rig_level.copy()
        shape = self.rig_level.shape
        factor = crop_of_lab(
            self.lab_factor, self.lab_origin_px, frame_shift_px, (shape[0], shape[1]), 1.0
        )
        # beside a sharp black edge the splines are negative
        return np.asarray(self.rig_level * np.maximum(factor, self.lab_factor.min()), np.float32)


def estimate_background(
    images: Callable[[int], NDArray[np.generic] | None],
    frame_count: int,
    *,
    shift_px: Array | None = None,
    max_frames: int | None = None,
) -> Background:
    """Return the background from at most ``max_frames`` frames spread over the run.

    By default it is made of 21 frames, and of up to 41 where the lab moves through the image, so
    that each place in the lab is seen in about 13 of them.

    images : gives a frame's (H, W) image, or None where it is missing.
    shift_px : (F, 2) travel of the rig as seen in the image, (u, v): what is fixed in the lab is
    seen at p - shift. None when nothing moves, or everything seen moves along. Frames with NaN are
    not used.

    A bubble that the rig follows keeps some pixels dark all the time: they are recognised by the
    changing edge around them, filled smoothly, and marked in `Background.covered`.
    Raises DetectionError without a single frame, InputError for images that differ in size.
    """
    shifts = np.zeros((frame_count, 2)) if shift_px is None else np.asarray(shift_px, float)
    if shifts.shape != (frame_count, 2):
        raise InputError(
            f"has the shape {shifts.shape}", where="shift_px", todo=f"give ({frame_count}, 2)"
        )
    usable = np.flatnonzero(np.isfinite(shifts).all(1))
    frames, stack = _sample(images, usable, max_frames or _enough_frames(images, shifts[usable]))
    if len(frames) < LEAST_FRAMES:
        brightest = stack.max(0).astype(np.float32)
        level = screen_level(brightest)
        seen = brightest < (1 - DARK) * level
        dark = np.asarray(cv2.dilate(seen.view(np.uint8), np.ones((9, 9), np.uint8)) > 0)
        cells = log_cells(brightest, _FEW_FRAMES_CELL_PX)
        size = cells.shape[::-1]
        hidden = cv2.resize(dark.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
        smooth = cv2.GaussianBlur(fill_masked(cells, hidden, ~hidden), (0, 0), 1.0)
        level = np.exp(cv2.resize(smooth, level.shape[::-1], interpolation=cv2.INTER_LINEAR))
        return Background(level, dark, frames=frames, shift_px=shift_px)
    travel = shifts[frames]
    moving = bool(np.ptp(travel, axis=0).max() >= LEAST_TRAVEL_PX)
    layers, covered, noise = fit_layers(stack, travel if moving else None)
    lab = None if layers.lab is None else np.exp(layers.lab)
    rig = np.exp(layers.rig)
    return Background(rig, covered, lab, layers.lab_origin_px, frames, noise, shift_px)


def _enough_frames(images: Callable[[int], NDArray[np.generic] | None], shifts: Array) -> int:
    image = next((i for k in range(len(shifts)) if (i := images(k)) is not None), None)
    if image is None:
        return _FEWEST_FRAMES
    screens = 1 + np.max(np.ptp(shifts, axis=0) / image.shape[::-1], initial=0)
    return int(np.clip(np.ceil(_FRAMES_A_PLACE * screens), _FEWEST_FRAMES, _MOST_FRAMES))


def _sample(
    images: Callable[[int], NDArray[np.generic] | None],
    candidates: Ints,
    max_frames: int,
) -> tuple[Ints, NDArray[np.generic]]:
    """Return frames (n,), unevenly spread, and their images (n, H, W).

    Even spacing at even speed would make every texture whose period is the spacing look the same
    in both layers; the golden ratio's multiples avoid all periods.
    """
    parts = np.array_split(candidates, min(max_frames, len(candidates)))
    frames, pictures = [], []
    for k, part in enumerate(parts):
        turn = int((k * 0.6180339887498949) % 1 * len(part)) if len(part) else 0
        for frame in np.roll(part, -turn)[:4]:
            picture = images(int(frame))
            if picture is not None:
                frames.append(int(frame))
                pictures.append(picture)
                break
    if not pictures:
        raise DetectionError(
            "no frame can be used for the background",
            where="run",
            todo="check that images exist and the stage's record covers their times",
        )
    if len({picture.shape for picture in pictures}) > 1:
        raise InputError("the images differ in size", where="run", todo="give one camera's images")
    return np.array(frames, np.int64), np.stack(pictures)
