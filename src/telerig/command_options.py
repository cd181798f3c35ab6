"""The options of the commands that calibrate, track, smooth and plan, each declared once.

The command lines, with those of `run` and `batch`, the jobs of a batch, the options in `run.json`
and the command line that makes results again are made from these classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Self

from telerig.errors import InputError
from telerig.rig.lens_parameters import NAMES


@dataclass(frozen=True)
class Setting:
    """Say how an option is given and kept.

    help : its sentence on the command line.
    flags : its names there; empty for the field's name.
    key : its name in run.json; "" for the field's name.
    in_batch : its name for `run` and `batch`, where options of several kinds of jobs stand side by
        side; "" if they do not have it.
    also_there : a sentence that their help adds.
    is_input : whether the results depend on it.
    """

    help: str
    flags: tuple[str, ...]
    key: str = ""
    in_batch: str = ""
    also_there: str = ""
    is_input: bool = True


def _setting(default: Any, help: str, flag: str, *more: str, **how: Any) -> Any:
    how.setdefault("in_batch", flag)
    return field(default=default, metadata={"setting": Setting(help, (flag, *more), **how)})


class Options:
    """The options of one kind of job; every field is a `_setting`."""

    @property
    def keywords(self) -> dict[str, Any]:
        """The options as keywords of the library's function that does the job."""
        raise NotImplementedError

    @classmethod
    def settings(cls) -> dict[str, Setting]:
        """Return the setting of each field by the field's name."""
        return {f.name: f.metadata["setting"] for f in fields(cls)}  # type: ignore[arg-type]

    @classmethod
    def repeats(cls, name: str) -> bool:
        """Whether the option of a field can be given several times."""
        return isinstance(getattr(cls, name), tuple)

    def words(self) -> list[str]:
        """Return the words of a command line that gives the options that differ from defaults."""
        words = []
        for name, setting in self.settings().items():
            value, flag = getattr(self, name), setting.flags[0]
            if value == getattr(type(self), name):
                continue
            for one in value if isinstance(value, tuple) else (value,):
                words += [flag] if one is True else [f"{flag}={one}"]
        return words

    def record(self) -> dict[str, Any]:
        """Return the options on which results depend, as run.json keeps them."""
        values = {s.key or n: getattr(self, n) for n, s in self.settings().items() if s.is_input}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Self:
        """Return the options in what `record` returned; those that are missing have defaults."""
        keys = {setting.key or name: name for name, setting in cls.settings().items()}
        given = {keys[key]: value for key, value in record.items() if key in keys}
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})


ShakePriors = Literal["auto", "default"]
Kind = Literal["calibrate", "track", "smooth"]

_BOTH = "Use images or {0}; needed if the {1} has both."


@dataclass(frozen=True)
class CalibrationOptions(Options):
    """The options of `telerig calibrate`; see `telerig.calibrate`."""

    model: str = _setting(
        "auto",
        f"Lens model: auto chooses one per camera. Others: {', '.join(NAMES)}, or several joined "
        "by + (k1+k2). left=brown,right=auto gives each camera its own.",
        "--model",
        also_there="With --only smooth as in `telerig smooth`: auto or default.",
    )
    dots_free: str = _setting(
        "3d",
        "Where the dots may lie: 3d (estimated in space), plane (estimated in the plane of the "
        "target) or nominal (held at their nominal places).",
        "--dots",
        key="dots",
    )
    outlier_sd: float = _setting(
        4.5,
        "Reject dots whose residual is larger than this many standard deviations; at least 3.",
        "--outlier-sd",
    )
    medium: str = _setting(
        "air",
        "Where the target was: air or water. With [walls] in rig.toml, runs are in water.",
        "--medium",
    )
    source: Literal["images", "dots"] | None = _setting(
        None,
        _BOTH.format("dots", "dataset"),
        "--from",
        key="from",
        in_batch="",
    )

    @property
    def keywords(self) -> dict[str, Any]:
        """The options as keywords of `telerig.calibrate`'s functions, which take a dataset."""
        return {f: getattr(self, f) for f in ("model", "dots_free", "outlier_sd", "medium")}


