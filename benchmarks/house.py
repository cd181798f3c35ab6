"""How large the house is: lines and files per folder, and the files that one command enters.

Usage: python benchmarks/house.py [--out FILE.md] [--draw SEED]
A file counts as entered when a function of it runs, in the process of the command itself. With
--draw it prints 20 messages and 20 public docstrings drawn at random, for a reader to explain; what
readers found stands below the tables of FILE.md and stays there.
"""

from __future__ import annotations

import argparse
import ast
import random
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


SPEAKS = {
    "InputError", "CalibrationError", "GeometryError", "SensorError", "Finding", "say", "warn",
    "ValueError", "Problem", "_problem", "TelerigError", "echo",
}  # fmt: skip
"""Functions and classes to which messages are given."""


def sentences() -> tuple[list[str], list[str]]:
    """All messages, and all public docstrings with their signatures, of nine words or more.

    A message is a text that a call in `SPEAKS` gets, or any text of twelve words or more.
    """
    messages, docstrings = [], []
    for file in sorted(f for top in PRODUCT for f in (ROOT / top).rglob("*.py")):
        tree, place = ast.parse(file.read_text(encoding="utf-8")), file.relative_to(ROOT)
        apart = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
        apart |= {id(v) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for v in n.values}
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in SPEAKS:
                given = [*node.args, *(k.value for k in node.keywords)]
                parts = [
                    ast.unparse(a) for a in given if isinstance(a, ast.Constant | ast.JoinedStr)
                ]
                if any(len(part.split()) >= 9 for part in parts):
                    messages.append(f"{place}:{node.lineno} {' | '.join(parts)}")
            elif isinstance(node, ast.Constant | ast.JoinedStr) and id(node) not in apart:
                if len(ast.unparse(node).split()) >= 12:
                    messages.append(f"{place}:{node.lineno} {ast.unparse(node)}")
            elif isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name[0] != "_":
                words = ast.get_docstring(node) or ""
                if len(words.split()) >= 9:
                    lines = ast.unparse(node).splitlines()
                    head = next(line for line in lines if line[0] != "@")
                    docstrings.append(f"{place}:{node.lineno} {head}\n{words}")
    return messages, docstrings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--draw", type=int)
    options = parser.parse_args()
    if options.draw is not None:
        draw = random.Random(options.draw)
        print("\n\n".join(one for kind in sentences() for one in draw.sample(kind, 20)))
        return
    lines, files = lines_and_files()
    rows = ["| folder | files | lines |", "|---|---|---|"]
    rows += [f"| {folder} | {files[folder]} | {lines[folder]} |" for folder in sorted(files)]
    rows.append(f"| all | {sum(files.values())} | {sum(lines.values())} |")
    rows += ["", "| what | files entered |", "|---|---|"]
    rows += [f"| {name} | {len(found)} |" for name, found in files_entered().items()]
    text = "\n".join(rows) + "\n"
    print(text)
    if options.out:
        before = options.out.read_text(encoding="utf-8") if options.out.is_file() else ""
        _, mark, read = before.partition("\n## ")
        options.out.write_text(f"# The house\n\n{text}{mark}{read}", encoding="utf-8")


if __name__ == "__main__":
    main()
