"""A page that says one thing in two ways is found, by its text alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from guard_parts.contradictions import contradictions
from smoothed_folder import write_folder

from telerig.io.report.run.report import write_track_report


def _tile(name: str, value: str) -> str:
    return f'<p class="name">{name}</p><p class="value">{value}</p><p class="remark">of all</p>'


@pytest.mark.parametrize(
    ("page", "found"),
    [
        (_tile("Sauter mean", "3.09 ± 0.15 mm") + "<p>The Sauter mean 3.06 mm is drawn.</p>", 1),
        (_tile("Sauter mean", "3.09 ± 0.15 mm") + "<p>The Sauter mean 3.1 mm is drawn.</p>", 0),
        (_tile("Sauter mean", "3.09 mm") + "<p>The Sauter mean 3.06 µm is drawn.</p>", 0),
        (_tile("Shake", "1 440 µm") + _tile("Shake", "1 441 µm"), 0),
        (_tile("Shake", "1 440 µm") + _tile("Shake", "1 540 µm"), 2),
        (_tile("Tracks", "12") + _tile("Matched", "13 %"), 0),
    ],
)
def test_numbers_of_one_name(page: str, found: int) -> None:
    assert len(contradictions(page)) == found


def test_no_objection_beside_an_objection() -> None:
    box = '<section id="verdict"><p>No check objected.</p>{}</section>'
    assert contradictions(box.format("")) == []
    (words,) = contradictions(box.format("<ul><li>only 5 views</li></ul>"))
    assert "only 5 views" in words


def test_advice_to_add_what_is_there() -> None:
    advice = {
        "<p>describe the liquid under [fluid] in rig.toml</p>": "<table><th>Re</th></table>",
        "<p>fix a strip of dots to the tank</p>": "<h2>Marks fixed to the tank</h2>",
        "<p>mount one accelerometer on each camera arm</p>": "<td>arm_left</td><td>arm_right</td>",
    }
    for words, there in advice.items():
        assert contradictions(words) == [] and contradictions(there) == []
        assert len(contradictions(words + there)) == 1, words


@pytest.mark.usefixtures("undrawn")
def test_a_smoothed_run_states_each_number_once(tmp_path: Path) -> None:
    page = write_track_report(write_folder(tmp_path / "r", frames=80, bubbles=1))
    assert contradictions(page.read_text(encoding="utf-8")) == []
