"""Hostile files of every kind: each is read, or refused in a short message that names the file."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz_corpus import write_corpus
from fuzz_driver import run_cases

CASES = 200
SHARDS = 20
LONG_CASES = 200_000


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz") / "corpus"
    write_corpus(folder)
    return folder


def test_hostile_files_are_read_or_refused(corpus: Path) -> None:
    outcome = run_cases(corpus, 0, CASES)
    assert not outcome.faults, outcome.words()
    assert outcome.cases > 0.9 * CASES, "fewer only where an optional library is missing"
    assert min(outcome.results["read"], outcome.results["refused"]) > 0.1 * CASES


@pytest.mark.slow
@pytest.mark.parametrize("shard", range(SHARDS))
def test_many_hostile_files_are_read_or_refused(corpus: Path, shard: int) -> None:
    each = LONG_CASES // SHARDS
    begin = CASES + shard * each
    outcome = run_cases(corpus, begin, begin + each)
    assert not outcome.faults, outcome.words()
