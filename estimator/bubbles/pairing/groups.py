"""Finds which detections of all cameras show the same bubble: groups of at most one of each.

A group's log odds say how much better "one bubble" explains its detections than "each by itself",
for any number of cameras. Images of one point in n cameras have 2 n - 3 directions in which they
cannot differ (`image_axes`): the innovation is what they do differ there, and the evidence is its
density against images anywhere. With two cameras it is the *gap*, by which their rays miss each
other.

Two views of one body share the planes that touch it and hold both viewing directions. So along the
common perpendicular of the rays both silhouettes have the same top and the same bottom, for any
body and any angle between the cameras. An image of a bubble therefore counts as the middle between
top and bottom along the axes that its camera shares with others, and as the outline's centre across
them; half the distance of top and bottom, the *height*, is compared, too, and so are width and
contrast, by the mean of the pairs' evidence over all trees that connect the views. (Blur is not
used: views at an angle are out of focus at different depths.)

The probability of a set of disjoint groups is proportional to the product of exp(log odds) of its
groups, and each group has an exact posterior probability. Groups that are more probable than not
are disjoint, and they are the result: where no group is, none is guessed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc, chdtri

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.errors import InputError
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    AXES_COLUMNS,
    CENTRE_COLUMNS,
    COVARIANCE_COLUMNS,
    HARMONIC_COLUMNS,
    centre_covariances,
    columns,
    flag_words,
)
from telerig.estimator.bubbles.pairing.evidence import (
    DETECTION_PROBABILITY,
    Prediction,
    evidence,
)
from telerig.estimator.bubbles.pairing.model import (
    GAP_PX,
    NEVER,
    Comparison,
    RigModel,
    appearance_log_odds,
    image_axes,
)
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.outline import waves
from telerig.rig.triangulation import (
    UNKNOWN_MM,
    midpoint,
    nearly_parallel,
    on_rays,
    stacked_jacobian,
    triangulate_views,
)

_CERTAIN = 1e9
"""Log odds of a group by an id that came with the data."""

NEGLIGIBLE = -9.0
"""Log odds below which a group is never considered: its probability stays under exp(-9)."""

SAFE_LOG_ODDS = 3.0
"""Posterior log odds (20 to 1) below which a group is ambiguous."""

_NEW_SHARE = 0.1
"""Share of the bubbles of a frame that no track expects."""

_SILHOUETTE_SIZE_SD = 0.1
"""Relative standard deviation of a silhouette's mean diameter about the body's diameter."""

NO_SIZE_FLAGS = ("border", "merged")
_SCATTER_FACTOR = {"overlap": 2.0, "defocus": 1.5, "saturated": 1.5, "merged": 3.0, "border": 3.0}
_MOST_SCATTER = max(_SCATTER_FACTOR.values())
"""By flag, the factor on the scatter of an outline's middle, and the largest of them."""

_UNSURE_SHARE = {"overlap": 0.01, "merged": 0.05, "border": 0.05}
"""By flag, the standard deviation that a partly hidden outline adds to the centre, as a share of
the major semi-axis."""
_OUTLINE_SAMPLES = 96
"""Points of an outline with harmonics, of which the highest is refined by a parabola."""

GATE2 = 25.0
"""Largest square of a true pair's gap, in variances of its wide part: wider than the gate of
predictions, because what disturbs an outline is no Gaussian noise."""

_TAIL, _LEAST_TAIL_PX2, _MOST_TAIL_PX2 = 0.02, 0.125, 0.5
"""Share of outlines that are disturbed, and limits of the variance that this adds to an image."""

_SHIFT_PASSES = 4
"""Turns of probabilities and the shift of each camera that all groups of a frame share."""

_SAME_AXIS = 0.1
"""Axes nearer to each other than some 11 degrees are one: ratio of singular values."""

Cameras = tuple[Camera, Camera]

Rays = tuple[tuple[Array, Array, Array], ...]
"""The detections of each camera by themselves, as `on_rays` returns them."""


@dataclass(frozen=True)
class View(Rows):
    """Hold the N detections of one camera, as groups take them.

    A camera shares an axis with each of P others, the common perpendicular of both lines of sight.

    uv_px, covariance_px2 : (N, 2), (N, 2, 2) centres of the outlines and their covariances, with
        what a body's unknown shape adds.
    middle_px, middle_covariance_px2 : (N, 2), (N, 2, 2) the same of the outline's middle between
        top and bottom along the shared axes.
    origin_mm, direction : (N, 3) origins (mm) and unit directions of the middle's rays in the rig
        frame.
    log_size : (N, P, 2) logarithms of half the height and half the width (mm), along and across
        each shared axis; NaN where unknown.
    log_contrast : (N, 1) logarithm of the contrast; NaN where unknown.
    scatter_factor : (N,) factor on the scatter of the middle, above 1 for detections with some
        flags.
    """

    uv_px: Array
    covariance_px2: Array
    middle_px: Array
    middle_covariance_px2: Array
    origin_mm: Array
    direction: Array
    log_size: Array
    log_contrast: Array
    scatter_factor: Array


