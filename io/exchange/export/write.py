"""One export by its name: which file or folder it fills, and what is to be said of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from telerig.errors import InputError
from telerig.io.exchange.export.run_results import RunResults
from telerig.io.exchange.export.volume import Volume, working_volume
from telerig.io.files.atomic import atomic_folder
from telerig.rig.camera import Camera

CAMERA_FORMATS = ("halcon", "opencv", "soloff")
RUN_FORMATS = ("hdf5", "netcdf", "mat", "trackpy")
SUFFIXES = {"opencv": ".yml", "hdf5": ".h5", "netcdf": ".nc", "mat": ".mat", "trackpy": ".csv"}


def export_cameras(
    cameras: Sequence[Camera],
    to: str,
    out: Path,
    *,
    volume: Volume | None = None,
    full_cubic: bool = False,
    first_pixel: float = 0.0,
) -> list[str]:
    """Write the cameras as "halcon" (a folder), "opencv" (a file) or "soloff" (a folder).

    volume : where errors are measured and polynomials fitted; None takes `working_volume`.
    full_cubic, first_pixel : of "soloff". Returns sentences: the volume and each camera's error.
    Raises InputError for another format, a volume the cameras do not see, a place that cannot be
    written.
    """
    box = volume or working_volume(cameras)
    words = [f"working volume: {box.words()}"]
    if to == "halcon":
        from telerig.io.exchange.export.halcon import halcon_cameras
        from telerig.io.exchange.export.halcon_files import write_halcon

        found = halcon_cameras(cameras, volume=box)
        write_halcon(found, out)
        return words + [
            f"{c.camera}: {c.kind}; {'; '.join(c.notes) or 'exact'}; {c.misfit.words()}"
            for c in found
        ]
    if to == "opencv":
        from telerig.io.exchange.export.opencv import camera_matrices, write_opencv

        matrices = camera_matrices(cameras, box)
        write_opencv(matrices, out)
        return words + [
            f"{m.camera}: affine matrix, {m.affine_misfit.words()}; "
            f"matrix without the distortion, {m.undistorted_misfit.words()}"
            for m in matrices
        ]
    if to == "soloff":
        from telerig.io.exchange.export.soloff import fit_soloff, write_soloff

        fits = fit_soloff(cameras, box, full_cubic=full_cubic)
        with atomic_folder(out) as place:
            for fit in fits:
                write_soloff(fit, place / f"soloff_{fit.camera}.csv", first_pixel)
        return words + [
            f"{f.camera}: {len(f.coefficients)} terms, {f.misfit.words()}" for f in fits
        ]
    raise _unknown(to)


def export_run(
    results: RunResults, to: str, out: Path, cameras: Sequence[Camera] = ()
) -> list[str]:
    """Write a run as "hdf5", "netcdf", "mat" or "trackpy"; cameras go into HDF5 and MAT.

    Returns sentences on what was written. Raises InputError as `export_cameras`.
    """
    from telerig.io.exchange.export.netcdf import write_netcdf
    from telerig.io.exchange.export.tables import write_hdf5, write_mat, write_trackpy

    writers: dict[str, Callable[[], None]] = {
        "hdf5": lambda: write_hdf5(results, out, cameras),
        "mat": lambda: write_mat(results, out, cameras),
        "netcdf": lambda: write_netcdf(results, out),
        "trackpy": lambda: write_trackpy(results, out),
    }
    if to not in writers:
        raise _unknown(to)
    writers[to]()
    count = results.points["particle"].nunique()
    return [
        f"{results.name}: {len(results.points)} rows, {count} bubbles, from {results.source}",
        f"frame: {results.frame}",
        f"verdict: {results.verdict or 'none: tracked, not smoothed'}",
    ]


def _unknown(to: str) -> InputError:
    return InputError(
        f"cannot export to {to!r}", todo=f"known: {', '.join(CAMERA_FORMATS + RUN_FORMATS)}"
    )
