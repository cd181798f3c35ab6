"""Defines a self-calibration problem.

A `Problem` holds the measurements, the prior knowledge, and which intrinsics are free;
`telerig.rig.lens_parameters` gives names to the sets of free intrinsics. `problem_from_dots` makes
one from a table of dots. `eccentricity_px` is what the measured centres are corrected by: the
centre of a dot's image is the image of the dot's centre only for an affine camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.thresholds import (
    IMPOSSIBLE_SD,
    LEAST_OUTLIER_SD,
    LINE_SHARE,
    OUTLIER_SD,
)
from telerig.factors.calibration import Observations, State, pixels
from telerig.io.images.read import natural
from telerig.io.tables.table import EDGE_COVARIANCE, covariance_of_image
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import INDEX, LENS_PARAMETERS, parameters_of
from telerig.rig.pose import Pose
from telerig.rig.target import Target

GAUGE_SIGMA_MM = 1e-4
"""Standard deviation with which the rig origin is held where the optical axes come closest
(docs/decisions/003)."""
LOOSE_GAUGE_MM = 1e6
"""The same where scales are held instead."""
HELD_MM = 1e-6
"""Standard deviation of a coordinate of a dot that is held."""
HELD_SCALE = 1e-7
"""Relative standard deviation of a scale that is held to fix the depth of a camera's origin."""

_WALL = ("wall_x_rad", "wall_y_rad")

DOTS_FREE = ("3d", "plane", "nominal")


def checked_outlier_sd(outlier_sd: float) -> float:
    """Check the limit beyond which a dot is an outlier, and return it unchanged.

    outlier_sd : limit of a residual, in its standard deviations.

    Raises InputError if it is not finite, or smaller than `LEAST_OUTLIER_SD`: many correct dots
    would be left out.
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
    """The measurements, priors and free parameters of one self-calibration.

    There are C cameras, V views, N dots and M measured dots. The first camera is the rig frame.

    nominal_mm, dot_sigma_mm : (N, 3) nominal position of each dot in the target's frame, and the
        prior standard deviations of the true one.
    view, camera, dot : (M,) indices of each measurement.
    uv_px : (M, 2) measured pixels: the centre of each dot's image.
    eccentricity_px : (M, 2) how far this lies from the image of the dot's centre; 0 before the lens
        is known. `observations` are ``uv_px`` less this.
    covariance_px2 : (M, 2, 2), without weights.
    weight : (M,) from 0 to 1.
    free : for each camera the names of its free intrinsics.
    scale : ((dot index, dot index), distance_mm, sigma_mm) of two dots whose distance is known;
        None if the nominal positions set the scale.
    plate_shift : (V, C) as in `Observations`.
    solver : what eliminates the dots: "gtsam", "numpy", or "auto" by their number.
    outlier_sd : number of standard deviations beyond which a dot is left out.
    hold_scales : if all lenses have perspective, whether their scales are held at nominal. Each
        camera's origin is then at the depth at which its scale is the nominal one, and not where
        the optical axes come closest.
    stretch : by how much the nominal places are stretched about their middle
        (`solver.print_stretch`).
    origin_camera : index of the camera whose optical axis fixes, with the first one's, the rig's
        origin (`known_target.origin_camera`).
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
    eccentricity_px: Array
    covariance_px2: Array
    weight: Array
    free: tuple[tuple[str, ...], ...]
    scale: tuple[tuple[int, int], float, float] | None
    plate_shift: Array
    solver: str = "auto"
    outlier_sd: float = OUTLIER_SD
    hold_scales: bool = False
    origin_camera: int = 1
    stretch: float = 0.0

    @property
    def middle_mm(self) -> Array:
        """The mean (3,) of the nominal positions, about which they are stretched."""
        return np.asarray(self.nominal_mm.mean(0))

    @property
    def stretched_mm(self) -> tuple[Array, Array]:
        """The nominal positions and their standard deviations (N, 3) on the stretched target."""
        middle, factor = self.middle_mm, 1 + self.stretch
        return middle + factor * (self.nominal_mm - middle), factor * self.dot_sigma_mm

    @property
    def scales_held(self) -> bool:
        """Whether the nominal scales fix the depths of the cameras' origins.

        Otherwise the point at which the optical axes come closest does.
        """
        return self.hold_scales and all("kappa_per_mm" in names for names in self.free)

    @property
    def gauge_sigma_mm(self) -> float:
        """The standard deviation that ties the origin to where the optical axes come closest."""
        return LOOSE_GAUGE_MM if self.scales_held else GAUGE_SIGMA_MM

    def prior_sigma(self, camera: int) -> Array:
        """Return the standard deviations (20,) of the priors of one camera's intrinsics."""
        sigma = prior_sigma(self.cameras[camera])
        if self.scales_held:
            scale = INDEX["scale_px_per_mm"]
            sigma[scale] = HELD_SCALE * self.cameras[camera].intrinsics[scale]
        return sigma

    @property
    def rho_mm(self) -> tuple[float, ...]:
        """Return half the image's diagonal of each camera in mm, the unit of its distortion."""
        return tuple(c.rho_mm for c in self.cameras)

    @property
    def kept(self) -> Bools:
        """Whether each measurement is used (M,), because its weight is positive."""
        return self.weight > 0

    def observations(self) -> Observations:
        """Return the measurements with a weight above 0.

        Their whitening matrices are multiplied by the square root of the weight.
        """
        keep = self.kept
        whitener = whitening(self.covariance_px2[keep])
        whitener = whitener * np.sqrt(self.weight[keep])[:, None, None]
        return self._rows(keep, whitener)

    def unweighted(self) -> Observations:
        """Return all measurements, whitened by their noise alone, without the robust weights."""
        whitener = whitening(self.covariance_px2)
        return self._rows(np.ones(len(self.view), bool), whitener)

    def _rows(self, keep: NDArray[np.bool_], whitener: Array) -> Observations:
        plate = (self.target.plate_thickness_mm, self.target.plate_index)
        return Observations(
            self.view[keep], self.camera[keep], self.dot[keep],
            self.uv_px[keep] - self.eccentricity_px[keep], whitener, self.plate_shift, plate,
            tuple(c.wall for c in self.cameras),
        )  # fmt: skip

    def with_model(self, model: str | Sequence[str]) -> Problem:
        """Return the problem with the free intrinsics of a lens model.

        model : its name for all cameras, or one name for each camera.
        """
        names = [model] * len(self.cameras) if isinstance(model, str) else list(model)
        free = (
            ("scale_px_per_mm", *parameters_of(n), *wall_freedom(c))
            for n, c in zip(names, self.cameras)
        )
        return replace(self, free=tuple(free))

    def subset(self, rows: NDArray[np.bool_]) -> Problem:
        """Return the problem with only some of the measurements; views, dots and priors stay."""
        names = ("view", "camera", "dot", "uv_px", "eccentricity_px", "covariance_px2", "weight")
        parts = {name: getattr(self, name)[rows] for name in names}
        return replace(self, **parts)

    def renumbered(self, ids: Ints) -> Problem:
        """Return the problem with other ids (M,) of its measured dots, and no known distance."""
        dot_ids = np.unique(ids)
        return replace(
            self,
            dot_ids=dot_ids,
            nominal_mm=self.target.nominal_mm(dot_ids),
            dot_sigma_mm=np.tile(self.dot_sigma_mm[0], (len(dot_ids), 1)),
            dot=np.searchsorted(dot_ids, ids),
            scale=None,
        )

    def free_indices(self, camera: int) -> Ints:
        """Return the indices into `PARAMETERS` of one camera's free intrinsics."""
        return np.array([INDEX[p] for p in self.free[camera]], int)


