"""Make a new dataset: its folders and a rig.toml with comments for the person who completes it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import NamedTuple

from telerig.errors import InputError
from telerig.io.files.atomic import write_text_atomic
from telerig.io.rig_file.camera_names import check_camera_names
from telerig.io.rig_file.description import MOST_CAMERAS, rotvec_key
from telerig.io.rig_file.rig_file import description_from_toml
from telerig.io.rig_file.writer import toml_key
from telerig.short_text import counted

PRACTICE_TARGET = """\
layout = "grid"                    # or "points" with points_mm = [[x, y], ...]
rows = 3
columns = 5
pitch_mm = 7.0                     # or [x, y]
dot_diameter_mm = 2.4
polarity = "white_on_black"        # or "black_on_white"
marks = [[1, 2], [1, 3], [0, 2]]   # [row, column] of the dots that fix its orientation
mark_style = "large"               # "large", "ring" or "missing"
mark_diameter_mm = 3.6
extent = "bounded"                 # "unbounded": the grid goes on beyond rows x columns
print_sigma_mm = 0.02              # how far a dot may be from its place in the plane
flatness_sigma_mm = 0.02           # and out of it
scale_dots = [0, 14]               # two dots, counted along the rows from 0 ...
scale_distance_mm = 31.305         # ... whose distance was measured ...
scale_sigma_mm = 0.001             # ... so well"""
"""The lines of [target] for a target that is still to be made."""
_STEREO = """\
[stereo]
# The rotation vector (degrees) that turns the first camera's axes into another's, roughly.
# 90 about y: the other camera looks at the first one's right hand. It decides between the two
# mirror images of the rig that fit the target equally well, so its sign matters.
"""
_NOT_IN_TOML = re.compile(r'["\\\x00-\x1f\x7f]')


class NewCamera(NamedTuple):
    """A camera's name, the (width, height) of its images in px, and its nominal scale in px/mm."""

    name: str
    image_size_px: tuple[int, int] = (512, 512)
    scale_px_per_mm: float = 10.0


def new_dataset(
    folder: Path,
    cameras: Sequence[NewCamera] = (NewCamera("left"), NewCamera("right")),
    *,
    angle_deg: float = 90.0,
    target: str = PRACTICE_TARGET,
) -> list[Path]:
    """Make the folders of a new dataset and write its rig.toml.

    folder : the dataset folder; it is made if it does not exist. Folders that exist already stay.
    cameras : one to four, with different names.
    angle_deg : nominal angle in degrees between the optical axes of one camera and the next.
    target : the lines of the table [target].

    Returns the paths of rig.toml and of the folders for the images and the runs, in this order.
    Raises InputError when the folder already has a rig.toml, and for values that no rig can have.
    """
    place = Path(folder)
    rig = place / "rig.toml"
    if rig.exists():
        raise InputError("there is a rig.toml already", where=str(rig), todo="edit it")
    _check(cameras, str(rig))
    template = (resources.files("telerig.io.dataset") / "rig_template.toml").read_text(
        encoding="utf-8"
    )
    first, *others = cameras
    text = Template(template).substitute(
        name=_NOT_IN_TOML.sub("", place.resolve().name), first=first.name,
        key=toml_key(first.name), axis=toml_key(f"axis_{first.name}"),
        arm=toml_key(f"arm_{first.name}"),
        others="".join(_camera(camera) for camera in others),
        stereo=_stereo([camera.name for camera in cameras], angle_deg), target=target,
        width=first.image_size_px[0], height=first.image_size_px[1],
        scale=float(first.scale_px_per_mm),
    )  # fmt: skip
    description_from_toml(text, where=str(rig))
    write_text_atomic(rig, text)
    folders = [place / "calibration" / camera.name for camera in cameras] + [place / "runs"]
    for made in folders:
        made.mkdir(parents=True, exist_ok=True)
    return [rig, *folders]


def _stereo(names: Sequence[str], angle_deg: float) -> str:
    """Return the text of the table [stereo]; "" for one camera."""
    if len(names) == 1:
        return ""
    rotations = [
        f"{toml_key(rotvec_key(name, names[0]))} = [0.0, {i * float(angle_deg)}, 0.0]"
        for i, name in enumerate(names[1:], 1)
    ]
    return _STEREO + "\n".join(rotations) + "\n\n"


def _camera(camera: NewCamera) -> str:
    """Return the text of the table [cameras.<name>]."""
    width, height = camera.image_size_px
    size = f"image_size_px = [{width}, {height}]"
    scale = f"scale_px_per_mm = {float(camera.scale_px_per_mm)}"
    return f"[cameras.{toml_key(camera.name)}]\n{size}\n{scale}\n\n"


def _check(cameras: Sequence[NewCamera], where: str) -> None:
    """Raise InputError for camera names, image sizes or scales that cannot be."""
    if not 1 <= len(cameras) <= MOST_CAMERAS:
        raise InputError(counted(len(cameras), "camera"), todo=f"name one to {MOST_CAMERAS}")
    check_camera_names([camera.name for camera in cameras], where)
    for _, size, scale in cameras:
        if min(size) < 16:
            words = f"image size {size[0]} x {size[1]}"
            raise InputError(words, todo="give width x height in pixels")
        if not scale > 0:
            what = f"the scale is {scale} px/mm, not positive"
            raise InputError(what, where="--scale", todo="give a positive number")
