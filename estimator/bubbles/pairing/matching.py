"""Finds which detection of the second camera shows the same bubble as which of the first.

Two views of one body share the planes that touch it and hold both viewing directions. So along
the common perpendicular of the rays both silhouettes have the same top and the same bottom, for
any body and any angle between the cameras. The *gap* is the mismatch of the two middles, the
*height* half the distance of top and bottom.

Every combination gets log odds: how much better "one bubble seen twice" explains the two
detections than "two detections without a partner". They come from the gap along the shared axis,
the height along it, the width, the contrast, and the predicted tracks. (Blur is not used: views at
an angle are out of focus at different depths.) `PairModel` holds what the two images of one bubble
have in common in a run. One assignment is then the best as a whole, with the option to leave
detections out; an assignment's probability is proportional to the product of exp(log odds) of its
pairs, and each pair has a posterior probability.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import Enum, auto
from functools import cached_property

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.errors import InputError
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    AXES_COLUMNS,
    CENTRE_COLUMNS,
    COVARIANCE_COLUMNS,
    HARMONIC_COLUMNS,
    HARMONICS,
    centre_covariances,
    columns,
    flag_words,
)
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.triangulation import cross, midpoint, nearly_parallel

NO_SIZE_FLAGS = ("border", "merged")
_SCATTER_FACTOR = {"overlap": 2.0, "defocus": 1.5, "saturated": 1.5, "merged": 3.0, "border": 3.0}
"""By flag, the factor on the scatter of a gap."""

_UNSURE_SHARE = {"overlap": 0.01, "merged": 0.05, "border": 0.05}
"""By flag, the standard deviation that a partly hidden outline adds to the centre, as a share of
the major semi-axis."""
_OUTLINE_SAMPLES = 96
"""Points of an outline with harmonics, of which the highest is refined by a parabola."""

Cameras = tuple[Camera, Camera]


@dataclass(frozen=True)
class View(Rows):
    """Hold the N detections of one camera, as `compared` takes them.

    The shared axis is the common perpendicular of both cameras' optical axes.

    uv_px, covariance_px2 : (N, 2) centres (px) and their (N, 2, 2) covariances (px^2).
    origin_mm, direction : (N, 3) origins (mm) and unit directions of the rays in the rig frame.
    mm_by_px : (N, 2, 2) derivative of a point at depth 0 in the camera's frame (mm) by the pixel.
    middle_mm : (N,) position midway between the outline's top and bottom along the shared axis,
        minus the centre's position (mm).
    log_size : (N, 2) logarithms of half the height and half the width (mm), along and across the
        shared axis; NaN where unknown.
    log_contrast : (N, 1) logarithm of the contrast; NaN where unknown.
    scatter_factor : (N,) factor on the scatter of the gap, above 1 for detections with some flags.
    """

    uv_px: Array
    covariance_px2: Array
    origin_mm: Array
    direction: Array
    mm_by_px: Array
    middle_mm: Array
    log_size: Array
    log_contrast: Array
    scatter_factor: Array


@dataclass(frozen=True)
class PairGeometry(Rows):
    """Compare first with second detections, in arrays of any shape (...).

    gap_px : (...) position of the first minus that of the second along the shared axis, in px of
        the first image, including any bias. It is positive along +u or +v of this image, whichever
        is nearer to the axis.
    variance_px2 : (...) variance of the gap that follows from the detections' covariances.
    points_mm : (..., 3) points midway between the two rays, in the rig frame (mm).
    size, size_sum : (..., 2) differences and sums of the logarithms of height and width.
    contrast, contrast_sum : (..., 1) difference and sum of the logarithm of the contrast.
    scatter_factor : (...) the larger of both detections' factors.
    """

    gap_px: Array
    variance_px2: Array
    points_mm: Array
    size: Array
    size_sum: Array
    contrast: Array
    contrast_sum: Array
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


def view_of(table: pd.DataFrame, camera: Camera, axis: Array) -> View:
    """Compute lines of sight and sizes in mm of the bubbles that one camera has detected.

    table : as `detect_bubbles` returns it.
    camera : the calibrated camera.
    axis : (3,) unit vector in the rig frame that is perpendicular to both optical axes, see
        `shared_axis`. Positions and heights are measured along it, widths across it.

    Raises InputError if a column is missing, or if a centre or its covariance is not finite.
    """
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
    origin, direction = camera.unproject(uv)
    mm_by_px = _mm_by_px(camera, uv)
    across = np.einsum("i,nij->nj", (camera.camera_from_rig.rotation @ axis)[:2], mm_by_px)
    middle, height = outline_extent(table, across)
    known, scatter_factor, unsure = _trust(table)
    a, b, measured, contrast = columns(table, ["a_px", "b_px", "area_px2", "contrast"]).T
    extra = np.square(unsure * np.nan_to_num(a))
    area = np.where(measured > 0, measured, np.pi * a * b)
    area_mm2 = area * np.abs(np.linalg.det(mm_by_px))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_height = np.where(known & (height > 0), np.log(height), np.nan)
        log_width = np.log(area_mm2 / np.pi) - log_height
        log_contrast = np.log(contrast)
    return View(
        uv, covariance + extra[:, None, None] * np.eye(2), origin, direction, mm_by_px, middle,
        _finite(np.stack([log_height, log_width], -1)), _finite(log_contrast[:, None]),
        scatter_factor,
    )  # fmt: skip


def compared(cameras: Cameras, first: View, second: View) -> PairGeometry:
    """Compare the detections of two views, whose arrays are broadcast."""
    points, _ = midpoint(first.origin_mm, first.direction, second.origin_mm, second.direction)
    axis = cross(first.direction, second.direction)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    axis *= np.sign(axis @ shared_axis(cameras))[..., None]
    gap = ((first.origin_mm - second.origin_mm) * axis).sum(-1)
    variance, stretch, lengths = np.zeros_like(gap), [], []
    for sign, camera, view in zip((1, -1), cameras, (first, second)):
        pose = camera.camera_from_rig
        depth = points @ pose.rotation[2] + pose.translation_mm[2]
        magnified = 1 + camera["kappa_per_mm"] * depth
        across = ((axis @ pose.rotation.T)[..., None, :2] @ view.mm_by_px)[..., 0, :]
        across = across * magnified[..., None]
        variance += np.einsum("...i,...ij,...j", across, view.covariance_px2, across)
        gap += sign * view.middle_mm * magnified
        stretch.append(np.log(magnified))
        lengths.append(np.linalg.norm(across, axis=-1))
    return PairGeometry(
        gap / lengths[0], variance / lengths[0] ** 2, points,
        first.log_size - second.log_size + (stretch[0] - stretch[1])[..., None],
        first.log_size + second.log_size,
        first.log_contrast - second.log_contrast, first.log_contrast + second.log_contrast,
        np.maximum(first.scatter_factor, second.scatter_factor),
    )  # fmt: skip


_COMBINATIONS_AT_ONCE = 50_000
"""Combinations of detections that are compared together; it limits the memory."""


def near_pairs(
    cameras: Cameras,
    views: tuple[View, View],
    counts: Ints,
    near: Callable[[PairGeometry], Bools],
) -> tuple[PairGeometry, Ints, Ints]:
    """Compare all detections of each of F frames, and keep pairs with gaps that are small enough.

    views : of all detections, which follow each other frame by frame. counts : (F, 2) of the
    frames. near : says which pairs are kept.

    Returns E pairs, ascending by frame and first detection; their rows (E, 2) among all detections,
    and their frames (E,).
    """
    combinations = counts.prod(1)
    part = np.cumsum(combinations) // _COMBINATIONS_AT_ONCE
    kept, starts = [], np.cumsum(counts, axis=0) - counts
    for one in np.unique(part):
        frames = np.flatnonzero(part == one)
        frame = np.repeat(frames, combinations[frames])
        first = np.cumsum(combinations[frames]) - combinations[frames]
        at = np.arange(len(frame)) - np.repeat(first, combinations[frames])
        rows = starts[frame] + np.stack(np.divmod(at, counts[frame, 1]), -1)
        every = compared(cameras, *(v.take(i) for v, i in zip(views, rows.T)))
        good = near(every)
        kept.append((every.take(good), rows[good], frame[good]))
    if not kept:
        none = np.zeros((0, 2), np.int64)
        return compared(cameras, *(v.take(none[:, 0]) for v in views)), none, none[:, 0]
    pairs, rows_of, frames_of = zip(*kept)
    return PairGeometry.concat(pairs), np.concatenate(rows_of), np.concatenate(frames_of)


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
        waves = np.stack([f(k * phi) for k in HARMONICS for f in (np.cos, np.sin)])
        profile = a * cosine * along + b * sine * beside + normal * (harmonics[shaped] @ waves)
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


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)


NEGLIGIBLE = -9.0
"""Log odds below which a pair is never considered: its probability stays under exp(-9)."""


@dataclass(frozen=True)
class LogRatioModel:
    """Describe how the logarithms of K properties differ between the two images of one bubble.

    difference, scatter : (K,) mean and (K, K) covariance of first minus second, over true pairs.
    means : (2, K) means over all bubbles in the first and in the second view.
    spread : (K, K) covariance over all bubbles of a view.
    """

    difference: Array
    scatter: Array
    means: Array
    spread: Array

    @property
    def sd(self) -> Array:
        """Return the standard deviation (K,) of each property's difference."""
        return np.sqrt(np.diag(self.scatter))

    @cached_property
    def uncorrelated(self) -> tuple[Array, Array]:
        """Return the axes (K, K) in which scatter and population are both uncorrelated (generalised
        eigenvectors, as columns), and the correlation (K,) of two images of one bubble there."""
        from scipy.linalg import eigh

        relative, axes = eigh(self.scatter, self.spread)
        return axes, np.clip(1 - relative / 2, 0.0, 1 - 1e-6)


