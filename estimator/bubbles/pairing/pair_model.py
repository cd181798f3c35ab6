"""What the two images of one bubble have in common in a run, and the findings in plain words."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LogRatioModel:
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


class Finding(Enum):
    """What `estimate_pair_model` found beside the numbers."""

    NO_DETECTIONS = auto()
    CALIBRATION_OFFSET = auto()
    OFFSET_VARIES = auto()
    FEW_PAIRS = auto()
    UNCLEAR_OFFSET = auto()
    CAMERA_SHAKE = auto()


@dataclass(frozen=True)
class PairModel:
    """What the two images of one bubble have in common, learnt from a run (`estimate_pair_model`).

    bias_px, bias_covariance_px2 : (B,), (B, B) coefficients of the gap's systematic part: 1, then
        with B = 4 x y z, with B = 10 also xx yy zz xy xz yz of the rig point less ``origin_mm``
        over ``reach_mm``.
    scatter_px : of single gaps beyond the detections' own covariance.
    frame_px : of a shift common to all gaps of a frame (the cameras shake).
    size : of (height, width) in mm, along and across the shared axis.  contrast : of the contrast.
    unmatched_share : share of the detections of each view without a partner.
    span_px : length of the shared coordinate that both images cover, in px of the first.
    pairs : number of pairs it rests on (a sum of probabilities); 0 for a model not learnt.
    mean_gap_px : mean of the pairs' gaps (the best constant) and its standard error.
    rms_px : root mean square of the gaps as they are, after the constant, after the whole bias,
        and with every pair left out of its own bias.
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
    def calibration_problem(self) -> bool:
        """Whether the gaps' systematic part is beyond chance and beyond half a pixel."""
        return bool({Finding.CALIBRATION_OFFSET, Finding.OFFSET_VARIES} & set(self.findings))

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

    def sentences(self, without: Collection[Finding] = ()) -> list[str]:
        """The findings in plain words, one string each, but those in ``without``."""
        if Finding.NO_DETECTIONS in self.findings:
            return ["No frame has detections in both cameras: nothing was learnt about the pairs."]
        offset, error = self.mean_gap_px
        raw, after_constant, after_all, left_out = self.rms_px
        texts = {
            Finding.CALIBRATION_OFFSET: (
                "This is a calibration problem: the coordinate that both cameras share is off by "
                f"{offset:+.2f} px. With that constant removed, {after_constant:.2f} px RMS "
                "remain. The matching removes the offset; the positions keep it until the rig is "
                "calibrated again."
            ),
            Finding.OFFSET_VARIES: (
                "The offset changes over the volume: a smooth function of position reduces the "
                f"gaps from {after_constant:.2f} px RMS to {after_all:.2f} px "
                f"({left_out:.2f} px for pairs left out of the fit). Possible causes are "
                "distortion, refraction and the cameras' timing."
            ),
            Finding.FEW_PAIRS: (
                "There are too few pairs to distinguish a biased calibration from wrong pairs."
            ),
            Finding.UNCLEAR_OFFSET: (
                "The offset hardly stands out among the possible ones, because the bubbles' sizes "
                "are too similar. Trust these pairs only where tracks confirm them, or calibrate "
                "again."
            ),
            Finding.CAMERA_SHAKE: (
                f"All gaps of a frame shift together by {self.frame_px:.2f} px RMS: the cameras "
                "shake against each other."
            ),
        }
        return [
            f"The run gives {self.pairs:.1f} pairs. The two rays of a pair miss each other by "
            f"{raw:.2f} px RMS along the axis that the cameras share, on average by "
            f"{offset:+.2f} +- {error:.2f} px.",
            *(text for finding, text in texts.items() if finding in {*self.findings} - {*without}),
        ]
