"""telerig import: cameras that another program calibrated, and recordings of accelerometers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.io.exchange.formats import CAMERA_IMPORTERS, recording_words
from telerig.scripts import options
from telerig.scripts.console import Command, errors_in_words, say, typed_command
from telerig.short_text import counted

if TYPE_CHECKING:
    import pandas as pd

    from telerig.arrays import Array

app = typer.Typer(no_args_is_help=True)

Files = Annotated[list[Path], typer.Argument(help="The files, in the order of the cameras.")]
Out = Annotated[Path, typer.Option(help="Folder for calibration.json and nominal.toml.")]
Names = Annotated[str | None, typer.Option(help="Names of the cameras, 'left,right'.")]
ImageSize = Annotated[
    str | None, typer.Option(help="'width,height' in px, if no file contains the image size.")
]
SigmaPx = Annotated[
    float, typer.Option(help="Standard deviation of measured pixels, stored with the cameras.")
]


@app.command(cls=Command, help=CAMERA_IMPORTERS["openlpt"].description)
@errors_in_words()
def openlpt(files: Files, out: Out, names: Names = None, sigma_px: SigmaPx = 0.1) -> None:
    _import_cameras("openlpt", files, out, sigma_px, names=options.split_names(names))


@app.command(cls=Command, help=CAMERA_IMPORTERS["opencv"].description)
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
    size = None if image_size is None else options.size_px("--image-size", image_size, ",")
    chosen = options.split_names(names) or ("left", "right")
    _import_cameras(
        "opencv", files, out, sigma_px, names=chosen, image_size_px=size, unit_mm=unit_mm
    )


@app.command(cls=Command, help=CAMERA_IMPORTERS["openptv"].description)
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
        todo = "give two numbers: width,height"
        wide, high = options.numbers_of("--pixel-mm", pixel_mm, 2, ",", todo)
        sensor = Sensor(options.size_px("--image-size", image_size, ","), (wide, high))
    else:
        raise InputError(
            "the sensor is not known", todo="give --ptv-par, or --image-size and --pixel-mm"
        )
    chosen = options.split_names(names)
    _import_cameras("openptv", files, out, sigma_px, names=chosen, sensor=sensor)


@app.command(
    cls=Command, help="Add the recording of an accelerometer to a run's accelerometer.csv."
)
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
    columns: Annotated[
        str | None,
        typer.Option(
            help="Columns of times, x, y and z, by name or by number from 0: Time,ch1,ch2,ch3; "
            "three without times, with --rate-hz."
        ),
    ] = None,
    time_unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of the times, s, ms, us, ns, min or h, or the form of time stamps, "
            "'%Y-%m-%d %H:%M:%S.%f'."
        ),
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option(help="Sampling rate, for a file without times.")
    ] = None,
    start_s: Annotated[
        float, typer.Option(help="Time in s that is added to bring times to the run's clock.")
    ] = 0.0,
    unit: Annotated[
        str | None,
        typer.Option(help="Unit of the readings: m/s^2, g, mg, mm/s^2, cm/s^2 or ft/s^2."),
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
    """The sensor must be in rig.toml; the refusal of another one shows the lines to add.

    What the file does not say is asked for by the name of the option that says it.
    """
    from telerig.io.dataset.run import run_folder
    from telerig.io.exchange.importing.accelerometer import import_accelerations, layout_from
    from telerig.io.exchange.importing.records import merge_accelerations

    run_folder(run)
    layout = layout_from(
        {
            "columns": columns, "time_unit": time_unit, "rate_hz": rate_hz, "start_s": start_s,
            "unit": unit, "scale_m_s2": scale, "group": group,
        }
    )  # fmt: skip
    found = import_accelerations(file, sensor, layout)
    clock = _clock_of(run, sensor, found.table)
    replaced = merge_accelerations(found.table, run / "accelerometer.csv")
    for note in found.notes:
        say(note)
    say(_record_words(sensor, found.table, _frame_times(run)))
    if replaced:
        say(f"the earlier readings of {sensor} were replaced; other sensors' readings stay")
    if clock is None:
        say(
            f"rig.toml does not state the clock of {sensor}, so its times count as those of the "
            f'frames; for a logger with a clock of its own add clock = "unknown" to '
            f"[accelerometers.{sensor}]"
        )
    say(f"written: {run / 'accelerometer.csv'}")


@app.callback(invoke_without_command=True)
@errors_in_words()
def records(
    context: typer.Context,
    listed: Annotated[
        Path | None,
        typer.Option("--list", help="DATASET/runs/NAME: list its recordings of accelerometers."),
    ] = None,
    remove: Annotated[
        str | None,
        typer.Option(help="Name of a sensor: remove its recording from the run given by --list."),
    ] = None,
) -> None:
    """Import cameras of other programs, and recordings of accelerometers; list and remove these."""
    from telerig.io.dataset.run import run_folder
    from telerig.io.exchange.importing.records import imported_records, remove_accelerations

    if listed is None:
        if remove is not None:
            raise InputError(
                f"--remove {remove}: no run is given",
                todo="give the run with --list DATASET/runs/NAME",
            )
        return
    if context.invoked_subcommand:
        raise InputError(
            f"--list and {context.invoked_subcommand} are given", todo="give only one of them"
        )
    run_folder(listed)
    file = listed / "accelerometer.csv"
    if remove is not None:
        say(f"removed: {counted(remove_accelerations(remove, file), 'reading')} of {remove}")
    found = imported_records(file)
    frames_t_s = _frame_times(listed) if found else None
    for name, table in found.items():
        say(_record_words(name, table, frames_t_s))
    if not found:
        say(f"{listed}: there are no recordings of accelerometers")


def _clock_of(run: Path, sensor: str, table: pd.DataFrame) -> str | None:
    """Return the sensor's clock in the rig.toml of the run's dataset; None where it states none.

    table : the readings. A run outside a dataset has no rig.toml, and its sensors no clock to
    state: "" is returned.
    Raises InputError, with the lines to add, for a sensor that rig.toml does not know.
    """
    from telerig.io.exchange.importing.sensor_table import sensor_toml
    from telerig.io.rig_file.rig_file import read_rig_toml

    file = run.resolve().parent.parent / "rig.toml"
    if not file.is_file():
        return ""
    rig = read_rig_toml(file)
    if sensor not in rig.accelerometers:
        known = f" (there are: {', '.join(rig.accelerometers)})" if rig.accelerometers else ""
        raise InputError(
            f"there is no accelerometer {sensor!r}{known}",
            where=str(file),
            todo="give --sensor another name, or add these lines and import again:\n"
            + sensor_toml(sensor, table, list(rig.cameras)),
        )
    return rig.accelerometers[sensor].clock


def _frame_times(run: Path) -> Array | None:
    """Return the (F,) times of the run's frames in s; None if they cannot be read yet."""
    from telerig.io.dataset.run import load_run

    try:
        return load_run(
            run, source="detections" if (run / "detections.csv").is_file() else None
        ).t_s
    except InputError:
        return None


