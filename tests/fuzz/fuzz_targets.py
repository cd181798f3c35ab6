"""Every file that telerig reads, with a function that reads it through public names.

Tables are taken from their declarations (`targets_of`), other files from the list.

A function returns what was read; every number in it must be finite.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

EXPORTED = "exported"
"""The folder of the corpus into which targets write."""
_MOST_FRAMES = 12
_POINTS_MM = np.random.default_rng(0).uniform(-5, 5, (7, 3))


@dataclass(frozen=True)
class Target:
    """Describe a file of the corpus and the function that reads it.

    file : its path in the corpus. kind : how `mutators.mutated` changes it.
    read : takes the file's path; the files of the corpus lie beside it.
    share : how often it is chosen, relative to the others.
    """

    file: str
    kind: str
    read: Callable[[Path], Any]
    share: float = 1.0


def _rig_toml(file: Path) -> Any:
    """What is read must also be written and read back without a change."""
    from telerig.io.rig_file.rig_file import read_rig_toml, write_rig_toml

    rig = read_rig_toml(file)
    copy = file.with_name("written.toml")
    try:
        write_rig_toml(rig, copy)
        assert repr(read_rig_toml(copy)) == repr(rig), "rig.toml is not read back as written"
    finally:
        copy.unlink(missing_ok=True)
    return [camera.scale_px_per_mm for camera in rig.cameras.values()]


def _dots(file: Path) -> Any:
    import telerig

    return telerig.load_dataset(file.parents[1]).dots()


def _corrections(file: Path) -> Any:
    from telerig.estimator.tracking.corrections import read_corrections

    read_corrections(file.parent, numbered=True)


def _truth(file: Path) -> Any:
    import telerig

    return telerig.load_dataset(file.parents[1]).truth


def _stage_axis(file: Path) -> Any:
    import telerig
    from telerig.estimator.calibration.stage_axis import stage_axis_from

    folder = file.parents[1]
    calibration = telerig.load_calibration(folder / "results" / "calibration")
    return stage_axis_from(telerig.load_dataset(folder), calibration).axis_rig


def _run(file: Path) -> Any:
    import telerig

    run = telerig.load_run(file.parent)
    sure = ["frame", "u_px", "v_px", "suu_px2", "svv_px2"]
    return [
        run.t_s,
        run.detections[sure],
        None if run.references is None else run.references[sure],
        None if run.stage is None else run.stage[["t_s", "position_mm"]],
        None if run.accelerometers is None else run.accelerometers[["t_s", "ax_m_s2"]],
    ]


def _run_toml(file: Path) -> Any:
    from telerig.io.dataset.tables import read_run_toml

    return read_run_toml(file)


def _image(file: Path) -> Any:
    from telerig.io.images.read import read_image

    return read_image(file)


def _frames(file: Path) -> Any:
    from telerig.io.images.frames import open_frames

    source = open_frames(file.parent, file.stem)
    assert source is not None
    places = range(min(len(source), _MOST_FRAMES))
    return _by_all([lambda _, place=place: source.read(place) for place in places])(file)


def _calibration(file: Path) -> Any:
    import telerig

    calibration = telerig.load_calibration(file.parent)
    first, second = calibration.cameras[0].name, calibration.cameras[-1].name
    pixels = [calibration.project(name, _POINTS_MM) for name in (first, second)]
    found = calibration.triangulate(*pixels, sigma_px=0.02)
    return [*pixels, found.points_mm, calibration.covariance]


def _cameras_to(to: str) -> Callable[[Path], Any]:
    def export(file: Path) -> Any:
        from telerig.io.exchange.formats import export_results

        export_results(file, to, out=_exported(file, to))
        return None

    return export


def _exported(file: Path, to: str) -> Path:
    """The only place where an export may write."""
    return next(p for p in file.parents if p.name == "case") / EXPORTED / to


def _calibration_folder(file: Path) -> Any:
    from telerig.io.results.folders.calibration import read_calibration_results

    found = read_calibration_results(file.parent)
    sure = found.residuals[["u_px", "v_px", "du_px", "dv_px"]]
    return [found.points_mm, found.joint[1], sure, len(found.rejected)]


def _tracks(file: Path) -> Any:
    import telerig

    tracks = telerig.load_tracks(file.parent)
    return tracks.table[["frame", "particle", "t_s", "x_mm", "y_mm", "z_mm"]]


def _track_report(file: Path) -> Any:
    from telerig.io.results.folders.tracking import read_track_results

    return read_track_results(file.parent).up


def _smoothing_report(file: Path) -> Any:
    from telerig.io.results.folders.smoothing import read_smoothing_results

    found = read_smoothing_results(file.parent, np.array([0.0, -1.0, 0.0]))
    return None if found is None else found.trajectories[["t_s", "x_mm", "vx_mm_s"]]


def _run_to(to: str) -> Callable[[Path], Any]:
    def export(file: Path) -> Any:
        from telerig.io.exchange.formats import export_results

        export_results(file.parent, to, out=_exported(file, to).with_suffix(f".{to}"))
        return None

    return export


def _batch(file: Path) -> Any:
    from telerig.io.report.batch.report import write_batch_report

    write_batch_report(file.parent, _exported(file, "batch"))


def _accelerometer(file: Path) -> Any:
    from telerig.io.exchange.importing.accelerometer import Layout, read_accelerations

    unit = {".wav": {"scale_m_s2": 20.0}, ".mat": {"unit": "g"}}.get(file.suffix, {})
    more = {"time_unit": "s"} if file.suffix == ".mat" else {}
    return read_accelerations(file, "arm", Layout(**unit, **more))


def _loggers_text(file: Path) -> Any:
    """What is read can be described for rig.toml, too."""
    import tomllib

    from telerig.io.exchange.importing.accelerometer import Layout, import_accelerations
    from telerig.io.exchange.importing.sensor_table import sensor_toml

    more: dict[str, Any] = {
        "stamps": {"columns": (0, 1, 2, 3), "time_unit": "%d.%m.%Y %H:%M:%S.%f"},
        "counter": {"columns": (0, 1, 2, 3), "rate_hz": 1000.0},
    }.get(file.stem, {"time_unit": "ms"})
    found = import_accelerations(file, "arm", Layout(unit="g", **more))
    tomllib.loads(sensor_toml("arm", found.table, ["left", "right"]))
    return found.table


def _opencv(file: Path) -> Any:
    from telerig.io.exchange.importing.opencv import read_opencv_cameras

    return _pixels(read_opencv_cameras([file]))


def _openptv(file: Path) -> Any:
    from telerig.io.exchange.importing.openptv import read_openptv_cameras, read_ptv_par

    sensor = read_ptv_par(file.with_name("ptv.par"))
    return _pixels(read_openptv_cameras([file.with_name("cam.ori")], sensor))


def _openlpt(file: Path) -> Any:
    from telerig.io.exchange.importing.openlpt import read_openlpt_cameras

    return _pixels(read_openlpt_cameras([file]))


def _pixels(imported: Any) -> Any:
    from telerig.io.exchange.importing.pinhole import nominal_toml

    nominal_toml(imported.cameras)
    return [camera.project(_POINTS_MM) for camera in imported.cameras]


def _recording(file: Path) -> Any:
    from telerig.io.recording.tables import write_tables

    return write_tables(file, _exported(file, "recording")).rows


_RUN = "set/runs/S2"
_TRACKED = "set/results/S2"
_CALIBRATED = "set/results/calibration"
_IMAGES = ("grey8.tif", "grey16.tif", "packed.tif", "tiles.tif", "big.tif", "float.tif", "grey.png",
           "grey16.png", "grey.bmp", "grey.jpg")  # fmt: skip

_TABLES: dict[str, tuple[Callable[[Path], Any], ...]] = {
    "set/calibration": (_dots,),
    "set/stage_axis": (_stage_axis,),
    _RUN: (_run, _corrections),
    _CALIBRATED: (_calibration_folder,),
    _TRACKED: (_tracks, _track_report, _smoothing_report),
    "batch": (_batch,),
}
"""What reads the tables of a folder."""


def targets_of(corpus: Path) -> dict[str, Target]:
    """Return all targets whose file is in the corpus; every declared table is one where it lies.

    Raises AssertionError where the corpus lacks a declared table.
    """
    from telerig.io.tables.declared import TABLES

    lying: dict[str, list[str]] = {}
    for folder in _TABLES:
        for file in (corpus / folder).glob("*.csv"):
            lying.setdefault(file.name, []).append(f"{folder}/{file.name}")
    names = {Path(name.split()[0]).name for table in TABLES for name in table.file.split(", ")}
    assert not names - set(lying), f"the corpus lacks {names - set(lying)}"
    tables = {
        file: Target(file, "csv", _by_all(_TABLES[str(Path(file).parent)]), 1.5)
        for file in sorted(file for name in names for file in lying[name])
    }
    return {n: t for n, t in (TARGETS | tables).items() if (corpus / t.file).is_file()}


def _by_all(readers: Sequence[Callable[[Path], Any]]) -> Callable[[Path], Any]:
    """Return a reader that tries all readers before the first error is raised."""

    def read(file: Path) -> Any:
        from telerig.errors import TelerigError

        found, errors = [], []
        for reader in readers:
            try:
                found.append(reader(file))
            except TelerigError as error:
                errors.append(error)
        for error in errors:
            raise error
        return found

    return read


TARGETS = {
    "rig": Target("set/rig.toml", "toml", _rig_toml, 3),
    "truth": Target("set/truth/truth.json", "json", _truth),
    "run.toml": Target(f"{_RUN}/run.toml", "toml", _run_toml),
    **{name: Target(f"images/{name}", "binary", _image) for name in _IMAGES},
    "pages": Target("film/pages.tif", "binary", _frames, 2),
    "stack": Target("film/stack.tif", "binary", _frames, 2),
    "avi": Target("film/raw.avi", "binary", _frames),
    "mp4": Target("film/film.mp4", "binary", _frames),
    "mkv": Target("film/wide.mkv", "binary", _frames),
    "cine": Target("film/phantom.cine", "binary", _frames, 2),
    "mraw": Target("film/photron.mraw", "binary", _frames, 0.5),
    "cihx": Target("film/photron.cihx", "binary", _frames),
    "cih": Target("film/older.cih", "binary", _frames),
    "calibration": Target(f"{_CALIBRATED}/calibration.json", "json", _calibration, 4),
    "to HALCON": Target(f"{_CALIBRATED}/calibration.json", "json", _cameras_to("halcon"), 0.5),
    "to OpenCV": Target(f"{_CALIBRATED}/calibration.json", "json", _cameras_to("opencv"), 0.5),
    "covariance": Target(f"{_CALIBRATED}/covariance.npz", "binary", _calibration, 2),
    "calibration report": Target(f"{_CALIBRATED}/calibration.json", "json", _calibration_folder),
    "comparison": Target(f"{_CALIBRATED}/comparison.json", "json", _calibration_folder),
    "tracking": Target(f"{_TRACKED}/tracking.json", "json", _track_report, 2),
    "run.json": Target(f"{_TRACKED}/run.json", "json", _track_report),
    "smoothing": Target(f"{_TRACKED}/smoothing.json", "json", _smoothing_report, 2),
    "manifest": Target("kept/manifest.json", "json", _tracks, 2),
    "manifest report": Target("kept/manifest.json", "json", _smoothing_report),
    "to HDF5": Target(f"{_TRACKED}/trajectories.csv", "csv", _run_to("hdf5"), 0.5),
    "to MATLAB": Target(f"{_TRACKED}/smoothing.json", "json", _run_to("mat"), 0.3),
    "to trackpy": Target(f"{_TRACKED}/trajectories.csv", "csv", _run_to("trackpy"), 0.5),
    "batch": Target("batch/batch.json", "json", _batch, 0.3),
    "arm.csv": Target("foreign/arm.csv", "csv", _accelerometer),
    **{
        f"logger's {name}": Target(f"foreign/{name}.txt", "csv", _loggers_text)
        for name in ("stamps", "counter", "units")
    },
    "logger's UTF-16": Target("foreign/wide.txt", "binary", _loggers_text),
    "arm73.mat": Target("foreign/arm73.mat", "binary", _accelerometer),
    "arm.wav": Target("foreign/arm.wav", "binary", _accelerometer, 2),
    "arm.mat": Target("foreign/arm.mat", "binary", _accelerometer),
    "arm.tdms": Target("foreign/arm.tdms", "binary", _accelerometer),
    "OpenCV YAML": Target("foreign/pair.yml", "text", _opencv),
    "OpenCV XML": Target("foreign/pair.xml", "text", _opencv),
    "OpenCV JSON": Target("foreign/pair.json", "json", _opencv),
    "OpenPTV": Target("foreign/cam.ori", "text", _openptv),
    "OpenPTV distortion": Target("foreign/cam.addpar", "text", _openptv),
    "OpenPTV sensor": Target("foreign/ptv.par", "text", _openptv),
    "OpenLPT": Target("foreign/cam1.txt", "text", _openlpt),
    "recording": Target("recording/recording.raw", "binary", _recording, 0.5),
}
