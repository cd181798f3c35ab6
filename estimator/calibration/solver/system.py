"""Computes the whitened residuals of a problem at any state, and the Gaussian of a state.

All residuals and derivatives are those of `factors.calibration`. They are summed over a few
thousand dots at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.calibration.solver.gaussian import Gaussian
from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.calibration import (
    Observations,
    State,
    depth_gauge_residual,
    distance_residual,
    dot_columns,
    image_columns,
    place_residual,
)
from telerig.io.machine.parallel import keep_freed_memory
from telerig.rig.pose import rotation_from_rotvec

MANY_DOTS = 5000
"""With more measured dots than this, NumPy eliminates the dots instead of GTSAM
(docs/decisions/020)."""
MANY_PARAMETERS = 4000
"""With more parameters of views and dots than this, NumPy eliminates, too, and the covariance of
all of them with all others is not kept: it would be too large."""
CHUNK = 4000
"""Approximate number of measured dots that are evaluated at once. With fewer, the function calls
take more time; with more, the arrays do not fit into the processor's cache."""


@dataclass(frozen=True)
class Priors:
    """Whitened residuals of all priors, and their derivatives.

    cameras : for each camera the residuals (r,) of the weak priors and of the depth gauge, and
        their derivatives (r, S) with respect to its S parameters: the free intrinsics and, except
        for the first camera, the pose.
    views : the residuals (V, 3) of the weak priors on the target's position in each view, and their
        derivatives (V, 3, 6) with respect to its pose.
    dots : the residuals (N, 3) of the dots' nominal positions, and the diagonal (N, 3) of their
        derivatives.
    distance : for a known distance the indices of the two dots, the residual, and its derivative
        (3,) with respect to the first dot; None if no distance is known.
    """

    cameras: list[tuple[Array, Array]]
    views: tuple[Array, Array]
    dots: tuple[Array, Array]
    distance: tuple[tuple[int, int], float, Array] | None

    @property
    def squared(self) -> float:
        """The sum of all squared residuals."""
        parts = [*(value for value, _ in self.cameras), self.views[0], self.dots[0]]
        far = self.distance[1] ** 2 if self.distance is not None else 0.0
        return float(sum(np.vdot(part, part) for part in parts)) + far


