"""The command `telerig smooth` as a file: python scripts/smooth_run.py DATASET/runs/NAME."""

from __future__ import annotations

from telerig.scripts.console import run_file
from telerig.scripts.smooth import smooth

if __name__ == "__main__":
    run_file(smooth)