def shared_axis(cameras: Cameras) -> Array:
    """Return the direction of the common perpendicular of two cameras' optical axes.

    Returns a unit vector (3,) in the rig frame. It points along +u or +v of the first camera's
    image, whichever is nearer.
    Raises InputError if both cameras look along nearly the same direction.
    """
    first, second = (c.camera_from_rig.rotation[2] for c in cameras)
    perpendicular = np.cross(first, second)
    length = np.linalg.norm(perpendicular)
    if nearly_parallel(cameras):
        raise InputError(
            "both cameras look along nearly the same direction",
            todo="turn the cameras: at less than 3 deg between them, bubbles cannot be paired",
        )
    in_first = (cameras[0].camera_from_rig.rotation @ perpendicular)[:2]
    return np.asarray(perpendicular / length * np.sign(in_first[np.argmax(np.abs(in_first))]))


def views_of(
    tables: Sequence[pd.DataFrame], model: RigModel, wander: float = 0.0
) -> tuple[View, ...]:
    """Compute lines of sight and sizes in mm of the bubbles that each camera has detected.

    tables : for each camera one as `detect_bubbles` returns it.
    wander : standard deviation of the shift of an outline's centre by a bubble's unknown shape, as
        a share of its radius.

    Raises InputError if a column is missing, or if a centre or its covariance is not finite.
    """
    axes: list[list[Array]] = [[] for _ in model.cameras]
    for a, b in model.pairs:
        axis = shared_axis((model.cameras[a], model.cameras[b]))
        axes[a].append(axis)
        axes[b].append(axis)
    return tuple(
        _view(table, camera, np.array(own).reshape(-1, 3), wander)
        for table, camera, own in zip(tables, model.cameras, axes)
    )


def _view(table: pd.DataFrame, camera: Camera, axes: Array, wander: float) -> View:
    """axes : (P, 3) unit vectors in the rig frame."""
    missing = {*CENTRE_COLUMNS, *COVARIANCE_COLUMNS, *AXES_COLUMNS[:2]} - set(table)
    if missing:
        raise InputError(
            f"the detections of camera {camera.name!r} lack {', '.join(sorted(missing))}",
            todo="give the table that detect_bubbles returns",
        )
    uv, covariance = columns(table, CENTRE_COLUMNS), centre_covariances(table)
    bad = ~(np.isfinite(uv).all(1) & np.isfinite(covariance).all((1, 2)))
    if bad.any():
        raise InputError(
            f"{int(bad.sum())} detections of camera {camera.name!r} have no finite centre or "
            f"covariance (first: row {int(np.argmax(bad))})",
            todo="leave such rows out",
        )
    mm_by_px = _mm_by_px(camera, uv)
    across = (axes @ camera.camera_from_rig.rotation.T)[:, :2] @ mm_by_px  # (N, P, 2)
    middle_mm, height = (np.stack(values, -1) for values in zip(
        *(outline_extent(table, across[:, k]) for k in range(len(axes)))
    ))  # fmt: skip
    known, scatter_factor, unsure = _trust(table)
    a, b, measured, contrast = columns(table, ["a_px", "b_px", "area_px2", "contrast"]).T
    area = np.where(measured > 0, measured, np.pi * a * b)[:, None]
    area_mm2 = area * np.abs(np.linalg.det(mm_by_px))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_height = np.where(known[:, None] & (height > 0), np.log(height), np.nan)
        log_width = np.log(area_mm2 / np.pi) - log_height
        log_contrast = np.log(contrast)
    back = np.linalg.pinv(across, rcond=_SAME_AXIS)
    middle = uv + (back @ middle_mm[..., None])[..., 0]
    shape_px2 = wander**2 / np.pi * np.nan_to_num(area)[:, :, None]
    hidden_px2 = np.square(unsure * np.nan_to_num(a))[:, None, None]
    free = np.eye(2) - back @ across
    return View(
        uv, covariance + shape_px2 * np.eye(2),
        middle, covariance + hidden_px2 * np.eye(2) + shape_px2 * free, *camera.unproject(middle),
        _finite(np.stack([log_height, log_width], -1)), _finite(log_contrast[:, None]),
        scatter_factor,
    )  # fmt: skip


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)


