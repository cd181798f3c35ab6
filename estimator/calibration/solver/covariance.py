"""Computes the joint covariance of a self-calibration; its first P parameters are the rig block of
`telerig.rig.triangulation`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.calibration.solver.problem import (
    Problem,
    System,
    images_of,
    parameter_unit,
    slots,
)
from telerig.estimator.calibration.solver.robust_least_squares import Solution
from telerig.estimator.calibration.solver.schur import Posterior
from telerig.rig.triangulation import POSE_COMPONENTS

FULL_COVARIANCE_UP_TO = 4000
"""Up to this number of parameters, the covariance of all parameters with all others is kept."""


@dataclass(frozen=True)
class JointCovariance:
    """The covariance of all parameters of a calibration with N dots and M used measurements.

    The first K parameters are those of cameras and views. Poses are in GTSAM's tangent space
    (rotation, translation) at ``rig_from_...``, with right perturbation.

    names : names of the D parameters in ``matrix``, for instance ``left.k1`` or ``view 03.rx_rad``.
    matrix : (D, D) covariance; if there are more than `FULL_COVARIANCE_UP_TO` parameters, only of
        cameras and views (D = K).
    dots : (N, 3, 3) covariance of each dot.
    cross : (K, N, 3) covariances of cameras and views with each dot.
    rig : number P of the cameras' parameters, which come first.
    leverage : (M, 2, 2) J C J^T of each used measurement, with J its derivatives and C the
        covariance of all parameters: the share of its noise that the fit absorbs.
    units : (K + 3 N,) size of each parameter's unit in the solver, in physical units.
    """

    names: tuple[str, ...]
    matrix: Array
    dots: Array
    cross: Array
    rig: int
    leverage: Array
    units: Array

    def of_rig_and(self, dots: Ints) -> Array:
        """Return the covariance (P + 3 n, P + 3 n) of the cameras' P parameters and n dots.

        dots : (n,) indices of the dots. If the full matrix was not computed, dots are taken as
        independent of each other for given cameras and views; this neglects a known distance of two
        dots.
        """
        common = len(self.cross)
        if len(self.names) > common:
            at = common + (3 * dots[:, None] + np.arange(3)).ravel()
            index = np.concatenate([np.arange(self.rig), at])
            return np.asarray(self.matrix[np.ix_(index, index)])
        known = np.isfinite(np.diag(self.matrix))
        sd = np.sqrt(np.diag(self.matrix)[known])
        correlation = self.matrix[np.ix_(known, known)] / np.outer(sd, sd)
        across = self.cross[:, dots].reshape(common, -1)
        scaled = across[known] / sd[:, None]
        own = (scaled.T @ np.linalg.solve(correlation, scaled)).reshape(len(dots), 3, -1, 3)
        own[np.arange(len(dots)), :, np.arange(len(dots))] = self.dots[dots]
        _, rig = self.rig_block()
        with_rig = across[: self.rig]
        return np.block([[rig, with_rig], [with_rig.T, own.reshape(3 * len(dots), -1)]])

    @property
    def effective_dof(self) -> float:
        """The expected sum of squared whitened residuals."""
        return degrees_of_freedom(self.leverage)

    def widened(self, offset: Array) -> JointCovariance:
        """Return the covariance with a further error added, which moves all parameters together.

        offset : (K + 3 N,) size of the error in the solver's units; offset offset^T is added.
        """
        shift = offset * self.units
        whole = shift[: len(self.matrix)]
        common, of_dots = shift[: len(self.cross)], shift[len(self.cross) :].reshape(-1, 3)
        return replace(
            self,
            matrix=self.matrix + np.outer(whole, whole),
            dots=self.dots + of_dots[:, :, None] * of_dots[:, None],
            cross=self.cross + common[:, None, None] * of_dots,
        )

    def rig_block(self) -> tuple[tuple[str, ...], Array]:
        """Return the names and the covariance (P, P) of the cameras' parameters."""
        return self.names[: self.rig], self.matrix[: self.rig, : self.rig]


def degrees_of_freedom(leverage: Array) -> float:
    """Return number of residuals - trace(J C J^T), the expected sum of their squares.

    leverage : (M, 2, 2) J C J^T of each used measurement.
    """
    return float(2 * len(leverage) - np.trace(leverage, axis1=-2, axis2=-1).sum())


def joint_covariance(
    problem: Problem, solution: Solution, *, leverage: Array | None = None
) -> JointCovariance:
    """Return the covariance of all parameters: the inverse of the information matrix.

    A parameter on which no measurement depends (the pose of a view that was left out) gets an
    infinite variance. Raises CalibrationError if the information matrix is singular.

    leverage : (M, 2, 2) of each used measurement if it is known; None computes it.
    """
    size = slots(problem)["dots"][0].stop
    posterior = solution.equations.posterior(whole=size <= FULL_COVARIANCE_UP_TO)
    matrix = posterior.common if posterior.whole is None else posterior.whole
    matrix = matrix.copy()
    untouched = posterior.untouched[: len(matrix)]
    matrix[untouched, untouched] = np.inf
    units = _units(problem, size)
    rig = sum(len(f) for f in problem.free) + 6 * (len(problem.cameras) - 1)
    if leverage is None:
        leverage = hat_matrix_blocks(problem, solution, posterior)
    names, within = _names(problem)[: len(matrix)], units[: len(matrix)]
    matrix *= within[:, None] * within
    cross = posterior.cross * units[: len(posterior.cross), None, None]
    return JointCovariance(names, matrix, posterior.dots, cross, rig, leverage, units)


def _units(problem: Problem, size: int) -> Array:
    units = np.ones(size)
    at = 0
    for c, camera in enumerate(problem.cameras):
        free = problem.free_indices(c)
        units[at : at + len(free)] = parameter_unit(camera)[free]
        at += len(free)
    return units


def _names(problem: Problem) -> tuple[str, ...]:
    names = [f"{c.name}.{p}" for c, free in zip(problem.cameras, problem.free) for p in free]
    names += [f"{c.name}.{p}" for c in problem.cameras[1:] for p in POSE_COMPONENTS]
    names += [f"view {v}.{p}" for v in problem.views for p in POSE_COMPONENTS]
    names += [f"dot {d}.{p}" for d in problem.dot_ids for p in ("x_mm", "y_mm", "z_mm")]
    return tuple(names)


def hat_matrix_blocks(problem: Problem, solution: Solution, posterior: Posterior) -> Array:
    """Return the leverage (M, 2, 2) of each used measurement.

    It is J C J^T, with J the derivatives of the measurement and C the covariance ``posterior``: the
    share of the measurement's noise that the fit absorbs.
    """
    system, out = System(problem), np.empty((int(np.sum(problem.kept)), 2, 2))
    for c, obs in enumerate(system.images):
        columns = system.columns(solution.state, c)[:-1].transpose(2, 1, 0)
        for view, first, last in images_of(obs):
            image, dot = columns[first:last], obs.dot[first:last]
            own, place = image[..., -3:], system.views_at + 6 * view
            index = np.r_[system.camera_places[c], place : place + 6]
            across = posterior.cross[index][:, dot].swapaxes(0, 1)
            mixed = image @ across @ np.swapaxes(own, -1, -2)
            alone = image @ posterior.common[np.ix_(index, index)] @ np.swapaxes(image, -1, -2)
            of_dots = own @ posterior.dots[dot] @ np.swapaxes(own, -1, -2)
            rows = system.rows[c][first:last]
            out[rows] = alone + mixed + np.swapaxes(mixed, -1, -2) + of_dots
    return out
