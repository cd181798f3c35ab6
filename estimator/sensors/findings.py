"""What the checks of the sensors find, and what becomes of it: a warning, a refusal, acceptance.

A check returns findings. `settled` raises the first refusal that the user has not accepted, and
returns the rest as warnings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from telerig.errors import InputError, suggestion
from telerig.short_text import counted_list


class Code(StrEnum):
    """Name every fault that is refused, and that a user can accept by its name."""

    SENSOR_UNIT = "SENSOR_UNIT"
    SENSOR_GRAVITY = "SENSOR_GRAVITY"
    SENSOR_AXES = "SENSOR_AXES"
    SENSOR_MOUNT = "SENSOR_MOUNT"
    SENSOR_SCALE = "SENSOR_SCALE"
    SENSOR_CLOCK = "SENSOR_CLOCK"
    ENCODER_SIGN = "ENCODER_SIGN"
    ENCODER_UNIT = "ENCODER_UNIT"
    ENCODER_STUCK = "ENCODER_STUCK"
    ENCODER_SCALE = "ENCODER_SCALE"
    ENCODER_JUMP = "ENCODER_JUMP"
    ENCODER_CLOCK = "ENCODER_CLOCK"
    STAGE_AXIS = "STAGE_AXIS"
    CAMERA_SCALE = "CAMERA_SCALE"
    FRAME_TIMES = "FRAME_TIMES"
    RISE_SPEED = "RISE_SPEED"


@dataclass(frozen=True)
class Finding:
    """What a check found.

    words : the fault, as a sentence without its place.
    where : file, sensor or row.
    todo : what the user can do.
    code : name of a fault that is refused unless the user accepts it; None for a warning.
    fix : the correction as data, or {}. For an accelerometer it is {"sensor": name} with one of
        "unit": "g"; "axes": rows; "add_m_s2": [x, y, z]; "offset_s": s, which is added to its
        times. {"exchange": [name, name]} exchanges two records. For the encoder it is
        {"encoder_factor": -1.0}, {"encoder_offset_s": s}, or {"encoder_jumps": [[t_s, mm], ...]},
        lengths that are subtracted from t_s on. For the stage it is {"stage_axis": [x, y, z]}, for
        the frames {"frame_time_factor": 0.001}.
    is_fault : False for what was assumed because it is not stated.
    """

    words: str
    where: str = ""
    todo: str = ""
    code: Code | None = None
    fix: Mapping[str, Any] = field(default_factory=dict)
    is_fault: bool = True

    @property
    def warning(self) -> str:
        """The finding as a warning in one line."""
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.words}" + (f"; {self.todo}" if self.todo else "")


class SensorError(InputError):
    """A sensor's record contradicts the images, the rig, or another sensor.

    The message is about the first finding and names the others; ``findings`` has all of them.
    """

    def __init__(self, *args: Any, findings: Sequence[Finding] = (), **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.findings = tuple(findings)


def accepted_codes(accept: Iterable[str]) -> frozenset[Code]:
    """Return the codes that a user accepts. Raises InputError for an unknown code."""
    words = [accept] if isinstance(accept, str) else list(accept)
    known = [str(code) for code in Code]
    for word in words:
        if word not in known:
            raise InputError(
                f"accept: there is no code {word!r}", todo=suggestion(str(word), known)
            )
    return frozenset(Code(word) for word in words)


def settled(findings: Sequence[Finding], accept: frozenset[Code]) -> list[str]:
    """Return the findings as warnings for the user.

    Raises SensorError if a finding has a code that the user does not accept.
    """
    refused = [f for f in findings if f.code is not None and f.code not in accept]
    if refused:
        first = refused[0]
        others = [f"{f.where}: {f.words} ({f.code})" for f in refused[1:]]
        more = "\nand " + counted_list(others, "more fault", "\n  ") if others else ""
        raise SensorError(
            first.words + more, where=first.where, code=str(first.code), findings=refused,
            todo=f'{first.todo}. To use the data as they are: --accept {first.code}, in Python '
            f'accept=["{first.code}"]',
        )  # fmt: skip
    out = []
    for finding in findings:
        end = f" (accepted: {finding.code})" if finding.code is not None else ""
        out.append(finding.warning + end)
    return list(dict.fromkeys(out))
