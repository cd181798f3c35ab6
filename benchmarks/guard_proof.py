"""Does the guard notice? Plants four faults, one after the other, and shows what it says.

Usage: python benchmarks/guard_proof.py [--workers 2]

Of each fault the parts that it can touch are run and compared with the baseline, and the whole
output goes to the end of `benchmarks/results/guard.md`. Exit code 1 if a fault was not noticed, or
if something is noticed without one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE / "results" / "guard.md"
TITLE = "## Planted faults"
TASKS = {
    "": ("dots/R 4", "bubbles/R 10", "calibration/paper, tables", "tracking/20 bubbles, table",
         "smoothing/S2 marks"),
    "sd15": ("dots/R 4", "bubbles/R 10", "calibration/paper, tables", "tracking/20 bubbles, table",
             "smoothing/S2 marks"),
    "bubbles3": ("bubbles/R 10", "bubbles/10 %", "tracking/20 bubbles, table"),
    "swap": ("tracking/20 bubbles, table", "tracking/close passes at 100"),
    "error10": ("dots/R 4", "bubbles/R 10", "calibration/paper, tables",
                "tracking/20 bubbles, table", "smoothing/S2 marks"),
}  # fmt: skip
WORDS = {
    "": "None",
    "sd15": "Standard deviations 15 % too small",
    "bubbles3": "3 % fewer bubbles",
    "swap": "One swap",
    "error10": "Errors 10 % larger (of calibrations: two of twelve views are left out)",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=2)
    workers = str(parser.parse_args().workers)
    lines = [
        TITLE, "", "By `python benchmarks/guard_proof.py`: the faults are planted in the exported",
        "functions (`guard_parts/faults.py`), and these are the ends of `guard.py --compare`.", "",
    ]  # fmt: skip
    code = 0
    for fault, tasks in TASKS.items():
        command = [sys.executable, str(HERE / "guard.py"), "--compare", "--workers", workers]
        command += ["--only", *tasks] + (["--plant", fault] if fault else [])
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        said = done.stdout.split(" s of CPU.\n\n")[-1].strip()
        lines += [f"### {WORDS[fault]}: exit code {done.returncode}", "", said, ""]
        print("\n".join(lines[-4:]), flush=True)
        code |= int(done.returncode != int(bool(fault)))
    before = PAGE.read_text(encoding="utf-8").split(TITLE)[0].rstrip()
    PAGE.write_text(before + "\n\n" + "\n".join(lines), encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())
