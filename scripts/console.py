"""What all commands share: messages for errors, progress, exit codes."""

from __future__ import annotations

import _thread
import contextlib
import errno
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import typer
from typer.core import TyperCommand

import telerig
from telerig import live
from telerig.errors import TelerigError, TelerigWarning
from telerig.progress import Steps, steps_shown

_PACKAGE = Path(telerig.__file__).resolve().parent

EXIT_REJECTED = 1
EXIT_BAD_INPUT = 2
EXIT_FAULT = 3
EXIT_INTERRUPTED = 130
EXIT_CLOSED_PIPE = 141
"""The exit code of a program whose reader (`| head`) has ended: 128 + SIGPIPE."""


class Command(TyperCommand):
    """A command that refuses empty arguments: an empty name of a folder would mean this one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line, as the class that it extends does."""
        for before, arg in zip(["", *args], args):
            option, equals, value = arg.partition("=")
            if not arg or (option[:2] == "--" and equals and not value):
                named = option or (before if before[:2] == "--" else "an argument")
                words = f"{named} is empty: leave it out, or write . for this folder"
                raise typer.BadParameter(words, ctx)
        return super().parse_args(ctx, args)


def run_file(command: Callable[..., None]) -> None:
    """Run a command's file as a program, with its help formatted as in `telerig`."""
    app = typer.Typer(rich_markup_mode="markdown", add_completion=False)
    app.command(cls=Command)(command)
    app()


def say(text: str) -> None:
    """Print a line for the user on standard output."""
    typer.echo(text)


def typed_command(*otherwise: object) -> str:
    """Return the command line as it was typed.

    otherwise : its words after "telerig" when another program called the command; "" without any.
    """
    program = Path(sys.argv[0])
    here = Path(__file__).resolve().parent
    module = program.name == "__main__.py" and program.resolve().parent == _PACKAGE  # python -m
    if module or program.stem == "telerig" or program.resolve().parent == here:
        return shlex.join(["telerig", *sys.argv[1:]])
    return shlex.join(["telerig", *map(str, otherwise)]) if otherwise else ""


def say_written(folder: Path, report: bool) -> None:
    """Print where the results are, or their report if there is one."""
    say(f"written: {folder}" + ("/report.html" if report else ""))


@contextmanager
def errors_in_words() -> Iterator[None]:
    """Decorate a command: errors and Ctrl-C become a message and an exit code.

    Every command is decorated with this function.
    """
    try:
        with warnings.catch_warnings():
            _say_warnings()
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
        if _interrupted.is_set():
            _leave_interrupted()
        words = _words_of_system(error)
        if words:
            typer.echo(f"telerig: {words}", err=True)
            raise typer.Exit(EXIT_BAD_INPUT) from error
        typer.echo(
            f"telerig: this is a fault of telerig, not of your data: {error!r:.500}\n"
            "  -> run the command again with TELERIG_DEBUG=1 and report what it prints",
            err=True,
        )
        raise typer.Exit(EXIT_FAULT) from error
    except KeyboardInterrupt:
        _leave_interrupted()


_interrupted = threading.Event()
"""Whether Ctrl-C was pressed. Libraries may turn the interrupt into another error."""
_AGAIN_S = 0.01


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, also where Python would only print it.

    Python prints and drops an exception that is raised while an object is deleted; the interrupt is
    then raised once more. After an interrupt the process ends with this context.
    """

    def interrupt(_: int, __: FrameType | None) -> None:
        _interrupted.set()
        raise KeyboardInterrupt

    def again(dropped: sys.UnraisableHookArgs) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            threading.Timer(_AGAIN_S, _thread.interrupt_main).start()
        else:
            sys.__unraisablehook__(dropped)

    signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook = again
    try:
        yield
    finally:
        if _interrupted.is_set():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(EXIT_INTERRUPTED)  # threads of libraries may abort at an orderly end


def _leave_interrupted() -> NoReturn:
    typer.echo("telerig: interrupted; no file is half-written", err=True)
    raise typer.Exit(EXIT_INTERRUPTED) from None


_TODO_OF_SYSTEM = {
    errno.ENOSPC: "make room on the disk, then run the command again",
    errno.EDQUOT: "make room in your quota of the disk, then run the command again",
    errno.EFBIG: "a larger file is not allowed here: choose another disk, then run again",
    errno.EROFS: "choose a folder that can be written (--out)",
    errno.EACCES: "change the permissions, or choose another folder",
    errno.EIO: "the disk reports a fault: copy the data to another disk, then run again",
    errno.ENAMETOOLONG: "give a shorter name or path",
    errno.EMFILE: "close other programs, or raise the limit of open files (`ulimit -n`)",
}
"""What a user can do about errors of the operating system, which no command can avoid."""


def _words_of_system(error: Exception) -> str:
    """Return the message for an error that the operating system caused; "" for any other error."""
    if isinstance(error, MemoryError):
        return (
            "this computer has not enough free memory for the command\n"
            "  -> close other programs, or give the command a smaller part of the data"
        )
    if not isinstance(error, OSError) or error.errno not in _TODO_OF_SYSTEM:
        return ""
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror}\n  -> {_TODO_OF_SYSTEM[error.errno]}"


def _say_warnings() -> None:
    """Print telerig's warnings as messages, each once, and leave other warnings as they are."""
    python_shows, said = warnings.showwarning, set()

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if not issubclass(category, TelerigWarning):
            python_shows(message, category, *place, **more)
        elif str(message) not in said:
            said.add(str(message))
            typer.echo(f"telerig: warning: {message}", err=True)

    warnings.simplefilter("always", TelerigWarning)
    warnings.showwarning = show


def _leave_closed_pipe() -> None:
    """Redirect standard output to nowhere: flushing it at the end must raise no second error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set, so that the work can end in an orderly way."""
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
def progress(quiet: bool) -> Iterator[Steps]:
    """Yield a `Progress` that shows a progress bar on a terminal, and plain lines elsewhere."""
    with contextlib.nullcontext(Steps(None)) if quiet else steps_shown() as steps:
        yield steps


@contextmanager
def viewed(wanted: bool, name: str) -> Iterator[None]:
    """Show the work in a viewer if that is wanted, and say where; name : of what is worked on."""
    with live.viewed(wanted, name) as address:
        if address:
            say(f"open {address}")
        yield
