"""Centre of volume from two outlines: error against the mean of the outlines, mode by mode.

Bodies x = A s (1 + eps Y(s)) with A an ellipsoid and Y one spherical harmonic of largest value 1;
their exact rims (largest extent in each direction of the image), their centres by quadrature, and
outlines fitted to noisy rim points. None of it shares code with the estimate.

    python benchmarks/bodies.py [--bodies 200] [--seed 0] [--out benchmarks/results/bodies.md]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from telerig.estimator.bubbles.outline.ellipse_geometry import DETECTION_COLUMNS
from telerig.estimator.bubbles.shape.body import Bodies, fit_bodies
from telerig.estimator.bubbles.shape.learning import learn_shapes
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.bubbles.shape.sightings import Sightings, sightings_from_table
from telerig.rig.camera import Camera
from telerig.rig.outline import HARMONICS, waves
from telerig.rig.pose import Pose

Array = NDArray[np.float64]
Mode = Callable[[Array], Array]

SCALE_PX_PER_MM = 10.0
NOISE_PX = 0.05
EPSILON = 0.05
RIM_POINTS = 96
VERTICAL_FROM_Z = Rotation.from_rotvec([np.pi / 2, 0, 0])
MODES = [(2, 0), (2, 1), (2, 2), (3, 0), (3, 1), (3, 2), (3, 3), *((4, m) for m in range(5))]


UP = np.array([0.0, -1.0, 0.0])
RIGS = {2: (0, 90), 3: (0, 60, 120), 4: (0, 45, 90, 135)}
"""Directions of the cameras about the vertical (degrees), by their number."""


def rig(views: int = 2) -> tuple[Camera, ...]:
    """Ideal telecentric cameras, the vertical shared."""
    return tuple(
        Camera.create(
            f"camera{i}", (1280, 800), SCALE_PX_PER_MM,
            camera_from_rig=Pose.from_rotvec([0, np.radians(angle), 0]),
        )
        for i, angle in enumerate(RIGS[views])
    )  # fmt: skip


PLACEMENTS = [
    ("vertical", 1.0), ("own", 1.0), ("vertical", 1.6), ("own", 1.6), ("apart", 1.6),
]  # fmt: skip
NOTES = """Bodies x = A s (1 + 0.05 Y(s)), Y one harmonic (degree, order) of largest value 1 or, for
"Gaussian 3+4", independent coefficients of degree 3 and 4; A an oblate spheroid of an axis ratio
drawn evenly from the range; R 10-40 px at 10 px/mm; outlines measured to 0.05 px per px of arc.
`vertical`: the mode's axis and the spheroid's are vertical (the coordinate both cameras share);
`own`: both are one random direction; `apart`: two random directions. Errors are RMS lengths against
the exact centre of volume; `gain` is their ratio; `in 68 %`, `in 95 %`: share of bodies inside
those ellipsoids of the reported covariance. The even degrees 2 and 4 move no outline: there both
are at the noise."""


@dataclass(frozen=True)
class Body:
    """centre_mm (3,), shape_mm (3, 3) A, mode: (..., 3) unit vectors -> (...) relative height."""

    centre_mm: Array
    shape_mm: Array
    mode: Mode

    def surface_mm(self, directions: Array) -> Array:
        radial = directions * (1 + self.mode(directions))[..., None]
        return np.asarray(self.centre_mm + radial @ self.shape_mm.T)

    def volume_centre_mm(self) -> Array:
        directions, weight = _quadrature()
        radius = 1 + self.mode(directions)
        first = np.einsum("t,tp,tpi->i", weight, radius**4 / 4, directions)
        volume = np.einsum("t,tp->", weight, radius**3 / 3)
        return np.asarray(self.centre_mm + self.shape_mm @ (first / volume))

    def diameter_mm(self) -> float:
        """Of the sphere of equal volume."""
        directions, weight = _quadrature()
        mean = np.einsum("t,tp->", weight, (1 + self.mode(directions)) ** 3) / 96
        return float(2 * np.cbrt(mean * np.linalg.det(self.shape_mm)))


def _quadrature() -> tuple[Array, Array]:
    """(24, 48, 3) directions, (24,) Gauss-Legendre weights in the cosine of the polar angle."""
    cosine, weight = np.polynomial.legendre.leggauss(24)
    angle = 2 * np.pi * np.arange(48) / 48
    sine = np.sqrt(1 - cosine**2)[:, None]
    parts = [sine * np.cos(angle), sine * np.sin(angle), cosine[:, None] + 0 * angle]
    return np.stack(parts, -1), weight


def real_harmonic(degree: int, order: int, into_mode: Rotation) -> Mode:
    """Y_lm of rotated directions, scaled to a largest value of 1."""

    def raw(s: Array) -> Array:
        polar, azimuth = np.arccos(np.clip(s[..., 2], -1, 1)), np.arctan2(s[..., 1], s[..., 0])
        return np.asarray(sph_harm_y(degree, order, polar, azimuth).real)

    largest = np.abs(raw(_sphere(20000))).max()
    matrix = into_mode.as_matrix()
    return lambda s: EPSILON / largest * raw(s @ matrix.T)


def gaussian_mode(rng: np.random.Generator) -> Mode:
    """Independent coefficients of degree 3 and 4, of rms `EPSILON` / 2.6 together."""
    terms = [(degree, m) for degree in (3, 4) for m in range(degree + 1)]
    weights = rng.standard_normal((len(terms), 2)) * EPSILON / 2.6 * np.sqrt(4 * np.pi / 16)

    def mode(s: Array) -> Array:
        polar, azimuth = np.arccos(np.clip(s[..., 2], -1, 1)), np.arctan2(s[..., 1], s[..., 0])
        total = np.zeros(s.shape[:-1])
        for (degree, m), (even, odd) in zip(terms, weights):
            y = sph_harm_y(degree, m, polar, azimuth)
            total += even * y.real if m == 0 else np.sqrt(2) * (even * y.real + odd * y.imag)
        return total

    return mode


def _sphere(count: int) -> Array:
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], -1)


def rim_mm(body: Body, outward: Array) -> Array:
    """(N, 3) surface points that reach farthest in the directions outward (N, 3).

    The best of 1500 points, then three Newton steps on the sphere with differences.
    """
    start = _sphere(1500)
    best = start[np.argmax(body.surface_mm(start) @ outward.T, axis=0)]
    step = 0.01
    for _ in range(3):
        helper = np.where(np.abs(best[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
        e1 = np.cross(best, helper)
        e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
        e2 = np.cross(best, e1)

        def reach(a: float, b: float, s=best, e1=e1, e2=e2) -> Array:  # type: ignore[no-untyped-def]
            moved = s + step * (a * e1 + b * e2)
            moved = moved / np.linalg.norm(moved, axis=-1, keepdims=True)
            return np.asarray((body.surface_mm(moved) * outward).sum(-1))

        f0, fa, fb, ga, gb = reach(0, 0), reach(1, 0), reach(0, 1), reach(-1, 0), reach(0, -1)
        cross = (reach(1, 1) - reach(1, -1) - reach(-1, 1) + reach(-1, -1)) / 4
        hessian = np.stack([fa + ga - 2 * f0, cross, cross, fb + gb - 2 * f0], -1)
        gradient = np.stack([fa - ga, fb - gb], -1) / 2
        move = -np.linalg.solve(hessian.reshape(-1, 2, 2), gradient[..., None])[..., 0]
        move = np.clip(move, -8, 8) * step
        best = best + move[:, :1] * e1 + move[:, 1:] * e2
        best /= np.linalg.norm(best, axis=-1, keepdims=True)
    return body.surface_mm(best)


def outline_row(points_px: Array, sigma_px: Array, rng: np.random.Generator) -> dict[str, float]:
    """One row of the detection table: ellipse and harmonics fitted to noisy outline points."""
    tangent = np.roll(points_px, -1, 0) - np.roll(points_px, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], -1)
    points = points_px + normal * (sigma_px * rng.standard_normal(len(points_px)))[:, None]
    centre = points.mean(0)
    axes = np.linalg.cholesky(2 * np.cov((points - centre).T))
    for _ in range(8):
        left, (a, b), _ = np.linalg.svd(axes)
        rest, jacobian = _outline_residuals(points, centre, left, a, b)
        weighted = jacobian / sigma_px[:, None]
        found = np.linalg.lstsq(weighted, rest / sigma_px, rcond=None)[0]
        centre = centre + left @ found[:2]
        stretch = np.array([[found[2], found[4]], [found[4], found[3]]])
        axes = left @ (np.eye(2) + stretch) @ np.diag([a, b])
    covariance = np.linalg.inv(weighted.T @ weighted)
    of_centre = left @ covariance[:2, :2] @ left.T
    names = [f"{part}{k}_px" for k in HARMONICS for part in "cs"]
    return dict(zip(names, found[5:])) | {
        "u_px": centre[0], "v_px": centre[1], "a_px": a, "b_px": b,
        "angle_rad": float(np.arctan2(left[1, 0], left[0, 0])),
        "suu_px2": of_centre[0, 0], "suv_px2": of_centre[0, 1], "svv_px2": of_centre[1, 1],
        "sigma_outline_px": float(np.sqrt(np.diag(covariance)[5:].mean())),
    }  # fmt: skip


def _outline_residuals(
    points: Array, centre: Array, left: Array, a: float, b: float
) -> tuple[Array, Array]:
    """Normal distances of points from the ellipse; (N, 13) derivatives: shift and stretch in the
    ellipse's own axes, harmonics. A reflected frame is turned into a rotated one in place."""
    if np.linalg.det(left) < 0:
        left[:, 1] *= -1
    local = (points - centre) @ left
    phi = np.arctan2(local[:, 1] * a, local[:, 0] * b)
    for _ in range(6):
        c, s = np.cos(phi), np.sin(phi)
        across = (local[:, 0] - a * c) * -a * s + (local[:, 1] - b * s) * b * c
        phi = phi + across / (local[:, 0] * a * c + local[:, 1] * b * s
                              + (a * a - b * b) * (s * s - c * c))  # fmt: skip
    c, s = np.cos(phi), np.sin(phi)
    g = np.hypot(b * c, a * s)
    nx, ny = b * c / g, a * s / g
    basis = waves(phi).T
    rest = (local[:, 0] - a * c) * nx + (local[:, 1] - b * s) * ny
    ellipse = [nx, ny, nx * a * c, ny * b * s, nx * b * s + ny * a * c]
    return rest, np.concatenate([np.stack(ellipse, -1), basis], -1)


