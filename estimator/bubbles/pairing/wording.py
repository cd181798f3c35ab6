"""The pair model in plain words."""

from __future__ import annotations

from dataclasses import replace

from telerig.estimator.bubbles.pairing.types import PairModel

LEAST_PROBLEM_PX = 0.5
_SIGNIFICANT = 4.0
_FEW_PAIRS = 5.0
_CLEAR_VOTE = 3.0


def describe(model: PairModel, votes: float) -> PairModel:
    """The model with its words; votes : how far the bias stood out in the first vote."""
    constant, error = model.mean_gap_px
    raw, after_constant, after_all, left_out = model.rms_px
    problem = abs(constant) > max(LEAST_PROBLEM_PX, _SIGNIFICANT * error)
    uneven = len(model.bias_px) > 1 and after_constant > max(LEAST_PROBLEM_PX, 1.5 * after_all)
    words = [
        f"{model.pairs:.1f} pairs; the rays of a pair miss each other by {raw:.2f} px RMS along "
        f"the shared axis, {constant:+.2f} +- {error:.2f} px on average."
    ]
    offset = ""
    if problem:
        offset = (
            f"This is a calibration problem: the shared coordinate is off by {constant:+.2f} px; "
            f"with that constant removed {after_constant:.2f} px RMS remain. Matching removes it; "
            "positions keep it until the rig is calibrated again."
        )
        words.append(offset)
    if uneven:
        words.append(
            f"The offset changes over the volume: a smooth term brings {after_constant:.2f} px RMS "
            f"to {after_all:.2f} ({left_out:.2f} for pairs left out of it). Distortion, refraction "
            "or timing could do this; one frame cannot tell."
        )
    if model.pairs < _FEW_PAIRS:
        words.append("Too few pairs to tell a biased calibration from wrong pairs.")
    elif votes < _CLEAR_VOTE:
        words.append(
            "The offset hardly stands out among the possible ones: sizes are too much alike. "
            "Trust these pairs only with history, or calibrate anew."
        )
    if model.frame_px > max(0.1, model.scatter_px / 2):
        words.append(
            f"All gaps of a frame shift together by {model.frame_px:.2f} px RMS: the cameras shake "
            "against each other."
        )
    return replace(
        model,
        words=tuple(words),
        offset_words=offset,
        calibration_problem=bool(problem or uneven),
    )
