"""Defines the description of a self-calibration problem that all solvers share.

A `Problem` holds the measurements, the prior knowledge, and which intrinsics are free;
`telerig.rig.lens_models` gives names to the sets of free intrinsics. `problem_from_dots` makes one
from a table of dots. `eccentricity_px` is what the measured centres are corrected by: the centre of
a dot's image is the image of the dot's centre only for an affine camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError, InputError
from telerig.factors.calibration import Observations, State, pixels
from telerig.rig.camera import Camera
from telerig.rig.lens_models import parameters_of
from telerig.rig.pose import Pose
from telerig.rig.projection import INDEX, PARAMETERS
from telerig.rig.target import Target

GAUGE_SIGMA_MM = 1e-4
"""Standard deviation with which the rig origin is held where the optical axes come closest
(docs/decisions/003)."""

_CENTRE = ("centre_u_px", "centre_v_px")
_WALL = ("wall_x_rad", "wall_y_rad")

OUTLIER_SD = 4.5
"""A dot farther than this many standard deviations from its prediction is left out, with Gaussian
noise 4e-5 of all correct dots."""
LEAST_OUTLIER_SD = 3.0
"""The smallest limit that is accepted. It leaves out one correct dot in 90; with a lower limit too
much ordinary noise would be taken for outliers."""

SOLVERS = ("auto", "gtsam", "schur")
DOTS_FREE = ("3d", "plane", "nominal")

PRIOR_SIGMA = {
    "scale_px_per_mm": 0.5,  # relative to the nominal scale
    "aspect": 0.1, "skew": 0.1, "kappa_per_mm": 0.5,  # kappa in units of 1 / rho
    "k1": 0.5, "k2": 0.5, "k3": 0.5, "p1": 0.2, "p2": 0.2,
    "s1": 0.2, "s2": 0.2, "s3": 0.2, "s4": 0.2,
    "tilt_x": 0.3, "tilt_y": 0.3, "image_convergence_per_mm": 0.05,
    "centre_u_px": 0.05, "centre_v_px": 0.05,  # relative to the image width
    "wall_x_rad": 0.1, "wall_y_rad": 0.1,  # unless the window states its own
}  # fmt: skip
"""Standard deviations of weak priors, several times the values of usual telecentric lenses. They
only bound parameters that the data do not determine."""


def checked_outlier_sd(outlier_sd: float) -> float:
    """Return ``outlier_sd`` unchanged after a check.

    Raises InputError if it is not finite, or so small that correct dots would be left out.
    """
    if not LEAST_OUTLIER_SD <= outlier_sd < np.inf:
        raise InputError(
            f"dots beyond {outlier_sd:g} standard deviations cannot be distinguished from "
            "correct ones",
            todo=f"give {LEAST_OUTLIER_SD:g} or more; {OUTLIER_SD:g} is usual",
        )
    return outlier_sd


@dataclass(frozen=True)
class Problem:
    """Holds the measurements, priors and free parameters of one self-calibration.

    There are C cameras, V views, N dots and M measured dots.

    cameras : the nominal cameras; the first one defines the rig frame.
    views : names of the views.
    dot_ids : (N,) ids of the dots, sorted.
    nominal_mm, dot_sigma_mm : (N, 3) nominal position of each dot, and the standard deviations of
        the true position from it.
    view, camera, dot : (M,) indices of each measurement.
    uv_px : (M, 2).
    covariance_px2 : (M, 2, 2) of each measurement, without weights.
    weight : (M,) weights from 0 to 1.
    free : for each camera the names of its free intrinsics.
    scale : ((dot index, dot index), distance_mm, sigma_mm) of two dots whose distance is known;
        None if the nominal positions set the scale.
    plate_shift : (V, C) as in `Observations`.
    solver : "gtsam", "schur", or "auto" for the one that suits the size of the problem.
    outlier_sd : number of standard deviations beyond which a dot is left out.
    """

    cameras: tuple[Camera, ...]
    target: Target
    views: tuple[str, ...]
    dot_ids: Ints
    nominal_mm: Array
    dot_sigma_mm: Array
    view: Ints
    camera: Ints
    dot: Ints
    uv_px: Array
    covariance_px2: Array
    weight: Array
    free: tuple[tuple[str, ...], ...]
    scale: tuple[tuple[int, int], float, float] | None
    plate_shift: Array
    solver: str = "auto"
    outlier_sd: float = OUTLIER_SD

    @property
    def rho_mm(self) -> tuple[float, ...]:
        return tuple(c.rho_mm for c in self.cameras)

    def observations(self) -> Observations:
        """Return the measurements of positive weight, whitened with the square root of their
        weight.
        """
        keep = self.weight > 0
        whitener = whitening(self.covariance_px2[keep])
        whitener = whitener * np.sqrt(self.weight[keep])[:, None, None]
        return self._rows(keep, whitener)

    def unweighted(self) -> Observations:
        """Return all measurements, whitened by their covariance alone."""
        whitener = whitening(self.covariance_px2)
        return self._rows(np.ones(len(self.view), bool), whitener)

    def _rows(self, keep: NDArray[np.bool_], whitener: Array) -> Observations:
        plate = (self.target.plate_thickness_mm, self.target.plate_index)
        return Observations(
            self.view[keep], self.camera[keep], self.dot[keep], self.uv_px[keep], whitener,
            self.plate_shift, plate, tuple(c.wall for c in self.cameras),
        )  # fmt: skip

    def with_model(self, model: str | Sequence[str]) -> Problem:
        """Return the same problem with other free intrinsics.

        model : the name of a model for all cameras, or one name for each; see
            `telerig.rig.lens_models`.

        Raises CalibrationError for an unknown name.
        """
        names = [model] * len(self.cameras) if isinstance(model, str) else list(model)
        free = (
            ("scale_px_per_mm", *parameters_of(n), *wall_freedom(c))
            for n, c in zip(names, self.cameras)
        )
        return replace(self, free=tuple(free))

    def subset(self, rows: NDArray[np.bool_]) -> Problem:
        """Return the problem with only some of the measurements; views, dots and priors stay."""
        parts = {
            name: getattr(self, name)[rows]
            for name in ("view", "camera", "dot", "uv_px", "covariance_px2", "weight")
        }
        return replace(self, **parts)

    def free_indices(self, camera: int) -> Ints:
        """Return the indices into `PARAMETERS` of one camera's free intrinsics."""
        return np.array([INDEX[p] for p in self.free[camera]], int)


