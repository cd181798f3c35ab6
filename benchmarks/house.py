"""How large the house is: lines and files per folder, and the files that one command enters.

Usage: python benchmarks/house.py [--out FILE.md]
A file counts as entered when a function of it runs, in the process of the command itself.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
PRODUCT = ("rig", "factors", "estimator", "io", "scripts", "src")


def lines_and_files() -> tuple[Counter[str], Counter[str]]:
    """Lines and files of every folder of the product."""
    lines: Counter[str] = Counter()
    files: Counter[str] = Counter()
    for top in PRODUCT:
        for file in (ROOT / top).rglob("*.py"):
            folder = file.parent.relative_to(ROOT).as_posix()
            lines[folder] += file.read_text(encoding="utf-8").count("\n")
            files[folder] += 1
    return lines, files


def entered(work: Callable[[], object]) -> set[str]:
    """Files of telerig in which a function ran."""
    found: set[str] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_name != "<module>":
            found.add(frame.f_code.co_filename)

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return {
        f for f in found if ("/telerig/" in f or f.startswith(str(ROOT))) and "benchmarks" not in f
    }


def files_entered() -> dict[str, set[str]]:
    """By a calibration from images, a tracking from images and a smoothing, without their pages."""
    import telerig

    with tempfile.TemporaryDirectory() as place:
        rng = np.random.default_rng(0)
        data = telerig.simulate("rise", rng=rng, out=Path(place) / "data")
        dataset = telerig.load_dataset(data.path)
        kept: dict[str, Any] = {}

        def calibrate() -> None:
            kept["calibration"] = telerig.calibrate(dataset)

        def track() -> None:
            run = dataset.runs["rise"].load()
            kept["run"], kept["tracks"] = run, telerig.track(run, kept["calibration"])

        def smooth() -> None:
            telerig.smooth(kept["tracks"], kept["calibration"], stage=kept["run"])

        return {w.__name__: entered(w) for w in (calibrate, track, smooth)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    lines, files = lines_and_files()
    rows = ["| folder | files | lines |", "|---|---|---|"]
    rows += [f"| {folder} | {files[folder]} | {lines[folder]} |" for folder in sorted(files)]
    rows.append(f"| all | {sum(files.values())} | {sum(lines.values())} |")
    rows += ["", "| what | files entered |", "|---|---|"]
    rows += [f"| {name} | {len(found)} |" for name, found in files_entered().items()]
    text = "\n".join(rows) + "\n"
    print(text)
    if options.out:
        options.out.write_text(f"# The house\n\n{text}", encoding="utf-8")


if __name__ == "__main__":
    main()
