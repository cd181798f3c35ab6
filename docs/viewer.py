"""A picture of results in the viewer: python docs/viewer.py FOLDER PICTURE

`telerig view FOLDER --web` serves them, and a browser without a screen opens them. Needs rerun,
Playwright (pip install playwright) and the system's chromium or Chrome.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from shutil import which

import numpy as np
from PIL import Image

from telerig.live import ADDRESS

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIZE_PX = (1600, 1000)
_OPTIONS = (
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
    "--ignore-gpu-blocklist", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
)  # fmt: skip
_LONGEST_S, _STEP_S = 120, 2
_STILL = 3
"""So many pictures one after the other are the same when everything is shown."""


def missing() -> str:
    """Return what a picture of the viewer needs and is not installed, in words; "" for nothing."""
    wanted = {"rerun": find_spec("rerun"), "playwright": find_spec("playwright")}
    wanted["chromium or Chrome"] = next(filter(None, map(which, BROWSERS)), None)
    return ", ".join(name for name, found in wanted.items() if not found)


def viewer_picture(*arguments: str | Path) -> Image.Image:
    """Return what a browser shows of `telerig view ARGUMENTS --web` when it has loaded all.

    Raises RuntimeError if nothing appears in two minutes.
    """
    from playwright.sync_api import sync_playwright

    browser = next(filter(None, map(which, BROWSERS)), None)
    with _served(*arguments), sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=browser, args=[*_OPTIONS])
        page = chromium.new_page(viewport={"width": SIZE_PX[0], "height": SIZE_PX[1]})
        page.goto(ADDRESS)
        before, same = b"", 0
        for _ in range(_LONGEST_S // _STEP_S):
            page.wait_for_timeout(1000 * _STEP_S)
            now = page.locator("canvas").first.screenshot()
            picture = Image.open(BytesIO(now)).convert("RGB")
            same = same + 1 if now == before and colours(picture) > 100 else 0
            before = now
            if same == _STILL:
                chromium.close()
                return picture
        chromium.close()
    raise RuntimeError(f"telerig view {' '.join(map(str, arguments))}: nothing appeared")


def colours(picture: Image.Image) -> int:
    """Return how many colours a picture has; a blank page has few."""
    return len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0))


@contextmanager
def _served(*arguments: str | Path) -> Iterator[None]:
    command = [sys.executable, "-m", "telerig", "view", *map(str, arguments), "--web"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        said = process.stdout.readline()
        if "open http" not in said:
            raise RuntimeError(f"telerig view: {said}{process.stdout.read()}")
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)


if __name__ == "__main__":
    viewer_picture(sys.argv[1]).save(sys.argv[2])
