"""The wording of verdicts, made from codes and numbers."""

from __future__ import annotations

from typing import Any

from telerig.io.results.smoothing import AxisVerdict, Contradiction, Flag, SmoothingFile, Verdict
from telerig.io.results.verdict_words import conclusion_words, number_words


def axes(**vertical: Any) -> dict[str, AxisVerdict]:
    """x and z of the demo, and y with these numbers in place of the demo's."""
    across = {"verdict": "RESOLVED", "q": 1.1, "eta": 0.96, "sigma_mm": 0.0321}
    along = {"verdict": "RESOLVED", "q": 14.6, "eta": 0.989, "sigma_mm": 0.0221} | vertical
    return {
        "x": AxisVerdict.model_validate(across),
        "y": AxisVerdict.model_validate(along),
        "z": AxisVerdict.model_validate(across),
    }


def conclusion(verdict: str, **vertical: Any) -> str:
    given = axes(verdict=verdict, **vertical)
    return conclusion_words(SmoothingFile(verdict=Verdict(verdict), axes=given, vertical="y"))


def test_the_number_that_a_person_wants() -> None:
    assert number_words(axes(), "y") == (
        "Vertical: 98.9 % of the shake's variance removed; paths good to 22 µm (1 sd), 32 µm in x "
        "and z."
    )
    assert "99.9 % of" in number_words(axes(eta=0.99999), "y")
    assert number_words(axes(), "") == number_words({}, "y") == ""
    other = axes() | {"z": AxisVerdict(sigma_mm=1.2)}
    assert "32 µm in x, 1\u202f200 µm in z." in number_words(other, "y")


def test_a_share_that_means_nothing_is_not_said() -> None:
    assert number_words(axes(eta=None), "y").startswith("Vertical: paths good to 22 µm")
    assert number_words(axes(verdict="CONTRADICTED"), "y") == "", "a path is good to nothing"
    assert number_words(axes(), "y", Verdict.CONTRADICTED) == "", "along no axis"
    below = number_words(axes(eta=0.1, flags=(Flag.SHAKE_BELOW_NOISE,)), "y")
    assert "below the noise" in below and "removed" not in below
    assert "assumptions" in number_words(axes(flags=(Flag.SHAKE_UNMEASURED,)), "y")


def test_the_conclusion_says_why_a_run_is_not_resolved() -> None:
    assert conclusion("RESOLVED").startswith("RESOLVED: the data separate")
    left = conclusion("PARTIAL", q=3.1, eta=0.88)
    assert left.startswith("PARTIAL: along y, 12.0 % of the shake's variance is left")
    assert "3.1 times" in left and "5 % or 1.25 times" in left
    assert "one or two bubbles" in conclusion("UNRESOLVED", flags=(Flag.SHAKE_UNMEASURED,))
    one = Contradiction(source="marks", axis="y", from_s=0.4, to_s=1.5, statistic=3.1)
    file = SmoothingFile(verdict=Verdict.CONTRADICTED, axes=axes(), contradictions=(one,))
    assert conclusion_words(file).startswith("CONTRADICTED: marks disagrees")
    assert conclusion_words(SmoothingFile()) == ""
