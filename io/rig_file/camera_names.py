"""The rule for the names of a rig's cameras, and where it is checked.

A camera's name is a folder, a key of rig.toml and a part of the names of columns.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from telerig.errors import InputError
from telerig.io.files.names import check_name
from telerig.io.rig_file.description import CARRIAGE

_NAME = re.compile(r"\w[\w-]*")
_RESERVED = {
    CARRIAGE: f'"{CARRIAGE}" means the stage in mounted_on',
    "all": "rms_all_px in calibration.json is the RMS of all dots",
}
_OTHER = "give the camera another name"


class CameraNameFault(NamedTuple):
    """A name that a camera cannot have beside the others, what is wrong with it, what to do."""

    name: str
    what: str
    todo: str


def camera_name_faults(names: Sequence[str]) -> list[CameraNameFault]:
    """Return what is wrong with the names of a rig's cameras beyond the rule for all names."""
    found = []
    for i, name in enumerate(names):
        if not _NAME.fullmatch(name):
            what = "a camera's name has letters, digits, _ and - only, and does not begin with -"
            todo = "it is a folder, a key and a part of columns' names: choose another one"
            found.append(CameraNameFault(name, what, todo))
        if name.lower() in _RESERVED:
            found.append(CameraNameFault(name, _RESERVED[name.lower()], _OTHER))
        for other in names[:i]:
            if other.lower() == name.lower():
                case = "" if other == name else ", but for upper and lower case"
                found.append(CameraNameFault(name, f"two cameras have one name{case}", _OTHER))
        if f"s{name}" in names:
            what = (
                f"the column s{name}_x_mm of shake.csv would be the standard deviation of camera "
                f"{name!r} and the place of camera {f's{name}'!r}"
            )
            found.append(CameraNameFault(name, what, _OTHER))
    return found


def check_camera_names(names: Sequence[str], where: str, option: str = "") -> None:
    """Raise InputError, with the place ``where``, for the first name that rig.toml refuses.

    option : the option of a command with which the names can be given.
    """
    for name in names:
        check_name(name, where, "camera")
    for fault in camera_name_faults(names):
        todo = fault.todo + (f" ({option})" if option else "")
        raise InputError(f"camera {fault.name!r}: {fault.what}", where=where, todo=todo)
