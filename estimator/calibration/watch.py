"""Calibrate while the views are being taken: solve again whenever a view is complete."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pandas as pd

from telerig.errors import CalibrationError, InputError, TelerigError
from telerig.estimator.calibration.calibrate import (
    CalibrationRun,
    check_options,
    run_calibration,
    solve_dots,
)
from telerig.estimator.calibration.next_view import first_views
from telerig.estimator.calibration.thresholds import ENOUGH_SHARE, RECOMMENDED_VIEWS
from telerig.estimator.dots.dataset_dots import (
    NO_DOTS,
    DatasetDots,
    ImageDots,
    detect_image,
    detected_together,
)
from telerig.estimator.dots.locate import REJECTED
from telerig.io.dataset.dataset import Dataset, NoViewsError, View, load_dataset
from telerig.live import due, folder_for_viewer, publish
from telerig.rig.pose import rotation_from_rotvec, rotvec_from_rotation
from telerig.short_text import number

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration

_SETTLE_S = 0.2
"""At the end an image counts as completely written if it does not change for so long."""

Tell = Callable[[str], None]
Stamp = tuple[int, int]


class Stop(Protocol):
    """A flag that says when to stop, such as a `threading.Event`."""

    def wait(self, timeout: float) -> bool:
        """Wait at most ``timeout`` seconds; return whether the end was asked for."""

    def is_set(self) -> bool:
        """Return whether the end was asked for."""


@dataclass
class WatchedFolder:
    """The images of a dataset as they arrive in its folder; dots are detected in each image once.

    An image counts as completely written when its size and its time of change are the same at two
    polls. If it changes later, its dots are detected again.

    path : folder of the dataset.
    tell : function that gets messages for the user.
    patience_s : if an image of a view is missing for longer than this, one message says so.
    """

    path: Path
    tell: Tell
    dataset: Dataset | None = None
    patience_s: float = 5.0
    _stamps: dict[Path, Stamp] = field(default_factory=dict)
    _found: dict[Path, tuple[Stamp, ImageDots]] = field(default_factory=dict)
    _said: str = ""
    _rig: bytes = b""
    _waiting_s: dict[tuple[str, str], float] = field(default_factory=dict)

    def poll(self, stop: Stop | None = None) -> None:
        """Look into the folder once and detect the dots in new images; end early at ``stop``."""
        dataset = self._listed()
        if dataset is None:
            return
        before, self._stamps = self._stamps, {}
        paths = {path for view in dataset.views for path in view.image_paths.values()}
        for path in self._found.keys() - paths:
            del self._found[path]
        for view in dataset.views:
            for camera, path in view.image_paths.items():
                stamp = _stamp(path)
                if stamp is None or (stop is not None and stop.is_set()):
                    continue
                self._stamps[path] = stamp
                complete = stamp[0] > 0 and before.get(path) == stamp
                if complete and self._found.get(path, (None,))[0] != stamp:
                    self._found[path] = stamp, self._detected(dataset, view, camera)
                    self._show(path)
        self.dataset = replace(dataset, views=self._views(dataset))
        self._remind(dataset, time.monotonic())

    def _remind(self, dataset: Dataset, now_s: float) -> None:
        """Name the views that wait for a camera's image, each once."""
        waiting = [
            (view.name, camera)
            for view in dataset.views
            for camera in dataset.rig.cameras
            if camera not in view.image_paths and len(view.image_paths) < _needed(dataset)
        ]
        self._waiting_s = {key: self._waiting_s.get(key, now_s) for key in waiting}
        late = [
            key for key, since_s in self._waiting_s.items() if now_s - since_s > self.patience_s
        ]
        self._waiting_s |= dict.fromkeys(late, float("inf"))
        for camera in dataset.rig.cameras:
            if names := [view for view, lacking in late if lacking == camera]:
                self.tell(_missing(names, camera))

    def _listed(self) -> Dataset | None:
        try:
            dataset = load_dataset(self.path, "images")
        except NoViewsError:
            return None
        except InputError as error:
            if str(error) != self._said:
                self.tell(str(error))
                self._said = str(error)
            return None
        self._said = ""
        rig = (self.path / "rig.toml").read_bytes()
        if rig != self._rig:
            self._found, self._rig = {}, rig
        return dataset

    def _detected(self, dataset: Dataset, view: View, camera: str) -> ImageDots:
        try:
            found = detect_image(dataset, view, camera, overlay=True)
        except InputError as error:
            nothing = pd.DataFrame(columns=REJECTED)
            found = ImageDots(view.name, camera, NO_DOTS, nothing, 0, error.what)
        if found.failure:
            self.tell(f"view {view.name}, camera {camera} cannot be used: {found.failure}")
        return found

    def _show(self, path: Path) -> None:
        """Tell a viewer what was found in an image."""
        image = self._found[path][1]
        dots, rejected = (
            table[["u_px", "v_px"]].to_numpy(float) for table in (image.dots, image.rejected)
        )
        publish(
            "found", camera=image.camera, view=image.view, file=path, dots_px=dots,
            rejected_px=rejected,
        )  # fmt: skip

    def _views(self, dataset: Dataset) -> tuple[View, ...]:
        """Return the views with those of their images whose dots have been detected so far."""
        views = (
            View(v.name, {c: p for c, p in v.image_paths.items() if p in self._found})
            for v in dataset.views
        )
        return tuple(v for v in views if v.image_paths)

    def unfinished(self) -> list[Path]:
        """Return the images that were there at the last poll, and not completely written."""
        return sorted(self._stamps.keys() - self._found.keys())

    def images(self) -> list[ImageDots]:
        """Return the detected dots of each image, in the order of the views and cameras."""
        if self.dataset is None:
            return []
        return [self._found[p][1] for v in self.dataset.views for p in v.image_paths.values()]

    def complete(self) -> list[str]:
        """Return the names of the views in which enough cameras see the target.

        These are two cameras, or the only camera of the rig.
        """
        if self.dataset is None:
            return []
        good: dict[str, int] = {}
        for image in self.images():
            good[image.view] = good.get(image.view, 0) + (not image.failure)
        return [name for name, count in good.items() if count >= _needed(self.dataset)]

    def version(self) -> frozenset[tuple[Path, Stamp]]:
        """Return the files of the complete views with their size and time of change.

        The result changes whenever another calibration is possible.
        """
        complete = set(self.complete())
        return frozenset((p, s) for p, (s, i) in self._found.items() if i.view in complete)

    def detected(self) -> DatasetDots:
        """Return the dots of all images that have arrived, in one table.

        Raises CalibrationError when no image has arrived, DetectionError when none shows the
        target.
        """
        images = self.images()
        if self.dataset is None or not images:
            raise CalibrationError(
                "no image has arrived", where=str(self.path / "calibration"),
                todo="put images of the target into calibration/<camera>/",
            )  # fmt: skip
        return detected_together(self.dataset, images)


