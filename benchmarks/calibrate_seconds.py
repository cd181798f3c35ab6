"""Wall and processor time of `telerig calibrate` as a whole process: 24 images of 512 x 512.

Usage: python benchmarks/calibrate_seconds.py [--runs 10]

Preset `paper`; the time of everything from the interpreter's start to its end, report included.
Processor time is that of all its processes. The first run, not counted, leaves the compiled
modules that an installation has.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import telerig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10)
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "set"
        telerig.simulate("paper", rng=np.random.default_rng(0), out=folder)
        command = [sys.executable, "-m", "telerig.scripts.main", "calibrate", str(folder)]
        seconds(command)
        figures = np.array([seconds(command) for _ in range(runs)])
    wall, used = figures.T
    print(f"wall, s: {' '.join(f'{s:.1f}' for s in np.sort(wall))}; median {np.median(wall):.1f}")
    print(f"processor, s: median {np.median(used):.1f}, least {used.min():.1f}")


def seconds(command: list[str]) -> tuple[float, float]:
    """Wall and processor time of one run."""
    settings = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    before, begun = _used(), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=settings)
    return time.perf_counter() - begun, _used() - before


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