def compared(
    cameras: Cameras, first: View, second: View, of_axis: tuple[int, int] = (0, 0)
) -> Comparison:
    """Compare the detections of two views, whose arrays are broadcast.

    of_axis : which of the axes of either view both share.
    """
    points, miss = midpoint(first.origin_mm, first.direction, second.origin_mm, second.direction)
    rotation = cameras[0].camera_from_rig.rotation
    up = np.cross(rotation[2], cameras[1].camera_from_rig.rotation[2]) @ shared_axis(cameras)
    sizes, stretch = [], []
    for camera, view, k in zip(cameras, (first, second), of_axis):
        pose = camera.camera_from_rig
        depth = points @ pose.rotation[2] + pose.translation_mm[2]
        stretch.append(np.log(1 + camera["kappa_per_mm"] * depth)[..., None])
        sizes.append(view.log_size[..., k, :])
    variance = [np.trace(v.middle_covariance_px2, axis1=-2, axis2=-1) for v in (first, second)]
    return Comparison(
        -np.sign(up) * miss * cameras[0]["scale_px_per_mm"] * np.exp(-stretch[0][..., 0]),
        points,
        sizes[0] - sizes[1] + stretch[0] - stretch[1], sizes[0] + sizes[1],
        first.log_contrast - second.log_contrast, first.log_contrast + second.log_contrast,
        np.maximum(first.scatter_factor, second.scatter_factor) > 1, variance[0] + variance[1],
    )  # fmt: skip


def outline_extent(table: pd.DataFrame, across: Array) -> tuple[Array, Array]:
    """Compute how far outlines extend along a direction.

    table : detection table with N rows.
    across : (N, 2) for each row, the increase (mm) of the coordinate along this direction per px
        of u and of v.

    Returns two arrays (N,) in mm: the middle of each outline's extent relative to its centre, and
    half of the extent. Harmonics are used if they were fitted.
    """
    a, b, angle = columns(table, AXES_COLUMNS).T
    angle = np.nan_to_num(angle)
    turn = np.stack([np.cos(angle), np.sin(angle)], -1)
    along = (across * turn).sum(-1)
    beside = across[:, 1] * turn[:, 0] - across[:, 0] * turn[:, 1]
    half = np.hypot(a * along, b * beside)
    middle = np.zeros(len(table))
    harmonics = columns(table, HARMONIC_COLUMNS)
    shaped = np.isfinite(harmonics).all(1)
    if shaped.any():
        phi = 2 * np.pi * np.arange(_OUTLINE_SAMPLES) / _OUTLINE_SAMPLES
        cosine, sine = np.cos(phi), np.sin(phi)
        a, b, along, beside = (v[shaped, None] for v in (a, b, along, beside))
        normal = (b * cosine * along + a * sine * beside) / np.hypot(b * cosine, a * sine)
        bump = harmonics[shaped] @ waves(phi)
        profile = a * cosine * along + b * sine * beside + normal * bump
        top, bottom = _peak(profile), -_peak(-profile)
        middle[shaped], half[shaped] = (top + bottom) / 2, (top - bottom) / 2
    return middle, half


def _peak(profile: Array) -> Array:
    """Return the maximum of each row of a periodic profile, refined by a parabola."""
    rows, i = np.arange(len(profile)), np.argmax(profile, axis=1)
    n = profile.shape[1]
    before, here, after = profile[rows, i - 1], profile[rows, i], profile[rows, (i + 1) % n]
    bend = before - 2 * here + after
    bend = np.where(bend < 0, bend, -1.0)
    return np.asarray(here - (after - before) ** 2 / (8 * bend))


def _mm_by_px(camera: Camera, uv_px: Array) -> Array:
    ideal = projection.ideal_from_pixel(uv_px, camera.intrinsics, camera.rho_mm)
    points = np.concatenate([ideal, np.zeros((len(ideal), 1))], -1)
    _, by_point, _ = projection.pixel_jacobians(points, camera.intrinsics, camera.rho_mm, free=())
    return np.asarray(np.linalg.inv(by_point[..., :2]))


def _trust(table: pd.DataFrame) -> tuple[Bools, Array, Array]:
    """Return how far each of N detections can be trusted, as its flags say.

    Returns three arrays (N,): whether the size is known, the factor on the scatter of the gap, and
    the additional standard deviation of the centre as a share of the major semi-axis.
    """
    words = [tuple(row) for row in flag_words(table)]
    trust = {
        row: (
            not any(word in NO_SIZE_FLAGS for word in row),
            max((_SCATTER_FACTOR.get(word, 1.0) for word in row), default=1.0),
            max((_UNSURE_SHARE.get(word, 0.0) for word in row), default=0.0),
        )
        for row in set(words)
    }
    known, factor, unsure = np.array([trust[row] for row in words]).reshape(-1, 3).T
    return known > 0, factor, unsure


_COMBINATIONS_AT_ONCE = 50_000
"""Combinations of detections that are compared together; it limits the memory."""