def _needed(dataset: Dataset) -> int:
    """Return how many cameras must see a view for it to be complete."""
    return min(2, len(dataset.rig.cameras))


def _missing(views: list[str], camera: str, most: int = 5) -> str:
    some = ", ".join(views[:most]) + (", ..." if len(views) > most else "")
    what = f"view {some} has" if len(views) == 1 else f"{len(views)} views ({some}) have"
    return (
        f"{what} no image of camera {camera}; the images of a view have the same name in every "
        f"calibration/<camera>/"
    )


def _stamp(path: Path) -> Stamp | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def watch(
    dataset: Dataset,
    *,
    stop: Stop,
    tell: Tell,
    interval_s: float = 1.0,
    until_um: float | None = None,
    **options: Any,
) -> tuple[Dataset, CalibrationRun]:
    """Calibrate whenever a new view of the target is complete, and say how to take the next one.

    This ends when one more view would gain little, when points in space are good enough, or when
    ``stop`` is set.

    tell : function that gets messages for the user.
    interval_s : time between two looks into the folder.
    until_um : standard deviation of points in space that is good enough; None for none. options :
        as for `run_calibration`.

    Returns the dataset of the images that were used, and its calibration with windows and stage.
    Raises CalibrationError or DetectionError if it is stopped before there are enough views.
    """
    check_options(**options, cameras=list(dataset.rig.cameras))
    folder = WatchedFolder(dataset.path, tell)
    known: object = None
    folder.poll(stop)
    while not stop.wait(interval_s):
        folder.poll(stop)
        version = folder.version()
        if version != known:
            known = version
            if _solved(folder, dataset, tell, until_um, options):
                break
    if stop.is_set():
        tell("stopped; calibrating with the images that have arrived")
        folder.poll()
        time.sleep(_SETTLE_S)
        folder.poll()
        for path in folder.unfinished():
            tell(f"{path} is still being written and is not used")
    detected = folder.detected()
    assert folder.dataset is not None
    run = run_calibration(folder.dataset, detected=detected, **options)
    return folder.dataset, run