def whitening(covariance: Array) -> Array:
    """Return the inverses of the lower Cholesky factors of covariances, both (M, 2, 2).

    Raises numpy.linalg.LinAlgError if a covariance is not positive definite.
    """
    first, second, mixed = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 1, 0]
    rest = second * first - mixed * mixed
    if not (np.all(first > 0) and np.all(rest > 0)):
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    out = np.zeros_like(covariance)
    out[:, 0, 0] = 1 / np.sqrt(first)
    out[:, 1, 1] = np.sqrt(first / rest)
    out[:, 1, 0] = -mixed / first * out[:, 1, 1]
    return out


def parameter_unit(camera: Camera) -> Array:
    """Return for each parameter (20,) the change that moves a pixel at the image corner by about 1
    px.
    """
    scale, rho = camera["scale_px_per_mm"], camera.rho_mm
    corner_px = scale * rho
    unit = np.full(len(PARAMETERS), 1 / corner_px)
    unit[INDEX["scale_px_per_mm"]] = scale / corner_px
    unit[INDEX["centre_u_px"]] = unit[INDEX["centre_v_px"]] = 1.0
    unit[INDEX["kappa_per_mm"]] = 1 / corner_px / rho
    unit[INDEX["image_convergence_per_mm"]] = 10 / corner_px / rho
    unit[[INDEX[name] for name in _WALL]] = 4 / corner_px
    return unit


def wall_freedom(camera: Camera) -> tuple[str, ...]:
    """Return the names of the parameters that turn the window's normal, () if the normal is
    exact."""
    return _WALL if camera.wall is not None and camera.wall.normal_sigma_rad > 0 else ()


def prior_sigma(camera: Camera) -> Array:
    """Return the standard deviations (20,) of the weak priors, in the units of the parameters."""
    sigma = np.array([PRIOR_SIGMA[p] for p in PARAMETERS])
    sigma[INDEX["scale_px_per_mm"]] *= camera["scale_px_per_mm"]
    sigma[INDEX["kappa_per_mm"]] /= camera.rho_mm
    for name in _CENTRE:
        sigma[INDEX[name]] *= camera.image_size_px[0]
    if wall_freedom(camera) and camera.wall is not None:
        sigma[[INDEX[name] for name in _WALL]] = camera.wall.normal_sigma_rad
    return sigma


