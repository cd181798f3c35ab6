"""The commands on a simulated run: sizes of what they write, and their processor time.

The time is over that of a process that imports NumPy, SciPy, pandas and matplotlib.
"""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

import telerig
from guard_parts.contradictions import contradictions
from guard_parts.inputs import digest
from guard_parts.metrics import Metric, count, cpu_ratio, size, word
from guard_parts.product import run_preset

SCENARIO, FRAMES = "S2", 200
PEER = "import matplotlib.pyplot, numpy, pandas, scipy.optimize, scipy.signal"
SIZES = (
    "calibration/calibration.json", "calibration/covariance.npz", "calibration/report.html",
    "S2/tracks.csv", "S2/trajectories.csv", "S2/smoothing.json", "S2/results.h5",
    "S2/report.html",
)  # fmt: skip
PAGES = ("calibration/report.html", "S2/report.html")


def children_cpu_s(*command: str) -> float:
    """Processor time of a process and of all that it starts."""

    def used() -> float:
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        return spent.ru_utime + spent.ru_stime

    before = used()
    done = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=False, env=os.environ
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stdout}{done.stderr}")
    return used() - before


def words_of(page: Path) -> int:
    """Characters of a page that a person reads."""
    text = page.read_text(encoding="utf-8")
    text = re.sub(r"(?s)<(script|style|svg)\b.*?</\1>", " ", text)
    return len(" ".join(re.sub(r"<[^>]+>", " ", text).split()))


def commands() -> list[Metric]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "set"
        config = run_preset(SCENARIO, frames=FRAMES)
        telerig.simulate(config, rng=np.random.default_rng(35), out=folder, images=False)
        given = digest(pd.read_csv(folder / "runs" / SCENARIO / "detections.csv"))
        run = str(folder / "runs" / SCENARIO)
        out: list[Metric] = []
        for words in (("calibrate", str(folder)), ("track", run), ("smooth", run)):
            peer = children_cpu_s("-c", PEER)
            spent = children_cpu_s("-m", "telerig", *words, "--quiet")
            peer = min(peer, children_cpu_s("-c", PEER))
            out.append(cpu_ratio(f"telerig {words[0]} over imports", spent / peer))
        results = folder / "results"
        out += [size(file.replace("/", " "), (results / file).stat().st_size) for file in SIZES]
        out += [
            size(f"{page.replace('/', ' ')}, text", words_of(results / page), "characters")
            for page in PAGES
        ]
        found = [contradictions((results / page).read_text(encoding="utf-8")) for page in PAGES]
        out.append(count("contradictions on pages", sum(map(len, found)), "same"))
        tracks = pd.read_csv(results / SCENARIO / "tracks.csv", nrows=1)
        out.append(count("columns of tracks.csv", len(tracks.columns), "same"))
        return [*out, word("inputs", given)]


def start() -> list[Metric]:
    """The least of three runs in turn."""
    times = {"import telerig": ("-c", "import telerig"), "peer": ("-c", "import numpy"),
             "telerig --help": ("-m", "telerig", "--help")}  # fmt: skip
    least = {key: min(children_cpu_s(*command) for _ in range(3)) for key, command in times.items()}
    return [
        cpu_ratio(f"{key} over import numpy", spent / least["peer"])
        for key, spent in least.items()
        if key != "peer"
    ]


TASKS: dict[str, Callable[[], list[Metric]]] = {"commands": commands, "start": start}