def _solved(
    folder: WatchedFolder,
    dataset: Dataset,
    tell: Tell,
    until_um: float | None,
    options: dict[str, Any],
) -> bool:
    """Solve and report the state of the calibration; whether the views are enough."""
    count = len(folder.complete())
    if count < 2:
        tell(_too_few(dataset, count))
        return False
    try:
        calibration = solve_dots(folder.dataset or dataset, folder.detected().dots, **options)
    except TelerigError as error:
        tell(f"{_views(count)}: {error}")
        return False
    if due("results"):
        place = folder_for_viewer()
        calibration.save(place)
        publish("results", folder=place, dataset=dataset.path)
    words, enough = standing(calibration, dataset, count, until_um)
    tell(words)
    return enough


def _too_few(dataset: Dataset, count: int) -> str:
    missing = RECOMMENDED_VIEWS - count
    return f"{_views(count)}; {missing} more needed. Next: {_generic(dataset, count)}"


def _views(count: int) -> str:
    return f"{count} complete view{'' if count == 1 else 's'}"


def _generic(dataset: Dataset, count: int) -> str:
    """Return what to do first, before a calibration can say more."""
    names = list(dataset.rig.cameras)
    if len(names) < 2:
        return "tilt the target by 20 to 60 degrees, about another axis than before"
    rotvecs = {names[0]: (0.0, 0.0, 0.0), **dataset.rig.rotvec_from_first_deg}
    at = count % (len(names) - 1)  # each camera and the next one in turn
    first, second = names[at], names[at + 1]
    angle = 90.0
    if first in rotvecs and second in rotvecs:
        turns = [rotation_from_rotvec(np.radians(rotvecs[name])) for name in (first, second)]
        angle = float(np.degrees(np.linalg.norm(rotvec_from_rotation(turns[1] @ turns[0].T))))
    return first_views(first, second, angle, alone=len(names) == 2)[
        min(count, RECOMMENDED_VIEWS - 1)
    ]


def standing(
    calibration: Calibration, dataset: Dataset, count: int, until_um: float | None
) -> tuple[str, bool]:
    """Return one line on a calibration from the views so far, and whether the views are enough.

    count : number of complete views. until_um : as for `watch`.
    """
    advice = calibration.diagnostics.get("next_view") or {}
    status = str(calibration.verdict["status"])
    words = _views(count) + (f", {status}" if status != "GOOD" else "")
    if not advice:
        residual = calibration.statistics["rms_px"]
        return f"{words}: residual {residual:.3g} px. Next: {_generic(dataset, count)}", False
    sd = advice["before_um"]
    words += f": standard deviation of points in space {number(sd, 2)} µm"
    if count < RECOMMENDED_VIEWS:
        missing = RECOMMENDED_VIEWS - count
        return f"{words}; {missing} more views needed. Next: {_generic(dataset, count)}", False
    if status == "REJECTED":
        return f"{words}: {calibration.verdict['reasons'][0]}", False
    if until_um is not None and sd <= until_um:
        return f"{words}. This is enough: {until_um:g} µm were asked for", True
    if advice["enough"]:
        unmet = "" if until_um is None else f", though {until_um:g} µm were asked for"
        gain = f"one more view would lower it by less than {ENOUGH_SHARE:.0%}"
        return f"{words}. These views are enough: {gain}{unmet}", True
    if not advice["poses"]:
        return f"{words}. {advice['verdict']}", False
    after = number(advice["after_um"], 2)
    return f"{words}; {after} µm with one more view. Next: {advice['poses'][0]['words']}", False
