"""Runs the blocks of the documentation's pages, and knows those that cannot run in a test.

A page is read block by block: ``sh`` runs in bash, ``python`` in one namespace a page, ``toml`` is
read as `rig.toml`, ``text`` is what the block before it printed, numbers aside. Before a block:
``<!-- not run: KEY -->`` with a key of `NOT_RUN`, ``<!-- exit code: N -->``.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from places import ROOT
from typer.testing import CliRunner

from telerig.io.dataset.new_dataset import new_dataset
from telerig.io.rig_file.rig_file import description_from_toml
from telerig.scripts.main import app

CELL = "{code-cell} ipython3"
LANGUAGES = ("sh", "python", "toml", "text", CELL, "{toctree}", "{eval-rst}")

NOT_RUN = {
    "cron": "needs a cron daemon and waits for the night; the script is run",
    "completion": "changes the start-up file of the user's shell",
    "dask": "needs a cluster; a test runs a scheduler and two workers",
    "devices": "needs a laboratory; a test records simulated devices",
    "figures": "is a layout, not a program",
    "install": "makes an environment; .ci/run runs it literally",
    "plate": "needs images of a plate; a test draws them",
    "viewer": "opens a window; a test shows them in a browser",
    "slurm": "needs a Slurm cluster; the script that it submits is run",
}
"""Why a block with this key is not run."""

ELSEWHERE = {
    "docs/exports.md": "tests/io/exchange/test_docs_exports.py",
    "docs/howto/join.md": "tests/estimator/smoothing/test_logger_joined.py",
    "docs/reports.md": "tests/io/report/test_report_command.py",
}
"""Pages whose blocks run in a test of their own."""

COMPARED = ("docs/tutorial.md",)
"""Pages whose numbers have to be those that are printed."""

SENSOR = """
[accelerometers.arm_left]
mounted_on = "left"
axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
noise_density_ug_sqrt_hz = 22.5
"""
"""Which tables of devices take for granted."""

FENCE = re.compile(
    r"(?P<before>(?:^<!--[^\n]*-->\n)*)^```(?P<language>[^\n]*)\n(?P<code>.*?)^```$", re.M | re.S
)
PLAIN = re.compile(r"(telerig [\w ./:=-]+\n)+")
"""Lines that need no shell."""
NUMBER = re.compile(r"[-+]?\d[\d.,]*(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Block:
    page: str
    line: int
    language: str
    code: str
    not_run: str = ""
    exit_code: int = 0

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"


def pages() -> list[str]:
    """README and every page under docs/ that somebody wrote, as paths in the repository."""
    found = [p for p in (ROOT / "docs").rglob("*.md") if "_generated" not in p.parts]
    return sorted(p.relative_to(ROOT).as_posix() for p in [*found, ROOT / "README.md"])


def blocks_of(page: str) -> list[Block]:
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = []
    for match in FENCE.finditer(text):
        said = dict(re.findall(r"<!-- (not run|exit code): (.*?) -->", match["before"]))
        blocks.append(
            Block(
                page,
                text.count("\n", 0, match.start("language")) + 1,
                match["language"].strip(),
                match["code"],
                said.get("not run", ""),
                int(said.get("exit code", 0)),
            )
        )
    return blocks


def environment(folder: Path) -> dict[str, str]:
    """With a command `telerig` that is this very package, and a Slurm task's variables."""
    commands = folder / ".commands"
    commands.mkdir(exist_ok=True)
    command = commands / "telerig"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m telerig.scripts.main "$@"\n')
    command.chmod(0o755)
    slurm = {"ARRAY_TASK_ID": "1", "ARRAY_TASK_COUNT": "2", "CPUS_PER_TASK": "1"}
    return {
        **os.environ,
        "PATH": f"{commands}{os.pathsep}{os.environ['PATH']}",
        "COLUMNS": "200",
        "TELERIG_DEBUG": "",
        **{f"SLURM_{name}": value for name, value in slurm.items()},
    }


class PageRunner:
    """One page's blocks, in order, in one folder; the current one, for Python."""

    def __init__(self, folder: Path, names: dict[str, object] | None = None) -> None:
        self.folder, self.names, self.said = folder, dict(names or {}), ""
        self.environment = environment(folder)
        self.ran = 0

    def run(self, block: Block) -> None:
        if block.not_run:
            return
        if block.language == "sh":
            self.said = self._bash(block)
        elif block.language in ("python", CELL):
            self.said = self._python(block)
        elif block.language == "toml":
            check_toml(block)
        elif block.language == "text":
            check_output(block, self.said)
        self.ran += 1

    def _bash(self, block: Block) -> str:
        if PLAIN.fullmatch(block.code):
            return self._here(block)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block.code], cwd=self.folder, env=self.environment,
            text=True, timeout=300, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert done.returncode == block.exit_code, f"{block.where}: {done.stdout}"
        return done.stdout

    def _here(self, block: Block) -> str:
        """Commands alone, in this process: Python and its libraries start once."""
        said, code = "", 0
        with contextlib.chdir(self.folder):
            for line in block.code.splitlines():
                words = shlex.split(line)[1:]
                done = CliRunner().invoke(app, words, env=self.environment)
                if done.exception and not isinstance(done.exception, SystemExit):
                    raise done.exception
                said, code = said + done.output, done.exit_code
                if code:
                    break
        assert code == block.exit_code, f"{block.where}: {said}"
        return said

    def _python(self, block: Block) -> str:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile("\n" * block.line + block.code, block.page, "exec"), self.names)
        return printed.getvalue()


def check_toml(block: Block) -> None:
    """A whole `rig.toml` is read as one; tables of it are, added to the template."""
    content = tomllib.loads(block.code)
    if "schema" in content:
        description_from_toml(block.code, where=block.where)
    elif all(isinstance(value, dict) for value in content.values()):
        with tempfile.TemporaryDirectory() as folder:
            template = new_dataset(Path(folder) / "rig")[0].read_text(encoding="utf-8")
        sensors = "" if "accelerometers" in content else SENSOR
        whole = template + sensors + block.code
        description_from_toml(whole, where=block.where)


def masked(line: str) -> str:
    return " ".join(NUMBER.sub("#", line).split())


def check_output(block: Block, said: str) -> None:
    """Every line of the block begins a line of the output, ``...`` ends it; numbers may differ.

    On the pages of `COMPARED` they are compared, see `like`.
    """
    printed = said.splitlines()
    for line in block.code.splitlines():
        line = line.removesuffix("...").rstrip()
        found = [p for p in printed if masked(p).startswith(masked(line))]
        assert found, f"{block.where}: {line!r} in\n{said}"
        if block.page in COMPARED:
            assert any(like(line, p) for p in found), f"{block.where}: {line!r} is\n{found}"


def like(line: str, printed: str) -> bool:
    """Whether the numbers of a page's line are those that were printed.

    A number before ``± sd`` may differ by half of this standard deviation, a whole number by 1 or
    2 % of it, seconds by anything, and every other number by 10 % or one unit of its last digit.
    """
    for match, other in zip(NUMBER.finditer(line), NUMBER.finditer(printed)):
        text, after = match[0].strip(".,"), line[match.end() :]
        value, seen = (float(m[0].rstrip(".,").replace(",", "")) for m in (match, other))
        sd = re.match(r" ± ([\d.e-]+\d)", after)
        decimals = len(text.partition(".")[2])
        if sd:
            near = 0.5 * float(sd[1])
        elif re.match(r" s\b", after):
            continue
        else:
            near = max(10.0**-decimals, (0.1 if decimals else 0.02) * abs(value))
        if abs(value - seen) > near + 1e-12:
            return False
    return True