def near_pairs(
    model: RigModel,
    pair: tuple[int, int],
    views: Sequence[View],
    counts: Ints,
    near: Callable[[Comparison], Bools],
) -> tuple[Comparison, Ints, Ints]:
    """Compare all detections of two cameras in each of F frames, and keep pairs that are ``near``.

    views : of all cameras and detections, which follow each other frame by frame.
    counts : (F, C) detections of the frames.

    Returns E pairs, ascending by frame and first detection; their rows (E, 2) among all detections,
    and their frames (E,).
    """
    a, b = pair
    cameras, counts = (model.cameras[a], model.cameras[b]), counts[:, [a, b]]
    sharing = [[p for p in model.pairs if c in p].index(pair) for c in pair]
    of_axis = sharing[0], sharing[1]
    combinations = counts.prod(1)
    part = np.cumsum(combinations) // _COMBINATIONS_AT_ONCE
    kept, starts = [], np.cumsum(counts, axis=0) - counts
    for one in np.unique(part):
        frames = np.flatnonzero(part == one)
        frame = np.repeat(frames, combinations[frames])
        first = np.cumsum(combinations[frames]) - combinations[frames]
        at = np.arange(len(frame)) - np.repeat(first, combinations[frames])
        rows = starts[frame] + np.stack(np.divmod(at, counts[frame, 1]), -1)
        every = compared(cameras, views[a].take(rows[:, 0]), views[b].take(rows[:, 1]), of_axis)
        good = near(every)
        kept.append((every.take(good), rows[good], frame[good]))
    if not kept:
        none = np.zeros((0, 2), np.int64)
        empty = compared(cameras, views[a].take(none[:, 0]), views[b].take(none[:, 0]), of_axis)
        return empty, none, none[:, 0]
    pairs, rows_of, frames_of = zip(*kept)
    return Comparison.concat(pairs), np.concatenate(rows_of), np.concatenate(frames_of)


@dataclass(frozen=True)
class Groups(Rows):
    """G groups of the detections of one frame, or of several, in C cameras; D is 2 C - 3.

    rows : (G, C) row of the detection of each camera, -1 for none.
    log_odds : (G,) log odds from everything but the tracks, and of `possible_groups` but the
        innovation.
    log_radius : (G,) mean logarithm of the radius in all views (mm); NaN if unknown.
    points_mm, covariance_mm2 : (G, 3), (G, 3, 3) triangulated from all detections of a group.
    left_px : (G, C, 2) centres of the outlines less the pixels of the points; NaN without one.
    axes : (G, 2 C, D) `image_axes` of the points.
    innovation_px, noise_px2 : (G, D), (G, D, D) by how much the middles differ along the axes, and
        its covariance by that of the detections.
    scatter_px2 : (G, D, D) the same by the scatter of the model.
    constant : (G,) logarithm of a density of innovations of images anywhere; without its sign.
    probability : (G,) posterior probabilities; NaN if unknown.
    """

    rows: Ints
    log_odds: Array
    log_radius: Array
    points_mm: Array
    covariance_mm2: Array
    left_px: Array
    axes: Array
    innovation_px: Array
    noise_px2: Array
    scatter_px2: Array
    constant: Array
    probability: Array

    @property
    def ambiguous(self) -> Bools:
        """Whether the posterior log odds are below ``SAFE_LOG_ODDS`` (G,)."""
        odds = np.exp(SAFE_LOG_ODDS)
        return np.asarray(self.probability < (1 - self.probability) * odds)

    @property
    def free(self) -> Ints:
        """Numbers (G,) of axes: 2 n - 3 of n detections."""
        return np.asarray(2 * (self.rows >= 0).sum(1) - 3)

    def unbiased(self, model: RigModel) -> tuple[Array, Array]:
        """Return innovations (G, D) less the model's offsets, and covariances (G, D, D)."""
        basis = model.basis(self.points_mm)
        terms = self.axes[:, :, None] * basis[:, None, :, None]
        flat = terms.reshape(len(self), model.offset_px.size, self.axes.shape[2])
        unsure = flat.mT @ model.offset_covariance_px2 @ flat
        bias = (flat * model.offset_px.ravel()[:, None]).sum(1)
        return self.innovation_px - bias, self.noise_px2 + self.scatter_px2 + unsure

    @staticmethod
    def of(model: RigModel, views: Sequence[View], rows: Ints) -> Groups:
        """Return groups of the rows (G, C) of all detections, -1 for none, triangulated; their
        log odds are 0."""
        seen, shape, both = rows >= 0, (len(rows), len(views), 2), 2 * len(views)
        at = [np.maximum(own, 0) if len(view.uv_px) else None for view, own in zip(views, rows.T)]
        scatter = model.scatter_px2()

        def of_views(name: str, *size: int) -> Array:
            values = [np.zeros((len(rows), *size)) if k is None else getattr(view, name)[k]
                      for view, k in zip(views, at)]  # fmt: skip
            return np.stack(values, 1)

        uv, middle = (np.where(seen[..., None], of_views(name, 2), np.nan)
                      for name in ("uv_px", "middle_px"))  # fmt: skip
        spread = of_views("covariance_px2", 2, 2)
        found = triangulate_views(
            model.cameras, [*np.moveaxis(uv, 1, 0)], tuple(np.moveaxis(spread, 1, 0))
        )
        expected, by_point = stacked_jacobian(model.cameras, found.points_mm)
        by_point, expected = by_point.reshape(*shape, 3), expected.reshape(shape)
        axes = image_axes(by_point, seen)
        each = axes.reshape(*shape, axes.shape[2])
        own = each.mT @ of_views("middle_covariance_px2", 2, 2) @ each
        factor = of_views("scatter_factor") ** 2 * scatter
        none = np.eye(axes.shape[2]) * (axes == 0).all(1)[:, :, None]
        left = np.where(seen[..., None], middle - expected, 0.0).reshape(len(rows), 1, both)
        flat = by_point.reshape(len(rows), both, 3) * np.repeat(seen, 2, 1)[..., None]
        _, size = np.linalg.slogdet(flat.mT @ flat)
        anywhere = np.where(seen, np.log(model.areas_px2), 0.0).sum(1) - size / 2
        constant = anywhere - (seen.sum(1) - 1.5) * np.log(2 * np.pi) - np.log(model.volume_mm3)
        blank = np.zeros(len(rows))
        return Groups(
            rows, blank, blank + np.nan, found.points_mm, found.covariance_mm2, uv - expected,
            axes, (left @ axes)[:, 0], own.sum(1) + none,
            (each.mT @ (each * factor[:, :, None, None])).sum(1), constant, blank + np.nan,
        )  # fmt: skip


