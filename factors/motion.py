"""Expresses motion priors as whitened linear factors. Several processes are put side by side in one
state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.factors.linear_factors import LinearFactors
from telerig.factors.state_space import (
    Component,
    block_diagonal,
    discretise,
    distinct_steps,
    log_det_of,
    whitener_of,
)


@dataclass(frozen=True)
class Motion:
    """Holds whitened steps of several processes: W (x' - Phi x - G c) has unit noise.

    Here x (n,) and x' (n,) are the states before and after a step, Phi (n, n) the transition, c
    (K,) the constant inputs, G (n, K) their effect, and W (n, n) the whitening matrix. There are M
    steps, of U different lengths.

    by_next, by_last : (U, n, n) W and -W Phi.
    by_input : (U, n, K) -W G.
    log_det : (U,) logarithm of the determinant of W.
    basis : (U + 1, n, n) bases of the states, see `Steps.bases`.
    index : (M,) which of the U lengths each step has.
    """

    by_last: Array
    by_next: Array
    by_input: Array
    log_det: Array
    basis: Array
    index: Ints

    def residual(self, last: Array, following: Array, inputs: ArrayLike) -> Array:
        """Return the whitened residuals (M, n) of M steps.

        last, following : (M, n) states before and after each step.
        inputs : (M, K), or (K,) for all steps.
        """
        count, width = len(self.index), self.by_input.shape[-1]
        constant = np.broadcast_to(np.asarray(inputs, float), (count, width))
        terms = ((self.by_next, following), (self.by_last, last), (self.by_input, constant))
        if len(self.by_next) == 1:
            return np.asarray(sum(x @ a[0].T for a, x in terms))
        return np.asarray(sum(np.einsum("mij,mj->mi", a[self.index], x) for a, x in terms))

    def factors(
        self,
        keys: Sequence[ArrayLike],
        states: tuple[Array, Array],
        inputs: Array,
        following: Ints,
    ) -> LinearFactors:
        """Return the M steps as linear factors on increments of the states, in their bases, and on
        the inputs.

        keys : (M,) of the states before, (M,) of the states after and, if there are inputs, (M,) of
            these.
        states : (M, n) before and (M, n) after.
        inputs : (M, K).
        following : (M,) as in `in_basis`.
        """
        residual = self.residual(*states, inputs)
        blocks = (*self.in_basis(following), _chosen(self.by_input, self.index))
        return LinearFactors(tuple(keys), blocks[: len(keys)], -residual, self.log_det[self.index])

    def in_basis(self, following: Ints) -> tuple[Array, Array]:
        """Return by_last and by_next (M, n, n) for increments that are expressed in the states'
        bases.

        following : (M,) index into ``basis`` of the state after each step.
        """
        last, ahead, place = self.distinct_in_basis(following)
        return _chosen(last, place), _chosen(ahead, place)

    def distinct_in_basis(self, following: Ints) -> tuple[Array, Array, Ints]:
        """Return the same as `in_basis`, but every different pair of matrices only once.

        Returns by_last and by_next (Q, n, n) of the Q different pairs, and the index (M,) of each
        step's pair.
        """
        count = len(self.basis)
        own, place = np.unique(self.index * count + following % count, return_inverse=True)
        step, after = np.divmod(own, count)
        return self.by_last[step] @ self.basis[step], self.by_next[step] @ self.basis[after], place


def _chosen(blocks: Array, which: Ints) -> Array:
    """Return blocks (M, i, j) of (U, i, j) by index; a single block is not copied."""
    if len(blocks) == 1:
        return np.broadcast_to(blocks[0], (len(which), *blocks.shape[1:]))
    return np.asarray(blocks[which])


def motion(components: Sequence[Component], dt_s: ArrayLike, *, batched: bool = False) -> Motion:
    """Return the whitened steps of independent processes, with states and inputs side by side.

    dt_s : (M,) lengths of the steps.
    batched : whether processes of equal kind are computed together. This is faster if a few steps
        are computed thousands of times.
    """
    lengths, index = distinct_steps(dt_s)
    sizes, inputs = (np.array([c.input.shape[i] for c in components], int) for i in (0, 1))
    first, first_input = np.cumsum(sizes) - sizes, np.cumsum(inputs) - inputs
    count, width = len(lengths), int(sizes.sum())
    by_last, by_next = np.zeros((2, count, width, width))
    by_input = np.zeros((count, width, int(inputs.sum())))
    basis = np.zeros((count + 1, width, width))
    log_det = np.zeros((0, count))
    for steps in discretise(components, lengths, batched=batched):
        states = first[steps.which, None] + np.arange(steps.input.shape[-2])
        constants = first_input[steps.which, None] + np.arange(steps.input.shape[-1])
        for out, columns, blocks in (
            (by_last, states, -steps.whitener @ steps.transition),
            (by_next, states, steps.whitener),
            (by_input, constants, -steps.whitener @ steps.input),
            (basis, states, steps.bases()),
        ):
            out[:, states[:, :, None], columns[:, None]] = np.swapaxes(blocks, 0, 1)
        log_det = np.concatenate([log_det, steps.log_det.sum(0, keepdims=True)])
    return Motion(by_last, by_next, by_input, log_det.sum(0), basis, index)


def start(components: Sequence[Component]) -> tuple[Array, Array]:
    """Return the prior of the first state of several processes.

    Returns its covariance (n, n), and the matrix (n, K) that maps the inputs to its mean.
    """
    covariance = block_diagonal([c.start_covariance for c in components])
    return covariance, block_diagonal([c.start_from_input for c in components])


def start_factors(
    components: Sequence[Component],
    keys: Sequence[ArrayLike],
    deviation: Array,
    basis: Array,
    inputs: Array,
) -> LinearFactors:
    """Return the priors of M first states as factors on increments of the state and on the inputs.

    keys : (M,) of the states and, if there are inputs, (M,) of these.
    deviation : (M, n) state minus its mean without inputs.
    basis : (M, n, n) in which the increments of the states are expressed.
    inputs : (M, K).
    """
    covariance, by_input = start(components)
    whitener = whitener_of(covariance)
    count = len(deviation)
    by_inputs = np.broadcast_to(-whitener @ by_input, (count, *by_input.shape))
    rhs = -(deviation - inputs @ by_input.T) @ whitener.T
    log_det = np.full(count, log_det_of(whitener))
    return LinearFactors(tuple(keys), (whitener @ basis, by_inputs)[: len(keys)], rhs, log_det)
