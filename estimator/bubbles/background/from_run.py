"""The bright-field level behind the bubbles, from the run itself.

log image = rig layer(u, v) + lab layer(u + shift_u, v + shift_v) + gain of the frame, with bubbles
as dark outliers. The rig layer is all that is fixed in the image (lens dirt, flat field, a screen
that moves with the rig), the lab layer all that stays behind (a fixed screen, dirt on the tank).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.errors import DetectionError, InputError
from telerig.estimator.bubbles.background.from_one_image import level_of_image
from telerig.estimator.bubbles.background.layers import crop_of_lab, fit_layers

Shift = tuple[float, float]

LEAST_FRAMES = 4
"""With fewer frames the motion of the bubbles does not separate them from the background."""

LEAST_TRAVEL_PX = 2.0
"""Least total travel that separates what is fixed in the lab from what is fixed in the image."""


@dataclass(frozen=True)
class Background:
    """rig_level : (H, W) level of what is fixed in the image, in grey values.

    lab_factor : (Hl, Wl) what multiplies it, fixed in the lab; None without one. Its pixel (0, 0)
    is seen at image pixel (0, 0) when the shift is ``lab_origin_px``.
    covered : (H, W) True where a bubble hid the screen all the time, so that the level there is
    interpolated. frames : those it was made of.
    noise : relative standard deviation of a pixel at the median level.
    """

    rig_level: Float32
    covered: Bools
    lab_factor: Float32 | None = None
    lab_origin_px: tuple[int, int] = (0, 0)
    frames: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    noise: float = 0.0

    def at(self, frame_shift_px: Shift = (0.0, 0.0)) -> Float32:
        """(H, W) level at the median brightness, with the lab displaced by (u, v) px.

        What is fixed in the lab and seen at pixel p at shift 0 is seen at p - shift. A shift that
        is not finite, or outside the lab seen in the run, gives the rig layer alone.
        """
        if self.lab_factor is None or not np.all(np.isfinite(frame_shift_px)):
            return self.rig_level.copy()
        shape = self.rig_level.shape
        return self.rig_level * crop_of_lab(
            self.lab_factor, self.lab_origin_px, frame_shift_px, (shape[0], shape[1]), 1.0
        )


def estimate_background(
    images: Callable[[int], NDArray[np.generic] | None],
    frame_count: int,
    *,
    shift_px: Array | None = None,
    max_frames: int = 41,
) -> Background:
    """The background from a sample of at most ``max_frames`` frames spread over the run.

    images : gives a frame's (H, W) image, or None where it is missing.
    shift_px : (F, 2) travel of the rig as seen in the image, (u, v): what is fixed in the lab is
    seen at p - shift. None when nothing moves, or everything seen moves along. Frames with NaN are
    not used.

    A bubble that the rig follows keeps some pixels dark all the time: they are recognised by the
    changing edge around them, filled smoothly, and marked in `Background.covered`.
    Raises DetectionError without a single frame, InputError for images that differ in size.
    """
    shifts = np.zeros((frame_count, 2)) if shift_px is None else np.asarray(shift_px, float)
    if shifts.shape != (frame_count, 2):
        raise InputError(
            f"has the shape {shifts.shape}", where="shift_px", todo=f"give ({frame_count}, 2)"
        )
    frames, stack = _sample(images, np.flatnonzero(np.isfinite(shifts).all(1)), max_frames)
    if len(frames) < LEAST_FRAMES:
        return Background(*level_of_image(stack.max(0)), frames=frames)
    travel = shifts[frames]
    moving = bool(np.ptp(travel, axis=0).max() >= LEAST_TRAVEL_PX)
    layers, covered, noise = fit_layers(stack, travel if moving else None)
    lab = None if layers.lab is None else np.exp(layers.lab)
    return Background(np.exp(layers.rig), covered, lab, layers.lab_origin_px, frames, noise)


def _sample(
    images: Callable[[int], NDArray[np.generic] | None],
    candidates: Ints,
    max_frames: int,
) -> tuple[Ints, NDArray[np.generic]]:
    """Frames and their (n, H, W) images, unevenly spread.

    Even spacing at even speed would make every texture whose period is the spacing look the same
    in both layers; the golden ratio's multiples avoid all periods.
    """
    parts = np.array_split(candidates, min(max_frames, len(candidates)))
    frames, pictures = [], []
    for k, part in enumerate(parts):
        turn = int((k * 0.6180339887498949) % 1 * len(part)) if len(part) else 0
        for frame in np.roll(part, -turn)[:4]:
            picture = images(int(frame))
            if picture is not None:
                frames.append(int(frame))
                pictures.append(picture)
                break
    if not pictures:
        raise DetectionError(
            "no frame can be used for the background",
            where="run",
            todo="check that images exist and the stage's record covers their times",
        )
    if len({picture.shape for picture in pictures}) > 1:
        raise InputError("the images differ in size", where="run", todo="give one camera's images")
    return np.array(frames, np.int64), np.stack(pictures)
