"""From a closed outline to pixels: exact coverage of grid cells, blur, integration, windows."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from telerig.arrays import Array, Ints

Window = tuple[slice, slice]


def cell_coverage(polygon: Array, size: tuple[int, int]) -> Array:
    """Return the exact share (rows, columns) of each cell of a grid that lies inside a polygon.

    polygon : (points, 2) x and y of its corners in cells, inside the grid. size : (rows, columns)
    of the grid. Each edge is cut at the cells' borders; a piece adds its height to all cells to its
    right.
    """
    rows, columns = size
    start, end = _pieces(polygon)
    middle = (start + end) / 2
    column = np.clip(np.floor(middle[:, 0]).astype(np.int64), 0, columns - 1)
    row = np.clip(np.floor(middle[:, 1]).astype(np.int64), 0, rows - 1)
    rise = end[:, 1] - start[:, 1]
    part = rise * (middle[:, 0] - column)
    width = columns + 1
    place = row * width + column
    step = np.bincount(place, rise - part, rows * width)
    step += np.bincount(place + 1, part, rows * width)
    coverage = np.cumsum(step.reshape(rows, width), 1)[:, :columns]
    return np.asarray(np.abs(coverage))


def _pieces(polygon: Array) -> tuple[Array, Array]:
    """Return the ends (M, 2), (M, 2) of the edges cut at every whole x and y."""
    first = polygon
    step = np.roll(polygon, -1, 0) - first
    edges, cuts = [np.arange(len(first))], [np.zeros(len(first))]
    for axis in (0, 1):
        edge, cut = _crossings(first[:, axis], step[:, axis])
        edges.append(edge)
        cuts.append(cut)
    edge, at = np.concatenate(edges), np.concatenate(cuts)
    order = np.lexsort((at, edge))
    edge, at = edge[order], at[order]
    until = np.append(at[1:], 1.0)
    until[np.append(edge[1:] != edge[:-1], True)] = 1.0
    return (
        first[edge] + at[:, None] * step[edge],
        first[edge] + until[:, None] * step[edge],
    )


def _crossings(start: Array, step: Array) -> tuple[Ints, Array]:
    """Return which edges cross a whole number, and at which share of their length."""
    low = np.ceil(np.minimum(start, start + step)).astype(np.int64)
    high = np.floor(np.maximum(start, start + step)).astype(np.int64)
    count = np.where(step == 0, 0, np.maximum(high - low + 1, 0))
    edge = np.repeat(np.arange(len(start)), count)
    nth = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    cut = (low[edge] + nth - start[edge]) / step[edge]
    return edge, np.clip(cut, 0.0, 1.0)


def pixel_weights(
    pixels: int,
    per_pixel: int,
    pad: int,
    sigma_px: float,
    shift_px: float = 0.0,
    kind: type[np.floating] = np.float64,
) -> Array:
    """Return the matrix that turns a row of fine cells into blurred pixels.

    Its size is (pixels + 2 pad, pixels * per_pixel): the pixels, with ``pad`` more on both sides,
    from ``per_pixel`` cells per pixel. It blurs with the standard deviation sigma_px and integrates
    over each pixel. The row of cells starts at the left edge of its first pixel and is displaced by
    shift_px. The blur by the finite width of a cell, a variance of width^2 / 12, is subtracted from
    sigma_px^2.
    """
    centre = (np.arange(pixels * per_pixel) + 0.5) / per_pixel + shift_px
    border = np.arange(-pad, pixels + pad + 1)[:, None]
    sigma = np.sqrt(max(sigma_px**2 - 1 / (12 * per_pixel**2), (0.1 / per_pixel) ** 2))
    share = ndtr(((border - centre) / sigma).astype(kind))
    return np.asarray((share[1:] - share[:-1]) / kind(per_pixel))


def overlap(
    shape: tuple[int, ...], patch_shape: tuple[int, ...], row: int, column: int
) -> tuple[Window, Window]:
    """Return the part of an image that a patch covers.

    shape, patch_shape : of the image and of the patch. row, column : the patch's first pixel in the
    image, which may be negative.
    Returns the slices (rows, columns) of this part in the image, and its slices in the patch.
    """
    first = np.maximum([row, column], 0)
    end = np.maximum(np.minimum(np.add([row, column], patch_shape), shape), first)
    inside = slice(first[0], end[0]), slice(first[1], end[1])
    taken = slice(first[0] - row, end[0] - row), slice(first[1] - column, end[1] - column)
    return inside, taken


def refined(outline: Array, count: int) -> Array:
    """Return ``count`` points (count, 2) of a smooth closed outline that is given by fewer.

    outline : (points, 2), evenly spaced in the parameter; the interpolation is trigonometric.
    """
    n = len(outline)
    spectrum = np.fft.rfft(outline, axis=0)
    if n % 2 == 0:
        spectrum[-1] /= 2
    return np.fft.irfft(spectrum, count, axis=0) * (count / n)
