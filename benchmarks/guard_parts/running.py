"""Tasks in processes of their own; what is done is kept, so that an interrupted run goes on."""

from __future__ import annotations

import hashlib
import importlib
import json
import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from guard_parts.metrics import Metric, as_json, from_json

HERE = Path(__file__).parents[1]
PARTS = ("dots", "bubbles", "calibration", "tracking", "smoothing", "sensors", "files", "peers")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
Task = Callable[[], list[Metric]]


def tasks_of(part: str) -> dict[str, Task]:
    tasks: dict[str, Task] = importlib.import_module(f"guard_parts.{part}").TASKS
    return tasks


def state_of_source(planted: str) -> str:
    """A hash of all modules of the product and of the benchmarks."""
    import telerig

    code = hashlib.sha256(planted.encode())
    roots = (Path(telerig.__file__).parent, HERE, HERE.parent / "tests" / "support")
    for root in roots:
        for folder, _, names in os.walk(root, followlinks=True):
            for name in sorted(names):
                if name.endswith((".py", ".css", ".html")) and "results" not in folder:
                    path = Path(folder) / name
                    code.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return code.hexdigest()[:16]


def begin(planted: str) -> None:
    """Of a process: one thread each, and the planted fault."""
    sys.path[:0] = [str(HERE), str(HERE.parent / "tests" / "support")]
    import cv2

    cv2.setNumThreads(1)
    os.environ["TELERIG_CORES"] = "1"
    if planted:
        importlib.import_module("guard_parts.faults").plant(planted)


def done(part: str, name: str) -> dict[str, Any]:
    """One task: its metrics as JSON, seconds of processor time, and an error's last words."""
    begun, clock = _cpu_s(), time.perf_counter()
    failure, metrics = "", []
    try:
        metrics = tasks_of(part)[name]()
    except Exception as error:  # noqa: BLE001 - whatever it is, it stands in the table
        failure = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        traceback.print_exc()
    return {
        "metrics": as_json({f"{part}/{name}/{m.name}": m for m in metrics}),
        "failure": failure, "cpu_s": _cpu_s() - begun,
        "wall_s": time.perf_counter() - clock,
    }  # fmt: skip


def _cpu_s() -> float:
    """Of this process and of those that it has started."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def chosen(only: Sequence[str]) -> list[tuple[str, str]]:
    """Parts and tasks whose "part/task" begins with one of the words; all without words."""
    every = [(part, name) for part in PARTS for name in tasks_of(part)]
    if not only:
        return every
    return [(p, n) for p, n in every if any(f"{p}/{n}".startswith(word) for word in only)]


def run(
    tasks: Sequence[tuple[str, str]], folder: Path, *, workers: int, planted: str = ""
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield "part/task" and its record as tasks end; those kept in ``folder`` come first."""
    folder.mkdir(parents=True, exist_ok=True)
    left = []
    for part, name in tasks:
        kept = _file(folder, part, name)
        if kept.is_file():
            yield f"{part}/{name}", json.loads(kept.read_text(encoding="utf-8"))
        else:
            left.append((part, name))
    if not left:
        return
    os.environ.update(dict.fromkeys(THREADS, "1"))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, begin, (planted,)) as pool:
        waiting: dict[Future[dict[str, Any]], tuple[str, str]] = {
            pool.submit(done, part, name): (part, name) for part, name in left
        }
        while waiting:
            ended, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in ended:
                part, name = waiting.pop(future)
                record = future.result()
                if not record["failure"]:
                    target = _file(folder, part, name)
                    target.with_suffix(".part").write_text(json.dumps(record), encoding="utf-8")
                    target.with_suffix(".part").replace(target)
                yield f"{part}/{name}", record


def _file(folder: Path, part: str, name: str) -> Path:
    return folder / f"{part}-{hashlib.sha256(name.encode()).hexdigest()[:12]}.json"


def metrics_of(records: dict[str, dict[str, Any]]) -> dict[str, Metric]:
    out: dict[str, Metric] = {}
    for task, record in records.items():
        if record["failure"]:
            out[f"{task}/failed"] = Metric("failed", record["failure"], "", "same")
        out |= from_json(record["metrics"])
    return out
