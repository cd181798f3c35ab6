"""Pages that are made when the documentation is built.

Pages of the repository's root and of benchmarks/ are taken in as they stand, and the commands' help
is asked of the command line itself. Links work both in the repository and in the built pages.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
GENERATED = "_generated"
TAKEN_IN = ("CONVENTIONS.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")
CODE = re.compile(
    r"(^```.*?^```\s*?$|!?\[(?:[^\[\]`]|`[^`\n]+`)*\]\([^()\s]+\)|`[^`\n]+`)",
    flags=re.DOTALL | re.MULTILINE,
)
"""Code, and links as a whole: the text of a link may be code."""


def taken_in() -> dict[str, Path]:
    """Document name to the file of the repository that it shows."""
    files = [ROOT / name for name in TAKEN_IN]
    files += [
        ROOT / "benchmarks" / "README.md",
        *sorted((ROOT / "benchmarks/results").glob("*.md")),
    ]
    return {
        f"{GENERATED}/{path.relative_to(ROOT).with_suffix('').as_posix()}": path for path in files
    }


def with_links(text: str, docname: str) -> str:
    """The text with links to other files turned into links between built pages.

    A link to a file that has no page becomes its text.
    """
    documents = {path: name for name, path in taken_in().items()}
    here = taken_in().get(docname, DOCS / f"{docname}.md")

    def turned(match: re.Match[str]) -> str:
        mark, words, target = match.groups()
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        name, _, anchor = target.partition("#")
        path = (here.parent / name).resolve()
        if path not in documents and not path.is_relative_to(DOCS):
            return words
        if path in documents:
            path = DOCS / f"{documents[path]}.md"
        if path.is_dir():
            return words
        start = (DOCS / docname).parent
        link = Path(os.path.relpath(path, start)).as_posix()
        return f"{mark}[{words}]({link}{'#' + anchor if anchor else ''})"

    pieces = CODE.split(text)
    return "".join(p if p.startswith("`") else LINK.sub(turned, p) for p in pieces)


def commands_page() -> str:
    """The help of every command, as the command line prints it."""
    import typer
    from typer.testing import CliRunner

    from telerig.scripts.main import app

    def help_of(words: list[str]) -> str:
        result = CliRunner().invoke(
            app, [*words, "--help"], prog_name="telerig", env={"COLUMNS": "100", "TERM": "dumb"}
        )
        title = "telerig " + " ".join(words)
        lines = (line.rstrip() for line in result.output.strip().splitlines())
        return f"## {title.strip()}\n\n```text\n" + "\n".join(lines) + "\n```\n"

    command = typer.main.get_command(app)
    pages = ["# The commands' own help\n", help_of([])]
    for name, inner in getattr(command, "commands", {}).items():
        pages.append(help_of([name]))
        pages += [help_of([name, below]) for below in getattr(inner, "commands", {})]
    return "\n".join(pages)


def titled(path: Path) -> str:
    """A page's text; one that begins with no title gets its file's name."""
    text = path.read_text(encoding="utf-8")
    return text if text.startswith("# ") else f"# {path.stem.replace('_', ' ')}\n\n{text}"


def _write(docname: str, suffix: str, text: str) -> None:
    path = DOCS / f"{docname}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def make_pages(*_: Any) -> None:
    """Write docs/_generated/, and take away what no longer belongs there."""
    wanted = {f"{name}.md": titled(path) for name, path in taken_in().items()}
    wanted[f"{GENERATED}/commands.md"] = commands_page()
    for old in (DOCS / GENERATED).rglob("*.*"):
        if old.is_file() and old.relative_to(DOCS).as_posix() not in wanted:
            old.unlink()
    for file, text in wanted.items():
        name, dot, suffix = file.rpartition(".")
        _write(name, dot + suffix, text)


def turn_links(app: Any, docname: str, source: list[str]) -> None:
    if (DOCS / f"{docname}.md").exists():
        source[0] = with_links(source[0], docname)


def setup(app: Any) -> dict[str, bool]:
    app.connect("config-inited", make_pages)
    app.connect("source-read", turn_links)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
