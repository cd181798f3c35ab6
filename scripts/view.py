"""telerig view: a calibration or a run in a viewer, on one time line."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from telerig.errors import InputError
from telerig.live import ADDRESS
from telerig.scripts.console import errors_in_words, run_file, say


@errors_in_words()
def view(
    folder: Annotated[
        Path,
        typer.Argument(help="Results of a calibration or a run, DATASET/results/NAME."),
    ],
    web: Annotated[
        bool,
        typer.Option("--web", help="Serve it for a browser on this computer alone, until Ctrl-C."),
    ] = False,
    save: Annotated[
        Path | None, typer.Option(help="Write an .rrd file, which `rerun FILE` opens.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="A:B shows the images of these frames [all, or every k-th].")
    ] = None,
    run: Annotated[
        Path | None, typer.Option(help="The recording, for its images [DATASET/runs/NAME].")
    ] = None,
) -> None:
    """Look at results: images with what was found, paths in space and numbers over time.

    Needs pip install 'telerig[view]'. Without --web and --save a window opens.

    Exit code 0: shown or written. 2: the input cannot be used. 130: interrupted.
    """
    from telerig.io.results.manifest import check_file
    from telerig.io.view.show import frames_of
    from telerig.io.view.show import view as show

    if web and save is not None:
        raise InputError("--web and --save are given", todo="give only one of them")
    if save is not None:
        check_file(save, "--save")
    stream = show(folder, save=save, web=web, frames=frames_of(frames), recording=run)
    if save is not None:
        say(f"written: {save} ({save.stat().st_size / 1e6:.1f} MB)")
    if web:
        say(f"open {ADDRESS} ; Ctrl-C ends it")
        while stream is not None:
            time.sleep(1.0)


if __name__ == "__main__":
    run_file(view)