@dataclass(frozen=True)
class TrackingOptions(Options):
    """The options of `telerig track`; see `telerig.track`."""

    min_diameter_px: float = _setting(
        8.0,
        "Dark spots with a smaller diameter, in px, are not taken for bubbles; at least 4.",
        "--min-diameter",
    )
    min_contrast: float = _setting(
        0.3,
        "Fainter shadows, as a share of the screen's brightness, are not taken for bubbles.",
        "--min-contrast",
    )
    source: Literal["images", "detections"] | None = _setting(
        None,
        _BOTH.format("detections", "run"),
        "--from",
        key="from",
        in_batch="",
    )
    frames: str | None = _setting(
        None, "Track only the first frames, for a first look: 0:500 [all].", "--frames"
    )
    cluster: str | None = _setting(
        None,
        "Detect bubbles on a Dask cluster: its scheduler's address, tcp://host:port.",
        "--cluster",
        is_input=False,
    )

    @property
    def first_frames(self) -> int | None:
        """The number of frames to track; None for all. Raises InputError for a text but 0:N."""
        if self.frames is None:
            return None
        first, colon, stop = self.frames.partition(":")
        if not colon or first not in ("", "0") or not (stop.isascii() and stop.isdecimal()):
            raise InputError(
                f"{self.frames!r} does not name the first frames of a run",
                where="--frames",
                todo="give 0:N, for example 0:500 for the first 500 frames",
            )
        return int(stop)


@dataclass(frozen=True)
class SmoothingOptions(Options):
    """The options of `telerig smooth`; see `telerig.smooth`."""

    model: ShakePriors = _setting(  # noqa: RUF009 - a field, as the others
        "auto",
        "Priors of the shake: auto learns what no sensor measures, default fixes them.",
        "--model",
        "--shake",
        in_batch="--shake",
    )
    refine_rig: bool = _setting(
        False,
        "Estimate how a camera has moved against the others since the calibration.",
        "--refine-rig",
    )
    accept: tuple[str, ...] = _setting(
        (),
        "Use a sensor although it was refused: code of the fault, which the error names. Can be "
        "given several times.",
        "--accept",
    )

    @property
    def keywords(self) -> dict[str, Any]:
        """The options as keywords of `telerig.smooth`."""
        return {field: getattr(self, field) for field in self.settings()}


@dataclass(frozen=True)
class Experiment(Options):
    """A planned run, for `telerig plan`. The rig, its stage and its sensors are those of rig.toml.

    rise_mm_s : with this velocity the stage follows the bubbles. zigzag_mm : across the vertical.
    mark_sigma_px : standard deviation of a mark's centre.
    arms : whether each camera's arm carries an accelerometer in addition to those of rig.toml.
    """

    rate_hz: float = _setting(500.0, "Frame rate in Hz.", "--rate-hz")
    seconds: float = _setting(0.5, "Duration of the run in s.", "--seconds")
    bubbles: int = _setting(1, "Number of bubbles in sight.", "--bubbles")
    diameter_mm: float = _setting(3.0, "Diameter of a bubble in mm.", "--diameter-mm")
    sigma_px: float | None = _setting(
        None, "Noise of a bubble's centre in px [from its diameter].", "--sigma-px"
    )
    rise_mm_s: float = _setting(250.0, "Rise velocity in mm/s.", "--rise-mm-s")
    zigzag_hz: float = _setting(6.0, "Frequency of the path's zigzag in Hz.", "--zigzag-hz")
    zigzag_mm: float = _setting(1.4, "RMS of the zigzag in mm.", "--zigzag-mm")
    shake_hz: float = _setting(20.0, "Frequency of the rig's shake in Hz.", "--shake-hz")
    shake_mm: float = _setting(
        0.15, "RMS of the shake in mm, vertical; each horizontal axis has half.", "--shake-mm"
    )
    marks: int = _setting(0, "Number of marks in each view that are fixed to the tank.", "--marks")
    mark_sigma_px: float = _setting(0.1, "", "")
    arms: bool = _setting(False, "", "")

    @property
    def frames(self) -> int:
        """Number of frames."""
        return round(self.rate_hz * self.seconds)


KINDS: dict[Kind, type[Options]] = {
    "calibrate": CalibrationOptions,
    "track": TrackingOptions,
    "smooth": SmoothingOptions,
}
