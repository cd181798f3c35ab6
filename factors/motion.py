"""Motion priors as whitened linear factors: the steps of several processes side by side."""

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
    """Steps of several components side by side, whitened: W (x' - Phi x - G c) has unit noise.

    by_next, by_last : (U, n, n) W and -W Phi.  by_input : (U, n, K) -W G.  log_det : (U,) of W.
    basis : (U + 1, n, n), see `Steps.bases`.
    index : (M,) which of the U distinct steps each step is.
    """

    by_last: Array
    by_next: Array
    by_input: Array
    log_det: Array
    basis: Array
    index: Ints

    def residual(self, last: Array, following: Array, inputs: ArrayLike) -> Array:
        """(M, n) whitened residuals of states (M, n), (M, n) and inputs (M, K) or (K,)."""
        i = self.index
        constant = np.broadcast_to(np.asarray(inputs, float), (len(i), self.by_input.shape[-1]))
        terms = ((self.by_next, following), (self.by_last, last), (self.by_input, constant))
        return np.asarray(sum(np.einsum("mij,mj->mi", a[i], x) for a, x in terms))

    def factors(
        self,
        keys: Sequence[ArrayLike],
        states: tuple[Array, Array],
        inputs: Array,
        following: Ints,
    ) -> LinearFactors:
        """The steps as M factors on increments of both states in their bases, and on the inputs.

        keys : of the states before and after, (M,) each, and of the inputs where there are any.
        states : before and after, (M, n) each.  inputs : (M, K).  following : see `in_basis`.
        """
        residual = self.residual(*states, inputs)
        blocks = (*self.in_basis(following), self.by_input[self.index])
        return LinearFactors(tuple(keys), blocks[: len(keys)], -residual, self.log_det[self.index])

    def in_basis(self, following: Ints) -> tuple[Array, Array]:
        """(M, n, n) by_last and by_next for increments in the bases of the two states.

        following : (M,) index into ``basis`` of each step's second state.
        """
        last, ahead, place = self.distinct_in_basis(following)
        return last[place], ahead[place]

    def distinct_in_basis(self, following: Ints) -> tuple[Array, Array, Ints]:
        """As `in_basis`, but only those that differ, and (M,) which of them each step has."""
        count = len(self.basis)
        own, place = np.unique(self.index * count + following % count, return_inverse=True)
        step, after = np.divmod(own, count)
        return self.by_last[step] @ self.basis[step], self.by_next[step] @ self.basis[after], place


def motion(components: Sequence[Component], dt_s: ArrayLike, *, batched: bool = False) -> Motion:
    """The steps dt_s (M,) of independent components, states and inputs one after the other.

    batched : components of one kind in one batch of arrays, which pays where few steps are worked
    out a thousand times.
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
    """(n, n) covariance of the states at the start, and (n, K) their mean for given inputs."""
    covariance = block_diagonal([c.start_covariance for c in components])
    return covariance, block_diagonal([c.start_from_input for c in components])


def start_factors(
    components: Sequence[Component],
    keys: Sequence[ArrayLike],
    deviation: Array,
    basis: Array,
    inputs: Array,
) -> LinearFactors:
    """The priors of M first states, as factors on increments in their basis and on the inputs.

    keys : of the states, (M,), and of the inputs where there are any.  deviation : (M, n) from the
    mean without inputs.  basis : (M, n, n).  inputs : (M, K).
    """
    covariance, by_input = start(components)
    whitener = whitener_of(covariance)
    count = len(deviation)
    by_inputs = np.broadcast_to(-whitener @ by_input, (count, *by_input.shape))
    rhs = -(deviation - inputs @ by_input.T) @ whitener.T
    log_det = np.full(count, log_det_of(whitener))
    return LinearFactors(tuple(keys), (whitener @ basis, by_inputs)[: len(keys)], rhs, log_det)