def nominal_state(problem: Problem) -> State:
    """Return the state with nominal cameras and dots, and with the target of every view at the
    origin.
    """
    poses = np.array([matrix_from_camera(c) for c in problem.cameras])
    intrinsics = np.array([c.intrinsics for c in problem.cameras])
    views = np.tile(np.eye(4), (len(problem.views), 1, 1))
    return State(intrinsics, poses, views, problem.nominal_mm.copy())


def matrix_from_camera(camera: Camera) -> Array:
    """Return rig_from_camera as a matrix (4, 4)."""
    pose, out = camera.rig_from_camera, np.eye(4)
    out[:3, :3], out[:3, 3] = pose.rotation, pose.translation_mm
    return out


def held_at_nominal(problem: Problem, state: State) -> State:
    """Return the state with every intrinsic that is not free set to its nominal value."""
    intrinsics = np.array([c.intrinsics for c in problem.cameras])
    for c in range(len(problem.cameras)):
        free = problem.free_indices(c)
        intrinsics[c, free] = state.intrinsics[c, free]
    return replace(state, intrinsics=intrinsics)


def cameras_from_state(problem: Problem, state: State) -> tuple[Camera, ...]:
    """Return the estimated cameras."""
    return tuple(
        Camera(c.name, c.image_size_px, c.rho_mm, k, Pose(m[:3, :3], m[:3, 3]).inverse(), c.wall)
        for c, k, m in zip(problem.cameras, state.intrinsics, state.rig_from_camera)
    )


IMPOSSIBLE_SD = 20.0


def problem_from_dots(dots: pd.DataFrame, cameras: Sequence[Camera], target: Target) -> Problem:
    """Return a `Problem` with every measured dot, in which only the scales of the cameras are free.

    dots : table with the columns view, camera, dot, u_px, v_px, suu_px2, suv_px2, svv_px2.

    Raises InputError for values that are not finite, covariances that are not positive definite,
    cameras or dots that the rig does not have, and rows given twice. Raises CalibrationError if
    there are no dots, if the dots that set the scale are never seen, or if their distance
    contradicts their nominal positions.
    """
    if len(dots) == 0:
        raise CalibrationError(
            "no dots in any image", todo="run `telerig detect` to see why none is found"
        )
    names = [c.name for c in cameras]
    _check(dots, names, target)
    table = dots.sort_values(["view", "camera", "dot"])
    views = tuple(sorted(table["view"].astype(str).unique(), key=_natural))
    ids = np.unique(table["dot"].to_numpy(np.int64))
    camera = _index(table["camera"], names)
    view = _index(table["view"].astype(str), views)
    order = np.lexsort((table["dot"].to_numpy(), camera, view))
    table = table.iloc[order]
    covariance = np.empty((len(table), 2, 2))
    covariance[:, 0, 0] = table["suu_px2"]
    covariance[:, 1, 1] = table["svv_px2"]
    covariance[:, 0, 1] = covariance[:, 1, 0] = table["suv_px2"]
    sigma = [target.print_sigma_mm, target.print_sigma_mm, target.flatness_sigma_mm]
    return Problem(
        cameras=tuple(cameras),
        target=target,
        views=views,
        dot_ids=ids,
        nominal_mm=target.nominal_mm(ids),
        dot_sigma_mm=np.tile(sigma, (len(ids), 1)),
        view=view[order],
        camera=camera[order],
        dot=np.searchsorted(ids, table["dot"].to_numpy(np.int64)),
        uv_px=table[["u_px", "v_px"]].to_numpy(float),
        covariance_px2=covariance,
        weight=np.ones(len(table)),
        free=tuple(("scale_px_per_mm",) for _ in cameras),
        scale=_scale(target, ids),
        plate_shift=np.zeros((len(views), len(cameras))),
    )


def _index(column: pd.Series[str], names: Sequence[str]) -> NDArray[np.int64]:
    numbers = column.map({name: i for i, name in enumerate(names)})
    return np.asarray(numbers, dtype=np.int64)


def _natural(name: str) -> tuple[int, float, str]:
    return (0, float(name), name) if name.isdigit() else (1, 0.0, name)


