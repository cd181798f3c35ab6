"""Learns from a run which share of the errors of sizes and shapes all frames of a bubble have."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.shapes import DEFAULT_SHAPES

_PRIOR_FRAMES = 10.0
"""Weight, in frames of one bubble, of a stretch that never changes."""
_PRIOR_SQUARE = 0.5
"""Share of the variance of its square that is left in a mean where a run does not tell it, with the
weight of one bubble: that of a body that turns, which shows both numbers t in turn."""


@dataclass
class LastingShare:
    """Collects the ``stretch`` of the rows of tracks.csv, in the order of their frames.

    Two views see one number of how a body's equator differs from a circle, and miss the other,
    which causes most of what is uncertain of a size or an aspect ratio beside the outlines' noise.
    Both change alike as a body turns and swings, so that the correlation of the seen one over the
    frames of a bubble is that of the errors.

    sums : (4,) by track: number of frames, sum of the stretch, of its square, and of the variance
        by the outlines' noise.
    """

    sums: dict[Any, Array] = field(default_factory=dict)

    def add(self, tracks: pd.DataFrame) -> None:
        """Add the next rows of tracks.csv."""
        known = tracks[tracks["stretch"].notna()]
        stretch, noise = (known[name].to_numpy(float) for name in ("stretch", "noise_stretch"))
        parts = np.stack([np.ones_like(stretch), stretch, stretch**2, noise**2], -1)
        tracks_of_rows, place = np.unique(known["particle"].to_numpy(), return_inverse=True)
        sums = np.zeros((len(tracks_of_rows), 4))
        np.add.at(sums, place, parts)
        for particle, mine in zip(tracks_of_rows.tolist(), sums):
            self.sums[particle] = self.sums.get(particle, 0.0) + mine

    def found(self) -> dict[str, float]:
        """Return ``lasting_share`` and ``lasting_square``, 0 to 1.

        They are the shares of the variances of the stretch and of its square that are left in a
        mean over a bubble's frames.
        """
        return {"lasting_share": self._share(), "lasting_square": self._square()}

    def _square(self) -> float:
        """Return the variance between the bubbles' mean squares, over that of a normal variable's
        square."""
        count, _, squares, noise = np.reshape([*self.sums.values()], (-1, 4)).T
        whole = float((squares - noise).sum())
        if not whole > 0:
            return _PRIOR_SQUARE
        each = (squares - noise) / count / (whole / count.sum())
        bubbles = len(count)
        scatter = bubbles * float(count @ (each - 1) ** 2 / count.sum())
        return float(np.clip((scatter / 2 + _PRIOR_SQUARE) / bubbles, 0.0, 1.0))

    def _share(self) -> float:
        """Products of different frames have no part of the outlines' noise. Without bubbles that
        are seen in two frames, or without any stretch beyond the noise, the share is 1.
        """
        left = every = _PRIOR_FRAMES * (2 * DEFAULT_SHAPES.triaxial) ** 2
        for count, total, squares, noise in self.sums.values():
            if count > 1:
                apart = (total**2 - squares) / (count - 1)
                left += apart + (squares - noise - apart) / count
                every += squares - noise
        return float(np.clip(left / every, 0.0, 1.0)) if every > 0 else 1.0
