"""What a recording of rerun holds."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

needs_rerun = pytest.mark.skipif(
    find_spec("rerun") is None, reason="rerun is not installed: pip install 'telerig[view]'"
)


def entities(file: Path) -> dict[str, int]:
    """Entities of a recording by their paths, and how many chunks each has."""
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = re.findall(r"^Chunk\(\S+ with \d+ rows[^)]*\) - (/\S+)", done.stdout, re.MULTILINE)
    return {path: found.count(path) for path in found}