def _record_words(sensor: str, table: pd.DataFrame, frames_t_s: Array | None) -> str:
    """Return the lines about a sensor's readings.

    table : its rows of accelerometer.csv. frames_t_s : (F,) times of the frames in s, or None.
    """
    t_s = table["t_s"].to_numpy()
    rate = f" at {(len(t_s) - 1) / (t_s[-1] - t_s[0]):.5g} Hz" if len(t_s) > 1 else ""
    mean = table[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy().mean(0)
    numbers = ", ".join(f"{value:.4g}" for value in mean)
    size = float((mean @ mean) ** 0.5)
    lines = [
        f"{sensor}: {counted(len(table), 'reading')} from {t_s[0]:.6g} to {t_s[-1]:.6g} s{rate}",
        f"  mean reading (x, y, z): {numbers} m/s^2, {size:.4g} in all (gravity at rest: 9.81)",
    ]
    if frames_t_s is not None and len(frames_t_s):
        first, last = float(frames_t_s[0]), float(frames_t_s[-1])
        outside = (t_s < first) | (t_s > last)
        if outside.any():
            times = t_s[outside]
            lines.append(
                f"  {100 * outside.mean():.3g} % of them are outside the run's time ({first:.6g} "
                f"to {last:.6g} s): the first at {times[0]:.6g} s, the last at {times[-1]:.6g} s"
            )
        if outside.all():
            lines.append(
                "  the sensor seems to have its own clock: its table in rig.toml needs clock = "
                '"unknown", or bring it to the run\'s clock with --start-s'
            )
    return "\n".join(lines)


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
    again, inputs = typed_command("import", name, *files, "--out", out), fingerprints(out, files)
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