def outlines(
    body: Body, cameras: tuple[Camera, ...], rng: np.random.Generator
) -> list[dict[str, float]]:
    """The rows of all cameras."""
    angle = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    outward = np.concatenate([circle @ camera.camera_from_rig.rotation[:2] for camera in cameras])
    rims = np.split(rim_mm(body, outward), len(cameras))
    rows = []
    for camera, rim in zip(cameras, rims):
        pixels = camera.project(rim)
        arc = np.linalg.norm(np.roll(pixels, -1, 0) - np.roll(pixels, 1, 0), axis=-1) / 2
        rows.append(outline_row(pixels, NOISE_PX / np.sqrt(arc), rng))
    return rows


@dataclass(frozen=True)
class Case:
    """One kind of body: a mode (None: Gaussian), its axis, and the ellipsoid's largest ratio."""

    mode: tuple[int, int] | None
    axis: str
    largest_ratio: float

    def draw(self, rng: np.random.Generator) -> Body:
        turned = VERTICAL_FROM_Z if self.axis == "vertical" else Rotation.random(rng=rng)
        ratio = rng.uniform(1, self.largest_ratio)
        axis = turned.as_matrix()[:, 2]
        flat = np.eye(3) + (1 / ratio - 1) * np.outer(axis, axis)
        radius_mm = rng.uniform(10, 40) / SCALE_PX_PER_MM / np.cbrt(np.linalg.det(flat))
        about = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]) * turned.inv()
        if self.axis == "apart":
            about = Rotation.random(rng=rng)
        mode = gaussian_mode(rng) if self.mode is None else real_harmonic(*self.mode, about)
        return Body(rng.uniform(-15, 15, 3), radius_mm * flat, mode)