def bias_basis(points_mm: Array, origin_mm: Array, reach_mm: Array, terms: int) -> Array:
    """Return the terms (..., B) of an error of the calibration at points (..., 3) of the rig frame.

    origin_mm, reach_mm : (3,) origin and scale. terms : B, which is 1, 4 or 10, see `PairModel`.
    """
    scaled = (points_mm - origin_mm) / reach_mm
    x, y, z = np.moveaxis(np.clip(scaled, -1.5, 1.5), -1, 0)
    every = [np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
    return np.stack(every[:terms], -1)


class Finding(Enum):
    """Name what `estimate_pair_model` has to tell the user; `PairModel.sentences` explains each."""

    NO_DETECTIONS = auto()
    CALIBRATION_OFFSET = auto()
    OFFSET_VARIES = auto()
    FEW_PAIRS = auto()
    UNCLEAR_OFFSET = auto()
    CAMERA_SHAKE = auto()


@dataclass(frozen=True)
class PairModel:
    """Describe how the two images of one bubble agree; `estimate_pair_model` learns it from a run.

    A gap is the distance between two detections along the axis that both cameras share, in px of
    the first image.

    bias_px, bias_covariance_px2 : (B,) coefficients of the gap's systematic part (px) and their
        (B, B) covariance (px^2). B is 1, 4 or 10: a constant; with x, y, z; with all products of
        two of these. x, y, z are the point's coordinates in the rig frame minus ``origin_mm``,
        divided by ``reach_mm``.
    origin_mm, reach_mm : (3,) origin and scale of these coordinates (mm).
    scatter_px : standard deviation of single gaps beyond the detections' own covariance.
    frame_px : standard deviation of a shift that all gaps of a frame share (the cameras shake).
    size : model for height and width (mm), along and across the shared axis.
    contrast : model for the contrast.
    unmatched_share : for each view, the share of its detections that have no partner.
    span_px : length of the shared coordinate that both images cover.
    pairs : number of pairs from which it was learnt (a sum of probabilities); 0 if not learnt.
    mean_gap_px : mean of the pairs' gaps and its standard error.
    rms_px : RMS of the gaps, less the shift of their frame: as they are; without the constant;
        without the whole bias; and without a bias that is fitted without the pair itself.
    findings : what the user should know.
    """

    bias_px: Array
    bias_covariance_px2: Array
    origin_mm: Array
    reach_mm: Array
    scatter_px: float
    frame_px: float
    size: LogRatioModel
    contrast: LogRatioModel
    unmatched_share: tuple[float, float]
    span_px: float
    pairs: float = 0.0
    mean_gap_px: tuple[float, float] = (0.0, 0.0)
    rms_px: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    findings: tuple[Finding, ...] = ()

    @property
    def gap_rms_px(self) -> float:
        """Return the RMS of the gaps as they are."""
        return self.rms_px[0]

    @property
    def calibration_problem(self) -> bool:
        """Return whether the gaps have a systematic part beyond chance and beyond half a pixel."""
        return bool({Finding.CALIBRATION_OFFSET, Finding.OFFSET_VARIES} & set(self.findings))

    def basis(self, points_mm: Array, terms: int | None = None) -> Array:
        """Return the terms (..., B) of the bias at points (..., 3) of the rig frame (mm).

        terms : number B of terms (1, 4 or 10); None takes that of this model.
        """
        count = len(self.bias_px) if terms is None else terms
        return bias_basis(points_mm, self.origin_mm, self.reach_mm, count)

    def bias(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the systematic distance (...) in px between the two images of one point along the
        coordinate that both cameras share (0 for a right calibration), and its variance in px^2.

        points_mm : (..., 3) points in the rig frame, in mm.
        """
        basis = self.basis(points_mm)
        variance = np.einsum("...i,ij,...j", basis, self.bias_covariance_px2, basis)
        return basis @ self.bias_px, np.asarray(variance)

    def sentences(self, without: Collection[Finding] = ()) -> list[str]:
        """Return a summary and a text for each finding except those in ``without``."""
        if Finding.NO_DETECTIONS in self.findings:
            return [
                "No frame has detections in both cameras, so there are no pairs, and offset and "
                "scatter of the ray misses are unknown."
            ]
        offset, error = self.mean_gap_px
        raw, after_constant, after_all, left_out = self.rms_px
        texts = {
            Finding.CALIBRATION_OFFSET: (
                "This is a calibration problem: in the coordinate that both cameras share, the "
                f"cameras differ by {offset:+.2f} px. Without this constant offset the ray misses "
                f"are {after_constant:.2f} px RMS. The offset does not affect the pairing, but all "
                "positions contain it: calibrate the rig again."
            ),
            Finding.OFFSET_VARIES: (
                "The offset changes over the volume: a smooth function of position reduces the "
                f"ray misses from {after_constant:.2f} px RMS to {after_all:.2f} px "
                f"({left_out:.2f} px for pairs left out of the fit). Possible causes are "
                "distortion, refraction and the cameras' timing."
            ),
            Finding.FEW_PAIRS: (
                "There are too few pairs to distinguish a biased calibration from wrong pairs."
            ),
            Finding.UNCLEAR_OFFSET: (
                "Other offsets explain the run almost as well, because the bubbles' sizes are too "
                "similar. Trust these pairs only where tracks confirm them, or calibrate again."
            ),
            Finding.CAMERA_SHAKE: (
                f"All ray misses of a frame shift together by {self.frame_px:.2f} px RMS from "
                "frame to frame, because the cameras shake relative to each other."
            ),
        }
        return [
            f"The run gives {self.pairs:.1f} pairs. The two rays of a pair miss each other by "
            f"{raw:.2f} px RMS along the axis that the cameras share, less what all pairs of a "
            f"frame have in common, and on average by {offset:+.2f} ± {error:.2f} px.",
            *(text for finding, text in texts.items() if finding in {*self.findings} - {*without}),
        ]


_WRONG_SIZE, _WRONG_SIZE_FLAGGED, _WRONG_CONTRAST = 1e-6, 0.02, 0.05
"""Probabilities that a size or contrast is unrelated to the bubble."""

_IMPOSSIBLE, _IMPOSSIBLE_SIGMA = 0.15, 10.0
"""Difference of the logarithms of two heights that no outline shows, itself and in sd."""

_UNKNOWN_SIZE = 2.0
"""Log odds against a pair with a bubble that is cut or merged: its partner is often unseen."""

_RARE, _FREEDOM = 2.5, 6.0
"""Limit of the rareness of a size (sd), and degrees of freedom of the differences' tails."""


def unbiased(geometry: PairGeometry, model: PairModel) -> tuple[Array, Array]:
    """Return gaps (px) less the model's bias, and their variances (px^2)."""
    bias, variance = model.bias(geometry.points_mm)
    own = geometry.variance_px2 + variance + (model.scatter_px * geometry.scatter_factor) ** 2
    return geometry.gap_px - bias, own


def appearance_log_odds(geometry: PairGeometry, model: PairModel) -> Array:
    """Return the log odds (...) of pairs from height, width and contrast.

    If two heights differ by more than any measurement error, the pair is excluded; for flagged
    detections this limit is twice as large.
    """
    from telerig.estimator.bubbles.pairing import kernels

    flagged = geometry.scatter_factor > 1
    wrong = np.where(flagged, _WRONG_SIZE_FLAGGED, _WRONG_SIZE)
    odds = _ratio_log_odds(model.size, geometry.size, geometry.size_sum, wrong)
    apart = np.abs(geometry.size[..., 0] - model.size.difference[0])
    limit = max(_IMPOSSIBLE, _IMPOSSIBLE_SIGMA * model.size.sd[0])
    odds[apart > np.where(flagged, 2 * limit, limit)] = kernels.NEVER
    odds -= np.where(np.isfinite(apart), 0.0, _UNKNOWN_SIZE)
    wrong = np.full(flagged.shape, _WRONG_CONTRAST)
    return odds + _ratio_log_odds(model.contrast, geometry.contrast, geometry.contrast_sum, wrong)


def prior_log_odds(counts: Ints, unmatched: tuple[float, float]) -> Array:
    """Return the prior log odds of a pair in a frame.

    counts : (..., 2) detections of the frame in both views.
    unmatched : for each view, the expected share of detections without a partner.
    """
    alone = np.maximum(counts * np.array(unmatched), 1e-3)
    pairs = np.sqrt((counts * (1 - np.array(unmatched))).prod(-1))
    return np.asarray(np.log(np.maximum(pairs, 1e-3) / alone.prod(-1)))


def _ratio_log_odds(expected: LogRatioModel, ratio: Array, total: Array, wrong: Array) -> Array:
    """Log odds (...) of properties: two noisy images of one bubble, or of two bubbles.

    In the axes in which scatter and population are both uncorrelated, two images of one bubble
    have correlation 1 - scatter / 2; the log odds are those of the two normal distributions, with
    the tails of Student's t. How rare a bubble is counts to ``_RARE`` standard deviations.
    ratio, total : (..., K) differences and sums of the logarithms; pairs with unknown ones get 0.
    wrong : (...) probability that a measurement is unrelated to the bubble.
    """
    axes, alike = expected.uncorrelated
    apart = np.square((ratio - expected.difference) @ axes)
    own = np.square(np.clip((total - expected.means.sum(0)) @ axes / 2, -_RARE, _RARE))
    odds = own @ (alike / (1 + alike)) + apart.sum(-1) / 4 - np.log1p(-np.square(alike)).sum() / 2
    tails = np.log1p(apart @ (0.5 / (1 - alike)) / _FREEDOM)
    odds += np.log1p(-wrong) - (_FREEDOM + len(alike)) / 2 * tails
    known = np.isfinite(odds)
    return np.where(known, np.logaddexp(np.where(known, odds, 0.0), np.log(wrong)), 0.0)
