"""A report's page taken to pieces, and the results that it is made of changed."""

from __future__ import annotations

import base64
import json
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any


class Page(HTMLParser):
    """Text, section ids, what the page loads; fails on tags that do not close.

    spaced : the text with one space between all its words and pieces.
    """

    EMPTY = ("meta", "link", "img", "input", "br")
    LOADS = ("src", "href", "srcset", "data", "poster", "action", "background")

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.loads: list[str] = []
        self._pieces: list[str] = []
        self.feed(file.read_text(encoding="utf-8"))
        assert self.open == []
        self.text = "".join(self._pieces)
        self.spaced = re.sub(r"\s+", " ", " ".join(self._pieces))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.EMPTY:
            self.open.append(tag)
        self.ids += [value or "" for name, value in attrs if name == "id" and tag == "section"]
        self.loads += [value or "" for name, value in attrs if name in self.LOADS]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self._pieces.append(data)

    def pictures(self, kind: str) -> list[str]:
        """Those that it holds of a kind like "png"; drawings are read as XML."""
        found = [load for load in self.loads if load.startswith(f"data:image/{kind}")]
        for picture in found if kind == "svg+xml" else ():
            ET.fromstring(base64.b64decode(picture.split(",")[1]))
        return found


def edit(name: str, folder: Path, /, *without: str, **changes: Any) -> Path:
    """Change the folder's file ``name`` of JSON and leave keys out; returns the folder."""
    content = json.loads((folder / name).read_text()) | changes
    kept = {key: value for key, value in content.items() if key not in without}
    (folder / name).write_text(json.dumps(kept))
    return folder
