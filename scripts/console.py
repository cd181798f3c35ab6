"""What all commands share: messages for errors, progress, exit codes."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import typer

from telerig.errors import TelerigError

EXIT_REJECTED = 1
EXIT_BAD_INPUT = 2
EXIT_FAULT = 3
EXIT_INTERRUPTED = 130
EXIT_CLOSED_PIPE = 141
"""The exit code of a program whose reader (`| head`) has ended: 128 + SIGPIPE."""


def run_file(command: Callable[..., None]) -> None:
    """Run a command's file as a program, with its help formatted as in `telerig`."""
    app = typer.Typer(rich_markup_mode="markdown", add_completion=False)
    app.command()(command)
    app()


def say(text: str) -> None:
    """A line for the user, on standard output."""
    typer.echo(text)


def say_written(folder: Path, report: bool) -> None:
    """Where the results are, or their report if there is one."""
    say(f"written: {folder}" + ("/report.html" if report else ""))


@contextmanager
def errors_in_words() -> Iterator[None]:
    """Turn telerig's errors, Ctrl-C and faults of telerig into a message and an exit code.

    Every command has it as a decorator.
    """
    try:
        yield
    except TelerigError as error:
        typer.echo(f"telerig: {error}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT) from error
    except typer.Exit:
        raise
    except BrokenPipeError:
        _leave_closed_pipe()
        raise typer.Exit(EXIT_CLOSED_PIPE) from None
    except Exception as error:
        if os.environ.get("TELERIG_DEBUG"):
            raise
        typer.echo(
            f"telerig: this is a fault of telerig, not of your data: {error!r:.500}\n"
            "  -> run the command again with TELERIG_DEBUG=1 and report what it prints",
            err=True,
        )
        raise typer.Exit(EXIT_FAULT) from error
    except KeyboardInterrupt:
        typer.echo("telerig: interrupted; no file is half-written", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def _leave_closed_pipe() -> None:
    """Redirect standard output to nowhere: flushing it at the end must raise no second error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, so that the work can end in an orderly way."""
    stop = threading.Event()

    def set_stop(_: int, __: FrameType | None) -> None:
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {s: signal.signal(s, set_stop) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def progress(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A callback (what, done, of): a progress bar on a terminal, plain lines elsewhere."""
    if quiet:
        yield lambda *_: None
    elif sys.stderr.isatty():
        yield from _bar()
    else:
        yield _plain_lines()


def _bar() -> Iterator[Callable[[str, int, int], None]]:
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True, auto_refresh=False) as bar:
        tasks: dict[str, Any] = {}

        def update(what: str, done: int, of: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=of or None)
            bar.update(tasks[what], completed=done, refresh=True)

        yield update


def _plain_lines() -> Callable[[str, int, int], None]:
    last = {"time": 0.0}

    def update(what: str, done: int, of: int) -> None:
        now = time.monotonic()
        if (of and done == of) or now - last["time"] > 2:
            last["time"] = now
            counted = f": {done} of {of}" if of else f": {done}" if done else ""
            typer.echo(what + counted, err=True)

    return update
