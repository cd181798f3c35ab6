"""Run ranges of hostile cases in worker processes and report what broke the rules.

`python tests/fuzz/fuzz_driver.py CORPUS BEGIN END [TARGET]` (with tests/support on PYTHONPATH)
prints the faults; CORPUS is made if it does not exist.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import IO, Any

LONGEST_S = 20.0
"""A case that takes longer counts as a loop without end."""

_START_S = 120.0
_HERE = Path(__file__).parent


@dataclass
class Outcome:
    """cases : how many were read. results : number of each result. faults : what broke a rule."""

    cases: int = 0
    results: Counter[str] = field(default_factory=Counter)
    faults: list[dict[str, Any]] = field(default_factory=list)
    slowest: tuple[float, str] = (0.0, "")

    def words(self) -> str:
        """Return the faults as lines, one of each kind, with a case that shows it."""
        kinds: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for fault in self.faults:
            kinds.setdefault((fault["target"], fault["words"][-60:]), []).append(fault)
        lines = [f"{len(f)} x {t}, case {f[0]['case']}: {f[0]['words'][:500]}"
                 for (t, _), f in sorted(kinds.items())]  # fmt: skip
        return "\n".join([f"{len(self.faults)} faults in {self.cases} cases", *lines])


def run_cases(corpus: Path, begin: int, end: int, only: str = "") -> Outcome:
    """Read the cases ``begin`` to ``end`` - 1 and return what came of them."""
    outcome = Outcome()
    while begin < end:
        last = None
        for record in _answers(corpus, begin, end, only):
            last = record
            if "result" in record:
                outcome.cases += 1
                outcome.results[record["result"]] += 1
                outcome.slowest = max(outcome.slowest, (record["seconds"], record["target"]))
                if record["result"] == "fault":
                    outcome.faults.append(record)
        if last is None or "result" in last:
            return outcome
        outcome.cases += 1
        outcome.results["fault"] += 1
        outcome.faults.append(last)
        begin = last["case"] + 1
    return outcome


def _answers(corpus: Path, begin: int, end: int, only: str) -> Iterator[dict[str, Any]]:
    """The records of one worker; the last lacks "result" if the worker hung or crashed in it."""
    with (
        tempfile.TemporaryDirectory(prefix="telerig-fuzz-") as work,
        tempfile.TemporaryFile() as noise,
    ):
        command = [
            sys.executable,
            str(_HERE / "fuzz_worker.py"),
            corpus,
            work,
            str(begin),
            str(end),
        ]
        # glibc gives each thread 64 MB of addresses, which are no memory but count as such
        environment = os.environ | {"MALLOC_ARENA_MAX": "2", "OPENBLAS_NUM_THREADS": "1"}
        environment["PYTHONPATH"] = os.pathsep.join(p for p in sys.path if p)
        process = subprocess.Popen(
            [*command, *([only] if only else [])], stdin=subprocess.DEVNULL, stderr=noise,
            stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        lines: Queue[str] = Queue()
        reader = Thread(target=_forward, args=(process.stdout, lines), daemon=True)
        reader.start()
        pending: dict[str, Any] | None = None
        wait, why = _START_S, f"no answer in {LONGEST_S} s"
        try:
            while line := lines.get(timeout=wait):
                wait, record = LONGEST_S, json.loads(line)
                pending = None if "result" in record else record
                if pending is None:
                    yield record
            why = f"the process ended with {process.wait(LONGEST_S)}"
        except Empty:
            process.kill()
        finally:
            process.kill()
            process.wait()
            reader.join()
        if pending is not None:
            yield pending | {"words": why}
        elif process.returncode != 0:
            noise.seek(0)
            raise AssertionError(why + noise.read()[-3000:].decode("utf-8", "replace"))


def _forward(stream: IO[str], lines: Queue[str]) -> None:
    """Put the lines of a stream into a queue, which can be waited for; "" is its end."""
    with stream:
        for line in stream:
            lines.put(line)
    lines.put("")


def main(corpus: Path, begin: int, end: int, only: str = "") -> None:
    if not corpus.exists():
        from fuzz_corpus import write_corpus

        write_corpus(corpus)
    outcome = run_cases(corpus, begin, end, only)
    sys.stdout.write(f"{outcome.words()}\n{dict(outcome.results)} slowest {outcome.slowest}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:])
