"""The viewer's process while a command works: reads what it publishes, and logs it.

`telerig.live` starts it as `python -m telerig.io.view.live`. Standard input brings pickled pairs
(kind, content), from which the method of `LiveView` with the kind's name is called.
"""

from __future__ import annotations

import pickle
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError, TelerigError
from telerig.io.dataset.run import RunData, RunSource, recordings
from telerig.io.images.read import list_images, read_image
from telerig.io.recording.clock import unwrap
from telerig.io.report.film.views import outlines_of
from telerig.io.report.overlays import grey_levels
from telerig.io.report.plot.axes import COLOURS, KEPT, LEFT_OUT, MUTED, rgb
from telerig.io.rig_file.description import DeviceDescription
from telerig.io.tables.run import DETECTIONS
from telerig.io.tables.smoothing import AXES
from telerig.io.view.names import (
    FRAME,
    SPACE,
    TIME,
    VIEW,
    calibration_layout,
    need_rerun,
    of_image,
    run_layout,
)
from telerig.io.view.open import open_window, serve
from telerig.io.view.run import (
    log_bodies,
    log_outlines,
    log_rays,
    log_sensors,
    log_track_series,
)
from telerig.io.view.show import load_for_view, log_results
from telerig.io.view.stream import log_image, log_series, log_spectrum
from telerig.rig.camera import Camera
from telerig.spectra import LEAST_FRAMES, Spectrum, motion_spectrum, segment, welch_density

SPECTRUM_S = 5.0
"""Spectra are those of the last seconds."""
_MEMORY = "1GB"
_POINTS = 50
"""Readings of a curve that are shown of every half second."""


def main() -> None:
    """Show what standard input brings until its end."""
    rr = need_rerun()
    begun, content = pickle.load(sys.stdin.buffer)
    assert begun == "begin"
    stream = rr.RecordingStream(f"telerig {content['name']}")
    try:
        if content["web"]:
            serve(stream)
        else:
            open_window(stream, _MEMORY)
    except InputError as error:
        sys.exit(" ".join(str(error).split()))  # `telerig.live` shows the last line
    show(stream, sys.stdin.buffer)


def show(stream: Any, messages: BinaryIO) -> None:
    """Log pickled messages into a recording of rerun, until one of kind "end" or the end."""
    view = LiveView(stream)
    while True:
        try:
            kind, content = pickle.load(messages)
        except (EOFError, pickle.UnpicklingError):
            return
        if kind == "end":
            return
        with suppress(TelerigError, OSError):  # such as an image that is being written
            getattr(view, kind)(**content)


