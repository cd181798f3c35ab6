"""The same least-squares problem as the graph's, evaluated by arrays; no graph.

The images are evaluated a chunk at a time (`telerig.factors.image_blocks`) and summed up to
normal equations in blocks. Cost, information and minimum are the graph's; tests/test_schur.py.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from telerig.estimator.calibration.solver.normal_equations import NormalEquations
from telerig.estimator.calibration.solver.problem import (
    GAUGE_SIGMA_MM,
    Problem,
    parameter_unit,
    prior_sigma,
)
from telerig.estimator.calibration.solver.schur import Group
from telerig.factors.image_blocks import (
    ImageBlocks,
    Scratch,
    image_blocks,
    squared_error,
)
from telerig.factors.image_rows import Entries, ImageRows, in_chunks
from telerig.factors.priors import depth_gauge_residual, distance_residual
from telerig.factors.projection import State
from telerig.rig.pose import rotation_from_rotvec

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


MANY = 40_000
"""Measured dots from which loading compiled loops is worth its second."""


@cache
def compiled_loops() -> Any:
    """The module `telerig.factors.image_loops`, or None where numba is not installed."""
    try:
        return import_module("telerig.factors.image_loops")
    except ImportError:
        return None


class ArraySystem:
    """A problem without a graph; points are states. The interface is `graph.GraphSystem`'s."""

    def __init__(self, problem: Problem, start: State) -> None:
        self.problem, self.start = problem, start
        cameras = range(len(problem.cameras))
        self.free = [problem.free_indices(c) for c in cameras]
        self.unit = [parameter_unit(problem.cameras[c])[self.free[c]] for c in cameras]
        self.weight = [
            self.unit[c] / prior_sigma(problem.cameras[c])[self.free[c]] for c in cameras
        ]
        self.any_free = list(dict.fromkeys(np.concatenate(self.free).tolist()))
        self.picked = [self._pick(free, unit) for free, unit in zip(self.free, self.unit)]
        self.own = [order[6:-1] for order, _ in self.picked]
        self.chunks = in_chunks(problem.observations(), len(problem.dot_ids))
        sizes = [len(f) for f in self.free] + [6] * (len(problem.cameras) - 1)
        self.edges = np.r_[0, np.cumsum(sizes)]
        self.dot_weight = np.ascontiguousarray(problem.dot_sigma_mm.T**-2.0)
        self.loops: Any = compiled_loops() if len(problem.view) >= MANY else None
        self.groups = seen_together(problem, int(self.edges[-1]))
        self.scratch = Scratch()
        self.loose_mm = 10 * max(problem.rho_mm)

    def _pick(self, free: Ints, unit: Array) -> tuple[Ints, Array]:
        """Which of a chunk's columns are a camera's own, and the units of their products."""
        own = [6 + self.any_free.index(p) for p in free.tolist()]
        order = np.array([*range(6), *own, 6 + len(self.any_free)])
        scale = np.concatenate([np.ones(6), unit, [1.0]])
        return order, scale[:, None] * scale

    def first(self) -> State:
        return self.start

    def state(self, state: State) -> State:
        return state

    def cost(self, state: State) -> float:
        """Half the sum of the squared residuals, without derivatives."""
        twice = 0.0
        for rows in self.chunks:
            own = self.loops is not None and self.loops.handles(state, rows, self.any_free)
            error = self.loops.squared_error if own else squared_error
            twice += error(state, rows, self.problem.rho_mm)
        return 0.5 * (twice + self.prior_cost(state))

    def linearised(self, state: State) -> NormalEquations:
        """Everything at one state: images, then priors and gauge."""
        return _Sums(self, state).equations()

    def intrinsics_of(self, camera: int) -> slice:
        """Where a camera's free intrinsics stand."""
        return slice(int(self.edges[camera]), int(self.edges[camera + 1]))

    def pose_of(self, camera: int) -> slice:
        """Where the pose of a camera but the first stands."""
        return self.intrinsics_of(len(self.problem.cameras) + camera - 1)

    def intrinsic_pull(self, state: State, camera: int) -> tuple[Array, Array]:
        """Whitened distance of the free intrinsics from nominal, and 1 / sigma, in their units."""
        free, weight = self.free[camera], self.weight[camera]
        off = state.intrinsics[camera] - self.problem.cameras[camera].intrinsics
        return off[free] / self.unit[camera] * weight, weight

    def prior_cost(self, state: State) -> float:
        """Twice the cost of priors, gauge and known distance."""
        problem = self.problem
        parts = [self.intrinsic_pull(state, c)[0] for c in range(len(problem.cameras))]
        for pose in state.rig_from_camera[1:]:
            parts.append(depth_gauge_residual(pose, GAUGE_SIGMA_MM)[0])
        parts.append(state.rig_from_target[:, :3, 3].ravel() / self.loose_mm)
        parts.append(((state.dots_mm - problem.nominal_mm) / problem.dot_sigma_mm).ravel())
        if problem.scale is not None:
            parts.append(distance_residual(state.dots_mm, *problem.scale)[0])
        return float(sum(part @ part for part in parts))

    def moved(self, state: State, step: Array) -> State:
        """The state after a step: poses R exp(w), t + R v."""
        intrinsics, cameras = state.intrinsics.copy(), state.rig_from_camera.copy()
        for c, (free, unit) in enumerate(zip(self.free, self.unit)):
            intrinsics[c, free] += step[self.intrinsics_of(c)] * unit
        others = len(cameras) - 1
        first = int(self.edges[-1])
        last = first + 6 * len(self.problem.views)
        poses = np.concatenate([cameras[1:], state.rig_from_target])
        poses = _retracted(poses, step[first - 6 * others : last].reshape(-1, 6))
        cameras[1:], views = poses[:others], poses[others:]
        dots = state.dots_mm + step[last:].reshape(-1, 3)
        return replace(
            state, intrinsics=intrinsics, rig_from_camera=cameras, rig_from_target=views,
            dots_mm=dots,
        )  # fmt: skip