def _inverse(matrices: Array) -> tuple[Array, Array]:
    """Return the inverses of matrices (G, D, D), and the logarithms (G,) of their determinants."""
    if matrices.shape[-1] == 1:
        return 1 / matrices, np.log(matrices[:, 0, 0])
    return np.asarray(np.linalg.inv(matrices)), np.linalg.slogdet(matrices)[1]


def _density(groups: Groups, left_px: Array, covariance_px2: Array) -> tuple[Array, Array]:
    """Return chi-square (G,) of innovations, and the log odds of the images being of one point.

    Their density is normal with wider tails (for disturbed outlines), and 0 beyond a limit.
    """
    inverse, size = _inverse(covariance_px2)
    chi2 = (left_px[:, None] @ inverse @ left_px[..., None])[:, 0, 0]
    free, most = groups.free, groups.axes.shape[2]
    typical = (np.trace(covariance_px2, axis1=1, axis2=2) - (most - free)) / free
    wide = 1 + np.clip(3 * typical, _LEAST_TAIL_PX2, _MOST_TAIL_PX2) / typical
    core = (1 - _TAIL) * np.exp(-chi2 / 2)
    tail = _TAIL * wide ** (-free / 2) * np.exp(-chi2 / wide / 2)
    odds = np.log(np.maximum(core + tail, 1e-300)) - size / 2 + groups.constant
    limit = chdtri(np.arange(most + 1), chdtrc(1, GATE2))[free]
    return chi2, np.where(chi2 < wide * limit, odds, NEVER)


def with_innovations(
    groups: Groups, log_odds: Array, frame: Ints, counts: Ints, model: RigModel
) -> tuple[Array, Array, Array]:
    """Return the log odds (G,) of the groups of F frames with their innovations, the shifts
    (F, 2 C) of all cameras that the groups of a frame share, and the groups' probabilities (G,).

    log_odds : (G,) without the innovations. frame : (G,) of the groups, ascending from 0 on.
    counts : (F, C) detections of the frames.
    """
    from telerig.estimator.bubbles.pairing import kernels

    left, noise = groups.unbiased(model)
    prior = model.mean("frame_px") ** 2 / 2
    size = groups.axes.shape[1]
    shift, spread = (
        np.zeros((len(counts), size)),
        np.tile(prior * np.eye(size), (len(counts), 1, 1)),
    )
    weighted = groups.axes @ _inverse(noise)[0]
    pull, own = (weighted @ left[..., None])[..., 0], weighted @ groups.axes.mT
    rows = np.where(groups.rows >= 0, groups.rows + (np.cumsum(counts, 0) - counts)[frame], -1)
    passes = _SHIFT_PASSES if prior > 0 else 0
    for last in range(passes + 1):
        noise_and_shift = noise + groups.axes.mT @ spread[frame] @ groups.axes
        moved = (shift[frame, None] @ groups.axes)[:, 0]
        chi2, density = _density(groups, left - moved, noise_and_shift)
        total = log_odds + density
        probability = kernels.marginals(total, rows, counts.sum(0), NEGLIGIBLE)
        if last < passes:
            weight = probability / (1 + chi2 / groups.free / 4)
            information = _summed(weight[:, None, None] * own, frame, len(counts))
            spread = np.asarray(np.linalg.inv(information + np.eye(size) / prior))
            pulls = _summed(weight[:, None] * pull, frame, len(counts))
            shift = (spread @ pulls[..., None])[..., 0]
    return total, shift, probability


