"""Log a results folder into a recording of rerun: to a window, a browser, a file, a notebook."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from telerig.errors import InputError, TelerigWarning
from telerig.io.dataset.dataset import load_dataset
from telerig.io.dataset.run import RunData, RunSource, load_run, recordings
from telerig.io.files.atomic import atomic_path
from telerig.io.report.film.views import found_outlines
from telerig.io.results.folders.calibration import read_calibration_results
from telerig.io.results.folders.smoothing import read_smoothing_results
from telerig.io.results.folders.tracking import TrackResults, read_track_results
from telerig.io.view.calibration import log_calibration
from telerig.io.view.names import calibration_layout, need_rerun, run_layout
from telerig.io.view.open import open_window, serve
from telerig.io.view.run import log_run, log_sensors

MOST_IMAGES = 4_000
"""Of a longer run every k-th frame is shown, so that a recording stays small (some 20 kB an image,
100 MB)."""


def view(
    folder: str | Path,
    *,
    save: str | Path | None = None,
    web: bool = False,
    frames: tuple[int, int] | None = None,
    recording: Path | None = None,
) -> Any:
    """Show the results of a calibration or a run in the viewer of rerun; return its recording.

    Both views' images with outlines, ids and the rays of the other view, paths and bodies in space,
    shake, height, speed, ray miss, encoder and accelerometers over time, on one time line; of a
    calibration every view's dots and residuals, and the rig with all poses. In a notebook the last
    line of a cell shows it.

    folder : results of `telerig calibrate`, `track` or `smooth`.
    save : an .rrd file to write instead of opening a window.
    web : serve it for a browser instead, while the returned recording exists. Window and server
        listen on 127.0.0.1 alone.
    frames : (first, end) whose images are shown; None for all, of a run with more than 4,000 images
        every k-th.
    recording : the run's folder; None looks in the dataset, and shows no images where there is
        none.

    Raises InputError for a folder that holds no such results, without rerun, and if the viewer
    cannot be started.
    """
    rr = need_rerun()
    place = Path(folder)
    stream = rr.RecordingStream(f"telerig {place.resolve().name}")
    if save is not None:
        with atomic_path(Path(save)) as temporary:
            stream.save(str(temporary))
            log_results(stream, place, frames, recording)
            stream.flush()
            stream.disconnect()
        return stream
    in_notebook = _in_notebook()
    if web:
        serve(stream)
    elif not in_notebook:
        open_window(stream)
    log_results(stream, place, frames, recording)
    if in_notebook and not web:
        stream.notebook_show()
    return stream


def _in_notebook() -> bool:
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


def log_results(
    stream: Any,
    place: Path,
    frames: tuple[int, int] | None = None,
    recording: Path | None = None,
    dataset: Path | None = None,
    tracked: Path | None = None,
) -> None:
    """Log a folder of results and the layout of the window.

    frames, recording : as for `view`. dataset : of a calibration; None for the one it lies in.
    tracked : the results folder of a smoothed run's tracks; None for the same.
    """
    if (place / "calibration.json").is_file():
        results = read_calibration_results(place)
        stream.send_blueprint(calibration_layout(results.camera_names))
        images = _views_of(dataset or place.resolve().parent.parent)
        log_calibration(stream, results, images)
        return
    found_in = tracked or place
    if not (found_in / "tracking.json").is_file():
        raise InputError(
            "holds neither a calibration nor a tracked run", where=str(place),
            todo="give a folder like DATASET/results/calibration or DATASET/results/NAME",
        )  # fmt: skip
    tracks = read_track_results(found_in)
    smoothing = read_smoothing_results(place, tracks.up)
    data = _recording_of(place, recording, tracks)
    image, count = _frames_of(data, tracks)
    every = range(count)[slice(*frames)] if frames else range(count)
    if not every:
        raise InputError(
            f"has no frame from {frames[0]} on" if frames else "has no frames", where=str(place),
            todo=f"the run has frames 0 to {count - 1}" if count else "track the run again",
        )  # fmt: skip
    shown = every[:: -(-len(every) * len(tracks.cameras) // MOST_IMAGES) or 1]
    smoothed = ("height_less_line_mm", "shake_um", "speed_mm_s", "encoder_residual_um")
    plots = ["ray_miss_um", "step_mm", *(() if smoothing is None else smoothed)]
    found = found_outlines(tracks, tracks.cameras)
    if "chi2_dof" in found and found["chi2_dof"].notna().any():
        plots.insert(2, "outline_chi2")
    if data is not None and data.accelerometers is not None:
        plots.append("accelerometers_m_s2")
    stream.send_blueprint(run_layout(tracks.cameras, plots, spectra=smoothing is not None))
    log_run(stream, tracks, smoothing, tracks.rig, found, image, list(shown))
    if data is not None:
        log_sensors(stream, data, smoothing)


def _views_of(dataset: Path) -> Callable[[str, str], NDArray[Any] | None]:
    """Return the function that reads a view's image from the dataset of a calibration."""
    try:
        data = load_dataset(dataset, source="images")
    except InputError:
        return lambda _camera, _view: None
    views = {view.name: view for view in data.views}

    def image(camera: str, view: str) -> NDArray[Any] | None:
        if view not in views:
            return None
        try:
            return data.image(views[view], camera)
        except InputError:
            return None

    return image


def _recording_of(place: Path, recording: Path | None, tracks: TrackResults) -> RunData | None:
    """Return the recording of a results folder; None where it is not there."""
    folder = place.resolve()
    run = recording or folder.parent.parent / "runs" / folder.name
    if not (run.is_dir() and (recordings(run) or (run / "detections.csv").is_file())):
        return None
    source: RunSource = "images" if recordings(run) else "detections"
    return load_for_view(run, source, tracks.cameras, tracks.image_sizes_px)


def load_for_view(
    run: Path, source: RunSource, cameras: Sequence[str], sizes: Mapping[str, tuple[int, int]]
) -> RunData | None:
    """Return a recording without what cannot be read, which warnings name; None if nothing can.

    source, cameras, sizes : as for `load_run`.
    """
    try:
        data = load_run(
            run, source=source, cameras=cameras, image_sizes_px=sizes, skip_unreadable=True
        )
    except InputError as error:
        warnings.warn(f"the recording is not shown: {error}", TelerigWarning, stacklevel=2)
        return None
    tables = {"stage.csv": data.stage, "accelerometer.csv": data.accelerometers}
    if any(table is None and (run / name).is_file() for name, table in tables.items()):
        warnings.warn("; ".join(data.notes), TelerigWarning, stacklevel=2)
    return data


def _frames_of(
    data: RunData | None, tracks: TrackResults
) -> tuple[Callable[[str, int], NDArray[Any] | None], int]:
    """Return the function that reads a run's images, and the number of its frames."""
    last = int(tracks.tracks["frame"].to_numpy().max(initial=-1)) + 1
    count = tracks.file.frames or last
    if data is None or data.source != "images":
        return (lambda _camera, _frame: None), count
    return data.image, min(count, data.frame_count)


def frames_of(text: str | None) -> tuple[int, int] | None:
    """Return first frame and end of a text like "100:200". Raises InputError for another one."""
    if text is None:
        return None
    first, colon, end = text.partition(":")
    if not (colon and first.isdecimal() and end.isdecimal() and int(first) < int(end)):
        raise InputError(
            f"--frames {text} names no frames", todo="give A:B with A below B, like 100:200"
        )
    return int(first), int(end)
