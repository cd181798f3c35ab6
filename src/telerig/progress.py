"""Show how far a function or a command is."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from telerig.errors import InputError

P = ParamSpec("P")
T = TypeVar("T")
Progress = Callable[[str, float, int], None]
"""Called with the name of a step, the number done and the total number. Where nothing is counted,
these are the share that is done, from 0 to 1, and 1."""


_tellers: list[Callable[[str], None]] = []


def tell(line: str) -> None:
    """Print a line beside the progress that is shown; nothing where none is."""
    for say in _tellers[-1:]:
        say(line)


class Steps:
    """Show how far a command is: call the object as a `Progress`.

    seconds : for each step, by its name, the seconds that it has taken so far.
    """

    def __init__(self, show: Callable[[str, float, int, float, float], None] | None) -> None:
        self._show = show
        self._begun: dict[str, tuple[float, float]] = {}
        self._now = ""
        self.seconds: dict[str, float] = {}

    def __call__(self, what: str, done: float, of: int) -> None:
        now = time.monotonic()
        if self._now:
            self.seconds[self._now] = now - self._begun[self._now][0]
        self._now = what
        begun_s, first = self._begun.setdefault(what, (now, done))
        self.seconds[what] = now - begun_s
        if self._show is not None:
            self._show(what, done, of, now - begun_s, done - first)

    def words(self) -> str:
        """Return the steps that took a second or longer, in words; "" for none."""
        return ", ".join(f"{what} {s:.0f} s" for what, s in self.seconds.items() if s >= 1)


def showing_progress(function: Callable[P, T]) -> Callable[P, T]:
    """Decorate a function so that its argument ``progress`` may be True, False or a function.

    True shows a progress bar or lines of text (see `steps_shown`), False shows nothing, and a
    function is called as a `Progress`. For anything else the decorated function raises InputError.
    """

    @wraps(function)
    def showing(*arguments: P.args, **named: P.kwargs) -> T:
        wanted = named.get("progress")
        if wanted is None:
            named.pop("progress", None)
        elif not (isinstance(wanted, bool) or callable(wanted)):
            what = f"progress is {type(wanted).__name__}"
            todo = "give True, False, or a function of (name of the step, number done, total)"
            raise InputError(what, where=function.__name__, todo=todo)
        if wanted is not True:
            return function(*arguments, **named)
        with steps_shown() as steps:
            named["progress"] = steps
            return function(*arguments, **named)

    return showing


@contextmanager
def steps_shown() -> Iterator[Steps]:
    """Yield `Steps` that show a progress bar in a notebook and on a terminal, else plain lines."""
    from rich.console import Console

    console = Console(stderr=True)
    _tellers.append(console.print)
    try:
        with contextlib.ExitStack() as stack:
            if console.is_jupyter or sys.stderr.isatty():
                yield Steps(stack.enter_context(_bar(console)))
            else:
                yield Steps(_plain_lines())
    finally:
        _tellers.pop()


@contextmanager
def _bar(console: Any) -> Iterator[Callable[[str, float, int, float, float], None]]:
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[words]}"))
    # no refreshing thread: worker processes are copies of this one, which must have one thread
    with Progress(*columns, console=console, transient=True, auto_refresh=False) as bar:
        tasks: dict[str, Any] = {}

        def update(what: str, done: float, of: int, seconds: float, here: float) -> None:
            words = _how_far(done, of, seconds, here)
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=of or None, words=words)
            bar.update(tasks[what], completed=done, words=words, refresh=True)

        yield update


_PLAIN_S = 2.0


def _plain_lines() -> Callable[[str, float, int, float, float], None]:
    last: dict[str, Any] = {"time": 0.0, "what": ""}

    def update(what: str, done: float, of: int, seconds: float, here: float) -> None:
        now = time.monotonic()
        if what != last["what"] or (of and done == of) or now - last["time"] > _PLAIN_S:
            last.update(time=now, what=what)
            words = _how_far(done, of, seconds, here)
            sys.stderr.write(f"{what}: {words}\n" if words else f"{what}\n")
            sys.stderr.flush()

    return update


def _how_far(done: float, of: int, seconds: float, here: float) -> str:
    """Return in words how far a step is, how fast, and how long it will take.

    here : how many of those that are done were done in these ``seconds``.
    """
    share = isinstance(done, float)
    words = [f"{100 * done:.0f} %" if share else f"{done} of {of}" if of else f"{done or ''}"]
    words = [] if share and not done else words
    if here and seconds >= 1:
        rate = here / seconds
        words += [] if share else [f"{rate:.3g} a second"]
        words.append(f"{_duration(seconds)} so far")
        if of > done:
            words.append(f"{_duration((of - done) / rate)} left")
    return ", ".join(word for word in words if word)


def _duration(seconds: float) -> str:
    whole = round(seconds)
    if whole < 120:
        return f"{whole} s"
    return f"{whole // 60} min" if whole < 7200 else f"{whole / 3600:.1f} h"
