"""telerig bubbles: find the bubbles of single images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.command_options import TrackingOptions
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, progress, run_file, say, typed_command


@errors_in_words()
def bubbles(
    images: Annotated[
        list[Path], typer.Argument(help="Backlit grey images, or folders of such images.")
    ],
    out: Annotated[Path, typer.Option(help="Results folder.", file_okay=False)] = Path("bubbles"),
    min_diameter: options.MinDiameter = TrackingOptions.min_diameter_px,
    min_contrast: options.MinContrast = TrackingOptions.min_contrast,
    region: Annotated[
        str,
        typer.Option(
            help="Look within a polygon: its corners in px, as 100,50 900,50 900,700. Without it "
            "and without a mask, a dark surround of the screen is found and left out."
        ),
    ] = "",
    mask: Annotated[Path | None, typer.Option(help="Look where this image is not black.")] = None,
    quiet: options.Quiet = False,
) -> None:
    """Find the bubbles of single images, without a run and without a calibration.

    Writes detections.csv (outline, covariance and flags of every bubble), clusters.csv (outlines
    of dark regions that could not be divided into bubbles) and overlays/IMAGE.jpg.

    Exit code 0: done. 2: the input cannot be used. 130: interrupted.
    """
    from telerig.errors import InputError
    from telerig.estimator.bubbles.single_images import write_bubbles
    from telerig.io.images.read import list_images
    from telerig.io.results.inputs import fingerprints
    from telerig.io.results.manifest import replaced_results

    files = [f for path in images for f in (list_images(path) if path.is_dir() else [path])]
    if not files:
        raise InputError("holds no image", where=str(images[0]), todo="give images or a folder")
    corners = _corners(region)
    again = typed_command("bubbles", *images, "--out", out)
    with progress(quiet) as stage:
        inputs = fingerprints(out, files if mask is None else [*files, mask])
        with replaced_results(out, "bubbles", again=again, inputs=inputs) as staged:
            words = write_bubbles(
                files, staged, min_diameter_px=min_diameter, min_contrast=min_contrast,
                region_px=corners, mask=mask,
                progress=lambda done, total: stage("images", done, total),
            )  # fmt: skip
    for line in words:
        say(line)
    say(f"written: {out}/detections.csv, clusters.csv, overlays/")


def _corners(region: str) -> list[list[float]] | None:
    """Read "100,50 900,50 900,700"."""
    from telerig.errors import InputError

    if not region.strip():
        return None
    try:
        return [[float(x) for x in corner.split(",")] for corner in region.split()]
    except ValueError as error:
        raise InputError(
            f"cannot be read: {region!r}", where="--region", todo="give it as 100,50 900,50 900,700"
        ) from error


if __name__ == "__main__":
    run_file(bubbles)
