"""Fit Soloff's polynomial camera: cubic in x and y, quadratic in z, 19 terms for u and for v.

S. M. Soloff, R. J. Adrian and Z.-C. Liu, Meas. Sci. Technol. 8:1441 (1997), equation 8. PIV
programs use it in place of a camera model. It is fitted to the calibrated camera over the working
volume.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from telerig.arrays import Array
from telerig.io.exchange.export.volume import Misfit, Volume, seen_points, working_volume
from telerig.io.files.atomic import atomic_folder, write_text_atomic
from telerig.rig.camera import Camera

POWERS = (
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1),
    (2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2),
    (3, 0, 0), (2, 1, 0), (1, 2, 0), (0, 3, 0), (2, 0, 1), (1, 1, 1), (0, 2, 1), (1, 0, 2),
    (0, 1, 2),
)  # fmt: skip
"""Exponents of x, y, z in the order of the paper's a0 ... a18."""

CUBIC_Z = (0, 0, 3)
"""Exponents of the 20th term, which the paper omits. A camera that looks along x needs it."""

FIT_POINTS_PER_EDGE = 21
CHECK_POINTS_PER_EDGE = 34


@dataclass(frozen=True)
class Soloff:
    """Hold the polynomial that was fitted to one camera over a volume.

    coefficients : (19, 2) in the order of `POWERS`, or (20, 2) with `CUBIC_Z` last. Columns give
        u and v in px for x, y, z in mm in the rig frame.
    misfit : error of the polynomial in px at points that were not used in the fit.
    """

    camera: str
    coefficients: Array
    misfit: Misfit
    volume: Volume


def export_soloff(
    cameras: Sequence[Camera],
    out: Path,
    volume: Volume,
    *,
    full_cubic: bool = False,
    first_pixel: float = 0.0,
    remarks: Sequence[str] = (),
) -> list[str]:
    """Fit a polynomial to each camera and write it to soloff_<camera>.csv in the folder ``out``.

    full_cubic : see `fit_soloff`. first_pixel, remarks : see `write_soloff`. Returns one line of
    text per camera. Raises InputError when the cameras do not see the volume.
    """
    fits = fit_soloff(cameras, volume, full_cubic=full_cubic)
    with atomic_folder(out) as folder:
        for fit in fits:
            write_soloff(fit, folder / f"soloff_{fit.camera}.csv", first_pixel, remarks)
    return [f"{f.camera}: {len(f.coefficients)} terms, {f.misfit.words()}" for f in fits]


def terms(points_mm: Array, count: int = len(POWERS)) -> Array:
    """Return the monomials (..., count) of points (..., 3) in mm, in the order of `POWERS`."""
    powers = np.array([*POWERS, CUBIC_Z][:count])
    return np.asarray(np.prod(points_mm[..., None, :] ** powers, axis=-1))


def fit_soloff(
    cameras: Sequence[Camera], volume: Volume | None = None, *, full_cubic: bool = False
) -> tuple[Soloff, ...]:
    """Fit one polynomial per camera by least squares.

    volume : the fit uses the part of this box that all cameras see; None takes `working_volume`.
    full_cubic : whether the term z^3 is added (20 terms), for programs that take the exponents from
    the file. Raises InputError if the cameras do not see the volume.
    """
    box = volume or working_volume(cameras)
    fitted = seen_points(cameras, box, FIT_POINTS_PER_EDGE)
    checked = seen_points(cameras, box, CHECK_POINTS_PER_EDGE)
    unit = float(np.abs(fitted).max())
    powers = [*POWERS, CUBIC_Z] if full_cubic else list(POWERS)
    scale = unit ** -np.sum(powers, axis=1, dtype=float)
    design = terms(fitted / unit, len(powers))
    check = terms(checked, len(powers))
    out = []
    for camera in cameras:
        solution = np.linalg.lstsq(design, camera.project(fitted), rcond=None)[0]
        coefficients = solution * scale[:, None]
        misfit = Misfit.between(check @ coefficients, camera.project(checked))
        out.append(Soloff(camera.name, coefficients, misfit, box))
    return tuple(out)


def write_soloff(
    fit: Soloff,
    path: str | PathLike[str],
    first_pixel: float = 0.0,
    remarks: Sequence[str] = (),
) -> None:
    """Write a CSV file of the terms, below a header on volume, units, pixel origin and misfit.

    first_pixel : the coordinate in px that the other program gives to the centre of the top-left
    pixel: 0 as in telerig, 0.5 where it counts from the pixel's corner, 1 in MATLAB.
    """
    shifted = fit.coefficients.copy()
    shifted[0] += first_pixel
    head = [
        f"Soloff polynomial ({len(shifted)} terms) of camera {fit.camera}",
        "u_px = sum of u * x^i y^j z^k, v_px likewise; x, y, z in mm in the rig frame",
        f"pixel: u right, v down; the centre of the top-left pixel is ({first_pixel:g}, "
        f"{first_pixel:g})",
        f"fitted over {fit.volume.words()}, as far as every camera sees it; not valid outside",
        f"error against the calibrated camera: rms_px = {fit.misfit.rms_px!r}, "
        f"max_px = {fit.misfit.max_px!r} at {fit.misfit.points} points that were not fitted",
        *remarks,
    ]
    rows = [
        f"{i},{j},{k},{float(u)!r},{float(v)!r}"
        for (i, j, k), (u, v) in zip([*POWERS, CUBIC_Z], shifted)
    ]
    text = "".join(f"# {line}\n" for line in head) + "i,j,k,u,v\n" + "\n".join(rows) + "\n"
    write_text_atomic(path, text)
