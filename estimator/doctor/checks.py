"""Checks the installation, the serial ports and a dataset. Each question gives one `Check`."""

from __future__ import annotations

import importlib
import os
import platform
import sys
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distributions, requires, version
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from telerig.errors import TelerigError
from telerig.estimator.batch.jobs import check_run_name
from telerig.estimator.bubbles.detect import COVERED_LIMIT, crowded_words, is_crowded
from telerig.estimator.bubbles.lighting import NOT_BACKLIT_WORDS
from telerig.estimator.doctor.cost import Sample, cost_words, samples_of
from telerig.io.dataset.dataset import Dataset, load_dataset
from telerig.io.machine.room import free_bytes
from telerig.io.recording.ports import NO_PERMISSION, found_ports
from telerig.io.results.stale import stale
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.io.dataset.run import RunData

Status = Literal["ok", "note", "warning", "failure"]

_IMPORTS = {
    "google-re2": "re2",
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
    """The answer to one question: what was checked, what was found, and what to do about it."""

    what: str
    status: Status
    words: str
    todo: str = ""


def check_installation() -> Iterator[Check]:
    """Check Python, the packages that telerig needs, the extras, and that OpenCV is there once."""
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
            "" if have else f"pip install 'telerig[{extra}]' if you need this extra",
        )  # fmt: skip


