"""Computes the joint covariance of a self-calibration; its first P parameters are the rig block of
`telerig.rig.triangulation`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.calibration.solver.gaussian import Gaussian
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.system import (
    MANY_PARAMETERS,
    Solution,
    System,
    images_of,
)
from telerig.rig.triangulation import POSE_COMPONENTS


@dataclass(frozen=True)
class JointCovariance:
    """The covariance of all parameters of a calibration with N dots and M used measurements.

    The first K parameters are those of cameras and views. Poses are in GTSAM's tangent space
    (rotation, translation) at ``rig_from_...``, with right perturbation.

    names : names of the D parameters in ``matrix``, for instance ``left.k1`` or ``view 03.rx_rad``.
    matrix : (D, D) covariance; if there are more than `MANY_PARAMETERS` parameters, only of cameras
        and views (D = K).
    dots : (N, 3, 3) covariance of each dot.
    rig : number P of the cameras' parameters, which come first.
    leverage : (M, 2, 2) J C J^T of each used measurement, with J its derivatives and C the
        covariance of all parameters: the share of its noise that the fit absorbs.
    gaussian : that of which this is the inverse.
    offset : (K + 3 N, m) further errors, each of which moves all parameters together; ``matrix``
        and ``dots`` contain them.
    """

    names: tuple[str, ...]
    matrix: Array
    dots: Array
    rig: int
    leverage: Array
    gaussian: Gaussian
    offset: Array

    def of_rig_and(self, dots: Ints) -> Array:
        """Return the covariance (P + 3 n, P + 3 n) of the cameras' P parameters and n dots.

        dots : (n,) indices of the dots.
        """
        index = np.concatenate([np.arange(self.rig), self.gaussian.of_blocks[dots].ravel()])
        if index[-1] < len(self.matrix):
            return np.asarray(self.matrix[np.ix_(index, index)])
        offset = self.offset[index]
        return np.asarray(self.gaussian.marginal(index) + offset @ offset.T)

    @property
    def effective_dof(self) -> float:
        """The expected sum of squared whitened residuals: their number - trace(J C J^T)."""
        return float(2 * len(self.leverage) - np.trace(self.leverage, axis1=-2, axis2=-1).sum())

    def widened(self, offset: Array) -> JointCovariance:
        """Return the covariance with a further error ``offset`` (K + 3 N,) added."""
        whole = offset[: len(self.matrix)]
        of_dots = offset[self.gaussian.of_blocks]
        return replace(
            self,
            matrix=self.matrix + np.outer(whole, whole),
            dots=self.dots + of_dots[:, :, None] * of_dots[:, None],
            offset=np.column_stack([self.offset, offset]),
        )

    def rig_block(self) -> tuple[tuple[str, ...], Array]:
        """Return the names and the covariance (P, P) of the cameras' parameters."""
        return self.names[: self.rig], self.matrix[: self.rig, : self.rig]


def joint_covariance(
    problem: Problem, solution: Solution, *, leverage: Array | None = None, whole: bool = True
) -> JointCovariance:
    """Return the covariance of all parameters: the inverse of the information matrix.

    A parameter on which no measurement depends (the pose of a view that was left out) gets an
    infinite variance. Raises CalibrationError if the information matrix is singular.

    leverage : (M, 2, 2) of each used measurement if it is known; None computes it.
    whole : whether ``matrix`` contains the dots, unless there are too many.
    """
    gaussian = solution.gaussian
    untouched, size = gaussian.untouched, len(gaussian.right)
    common, cross, dots, every = gaussian.covariance(whole=whole and size <= MANY_PARAMETERS)
    if leverage is None:
        leverage = _leverage(problem, solution, common, cross, dots)
    matrix = common if every is None else every
    at = np.flatnonzero(untouched[: len(matrix)])
    matrix[at, at] = np.inf
    names = _names(problem)[: len(matrix)]
    rig = sum(len(f) for f in problem.free) + 6 * (len(problem.cameras) - 1)
    return JointCovariance(
        names, matrix, dots, rig, leverage, gaussian, np.zeros((len(gaussian.right), 0))
    )


def _names(problem: Problem) -> tuple[str, ...]:
    names = [f"{c.name}.{p}" for c, free in zip(problem.cameras, problem.free) for p in free]
    names += [f"{c.name}.{p}" for c in problem.cameras[1:] for p in POSE_COMPONENTS]
    names += [f"view {v}.{p}" for v in problem.views for p in POSE_COMPONENTS]
    names += [f"dot {d}.{p}" for d in problem.dot_ids for p in ("x_mm", "y_mm", "z_mm")]
    return tuple(names)


def _leverage(
    problem: Problem, solution: Solution, common: Array, cross: Array, dots: Array
) -> Array:
    """Return `JointCovariance.leverage` from the blocks of the covariance."""
    system, out = System(problem), np.empty((int(np.sum(problem.kept)), 2, 2))
    for c, obs in enumerate(system.images):
        columns = system.columns(solution.state, c)[:-1].transpose(2, 1, 0)
        for view, first, last in images_of(obs):
            image, dot = columns[first:last], obs.dot[first:last]
            own, place = image[..., -3:], system.views_at + 6 * view
            index = np.r_[system.camera_places[c], place : place + 6]
            mixed = image @ cross[index][:, dot].swapaxes(0, 1) @ np.swapaxes(own, -1, -2)
            alone = image @ common[np.ix_(index, index)] @ np.swapaxes(image, -1, -2)
            of_dots = own @ dots[dot] @ np.swapaxes(own, -1, -2)
            out[system.rows[c][first:last]] = alone + mixed + np.swapaxes(mixed, -1, -2) + of_dots
    return out