class System:
    """Computes the residuals of a problem, and their Gaussian, as functions of the state.

    images : for each camera its measurements, sorted by view and dot.
    rows : for each camera the indices of these measurements in `Problem.observations`.
    camera_places : for each camera the indices of its S parameters among all D parameters.
    views_at, dots_at : index of the first parameter of the views and of the dots.
    size : D.
    alone : (view, camera) for each view that one camera alone sees.
    """

    def __init__(self, problem: Problem) -> None:
        keep_freed_memory()
        self.problem = problem
        self.place_sigma_mm = 10 * max(problem.rho_mm)
        cameras = range(len(problem.cameras))
        self.free = [problem.free_indices(c) for c in cameras]
        self.sigma = [problem.prior_sigma(c)[f] for c, f in enumerate(self.free)]
        place = slots(problem)
        every = np.arange(place["dots"][0].stop)
        self.camera_places = [
            np.r_[every[place["intrinsics"][c]], every[place["camera"][c]]] for c in cameras
        ]
        self.views_at = place["view"][0].start if problem.views else place["dots"][0].start
        self.dots_at, self.size = place["dots"][0].start, place["dots"][0].stop
        observations = problem.observations()
        self.rows = [np.flatnonzero(observations.camera == c) for c in cameras]
        self.rows = [
            rows[np.lexsort((observations.dot[rows], observations.view[rows]))]
            for rows in self.rows
        ]
        self.images = [_components_first(observations.subset(rows)) for rows in self.rows]
        seen = np.array(
            [np.bincount(obs.view, minlength=len(problem.views)) for obs in self.images]
        )
        alone = np.flatnonzero((seen > 0).sum(0) == 1)
        self.alone = [(int(view), int(np.argmax(seen[:, view]))) for view in alone]

    def columns(self, state: State, camera: int, rows: slice = slice(None)) -> Array:
        """Return the whitened residuals of a camera and their derivatives: `image_columns`.

        They are (S + 7, 2, M) for M measurements.
        rows : which of the camera's measurements are used.
        """
        obs = self.images[camera].subset(rows)
        rho_mm, free = self.problem.rho_mm[camera], self.free[camera].tolist()
        return image_columns(state, obs, camera, rho_mm, free)

    def priors(self, state: State) -> Priors:
        """Return the residuals of all priors, and their derivatives."""
        problem, cameras = self.problem, []
        for c, nominal in enumerate(problem.cameras):
            free, sigma = self.free[c], self.sigma[c]
            value = (state.intrinsics[c] - nominal.intrinsics)[free] / sigma
            jacobian = np.diag(1 / sigma)
            if c:
                # only one camera fixes the origin along the axis of the first camera
                gauge, by_pose = depth_gauge_residual(
                    state.rig_from_camera[c], problem.gauge_sigma_mm
                )
                first = 0 if c == problem.origin_camera else 1
                value = np.concatenate([value, gauge[first:]])
                whole = np.zeros((len(value), len(free) + 6))
                whole[: len(free), : len(free)] = jacobian
                whole[len(free) :, len(free) :] = by_pose[first:]
                jacobian = whole
            cameras.append((value, jacobian))
        views = place_residual(state.rig_from_target, self.place_sigma_mm)
        expected, sigma = problem.stretched_mm
        dots = (state.dots_mm - expected) / sigma, 1 / sigma
        distance = None
        if problem.scale is not None:
            (a, b), length, sd = problem.scale
            off, by_first = distance_residual(state.dots_mm[a], state.dots_mm[b], length, sd)
            distance = (a, b), float(off), by_first
        return Priors(cameras, views, dots, distance)

    def moved(self, state: State, step: Array) -> State:
        """Return the state after a step of all D parameters.

        step : (D,). A pose (R, t) becomes (R exp(w), t + R v) for the step (w, v).
        """
        intrinsics, cameras = state.intrinsics.copy(), state.rig_from_camera.copy()
        for c, (free, places) in enumerate(zip(self.free, self.camera_places)):
            intrinsics[c, free] += step[places[: len(free)]]
            if c:
                cameras[c] = retracted(cameras[c], step[places[len(free) :]])
        of_views = step[self.views_at : self.dots_at].reshape(-1, 6)
        return replace(
            state,
            intrinsics=intrinsics,
            rig_from_camera=cameras,
            rig_from_target=retracted(state.rig_from_target, of_views),
            dots_mm=state.dots_mm + step[self.dots_at :].reshape(-1, 3),
        )

    def gaussian(self, state: State) -> Gaussian:
        """Return the Gaussian of all D parameters, linearised at a state."""
        sums, problem = _Sums(self, state), self.problem
        for camera in range(len(self.images)):
            sums.add_images(state, camera)
        priors = self.priors(state)
        for at, (value, jacobian) in zip(self.camera_places, priors.cameras):
            sums.add(at, jacobian, value)
        for view, (at, value, jacobian) in enumerate(zip(sums.views, *priors.views)):
            if view in sums.turn:
                jacobian[:, 3:] = jacobian[:, 3:] @ sums.turn[view]
            sums.add(at, jacobian, value)
        value, weight = priors.dots
        sums.dots[range(3), range(3)] += weight.T**2
        sums.of_dots -= weight * value
        distance = None
        if priors.distance is not None:
            pair, off, by_first = priors.distance
            sums.of_dots[list(pair)] -= off * np.array([by_first, -by_first])
            distance = pair, by_first
        by_gtsam = problem.solver == "gtsam" or (
            problem.solver == "auto"
            and len(problem.view) <= MANY_DOTS
            and self.size - self.views_at <= MANY_PARAMETERS
        )
        return Gaussian(
            sums.common, sums.cross, sums.dots.transpose(2, 0, 1), sums.right,
            0.5 * (sums.squared + priors.squared), self.views_at, distance, by_gtsam,
            [(sums.views[view, 3:], axes) for view, axes in sums.turn.items()],
        )  # fmt: skip


@dataclass(frozen=True)
class Solution:
    """The result of a least-squares solution.

    state : the minimum.
    gaussian : the Gaussian of the problem there.
    iterations : number of steps.
    """

    state: State
    gaussian: Gaussian
    iterations: int

    @property
    def cost(self) -> float:
        """Half the sum of squared whitened residuals, including those of the priors."""
        return self.gaussian.cost