def _summed(values: Array, frame: Ints, many: int) -> Array:
    """Return the sums (F, ...) over the frames of values (G, ...)."""
    out, there = np.zeros((many, *values.shape[1:])), np.unique(frame)
    out[there] = np.add.reduceat(values, np.searchsorted(frame, there), axis=0)
    return out


def candidates_of(
    frames: Sequence[Sequence[pd.DataFrame]], model: RigModel
) -> tuple[list[pd.DataFrame], Ints, list[tuple[Groups, Rays]]]:
    """Return the detections of all frames by camera, their numbers (F, C), and `candidates`.

    frames : for each frame the tables of `detect_bubbles` for all cameras.

    Raises InputError for tables without centres or covariances.
    """
    tables = [pd.concat(own, ignore_index=True) for own in zip(*frames)]
    counts = np.array([[len(table) for table in one] for one in frames])
    return tables, counts, candidates(views_of(tables, model), counts, model)


def candidates(
    views: Sequence[View], counts: Ints, model: RigModel, given: Sequence[Ints] | None = None
) -> list[tuple[Groups, Rays]]:
    """Return for each of F frames the possible groups, with log odds and probabilities of all but
    the tracks, and the detections by themselves.

    The arguments are those of `possible_groups`.
    """
    groups, frame = possible_groups(views, counts, model, given)
    total, _, probability = with_innovations(groups, groups.log_odds, frame, counts, model)
    groups = replace(groups, log_odds=total, probability=probability)
    cuts = np.searchsorted(frame, np.arange(len(counts) + 1)).tolist()
    rays = [on_rays(c, v.uv_px, v.covariance_px2) for c, v in zip(model.cameras, views)]
    ends = np.cumsum(counts, axis=0)
    of_frame = [
        tuple((x[i:j], p[i:j], by[i:j]) for (x, p, by), i, j in zip(rays, first, last))
        for first, last in zip((ends - counts).tolist(), ends.tolist())
    ]
    return [(groups.take(slice(*ends)), own) for own, ends in zip(of_frame, pairwise(cuts))]


def possible_groups(
    views: Sequence[View], counts: Ints, model: RigModel, given: Sequence[Ints] | None = None
) -> tuple[Groups, Ints]:
    """Return the possible groups (G,) of F frames, and their frames (G,), ascending.

    views : of all detections, which follow each other frame by frame.
    counts : (F, C) number of detections in each frame and camera.
    given : for each camera the ids (N,) that came with the detections, -1 for none. Detections of a
        frame with one id are a group that is certain; those with an id are in no other one.

    A gap may be twice as large as that of a pair, because all gaps of a frame shift together.
    """
    edges = [_edges(pair, views, counts, model, given) for pair in model.pairs]
    groups = _grown(edges, views, model)
    many = (groups.rows >= 0).sum(1)
    ends = np.cumsum(counts, axis=0)
    frame = np.max([np.where(own >= 0, np.searchsorted(end, own, "right"), -1)
                    for own, end in zip(groups.rows.T, ends.T)], axis=0)  # fmt: skip
    total, pairs = np.zeros((len(groups), 2)), np.zeros((len(groups), 1))
    for own in edges:
        known, values = own.of(groups.rows)
        total, pairs = total + values, pairs + known[:, None]
    alike, log_radius = (total / pairs).T
    odds = alike * (many - 1) + prior_log_odds(groups, counts[frame], model)
    groups = replace(groups, log_odds=odds, log_radius=log_radius)
    if given is not None and max(own.max(initial=-1) for own in given) >= 0:
        rows, of_rows = _named(given, [np.repeat(np.arange(len(counts)), n) for n in counts.T])
        named = Groups.of(model, views, rows)
        named = replace(named, log_odds=np.full(len(rows), _CERTAIN))
        groups, frame = Groups.concat([named, groups]), np.concatenate([of_rows, frame])
    order = np.argsort(frame, kind="stable")
    groups, frame = groups.take(order), frame[order]
    groups.rows[:] = np.where(groups.rows >= 0, groups.rows - (ends - counts)[frame], -1)
    return groups, frame


