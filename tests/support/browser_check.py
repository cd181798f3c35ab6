"""A page in a real browser without a screen: what its console says, how wide it is, its print."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
HARMLESS = ("willReadFrequently", "software WebGL", "GPU stall")

_PROBE = """<script>addEventListener("load", function () { setTimeout(function () {
  var d = document.documentElement, wide = [], pale = 0;
  document.querySelectorAll("p, h1, h2, h3, td, th, figcaption, li").forEach(function (e) {
    var box = e.getBoundingClientRect();
    if (box.right > d.clientWidth + 1 && !e.closest(".scroll")) { wide.push(e.textContent); }
    if (box.width && parseFloat(getComputedStyle(e).fontSize) < 11) { pale += 1; }
  });
  console.log("PROBE " + JSON.stringify({scroll: d.scrollWidth, client: d.clientWidth,
    wide: wide.slice(0, 3), small: pale, first: document.querySelector(".status").textContent,
    top: document.querySelector(".status").getBoundingClientRect().top,
    height: d.scrollHeight,
    broken: Array.from(document.images).filter(function (i) { return !i.naturalWidth; }).length
  }));
}, 1500); });</script>"""


@dataclass(frozen=True)
class Seen:
    """errors : what the console said. layout : the probe's numbers."""

    errors: list[str]
    layout: dict[str, Any]


def look(page: Path, width_px: int, work: Path) -> Seen:
    """The page laid out ``width_px`` wide, in a frame, as windows are not so narrow."""
    text = page.read_text(encoding="utf-8").replace("</body>", _PROBE + "</body>")
    (work / "page.html").write_text(text, encoding="utf-8")
    frame = work / "frame.html"
    frame.write_text(
        '<!DOCTYPE html><link rel="icon" href="data:,"><body style="margin:0">'
        f'<iframe src="page.html" style="border:0;width:{width_px}px;height:1200px"></iframe>'
    )
    options = ["--enable-logging=stderr", "--virtual-time-budget=6000", "--dump-dom"]
    said = _run([*options, f"--window-size={max(width_px, 500)},1200"], frame, work)
    lines = re.findall(r"CONSOLE[^\]]*\] (.*), source: ", said)
    probe = [line for line in lines if "PROBE {" in line]
    assert probe, said[-2000:]
    found = json.loads(probe[-1].strip('"').removeprefix("PROBE "))
    others = [line for line in lines if line not in probe]
    return Seen([o for o in others if not any(known in o for known in HARMLESS)], found)


def print_pdf(page: Path, work: Path) -> bytes:
    """The page on paper."""
    file = work / "page.pdf"
    _run(
        ["--virtual-time-budget=6000", "--no-pdf-header-footer", f"--print-to-pdf={file}"],
        page,
        work,
    )
    return file.read_bytes()


def _run(options: list[str], page: Path, work: Path) -> str:
    assert BROWSER is not None
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--hide-scrollbars",
        f"--user-data-dir={work / 'profile'}",
    ]
    offline = ["--host-resolver-rules=MAP * ~NOTFOUND"]
    done = subprocess.run(
        [*command, *offline, *options, page.as_uri()],
        capture_output=True, text=True, timeout=120, check=True, env=os.environ,
    )  # fmt: skip
    return done.stderr
