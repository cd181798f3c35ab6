"""telerig import: cameras that another program calibrated, and recordings of accelerometers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from telerig.errors import InputError
from telerig.io.exchange.formats import CAMERA_IMPORTERS, recording_words
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, say, typed_command

app = typer.Typer(
    no_args_is_help=True,
    help="Import cameras of other programs, and recordings of accelerometers.",
)

Files = Annotated[list[Path], typer.Argument(help="The files, in the order of the cameras.")]
Out = Annotated[Path, typer.Option(help="Folder for calibration.json and nominal.toml.")]
Names = Annotated[str | None, typer.Option(help="Names of the cameras, 'left,right'.")]
ImageSize = Annotated[
    str | None, typer.Option(help="'width,height' in px, if no file contains the image size.")
]
SigmaPx = Annotated[
    float, typer.Option(help="Standard deviation of measured pixels, stored with the cameras.")
]


@app.command(help=CAMERA_IMPORTERS["openlpt"].description)
@errors_in_words()
def openlpt(files: Files, out: Out, names: Names = None, sigma_px: SigmaPx = 0.1) -> None:
    _import_cameras("openlpt", files, out, sigma_px, names=options.split_names(names))


@app.command(help=CAMERA_IMPORTERS["opencv"].description)
@errors_in_words()
def opencv(
    files: Files,
    out: Out,
    names: Names = None,
    image_size: ImageSize = None,
    unit_mm: Annotated[
        float, typer.Option(help="Length of the unit of T in mm: 1000 if T is in metres.")
    ] = 1.0,
    sigma_px: SigmaPx = 0.1,
) -> None:
    size = None if image_size is None else _size_px(image_size)
    chosen = options.split_names(names) or ("left", "right")
    _import_cameras(
        "opencv", files, out, sigma_px, names=chosen, image_size_px=size, unit_mm=unit_mm
    )


@app.command(help=CAMERA_IMPORTERS["openptv"].description)
@errors_in_words()
def openptv(
    files: Files,
    out: Out,
    ptv_par: Annotated[Path | None, typer.Option(help="The ptv.par of OpenPTV.")] = None,
    image_size: ImageSize = None,
    pixel_mm: Annotated[
        str | None, typer.Option(help="Size of a pixel on the sensor in mm, 'width,height'.")
    ] = None,
    names: Names = None,
    sigma_px: SigmaPx = 0.1,
) -> None:
    from telerig.io.exchange.importing.openptv import Sensor, read_ptv_par

    if ptv_par is not None:
        sensor = read_ptv_par(ptv_par)
    elif image_size is not None and pixel_mm is not None:
        sensor = Sensor(_size_px(image_size), _pair("--pixel-mm", pixel_mm))
    else:
        raise InputError(
            "the sensor is not known", todo="give --ptv-par, or --image-size and --pixel-mm"
        )
    chosen = options.split_names(names)
    _import_cameras("openptv", files, out, sigma_px, names=chosen, sensor=sensor)


@app.command(help="Add the recording of an accelerometer to a run's accelerometer.csv.")
@errors_in_words()
def accelerometer(
    file: Annotated[
        Path,
        typer.Argument(help=f"{recording_words()}."),
    ],
    run: Annotated[
        Path, typer.Option(help="DATASET/runs/NAME, whose accelerometer.csv is written.")
    ],
    sensor: Annotated[str, typer.Option(help="Name of the sensor in rig.toml.")],
    channels: Annotated[
        str | None, typer.Option(help="Names or numbers (from 0) of x, y and z: 'ch1,ch2,ch3'.")
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="Name of the channel that holds the times in s.")
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option(help="Sampling rate, for a file without times.")
    ] = None,
    start_s: Annotated[
        float, typer.Option(help="Added to all times, to bring them to the run's clock.")
    ] = 0.0,
    unit: Annotated[
        str | None, typer.Option(help="Unit of the readings: m/s2, mm/s2, g or mg.")
    ] = None,
    scale: Annotated[
        str | None,
        typer.Option(
            help="Acceleration in m/s^2 for a reading of 1 (WAV: for full scale), one number or "
            "'x,y,z'."
        ),
    ] = None,
    group: Annotated[str | None, typer.Option(help="Group of a TDMS file.")] = None,
) -> None:
    from telerig.io.exchange.importing.accelerometer import (
        layout_from,
        merge_accelerations,
        read_accelerations,
    )

    if not run.is_dir():
        raise InputError("there is no such run", where=str(run), todo="check --run")
    layout = layout_from(
        {
            "channels": channels, "time": time, "rate_hz": rate_hz, "start_s": start_s,
            "unit": unit, "scale_m_s2": scale, "group": group,
        }
    )  # fmt: skip
    table = read_accelerations(file, sensor, layout)
    replaced = merge_accelerations(table, run / "accelerometer.csv")
    first, last = table["t_s"].iloc[0], table["t_s"].iloc[-1]
    say(f"{sensor}: {len(table)} readings from {first:.6g} to {last:.6g} s")
    means = table[["ax_m_s2", "ay_m_s2", "az_m_s2"]].mean()
    say("mean reading (x, y, z): " + ", ".join(f"{value:.4g}" for value in means) + " m/s^2")
    if replaced:
        say(f"the earlier readings of {sensor} were replaced; other sensors' readings stay")
    say(f"written: {run / 'accelerometer.csv'}")


def _pair(option: str, text: str) -> tuple[float, float]:
    width, height = options.numbers_of(option, text, 2, ",", "give two numbers: width,height")
    return width, height


def _size_px(text: str) -> tuple[int, int]:
    width, height = _pair("--image-size", text)
    return int(width), int(height)


def _import_cameras(
    name: str, files: list[Path], out: Path, sigma_px: float, **offered: Any
) -> None:
    """Write calibration.json (cameras held fixed) and nominal.toml (a start for a calibration)."""
    from telerig.estimator.calibration.result.calibration import calibration_from_cameras
    from telerig.io.exchange.importing.pinhole import nominal_toml
    from telerig.io.files.atomic import write_text_atomic
    from telerig.io.results.inputs import fingerprints
    from telerig.io.results.manifest import replaced_results
    from telerig.io.rig_file.description import MOST_CAMERAS

    importer = CAMERA_IMPORTERS[name]
    cameras, _, notes = importer(files, **offered)
    source = f"imported from {importer.program}: {', '.join(str(file) for file in files)}"
    calibration = calibration_from_cameras(
        cameras, name=importer.program, sigma_px=sigma_px, notes=[source, *notes]
    )
    again, inputs = typed_command() or f"telerig import {name}", fingerprints(out, files)
    with replaced_results(out, "calibrate", again=again, inputs=inputs) as staged:
        calibration.write_files(staged)
        if len(cameras) <= MOST_CAMERAS:
            write_text_atomic(staged / "nominal.toml", nominal_toml(cameras))
    for camera in cameras:
        say(
            f"{camera.name}: {camera['scale_px_per_mm']:.5g} px/mm at a working distance of "
            f"{1 / camera['kappa_per_mm']:.5g} mm"
        )
    for line in [*notes, f"written: {out / 'calibration.json'}"]:
        say(line)


if __name__ == "__main__":
    app()
