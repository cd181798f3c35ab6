"""Docstrings are plain text with `names` in backticks: made safe for reStructuredText here.

A line ``name : what it is`` becomes an item of a list, an indented block stays as it is.
"""

from __future__ import annotations

import re
from typing import Any

ITEM = re.compile(r"^(\w[\w.\[\] ]*(?:, \w[\w. ]*)*) : +(.*)$")
QUOTED = re.compile(r"(``.+?``|(?::\w+:)?`[^`]+`)", re.DOTALL)


def inline(text: str) -> str:
    """Text of a paragraph: code in backticks, everything else as it stands."""
    pieces = QUOTED.split(text)
    for i, piece in enumerate(pieces):
        if i % 2:
            code = re.sub(r"^(:\w+:)?`+|`+$", "", piece).strip()
            before = pieces[i - 1][-1:]
            after = pieces[i + 1][:1]
            glue = (
                ("\\ " if re.match(r"[\w.(\[]", before or " ") else ""),
                ("\\ " if re.match(r"\w", after or " ") else ""),
            )
            pieces[i] = f"{glue[0]}``{code}``{glue[1]}"
        else:
            pieces[i] = piece
    return "".join(p if i % 2 else re.sub(r"([\\*|_`])", r"\\\1", p) for i, p in enumerate(pieces))


def block(lines: list[str]) -> list[str]:
    """One paragraph of a docstring as reStructuredText."""
    if all(line.startswith("    ") or line.startswith("  ") for line in lines):
        return ["::", "", *("   " + line for line in lines), ""]
    parts: list[tuple[str, list[str]]] = []
    for line in lines:
        item = ITEM.match(line)
        bullet = re.match(r"^[-*] +(.*)$", line)
        if item:
            parts.append((f"- **{inline(item[1])}** : ", [item[2]]))
        elif bullet:
            parts.append(("- ", [bullet[1]]))
        elif parts and (line[0] == " " or not parts[-1][0] or parts[-1][1][-1][-1:] not in ".:"):
            parts[-1][1].append(line.strip())
        else:
            parts.append(("", [line.strip()]))
    out: list[str] = []
    for lead, words in parts:
        if out and not (lead and out[-1].startswith("- ")):
            out.append("")
        out.append(lead + inline(" ".join(words)))
    return [*out, ""]


def plain(lines: list[str]) -> list[str]:
    """A docstring's lines as reStructuredText."""
    paragraphs: list[list[str]] = [[]]
    for line in lines:
        if line.strip():
            paragraphs[-1].append(line)
        elif paragraphs[-1]:
            paragraphs.append([])
    return [out for paragraph in paragraphs if paragraph for out in block(paragraph)]


def process(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = plain(lines)


def keep_own_types(app: Any, doctree: Any) -> None:
    """Links in annotations only to telerig's own full names: short ones are not unique."""
    from sphinx.addnodes import pending_xref

    for node in list(doctree.findall(pending_xref)):
        if node.get("refdomain") == "py" and not node["reftarget"].startswith("telerig."):
            node.replace_self(node.children)


def setup(app: Any) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", process)
    app.connect("doctree-read", keep_own_types)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
