"""Builds the linear factors of a calibration and eliminates them with GTSAM.

The variables are cameras, views and groups of dots. The whitened blocks of all images are computed
as arrays. GTSAM gets one `JacobianFactor` for each camera, view and group of dots that the camera
sees in this view. A group of dots is one variable so that a factor has about 30 rows, which makes
the cost of each Python object small. Columns are scaled to unit length, because GTSAM's Cholesky
factorisation refuses pivots of very different size.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg.lapack import dpotri

from telerig.arrays import Array, Ints
from telerig.estimator.calibration.solver.problem import System
from telerig.estimator.calibration.solver.schur import Posterior, undetermined
from telerig.factors.calibration import State
from telerig.factors.linear_factors import add_linear_factors

DOTS_OF_GROUP = 10
"""Approximate number of dots that form one variable of the graph; see docs/decisions/020."""
LEAST_PIVOT = 1e-10
"""Smallest pivot with which the problem still counts as determined, if all columns have the length
1."""


@dataclass(frozen=True)
class _Images:
    """Where one camera's M measurements stand in P factors, one for a view and a group of dots.

    view, group : (P,).
    place : (M,) factor times G, plus the number of the dot in its group of G.
    """

    view: Ints
    group: Ints
    place: Ints


class GraphLayout:
    """Orders the variables of a problem's graph: cameras, then views, then groups of dots.

    All groups have the same size, so the last one may contain dots that do not exist and on which
    no measurement depends.

    size : number W of all scalar parameters.
    places : for each variable the indices of its scalars.
    families : for each set of variables of equal size, their keys (M,) and the indices (M, size) of
        their scalars.
    order : keys of the variables in the order of elimination.
    """

    def __init__(self, system: System) -> None:
        problem, self.system = system.problem, system
        count, cameras, views = len(problem.dot_ids), len(problem.cameras), len(problem.views)
        groups = max(1, round(count / DOTS_OF_GROUP))
        self.per_group = -(-count // groups)
        self.view_key = cameras + np.arange(views)
        self.group_key = cameras + views + np.arange(groups)
        self.size = system.dots_at + 3 * self.per_group * groups
        self.of_views = np.arange(system.views_at, system.dots_at).reshape(views, 6)
        self.of_groups = np.arange(system.dots_at, self.size).reshape(groups, -1)
        self.places = [*system.camera_places, *self.of_views, *self.of_groups]
        families = [(np.array([c]), system.camera_places[c][None]) for c in range(cameras)]
        families += [(self.view_key, self.of_views), (self.group_key, self.of_groups)]
        self.families = families
        first, second = self.view_key, self.group_key
        if views <= count:
            first, second = second, first
        self.order = [*first.tolist(), *second.tolist(), *range(cameras)]
        self.images = [self._images(obs.view, obs.dot) for obs in system.images]

    @cached_property
    def every_place(self) -> Ints:
        """The indices of the scalars of all variables, one variable after the other."""
        return np.concatenate(self.places)

    def _images(self, view: Ints, dot: Ints) -> _Images:
        group, slot = np.divmod(dot, self.per_group)
        pairs, which = np.unique(view * len(self.group_key) + group, return_inverse=True)
        return _Images(*np.divmod(pairs, len(self.group_key)), which * self.per_group + slot)

    @cached_property
    def gtsam_order(self) -> Any:
        """The order of elimination as a `gtsam.Ordering`."""
        import gtsam

        order = gtsam.Ordering()
        for key in self.order:
            order.push_back(key)
        return order


class GraphEquations:
    """The Gaussian factor graph of a problem, linearised at one state.

    J are the derivatives of the whitened residuals r with respect to the W scalar parameters.

    square, right : (W,) diagonal of J^T J, and -J^T r.
    untouched : (W,) whether no measurement and no prior depends on the parameter.
    cost : half the sum of squared residuals.
    """

    def __init__(self, layout: GraphLayout, state: State) -> None:
        self.layout, system = layout, layout.system
        self.square, self.right = np.zeros((2, layout.size))
        self.priors = system.priors(state)
        self.columns = [self._padded(state, c) for c in range(len(layout.images))]
        images = (float(np.vdot(columns[-1], columns[-1])) for columns in self.columns)
        self.cost = 0.5 * (sum(images) + self.priors.squared)
        self._add_priors()
        self.untouched = self.square <= 0
        self.scale = 1 / np.sqrt(np.where(self.untouched, 1.0, self.square))

    def _padded(self, state: State, camera: int) -> Array:
        """Return a camera's columns (S + 7, 2, P, G), 0 for unseen dots; add up their products."""
        layout, where = self.layout, self.layout.images[camera]
        columns = layout.system.columns(state, camera)
        shape = (*columns.shape[:2], len(where.view), layout.per_group)
        padded = columns
        if columns[0].size != np.prod(shape[1:]):
            padded = np.zeros((*shape[:2], shape[2] * shape[3]))
            padded[..., where.place] = columns
        padded = padded.reshape(shape)
        for out, products in (
            (self.square, (padded * padded).sum(1)),
            (self.right, -(padded * padded[-1]).sum(1)),
        ):
            own = layout.system.camera_places[camera]
            out[own] += products[: len(own)].sum((1, 2))
            np.add.at(out, layout.of_views[where.view], products[-7:-1].sum(2).T)
            of_dots = products[-4:-1].transpose(1, 2, 0).reshape(len(where.group), -1)
            np.add.at(out, layout.of_groups[where.group], of_dots)
        return padded

    def _add_priors(self) -> None:
        """Add the contributions of the priors to ``square`` and ``right``."""
        layout, priors = self.layout, self.priors
        for own, (value, jacobian) in zip(layout.system.camera_places, priors.cameras):
            self.square[own] += (jacobian**2).sum(0)
            self.right[own] -= value @ jacobian
        value, jacobian = priors.views
        self.square[layout.of_views] += (jacobian**2).sum(1)
        self.right[layout.of_views] -= np.einsum("vr,vrk->vk", value, jacobian)
        first, last = layout.system.dots_at, layout.system.size
        self.square[first:last] += priors.dots[1].ravel() ** 2
        self.right[first:last] -= (priors.dots[0] * priors.dots[1]).ravel()
        if priors.distance is not None:
            pair, off, by_first = priors.distance
            rows = np.array([by_first, -by_first])
            at = first + 3 * np.array(pair)[:, None] + np.arange(3)
            self.square[at] += rows**2
            self.right[at] -= off * rows

    @cached_property
    def _undamped(self) -> Any:
        """The graph of all factors, with columns scaled to unit length."""
        import gtsam

        graph = gtsam.GaussianFactorGraph()
        for camera in range(len(self.columns)):
            self._add_images(graph, camera)
        self._add_prior_factors(graph)
        return graph

    def _add_images(self, graph: Any, camera: int) -> None:
        """Add one factor for each view and group of dots that the camera sees."""
        layout, where, padded = self.layout, self.layout.images[camera], self.columns[camera]
        own, per = layout.system.camera_places[camera], layout.per_group
        of_camera = padded[: len(own)] * self.scale[own][:, None, None, None]
        of_view = padded[-7:-1] * self.scale[layout.of_views[where.view]].T[:, None, :, None]
        scale = self.scale[layout.of_groups[where.group]].reshape(-1, per, 3)
        each = np.arange(per)
        of_dots = np.zeros((len(where.group), per, 3, 2, per))
        of_dots[:, each, :, :, each] = (
            padded[-4:-1] * scale.transpose(2, 0, 1)[:, None]
        ).transpose(3, 2, 0, 1)
        blocks = [
            *(part.transpose(2, 0, 1, 3) for part in (of_camera, of_view)),
            of_dots.reshape(len(where.group), 3 * per, 2, per),
        ]
        add_linear_factors(
            graph,
            (camera, layout.view_key[where.view], layout.group_key[where.group]),
            [b.reshape(*b.shape[:2], 2 * per).swapaxes(1, 2) for b in blocks],
            -padded[-1].swapaxes(0, 1).reshape(len(where.view), 2 * per),
        )

    def _add_prior_factors(self, graph: Any) -> None:
        """Add the factors of the priors and of the known distance to the graph."""
        layout, priors, scale = self.layout, self.priors, self.scale
        for camera, (value, jacobian) in enumerate(priors.cameras):
            block = jacobian * scale[layout.system.camera_places[camera]]
            add_linear_factors(graph, (camera,), (block,), -value[None])
        value, jacobian = priors.views
        add_linear_factors(
            graph, (layout.view_key,), (jacobian * scale[layout.of_views][:, None],), -value
        )
        value, weight = np.zeros((2, *layout.of_groups.shape))
        value.flat[: priors.dots[0].size] = priors.dots[0].flat
        weight.flat[: priors.dots[1].size] = priors.dots[1].flat
        blocks = (weight * scale[layout.of_groups])[:, None] * np.eye(weight.shape[1])
        add_linear_factors(graph, (layout.group_key,), (blocks,), -value)
        if priors.distance is not None:
            pair, off, by_first = priors.distance
            groups, slots = np.divmod(np.array(pair), layout.per_group)
            rows = np.zeros((2, layout.per_group, 3))
            rows[[0, 1], slots] = by_first, -by_first
            rows = rows.reshape(2, 1, -1) * scale[layout.of_groups[groups]][:, None]
            keys = layout.group_key[groups]
            if groups[0] == groups[1]:
                rows, keys = rows.sum(0, keepdims=True), keys[:1]
            add_linear_factors(graph, [*keys], [*rows[:, None]], np.array([[-off]]))

    def _graph(self, damping: float) -> Any:
        """Return the graph with Marquardt's damping; scalars that nothing touches stay in place."""
        import gtsam

        graph = gtsam.GaussianFactorGraph()
        graph.push_back(self._undamped)
        weight = np.sqrt(np.where(self.untouched, 1.0, damping))
        if weight.any():
            for keys, places in self.layout.families:
                diagonal = weight[places]
                blocks = diagonal[:, None] * np.eye(diagonal.shape[1])
                add_linear_factors(graph, (keys,), (blocks,), np.zeros_like(diagonal))
        return graph

    def _net(self, damping: float) -> Any:
        """Return the Bayes net by Cholesky factorisation, or by QR if a pivot is too small.

        It is if only one camera sees a view: only a weak prior determines the depth along its axis.
        """
        import gtsam

        graph, order = self._graph(damping), self.layout.gtsam_order
        try:
            return graph.eliminateSequential(order)
        except RuntimeError:
            pass  # GTSAM's word for a pivot below 1/4096 of the one before
        try:
            return graph.eliminateSequential(order, gtsam.EliminateQR)
        except RuntimeError as error:
            raise undetermined() from error

    def step(self, damping: float) -> tuple[Array, float]:
        """Return a Levenberg-Marquardt step (D,) of the D parameters, and the predicted gain.

        The gain is the decrease of the cost that the linear model predicts. Raises CalibrationError
        if GTSAM can eliminate the graph neither by Cholesky nor by QR.
        """
        step = np.empty(self.layout.size)
        step[self.layout.every_place] = self._net(damping).optimize().vector()
        step *= self.scale
        return step[: self.layout.system.size], float(0.5 * step @ self.right)

    def posterior(self, whole: bool) -> Posterior:
        """Return the inverse of J^T J, in full for any ``whole``.

        Raises CalibrationError if J^T J is singular.
        """
        del whole
        root, place = self._square_root()
        inverse, failed = dpotri(root, lower=0, overwrite_c=1)
        if failed:
            raise undetermined()
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        matrix, scale = np.empty_like(inverse), self.scale[place]
        matrix[np.ix_(place, place)] = inverse * scale[:, None] * scale
        size = self.layout.system.size
        return Posterior.of(matrix[:size, :size], self.layout.system.dots_at, self.untouched[:size])

    def information(self) -> Array:
        """Return J^T J of the D parameters as a dense matrix (D, D)."""
        root, place = self._square_root()
        scaled = root / self.scale[place]
        out = np.empty_like(root)
        out[np.ix_(place, place)] = scaled.T @ scaled
        out[self.untouched, self.untouched] = 0.0
        return out[: self.layout.system.size, : self.layout.system.size]

    def _square_root(self) -> tuple[Array, Ints]:
        """Return the Bayes net's upper triangular R (W, W), and the scalar (W,) of each column."""
        net = self._net(0.0)
        place = np.concatenate([self.layout.places[key] for key in self.layout.order])
        row_of = np.empty_like(place)
        row_of[place] = np.arange(len(place))
        root = np.zeros((len(place), len(place)), order="F")
        for i in range(net.size()):
            conditional = net.at(i)
            keys = list(conditional.keys())
            own, *parents = (row_of[self.layout.places[key]] for key in keys)
            root[np.ix_(own, own)] = conditional.R()
            if parents:
                root[np.ix_(own, np.concatenate(parents))] = conditional.S()
        if np.abs(np.diag(root)).min() < LEAST_PIVOT:
            raise undetermined()
        return root, place
