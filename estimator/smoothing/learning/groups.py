"""What is learned together: the signals of a group, and which hyper-parameters they determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cached_property

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.learning.lines_of_sight import Signal, pooled
from telerig.estimator.smoothing.learning.parameters import FORCE, names_of
from telerig.estimator.smoothing.problem.problem import CARRIAGE, ShakeModel
from telerig.factors.bubble_motion import Triple

Owner = int | str

BUBBLE = "bubble"


@dataclass(frozen=True)
class Learning:
    """What may be learned.

    most_modes : lines of one kind (common, each arm, bubble) at most, in the vertical and across.
    hold : patterns of names (see ``parameters``) that keep the start's values,
        "modes.*" for instance for a rig that is known. The forces' cut-off, which all modes
        share, is held with any mode of which all is held.
    target : the tracks are those of a target standing still in the lab, not of bubbles.
    force_hz : low-pass cut-off of the modes' force to begin with; None: white, with a cut-off only
        where the information criterion prefers one.
    """

    most_modes: int = 3
    hold: tuple[str, ...] = ()
    target: bool = False
    force_hz: float | None = None


@dataclass(frozen=True)
class Group:
    """Channels learned together.

    pattern : (3,) share of a line's RMS along the rig's axes.  owners : what a line could be.
    fast : the signals as their likelihood is worked out, see `pooled`.
    """

    signals: tuple[Signal, ...]
    pattern: Triple
    owners: tuple[Owner, ...]
    up: Array

    @cached_property
    def fast(self) -> tuple[Signal, ...]:
        return tuple(part for signal in self.signals for part in pooled(signal))


def groups_of(signals: Sequence[Signal], options: Learning, up: Array) -> list[Group]:
    """The shared coordinate, and the coordinates across it, taken together; up : (3,)."""
    if not signals:
        return []
    bubble: tuple[Owner, ...] = () if options.target else (BUBBLE,)
    shared = signals[0]
    own: tuple[Owner, ...] = shared.cameras if len(shared.cameras) > 1 else ()
    square = shared.direction**2
    groups = [Group((shared,), _pattern(square), (CARRIAGE, *own, *bubble), up)]
    if len(signals) > 1:
        directions = np.array([c.direction for c in signals[1:]])
        across = np.diagonal(np.linalg.pinv(directions) @ directions)
        groups.append(Group(tuple(signals[1:]), _pattern(across), (CARRIAGE, *bubble), up))
    return groups


def _pattern(square: Array) -> Triple:
    x, y, z = (float(np.sqrt(s)) if s > 1e-3 else 0.0 for s in square)
    return x, y, z


def free_names(model: ShakeModel, group: Group, options: Learning, first: bool) -> list[str]:
    """Names of what this group determines and nobody holds."""
    names = []
    for name in names_of(model):
        if is_held(name, model, options):
            continue
        if name == FORCE:
            if any(_concerns(group, model, f"modes.{i}.rms_mm") for i in _low_pass_modes(model)):
                names.append(name)
        elif name.startswith(("modes", "bubble.zigzags", "broad_bands")):
            if _concerns(group, model, name):
                names.append(name)
        elif first and not (options.target and name.startswith("bubble")):
            names.append(name)
    return names


def is_held(name: str, model: ShakeModel, options: Learning) -> bool:
    """Whether the user keeps that hyper-parameter as it is."""
    names = [name]
    if name == FORCE:
        names += [f"modes.{i}.force_hz" for i in range(len(model.modes))]
    return any(fnmatch(n, pattern) for n in names for pattern in options.hold)


def _low_pass_modes(model: ShakeModel) -> list[int]:
    return [i for i, mode in enumerate(model.modes) if mode.force_hz is not None]


def _concerns(group: Group, model: ShakeModel, name: str) -> bool:
    """Whether a line moves along the group's directions more than along the others."""
    parts = name.split(".")
    lines = model.bubble.zigzags if parts[0] == "bubble" else getattr(model, parts[0])
    rms = np.asarray(lines[int(parts[-2])].rms_mm)
    inside = np.asarray(group.pattern) > 0.7
    if parts[0] == "bubble" and group.signals[0].moving.sum() == 0:
        return False
    return bool(rms[inside].max(initial=0.0) > rms[~inside].max(initial=0.0))
