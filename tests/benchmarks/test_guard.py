"""How the guard compares two runs; the runs themselves are long."""

from __future__ import annotations

import json

import numpy as np
import pytest
from guard_parts import metrics
from guard_parts.inputs import digest
from guard_parts.metrics import BETTER, FAILED, GONE, MOVED, NEW, WITHIN, WORSE, Metric


def state(before: Metric, after: Metric) -> str:
    (moved,) = metrics.compared({"a/b/c": before}, {"a/b/c": after})
    return moved.state


def draws(error: float = 1.0, sd: float = 1.0) -> dict[str, Metric]:
    """What a part reports of the same 300 draws with errors and stated sds times a factor."""
    off = error * np.random.default_rng(1).standard_normal(300)
    stated = sd * np.full(300, 1.1)
    every = [
        metrics.error("error", float(np.sqrt(np.mean(off**2))), "µm"),
        metrics.stated_sd(stated, "µm"),
        metrics.nees((off / stated) ** 2),
    ]
    return {f"part/task/{m.name}": m for m in every}


def states(after: dict[str, Metric]) -> dict[str, str]:
    return {m.key.split("/")[-1]: m.state for m in metrics.compared(draws(), after)}


def test_a_sd_that_is_15_percent_too_small_is_worse_by_its_nees() -> None:
    assert states(draws(sd=0.85)) == {"error": WITHIN, "stated sd": BETTER, "NEES": WORSE}


def test_an_error_that_is_10_percent_larger_is_worse_also_if_it_is_stated() -> None:
    assert states(draws(error=1.1)) == {"error": WORSE, "stated sd": WITHIN, "NEES": WORSE}
    assert states(draws(error=1.1, sd=1.1)) == {"error": WORSE, "stated sd": WORSE, "NEES": WITHIN}


def test_another_order_of_sums_is_within_and_a_smaller_error_with_its_sd_is_better() -> None:
    assert set(states(draws(error=1.001, sd=1.001)).values()) == {WITHIN}
    assert states(draws(error=0.9, sd=0.9)) == {
        "error": BETTER, "stated sd": BETTER, "NEES": WITHIN,
    }  # fmt: skip


def test_three_percent_fewer_bubbles_and_one_swap_are_worse() -> None:
    assert state(metrics.share("recall", 0.99), metrics.share("recall", 0.97 * 0.99)) == WORSE
    assert state(metrics.share("recall", 0.97), metrics.share("recall", 0.99)) == BETTER
    assert state(metrics.count("swaps", 0), metrics.count("swaps", 1)) == WORSE
    assert state(metrics.count("swaps", 1), metrics.count("swaps", 1)) == WITHIN


def test_words_and_numbers_that_may_not_change_have_moved() -> None:
    assert state(metrics.word("verdict", "RESOLVED"), metrics.word("verdict", "PARTIAL")) == MOVED
    bias = Metric("bias", 0.01, "1", "same", absolute=1e-3)
    assert state(bias, Metric("bias", 0.012, "1", "same", absolute=1e-3)) == MOVED
    assert state(bias, Metric("bias", 0.0105, "1", "same", absolute=1e-3)) == WITHIN


@pytest.mark.parametrize("value", [None, float("nan"), float("inf")])
def test_a_number_that_is_none_any_more_is_worse(value: float | None) -> None:
    assert state(metrics.error("e", 1.0, "µm"), Metric("e", value, "µm")) == WORSE
    assert state(Metric("e", value, "µm"), metrics.error("e", 1.0, "µm")) == BETTER
    assert state(Metric("e", value, "µm"), Metric("e", value, "µm")) == WITHIN


def test_a_metric_that_is_gone_fails_and_a_new_one_does_not() -> None:
    one = metrics.count("swaps", 0)
    gone, new = metrics.compared({"a/b/swaps": one}, {"a/c/swaps": one})
    assert (gone.state, new.state) == (GONE, NEW)
    assert gone.state in FAILED and new.state not in FAILED


def test_only_tasks_that_ran_and_were_not_skipped_are_compared() -> None:
    one = metrics.count("swaps", 0)
    before = {"a/b/swaps": one, "a/c/swaps": one, "a/d/swaps": one}
    after = {"a/b/swaps": one, "a/d/skipped": metrics.word("skipped", "no images")}
    moved = metrics.compared(before, after, ["a/b", "a/d"])
    assert [m.key for m in moved] == ["a/b/swaps"]


def test_a_baseline_is_read_as_it_was_written() -> None:
    written = draws() | {"a/b/verdict": metrics.word("verdict", "GOOD")}
    read = metrics.from_json(json.loads(json.dumps(metrics.as_json(written))))
    assert {m.state for m in metrics.compared(written, read)} == {WITHIN}
    assert read["part/task/NEES"].relative == 0.1 and read["a/b/verdict"].better == "same"


def test_inputs_are_the_same_in_another_order_of_sums_and_not_with_other_noise() -> None:
    one = np.random.default_rng(0).standard_normal(100)
    assert digest(one) == digest(one * (1 + 1e-13)) != digest(one + 1e-6)
