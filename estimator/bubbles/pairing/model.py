"""What the images of one bubble have in common in a run; `learning` learns it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum, auto
from functools import cached_property

import numpy as np

from telerig.arrays import Array, Bools, Rows
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

NEVER = -1e6
"""Log odds of what is impossible."""

GAP_PX = 2**0.5
"""A gap is the difference of two images along their common axis. It has so many standard deviations
of one image."""


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
    """Name what `learn_rig` has to tell the user; `PairModel.sentences` explains each."""

    NO_DETECTIONS = auto()
    CALIBRATION_OFFSET = auto()
    OFFSET_VARIES = auto()
    FEW_PAIRS = auto()
    UNCLEAR_OFFSET = auto()
    CAMERA_SHAKE = auto()


@dataclass(frozen=True)
class PairModel:
    """Describe how the two images of one bubble agree, learnt from a run.

    A gap is the difference between two images along the axis that both cameras share, in px. It is
    positive if the first image lies along +u or +v, whichever is nearer to the axis.

    scatter_px : standard deviation of single gaps beyond the detections' own covariance.
    frame_px : standard deviation of a shift that all gaps of a frame share (the cameras shake).
    size : model for height and width (mm), along and across the shared axis.
    contrast : model for the contrast.
    unmatched_share : for each view, the share of its detections that have no partner.
    span_px : length of the shared coordinate that both images cover.
    pairs : number of pairs from which it was learnt (a sum of probabilities); 0 if not learnt.
    mean_gap_px : mean of the pairs' gaps and its standard error.
    bias_px : (B,) coefficients of the systematic part of the gaps, see `bias_basis`.
    rms_px : RMS of the gaps, less the shift of their frame: as they are; without the constant;
        without the whole bias; and without a bias that is fitted without the pair itself.
    findings : what the user should know.
    """

    scatter_px: float
    frame_px: float
    size: LogRatioModel
    contrast: LogRatioModel
    unmatched_share: tuple[float, float]
    span_px: float
    pairs: float = 0.0
    mean_gap_px: tuple[float, float] = (0.0, 0.0)
    bias_px: tuple[float, ...] = (0.0,)
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
            f"The run gives {self.pairs:.0f} pairs. The two rays of a pair miss each other by "
            f"{raw:.2f} px RMS along the axis that the cameras share, less what all pairs of a "
            f"frame have in common, and on average by {offset:+.3f} ± {error:.2g} px.",
            *(text for finding, text in texts.items() if finding in {*self.findings} - {*without}),
        ]


@dataclass(frozen=True)
class RigModel:
    """Describe how the images of one bubble agree in C cameras; `learn_rig` learns it from a run.

    pairs : the model of each pair of cameras (indices, in ascending order) whose lines of sight are
        not parallel.
    offset_px, offset_covariance_px2 : (2 C, B), (2 C B, 2 C B) systematic deviations of u and v of
        each camera from the pixels of a common point, as coefficients of `bias_basis`, and their
        covariance. A part that a shift of all points explains has no effect.
    origin_mm, reach_mm : (3,) for `bias_basis`.
    misplaced : if one camera's images lie elsewhere than the calibration says, beyond chance and
        half a pixel: its index, and by how much in u and v (px).
    """

    cameras: tuple[Camera, ...]
    pairs: dict[tuple[int, int], PairModel]
    offset_px: Array
    offset_covariance_px2: Array
    origin_mm: Array
    reach_mm: Array
    misplaced: tuple[int, float, float] | None = None

    def basis(self, points_mm: Array, terms: int | None = None) -> Array:
        """Return `bias_basis` at points (..., 3), with as many terms as the offsets have."""
        count = self.offset_px.shape[1] if terms is None else terms
        return bias_basis(points_mm, self.origin_mm, self.reach_mm, count)

    def offset(self, points_mm: Array) -> Array:
        """Return the systematic deviations (..., 2 C) in px at points (..., 3)."""
        return np.asarray(self.basis(points_mm) @ self.offset_px.T)

    def mean(self, name: str, camera: int | None = None) -> float:
        """Return the RMS over the pairs (of a camera) of a field of their models."""
        values = [getattr(m, name) for p, m in self.pairs.items() if camera is None or camera in p]
        return float(np.sqrt(np.mean(np.square(values))))

    def scatter_px2(self) -> Array:
        """Return the variance (C,) of an image beyond its own covariance: half of that of gaps."""
        return np.array([self.mean("scatter_px", c) ** 2 for c in range(len(self.cameras))]) / 2

    @cached_property
    def apart_px2(self) -> Array:
        """Return the variance (C,) of an image's place against that of a track: scatter, shift of a
        frame, and the constant part of the offsets."""
        out = []
        for c in range(len(self.cameras)):
            bias = [m.bias_px[0] for pair, m in self.pairs.items() if c in pair]
            common = self.mean("scatter_px", c) ** 2 + self.mean("frame_px", c) ** 2
            out.append(common + float(np.mean(np.square(bias))) / 4)
        return np.array(out)

    @cached_property
    def unmatched(self) -> Array:
        """Return for each camera (C,) the mean share of its detections without a partner."""
        own = [[m.unmatched_share[p.index(c)] for p, m in self.pairs.items() if c in p]
               for c in range(len(self.cameras))]  # fmt: skip
        return np.array([np.mean(shares) for shares in own])

    @cached_property
    def gap_axes(self) -> dict[tuple[int, int], Array]:
        """Return for each pair the unit vector (2 C,) of pixels along which its gap is measured."""
        _, by_point = stacked_jacobian(self.cameras, self.origin_mm[None])
        by_point = by_point.reshape(1, -1, 2, 3)
        seen = np.arange(len(self.cameras))
        out = {}
        for a, b in self.pairs:
            axis = image_axes(by_point, ((seen == a) | (seen == b))[None])[0, :, 0]
            first = axis[2 * a : 2 * a + 2]
            out[a, b] = axis * np.sign(first[np.argmax(np.abs(first))])
        return out

    @cached_property
    def volume_mm3(self) -> float:
        """Return the volume that the images of two cameras show."""
        a, b = next(iter(self.pairs))
        lines = [self.cameras[c].camera_from_rig.rotation[2] for c in (a, b)]
        sine = np.linalg.norm(np.cross(*lines))
        scale = self.cameras[a]["scale_px_per_mm"]
        span = self.pairs[a, b].span_px
        return float(self.areas_px2[[a, b]].prod() / span / scale**3 / sine)

    @cached_property
    def areas_px2(self) -> Array:
        """Return the areas (C,) of the images."""
        return np.array([float(np.prod(c.image_size_px)) for c in self.cameras])


def image_axes(by_point: Array, seen: Bools) -> Array:
    """Return the directions of pixels in which n images of a point cannot differ.

    by_point : (G, C, 2, 3) derivatives of the pixels by G points. seen : (G, C) cameras with an
    image of the point.

    Returns unit vectors (G, 2 C, 2 C - 3) that are perpendicular to each other, 2 n - 3 of them of
    n cameras, and zeros.
    """
    there = np.repeat(seen, 2, axis=1).astype(float)
    flat = by_point.reshape(*there.shape, 3) * there[..., None]
    left = there[:, :, None] * np.eye(there.shape[1])
    left -= flat @ np.linalg.solve(flat.mT @ flat, flat.mT)
    out = np.zeros((*there.shape, there.shape[1] - 3))
    each = np.arange(len(there))
    for d in range(out.shape[2]):
        variance = np.diagonal(left, axis1=1, axis2=2)
        k = variance.argmax(1)
        own = left[each, k] / np.sqrt(np.maximum(variance[each, k], 1e-9))[:, None]
        out[..., d] = own * (d < 2 * seen.sum(1) - 3)[:, None]
        left -= own[:, :, None] * own[:, None, :]
    return out


@dataclass(frozen=True)
class Comparison(Rows):
    """Compare first with second detections, in arrays of any shape (...).

    gap_px : (...) position of the first minus that of the second along the shared axis, in px of
        the first image, including any bias. It is positive along +u or +v of this image, whichever
        is nearer to the axis.
    points_mm : (..., 3) points midway between the two rays, in the rig frame (mm).
    size, size_sum : (..., 2) differences and sums of the logarithms of height and width.
    contrast, contrast_sum : (..., 1) difference and sum of the logarithm of the contrast.
    flagged : (...) whether a flag says that an outline is disturbed.
    variance_px2 : (...) largest variance of the gap that the detections' covariances allow.
    """

    gap_px: Array
    points_mm: Array
    size: Array
    size_sum: Array
    contrast: Array
    contrast_sum: Array
    flagged: Bools
    variance_px2: Array


_WRONG_SIZE, _WRONG_SIZE_FLAGGED, _WRONG_CONTRAST = 1e-6, 0.02, 0.05
"""Probabilities that a size or contrast is unrelated to the bubble."""

_IMPOSSIBLE, _IMPOSSIBLE_SIGMA = 0.15, 10.0
"""Difference of the logarithms of two heights that no outline shows, itself and in sd."""

_UNKNOWN_SIZE = 2.0
"""Log odds against a pair with a bubble that is cut or merged: its partner is often unseen."""

_RARE, _FREEDOM = 2.5, 6.0
"""Limit of the rareness of a size (sd), and degrees of freedom of the differences' tails."""


def appearance_log_odds(found: Comparison, model: PairModel) -> Array:
    """Return the log odds (...) of pairs from height, width and contrast.

    If two heights differ by more than any measurement error, the pair is excluded; for flagged
    detections this limit is twice as large.
    """
    wrong = np.where(found.flagged, _WRONG_SIZE_FLAGGED, _WRONG_SIZE)
    odds = _ratio_log_odds(model.size, found.size, found.size_sum, wrong)
    apart = np.abs(found.size[..., 0] - model.size.difference[0])
    limit = max(_IMPOSSIBLE, _IMPOSSIBLE_SIGMA * model.size.sd[0])
    odds[apart > np.where(found.flagged, 2 * limit, limit)] = NEVER
    odds -= np.where(np.isfinite(apart), 0.0, _UNKNOWN_SIZE)
    wrong = np.full(apart.shape, _WRONG_CONTRAST)
    return odds + _ratio_log_odds(model.contrast, found.contrast, found.contrast_sum, wrong)


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