@dataclass(frozen=True)
class Outcome:
    """Truth (M, 3), (M,), (M,) and what was estimated."""

    truth_mm: Array
    radius_mm: Array
    diameter_mm: Array
    bodies: Bodies

    def relative_rms(self, points_mm: Array) -> float:
        error = (points_mm - self.truth_mm) / self.radius_mm[:, None]
        return float(np.sqrt((error**2).sum(-1).mean()))

    def rms_um(self, points_mm: Array) -> float:
        return float(1e3 * np.sqrt(((points_mm - self.truth_mm) ** 2).sum(-1).mean()))

    def mahalanobis2(self) -> Array:
        error = (self.bodies.points_mm - self.truth_mm)[..., None]
        return np.asarray((error * np.linalg.solve(self.bodies.covariance_mm2, error)).sum((1, 2)))


def fitted(
    rows: list[list[dict[str, float]]],
    cameras: tuple[Camera, ...],
    shapes: Shapes | None = None,
) -> Bodies:
    """Fit the bodies whose outlines are given, as one run; rows: by body and camera."""
    tables = [
        pd.DataFrame([r[c] for r in rows]).reindex(columns=DETECTION_COLUMNS).assign(flags="")
        for c in range(len(cameras))
    ]
    return fitted_tables(tables, cameras, shapes)


