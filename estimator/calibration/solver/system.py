"""Computes the whitened residuals of a problem and their derivatives, at any state.

All solvers use the same arrays: those of `factors.calibration.image_columns` for the images, and
those of `Priors` for all other residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from telerig.arrays import Array
from telerig.estimator.calibration.solver.problem import (
    GAUGE_SIGMA_MM,
    Problem,
    parameter_unit,
    prior_sigma,
)
from telerig.factors.calibration import (
    Observations,
    State,
    depth_gauge_residual,
    distance_residual,
    image_columns,
    place_residual,
)
from telerig.io.machine.parallel import keep_freed_memory
from telerig.rig.pose import rotation_from_rotvec


@dataclass(frozen=True)
class Priors:
    """Holds whitened residuals other than those of images, and their derivatives.

    cameras : for each camera the residuals (r,) of the weak priors and the depth gauge, and their
        derivatives (r, S) with respect to the camera's S parameters: its free intrinsics and,
        except for the first camera, its pose.
    views : residuals (V, 3) and derivatives (V, 3, 6) of the weak priors on the V views' positions.
    dots : residuals (N, 3) of the N dots' nominal positions, and the diagonal (N, 3) of their
        derivatives.
    distance : indices of the two dots of a known distance, its residual, and the derivative (3,)
        with respect to the first dot; None if no distance is known.
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
    """Computes the residuals of a problem as functions of the state.

    images : for each camera its measurements, sorted by view and dot.
    rows : for each camera the rows of these measurements in `Problem.observations`.
    camera_places : for each camera the indices of its S parameters among all D: free intrinsics,
        then pose.
    views_at, dots_at : index of the first parameter of the views and of the dots.
    size : D, the number of all parameters.
    """

    def __init__(self, problem: Problem) -> None:
        keep_freed_memory()
        self.problem = problem
        self.place_sigma_mm = 10 * max(problem.rho_mm)
        cameras = range(len(problem.cameras))
        self.free = [problem.free_indices(c) for c in cameras]
        self.unit = [parameter_unit(k)[f] for k, f in zip(problem.cameras, self.free)]
        self.sigma = [prior_sigma(k)[f] for k, f in zip(problem.cameras, self.free)]
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

    def columns(self, state: State, camera: int, rows: slice = slice(None)) -> Array:
        """Return `image_columns` (S + 7, 2, M) of M measurements of a camera.

        The derivatives are with respect to the parameters in the units of a step
        (`parameter_unit`).

        rows : which of the camera's measurements are used.
        """
        obs = self.images[camera].subset(rows)
        out = image_columns(
            state, obs, camera, self.problem.rho_mm[camera], self.free[camera].tolist()
        )
        out[: len(self.free[camera])] *= self.unit[camera][:, None, None]
        return out

    def priors(self, state: State) -> Priors:
        """Return the residuals that do not come from images, and their derivatives."""
        problem, cameras = self.problem, []
        for c, nominal in enumerate(problem.cameras):
            free, unit, sigma = self.free[c], self.unit[c], self.sigma[c]
            value = (state.intrinsics[c] - nominal.intrinsics)[free] / sigma
            jacobian = np.diag(unit / sigma)
            if c:
                # only the second camera fixes the origin along the axis of the first camera
                gauge, by_pose = depth_gauge_residual(state.rig_from_camera[c], GAUGE_SIGMA_MM)
                first = 0 if c == 1 else 1
                value = np.concatenate([value, gauge[first:]])
                whole = np.zeros((len(value), len(free) + 6))
                whole[: len(free), : len(free)] = jacobian
                whole[len(free) :, len(free) :] = by_pose[first:]
                jacobian = whole
            cameras.append((value, jacobian))
        views = place_residual(state.rig_from_target, self.place_sigma_mm)
        sigma = np.broadcast_to(problem.dot_sigma_mm, state.dots_mm.shape)
        dots = (state.dots_mm - problem.nominal_mm) / sigma, 1 / sigma
        distance = None
        if problem.scale is not None:
            (a, b), length, sd = problem.scale
            off, by_first = distance_residual(state.dots_mm[a], state.dots_mm[b], length, sd)
            distance = (a, b), float(off), by_first
        return Priors(cameras, views, dots, distance)

    def moved(self, state: State, step: Array) -> State:
        """Return the state after a step (D,). A pose (R, t) becomes (R exp(w), t + R v) for the
        tangent (w, v)."""
        intrinsics, cameras = state.intrinsics.copy(), state.rig_from_camera.copy()
        for c, (free, unit, places) in enumerate(zip(self.free, self.unit, self.camera_places)):
            intrinsics[c, free] += step[places[: len(free)]] * unit
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


def slots(problem: Problem) -> dict[str, list[slice]]:
    """Return for each kind of variable the slices of its parameters in the information matrix."""
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
    """Return (view, first row, last row + 1) for every image of one camera."""
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
