"""docs/requirements.md and pyproject.toml agree with each other and with what the package holds."""

from __future__ import annotations

import ast
import os
import re
import sys
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from importlib.metadata import packages_distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from places import ROOT

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PAGE = (ROOT / "docs/requirements.md").read_text(encoding="utf-8")
FOR_DEVELOPMENT = {"dev", "docs"}


def names(requirements: list[str]) -> list[str]:
    return [canonicalize_name(Requirement(text).name) for text in requirements]


REQUIRED = names(PYPROJECT["project"]["dependencies"])
EXTRAS = {
    extra: names(needed)
    for extra, needed in PYPROJECT["project"]["optional-dependencies"].items()
    if extra not in FOR_DEVELOPMENT
}


def product_files() -> Iterator[Path]:
    for folder, _, files in os.walk(ROOT / "src/telerig", followlinks=True):
        if not folder.endswith("__pycache__"):
            yield from (Path(folder) / file for file in files)


def imported() -> set[str]:
    """The distributions that the product imports, by the names that pip knows."""
    modules: set[str] = set()
    for file in product_files():
        if file.suffix != ".py":
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                modules.add(node.module.split(".")[0])
    installed = dict(packages_distributions())
    others = modules - set(sys.stdlib_module_names) - {"telerig"}
    installed.setdefault("rerun", ["rerun-sdk"])  # large, so it is in no extra for development
    return {canonicalize_name(name) for m in others for name in installed.get(m, [m])[:1]}


def test_the_table_has_every_requirement_once() -> None:
    rows = re.findall(r"^\| ([a-z0-9-]+) \|.*\| \d+(?: \+ \d+)? \|$", PAGE, re.MULTILINE)
    assert sorted(rows) == sorted(REQUIRED)
    extras = re.findall(r"^\| `(\w+)` \| ([\w-]+) \|", PAGE, re.MULTILINE)
    assert sorted(extras) == sorted((e, name) for e, needed in EXTRAS.items() for name in needed)


def test_every_requirement_is_imported_and_every_import_is_required() -> None:
    found = imported()
    assert set(REQUIRED) <= found
    assert found <= {*REQUIRED, *(name for needed in EXTRAS.values() for name in needed)}


def test_every_file_of_the_package_is_in_the_wheel() -> None:
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]
    left = [
        str(file)
        for file in product_files()
        if file.suffix != ".py"
        for package in [".".join(file.parent.relative_to(ROOT / "src").parts)]
        if not any(fnmatch(file.name, pattern) for pattern in patterns.get(package, []))
    ]
    assert left == []