def _required() -> list[str]:
    """Return the names of the packages that the installed telerig lists as its dependencies."""
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
    """Check that only one distribution of OpenCV is installed; two overwrite each other's files.

    OpenCV 4 and 5 both work.
    """
    here = {d.metadata["Name"] for d in distributions()}
    rivals = sorted(here & set(_OPENCV))
    have = _version("opencv-python-headless") or "none"
    if rivals:
        both = " ".join([*rivals, "opencv-python-headless"])
        return Check(
            "one OpenCV", "warning",
            f"also installed: {', '.join(rivals)}; these packages overwrite each other's files",
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
    """Check for every serial port whether it may be opened, and its adapter's latency timer."""
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
    """Check how long a USB adapter collects bytes before it sends them, which is often 16 ms."""
    try:
        held_ms = int(timer.read_text())
    except (OSError, ValueError):
        return
    slow = held_ms > _SLOW_TIMER_MS
    yield Check(
        f"{device} latency timer", "warning" if slow else "ok", f"{held_ms} ms",
        f"echo 1 | sudo tee {timer}" if slow else "",
    )  # fmt: skip


FEWEST_VIEWS = 6
_GOOD_VIEWS = 10
_LEAST_FREE_GB = 2.0
_RESULT_BYTES_PER_FRAME = 20_000
_DECODED_IMAGES = 3
_UNEVEN_STEP = 0.2
_FEWEST_READINGS = 2


def check_dataset(place: Path) -> Iterator[Check]:
    """Check rig.toml, the views, every run with its clocks and sensors, and the disk space.

    place : folder of a dataset, or of one of its runs, which is then the only one to be checked.
    """
    only = None
    if place.resolve().parent.name == "runs" and not (place / "rig.toml").is_file():
        place, only = place.resolve().parent.parent, place.resolve().name
    try:
        data = load_dataset(place, need_views=False)
    except TelerigError as error:
        yield failure("dataset", error)
        return
    cameras = ", ".join(
        f"{c.name} {c.image_size_px[0]} x {c.image_size_px[1]}" for c in data.rig.cameras.values()
    )
    yield Check("rig.toml", "ok", f"{data.rig.name!r}: {cameras}")
    yield from _views(data)
    frames = 0
    for name in data.runs:
        if only in (None, name):
            frames += yield from _run(data, name)
    if not data.runs:
        yield Check("runs", "note", "none", "put recordings into runs/<name>/<camera>/")
    yield from _results(data)
    yield from _left_over(data)
    yield _disk(data, frames)


def _results(data: Dataset) -> Iterator[Check]:
    """Check whether the results were made from the inputs that are there now."""
    folders = sorted(p.parent for p in data.results.glob("*/manifest.json"))
    for folder in folders:
        found = stale(folder)
        what = f"results {folder.name}"
        for words in found:
            yield Check(what, "warning", words)
        if not found:
            yield Check(what, "ok", "made from the inputs that are there now")


def _left_over(data: Dataset) -> Iterator[Check]:
    """Report temporary files of commands that were killed or are still running."""
    found = sorted(p for p in data.results.rglob(".*.part*") if not p.parent.name.startswith("."))
    if found:
        words = ", ".join(str(p.relative_to(data.path)) for p in found[:4])
        yield Check(
            "left over", "note", f"{len(found)} half-written: {words}",
            "remove these files if no telerig command is working on this dataset",
        )  # fmt: skip


def _views(data: Dataset) -> Iterator[Check]:
    """Check the number of views, and that they have images of both cameras."""
    done = (data.results / "calibration" / "calibration.json").is_file()
    if not data.views and (data.path / "calibration" / "dots.csv").is_file():
        words = "both images and dots.csv, of which `telerig calibrate` has to be told which to use"
        todo = "give --from images or --from dots, or move one of the two away"
        yield Check("views", "note" if done else "warning", words, todo)
        return
    if not data.views:
        words = "no views of the target, but a calibration" if done else "no views of the target"
        todo = "" if done else "put images into calibration/<camera>/<view>.tif"
        yield Check("views", "ok" if done else "warning", words, todo)
        return
    count = len(data.views)
    seen = {v.name: set(v.image_paths) for v in data.views}
    if data.table is not None:
        for view, camera in zip(data.table["view"], data.table["camera"]):
            seen[view].add(camera)
    single = [name for name, of in seen.items() if len(of) == 1 < len(data.rig.cameras)]
    words = f"{counted(count, 'view')} from {data.source}"
    if single:
        words += f", {len(single)} of them from one camera only ({', '.join(single[:4])})"
    if count < FEWEST_VIEWS:
        yield Check("views", "warning", words, f"take at least {FEWEST_VIEWS}, better 12")
    elif count < _GOOD_VIEWS:
        todo = "12 views with tilts in all directions give a better calibration"
        yield Check("views", "note", words, todo)
    else:
        yield Check("views", "ok", words)
    yield from _decoded(data)
    for note in data.notes:
        yield Check("views", "note", note)


def _decoded(data: Dataset) -> Iterator[Check]:
    """Check that the first images of every camera can be opened and have the stated size."""
    if data.source != "images":
        return
    for camera in data.rig.cameras:
        mine = [v for v in data.views if camera in v.image_paths]
        try:
            kinds = {data.image(v, camera).dtype.name for v in mine[:_DECODED_IMAGES]}
        except TelerigError as error:
            yield failure(f"images of {camera}", error)
        else:
            yield Check(f"images of {camera}", "ok", f"{len(mine)}, {', '.join(sorted(kinds))}")


def _run(data: Dataset, name: str) -> Generator[Check, None, int]:
    """Check that a run can be loaded, then its clocks and its sensors; return its frames."""
    what = f"run {name}"
    try:
        check_run_name(data.runs[name].path)
        path = data.runs[name].path
        source = "detections" if (path / "detections.csv").is_file() else None
        run = data.runs[name].load(source=source)
    except TelerigError as error:
        yield failure(what, error)
        return 0
    span = float(run.t_s[-1] - run.t_s[0]) if run.frame_count > 1 else 0.0
    rate = (run.frame_count - 1) / span if span else 0.0
    frames = counted(run.frame_count, "frame")
    words = f"{frames} from {run.source}, {span:.3g} s, {rate:.4g} per second"
    yield Check(what, "ok", words)
    for note in run.notes:
        yield Check(what, "note", note)
    samples: Mapping[str, Sample] = {}
    try:
        samples = samples_of(run) if run.source == "images" else {}
    except TelerigError as error:
        yield failure(f"{what} images", error)
    cost = cost_words(run, samples)
    if cost:
        yield Check(f"{what} time", "ok", cost)
    yield from _crowds(samples, what)
    yield from _clocks(run, what)
    yield from _sensors(run, what)
    return run.frame_count


def _crowds(samples: Mapping[str, Sample], what: str) -> Iterator[Check]:
    """Warn when bubbles cover more of an image than detection can take, or it is not backlit."""
    for camera, sample in samples.items():
        found = sample.bubbles
        if is_crowded(found.covered, len(found.accepted), COVERED_LIMIT):
            words = crowded_words(f"camera {camera}", found.covered)
            yield Check(f"{what} bubbles", "warning", words)
        if found.bright_spots:
            words = f"camera {camera}: {found.bright_spots} outlines are {NOT_BACKLIT_WORDS}"
            yield Check(f"{what} bubbles", "warning", words)


def _clocks(run: RunData, what: str) -> Iterator[Check]:
    """Report frames that are farther apart than the median step."""
    steps = np.diff(run.t_s)
    if not len(steps):
        return
    median_s = float(np.median(steps))
    gaps = int((steps > (1 + _UNEVEN_STEP) * median_s).sum())
    if gaps:
        yield Check(
            f"{what} frames.csv", "note",
            f"{counted(gaps, 'step')} longer than the median one of {1000 * median_s:.3g} ms, "
            f"the longest is {1000 * float(steps.max()):.3g} ms",
            "frames were lost, or the camera was not triggered evenly; tracking allows for both",
        )  # fmt: skip


def _sensors(run: RunData, what: str) -> Iterator[Check]:
    """Check the run's sensors and list them with their sampling rates."""
    from telerig.estimator.sensors.checks import check_sensors
    from telerig.estimator.sensors.findings import settled

    try:
        warnings = settled(check_sensors(run), frozenset())
    except TelerigError as error:
        yield failure(f"{what} sensors", error)
        return
    found = [f"encoder {_rate(run.stage['t_s'].to_numpy(float))}"] if run.stage is not None else []
    if run.accelerometers is not None:
        for sensor, rows in run.accelerometers.groupby("sensor"):
            found.append(f"{sensor} {_rate(rows['t_s'].to_numpy(float))}")
    if run.references is not None:
        found.append(counted(run.references["mark"].nunique(), "mark"))
    words = ", ".join(found) or "none, so the shake of the rig cannot be separated from the bubbles"
    todo = "" if found else "record the encoder, and an accelerometer on each arm"
    yield Check(f"{what} sensors", "ok" if found else "note", words, todo)
    for warning in warnings:
        yield Check(f"{what} sensors", "warning", warning)


def _rate(t_s: np.ndarray) -> str:
    if len(t_s) < _FEWEST_READINGS:
        return counted(len(t_s), "reading")
    return f"{(len(t_s) - 1) / (t_s[-1] - t_s[0]):.4g} Hz"


def _disk(data: Dataset, frames: int) -> Check:
    """Check that there is enough disk space for the results of so many frames."""
    free = free_bytes(data.path)
    wanted = max(_LEAST_FREE_GB * 1e9, frames * _RESULT_BYTES_PER_FRAME)
    words = f"{free / 1e9:.3g} GB free"
    if free < wanted:
        return Check("disk", "warning", words, f"results may need {wanted / 1e9:.2g} GB; make room")
    return Check("disk", "ok", words)


def failure(what: str, error: TelerigError) -> Check:
    """Return the check of something that cannot be used because of an error."""
    words = f"{error.where}: {error.what}" if error.where else error.what
    return Check(what, "failure", words, error.todo)