def _named(ids: Sequence[Ints], frames: Sequence[Ints]) -> tuple[Ints, Ints]:
    """Return the groups (M, C) of rows with one given id in one frame, and their frames (M,)."""
    own = [np.flatnonzero(i >= 0) for i in ids]
    tall = max((int(f.max(initial=0)) for f in frames), default=0) + 1
    keys = [i[mine] * tall + f[mine] for i, f, mine in zip(ids, frames, own)]
    every, many = np.unique(np.concatenate(keys), return_counts=True)
    every = every[many > 1]
    rows = np.full((len(every), len(ids)), -1)
    for c, (key, mine) in enumerate(zip(keys, own)):
        _, group, one = np.intersect1d(every, key, return_indices=True)
        rows[group, c] = mine[one]
    return rows, every % tall


@dataclass(frozen=True)
class _Edges:
    """E possible pairs of two cameras.

    pair : the cameras. rows : (E, 2) among all detections of both. values : (E, 2) log odds by size
    and contrast, and mean logarithm of the radius.
    """

    pair: tuple[int, int]
    rows: Ints
    values: Array

    def of(self, rows: Ints) -> tuple[Bools, Array]:
        """Return which groups (G, C) contain two detections of these cameras, and values (G, 2)."""
        wanted = rows[:, list(self.pair)]
        base = int(max(self.rows.max(initial=0), wanted.max(initial=0))) + 1
        keys, asked = self.rows @ [base, 1], wanted @ [base, 1]
        order, there = np.argsort(keys), np.asarray((wanted >= 0).all(1))
        out = np.zeros((len(rows), 2))
        out[there] = self.values[order[np.searchsorted(keys, asked[there], sorter=order)]]
        return there, out

    def links(self, camera: int, many: Ints) -> tuple[int, Any]:
        """Return the other camera, and which of its detections (N + 1, M) are linked with those of
        this one; the last row is that of no detection. many : (C,) detections of all cameras."""
        from scipy.sparse import csr_array

        k = self.pair.index(camera)
        other = self.pair[1 - k]
        at = self.rows[:, 1 - k], self.rows[:, k]
        return other, csr_array((np.ones(len(self.rows)), at), (many[other] + 1, many[camera]))


def _edges(
    pair: tuple[int, int],
    views: Sequence[View],
    counts: Ints,
    model: RigModel,
    given: Sequence[Ints] | None,
) -> _Edges:
    """Return the possible pairs of F frames."""
    own, axis = model.pairs[pair], model.gap_axes[pair]
    scatter = model.scatter_px2()[list(pair)].sum()
    blocks = model.offset_covariance_px2.reshape(2 * model.offset_px.shape)
    unsure = np.einsum("i,iajb,j->ab", axis, blocks, axis)

    def near(every: Comparison) -> Bools:
        basis = model.basis(every.points_mm)
        gap = every.gap_px - GAP_PX * (basis @ (axis @ model.offset_px))
        wide = every.variance_px2 + GAP_PX**2 * np.einsum("...a,ab,...b", basis, unsure, basis)
        wide += np.where(every.flagged, _MOST_SCATTER**2, 1.0) * scatter + own.frame_px**2
        return np.asarray(gap**2 < 4 * GATE2 * (wide + 2 * _MOST_TAIL_PX2))

    found, rows, _ = near_pairs(model, pair, views, counts, near)
    alike = appearance_log_odds(found, own)
    good = alike > 2 * NEGLIGIBLE
    if given is not None:
        good &= (given[pair[0]][rows[:, 0]] < 0) & (given[pair[1]][rows[:, 1]] < 0)
    values = np.stack([alike, 0.25 * found.size_sum.sum(-1)], -1)
    return _Edges(pair, rows[good], values[good])


def _grown(edges: Sequence[_Edges], views: Sequence[View], model: RigModel) -> Groups:
    """Return all groups of detections of which every two can be a pair, where their cameras are not
    parallel."""
    size, many = len(views), np.array([len(view.uv_px) for view in views])
    rows = np.concatenate([_in_columns(own.rows, own.pair, size) for own in edges])
    groups = Groups.of(model, views, rows)
    for c in range(1, size) if size > 2 else ():
        parallel = [d for d in range(size) if d != c and tuple(sorted((d, c))) not in model.pairs]
        later = (groups.rows[:, c:] >= 0).any(1)
        later &= ~((groups.rows >= 0)[:, parallel].any(1) & (groups.rows[:, c] < 0))
        base = groups.rows[~later]
        linked: Any = 0
        needed = np.zeros(len(base))
        for other, link in (own.links(c, many) for own in edges if c in own.pair):
            linked = linked + link[np.where(base[:, other] >= 0, base[:, other], many[other])]
            needed += base[:, other] >= 0
        found = linked.tocoo()
        good = found.data == needed[found.row]
        grown = base[found.row[good]]
        grown[:, c] = found.col[good]
        more = Groups.of(model, views, grown)
        left, noise = more.unbiased(model)
        shake = model.mean("frame_px") ** 2 / 2 * more.axes.mT @ more.axes
        groups = Groups.concat([groups, more.take(_density(more, left, noise + shake)[1] > NEVER)])
    _, first = np.unique(groups.rows, axis=0, return_index=True)
    return groups if size == 2 else groups.take(first)


