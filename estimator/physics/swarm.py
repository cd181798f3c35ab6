"""Numbers per volume of liquid: number density, void fraction, gas flux, mean diameters.

A bubble is measured where both images show it whole, so large ones are measured in a smaller volume
than small ones. Each bubble therefore counts by the inverse of the volume in which its own centre
may lie (Miles, Sankhya A 40:1, 1978, and Lantuejoul, J. Microsc. 120:213, 1980, in three
dimensions), and only while its centre lies there.

Bubbles arrive independently: sums over bubbles have the variance of a compound Poisson process,
which is the sum of the squares of what each bubble adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.physics.means import Lasting, mean_of_body
from telerig.rig.camera import Camera
from telerig.rig.triangulation import nearly_parallel, stacked_jacobian

_SAMPLES = 2**15
_EDGE_PX = 2.5
"""An outline that comes nearer than this to the edge of an image counts as cut."""

_LEAST_SHARE = 0.01


def swarm_numbers(
    trajectories: pd.DataFrame,
    bodies: pd.DataFrame,
    carriage_mm: Array,
    axis: Array,
    up: Array,
    cameras: Sequence[Camera],
    lasting: Lasting | None = None,
) -> dict[str, Any]:
    """Return number density, void fraction, gas flux and mean diameters with standard deviations.

    trajectories, bodies : tables of a run, see `telerig.estimator.physics.frames`.
    carriage_mm : (F,) position of the stage in each frame.
    axis : (3,) direction of its travel.
    up : (3,) unit vector against gravity.
    cameras : those of the run, two or more.

    The result is empty where no shape is known; "left_out" counts bubbles that hardly fit the
    images, or whose shape is not known.
    """
    shapes = bodies[bodies["aspect"].notna()].groupby("particle")
    if len(cameras) < 2 or not len(shapes) or not len(trajectories):
        return {}
    sight = _Sight(cameras)
    frames, left_out, rows = len(carriage_mm), 0, []
    means = shapes[["equator_mm", "polar_mm"]].mean()
    sizes = {k: mean_of_body(mine, "d_eq_mm", lasting or Lasting()) for k, mine in shapes}
    poles = {k: mine[["pole_x", "pole_y", "pole_z"]].to_numpy(float) for k, mine in shapes}
    for k, mine in trajectories.groupby("particle"):
        if k not in means.index:
            left_out += 1
            continue
        body = means.loc[k]
        axes = np.einsum("ni,nj->ij", poles[k], poles[k]) / len(poles[k])
        moments = body["equator_mm"] ** 2 * np.eye(3)
        moments += (body["polar_mm"] ** 2 - body["equator_mm"] ** 2) * axes
        volume, extents = sight.volume_mm3(moments)
        if volume < _LEAST_SHARE * sight.box_mm3:
            left_out += 1
            continue
        place = mine[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        place = place - carriage_mm[mine["frame"].to_numpy(int), None] * axis
        inside = sight.whole(place, extents)
        rise = mine[["vx_mm_s", "vy_mm_s", "vz_mm_s"]].to_numpy(float)[inside] @ up
        (d, sd), weight = sizes[k], 1 / (frames * volume)
        rows.append((d, sd / d, weight * inside.sum(), weight * rise.sum()))
    if not sum(number for _, _, number, _ in rows):
        return {}
    return _sums(np.array(rows, float)) | {
        "volume_mm3": sight.volume_mm3(np.zeros((3, 3)))[0],
        "bubbles": len(rows),
        "left_out": left_out,
    }


def _sums(rows: Array) -> dict[str, float]:
    """rows : (B, 4) of each bubble: diameter (mm), its relative standard deviation, what it adds to
    the number density (1/mm^3), and to the flux of numbers (1/(mm^2 s))."""
    d, size_sd, number, flux = rows.T
    gas = np.pi / 6 * d**3

    def total(parts: Array, power: int) -> tuple[float, float]:
        variance = (parts**2).sum() + ((power * size_sd * parts) ** 2).sum()
        return float(parts.sum()), float(np.sqrt(variance))

    out: dict[str, float] = {}
    for name, parts, power in (
        ("number_per_cm3", 1e3 * number, 0),
        ("void_fraction", gas * number, 3),
        ("gas_flux_mm_s", gas * flux, 3),
    ):
        out[name], out[f"s_{name}"] = total(parts, power)
    for name, high, low in (("d10_mm", 1, 0), ("d32_mm", 3, 2)):
        above, below = number * d**high, number * d**low
        out[name] = mean = float(above.sum() / below.sum())
        spread = ((above - mean * below) ** 2).sum() + ((size_sd * above) ** 2).sum()
        out[f"s_{name}"] = float(np.sqrt(spread) / below.sum())
    return out


class _Sight:
    """Where bubbles are seen whole by two cameras or more; volumes by quasi-random points."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        from scipy.stats import qmc

        self.cameras = tuple(cameras)
        self.size = np.concatenate([np.array(c.image_size_px, float) for c in cameras])
        pixel, jacobian = stacked_jacobian(self.cameras, np.zeros((1, 3)))
        self.jacobian = jacobian[0]
        # a box of rig axes that holds all that two cameras see
        ends = []
        for pair in combinations(range(len(cameras)), 2):
            if nearly_parallel((cameras[pair[0]], cameras[pair[1]])):
                continue
            rows = [2 * c + i for c in pair for i in range(2)]
            inverse = np.linalg.pinv(self.jacobian[rows])
            middle = inverse @ ((self.size - 1) / 2 - pixel[0])[rows]
            far = 1.1 * np.abs(inverse) @ self.size[rows] / 2 + 1e-9
            ends.append((middle - far, middle + far))
        low, high = np.min([e[0] for e in ends], 0), np.max([e[1] for e in ends], 0)
        centre, reach = (low + high) / 2, (high - low) / 2
        self.box_mm3 = float(np.prod(2 * reach))
        points = centre + reach * (2 * qmc.Halton(3, scramble=False).random(_SAMPLES) - 1)
        self.pixels, _ = stacked_jacobian(self.cameras, points)

    def _whole(self, pixels: Array, extents_px: Array) -> Array:
        margin = extents_px + _EDGE_PX
        inside = (pixels >= margin) & (pixels <= self.size - 1 - margin)
        return np.asarray(inside.reshape(*inside.shape[:-1], -1, 2).all(-1).sum(-1) >= 2)

    def volume_mm3(self, moments: Array) -> tuple[float, Array]:
        """Volume in which the centre of a body of moments A A^T (3, 3) may lie, and the half widths
        (2 C,) of its outlines in px."""
        extents = np.sqrt(np.einsum("ki,ij,kj->k", self.jacobian, moments, self.jacobian))
        return self.box_mm3 * float(self._whole(self.pixels, extents).mean()), extents

    def whole(self, points_mm: Array, extents_px: Array) -> Array:
        """Return whether (N,) bodies of these half widths at points (N, 3) are seen whole."""
        pixels, _ = stacked_jacobian(self.cameras, points_mm)
        return self._whole(pixels, extents_px)