class _Sums:
    """Normal equations in the making."""

    def __init__(self, system: ArraySystem, state: State) -> None:
        self.system, self.state = system, state
        shared, views = int(system.edges[-1]), len(system.problem.views)
        count = len(system.problem.dot_ids)
        self.twice = 0.0
        self.shared, self.by_view = np.zeros((shared, shared)), np.zeros((shared, views, 6))
        self.views, self.dots = np.zeros((views, 6, 6)), np.zeros((3, 3, count))
        self.cross = np.zeros((shared + 6 * views, 3, count))
        self.cross_views = self.cross[shared:].reshape(views, 6, 3, count)
        self.right_shared, self.right_views = np.zeros(shared), np.zeros((views, 6))
        self.right_dots = np.zeros((3, count))

    def equations(self) -> NormalEquations:
        system = self.system
        for rows in system.chunks:
            given = (self.state, rows, system.problem.rho_mm, system.any_free, system.scratch)
            if system.loops is not None and system.loops.handles(self.state, rows, system.any_free):
                self._add_compiled(rows, system.loops.image_columns(*given))
            else:
                self._add(rows, image_blocks(*given))
        return self.with_priors()

    def with_priors(self) -> NormalEquations:
        """With what has been summed so far."""
        row = self._add_priors()
        right = np.concatenate(
            [p.ravel() for p in (self.right_shared, self.right_views, self.right_dots.T)]
        )
        cost = 0.5 * self.twice
        by_view = self.by_view.reshape(len(self.shared), -1)
        return NormalEquations(
            cost,
            self.shared,
            by_view,
            self.views,
            self.dots,
            self.cross,
            right,
            row,
            self.system.groups,
        )

    def _add(self, rows: ImageRows, blocks: ImageBlocks) -> None:
        for k, (camera, images) in enumerate(rows.cameras):
            view, turn = rows.view[images], blocks.view_from_camera[images]
            self._add_gram(camera, view, blocks.gram[images], turn)
            if rows.entries is None:
                self._add_dots(camera, view, blocks.by_dot[images], turn)
            else:
                self._add_entries(camera, view, blocks.by_dot[images], turn, rows.entries[k])

    def _add_compiled(self, rows: ImageRows, blocks: Any) -> None:
        count = self.dots.shape[-1]
        for camera, images in rows.cameras:
            moved = blocks.view_from_camera[images]
            self._add_gram(camera, rows.view[images], blocks.gram[images], moved)
            total = np.zeros((blocks.gram.shape[-1] - 3, 3, count))
            turned = np.zeros((6 if camera else 0, 3, count))
            self.system.loops.add_dots(blocks, images, rows, self.cross_views, total, turned)
            self._add_totals(camera, total, slice(None))
            if camera:
                self.cross[self.system.pose_of(camera)] += turned

    def _add_gram(self, camera: int, view: Ints, gram: Array, moved: Array) -> None:
        """gram : (I, K, K) of the chunk's columns; moved : (I, 6, 6) of the camera's pose."""
        order, scale = self.system.picked[camera]
        if not np.array_equal(order, np.arange(gram.shape[-1])):
            gram = gram[:, order[:, None], order]
        gram = gram * scale
        lens = self.system.intrinsics_of(camera)
        self.twice += float(gram[:, -1, -1].sum())
        self.views[view] += gram[:, :6, :6]
        self.right_views[view] -= gram[:, :6, -1]
        self.by_view[lens, view] += gram[:, 6:-1, :6].swapaxes(0, 1)
        total = gram[:, 6:-1].sum(0)
        self.shared[lens, lens] += total[:, 6:-1]
        self.right_shared[lens] -= total[:, -1]
        if camera:
            pose = self.system.pose_of(camera)
            turned = np.swapaxes(moved, -1, -2) @ gram[:, :6]
            self.by_view[pose, view] += turned[:, :, :6].swapaxes(0, 1)
            total = turned.sum(0)
            self.shared[pose, lens] += total[:, 6:-1]
            self.shared[lens, pose] += total[:, 6:-1].T
            self.right_shared[pose] -= total[:, -1]
            self.shared[pose, pose] += (turned[:, :, :6] @ moved).sum(0)

    def _add_dots(self, camera: int, view: Ints, by_dot: Array, moved: Array) -> None:
        """by_dot : (I, K, 3, N), a place for every dot."""
        # a slice is added in place, an index array by way of two copies
        whole = view[-1] - view[0] + 1 == len(view)
        self.cross_views[slice(view[0], view[-1] + 1) if whole else view] += by_dot[:, :6]
        self._add_totals(camera, by_dot[:, 3:].sum(0), slice(None))
        if camera:
            count = by_dot.shape[-1]
            of_view = by_dot[:, :6].reshape(-1, 3 * count)
            total = moved.reshape(-1, 6).T @ of_view
            self.cross[self.system.pose_of(camera)] += total.reshape(6, 3, count)

    def _add_entries(
        self, camera: int, view: Ints, by_dot: Array, moved: Array, entries: Entries
    ) -> None:
        """by_dot : (I, K, 3, m), only the dots that were measured."""
        values = by_dot[entries.image, :, :, entries.slot]
        # an image sees a dot once, so that no two rows add to the same place
        self.cross_views[view[entries.image], :, :, entries.dot] += values[:, :6]
        self._add_totals(camera, _by_dot(values[:, 3:], entries), entries.distinct)
        if camera:
            turned = np.swapaxes(moved[entries.image], -1, -2) @ values[:, :6]
            total = _by_dot(turned, entries)
            self.cross[self.system.pose_of(camera), :, entries.distinct] += total

    def _add_totals(self, camera: int, total: Array, at: Ints | slice) -> None:
        """total : (K - 3, 3, n) summed over images, from the dot's own three columns on."""
        own, unit = self.system.own[camera], self.system.unit[camera]
        self.dots[:, :, at] += total[:3]
        self.right_dots[:, at] -= total[-1]
        by_lens = total[own - 3] * unit[:, None, None]
        lens = self.system.intrinsics_of(camera)
        self.cross[lens, :, at] += by_lens

    def _add_priors(self) -> Array | None:
        """Intrinsics, depth gauge, view places and dots, with their cost (`prior_cost`).

        Returns the row of the known distance.
        """
        system, problem, state = self.system, self.system.problem, self.state
        for c in range(len(problem.cameras)):
            pull, weight = system.intrinsic_pull(state, c)
            lens = system.intrinsics_of(c)
            self.shared[lens, lens] += np.diag(weight**2)
            self.right_shared[lens] -= pull * weight
            self.twice += float(pull @ pull)
        for c in range(1, len(problem.cameras)):
            value, jacobian = depth_gauge_residual(state.rig_from_camera[c], GAUGE_SIGMA_MM)
            pose = system.pose_of(c)
            self.shared[pose, pose] += jacobian.T @ jacobian
            self.right_shared[pose] -= jacobian.T @ value
            self.twice += float(value @ value)
        self.views[:, range(3, 6), range(3, 6)] += system.loose_mm**-2.0
        turn, shift = state.rig_from_target[:, :3, :3], state.rig_from_target[:, :3, 3]
        self.right_views[:, 3:] -= np.einsum("vij,vi->vj", turn, shift) / system.loose_mm**2
        self.twice += float(np.vdot(shift, shift)) / system.loose_mm**2
        off, weight = (state.dots_mm - problem.nominal_mm).T, system.dot_weight
        weighted = off * weight
        self.dots[range(3), range(3)] += weight
        self.right_dots -= weighted
        self.twice += float(np.vdot(off, weighted))
        if problem.scale is None:
            return None
        value, jacobian = distance_residual(state.dots_mm, *problem.scale)
        self.twice += float(value @ value)
        self.right_dots -= (jacobian[0] * value[0]).reshape(-1, 3).T
        return np.asarray(jacobian[0])


