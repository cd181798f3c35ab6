"""Make a new dataset: its folders and a rig.toml with comments for the person who completes it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template

from telerig.errors import InputError
from telerig.io.files.atomic import write_text_atomic
from telerig.io.rig_file.description import MOST_CAMERAS, rotvec_key
from telerig.io.rig_file.rig_file import description_from_toml

_NAME = re.compile(r"[A-Za-z0-9_-]+")
_NOT_IN_TOML = re.compile(r'["\\\x00-\x1f\x7f]')


def new_dataset(
    folder: Path,
    *,
    cameras: Sequence[str] = ("left", "right"),
    image_size_px: tuple[int, int] = (512, 512),
    scale_px_per_mm: float = 10.0,
    angle_deg: float = 90.0,
) -> list[Path]:
    """Make the folders of a new dataset and write its rig.toml.

    folder : the dataset folder; it is made if it does not exist. Folders that exist already stay.
    cameras : two to four different names.
    image_size_px : (width, height) of every camera's image in px.
    scale_px_per_mm : nominal scale of every camera in px/mm.
    angle_deg : nominal angle in degrees between the optical axes of one camera and the next.
    Returns the paths of rig.toml and of the folders for the images and the runs, in this order.
    Raises InputError when the folder already has a rig.toml, and for values that no rig can have.
    """
    place = Path(folder)
    rig = place / "rig.toml"
    if rig.exists():
        raise InputError("there is a rig.toml already", where=str(rig), todo="edit it")
    _check(cameras, image_size_px, scale_px_per_mm)
    template = (resources.files("telerig.io.dataset") / "rig_template.toml").read_text(
        encoding="utf-8"
    )
    text = Template(template).substitute(
        name=_NOT_IN_TOML.sub("", place.resolve().name), first=cameras[0],
        others="".join(_camera(name, image_size_px, scale_px_per_mm) for name in cameras[1:]),
        rotations="\n".join(
            f"{rotvec_key(name, cameras[0])} = [0.0, {i * float(angle_deg)}, 0.0]"
            for i, name in enumerate(cameras[1:], 1)
        ),
        width=image_size_px[0], height=image_size_px[1], scale=float(scale_px_per_mm),
    )  # fmt: skip
    description_from_toml(text, where=str(rig))
    write_text_atomic(rig, text)
    folders = [place / "calibration" / name for name in cameras] + [place / "runs"]
    for made in folders:
        made.mkdir(parents=True, exist_ok=True)
    return [rig, *folders]


def _camera(name: str, image_size_px: tuple[int, int], scale_px_per_mm: float) -> str:
    """Return the text of the table [cameras.<name>]; the size is in px, the scale in px/mm."""
    width, height = image_size_px
    size = f"image_size_px = [{width}, {height}]"
    return f"[cameras.{name}]\n{size}\nscale_px_per_mm = {float(scale_px_per_mm)}\n\n"


def _check(cameras: Sequence[str], size: tuple[int, int], scale: float) -> None:
    """Raise InputError for camera names, an image size (px) or a scale (px/mm) that cannot be."""
    if not 2 <= len(cameras) <= MOST_CAMERAS:
        raise InputError(f"{len(cameras)} cameras", todo=f"name two to {MOST_CAMERAS}")
    for name in cameras:
        if not _NAME.fullmatch(name) or name == "carriage":
            raise InputError(
                f"camera name {name!r}", todo="use letters, digits, _ and -; not 'carriage'"
            )
    if len(set(cameras)) < len(cameras):
        raise InputError("two cameras have one name", todo="name them apart")
    if min(size) < 16:
        raise InputError(f"image size {size[0]} x {size[1]}", todo="give width x height in pixels")
    if not scale > 0:
        raise InputError(f"scale {scale} px/mm", todo="give a positive number")
