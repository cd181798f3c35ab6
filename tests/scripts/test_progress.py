"""The lines that say how far a command is."""

from __future__ import annotations

import numba
import pytest

from telerig import compiled, progress
from telerig.errors import InputError
from telerig.scripts import console


def test_lines_say_how_many_of_all_how_fast_and_how_long(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with console.progress(quiet=False) as stage:
        for done in (200, 201, 260, 1000):
            stage("detection", done, 1000)
            now[0] += 0.5 if done == 200 else 9.5
        stage("pair model", 0, 0)
        now[0] += 300.0
        stage("tracks", 0, 7)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "detection: 200 of 1000",
        "detection: 260 of 1000, 6 a second, 10 s so far, 2 min left",
        "detection: 1000 of 1000, 41 a second, 20 s so far",
        "pair model",
        "tracks: 0 of 7",
    ]
    assert stage.words() == "detection 29 s, pair model 300 s"


def test_the_first_compilation_is_told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def twice(value: float) -> float:
        return 2.0 * value

    monkeypatch.setattr(compiled.FIRST, "told", False)
    monkeypatch.setattr(twice, "__module__", "telerig.example")
    function = numba.njit(twice)
    with console.progress(quiet=False):
        assert function(1.5) == function(1) + 1.0
    assert capsys.readouterr().err == "compiling loops, once for this installation\n"


def test_quiet_says_nothing_but_takes_the_time(capsys: pytest.CaptureFixture[str]) -> None:
    with console.progress(quiet=True) as stage:
        stage("tracks", 1, 2)
    assert capsys.readouterr().err == "" and set(stage.seconds) == {"tracks"}


def test_a_function_shows_how_far_it_is_if_asked(capsys: pytest.CaptureFixture[str]) -> None:
    @progress.showing_progress
    def work(count: int, *, progress: progress.Progress | bool = False) -> int:
        if not isinstance(progress, bool):
            progress("work", count, count)
        return count

    assert work(2) == 2 and capsys.readouterr().err == ""
    assert work(3, progress=True) == 3 and capsys.readouterr().err == "work: 3 of 3\n"
    seen: list[tuple[str, float, int]] = []
    assert work(1, progress=None) == 1  # type: ignore[arg-type]
    with pytest.raises(InputError, match="work: progress is int"):
        work(1, progress=3)  # type: ignore[arg-type]
    assert work(4, progress=lambda *step: seen.append(step)) == 4 and seen == [("work", 4, 4)]
