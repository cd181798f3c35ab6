"""telerig import: cameras that another program calibrated, and recordings of accelerometers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.errors import InputError
from telerig.scripts.console import errors_in_words, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from telerig.rig.camera import Camera

app = typer.Typer(
    no_args_is_help=True,
    help="Import cameras of other programs, and recordings of accelerometers.",
)

Files = Annotated[list[Path], typer.Argument(help="The files, the first camera's first.")]
Out = Annotated[Path, typer.Option(help="Folder for calibration.json and nominal.toml.")]
Names = Annotated[str | None, typer.Option(help="Names of the cameras, 'left,right'.")]
SigmaPx = Annotated[float, typer.Option(help="Pixel noise to go with the cameras.")]


@app.command()
def openlpt(files: Files, out: Out, names: Names = None, sigma_px: SigmaPx = 0.1) -> None:
    """Import OpenLPT's pinhole cameras (cam1.txt ...)."""
    with errors_in_words():
        from telerig.io.exchange.importing.openlpt import read_openlpt_cameras

        cameras, _ = read_openlpt_cameras(files, split(names))
        write_cameras(cameras, "OpenLPT", files, out, sigma_px)


@app.command()
def opencv(
    files: Files,
    out: Out,
    names: Names = None,
    image_size: Annotated[
        str | None, typer.Option(help="'width,height' in px, where no file has it.")
    ] = None,
    unit_mm: Annotated[float, typer.Option(help="Unit of T in mm: 1000 for metres.")] = 1.0,
    sigma_px: SigmaPx = 0.1,
) -> None:
    """Import a stereo calibration of OpenCV (YAML, XML or JSON: M1 D1 M2 D2 R T)."""
    with errors_in_words():
        from telerig.io.exchange.importing.opencv import read_opencv_cameras

        size = None if image_size is None else pair(image_size, "--image-size")
        cameras, _ = read_opencv_cameras(
            files,
            image_size_px=None if size is None else (int(size[0]), int(size[1])),
            unit_mm=unit_mm,
            names=split(names) or ("left", "right"),
        )
        write_cameras(cameras, "OpenCV", files, out, sigma_px)


@app.command()
def openptv(
    files: Files,
    out: Out,
    ptv_par: Annotated[Path | None, typer.Option(help="OpenPTV's ptv.par.")] = None,
    image_size: Annotated[str | None, typer.Option(help="'width,height' in px.")] = None,
    pixel_mm: Annotated[
        str | None, typer.Option(help="Size of a pixel on the sensor in mm, 'width,height'.")
    ] = None,
    names: Names = None,
    sigma_px: SigmaPx = 0.1,
) -> None:
    """Import OpenPTV's cameras (.ori, with .addpar beside them).

    Give --ptv-par, or --image-size and --pixel-mm.
    """
    with errors_in_words():
        from telerig.io.exchange.importing.openptv import Sensor, read_openptv_cameras, read_ptv_par

        if ptv_par is not None:
            sensor = read_ptv_par(ptv_par)
        elif image_size is not None and pixel_mm is not None:
            width, height = pair(image_size, "--image-size")
            sensor = Sensor((int(width), int(height)), pair(pixel_mm, "--pixel-mm"))
        else:
            raise InputError(
                "the sensor is not known", todo="give --ptv-par, or --image-size and --pixel-mm"
            )
        cameras, _, notes = read_openptv_cameras(files, sensor, split(names))
        write_cameras(cameras, "OpenPTV", files, out, sigma_px, notes)


@app.command()
def accelerometer(
    file: Annotated[Path, typer.Argument(help="CSV, WAV, TDMS or MAT.")],
    run: Annotated[Path, typer.Option(help="DATASET/runs/NAME: accelerometer.csv goes there.")],
    sensor: Annotated[str, typer.Option(help="Name of the sensor in rig.toml.")],
    channels: Annotated[
        str | None, typer.Option(help="Names or numbers (from 0) of x, y and z: 'ch1,ch2,ch3'.")
    ] = None,
    time: Annotated[str | None, typer.Option(help="Name of the channel of times in s.")] = None,
    rate_hz: Annotated[float | None, typer.Option(help="Sampling rate, instead of times.")] = None,
    start_s: Annotated[float, typer.Option(help="Added to all times: the run's clock.")] = 0.0,
    unit: Annotated[str | None, typer.Option(help="m/s2, mm/s2, g or mg.")] = None,
    scale: Annotated[
        str | None,
        typer.Option(help="m/s^2 for a reading of 1 (WAV: full scale), one number or 'x,y,z'."),
    ] = None,
    group: Annotated[str | None, typer.Option(help="Group of a TDMS file.")] = None,
) -> None:
    """Add a sensor's recording to a run's accelerometer.csv; other sensors' readings stay."""
    with errors_in_words():
        from telerig.io.exchange.importing.accelerometer import (
            layout_from,
            merge_accelerations,
            read_accelerations,
        )

        if not run.is_dir():
            raise InputError("there is no such run", where=str(run), todo="check --run")
        options = {
            "channels": channels, "time": time, "rate_hz": rate_hz, "start_s": start_s,
            "unit": unit, "scale_m_s2": scale, "group": group,
        }  # fmt: skip
        table = read_accelerations(file, sensor, layout_from(options))
        replaced = merge_accelerations(table, run / "accelerometer.csv")
        first, last = table["t_s"].iloc[0], table["t_s"].iloc[-1]
        say(f"{sensor}: {len(table)} readings from {first:.6g} to {last:.6g} s")
        means = table[["ax_m_s2", "ay_m_s2", "az_m_s2"]].mean()
        say("mean reading: " + ", ".join(f"{value:.4g}" for value in means) + " m/s^2 (x, y, z)")
        if replaced:
            say(f"replaced the earlier readings of {sensor}")
        say(f"written: {run / 'accelerometer.csv'}")


def split(names: str | None) -> list[str] | None:
    """Names between commas."""
    return None if names is None else [name.strip() for name in names.split(",")]


def pair(words: str, option: str) -> tuple[float, float]:
    """Two positive numbers between commas. Raises InputError for anything else."""
    try:
        first, second = (float(word) for word in words.split(","))
    except ValueError as error:
        raise InputError(f"{option} {words}", todo="give two numbers: width,height") from error
    return first, second


def write_cameras(
    cameras: Sequence[Camera],
    program: str,
    files: Sequence[Path],
    out: Path,
    sigma_px: float,
    notes: Sequence[str] = (),
) -> None:
    """calibration.json (held fixed) and nominal.toml (a start for a calibration of one's own)."""
    from telerig.estimator.calibration.result.imported import calibration_from_cameras
    from telerig.io.exchange.importing.nominals import nominal_toml
    from telerig.io.files.atomic import write_text_atomic

    source = f"imported from {program}: {', '.join(str(file) for file in files)}"
    calibration = calibration_from_cameras(
        cameras, name=program, sigma_px=sigma_px, notes=[source, *notes]
    )
    calibration.save(out)
    if len(cameras) <= 2:
        write_text_atomic(out / "nominal.toml", nominal_toml(cameras))
    for camera in cameras:
        kappa = camera["kappa_per_mm"]
        say(
            f"{camera.name}: {camera['scale_px_per_mm']:.5g} px/mm at a working distance of "
            f"{1 / kappa:.5g} mm"
        )
    for note in notes:
        say(note)
    say(f"written: {out / 'calibration.json'}")


if __name__ == "__main__":
    app()
