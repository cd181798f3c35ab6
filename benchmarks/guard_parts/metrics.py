"""Metrics with unit, direction and tolerance, and their comparison with a baseline.

Two runs of the guard have the same noise, so that a metric moves by as much as the product has:
an error that is 10 % larger moves its root mean square by 10 %, and standard deviations that are
15 % too small raise the NEES by 38 %, whatever the chance of the draws is. A tolerance therefore is
not the scatter between seeds. It is what a change of the numerical order gives (1e-3) and what a
redesign may move without an explanation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

Value = float | str | None
Better = Literal["lower", "higher", "same"]

WORSE, MOVED, BETTER, WITHIN, NEW, GONE = "WORSE", "MOVED", "better", "within", "new", "GONE"
FAILED = (WORSE, MOVED, GONE)


@dataclass(frozen=True)
class Metric:
    """One number, or a word such as a verdict.

    name : of the quantity; with part and task in front it is unique. better : "same" for what may
    not change in either direction. relative, absolute : a change is within the tolerance up to the
    larger of ``absolute`` and ``relative`` times the baseline. None as a value means that there is
    no such number, for example because a problem was not solved.
    """

    name: str
    value: Value
    unit: str = ""
    better: Better = "lower"
    relative: float = 0.0
    absolute: float = 0.0

    def tolerance(self, baseline: float) -> float:
        return max(self.absolute, self.relative * abs(baseline))


def error(name: str, value: float, unit: str, relative: float = 0.04) -> Metric:
    """An RMS error, or its ratio to a bound."""
    return Metric(name, float(value), unit, "lower", relative)


def stated_sd(values: ArrayLike, unit: str, name: str = "stated sd", scale: float = 1.0) -> Metric:
    """The geometric mean of stated standard deviations. A smaller one is better if the NEES, which
    is a metric of its own, stays."""
    mean = scale * math.exp(float(np.mean(np.log(np.asarray(values, float)))))
    return Metric(name, mean, unit, "lower", 0.05)


def nees(squares: ArrayLike, name: str = "NEES") -> Metric:
    """The mean of squared errors over their stated variances: 1 for true ones."""
    return Metric(name, float(np.mean(np.asarray(squares, float))), "1", "lower", 0.1)


def count(name: str, value: int, better: Better = "lower") -> Metric:
    """A number of which one more or less is a change."""
    return Metric(name, int(value), "", better)


def share(name: str, value: float, absolute: float = 0.005) -> Metric:
    """A recall or a precision."""
    return Metric(name, float(value), "", "higher", 0.0, absolute)


def word(name: str, value: str) -> Metric:
    """A verdict or another word."""
    return Metric(name, value, "", "same")


def cpu_ratio(name: str, value: float) -> Metric:
    """Processor time over that of a peer, which runs in turn with it; other work on the machine
    moves it by a quarter."""
    return Metric(name, float(value), "x", "lower", 0.3)


def size(name: str, value: float, unit: str = "bytes") -> Metric:
    return Metric(name, float(value), unit, "lower", 0.05)


@dataclass(frozen=True)
class Moved:
    """A metric beside its baseline.

    before : None for a new metric. after : None for a metric that is gone.
    """

    key: str
    state: str
    before: Metric | None
    after: Metric | None

    @property
    def change(self) -> str:
        """In percent, or absolute where the tolerance is absolute."""
        if self.before is None or self.after is None:
            return ""
        old, new = self.before.value, self.after.value
        if old is None or new is None or isinstance(old, str) or isinstance(new, str):
            return "" if old == new else "changed"
        if self.after.relative and old:
            return f"{100 * (new / old - 1):+.1f} %"
        return f"{new - old:+.4g}"


def _task(key: str) -> str:
    return key.rsplit("/", 1)[0]


def judged(before: Metric, after: Metric) -> str:
    """The state of a metric that both runs have. Direction and tolerance are those of ``after``."""
    old, new = before.value, after.value
    if old is None or new is None:
        return WITHIN if old == new else WORSE if new is None else BETTER
    if isinstance(old, str) or isinstance(new, str):
        return WITHIN if old == new else MOVED
    if not math.isfinite(new) or not math.isfinite(old):
        same = old == new or (math.isnan(old) and math.isnan(new))
        return WITHIN if same else BETTER if math.isfinite(new) else WORSE
    step = new - old
    if abs(step) <= after.tolerance(old) + 1e-9 * abs(old):
        return WITHIN
    if after.better == "same":
        return MOVED
    return BETTER if (step < 0) == (after.better == "lower") else WORSE


def compared(
    before: Mapping[str, Metric], after: Mapping[str, Metric], tasks: Iterable[str] | None = None
) -> list[Moved]:
    """Every metric of both, the baseline's order first.

    tasks : those that were run, "part/task"; metrics of others are left out. None: all. A task that
    either run had to skip, because its images are not there, is left out as well.
    """
    run = {_task(k) for k in (*before, *after)} if tasks is None else set(tasks)
    run -= {_task(k) for k in (*before, *after) if k.endswith("/skipped")}
    keys = [*before, *(k for k in after if k not in before)]
    out = []
    for key in keys:
        if _task(key) not in run:
            continue
        old, new = before.get(key), after.get(key)
        state = GONE if new is None else NEW if old is None else judged(old, new)
        out.append(Moved(key, state, old, new))
    return out


def text(metric: Metric | None) -> str:
    """The value with its unit."""
    if metric is None or metric.value is None:
        return "-"
    if isinstance(metric.value, str):
        return metric.value
    number = f"{metric.value:.0f}" if float(metric.value).is_integer() else f"{metric.value:.4g}"
    unit = "" if metric.unit in ("", "1") else f" {metric.unit}"
    return number + unit


def allowed(metric: Metric) -> str:
    """Direction and tolerance in words."""
    sign = {"lower": "+", "higher": "-", "same": "±"}[metric.better]
    if isinstance(metric.value, str):
        return "the same"
    if metric.relative:
        return f"{sign}{100 * metric.relative:g} %"
    return f"{sign}{metric.absolute:g}" if metric.absolute else f"{sign}0"


def table(metrics: Mapping[str, Metric]) -> list[str]:
    """Lines of a Markdown table, one for each task, its metrics beside each other."""
    lines = ["| task | metrics |", "|---|---|"]
    for task, mine in by_task(metrics).items():
        cells = [f"{m.name} **{text(m)}**" for m in mine]
        lines.append(f"| {task} | {'; '.join(cells)} |")
    return lines


def by_task(metrics: Mapping[str, Metric]) -> dict[str, list[Metric]]:
    out: dict[str, list[Metric]] = {}
    for key, metric in metrics.items():
        out.setdefault(_task(key), []).append(metric)
    return out


def comparison(moved: Sequence[Moved], *, whole: bool = False) -> list[str]:
    """Lines of what moved beyond its tolerance, and the counts. whole : also what did not."""
    shown = [m for m in moved if whole or m.state not in (WITHIN,)]
    lines = []
    if shown:
        lines += ["| | metric | baseline | now | change | allowed |", "|---|---|---|---|---|---|"]
        for m in sorted(shown, key=lambda m: m.state not in FAILED):
            either = m.after or m.before
            assert either is not None
            cells = [m.state, m.key, text(m.before), text(m.after), m.change, allowed(either)]
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    counts = {s: sum(m.state == s for m in moved) for s in (*FAILED, BETTER, NEW, WITHIN)}
    lines.append(
        f"{len(moved)} metrics: " + ", ".join(f"{n} {s}" for s, n in counts.items() if n) + "."
    )
    return lines


def as_json(metrics: Mapping[str, Metric]) -> dict[str, Any]:
    return {
        key: {
            k: _number(v)
            for k, v in asdict(metric).items()
            if k == "value" or (k != "name" and v != "")
        }
        for key, metric in metrics.items()
    }


def from_json(data: Mapping[str, Any]) -> dict[str, Metric]:
    return {
        key: Metric(key.rsplit("/", 1)[1], **({"value": ""} | entry)) for key, entry in data.items()
    }


def _number(value: Any) -> Any:
    """Ten digits are more than a comparison needs and fewer than a reader skips."""
    return float(f"{value:.10g}") if isinstance(value, float) else value
