"""telerig simulate: a dataset with known truth, or serial devices to practise recording with."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.io.simulation import preset_names
from telerig.scripts.console import errors_in_words, run_file, say, stopped_by_signals
from telerig.short_text import counted

if TYPE_CHECKING:
    from numpy.random import Generator

    from telerig.io.simulation.config import RunConfig, SimulationConfig


@errors_in_words()
def simulate(
    preset: Annotated[
        str | None,
        typer.Argument(
            help=f"A calibration ({', '.join(preset_names.CALIBRATIONS)}), or a run of bubbles "
            f"({', '.join(preset_names.RUNS)})."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to create; it must be new or empty.")
    ] = None,
    seed: Annotated[
        int,
        typer.Option(help="Seed of the random numbers; the same seed gives the same files.", min=0),
    ] = 0,
    images: Annotated[
        bool,
        typer.Option(help="Render images. Without them, dots.csv and detections.csv are written."),
    ] = True,
    frames: Annotated[int | None, typer.Option(help="Number of frames of the run.")] = None,
    bubbles: Annotated[
        int | None, typer.Option(help="Number of bubbles in view at a time.")
    ] = None,
    stage_axis: Annotated[
        int | None,
        typer.Option(
            help="Number of views of a target at rest, seen from different stage positions [0]."
        ),
    ] = None,
    encoder_scale: Annotated[
        float | None,
        typer.Option(help="Relative scale error of the encoder; with 0.01 it reads 1 % too much."),
    ] = None,
    references: Annotated[
        int | None,
        typer.Option(
            help="Number of dots that each camera sees of a strip that is fixed to the tank [0; in "
            "the presets S0 to S6 and forces: 4, as a table that is not drawn into the images]."
        ),
    ] = None,
    accelerometers: Annotated[
        str | None,
        typer.Option(
            help="Where accelerometers are mounted, separated by commas: a camera's name stands "
            "for its arm, 'carriage' for the carriage; or 'none' [none; in the presets S0 to S6 "
            "and forces: every arm]."
        ),
    ] = None,
    devices: Annotated[
        bool,
        typer.Option(
            "--devices",
            help="Simulate serial devices instead, to practise `telerig record` with.",
        ),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(help="With --devices: duration in seconds [until Ctrl-C].", min=0.1),
    ] = None,
) -> None:
    """Simulate a calibration, or a run of bubbles with one: images, rig.toml, and the truth.

    With --stage-axis 7, the folder stage_axis/ holds views of the target from seven positions of
    the stage, from which `telerig calibrate` estimates the travel axis and the encoder's scale.

    Exit code 0: simulated. 2: the request cannot be used. 130: interrupted.
    """
    import numpy as np

    if devices:
        if preset is not None:
            raise InputError(f"--devices and {preset} are given", todo="give only one of them")
        _simulate_devices(out, seconds, np.random.default_rng(seed))
        return
    if seconds is not None:
        raise InputError(
            f"--seconds {seconds:g} is for --devices", todo="add it, or leave both out"
        )
    if preset is None or out is None:
        missing = "the name of what to simulate" if preset is None else "--out"
        raise InputError(
            f"{missing} is missing", todo="for instance telerig simulate paper --out tank"
        )

    from telerig.io.simulation.simulate import simulate as run

    run_only = {"frames": frames, "bubbles": bubbles}
    mounts = None if accelerometers is None else _mounts(preset, accelerometers)
    stage = {"axis_views": stage_axis, "encoder_scale": encoder_scale, "accelerometers": mounts}
    settings = _with_strip(preset, _settings(preset, run_only, stage), references, images)
    data = run(settings, rng=np.random.default_rng(seed), out=out, images=images)
    views, cameras = counted(len(data.views), "view"), counted(len(data.rig.cameras), "camera")
    say(f"{preset}: {views} of {cameras} in {data.path}")
    for name in data.runs:
        say(f"run {name}: {data.runs[name].path}")
    say(f"next: telerig calibrate {data.path}")


def _settings(
    name: str, run: dict[str, int | None], stage: dict[str, Any]
) -> SimulationConfig | RunConfig:
    from telerig.io.simulation.presets import any_preset, run_preset

    changes: dict[str, Any] = {key: value for key, value in run.items() if value is not None}
    stage_changes = {key: value for key, value in stage.items() if value is not None}
    if not changes and not stage_changes:
        return any_preset(name)
    if name in preset_names.RUNS:
        if stage_changes:
            changes["stage"] = replace(run_preset(name).stage, **stage_changes)
        return run_preset(name, **changes)
    any_preset(name)
    given = [*changes, *(key.replace("axis_views", "stage_axis") for key in stage_changes)]
    raise _needs_run(name, " and ".join(given))


def _mounts(preset: str, text: str) -> tuple[str, ...]:
    """Return what carries an accelerometer. Raises InputError for an unknown name."""
    from telerig.errors import suggestion
    from telerig.io.rig_file.description import CARRIAGE
    from telerig.io.simulation.presets import run_preset

    if preset not in preset_names.RUNS or text == "none":
        return ()
    known = [*(camera.name for camera in run_preset(preset).calibration.cameras), CARRIAGE]
    mounts = tuple(name.strip() for name in text.split(","))
    for mount in mounts:
        if mount not in known or mounts.count(mount) > 1:
            raise InputError(
                f"{mount!r} cannot carry an accelerometer, or stands twice",
                where="--accelerometers",
                todo=suggestion(mount, [*known, "none"]),
            )
    return mounts


def _with_strip(
    name: str, settings: SimulationConfig | RunConfig, dots: int | None, images: bool
) -> SimulationConfig | RunConfig:
    """With a strip of dots in the images, or in `references.csv` where there are no images."""
    from telerig.io.simulation.config import RunConfig, StripConfig

    if dots is None:
        return settings
    if not isinstance(settings, RunConfig):
        raise _needs_run(name, "references")
    if dots < 0:
        raise InputError(
            f"--references {dots} is below 0", todo="give the number of dots in view, like 6"
        )
    strip = StripConfig(dots) if images and dots else None
    return replace(settings, table=replace(settings.table, references=dots), strip=strip)


def _needs_run(name: str, given: str) -> InputError:
    return InputError(
        f"{name} is a calibration without a run, so {given} have no effect",
        todo=f"leave them out, or choose one of {', '.join(preset_names.RUNS)}",
    )


def _simulate_devices(out: Path | None, seconds: float | None, rng: Generator) -> None:
    """Print the ports of simulated devices; with ``out`` also write a dataset whose rig.toml has
    them."""
    if sys.platform == "win32":
        raise InputError("Windows has no pseudo-terminals", todo="practise on Linux or macOS")
    from telerig.io.recording.simulated.devices import (
        SimulatedPorts,
        practice_devices,
        practice_rig,
    )
    from telerig.io.rig_file.rig_file import write_rig_toml
    from telerig.io.rig_file.writer import rig_toml

    if out is not None and (out / "rig.toml").exists():
        raise InputError(
            "exists already", where=str(out / "rig.toml"), todo="give a new folder with --out"
        )
    with (
        tempfile.TemporaryDirectory(prefix="telerig-") as folder,
        SimulatedPorts(practice_devices(), Path(folder), rng) as ports,
    ):
        rig = practice_rig(ports.devices)
        for device in ports.devices:
            say(f"{device.name}: {device.port}")
        if out is not None:
            write_rig_toml(rig, out / "rig.toml")
            say(f"next, in another terminal: telerig record {out}/runs/practice --seconds 20")
        else:
            say("\nfor rig.toml:\n" + "[devices" + rig_toml(rig).split("[devices", 1)[1])
        say("Ctrl-C ends the devices")
        sys.stdout.flush()
        with stopped_by_signals() as stop:
            stop.wait(seconds)


if __name__ == "__main__":
    run_file(simulate)
