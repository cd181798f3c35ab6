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
            help="Names of the one to four cameras. The first one's frame is the rig frame."
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
    from_images: Annotated[
        Path | None,
        typer.Option(
            help="Folder of images of the target, or of one such folder for each camera, from "
            "which rig.toml gets the cameras and the target."
        ),
    ] = None,
    pitch: Annotated[
        float | None,
        typer.Option(
            help="With --from-images: distance of neighbouring dots in mm, along the lines with "
            "more dots [by --scale]."
        ),
    ] = None,
) -> None:
    """Make the folders of a dataset and a commented rig.toml.

    Files that exist are not changed. Then edit rig.toml, put the views of the target into
    calibration/CAMERA/, and run `telerig doctor DATASET`. With --from-images the target's rows,
    columns, marks and polarity and the image sizes are those that the images show.

    Exit code 0: made. 2: there is a rig.toml already, or a value is impossible.
    """
    from telerig.io.dataset.new_dataset import PRACTICE_TARGET, NewCamera, new_dataset

    if from_images is not None:
        from telerig.estimator.dots.target_from_images import target_from_images

        seen = target_from_images(from_images, pitch_mm=pitch, scale_px_per_mm=scale)
        rig = [NewCamera(*camera) for camera in seen.cameras]
        made = new_dataset(dataset, rig, angle_deg=angle, target=seen.lines)
        for words in seen.words:
            say(words)
        copies = [
            f"the images of {source} to {dataset / 'calibration' / name}"
            for name, source in seen.sources.items()
            if Path(source).resolve() != (dataset / "calibration" / name).resolve()
        ]
        first = f"copy {', '.join(copies)}" if copies else ""
        if copies and len(rig) > 1:
            first += " (images of one view have the same name for all cameras)"
        missing = "the angles between the cameras" if len(rig) > 1 else "the cameras"
        if pitch is None:
            missing = f"pitch_mm, which stands for {seen.pitch_px:.1f} px, and {missing}"
    else:
        if pitch is not None:
            raise InputError(
                f"--pitch {pitch:g} is of a target in images",
                todo="add --from-images, or write pitch_mm into rig.toml",
            )
        names = options.split_names(cameras) or []
        size_px = options.size_px("--size", size, "x")
        rig = [NewCamera(name, size_px, scale) for name in names]
        made = new_dataset(dataset, rig, angle_deg=angle, target=PRACTICE_TARGET)
        first = f"put the images of the target into {dataset / 'calibration'}/CAMERA"
        missing = "the target and its size, the cameras"
    for path in made:
        say(f"made: {path}")
    say(f"next: {first}{', and ' * bool(first)}edit {made[0]} ({missing})")


if __name__ == "__main__":
    run_file(init)