def whitening(covariance: Array) -> Array:
    """Return whitening matrices W (M, 2, 2) with W^T W = inverse of the covariance (M, 2, 2).

    W is the inverse of the lower Cholesky factor.
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
    """Return for each intrinsic (20,) the change that moves a pixel at the image corner by about
    1 px."""
    return np.array([p.step(camera.scales) for p in LENS_PARAMETERS.values()])


def wall_freedom(camera: Camera) -> tuple[str, ...]:
    """Return the names of the two parameters that turn the normal of a camera's window.

    Returns () if there is no window or if its normal is stated as exact.
    """
    return _WALL if camera.wall is not None and camera.wall.normal_sigma_rad > 0 else ()


def prior_sigma(camera: Camera) -> Array:
    """Return the standard deviations (20,) of the weak priors, in the units of the parameters."""
    sigma = np.array([p.prior_sd(camera.scales) for p in LENS_PARAMETERS.values()])
    if wall_freedom(camera) and camera.wall is not None:
        sigma[[INDEX[name] for name in _WALL]] = camera.wall.normal_sigma_rad
    return sigma


def nominal_state(problem: Problem) -> State:
    """Return the state of nominal cameras and dots, with the target at the origin in every view."""
    poses = np.array([c.rig_from_camera.matrix for c in problem.cameras])
    intrinsics = np.array([c.intrinsics for c in problem.cameras])
    views = np.tile(np.eye(4), (len(problem.views), 1, 1))
    return State(intrinsics, poses, views, problem.nominal_mm.copy())


def held_at_nominal(problem: Problem, state: State) -> State:
    """Return the state in which every intrinsic that is not free has its nominal value."""
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


def problem_from_dots(dots: pd.DataFrame, cameras: Sequence[Camera], target: Target) -> Problem:
    """Return a `Problem` with every measured dot, in which only the scales of the cameras are free.

    dots : table with the columns view, camera, dot, u_px, v_px, suu_px2, suv_px2, svv_px2. What a
    rough edge adds to the covariance (edge_suu_px2, ...) is the same in all images of a dot: it is
    an error of the dot's place in the plane, as one of the print. Raises
    InputError for values or covariances that are impossible, unknown cameras or dots, and repeated
    rows; CalibrationError for no dots, and for a scale that is never seen or contradicts the
    nominal positions.
    """
    if len(dots) == 0:
        raise CalibrationError(
            "no dots in any image", todo="run `telerig detect` to see why none is found"
        )
    names = [c.name for c in cameras]
    _check(dots, names, target)
    table = dots.sort_values(["view", "camera", "dot"])
    views = tuple(sorted(table["view"].astype(str).unique(), key=natural))
    ids = np.unique(table["dot"].to_numpy(np.int64))
    camera = _index(table["camera"], names)
    view = _index(table["view"].astype(str), views)
    order = np.lexsort((table["dot"].to_numpy(), camera, view))
    table = table.iloc[order]
    covariance = covariance_of_image(table)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    sigma = [target.print_sigma_mm, target.print_sigma_mm, target.flatness_sigma_mm]
    if set(EDGE_COVARIANCE) <= set(table):
        parts = table[list(EDGE_COVARIANCE)].fillna(0.0).to_numpy(float)
        edge = parts[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        px_per_mm = np.array([c["scale_px_per_mm"] for c in cameras])[camera[order]]
        edge_mm = np.sqrt(np.linalg.eigvalsh(edge)[:, 1]) / px_per_mm
        sigma[:2] = 2 * [float(np.hypot(target.print_sigma_mm, np.median(edge_mm)))]
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
        eccentricity_px=np.zeros((len(table), 2)),
        covariance_px2=covariance,
        weight=np.ones(len(table)),
        free=tuple(("scale_px_per_mm",) for _ in cameras),
        scale=known_scale(target, ids),
        plate_shift=np.zeros((len(views), len(cameras))),
    )


def _index(column: pd.Series[str], names: Sequence[str]) -> NDArray[np.int64]:
    numbers = column.map({name: i for i, name in enumerate(names)})
    return np.asarray(numbers, dtype=np.int64)


def _check(table: pd.DataFrame, names: Sequence[str], target: Target) -> None:
    """Raise InputError if some rows cannot be used; the error names the first of them."""
    columns = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]
    uu, uv, vv = covariance_of_image(table).T
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


def known_scale(
    target: Target, ids: NDArray[np.int64]
) -> tuple[tuple[int, int], float, float] | None:
    """Return `Problem.scale` for the dots with some ids (N,), ascending.

    Raises CalibrationError if one of the two dots is not among them, or if the stated distance
    contradicts the nominal positions.
    """
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
    """Raise CalibrationError if the stated distance contradicts the nominal positions."""
    assert target.scale_dots is not None and target.scale_distance_mm is not None
    ends = target.nominal_mm(np.array(target.scale_dots))
    nominal = float(np.linalg.norm(ends[1] - ends[0]))
    tolerance = IMPOSSIBLE_SD * np.hypot(np.sqrt(2) * target.print_sigma_mm, target.scale_sigma_mm)
    if abs(nominal - target.scale_distance_mm) > tolerance:
        raise CalibrationError(
            f"the distance of dots {target.scale_dots} is {target.scale_distance_mm:g} mm, good to "
            f"{target.scale_sigma_mm:g} mm, but "
            f"their nominal places are {nominal:.4g} mm apart and good to "
            f"{target.print_sigma_mm:g} mm each",
            where="rig.toml [target]",
            todo="correct scale_distance_mm (the measured distance), scale_dots (the two dots that "
            "it joins) or the pitch, or raise print_sigma_mm (accuracy of the print)",
        )


def eccentricity_px(problem: Problem, state: State, rings: int = 2, spokes: int = 8) -> Array:
    """Return how far the centre of each measured dot's image lies from the image of its centre.

    A dot is a disc, and the centre of area of its image differs from the projection of its centre.
    Returns this difference (M, 2) in px. Each disc is sampled at ``rings`` radii (Gauss-Legendre
    points in r^2) and ``spokes`` equal angles, weighted by the area that a sample covers in the
    image.
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


def on_a_line(points_mm: Array) -> bool:
    """Return whether points (n, 2) lie on one line, so that they do not determine a pose."""
    length, width = np.linalg.svd(points_mm - points_mm.mean(0), compute_uv=False)
    return bool(width < LINE_SHARE * length)
