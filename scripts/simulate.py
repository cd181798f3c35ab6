"""telerig simulate: a dataset with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.errors import InputError
from telerig.scripts.console import errors_in_words, say

if TYPE_CHECKING:
    from telerig.io.run_presets import RunConfig
    from telerig.io.simulation_presets import SimulationConfig


def simulate(
    preset: Annotated[
        str,
        typer.Argument(
            help="A calibration (paper, dense, scheimpflug, near_telecentric, symmetric, "
            "unbounded, two_sided) or bubbles with a calibration (rise, swarm, crossing, S0 to S6)."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder to create; must be new or empty.")],
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 0,
    images: Annotated[
        bool, typer.Option(help="Render images; without, write dots.csv and detections.csv.")
    ] = True,
    frames: Annotated[int | None, typer.Option(help="Frames of the run.")] = None,
    bubbles: Annotated[int | None, typer.Option(help="Bubbles in view at a time.")] = None,
) -> None:
    """Simulate a calibration, or a run of bubbles with one: images, rig.toml, and the truth."""
    with errors_in_words():
        import numpy as np

        from telerig.io.simulation import simulate as run

        settings = _settings(preset, frames, bubbles)
        data = run(settings, rng=np.random.default_rng(seed), out=out, images=images)
        say(f"{preset}: {len(data.views)} views of {len(data.rig.cameras)} cameras in {data.path}")
        for name in data.runs:
            say(f"run {name}: {data.runs[name].path}")
        say(f"next: telerig calibrate {data.path}")


def _settings(name: str, frames: int | None, bubbles: int | None) -> SimulationConfig | RunConfig:
    from telerig.io.run_presets import RUN_PRESETS, any_preset, run_preset

    given = {"frames": frames, "bubbles": bubbles}
    changes = {key: value for key, value in given.items() if value is not None}
    if not changes:
        return any_preset(name)
    if name in RUN_PRESETS:
        return run_preset(name, **changes)
    any_preset(name)
    raise InputError(
        f"{name} is a calibration without a run, so {' and '.join(changes)} mean nothing",
        todo=f"leave them out, or choose one of {', '.join(RUN_PRESETS)}",
    )


if __name__ == "__main__":
    typer.run(simulate)
