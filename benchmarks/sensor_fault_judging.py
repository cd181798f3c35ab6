"""What a smoothing made of a faulty input: mended, owned up to, wrong, or a bare exception.

`judged` runs `telerig.smooth`, applies the corrections that its refusals propose, and compares the
result with the truth and with the same run without the fault.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_fault_kinds import Fault, Inputs, repaired
from shake_cases import middle
from shake_scene import Run

import telerig
from telerig.errors import TelerigError

Array = NDArray[np.float64]

LARGER = 1.2
"""An error is larger than that of the undisturbed run if it is more than so many times as large."""
HONEST = 2.0
"""Largest NEES of honest standard deviations."""
ROUNDS = 5


class Class(StrEnum):
    """What became of a fault.

    MENDED : the error is at most `LARGER` times that of the undisturbed run, of the call itself or
    after the corrections that refusals proposed.
    OWNED_UP : refused, a sensor left out, or a verdict that is not RESOLVED; the cause is named and
    the standard deviations are honest.
    HIDDEN : the data cannot show the fault, and ``usable_for`` says what this leaves unknown.
    WIDER : RESOLVED with a larger error inside honest standard deviations.
    UNNAMED : as OWNED_UP, but nothing names the cause.
    OVERCONFIDENT : as OWNED_UP, but the standard deviations are too small.
    WRONG : RESOLVED, as a whole or on an axis, with a larger error outside its standard deviations.
    OPEN : the checks do not tell; only the solution does.
    BARE : an exception that is not a `TelerigError`.
    """

    MENDED = "mended"
    OWNED_UP = "owned up"
    HIDDEN = "hidden"
    WIDER = "wider"
    UNNAMED = "unnamed"
    OVERCONFIDENT = "overconfident"
    WRONG = "wrong"
    OPEN = "open"
    BARE = "bare"


PASSED = (Class.MENDED, Class.OWNED_UP, Class.HIDDEN, Class.WIDER)


@dataclass(frozen=True)
class Score:
    """Errors of the middle 80 % of all bubbles, per axis (3,).

    error_um : RMS.  nees : mean of (error / sd)^2.  sd_um : RMS of the stated ones.
    """

    error_um: Array
    nees: Array
    sd_um: Array

    @property
    def total_um(self) -> float:
        return float(np.sqrt(np.sum(self.error_um**2)))

    @property
    def total_sd_um(self) -> float:
        return float(np.sqrt(np.sum(self.sd_um**2)))

    @property
    def total_nees(self) -> float:
        return float(np.mean(self.nees))


def score(run: Run, table: Any) -> Score:
    """Score of a table of trajectories. The standard deviations are those of its columns."""
    inner = middle(len(run.t_s))
    frame, bubble = table["frame"].to_numpy(), table["particle"].to_numpy()
    keep = (frame >= inner.start) & (frame < inner.stop)
    off = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)[keep]
    off = off - run.position_mm[bubble[keep], frame[keep]]
    sd = table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy(float)[keep]
    rms_um = [1e3 * np.sqrt(np.mean(x**2, axis=0)) for x in (off, sd)]
    return Score(rms_um[0], np.mean((off / sd) ** 2, axis=0), rms_um[1])


@dataclass(frozen=True)
class Outcome:
    """One cell for one seed.

    verdict : with those of the axes x, y, z.  ratio : error over that of the undisturbed run.
    sd_ratio : stated standard deviation over that of the undisturbed run; by so much the posterior
    of what is left is wider.  axis_ratio : ratio per axis.  left_out : sensors without a place in
    the solution.  fixes : corrections applied.  said : messages and warnings.
    """

    kind: Class
    verdict: str = ""
    error_um: float = np.nan
    ratio: float = np.nan
    sd_ratio: float = np.nan
    nees: float = np.nan
    axis_ratio: tuple[float, ...] = ()
    axis_nees: tuple[float, ...] = ()
    left_out: tuple[str, ...] = ()
    codes: tuple[str, ...] = ()
    fixes: tuple[str, ...] = ()
    said: str = ""
    seconds: float = 0.0
    summary: Mapping[str, Any] = field(default_factory=dict, repr=False)


def judged(run: Run, inputs: Inputs, fault: Fault, configuration: str, clean: Score) -> Outcome:
    """inputs : with the fault.  clean : score of the run without it."""
    begin = time.perf_counter()
    said: list[str] = []
    codes: list[str] = []
    fixes: list[str] = []

    def refused() -> Outcome:
        kind = Class.OWNED_UP if named(fault, said) else Class.UNNAMED
        return Outcome(
            kind, "refused", codes=tuple(codes), fixes=tuple(fixes), said=" | ".join(said),
            seconds=time.perf_counter() - begin,
        )  # fmt: skip

    for _ in range(ROUNDS):
        try:
            result = telerig.smooth(**inputs)
            break
        except telerig.SensorError as error:
            said.append(f"{error.code}: {error}")
            codes.append(error.code)
            fix = dict(error.findings[0].fix) if error.findings else {}
            try:
                mended = repaired(inputs, fix)
            except (KeyError, TypeError, ValueError) as fault_of_fix:
                return Outcome(Class.BARE, said=f"fix {fix}: {fault_of_fix!r}")
            if mended is None:
                return refused()
            fixes.append(json.dumps(fix, default=lambda a: np.asarray(a).tolist()))
            inputs = mended
        except TelerigError as error:
            said.append(str(error))
            codes.append(error.code)
            return refused()
        except Exception as error:  # noqa: BLE001 - to be counted is what they are here for
            return Outcome(Class.BARE, said=f"{type(error).__name__}: {error}")
    else:
        return refused()
    found = score(run, result.trajectories)
    summary, verdict = dict(result.summary), dict(result.verdict)
    said += _words(summary, verdict)
    used = _used(summary)
    left_out = tuple(name for name in inputs["accelerometers"] if name not in used)
    axes = [str(verdict.get("axes", {}).get(a, {}).get("verdict", "")) for a in "xyz"]
    kind = _class(fault, configuration, found, clean, verdict, axes, left_out, said)
    return Outcome(
        kind, " ".join([str(verdict.get("verdict", "")), *axes]), found.total_um,
        found.total_um / clean.total_um, found.total_sd_um / clean.total_sd_um, found.total_nees,
        tuple(found.error_um / clean.error_um), tuple(found.nees), left_out, tuple(codes),
        tuple(fixes), " | ".join(said), time.perf_counter() - begin, summary | verdict,
    )  # fmt: skip


def _words(summary: Mapping[str, Any], verdict: Mapping[str, Any]) -> list[str]:
    said = [str(w) for w in summary.get("warnings", ())]
    said += [json.dumps(c, default=str) for c in verdict.get("contradictions", ())]
    return said


def _used(summary: Mapping[str, Any]) -> set[str]:
    """Sensors that have a place in the solution."""
    return {
        name
        for name, entry in summary.get("accelerometers", {}).items()
        if "delay_s" in entry and entry.get("used", True)
    }


def named(fault: Fault, said: list[str]) -> bool:
    """Whether the words name the cause of the fault."""
    text = " ".join(said).lower()
    return any(word in text for word in fault.names)


def _class(
    fault: Fault,
    configuration: str,
    found: Score,
    clean: Score,
    verdict: Mapping[str, Any],
    axes: list[str],
    left_out: tuple[str, ...],
    said: list[str],
) -> Class:
    if found.total_um <= LARGER * clean.total_um:
        return Class.MENDED
    whole = str(verdict.get("verdict", ""))
    larger = found.error_um > LARGER * clean.error_um
    outside = (found.nees > HONEST) & (found.nees > LARGER * clean.nees)
    wrong = np.array([axis == "RESOLVED" for axis in axes]) & larger & outside
    if configuration in fault.hidden:
        return Class.HIDDEN if _says_so(verdict, found) else Class.WRONG
    if (whole == "RESOLVED" and found.total_nees > HONEST) or (
        whole != "CONTRADICTED" and any(wrong)
    ):
        return Class.WRONG
    if whole == "RESOLVED" and not left_out:
        return Class.WIDER
    if found.total_nees > HONEST:
        return Class.OVERCONFIDENT
    return Class.OWNED_UP if named(fault, said) else Class.UNNAMED


def _says_so(verdict: Mapping[str, Any], found: Score) -> bool:
    """Whether ``usable_for`` says that the vertical path and mean rise assume a sound encoder, or
    grades them below "good", or the stated standard deviations cover the error."""
    uses = [u for u in verdict.get("usable_for", ()) if u["axis"] == verdict.get("vertical")]
    of_place = [u for u in uses if "path" in u["quantity"] or "mean" in u["quantity"]]
    assumed = bool(of_place) and all("encoder" in u["assumes"] for u in of_place)
    honest = bool(of_place) and found.total_nees <= HONEST
    return assumed or honest or any(use["grade"] != "good" for use in of_place)
