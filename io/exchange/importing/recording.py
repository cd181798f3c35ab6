"""Hold the channels of a sensor's file as the file has them, before they are converted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from telerig.errors import InputError

EXPORT_AGAIN = "export the recording again from the program that made it, or give another file"


@dataclass(frozen=True)
class Recording:
    """Hold the channels of a sensor's file before they are converted.

    where : the file, for errors.
    channels : raw values (samples,) by the channel's name; text if they come from a text file.
    units : units by the channel's name, for channels that state a unit apart from their name.
    rate_hz : sampling rate that the file states, or None.
    offset_s : time of the first sample.
    lines : (samples,) line of the file, from 1, in which each sample is; None for binary files.
    notes : sentences for the user.
    """

    where: str
    channels: dict[str, NDArray[Any]]
    units: dict[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    offset_s: float = 0.0
    lines: NDArray[Any] | None = None
    notes: tuple[str, ...] = ()

    def error(self, what: str, todo: str, sample: int | None = None) -> InputError:
        """Return the error that names this recording's file, and the line of a sample."""
        where = self.where
        if sample is not None and self.lines is not None:
            where += f" row {self.lines[sample]}"
        return InputError(what, where=where, todo=todo)
