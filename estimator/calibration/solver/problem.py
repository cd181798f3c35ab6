"""One description of a self-calibration problem, for every solver.

A `Problem` holds the measurements, what is known beforehand (priors, gauge), and which intrinsics
are free; `telerig.rig.lens_models` names the sets of free intrinsics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.factors.projection import Observations, State
from telerig.rig.camera import Camera
from telerig.rig.lens_models import parameters_of
from telerig.rig.pose import Pose
from telerig.rig.projection import INDEX, PARAMETERS
from telerig.rig.target import Target

GAUGE_SIGMA_MM = 1e-4
"""Holds the rig origin where the optical axes come closest; see docs/decisions/003."""

_CENTRE = ("centre_u_px", "centre_v_px")
_WALL = ("wall_x_rad", "wall_y_rad")

OUTLIER_SD = 4.5
"""A dot further than this many standard deviations is left out: 4e-5 of sound dots."""
LEAST_OUTLIER_SD = 3.0
"""Leaves out one sound dot in 90; nearer in, noise would be taken for outliers."""

SOLVERS = ("auto", "gtsam", "schur")
DOTS_FREE = ("3d", "plane", "nominal")

PRIOR_SIGMA = {
    "scale_px_per_mm": 0.5,  # relative
    "aspect": 0.1, "skew": 0.1, "kappa_per_mm": 0.5,  # kappa: per rho
    "k1": 0.5, "k2": 0.5, "k3": 0.5, "p1": 0.2, "p2": 0.2,
    "s1": 0.2, "s2": 0.2, "s3": 0.2, "s4": 0.2,
    "tilt_x": 0.3, "tilt_y": 0.3, "image_convergence_per_mm": 0.05,
    "centre_u_px": 0.05, "centre_v_px": 0.05,  # of the image width
    "wall_x_rad": 0.1, "wall_y_rad": 0.1,  # unless the wall says better
}  # fmt: skip
"""Weak priors: several times what any telecentric lens shows. They bound what data leave open."""


def checked_outlier_sd(outlier_sd: float) -> float:
    """Raises InputError for what is no number, or so small that sound dots would be left out."""
    if not LEAST_OUTLIER_SD <= outlier_sd < np.inf:
        raise InputError(
            f"dots beyond {outlier_sd:g} standard deviations cannot be told as outliers",
            todo=f"give {LEAST_OUTLIER_SD:g} or more; {OUTLIER_SD:g} is usual",
        )
    return outlier_sd


@dataclass(frozen=True)
class Problem:
    """Measurements, knowledge and freedom of one self-calibration.

    cameras : nominal cameras, the first defines the rig frame.
    views : names.  dot_ids : (N,) sorted ids.  nominal_mm : (N, 3).  dot_sigma_mm : (N, 3).
    covariance_px2 : (M, 2, 2) of each measured dot, weights not applied.
    weight : (M,) in [0, 1].
    free : per camera, names of the free intrinsics.
    scale : ((index, index), distance_mm, sigma_mm) or None.
    solver : "gtsam", "schur", or "auto" for the one that suits the size.
    outlier_sd : standard deviations beyond which a dot is left out.
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
        """The rows of positive weight, whitened with the square root of their weight."""
        keep = self.weight > 0
        whitener = whitening(self.covariance_px2[keep])
        whitener = whitener * np.sqrt(self.weight[keep])[:, None, None]
        return self._rows(keep, whitener)

    def unweighted(self) -> Observations:
        """Every row, whitened by its covariance alone."""
        whitener = whitening(self.covariance_px2)
        return self._rows(np.ones(len(self.view), bool), whitener)

    def _rows(self, keep: NDArray[np.bool_], whitener: Array) -> Observations:
        plate = (self.target.plate_thickness_mm, self.target.plate_index)
        return Observations(
            self.view[keep], self.camera[keep], self.dot[keep], self.uv_px[keep], whitener,
            self.plate_shift, plate, tuple(c.wall for c in self.cameras),
        )  # fmt: skip

    def with_model(self, model: str | Sequence[str]) -> Problem:
        """The same problem with another set of free intrinsics: one name for all, or per camera.

        Names are those of `telerig.rig.lens_models`. Raises CalibrationError for others.
        """
        names = [model] * len(self.cameras) if isinstance(model, str) else list(model)
        free = (
            ("scale_px_per_mm", *parameters_of(n), *wall_freedom(c))
            for n, c in zip(names, self.cameras)
        )
        return replace(self, free=tuple(free))

    def subset(self, rows: NDArray[np.bool_]) -> Problem:
        """Only some measurements; views, dots and priors stay."""
        parts = {
            name: getattr(self, name)[rows]
            for name in ("view", "camera", "dot", "uv_px", "covariance_px2", "weight")
        }
        return replace(self, **parts)

    def free_indices(self, camera: int) -> Ints:
        """Indices into `PARAMETERS` of one camera's free intrinsics."""
        return np.array([INDEX[p] for p in self.free[camera]], int)


def whitening(covariance: Array) -> Array:
    """(M, 2, 2) covariances -> the inverses of their lower Cholesky factors.

    Raises numpy.linalg.LinAlgError where one is not positive definite.
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
    """(20,) the change of each parameter that moves a pixel at the image corner by about 1 px."""
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
    """The wall's orientation where it is not known exactly."""
    return _WALL if camera.wall is not None and camera.wall.normal_sigma_rad > 0 else ()


def prior_sigma(camera: Camera) -> Array:
    """(20,) standard deviations of the weak priors, in the parameters' units."""
    sigma = np.array([PRIOR_SIGMA[p] for p in PARAMETERS])
    sigma[INDEX["scale_px_per_mm"]] *= camera["scale_px_per_mm"]
    sigma[INDEX["kappa_per_mm"]] /= camera.rho_mm
    for name in _CENTRE:
        sigma[INDEX[name]] *= camera.image_size_px[0]
    if wall_freedom(camera) and camera.wall is not None:
        sigma[[INDEX[name] for name in _WALL]] = camera.wall.normal_sigma_rad
    return sigma


def nominal_state(problem: Problem) -> State:
    """Nominal cameras, views at the origin, dots at their nominal places."""
    poses = np.array([matrix_from_camera(c) for c in problem.cameras])
    intrinsics = np.array([c.intrinsics for c in problem.cameras])
    views = np.tile(np.eye(4), (len(problem.views), 1, 1))
    return State(intrinsics, poses, views, problem.nominal_mm.copy())


def matrix_from_camera(camera: Camera) -> Array:
    """(4, 4) rig_from_camera."""
    pose, out = camera.rig_from_camera, np.eye(4)
    out[:3, :3], out[:3, 3] = pose.rotation, pose.translation_mm
    return out


def held_at_nominal(problem: Problem, state: State) -> State:
    """The state with every intrinsic that is not free put back to its nominal value."""
    intrinsics = np.array([c.intrinsics for c in problem.cameras])
    for c in range(len(problem.cameras)):
        free = problem.free_indices(c)
        intrinsics[c, free] = state.intrinsics[c, free]
    return replace(state, intrinsics=intrinsics)


def cameras_from_state(problem: Problem, state: State) -> tuple[Camera, ...]:
    """The estimated cameras."""
    return tuple(
        Camera(c.name, c.image_size_px, c.rho_mm, k, Pose(m[:3, :3], m[:3, 3]).inverse(), c.wall)
        for c, k, m in zip(problem.cameras, state.intrinsics, state.rig_from_camera)
    )