def _in_columns(values: Ints, columns: tuple[int, int], size: int) -> Ints:
    out = np.full((len(values), size), -1)
    out[:, list(columns)] = values
    return out


def prior_log_odds(groups: Groups, counts: Ints, model: RigModel) -> Array:
    """Return the prior log odds (G,) of groups: how many bubbles the same cameras see alone, over
    how many of their detections have no partner. A camera whose image shows the place should see
    the bubble as well.

    counts : (G, C) detections of the frame.
    """
    seen, unmatched = groups.rows >= 0, model.unmatched
    alone = np.log(np.maximum(counts * unmatched, 1e-3))
    there = np.log(np.maximum(counts * (1 - unmatched), 1e-3))
    out = np.where(seen, there, 0).sum(1) / seen.sum(1) - np.where(seen, alone, 0).sum(1)
    if not seen.all():
        expected, _ = stacked_jacobian(model.cameras, groups.points_mm)
        limit = np.array([c.image_size_px for c in model.cameras]) - 1.0
        expected = expected.reshape(-1, *limit.shape)
        inside = ((expected >= 0) & (expected <= limit)).all(-1)
        out += (inside & ~seen).sum(1) * np.log(1 / DETECTION_PROBABILITY - 1)
    return np.asarray(out)


def match(
    groups: Groups, rays: Rays, model: RigModel, predicted: Prediction | None = None
) -> tuple[Ints, Groups]:
    """Return those M groups of a frame that are more probable than not, which are disjoint: their
    positions (M,), and the groups with their posterior probabilities.

    groups, rays : as `candidates` returns them.
    predicted : where tracks are expected; None if there are no tracks.
    """
    from telerig.estimator.bubbles.pairing import kernels

    probability = groups.probability
    if predicted is not None and len(predicted) and len(groups):
        odds = groups.log_odds + track_log_odds(groups, rays, model, predicted)
        counts = np.array([len(points) for points, *_ in rays])
        probability = kernels.marginals(odds, groups.rows, counts, NEGLIGIBLE)
    chosen = np.flatnonzero(probability > 0.5)
    return chosen, replace(groups.take(chosen), probability=probability[chosen])


def track_log_odds(groups: Groups, rays: Rays, model: RigModel, predicted: Prediction) -> Array:
    """Return the log odds (G,) that the predicted tracks add.

    Without tracks groups lie anywhere in the volume that the cameras see. With them most lie where
    a track is expected, and so do the detections of bubbles that only one camera found; one track
    cannot be the unmatched detection of two cameras.
    """
    wider = [
        (points, covariances + common * by_pixel @ by_pixel.mT)
        for common, (points, covariances, by_pixel) in zip(model.apart_px2, rays)
    ]
    scales = np.array([camera["scale_px_per_mm"] for camera in model.cameras])
    blur_px2 = model.mean("scatter_px") ** 2 + model.mean("frame_px") ** 2
    blurred = groups.covariance_mm2 + blur_px2 / np.mean(scales) ** 2 * np.eye(3)
    ends = np.cumsum([len(groups), *(len(points) for points, _ in wider)])
    sizes = np.full(ends[-1], np.nan)
    sizes[: len(groups)] = 2 * np.exp(groups.log_radius)
    near = evidence(
        predicted,
        np.concatenate([groups.points_mm, *(points for points, _ in wider)]),
        np.concatenate([blurred, *(covariances for _, covariances in wider)]),
        sizes,
        size_sd=_SILHOUETTE_SIZE_SD,
    )
    every = np.zeros((ends[-1], len(predicted.ids)))
    every[near.column, near.row] = np.exp(near.scores(np.zeros(3)))
    density, *of_rays, _ = np.split(every, ends)
    expected = (1 - _NEW_SHARE) * DETECTION_PROBABILITY**2 * model.volume_mm3 * density.mean(1)
    total = np.log(expected + _NEW_SHARE)
    depths = model.areas_px2 / scales**2 * np.sqrt(2 * np.pi) * UNKNOWN_MM
    alone = []
    for c, own in enumerate(of_rays):
        usual = max(len(own) * model.unmatched[c], 1e-3)
        relative = DETECTION_PROBABILITY * (1 - DETECTION_PROBABILITY) * depths[c] / usual
        none = np.zeros((1, own.shape[1]))
        alone.append(np.concatenate([relative * own, none])[groups.rows[:, c]])
    sums = [1 + one.sum(1) for one in alone]
    for c, one in enumerate(alone):
        total -= np.log(sums[c])
        for d in range(c):
            both = (one * alone[d]).sum(1) / (sums[c] * sums[d])
            total -= np.log1p(-both)
    return np.asarray(total)
