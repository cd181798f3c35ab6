"""What matching knows beforehand, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Cue:
    """How the logarithms of K properties compare between the two images of one bubble.

    difference, scatter : (K,), (K, K) mean and covariance of first - second over true pairs.
    means : (2, K) over all bubbles, in the first and in the second view.
    spread : (K, K) covariance over all bubbles of a view.
    """

    difference: Array
    scatter: Array
    means: Array
    spread: Array

    @property
    def sd(self) -> Array:
        """(K,) scatter of each property."""
        return np.sqrt(np.diag(self.scatter))


@dataclass(frozen=True)
class PairModel:
    """What the two images of one bubble have in common, learnt from a run (`estimate_pair_model`).

    bias_px, bias_covariance_px2 : (B,), (B, B) coefficients of the gap's systematic part: 1, then
        with B = 4 x y z, with B = 10 also xx yy zz xy xz yz of the rig point less ``origin_mm``
        over ``reach_mm``.
    scatter_px : of single gaps beyond the detections' own covariance.
    frame_px : of a shift common to all gaps of a frame (the cameras shake).
    size : of (height, width) in mm, along and across the shared axis.  contrast : see `Cue`.
    lonely : share of the detections of each view without a partner.
    span_px : length of the shared coordinate that both images cover, in px of the first.
    pairs : number of pairs it rests on (a sum of probabilities); 0 for a model not learnt.
    mean_gap_px : mean of the pairs' gaps (the best constant) and its standard error.
    rms_px : root mean square of the gaps as they are, after the constant, after the whole bias,
        and with every pair left out of its own bias.
    calibration_problem : the gaps' systematic part is beyond chance and beyond half a pixel.
    words : the finding in plain words, one sentence each.
    offset_words : of these the sentence on a constant offset of the calibration; "" without.
    """

    bias_px: Array
    bias_covariance_px2: Array
    origin_mm: Array
    reach_mm: Array
    scatter_px: float
    frame_px: float
    size: Cue
    contrast: Cue
    lonely: tuple[float, float]
    span_px: float
    pairs: float = 0.0
    mean_gap_px: tuple[float, float] = (0.0, 0.0)
    rms_px: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    calibration_problem: bool = False
    words: tuple[str, ...] = ()
    offset_words: str = ""

    def basis(self, points_mm: Array, terms: int | None = None) -> Array:
        """(..., 3) rig points -> (..., B) terms of the bias."""
        scaled = (points_mm - self.origin_mm) / self.reach_mm
        x, y, z = np.moveaxis(np.clip(scaled, -1.5, 1.5), -1, 0)
        every = [np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
        return np.stack(every[: len(self.bias_px) if terms is None else terms], -1)

    def bias(self, points_mm: Array) -> tuple[Array, Array]:
        """(...,) systematic gap (px) at rig points, and its variance (px^2)."""
        basis = self.basis(points_mm)
        variance = np.einsum("...i,ij,...j", basis, self.bias_covariance_px2, basis)
        return basis @ self.bias_px, np.asarray(variance)


@dataclass(frozen=True)
class Alternative:
    """A pair that might be instead; row -1: the other row has no partner at all."""

    first: int
    second: int
    probability: float


@dataclass(frozen=True)
class Matches:
    """Pairs of one frame. Rows are positions in the two detection tables.

    first, second : (M,) rows.  confidence : (M,) posterior probability of the pair.
    gap_px, gap_sigma : (M,) mismatch along the shared axis, first less second, the model's bias
        and the frame's common shift removed; in px of the first image and in standard deviations.
    height_ratio : (M,) height (mm) in the first view over that in the second; NaN where unknown.
    ambiguous : (M,) whether another hypothesis is less than ``SAFE_NATS`` away.
    alternatives : per pair what else may be true, most probable first.
    particle : (M,) id of the predicted track that explains the pair best, -1 without one.
    lonely_first, lonely_second : rows without a partner.
    frame_shift_px : the shift common to this frame's gaps.
    """

    first: Index
    second: Index
    confidence: Array
    gap_px: Array
    gap_sigma: Array
    height_ratio: Array
    ambiguous: NDArray[np.bool_]
    alternatives: tuple[tuple[Alternative, ...], ...]
    particle: Index
    lonely_first: Index
    lonely_second: Index
    frame_shift_px: float = 0.0
    probabilities: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)

    def __len__(self) -> int:
        return len(self.first)
