"""The command `telerig`."""

from __future__ import annotations

import atexit
import gc
import sys
from collections.abc import Callable
from io import TextIOWrapper

import typer

from telerig import __version__
from telerig.scripts.batch import batch
from telerig.scripts.bubbles import bubbles
from telerig.scripts.calibrate import calibrate
from telerig.scripts.console import Command, interruptible
from telerig.scripts.correct import correct
from telerig.scripts.demo import demo
from telerig.scripts.detect import detect
from telerig.scripts.doctor import doctor
from telerig.scripts.export import export
from telerig.scripts.import_files import app as import_files
from telerig.scripts.init import init
from telerig.scripts.plan import plan
from telerig.scripts.record import record
from telerig.scripts.report import report
from telerig.scripts.run import run as run_dataset
from telerig.scripts.simulate import simulate
from telerig.scripts.smooth import smooth
from telerig.scripts.track import track
from telerig.scripts.validate import validate
from telerig.scripts.view import view

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Telecentric stereo: self-calibration with a true covariance, bubbles tracked in space.",
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"telerig {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: bool = typer.Option(
        False, "--version", help="Print the version.", callback=_version, is_eager=True
    ),
) -> None:
    """Calibrate a telecentric stereo rig from views of dots, and track bubbles with it."""


_RESULTS = "Results"
_STEPS: dict[str, dict[str, Callable[..., None]]] = {
    "Before and during a recording": {
        "demo": demo, "simulate": simulate, "init": init, "plan": plan, "record": record,
        "doctor": doctor,
    },
    "Calibration": {"detect": detect, "calibrate": calibrate},
    "Runs": {
        "bubbles": bubbles, "track": track, "correct": correct, "smooth": smooth,
        "validate": validate,
    },
    "Whole datasets": {"run": run_dataset, "batch": batch},
    _RESULTS: {"report": report, "view": view, "export": export},
}  # fmt: skip
"""The commands by the steps of the work, as the help shows them."""
for step, commands in _STEPS.items():
    for name, command in commands.items():
        app.command(name, cls=Command, rich_help_panel=step)(command)
app.add_typer(import_files, name="import", rich_help_panel=_RESULTS)


_NEW_OBJECTS = 200_000
"""New objects before Python looks for garbage. With its default of 700 it looks 300 times while
libraries are loaded, and finds none."""


def run() -> None:
    """Run the command line; `telerig.scripts.start` is the entry point of the installed program."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # for a pipe without a plus-minus sign
    gc.set_threshold(_NEW_OBJECTS)
    atexit.register(gc.freeze)  # saves 0.3 s at the end: no search for garbage
    app()


if __name__ == "__main__":
    with interruptible():
        run()