TOGETHER = 64
"""Dots of a group: more are fewer products, fewer are seen by fewer views."""


def seen_together(problem: Problem, shared: int) -> tuple[Group, ...]:
    """Neighbouring dots with the rows of views that see any; () where that saves less than half."""
    count, views = len(problem.dot_ids), len(problem.views)
    used = problem.weight > 0
    seen = np.zeros((count, views), bool)
    seen[problem.dot[used], problem.view[used]] = True
    if seen.mean() > 0.5 or 2 * views > count:
        return ()
    groups, work = [], 0.0
    for dots in _halved(np.arange(count), problem.nominal_mm):
        of_views = shared + 6 * np.flatnonzero(seen[dots].any(0))[:, None] + np.arange(6)
        rows = np.concatenate([np.arange(shared), of_views.ravel()])
        groups.append(Group(dots, rows))
        work += len(dots) * len(rows) ** 2
    return tuple(groups) if work < 0.5 * count * (shared + 6 * views) ** 2 else ()


def _by_dot(values: Array, entries: Entries) -> Array:
    """(r, k, 3) -> (k, 3, n) summed over the images that see each dot."""
    count = len(values)
    edges = np.append(entries.first, count)
    summing = csr_array((np.ones(count), entries.order, edges), shape=(len(edges) - 1, count))
    total = summing @ values.reshape(count, -1)
    return np.asarray(total.reshape(-1, *values.shape[1:]).transpose(1, 2, 0))


def _halved(dots: Ints, places: Array) -> list[Ints]:
    """Neighbours in groups, by halving along the longer side."""
    if len(dots) <= TOGETHER:
        return [dots]
    along = int(np.argmax(np.ptp(places[dots], axis=0)))
    order = dots[np.argsort(places[dots, along], kind="stable")]
    middle = len(order) // 2
    return _halved(order[:middle], places) + _halved(order[middle:], places)


def _retracted(pose: Array, tangent: Array) -> Array:
    """(..., 4, 4) poses moved by (..., 6) tangents (rotation, translation)."""
    out = pose.copy()
    turn = pose[..., :3, :3]
    out[..., :3, :3] = turn @ rotation_from_rotvec(tangent[..., :3])
    out[..., :3, 3] += (turn @ tangent[..., 3:, None])[..., 0]
    return out
