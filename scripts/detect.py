"""telerig detect: find and number the dots of the calibration images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.scripts.console import errors_in_words, progress, say


def detect(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder with rig.toml and calibration/.")],
    out: Annotated[
        Path | None, typer.Option(help="Results folder [DATASET/results/calibration].")
    ] = None,
    quiet: Annotated[bool, typer.Option(help="No progress.")] = False,
) -> None:
    """Find and number the target's dots in every calibration image.

    Writes dots.csv (every numbered dot with its covariance and chi-square), rejected.csv (every
    dot-like thing that was left out, with the reason) and overlays/<camera>/<view>.jpg.
    """
    with errors_in_words():
        from telerig.estimator.calibration.results_folder import write_detections
        from telerig.estimator.dots.dataset_dots import detect_dataset
        from telerig.io.dataset.dataset import load_dataset
        from telerig.io.dataset.tables import write_table
        from telerig.io.files.atomic import atomic_folder

        data = load_dataset(dataset, source="images")
        with progress(quiet) as stage:
            found = detect_dataset(data, progress=lambda i, n: stage("images", i, n), overlays=True)
        folder = out or data.results / "calibration"
        with atomic_folder(folder) as staged:
            write_table(found.dots, staged / "dots.csv")
            write_detections(found, staged)
        for image in found.images:
            words = image.failure or f"{len(image.dots)} dots, {len(image.rejected)} rejected"
            say(f"view {image.view}, camera {image.camera}: {words}")
        say(f"written: {folder}/dots.csv, rejected.csv, overlays/")


if __name__ == "__main__":
    typer.run(detect)
