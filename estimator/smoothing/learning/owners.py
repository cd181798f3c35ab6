"""Decides whether a spectral line of a model is the rig's or the bubbles'.

With one bubble the likelihood is the same for both owners; several bubbles, marks or accelerometers
make the owner identifiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.learning.likelihood import evidence, maximise
from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode, ShakeModel
from telerig.factors.bubble_motion import Zigzag

L = TypeVar("L", RigMode, Zigzag)

AMBIGUOUS_LOG_RATIO = 5.0
HARMONIC_LOG_RATIO = 7.0
_SAME_HZ = 0.02
_HARMONIC = 0.12
_REFIT_LOG_RATIO = 40.0
_ZIGZAG_MM = 0.3
_ZIGZAG_HZ = (3.0, 12.0)


@dataclass(frozen=True)
class Attribution:
    """The owner of a spectral line.

    owner : "rig" or "bubble".
    index : of the line among the model's modes or zigzags.
    log_likelihood_ratio : to the other owner, with the lines refitted.
    log_prior_ratio : from prior knowledge; positive for a zigzag's second harmonic.
    """

    owner: str
    index: int
    frequency_hz: float
    rms_mm: float
    log_likelihood_ratio: float
    log_prior_ratio: float = 0.0

    @property
    def ambiguous(self) -> bool:
        return self.log_likelihood_ratio + self.log_prior_ratio < AMBIGUOUS_LOG_RATIO


def attributions(
    signals: Sequence[Signal], model: ShakeModel, pattern: Sequence[float], up: Array
) -> list[Attribution]:
    """Return the owners of the lines that could be a common mode of the rig or the bubbles'.

    pattern : (3,) axes of the rig along which lines are tested.
    up : (3,) unit vector against gravity.
    """
    if not any(c.moving.any() for c in signals):
        return []
    at = evidence(signals, model)
    out = []
    for i, mode in enumerate(model.modes):
        if _lies_in(mode.rms_mm, pattern) and _is_common(mode, signals):
            cost = _cost(signals, model, moved_to_bubble(model, i), at)
            label = Attribution("rig", i, mode.frequency_hz, max(mode.rms_mm), cost)
            out.append(label)
    differential = any(m.camera != CARRIAGE for m in model.modes)
    for i, line in enumerate(model.bubble.zigzags):
        if _lies_in(line.rms_mm, pattern):
            cost = _cost(signals, model, moved_to_rig(model, i), at)
            prior = _own_motion_log_ratio(model, i, differential, up)
            out.append(Attribution("bubble", i, line.frequency_hz, max(line.rms_mm), cost, prior))
    return out


def _is_common(mode: RigMode, signals: Sequence[Signal]) -> bool:
    """Return whether a mode moves all cameras of the signals alike, as a bubble's motion does."""
    if mode.camera == CARRIAGE:
        return True
    return all(c.cameras == (mode.camera,) for c in signals if mode.camera in c.cameras)


def _lies_in(rms_mm: Sequence[float], pattern: Sequence[float]) -> bool:
    rms, inside = np.asarray(rms_mm), np.asarray(pattern) > 0.7
    return bool(rms[inside].max(initial=0.0) > rms[~inside].max(initial=0.0))


def _cost(signals: Sequence[Signal], model: ShakeModel, other: ShakeModel, at: float) -> float:
    """Return the loss of log-likelihood in another model, lines refitted if that may matter."""
    loss = at - evidence(signals, other)
    if AMBIGUOUS_LOG_RATIO / 2 < loss < _REFIT_LOG_RATIO:
        loss = min(loss, at - maximise(signals, other, _line_names(other), steps=8).log_evidence)
    return float(loss)


def _line_names(model: ShakeModel) -> list[str]:
    stems = [f"modes.{i}" for i in range(len(model.modes))]
    stems += [f"bubble.zigzags.{i}" for i in range(len(model.bubble.zigzags))]
    return [f"{s}.{f}" for s in stems for f in ("frequency_hz", "rms_mm")]


def _own_motion_log_ratio(model: ShakeModel, index: int, differential: bool, up: Array) -> float:
    """Return the prior log ratio for the bubbles: wide swings and their second harmonic are theirs.

    If there is differential shake, a common mode is likely as well, and the harmonic gets no bonus.
    """
    line = model.bubble.zigzags[index]
    swings = [z for z in model.bubble.zigzags if is_zigzag(z, up)]
    if line in swings:
        return float("inf")
    second = any(abs(line.frequency_hz / (2 * z.frequency_hz) - 1) < _HARMONIC for z in swings)
    return HARMONIC_LOG_RATIO if second and not differential else 0.0


def is_zigzag(line: Zigzag, up: Array) -> bool:
    """Return whether a line is a wide lateral swing, as in the path of a rising bubble."""
    rms, upright = np.asarray(line.rms_mm), np.abs(up)
    across = float(np.linalg.norm(rms * (1 - upright)))
    wide = across > _ZIGZAG_MM and across > float(np.linalg.norm(rms * upright))
    return wide and _ZIGZAG_HZ[0] < line.frequency_hz < _ZIGZAG_HZ[1]


def moved_to_bubble(model: ShakeModel, index: int, share: float = 1.0) -> ShakeModel:
    """Return the model with a share of a mode's variance moved to the bubbles."""
    mode = model.modes[index]
    rms = _scaled(mode.rms_mm, np.sqrt(share))
    added = Zigzag(mode.frequency_hz, mode.damping, rms, mode.force_hz)
    modes = _with_rest(model.modes, index, share)
    zigzags = _joined(model.bubble.zigzags, added)
    return replace(model, modes=modes, bubble=replace(model.bubble, zigzags=zigzags))


def moved_to_rig(model: ShakeModel, index: int, share: float = 1.0) -> ShakeModel:
    """Return the model with a share of a bubble line's variance moved to a mode of the rig."""
    line = model.bubble.zigzags[index]
    rms = _scaled(line.rms_mm, np.sqrt(share))
    added = RigMode(line.frequency_hz, line.damping, rms, force_hz=line.force_hz)
    bubble = replace(model.bubble, zigzags=_with_rest(model.bubble.zigzags, index, share))
    return replace(model, modes=(*model.modes, added), bubble=bubble)


def _with_rest(lines: tuple[L, ...], index: int, share: float) -> tuple[L, ...]:
    """Return the lines with one line's variance reduced by a share; without it for 1."""
    line = lines[index]
    rest: tuple[L, ...] = ()
    if share < 1:
        rest = (replace(line, rms_mm=_scaled(line.rms_mm, np.sqrt(1 - share))),)
    return lines[:index] + rest + lines[index + 1 :]


def _joined(lines: tuple[Zigzag, ...], added: Zigzag) -> tuple[Zigzag, ...]:
    """Return the lines with another one added; variances of equal lines add up."""
    for i, line in enumerate(lines):
        near = abs(line.frequency_hz / added.frequency_hz - 1) < _SAME_HZ
        near &= line.force_hz == added.force_hz
        if near and np.isclose(line.damping, added.damping, rtol=_SAME_HZ):
            x, y, z = np.hypot(line.rms_mm, added.rms_mm).tolist()
            return (*lines[:i], replace(line, rms_mm=(x, y, z)), *lines[i + 1 :])
    return (*lines, added)


def _scaled(rms_mm: Sequence[float], factor: float) -> tuple[float, float, float]:
    x, y, z = (float(factor * r) for r in rms_mm)
    return x, y, z
