"""telerig simulate: a dataset with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.scripts.console import errors_in_words, say


def simulate(
    preset: Annotated[
        str,
        typer.Argument(
            help="paper, dense, scheimpflug, near_telecentric, symmetric, unbounded or two_sided."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder to create; must be new or empty.")],
    seed: Annotated[int, typer.Option(help="Same seed, same bytes.")] = 0,
    images: Annotated[
        bool, typer.Option(help="Render images; without, write calibration/dots.csv.")
    ] = True,
) -> None:
    """Simulate a calibration: target images of both cameras, rig.toml, and the truth."""
    with errors_in_words():
        import numpy as np

        from telerig.io.simulation import simulate as run

        data = run(preset, rng=np.random.default_rng(seed), out=out, images=images)
        say(f"{preset}: {len(data.views)} views of {len(data.rig.cameras)} cameras in {data.path}")
        say(f"next: telerig calibrate {data.path}")


if __name__ == "__main__":
    typer.run(simulate)
