"""Choice of the calibration with which a run is tracked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import Calibration, load_calibration


def pair_of_run(calibration: Calibration, names: Sequence[str]) -> Calibration:
    """Return the calibration of the two cameras that recorded a run.

    calibration : the calibration of two or more cameras.
    names : names of the run's cameras.

    The calibration is returned unchanged if it has fewer than three cameras, or if ``names`` are
    not two of its cameras; `check_calibration` then reports the error.
    """
    known = [camera.name for camera in calibration.cameras]
    if len(known) < 3 or len(names) != 2 or not set(names) <= set(known):
        return calibration
    first, second = sorted(names, key=known.index)
    return calibration.pair(first, second)


def calibration_for(run: Path, files: Sequence[Path] | None) -> tuple[Calibration, list[Path]]:
    """Read the calibration for a run.

    run : folder of the run.
    files : None to read results/calibration/calibration.json of the run's dataset; one
        calibration.json or its folder; or the two camera files of OpenLPT (.txt), first camera
        first.

    Returns the calibration and the files that were read. Raises InputError when there is no
    calibration, or when the files do not belong together.
    """
    if not files:
        default = run.resolve().parent.parent / "results" / "calibration" / "calibration.json"
        if not default.is_file():
            raise InputError(
                "there is no calibration",
                where=str(default),
                todo="run `telerig calibrate` on the dataset, or give one with --calibration",
            )
        return load_calibration(default), [default]
    if len(files) == 1 and files[0].suffix != ".txt":
        return load_calibration(files[0]), [p for p in files if p.is_file()]
    if len(files) == 2 and all(p.suffix == ".txt" for p in files):
        from telerig.estimator.calibration.result.imported import calibration_from_cameras
        from telerig.io.exchange.importing.openlpt import read_openlpt_cameras

        cameras, *_ = read_openlpt_cameras(list(files))
        return calibration_from_cameras(cameras, name="OpenLPT"), list(files)
    raise InputError(
        f"--calibration was given {len(files)} times: {', '.join(p.name for p in files)}",
        todo="give one calibration.json, or two OpenLPT camera files (.txt)",
    )
