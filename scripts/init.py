"""telerig init: a new dataset to fill."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.errors import InputError
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, run_file, say


@errors_in_words()
def init(
    dataset: Annotated[Path, typer.Argument(help="Folder to make, or to complete.")],
    cameras: Annotated[
        str,
        typer.Option(
            help="Names of the two to four cameras. The first one's frame is the rig frame."
        ),
    ] = "left,right",
    size: Annotated[str, typer.Option(help="Width x height of the images in pixels.")] = "512x512",
    scale: Annotated[
        float, typer.Option(help="Approximate scale, in pixels per mm in the object.")
    ] = 10.0,
    angle: Annotated[
        float,
        typer.Option(help="Angle from each camera's optical axis to the next one's, in degrees."),
    ] = 90.0,
) -> None:
    """Make the folders of a dataset and a commented rig.toml.

    Files that exist are not changed. Then edit rig.toml, put the views of the target into
    calibration/CAMERA/, and run `telerig doctor DATASET`.

    Exit code 0: made. 2: there is a rig.toml already, or a value is impossible.
    """
    from telerig.io.dataset.new_dataset import new_dataset
    from telerig.io.rig_file.description import MOST_CAMERAS

    names = options.split_names(cameras) or []
    if not 2 <= len(names) <= MOST_CAMERAS:
        todo = f"give two to {MOST_CAMERAS} names, like left,right"
        raise InputError(f"--cameras {cameras}", todo=todo)
    todo = "give width x height, like 1280x800"
    width, height = options.numbers_of("--size", size, 2, "x", todo)
    if not (width.is_integer() and height.is_integer()):
        raise InputError(f"--size {size}", todo=todo)
    made = new_dataset(
        dataset, cameras=names, image_size_px=(int(width), int(height)),
        scale_px_per_mm=scale, angle_deg=angle,
    )  # fmt: skip
    for path in made:
        say(f"made: {path}")
    say(f"next: edit {made[0]} (the target and its size, the cameras)")


if __name__ == "__main__":
    run_file(init)