@dataclass
class LiveView:
    """Logs each kind of message by a method of its name.

    rig : of a run. run : its recording. devices : those that are recorded, into ``folder``.
    """

    stream: Any
    rig: Sequence[Camera] = ()
    run: RunData | None = None
    devices: Mapping[str, _Line] = field(default_factory=dict)
    folder: Path = Path()
    cameras: Sequence[str] = ()
    views: list[str] = field(default_factory=list)

    def recording(self, path: Path, rig: Sequence[Camera]) -> None:
        """Show a recording's sensors; rig : its cameras."""
        source: RunSource = "images" if recordings(path) else "detections"
        self.rig, self.cameras = rig, [camera.name for camera in rig]
        sizes = {camera.name: camera.image_size_px for camera in rig}
        self.run = load_for_view(path, source, self.cameras, sizes)
        plots = ["ray_miss_um", "step_mm", "outline_chi2"]
        plots += ["encoder_mm"] if self.run is not None and self.run.stage is not None else []
        sensors = None if self.run is None else self.run.accelerometers
        plots += [] if sensors is None else ["accelerometers_m_s2"]
        self.stream.send_blueprint(run_layout(self.cameras, plots, live=FRAME))
        self.stream.log(SPACE, need_rerun().ViewCoordinates.RDF, static=True)
        if self.run is not None:
            log_sensors(self.stream, self.run, None)
        for name, rows in () if sensors is None else sensors.groupby("sensor"):
            readings = rows[[f"a{axis}_m_s2" for axis in AXES]].to_numpy(float)
            found = motion_spectrum(rows["t_s"].to_numpy(float), readings)
            if found is not None:
                log_spectrum(self.stream, str(name), found, static=True)

    def detected(self, file: Path, frame: int) -> None:
        """Show a frame's images with the bubbles found in them, from a file of detections."""
        found = outlines_of(DETECTIONS.read(file), self.cameras)
        self._frame(frame, found[found["frame"] == frame].assign(particle=np.nan))

    def linked(self, tracks: pd.DataFrame, detections: pd.DataFrame) -> None:
        """Show some frames of tracks: all points over time, and the last frame's images."""
        detections = outlines_of(detections, self.cameras)
        log_track_series(self.stream, tracks, detections)
        frame = int(tracks["frame"].max()) if len(tracks) else -1
        rows = tracks[tracks["frame"] == frame]
        if len(rows):
            self._frame(frame, detections[detections["frame"] == frame])
            log_rays(self.stream, self.rig, rows)
            log_bodies(self.stream, rows)

    def _frame(self, frame: int, detections: pd.DataFrame) -> None:
        self.stream.set_time(FRAME, sequence=frame)
        if self.run is not None and frame < self.run.frame_count:
            self.stream.set_time(TIME, duration=float(self.run.t_s[frame]))
            for camera in self.cameras if self.run.source == "images" else ():
                image = self.run.image(camera, frame)
                if image is not None:
                    log_image(self.stream, of_image(camera, "image"), image, grey_levels([image]))
        log_outlines(self.stream, self.cameras, detections)

    def shake(self, t_s: Array, shake_mm: Mapping[str, Array]) -> None:
        """Show the spectra of the cameras' shake (F, 3) after a pass of the smoothing."""
        for camera, values in shake_mm.items():
            if len(values) >= LEAST_FRAMES:
                found = Spectrum(*welch_density(t_s, 1e3 * values, segment(len(values))))
                log_spectrum(self.stream, camera, found, static=True)

    def found(self, camera: str, view: str, file: Path, dots_px: Array, rejected_px: Array) -> None:
        """Show an image of the target with the dots found in it, (N, 2) and (M, 2)."""
        rr = need_rerun()
        if camera not in self.cameras:
            self.cameras = [*self.cameras, camera]
            self.stream.send_blueprint(calibration_layout(self.cameras))
        self.views += [] if view in self.views else [view]
        self.stream.set_time(VIEW, sequence=self.views.index(view))
        image = read_image(file)
        log_image(self.stream, of_image(camera, "image"), image, grey_levels([image]))
        for name, points, colour in (("dots", dots_px, KEPT), ("rejected", rejected_px, LEFT_OUT)):
            dots = rr.Points2D(points, colors=rgb(colour), radii=rr.Radius.ui_points(2.5))
            self.stream.log(of_image(camera, name), dots)

    def results(
        self,
        folder: Path,
        dataset: Path | None = None,
        tracked: Path | None = None,
        recording: Path | None = None,
    ) -> None:
        """Show a folder of results as `telerig view` does; arguments are those of `log_results`."""
        log_results(self.stream, folder, None, recording, dataset, tracked)

    def recorder(
        self, devices: Sequence[DeviceDescription], cameras: Sequence[str], folder: Path
    ) -> None:
        """Begin to show a recording that goes into a folder, which may get images, too."""
        self.devices = {device.name: _Line(device) for device in devices}
        self.cameras, self.folder = cameras, folder
        kinds = {device.kind for device in devices}
        plots = ["encoder_mm"] if "encoder" in kinds else []
        plots += ["accelerometers_m_s2"] if "accelerometer" in kinds else []
        plots += ["clock_ms", "rate_hz"]
        self.stream.send_blueprint(run_layout(cameras, plots, space=False, live=TIME))

    def readings(self, device: str, arrived_s: Array, values: Mapping[str, Array]) -> None:
        """Show readings (N,) of a device, with the times (N,) at which they came."""
        if not len(arrived_s):
            return
        line = self.devices[device]
        line.add(arrived_s, values)
        some = slice(None, None, -(-len(arrived_s) // _POINTS))
        plot = "encoder_mm" if line.device.kind == "encoder" else "accelerometers_m_s2"
        for (axis, series), colour in zip(line.device.measured(values).items(), COLOURS):
            name = f"{device} {axis}".strip()
            self._series(plot, name, arrived_s[some], series[some], colour)
        if "t" in values:
            late = np.array([line.clock_ms(arrived_s, values["t"])])
            self._series("clock_ms", device, arrived_s[-1:], late, MUTED)
        self.stream.set_time(TIME, duration=float(arrived_s[-1]))
        spectrum = line.spectrum()
        if spectrum is not None:
            log_spectrum(self.stream, device, spectrum)

    def status(self, seconds: float, rates_hz: Mapping[str, float]) -> None:
        """Show how many readings come in a second, and the newest images in the run's folder."""
        for name, rate in rates_hz.items():
            self._series("rate_hz", name, np.array([seconds]), np.array([rate]), MUTED)
        self.stream.set_time(TIME, duration=seconds)
        for camera in self.cameras:
            if (self.folder / camera).is_dir():
                for newest in list_images(self.folder / camera)[-1:]:
                    image = read_image(newest)
                    place = of_image(camera, "image")
                    log_image(self.stream, place, image, grey_levels([image]))

    def _series(self, plot: str, name: str, t_s: Array, values: Array, colour: str) -> None:
        log_series(self.stream, plot, None, t_s, {name: values}, {name: colour})


@dataclass
class _Line:
    """The last seconds of a device's readings.

    device : as rig.toml describes it. last : times (N,) and measured numbers (N, K), in parts.
    """

    device: DeviceDescription
    last: deque[tuple[Array, Array]] = field(default_factory=deque)
    _clock: tuple[float, float] | None = None
    _first_ms: float = np.nan

    def add(self, arrived_s: Array, values: Mapping[str, Array]) -> None:
        """Keep the readings, and forget those of before the last seconds."""
        t_s = arrived_s
        if "t" in values and self.device.poll is None:
            stamped = unwrap(arrived_s, values["t"] * self.device.time_unit_s, self.device.wrap_s)
            t_s = arrived_s[-1] + stamped - stamped[-1]
        measured = self.device.measured(values)
        if measured:
            self.last.append((t_s, np.column_stack(list(measured.values()))))
        while self.last and arrived_s[-1] - self.last[0][0][-1] > SPECTRUM_S:
            self.last.popleft()

    def clock_ms(self, arrived_s: Array, stamps: Array) -> float:
        """Return how far the device's clock is behind the computer's, less that of the beginning.

        It is that of the readings that came soonest: the others waited.
        """
        before = [] if self._clock is None else [self._clock]
        host = np.array([*(b[0] for b in before), *arrived_s])
        own = np.array([*(b[1] for b in before), *(stamps * self.device.time_unit_s)])
        times = unwrap(host, own, self.device.wrap_s)
        self._clock = float(host[-1]), float(times[-1])
        late = 1e3 * float(np.min(host - times))
        self._first_ms = late if np.isnan(self._first_ms) else self._first_ms
        return late - self._first_ms

    def spectrum(self) -> Spectrum | None:
        """Return the spectrum of the motion in the last seconds, in µm²/Hz; None of too few."""
        if not self.last:
            return None
        t_s, values = (np.concatenate(parts) for parts in zip(*self.last))
        good = np.diff(t_s, prepend=-np.inf) > 0
        t_s, values = t_s[good], values[good]
        if len(t_s) < LEAST_FRAMES:
            return None
        if self.device.kind == "accelerometer":
            return motion_spectrum(t_s, values)
        return Spectrum(*welch_density(t_s, 1e3 * values, segment(len(values))))


if __name__ == "__main__":
    main()
