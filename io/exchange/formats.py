"""List the formats of other programs, which the commands and their help read.

A new export or importer is one file in ``export`` or ``importing`` and one entry here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from telerig.errors import InputError
from telerig.io.files.names import check_name
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.io.exchange.export.run_results import RunResults
    from telerig.io.exchange.export.volume import Volume
    from telerig.rig.camera import Camera


@dataclass(frozen=True)
class Format:
    """Describe one format of an import or export; its module is imported at the first use.

    program : the program that uses the format.
    function : "module:name" of the function that reads or writes it, below ``telerig.io.exchange``.
    description : for the help text.
    suffix : ending of an exported file; "" for a folder.
    options : the options of the command that the function takes.
    extra : name of the optional dependency that it needs, as in ``pip install 'telerig[tdms]'``.
    """

    program: str
    function: str
    description: str
    suffix: str = ""
    options: tuple[str, ...] = ()
    extra: str = ""

    def load(self) -> Callable[..., Any]:
        """Import and return the function that reads or writes the format."""
        module, name = self.function.split(":")
        function: Callable[..., Any] = getattr(import_module(f"telerig.io.exchange.{module}"), name)
        return function

    def __call__(self, *arguments: Any, **offered: Any) -> Any:
        """Call the function with the arguments and with those offered options that it takes."""
        return self.load()(*arguments, **{k: offered[k] for k in self.options if k in offered})


CAMERA_EXPORTS = {
    "halcon": Format(
        "HALCON",
        "export.halcon:export_halcon",
        "HDevelop lines and .dat files",
        options=("remarks",),
    ),
    "opencv": Format(
        "OpenCV", "export.opencv:export_opencv", "3 x 4 matrices in YAML", ".yml", ("remarks",)
    ),
}
RUN_EXPORTS = {
    "hdf5": Format("HDF5", "export.tables:write_hdf5", "h5py, MATLAB", ".h5", ("cameras",)),
    "netcdf": Format("NetCDF", "export.netcdf:write_netcdf", "CF-1.8 trajectories", ".nc"),
    "mat": Format("MATLAB", "export.tables:write_mat", "MATLAB", ".mat", ("cameras",)),
    "vtk": Format("ParaView", "export.vtk:write_vtk", "ParaView, VTK"),
    "trackpy": Format("trackpy", "export.tables:write_trackpy", "CSV for trackpy", ".csv"),
}
CAMERA_IMPORTERS = {
    "openlpt": Format(
        "OpenLPT",
        "importing.openlpt:read_openlpt_cameras",
        "Import the pinhole cameras of OpenLPT (cam1.txt ...).",
        options=("names",),
    ),
    "opencv": Format(
        "OpenCV",
        "importing.opencv:read_opencv_cameras",
        "Import a stereo calibration of OpenCV (YAML, XML or JSON with M1 D1 M2 D2 R T).",
        options=("names", "image_size_px", "unit_mm"),
    ),
    "openptv": Format(
        "OpenPTV",
        "importing.openptv:read_openptv_cameras",
        "Import the cameras of OpenPTV (.ori files, with the .addpar file beside each). "
        "Give --ptv-par, or --image-size and --pixel-mm.",
        options=("names", "sensor"),
    ),
}
_BINARY = "importing.binary_recordings"
RECORDINGS = {
    ".csv": Format(
        "CSV", "importing.logger_text:read_logger_text", "readings in columns", options=("columns",)
    ),
    ".wav": Format("WAV", f"{_BINARY}:read_wav", "channels of a sound file"),
    ".mat": Format("MAT", f"{_BINARY}:read_mat", "vectors of MATLAB"),
    ".tdms": Format("TDMS", f"{_BINARY}:read_tdms", "LabVIEW", options=("group",), extra="tdms"),
}
"""Recordings of accelerometers by the ending of the file. A reader takes the path, and returns a
`Recording`."""
RECORDINGS |= dict.fromkeys((".txt", ".tsv", ".lvm", ".dat"), RECORDINGS[".csv"])


def recording_words() -> str:
    """Return the programs whose recordings can be read, with the packages that they need."""
    known = {one.program: one.extra for one in RECORDINGS.values()}
    need = "".join(
        f"; {name} needs pip install 'telerig[{extra}]'" for name, extra in known.items() if extra
    )
    return f"{', '.join(known)} file{need}"


def described(formats: dict[str, Format]) -> str:
    """Return the names of formats, each with its description, for a help text."""
    return ", ".join(f"{name} ({known.description})" for name, known in formats.items())


def export_results(
    source: Path,
    to: str,
    *,
    run: str | None = None,
    calibration: Path | None = None,
    out: Path | None = None,
    accept: Collection[str] = (),
    volume: Volume | None = None,
) -> list[str]:
    """Write cameras or a run in the format ``to``, a name in `CAMERA_EXPORTS` or `RUN_EXPORTS`.

    source : a dataset, one of its results folders, or a calibration.json.
    run : name of the run; None takes the only one with results.
    calibration : calibration.json to use in place of the cameras that the run was smoothed or
        tracked with, or of the dataset's calibration where the run's folder does not state them.
    out : file or folder to write; None writes into the folder results/export of the dataset.
    accept : ("stale",) also exports results whose inputs have changed.
    volume : as for `export_cameras`.

    Returns lines of text that say what was written and where. Raises InputError for an unknown
    format, for an option of other formats, and for results that are missing, stale or cannot be
    used.
    """
    from telerig.io.exchange.export.run_results import (
        cameras_of,
        read_results,
        results_root,
        run_folder,
    )
    from telerig.io.results.manifest import check_file

    known = CAMERA_EXPORTS | RUN_EXPORTS
    if to not in known:
        raise InputError(
            f"--to {to}: there is no such format", todo=f"use one of: {', '.join(known)}"
        )
    if out is not None and known[to].suffix:
        check_file(out)
    _refuse_options_of_others(to, run=run, calibration=calibration, volume=volume)
    results = None
    if to in RUN_EXPORTS:
        results = read_results(run_folder(source, run), accept=accept)
    cameras: Sequence[Camera] = () if results is None else results.cameras
    accepted: Sequence[str] = ()
    of_cameras = to in CAMERA_EXPORTS
    if (of_cameras or "cameras" in known[to].options) and (calibration or not cameras):
        cameras, accepted = cameras_of(source, calibration, required=of_cameras, accept=accept)
    name = to if results is None else results.name
    place = out or results_root(source) / "export" / f"{name}{known[to].suffix}"
    if results is None:
        lines = export_cameras(cameras, to, place, volume=volume, remarks=accepted)
    else:
        lines, accepted = export_run(results, to, place, cameras), results.accepted
    return [*lines, *(f"accepted: {words}" for words in accepted), f"written: {place}"]


def _refuse_options_of_others(to: str, **given: Any) -> None:
    """Raise InputError for a given option that the format ``to`` does not know.

    given : the options; those that are None were not given.
    """
    with_cameras = [name for name, known in RUN_EXPORTS.items() if "cameras" in known.options]
    shared = {
        "run": [*RUN_EXPORTS],
        "calibration": [*CAMERA_EXPORTS, *with_cameras],
        "volume": [*CAMERA_EXPORTS],
    }
    for option in (name for name, value in given.items() if value):
        if to not in shared[option]:
            raise InputError(
                f"--to {to} has no option --{option}",
                todo=f"leave it out; the formats that have it: {', '.join(shared[option])}",
            )


def export_cameras(
    cameras: Sequence[Camera],
    to: str,
    out: Path,
    *,
    volume: Volume | None = None,
    remarks: Sequence[str] = (),
) -> list[str]:
    """Write the cameras in one of the formats `CAMERA_EXPORTS`.

    volume : box in which errors are measured; None takes
    `working_volume`. remarks : sentences that are written into the file as comments.
    Returns lines of text that say what was written. Raises InputError for a volume that the cameras
    do not see.
    """
    from telerig.io.exchange.export.volume import working_volume

    for camera in cameras:
        check_name(camera.name, "cameras", "camera")
    box = volume or working_volume(cameras)
    lines = [
        f"working volume: {box.words()}",
        *CAMERA_EXPORTS[to](cameras, out, box, remarks=remarks),
    ]
    walled = ", ".join(camera.name for camera in cameras if camera.wall is not None)
    if walled and to != "halcon":
        lines.append(
            "the export is for points in the water: the refraction at the windows of "
            f"{walled} is part of the exported cameras"
        )
    return lines


def export_run(
    results: RunResults, to: str, out: Path, cameras: Sequence[Camera] = ()
) -> list[str]:
    """Write a run in one of the formats `RUN_EXPORTS`.

    cameras : calibrated cameras, which are written too if the format can hold cameras.
    Returns lines of text that say what was written. Raises InputError for data that the format
    cannot hold.
    """
    RUN_EXPORTS[to](results, out, cameras=cameras)
    bubbles = counted(results.points["particle"].nunique(), "bubble")
    return [
        f"{results.name}: {counted(len(results.points), 'row')}, {bubbles}, from {results.source}",
        f"frame: {results.frame}",
        f"verdict: {results.verdict or 'none: the run was tracked, but not smoothed'}",
    ]