def fitted_tables(
    tables: list[pd.DataFrame], cameras: tuple[Camera, ...], shapes: Shapes | None = None
) -> Bodies:
    """Fit bodies; row i of each camera's table is body i."""
    sightings = Sightings.concat(
        [sightings_from_table(table, c, cameras) for c, table in enumerate(tables)]
    )
    count = len(tables[0])
    seen = np.arange(count)[:, None] + count * np.arange(len(cameras))
    if shapes is None:
        shapes = learn_shapes(sightings, seen, cameras, UP)
    return fit_bodies(sightings, seen, cameras, UP, shapes)


def run_case(case: Case, count: int, rng: np.random.Generator, views: int = 2) -> Outcome:
    """Draw bodies, measure them, fit them as one run."""
    cameras = rig(views)
    drawn = [case.draw(rng) for _ in range(count)]
    rows = [outlines(body, cameras, rng) for body in drawn]
    truth = np.array([body.volume_centre_mm() for body in drawn])
    diameter = np.array([body.diameter_mm() for body in drawn])
    return Outcome(truth, diameter / 2, diameter, fitted(rows, cameras))


HEADER = (
    "| mode | axis | ratio | mean of outlines, R | volume, R | mean of outlines, µm | volume, µm "
    "| gain | in 68 % | in 95 % | d_eq, % | its NEES |\n" + 12 * "|---" + "|"
)


def row(case: Case, outcome: Outcome) -> str:
    bodies = outcome.bodies
    points = (bodies.silhouette_points_mm, bodies.points_mm)
    plain, ours = (outcome.relative_rms(p) for p in points)
    distance2 = outcome.mahalanobis2()
    mode = "Gaussian 3+4" if case.mode is None else f"{case.mode[0]},{case.mode[1]}"
    off = bodies.d_eq_mm - outcome.diameter_mm
    diameter = np.sqrt(((off / outcome.diameter_mm) ** 2).mean())
    worse = " (worse)" if ours > 1.05 * plain else ""
    cells = [
        mode, case.axis, "1" if case.largest_ratio == 1 else f"1-{case.largest_ratio}",
        f"{plain:.4f}", f"{ours:.4f}{worse}", f"{outcome.rms_um(points[0]):.1f}",
        f"{outcome.rms_um(points[1]):.1f}", f"{plain / ours:.2f}",
        f"{(distance2 < 3.527).mean():.2f}", f"{(distance2 < 7.815).mean():.2f}",
        f"{100 * diameter:.2f}",
        f"{((off / bodies.sd_eq_mm) ** 2).mean():.2f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def speed(rng: np.random.Generator) -> str:
    """CPU time of 10,000 pairs."""
    cameras, case = rig(), Case((3, 0), "own", 1.6)
    rows = [outlines(case.draw(rng), cameras, rng) for _ in range(20)]
    tables = [pd.DataFrame([r[c] for r in rows] * 500).assign(flags="") for c in (0, 1)]
    spent = []
    for _ in range(5):
        begin = time.process_time()
        fitted_tables(tables, cameras)
        spent.append(time.process_time() - begin)
    return f"10,000 pairs: {min(spent):.2f} s of CPU time"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, default=200, help="per case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, default=2, choices=sorted(RIGS))
    parser.add_argument("--out", type=Path, help="write the table there as Markdown")
    options = parser.parse_args()
    lines = [HEADER]
    print(HEADER)
    for mode in [*MODES, None]:
        for place, (axis, ratio) in enumerate(PLACEMENTS):
            rng = np.random.default_rng([options.seed, *(mode or (0, 0)), place])
            case = Case(mode, axis, ratio)
            lines.append(row(case, run_case(case, options.bodies, rng, options.views)))
            print(lines[-1], flush=True)
    notes = [
        speed(np.random.default_rng(options.seed)),
        f"{options.bodies} bodies a case, seed {options.seed}",
    ]
    print("\n".join(notes))
    if options.out:
        text = ["# Centre of volume against the mean of the outlines", "", NOTES, "", *lines, ""]
        options.out.write_text("\n".join(text + [f"- {n}" for n in notes]) + "\n")


if __name__ == "__main__":
    main()
