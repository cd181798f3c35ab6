"""Folders with the unfinished work of an interrupted command, which go on if nothing changed."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from telerig import version
from telerig.io.files.atomic import write_json_atomic
from telerig.io.files.hashing import hashed

if TYPE_CHECKING:
    from telerig.io.results.inputs import Input


def work_key(options: Mapping[str, Any], inputs: Mapping[str, Input]) -> str:
    """Return a hash of options, of the inputs' fingerprints and of the program."""
    stated = [version.VERSION, options, {k: v.model_dump() for k, v in inputs.items()}]
    found = hashlib.sha256(json.dumps(stated, default=str).encode())
    here = Path(version.__file__).parent
    program = (Path(folder) / name for folder, _, names in os.walk(here, followlinks=True)
               for name in names)  # fmt: skip
    for file in sorted(path for path in program if path.suffix == ".py"):
        found.update(hashed(file).sha256.encode())
    return found.hexdigest()


def empty_unless(folder: Path, key: str) -> None:
    """Remove what a folder holds, unless it was made with the same key."""
    mark, state = folder / "work.json", {"fingerprint": key}
    if not (mark.is_file() and json.loads(mark.read_bytes()) == state):
        shutil.rmtree(folder, ignore_errors=True)
        write_json_atomic(mark, state)
