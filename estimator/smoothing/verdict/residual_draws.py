"""Residuals as they would be if the model were right, drawn for a stretch of the run.

The fit follows part of the noise: residuals are smaller than the noise, and one frame's are unlike
the next one's. With A the whitened factors and e ~ N(0, I) they are (I - A (A^T A)^-1 A^T) e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from telerig.estimator.smoothing.graph.blocks import Linear
from telerig.estimator.smoothing.graph.linear import all_factors
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.graph.state import Frame

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_HALVES, _EDGE = (100, 50, 30, 20), 12
_MOST_BAND = 1e6
_RIDGE = 1e-9
"""Of the diagonal: the smooth prior of a broad band has fewer digits than double precision. Single
residuals move by some hundredths of a standard deviation, their variance by less than 0.001."""


@dataclass(frozen=True)
class Stretch:
    """Some frames with what moves in them; the rest is held.

    column : of each key of shake and bubbles its first, -1 where it is held.  size : columns.
    inner : (first, last) frames far enough from those that are held.
    """

    frame: Frame
    column: Ints
    size: int
    inner: tuple[int, int]

    def columns(self, linear: Linear) -> Ints:
        """(M, keys) first column of each block of the factors, -1 where it is held."""
        count = len(linear.rhs)
        moving = len(self.column)
        out = np.full((count, len(linear.keys)), -1)
        for i, (key, block) in enumerate(zip(linear.keys, linear.blocks)):
            keys = np.broadcast_to(np.asarray(key, np.int64), (count,))
            mine = (keys < moving) & (block.shape[-1] > 0)
            out[mine, i] = self.column[keys[mine]]
        return out


def stretch_of(frame: Frame, middle: int) -> Stretch | None:
    """About a frame, 200 frames or, where much moves, down to 40; None if that is too much, too."""
    (nodes, shake), (_, bubble) = frame.counts()[:2]
    when = np.r_[np.arange(nodes), frame.node_of_row]
    sizes = np.repeat([shake, bubble], [nodes, frame.rows])
    count = len(frame.problem.t_s)
    for half in _HALVES:
        first = int(np.clip(middle - half, 0, max(count - 2 * half, 0)))
        last = min(first + 2 * half, count) - 1
        low, high = frame.nodes.of_frame[[first, last]]
        inside = (when >= low) & (when <= high) & (sizes > 0)
        at_once = int(np.bincount(when[nodes:][inside[nodes:]], minlength=1).max())
        width = 2 * (shake + bubble * at_once)
        if 0 < int(sizes[inside].sum()) * width <= _MOST_BAND:
            break
    else:
        return None
    order = np.flatnonzero(inside)[np.argsort(when[inside], kind="stable")]
    starts = np.r_[0, np.cumsum(sizes[order])]
    column = np.full(len(when), -1)
    column[order] = starts[:-1]
    inner = (first + _EDGE * (first > 0), last - _EDGE * (last < count - 1))
    return Stretch(frame, column, int(starts[-1]), inner)


def drawn_residuals(
    solution: Solution, stretch: Stretch, draws: int, rng: Generator
) -> list[tuple[Ints, Array]]:
    """By camera: which of its bubbles' pixels (m,), and residuals (m, 2, draws) in sigmas.

    Kept pixels in the inner frames. Raises numpy.linalg.LinAlgError where digits run out.
    """
    frame, observed = solution.frame, solution.frame.problem.observations
    parts = [_Part.of(stretch, f) for f in all_factors(frame, solution.state, solution.weights)]
    noise = [rng.standard_normal((*p.block.shape[:2], draws)) for p in parts]
    found = _fitted(stretch, parts, noise)
    inside = (observed.frame >= stretch.inner[0]) & (observed.frame <= stretch.inner[1])
    inside &= solution.weights[0] > 0.5
    pixels = iter(i for i, p in enumerate(parts) if p.of_bubbles)
    out = []
    for c in range(len(frame.problem.cameras)):
        mine = np.flatnonzero(observed.camera == c)
        residual = np.zeros((0, 2, draws))
        if len(mine):
            i = next(pixels)
            mine = mine[parts[i].which]
            residual = noise[i] - parts[i].block @ found[parts[i].column]
        out.append((mine[inside[mine]], residual[inside[mine]]))
    return out


@dataclass(frozen=True)
class _Part:
    """Factors of one kind that reach into a stretch.

    which : (m,) of them.  block : (m, rows, columns), zero where the key is held.
    column : (m, columns) the stretch's.  of_bubbles : images of them.
    """

    which: Ints
    block: Array
    column: Ints
    of_bubbles: bool

    @classmethod
    def of(cls, stretch: Stretch, linear: Linear) -> _Part:
        base, key = stretch.frame.base(), int(np.min(linear.keys[0]))
        of_bubbles = linear.weight is not None and base.bubbles <= key < base.means
        first = stretch.columns(linear)
        reached = first[:, 0] >= 0 if of_bubbles else np.any(first >= 0, axis=1)
        which = np.flatnonzero(reached)
        blocks, columns = [], []
        for start, block in zip(first[which].T, linear.blocks):
            if np.any(start >= 0):
                whole = np.broadcast_to(block, (len(linear.rhs), *block.shape[-2:]))[which]
                blocks.append(whole * (start >= 0)[:, None, None])
                columns.append(np.maximum(start, 0)[:, None] + np.arange(block.shape[-1]))
        if not blocks:
            blocks, columns = [np.zeros((0, linear.rhs.shape[1], 0))], [np.zeros((0, 0), np.int64)]
        return cls(which, np.concatenate(blocks, -1), np.concatenate(columns, -1), of_bubbles)


def _fitted(stretch: Stretch, parts: Sequence[_Part], noise: Sequence[Array]) -> Array:
    """(columns, draws) least squares of the noise."""
    places, values = [np.zeros(0, np.int64)], [np.zeros(0)]
    side = np.zeros((stretch.size, noise[0].shape[-1]))
    for part, one in zip(parts, noise):
        turned = np.swapaxes(part.block, -1, -2)
        gram = turned @ part.block
        below = part.column[:, :, None] - part.column[:, None]
        there = (below >= 0) & (gram != 0)
        right = np.broadcast_to(part.column[:, None], below.shape)
        places.append(below[there] * stretch.size + right[there])
        values.append(gram[there])
        np.add.at(side, part.column, turned @ one)
    place = np.concatenate(places)
    rows = int(place.max(initial=0)) // stretch.size + 1
    band = np.bincount(place, np.concatenate(values), rows * stretch.size).reshape(rows, -1)
    band[0] *= 1 + _RIDGE
    return np.asarray(cho_solve_banded((cholesky_banded(band, lower=True), True), side))
