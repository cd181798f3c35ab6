"""telerig init: a new dataset to fill."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.errors import InputError
from telerig.scripts.console import errors_in_words, say


def init(
    dataset: Annotated[Path, typer.Argument(help="Folder to make, or to complete.")],
    cameras: Annotated[str, typer.Option(help="Names of the cameras, first first.")] = "left,right",
    size: Annotated[str, typer.Option(help="Width x height of the images in pixels.")] = "512x512",
    scale: Annotated[float, typer.Option(help="Pixels per mm in the object, roughly.")] = 10.0,
    angle: Annotated[
        float, typer.Option(help="From the first camera's axis to the second's, degrees.")
    ] = 90.0,
) -> None:
    """Make the folders of a dataset and a commented rig.toml.

    Nothing that is there is changed. Then: edit rig.toml, put the views of the target into
    calibration/<camera>/, and run `telerig doctor DATASET`.

    Exit code 0: made. 2: there is a rig.toml already, or a value cannot be.
    """
    with errors_in_words():
        from telerig.io.dataset.new_dataset import new_dataset

        first, *rest = [name.strip() for name in cameras.split(",")]
        if len(rest) != 1:
            raise InputError(f"--cameras {cameras}", todo="give two names, like left,right")
        made = new_dataset(
            dataset, cameras=(first, rest[0]), image_size_px=_size(size), scale_px_per_mm=scale,
            angle_deg=angle,
        )  # fmt: skip
        for path in made:
            say(f"made: {path}")
        say(f"now edit {made[0]}: the target, its scale, the cameras")


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.strip().isdecimal() and height.strip().isdecimal()):
        raise InputError(f"--size {text}", todo="give width x height, like 1280x800")
    return int(width), int(height)


if __name__ == "__main__":
    typer.run(init)
