"""Random operators and constants of the product changed, one at a time: do the tests notice?

Usage: python benchmarks/mutation.py FOLDER... --tests PATH... [--number 15] [--seed 0]
           [--product CHECKOUT] [--tests-from CHECKOUT] [--work FOLDER] [--again] [--out FILE.md]

FOLDER : folders or files of the product whose operators may be changed, like `estimator/smoothing`.
--tests : the tests that may notice, like `tests/estimator/smoothing tests/factors`.
--product, --tests-from : the checkouts that the product and the `tests` folder are copied from
(this one). Two versions of the tests are compared on the same product with the same seed.
--work : where the copy stands; it is kept, with its compiled loops, for the next call.

The tests run once unchanged, which shows the functions that each of them enters (`entered.json` in
the copy; `--again` takes what the last call with this `--work` found). For each change only those
that enter the changed function run, the quickest first, until one fails; then the other tests of
their files, because of what these keep for several tests. Compiled functions, constants of modules
and bodies of classes belong to the functions that name them. What a test does in other processes is
not seen.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
OPTIONS = ["-p", "no:cacheprovider", "-q", "--no-header", "--tb=no"]
SWAPS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", ">="), ast.LtE: ("<=", ">"), ast.Gt: (">", "<="), ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip
Place = tuple[str, int]  # of a function: its file, and its first line with its decorators


@dataclass(frozen=True)
class Change:
    """Bytes `start` to `end` of a file of the product become `text`, in one of its definitions."""

    file: str
    line: int
    start: int
    end: int
    text: str
    definition: ast.stmt

    def words(self, product: Path) -> str:
        source = (product / self.file).read_bytes()
        first = source.rfind(b"\n", 0, self.start) + 1
        last = source.find(b"\n", self.end)
        line = source[first : self.start] + b"[" + source[self.start : self.end] + b" -> "
        return (line + self.text.encode() + b"]" + source[self.end : last]).decode().strip()


def changes_of(product: Path, file: str) -> Iterator[Change]:
    """Every change of an operator or a number in a file; annotations and messages are left out."""
    source = (product / file).read_bytes()
    begin = np.cumsum([0, *(len(line) for line in source.splitlines(keepends=True))])

    def at(node: ast.expr, end: bool = False) -> int:
        line, column = (
            (node.end_lineno, node.end_col_offset) if end else (node.lineno, node.col_offset)
        )
        assert line is not None and column is not None
        return int(begin[line - 1]) + column

    def visit(node: ast.AST, definition: ast.stmt) -> Iterator[Change]:
        if isinstance(node, ast.JoinedStr):
            return
        gaps: list[tuple[ast.AST, int, int]] = []
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            gaps = [(node.ops[0], at(node.left, True), at(node.comparators[0]))]
        elif isinstance(node, ast.BinOp):
            gaps = [(node.op, at(node.left, True), at(node.right))]
        elif isinstance(node, ast.BoolOp):
            gaps = [(node.op, at(a, True), at(b)) for a, b in zip(node.values, node.values[1:])]
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            value = node.value
            if isinstance(value, bool):
                text = repr(not value)
            else:
                text = repr(value + 1 if isinstance(value, int) else 1.5 * value or 1.0)
            yield Change(file, node.lineno, at(node), at(node, True), text, definition)
        for kind, start, end in gaps:
            old, new = SWAPS.get(type(kind), ("", ""))
            where = source.find(old.encode(), start, end) if old else -1
            if where >= 0:
                line = source.count(b"\n", 0, where) + 1
                yield Change(file, line, where, where + len(old), new, definition)
        for name, value in ast.iter_fields(node):
            if name not in ("annotation", "returns"):
                for child in value if isinstance(value, list) else [value]:
                    if isinstance(child, ast.AST):
                        yield from visit(child, definition)

    for definition in _definitions(ast.parse(source)):
        children = definition.decorator_list if isinstance(definition, ast.ClassDef) else None
        for child in [definition] if children is None else children:
            yield from visit(child, definition)


def _definitions(node: ast.Module | ast.ClassDef) -> Iterator[ast.stmt]:
    """The functions and other statements of a module, and those of its classes."""
    for statement in node.body:
        yield statement
        if isinstance(statement, ast.ClassDef):
            yield from _definitions(statement)


def _names(definition: ast.stmt) -> set[str]:
    return {n.id for n in ast.walk(definition) if isinstance(n, ast.Name)} | {
        n.attr for n in ast.walk(definition) if isinstance(n, ast.Attribute)
    }


class Product:
    """Where the functions of a product stand, and which of them name another thing."""

    def __init__(self, folder: Path) -> None:
        self.functions: list[tuple[Place, ast.FunctionDef, set[str]]] = []
        for top in ("estimator", "factors", "io", "rig", "scripts", "src/telerig"):
            for path in sorted((folder / top).rglob("*.py")):
                tree = ast.parse(path.read_bytes())
                file = str(path.relative_to(folder))
                for one in _definitions(tree):
                    if isinstance(one, ast.FunctionDef):
                        self.functions.append(((file, _first_line(one)), one, _names(one)))

    def reached_by(self, change: Change) -> set[Place]:
        """The functions that have to be entered for the change to matter."""
        one, seen = change.definition, set[str]()
        if isinstance(one, ast.FunctionDef) and not _compiled(one):
            return {(change.file, _first_line(one))}
        if isinstance(one, ast.FunctionDef):
            wanted = {one.name}
        else:
            wanted = {
                n.id for n in ast.walk(one)
                if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
            }  # fmt: skip
        found = set[Place]()
        while wanted - seen:
            now, seen = wanted - seen, seen | wanted
            for place, function, names in self.functions:
                if names & now and _compiled(function):
                    wanted.add(function.name)
                elif names & now:
                    found.add(place)
        return found


def _first_line(function: ast.FunctionDef) -> int:
    return min([function.lineno, *(d.lineno for d in function.decorator_list)])


def _compiled(function: ast.FunctionDef) -> bool:
    return any("compiled" in ast.dump(d) for d in function.decorator_list)


# --- the plugin of pytest that notes which functions each test enters --------------------------


class Notes:
    """Seconds of processor time of each test, and the functions of the product that it enters."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.places: dict[CodeType, Place | None] = {}
        self.entered: set[Place] = set()
        self.by_fixture: dict[str, set[Place]] = defaultdict(set)
        self.tests: dict[str, dict[str, Any]] = {}

    def enter(self, frame: FrameType, event: str, argument: Any) -> None:
        code = frame.f_code
        if code not in self.places:
            file = Path(code.co_filename).resolve()
            inside = file.is_relative_to(self.folder) and not code.co_name.startswith("<")
            place = (str(file.relative_to(self.folder)), code.co_firstlineno) if inside else None
            self.places[code] = place
        if (place := self.places[code]) is not None:
            self.entered.add(place)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Generator[None, Any, Any]:
        before, self.entered = self.entered, set()
        try:
            return (yield)
        finally:
            self.by_fixture[f"{fixturedef.baseid}:{fixturedef.argname}"] |= self.entered
            self.entered |= before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> Generator[None, Any, Any]:
        self.entered, begin = set(), time.process_time()
        sys.settrace(self.enter)
        threading.settrace(self.enter)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            for definitions in item._fixtureinfo.name2fixturedefs.values():
                for one in definitions:
                    self.entered |= self.by_fixture[f"{one.baseid}:{one.argname}"]
            seconds = time.process_time() - begin
            self.tests[item.nodeid] = {"seconds": seconds, "entered": sorted(self.entered)}

    def pytest_sessionfinish(self) -> None:
        (self.folder / "entered.json").write_text(json.dumps(self.tests))