class _Sums:
    """The parts of a `Gaussian` while the products of derivatives and residuals are added up.

    views : indices (V, 6) of the parameters of each of the V views.
    turn : for a view that one camera alone sees, the axes (3, 3) of this camera in the frame of the
        target, in columns. A telecentric image does not depend on a translation along the third.
    """

    def __init__(self, system: System, state: State) -> None:
        self.system, first = system, system.dots_at
        turns = state.rig_from_camera[:, :3, :3]
        self.turn = {
            view: state.rig_from_target[view, :3, :3].T @ turns[camera]
            for view, camera in system.alone
        }
        count = (system.size - first) // 3
        self.views = np.arange(system.views_at, first).reshape(-1, 6)
        self.common, self.cross = np.zeros((first, first)), np.zeros((first, 3, count))
        self.dots, self.right = np.zeros((3, 3, count)), np.zeros(system.size)
        self.of_dots = self.right[first:].reshape(count, 3)
        self.squared = 0.0

    def add(self, at: Ints, jacobian: Array, value: Array) -> None:
        """Add a residual whose derivatives belong to the common parameters ``at``."""
        self.common[np.ix_(at, at)] += jacobian.T @ jacobian
        self.right[at] -= jacobian.T @ value

    def add_images(self, state: State, camera: int) -> None:
        """Add the contributions of all images of one camera to the blocks."""
        system = self.system
        obs, own, views = system.images[camera], system.camera_places[camera], self.views
        size, width, first = len(own), len(own) + 7, system.views_at
        gram, of_camera = (
            np.zeros((len(views), width, width)),
            np.zeros((size, *self.dots.shape[1:])),
        )
        by_view = self.cross[first:].reshape(len(views), 6, 3, -1)
        for images in _in_chunks(images_of(obs)):
            start = images[0][1]
            columns = system.columns(state, camera, slice(start, images[-1][2]))
            by_dot = np.empty((width, 3, columns.shape[-1]))
            for j, dot_column in enumerate(dot_columns(columns)):
                np.multiply(columns[:, 0], dot_column[0], out=by_dot[:, j])
                by_dot[:, j] += columns[:, 1] * dot_column[1]
            for view, a, b in images:
                flat = columns[..., a - start : b - start].reshape(width, -1)
                dot, block = obs.dot[a:b], by_dot[..., a - start : b - start]
                pose = block[size:-1]
                if view in self.turn:
                    flat, pose = flat.copy(), pose.copy()
                    flat[-4:-1] = self.turn[view].T @ flat[-4:-1]
                    pose[3:] = np.tensordot(self.turn[view].T, pose[3:], 1)
                np.matmul(flat, flat.T, out=gram[view])
                # NumPy adds to a slice in place; an index array would cost two copies
                some = slice(dot[0], dot[-1] + 1) if dot[-1] - dot[0] + 1 == b - a else dot
                by_view[view][..., some] += pose
                of_camera[..., some] += block[:size]
                self.dots[..., some] += block[-4:-1]
                self.of_dots[some] -= block[-1].T
        self.cross[own] += of_camera
        self.common[np.ix_(own, own)] += gram[:, :size, :size].sum(0)
        self.common[views[:, :, None], views[:, None]] += gram[:, size:-1, size:-1]
        across = gram[:, :size, size:-1].swapaxes(0, 1).reshape(size, views.size)
        self.common[own, first:] += across
        self.common[first:, own] += across.T
        self.right[own] -= gram[:, :size, -1].sum(0)
        self.right[views] -= gram[:, size:-1, -1]
        self.squared += float(gram[:, -1, -1].sum())


def _in_chunks(images: Sequence[tuple[int, int, int]]) -> list[Sequence[tuple[int, int, int]]]:
    """Return the images (view, first row, last row + 1) in chunks of about `CHUNK` measurements."""
    ends = [end for _, _, end in images]
    parts = max(1, round(max(ends, default=0) / CHUNK))
    cuts = np.unique(np.searchsorted(ends, np.linspace(0, max(ends, default=0), parts + 1)[1:]) + 1)
    return [images[a:b] for a, b in pairwise([0, *cuts.tolist()])] if images else []


def slots(problem: Problem) -> dict[str, list[slice]]:
    """Return where the parameters of each variable are in the information matrix.

    The result maps each kind of variable to a list of slices, one for each variable.
    """
    out: dict[str, list[slice]] = {"intrinsics": [], "camera": [], "view": [], "dots": []}
    at = 0
    sizes = [("intrinsics", len(f)) for f in problem.free]
    sizes += [("camera", 0 if c == 0 else 6) for c in range(len(problem.cameras))]
    sizes += [("view", 6)] * len(problem.views) + [("dots", problem.nominal_mm.size)]
    for name, size in sizes:
        out[name].append(slice(at, at + size))
        at += size
    return out


def images_of(obs: Observations) -> list[tuple[int, int, int]]:
    """Return (view, first row, last row + 1) for every image of one camera.

    obs : the camera's measurements, sorted by view.
    """
    edges = np.flatnonzero(np.diff(obs.view, prepend=-1, append=-1)).tolist()
    return [(int(obs.view[a]), a, b) for a, b in pairwise(edges)]


def _components_first(obs: Observations) -> Observations:
    """Return the same measurements with each component contiguous in memory."""
    uv = np.ascontiguousarray(obs.uv_px.T)
    whitener = np.ascontiguousarray(obs.whitener.transpose(1, 2, 0))
    return replace(obs, uv_px=uv.T, whitener=whitener.transpose(2, 0, 1))


def retracted(pose: Array, tangent: Array) -> Array:
    """Return poses (..., 4, 4) after a step along tangents (..., 6) (rotation, translation)."""
    out = pose.copy()
    turn = pose[..., :3, :3]
    out[..., :3, :3] = turn @ rotation_from_rotvec(tangent[..., :3])
    out[..., :3, 3] += (turn @ tangent[..., 3:, None])[..., 0]
    return out
