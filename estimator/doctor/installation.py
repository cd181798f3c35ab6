"""Checks of the installation and the serial ports: one `Check` per question."""

from __future__ import annotations

import importlib
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distributions, requires, version
from pathlib import Path
from typing import Literal

from telerig.io.recording.ports import NO_PERMISSION, found_ports

Status = Literal["ok", "note", "warning", "failure"]

_IMPORTS = {
    "pillow": "PIL",
    "opencv-python-headless": "cv2",
    "scikit-image": "skimage",
    "pyserial": "serial",
}
_EXTRAS = {"av": "films and AVI/MP4 input (video)", "distributed": "batches on a cluster (cluster)"}
_OPENCV = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
_OLDEST, _NEWEST = (3, 11), (3, 14)
_SLOW_TIMER_MS = 2
LATENCY = Path("/sys/bus/usb-serial/devices")


@dataclass(frozen=True)
class Check:
    """what : the question. words : the answer. todo : the remedy, if one is needed."""

    what: str
    status: Status
    words: str
    todo: str = ""


def check_installation() -> Iterator[Check]:
    """Check Python, the packages that telerig needs, that there is one OpenCV only, the extras."""
    python = platform.python_version()
    known = _OLDEST <= sys.version_info[:2] <= _NEWEST
    yield Check(
        "Python", "ok" if known else "warning", python,
        "" if known else "telerig is tested with 3.11 to 3.14",
    )  # fmt: skip
    for name in _required():
        yield _package(name)
    yield _opencv()
    for name, purpose in _EXTRAS.items():
        have = _version(name)
        extra = purpose.split("(")[1].rstrip(")")
        yield Check(
            name, "ok" if have else "note", have or f"not installed: no {purpose.split(' (')[0]}",
            "" if have else f"pip install 'telerig[{extra}]' if you want it",
        )  # fmt: skip


def _required() -> list[str]:
    """Names of the packages that the installed telerig states as its dependencies."""
    try:
        stated = requires("telerig") or []
    except PackageNotFoundError:
        return ["gtsam", "numpy", "scipy", "opencv-python-headless", "scikit-image", "pyserial"]
    plain = [r for r in stated if "extra ==" not in r]
    return [r.split(";")[0].split(">")[0].split("<")[0].split("=")[0].strip() for r in plain]


def _package(name: str) -> Check:
    have = _version(name)
    if have is None:
        return Check(name, "failure", "not installed", f"pip install {name}")
    try:
        importlib.import_module(_IMPORTS.get(name, name))
    except ImportError as error:
        todo = f"pip install --force-reinstall {name}"
        return Check(name, "failure", f"{have}, but it cannot be imported: {error}", todo)
    return Check(name, "ok", have)


def _opencv() -> Check:
    """OpenCV 4 and 5 both work; two distributions of it overwrite each other's files."""
    here = {d.metadata["Name"] for d in distributions()}
    rivals = sorted(here & set(_OPENCV))
    have = _version("opencv-python-headless") or "none"
    if rivals:
        both = " ".join([*rivals, "opencv-python-headless"])
        return Check(
            "one OpenCV", "warning", f"also installed: {', '.join(rivals)}; they share files",
            f"pip uninstall -y {both} && pip install opencv-python-headless",
        )  # fmt: skip
    major = have.split(".")[0]
    if major not in ("4", "5"):
        return Check("one OpenCV", "warning", f"version {have}", "telerig is tested with 4 and 5")
    return Check("one OpenCV", "ok", f"major version {major}, of 4 and 5 that are tested")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_ports(latency: Path = LATENCY) -> Iterator[Check]:
    """Check of every serial port whether it may be opened, and its adapter's latency timer."""
    ports = found_ports()
    if not ports:
        words = "none found"
        yield Check("serial ports", "note", words, "plug the sensors in if you want to record")
    for device, name in ports:
        label = f"{device}: {name}" if name else device
        if not os.access(device, os.R_OK | os.W_OK):
            yield Check(
                device, "warning", f"{label}; you have no permission to open it", NO_PERMISSION
            )
        else:
            yield Check(device, "ok", label)
        yield from _latency(device, latency / Path(device).name / "latency_timer")


def _latency(device: str, timer: Path) -> Iterator[Check]:
    """How long a USB adapter collects bytes before it sends them, often 16 ms."""
    try:
        held_ms = int(timer.read_text())
    except (OSError, ValueError):
        return
    slow = held_ms > _SLOW_TIMER_MS
    yield Check(
        f"{device} latency timer", "warning" if slow else "ok", f"{held_ms} ms",
        f"echo 1 | sudo tee {timer}" if slow else "",
    )  # fmt: skip