def pytest_configure(config: Any) -> None:
    config.pluginmanager.register(Notes(Path(os.environ["MUTATION_FOLDER"])))


# --- the study ---------------------------------------------------------------------------------


def copied(product: Path, tests: Path, work: Path) -> None:
    """Copy the product with its tests; files that are the same keep their compiled loops."""
    work.mkdir(parents=True, exist_ok=True)
    for name in ("estimator", "factors", "io", "rig", "scripts", "src", "benchmarks", "docs"):
        _sync(product / name, work / name)
    for name in ("pyproject.toml", "README.md", "CONVENTIONS.md", "CHANGELOG.md"):
        shutil.copy2(product / name, work / name)
    _sync(tests / "tests", work / "tests")
    shutil.copy2(Path(__file__), work / "benchmarks" / "mutation.py")


def _sync(source: Path, target: Path) -> None:
    for path in sorted(target.rglob("*"), reverse=True):
        if "__pycache__" not in path.parts and not (source / path.relative_to(target)).exists():
            path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    for path in sorted(source.rglob("*")):
        to = target / path.relative_to(source)
        if "__pycache__" in path.parts or ".egg-info" in str(path):
            continue
        if path.is_symlink():
            if not to.is_symlink():
                to.parent.mkdir(parents=True, exist_ok=True)
                to.symlink_to(path.readlink())
        elif path.is_file() and not (to.is_file() and to.read_bytes() == path.read_bytes()):
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(path, to)


