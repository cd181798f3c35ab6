"""telerig simulate: a dataset with known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.scripts.console import errors_in_words, say

if TYPE_CHECKING:
    from telerig.io.simulation.calibration.presets import SimulationConfig
    from telerig.io.simulation.run.presets import RunConfig


def simulate(
    preset: Annotated[
        str | None,
        typer.Argument(
            help="A calibration (paper, dense, scheimpflug, near_telecentric, symmetric, "
            "unbounded, two_sided) or bubbles with a calibration (rise, swarm, crossing, S0 to S6)."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to create; must be new or empty.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 0,
    images: Annotated[
        bool, typer.Option(help="Render images; without, write dots.csv and detections.csv.")
    ] = True,
    frames: Annotated[int | None, typer.Option(help="Frames of the run.")] = None,
    bubbles: Annotated[int | None, typer.Option(help="Bubbles in view at a time.")] = None,
    stage_axis: Annotated[
        int | None,
        typer.Option(help="Views of the target at rest while the stage travels [0: none]."),
    ] = None,
    encoder_scale: Annotated[
        float | None, typer.Option(help="The encoder reads so much too far, like 0.01.")
    ] = None,
    references: Annotated[
        int | None, typer.Option(help="Dots of a strip on the tank that each camera sees [0].")
    ] = None,
    devices: Annotated[
        bool,
        typer.Option(
            "--devices", help="Serial devices to practise `telerig record` with, until Ctrl-C."
        ),
    ] = False,
    seconds: Annotated[float | None, typer.Option(help="With --devices: how long.")] = None,
) -> None:
    """Simulate a calibration, or a run of bubbles with one: images, rig.toml, and the truth.

    With --stage-axis 7, `stage_axis/` holds views of the target from seven stops of the stage, from
    which `telerig calibrate` finds the travel axis and the encoder's scale.
    """
    with errors_in_words():
        import numpy as np

        if devices:
            from telerig.scripts.simulate_devices import simulate_devices

            simulate_devices(out, seconds, np.random.default_rng(seed))
            return
        preset, out = _both(preset, out)

        from telerig.io.simulation.simulate import simulate as run

        run_only = {"frames": frames, "bubbles": bubbles}
        stage = {"axis_views": stage_axis, "encoder_scale": encoder_scale}
        settings = _with_strip(preset, _settings(preset, run_only, stage), references, images)
        data = run(settings, rng=np.random.default_rng(seed), out=out, images=images)
        say(f"{preset}: {len(data.views)} views of {len(data.rig.cameras)} cameras in {data.path}")
        for name in data.runs:
            say(f"run {name}: {data.runs[name].path}")
        say(f"next: telerig calibrate {data.path}")


def _both(preset: str | None, out: Path | None) -> tuple[str, Path]:
    if preset is None or out is None:
        what = "the name of what to simulate" if preset is None else "--out"
        raise InputError(
            f"{what} is missing", todo="for instance telerig simulate paper --out tank"
        )
    return preset, out


def _settings(
    name: str, run: dict[str, int | None], stage: dict[str, Any]
) -> SimulationConfig | RunConfig:
    from telerig.io.simulation.run.presets import RUN_PRESETS, any_preset, run_preset

    changes: dict[str, Any] = {key: value for key, value in run.items() if value is not None}
    moved = {key: value for key, value in stage.items() if value is not None}
    if not changes and not moved:
        return any_preset(name)
    if name in RUN_PRESETS:
        if moved:
            changes["stage"] = replace(run_preset(name).stage, **moved)
        return run_preset(name, **changes)
    any_preset(name)
    given = [*changes, *(key.replace("axis_views", "stage_axis") for key in moved)]
    raise InputError(
        f"{name} is a calibration without a run, so {' and '.join(given)} mean nothing",
        todo=f"leave them out, or choose one of {', '.join(RUN_PRESETS)}",
    )


def _with_strip(
    name: str, settings: SimulationConfig | RunConfig, dots: int | None, images: bool
) -> SimulationConfig | RunConfig:
    """In the images, or in `references.csv` where there are none."""
    from telerig.io.simulation.run.mark_strip_config import StripConfig
    from telerig.io.simulation.run.presets import RunConfig

    if dots is None:
        return settings
    if not isinstance(settings, RunConfig):
        raise InputError(
            f"{name} is a calibration without a run, so references mean nothing",
            todo="leave them out, or choose a run of bubbles, like rise",
        )
    if dots < 0:
        raise InputError(f"--references {dots}", todo="give the number of dots in view, like 6")
    strip = StripConfig(dots) if images and dots else None
    return replace(settings, table=replace(settings.table, references=dots), strip=strip)


if __name__ == "__main__":
    typer.run(simulate)
