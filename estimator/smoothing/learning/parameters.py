"""Names of hyper-parameters in a `ShakeModel`, and the processes that they describe.

A name is a path: ``modes.0.frequency_hz``, ``bubble.zigzags.1.rms_mm``, ``pixel_inflation``. An RMS
with three components counts as one number, the largest; setting it keeps the proportions. All
low-pass filtered forces share one cut-off, ``modes.force_hz``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatch
from functools import lru_cache
from typing import Any

import numpy as np

from telerig.errors import InputError
from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.problem.problem import ShakeModel
from telerig.factors.bubble_motion import (
    BUBBLE_PRIORS,
    Prior,
    Process,
    bubble_processes,
    learned_names,
    line_process,
)
from telerig.factors.state_space import broad_band

FORCE = "modes.force_hz"
"""Low-pass cut-off of the force that drives the modes, one for all."""

PRIORS: dict[str, Prior] = {
    FORCE: Prior(10.0, 1000.0, 60.0, 1.5, 0.2),
    "modes.*.frequency_hz": Prior(1.0, 150.0, 15.0, 1.5, 0.02),
    "modes.*.damping": Prior(0.003, 0.5, 0.04, 0.8, 0.4),
    "modes.*.rms_mm": Prior(1e-4, 5.0, 0.1, 1.5, 0.2),
    **BUBBLE_PRIORS,
    "pixel_inflation": Prior(0.3, 5.0, 1.0, 0.3, 0.02),
}
"""Priors by pattern of the name."""


def prior_of(name: str) -> Prior:
    """Return the prior of a hyper-parameter. Raises InputError for an unknown name."""
    for pattern, prior in PRIORS.items():
        if fnmatch(name, pattern):
            return prior
    raise InputError(
        f"{name!r} is not a hyper-parameter that can be learned",
        todo=f"use one of {', '.join(PRIORS)}, where * is the number of the process from 0",
    )


def value_of(model: ShakeModel, name: str) -> float:
    """Return the value of a hyper-parameter, in the unit that its name ends with.

    Raises InputError for an unknown name.
    """
    found: Any = model
    if name == FORCE and model.force_hz is not None:
        return model.force_hz
    try:
        for part in name.split("."):
            found = found[int(part)] if part.isdigit() else getattr(found, part)
    except (AttributeError, IndexError, TypeError) as error:
        raise InputError(
            f"the model has no hyper-parameter {name!r}",
            todo="use one of the names that names_of(model) returns",
        ) from error
    return float(max(found)) if isinstance(found, tuple) else float(found)


def with_values(model: ShakeModel, names: Sequence[str], values: Sequence[float]) -> ShakeModel:
    """Return the model with new values of the named hyper-parameters."""
    out: Any = model
    for name, value in zip(names, values):
        if name == FORCE:
            out = with_cutoff(out, float(value))
        else:
            out = _replaced(out, name.split("."), float(value))
    assert isinstance(out, ShakeModel)
    return out


def with_cutoff(model: ShakeModel, force_hz: float) -> ShakeModel:
    """Return the model with another cut-off of all low-pass filtered forces."""
    modes = tuple(m if m.force_hz is None else replace(m, force_hz=force_hz) for m in model.modes)
    zigzags = tuple(
        z if z.force_hz is None else replace(z, force_hz=force_hz) for z in model.bubble.zigzags
    )
    return replace(model, modes=modes, bubble=replace(model.bubble, zigzags=zigzags))


def _replaced(node: Any, path: list[str], value: float) -> Any:
    if not path:
        if isinstance(node, tuple):
            largest = max(node)
            return tuple(value * v / largest for v in node)
        return value
    head, rest = path[0], path[1:]
    if head.isdigit():
        index = int(head)
        return (*node[:index], _replaced(node[index], rest, value), *node[index + 1 :])
    return replace(node, **{head: _replaced(getattr(node, head), rest, value)})


def names_of(model: ShakeModel) -> list[str]:
    """Return the names of all hyper-parameters that can be learned."""
    out: list[str] = []
    fields = ("frequency_hz", "damping", "rms_mm")
    out += [f"modes.{i}.{f}" for i in range(len(model.modes)) for f in fields]
    if model.force_hz is not None:
        out.append(FORCE)
    return [*out, *learned_names(model.bubble), "pixel_inflation"]


def log_prior(model: ShakeModel, names: Sequence[str]) -> float:
    """Return the sum of the log prior densities, up to a constant."""
    return sum(prior_of(n).log_density(value_of(model, n)) for n in names)


_broad_band = lru_cache(maxsize=512)(broad_band)


def names_of_process(process: Process) -> dict[str, str]:
    """Return {name of the hyper-parameter in the model: its name in the process}."""
    return {FORCE if n == "force_hz" else f"{process.stem}.{n}": n for n in process.learned}


def shake_processes(signal: Signal, model: ShakeModel) -> list[Process]:
    """Return the processes of the shake along the signal's direction."""
    out: list[Process] = []
    if not signal.shaken:
        return out
    for i, mode in enumerate(model.modes):
        rms = _along(signal, mode.rms_mm, mode.camera)
        if rms > 0:
            line = (mode.frequency_hz, mode.damping, mode.force_hz)
            out.append(line_process(f"modes.{i}", rms, *line, camera=mode.camera))
    for i, band in enumerate(model.broad_bands):
        rms = _along(signal, band.rms_mm, band.camera)
        if rms > 0:
            learned = {"rms_mm": ("rms_mm", rms)}
            shape = ("low_hz", "high_hz", "floor", "tail")
            fixed = {name: getattr(band, name) for name in shape}
            out.append(Process(f"broad_bands.{i}", _broad_band, learned, fixed, band.camera))
    return out


def _along(signal: Signal, rms_mm: tuple[float, float, float], camera: int) -> float:
    if camera >= 0 and camera not in signal.cameras:
        return 0.0
    return float(np.sqrt(np.sum(np.square(signal.direction * rms_mm))))


def moving_processes(signal: Signal, model: ShakeModel) -> list[Process]:
    """Return the processes of one bubble along the signal's direction."""
    return bubble_processes(model.bubble, signal.direction, bubbles=signal.pooled, mean_known=True)


def depends_on(signal: Signal, model: ShakeModel, names: Sequence[str]) -> bool:
    """Return whether the likelihood of the signal depends on any of these hyper-parameters."""
    found = shake_processes(signal, model) + moving_processes(signal, model)
    known = {name for p in found for name in names_of_process(p)}
    return "pixel_inflation" in names or not known.isdisjoint(names)