def run_tests(work: Path, arguments: list[str], seconds: float | None) -> int:
    """The exit code of pytest; 124 if it takes longer than the seconds."""
    paths = [str(work / "src"), str(work / "benchmarks")]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1",
        "MUTATION_FOLDER": str(work), "OPENBLAS_NUM_THREADS": "1",
    }  # fmt: skip
    command = [sys.executable, "-m", "pytest", *OPTIONS, *arguments]
    try:
        return subprocess.run(
            command, cwd=work, env=environment, timeout=seconds, stdout=subprocess.DEVNULL
        ).returncode
    except subprocess.TimeoutExpired:
        return 124


def noticed(work: Path, tests: dict[str, Any], places: set[Place]) -> str:
    """What notices the change that stands in the copy."""
    reach = [n for n, t in tests.items() if places & {tuple(e) for e in t["entered"]}]
    if not reach:
        return "no test enters it"
    reach.sort(key=lambda name: tests[name]["seconds"])
    files = sorted({name.split("::")[0] for name in reach})
    cost = sum(t["seconds"] for n, t in tests.items() if n.split("::")[0] in files)
    rest = [*files, *(f"--deselect={n}" for n in reach)]
    for arguments in (reach, rest):
        code = run_tests(work, ["-x", *arguments], 120 + 10 * cost)
        if code not in (0, 5):
            return "hangs" if code == 124 else "noticed"
    return f"SURVIVES {len(reach)} tests"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+")
    parser.add_argument("--tests", nargs="+", required=True)
    parser.add_argument("--number", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--product", type=Path, default=ROOT)
    parser.add_argument("--tests-from", type=Path, default=ROOT)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    work = (given.work or Path(tempfile.mkdtemp(prefix="mutation-"))).resolve()
    copied(given.product, given.tests_from, work)
    files = [
        str(p.relative_to(work)) for f in given.folders
        for p in ([work / f] if (work / f).is_file() else sorted((work / f).rglob("*.py")))
    ]  # fmt: skip
    every = [change for file in files for change in changes_of(work, file)]
    rng = np.random.default_rng(given.seed)
    chosen = [every[i] for i in rng.choice(len(every), given.number, replace=False)]
    product = Product(work)
    places = [product.reached_by(change) for change in chosen]
    code = 0 if given.again else run_tests(work, ["-p", "mutation", *given.tests], None)
    if code:
        raise SystemExit(f"pytest ends with code {code} while nothing is changed")
    tests = json.loads((work / "entered.json").read_text())
    lines = ["| place | change | result |", "|---|---|---|"]
    for change, reach in zip(chosen, places):
        path = work / change.file
        source, stat = path.read_bytes(), path.stat()
        words = change.words(work).replace("|", "\\|")
        path.write_bytes(source[: change.start] + change.text.encode() + source[change.end :])
        try:
            result = noticed(work, tests, reach)
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        lines.append(f"| {change.file}:{change.line} | `{words}` | {result} |")
        print(lines[-1], flush=True)
    cpu = sum(t["seconds"] for t in tests.values())
    lost = sum("noticed" not in line and "hangs" not in line for line in lines[2:])
    result = f"{given.number - lost} of {given.number} noticed by {len(tests)} tests of {cpu:.0f} s"
    lines.append(f"\n{result} of processor time.")
    print(lines[-1])
    if given.out:
        given.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