def _check(table: pd.DataFrame, names: Sequence[str], target: Target) -> None:
    """Raise InputError if some rows cannot be used; the error names the first of them."""
    columns = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]
    uu, uv, vv = (table[name].to_numpy(float) for name in columns[2:])
    finite = np.isfinite(table[columns].to_numpy(float)).all(1)
    known = ", ".join(repr(n) for n in names)
    faults = {
        "are not finite": (~finite, "remove these rows or measure the dots again"),
        "have no positive definite covariance": (
            finite & ~((uu > 0) & (vv > 0) & (uu * vv > uv**2)),
            "give the standard deviation of each dot's centre",
        ),
        "are of a camera that the rig does not have": (
            ~table["camera"].isin(list(names)).to_numpy(), f"the rig has {known}",
        ),
        "have an id that the target does not have": (
            ~target.known_id(table["dot"]), "compare the target in rig.toml with the table",
        ),
        "are given twice": (
            table.duplicated(["view", "camera", "dot"]).to_numpy(), "keep one of the two rows",
        ),
    }  # fmt: skip
    for what, (bad, todo) in faults.items():
        if bad.any():
            row = table[bad].iloc[0]
            raise InputError(
                f"{int(bad.sum())} of {len(table)} dots {what}",
                where=f"view {row['view']}, camera {row['camera']}, dot {row['dot']}",
                todo=todo,
            )


def _scale(target: Target, ids: NDArray[np.int64]) -> tuple[tuple[int, int], float, float] | None:
    if target.scale_dots is None or target.scale_distance_mm is None:
        return None
    missing = [d for d in target.scale_dots if d not in ids]
    if missing:
        raise CalibrationError(
            f"dot(s) {missing}, whose distance sets the scale, are in no image",
            where="rig.toml [target] scale_dots",
            todo="name two dots that are seen, or leave scale_dots out to trust the nominal pitch",
        )
    _check_distance(target)
    a, b = (int(np.searchsorted(ids, d)) for d in target.scale_dots)
    return (a, b), float(target.scale_distance_mm), float(target.scale_sigma_mm)


def _check_distance(target: Target) -> None:
    """Raise CalibrationError if the stated distance is impossible, given the nominal positions and
    their tolerance."""
    assert target.scale_dots is not None and target.scale_distance_mm is not None
    ends = target.nominal_mm(np.array(target.scale_dots))
    nominal = float(np.linalg.norm(ends[1] - ends[0]))
    tolerance = IMPOSSIBLE_SD * np.sqrt(2) * target.print_sigma_mm
    if abs(nominal - target.scale_distance_mm) > tolerance:
        raise CalibrationError(
            f"the distance of dots {target.scale_dots} is {target.scale_distance_mm:g} mm, but "
            f"their nominal places are {nominal:.4g} mm apart and good to "
            f"{target.print_sigma_mm:g} mm each",
            where="rig.toml [target]",
            todo="correct scale_distance_mm, scale_dots or the pitch, or raise print_sigma_mm",
        )


def eccentricity_px(problem: Problem, state: State, rings: int = 2, spokes: int = 8) -> Array:
    """Return the centre of area of each projected disc minus the projection of its centre (M, 2),
    in px.

    The result has one row for each of the M measured dots. Each disc is sampled at ``rings`` radii
    (Gauss-Legendre points in r^2) and ``spokes`` equal angles. Each sample is weighted by the area
    that it covers in the image.
    """
    obs = problem.unweighted()
    radius = problem.target.diameter_mm(problem.dot_ids) / 2
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    centre = pixels(state, obs, problem.rho_mm)
    top, area = np.zeros_like(centre), np.zeros(len(centre))
    step = 1e-3 * float(radius.min())
    for node, weight in zip((nodes + 1) / 2, weights / 2):
        for angle in 2 * np.pi * np.arange(spokes) / spokes:
            reach = np.sqrt(node) * np.array([np.cos(angle), np.sin(angle), 0.0])
            moved = [
                pixels(_shifted(state, radius[:, None] * reach + extra), obs, problem.rho_mm)
                for extra in (np.zeros(3), [step, 0, 0], [0, step, 0])
            ]
            along = np.stack([moved[1] - moved[0], moved[2] - moved[0]], -1)
            piece = weight * np.abs(np.linalg.det(along)) / step**2
            top += piece[:, None] * (moved[0] - centre)
            area += piece
    return np.asarray(top / area[:, None])


def _shifted(state: State, shift_mm: Array) -> State:
    return replace(state, dots_mm=state.dots_mm + shift_mm)
