"""What the bubbles' states tell that is eliminated for a fixed rig (`bubble_chains`).

The way of each bubble with the share of the rig in its error, and positions as they would be known
if the shake were. Nothing is solved again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.graph.accelerations import add_slow_noise
from telerig.estimator.smoothing.graph.bubble_chains import BubbleChains, bubble_chains
from telerig.estimator.smoothing.graph.draws import Draws
from telerig.estimator.smoothing.graph.layout import GraphLayout, State, variances
from telerig.estimator.smoothing.graph.linear import PIXELS, SampleWeights, all_factors
from telerig.factors.linear_factors import AT_ONCE, LinearFactors

_STILL_MM_S = 1e-9


def shake_known_variances(
    graph: GraphLayout, state: State, weights: tuple[Array, Array], samples: SampleWeights | None
) -> Array:
    """Return variances (rows, 3) in mm^2 of the bubbles' positions if the shake were known.

    What the images do not show of the calibration is left. The encoder's scale is known.

    weights, samples : of the solution's pixels and of its accelerometers' samples.
    """
    factors = all_factors(graph, state, weights, samples)
    chains = bubble_chains(graph, factors)
    known = graph.bubble_covariances(chains.covariances(chains.places.place_of_row))
    add_slow_noise(graph, state, known)
    at = graph.bubble.position
    variance = variances(at, known)
    if not graph.share_size:
        return variance
    pushed = np.zeros((graph.rows, graph.bubble.size, graph.share_size))
    information = np.eye(graph.share_size)
    for linear in (f for f in factors if f.kind == PIXELS):
        by_share = linear.blocks[2][..., graph.encoder_size :]
        row = np.asarray(linear.keys[0]) - graph.base().bubbles
        np.add.at(pushed, row, -linear.blocks[0].mT @ by_share)
        flat = by_share.reshape(-1, graph.share_size)
        information += flat.T @ flat
    gain = _solved(chains, pushed)
    information -= np.einsum("nda,ndb->ab", pushed, gain)
    moved = np.concatenate([
        graph.in_bubble_basis(at[None], mine) @ gain[mine]
        for mine in np.array_split(np.arange(graph.rows), -(-graph.rows // AT_ONCE))
    ])  # fmt: skip
    root = np.linalg.inv(np.linalg.cholesky(information))
    return np.asarray(variance + ((moved @ root.T) ** 2).sum(-1))


def way_variances(
    graph: GraphLayout,
    state: State,
    factors: Sequence[LinearFactors],
    chains: BubbleChains,
    draws: Draws,
) -> tuple[Array, Array]:
    """Return variances in mm^2 of the displacement (K, 3) of K bubbles from the first frame of each
    track to its last one, and of the length (K,) of that way.

    The steps of the way have the directions of the velocity. The share of the rig comes from draws
    of its errors, which move the bubbles.

    chains : the bubbles, eliminated for a fixed rig.  draws : at the solution.
    """
    first, last = graph.first_row[:-1], graph.first_row[1:] - 1
    velocity = state.bubbles @ graph.bubble.velocity.T
    along = velocity / np.maximum(np.linalg.norm(velocity, axis=-1, keepdims=True), _STILL_MM_S)
    step = (along[1:] + along[:-1]) / 2
    step[last[:-1]] = 0.0
    by_place = np.zeros((graph.rows, 3, 4))
    by_place[last, :, :3] += np.eye(3)
    by_place[first, :, :3] -= np.eye(3)
    by_place[1:, :, 3] += step
    by_place[:-1, :, 3] -= step
    rows = graph.in_bubble_basis(graph.bubble.position[None], np.arange(graph.rows))
    by_state = rows.mT @ by_place
    own = np.add.reduceat((by_state * _solved(chains, by_state)).sum(1), first)
    pushed = np.zeros((graph.rows, graph.bubble.size, draws.errors.shape[-1]))
    shake, constants = draws.of_family(graph, "shake"), draws.of_family(graph, "constants")[0]
    for linear in (f for f in factors if f.kind == PIXELS):
        by_rig = linear.blocks[1] @ shake[np.asarray(linear.keys[1])]
        by_rig += linear.blocks[2] @ constants
        row = np.asarray(linear.keys[0]) - graph.base().bubbles
        np.add.at(pushed, row, -linear.blocks[0].mT @ by_rig)
    moved = np.einsum("nsk,nsd->nkd", by_state, _solved(chains, pushed))
    variance = own + (np.add.reduceat(moved, first) ** 2).mean(-1)
    return variance[:, :3], variance[:, 3]


def _solved(chains: BubbleChains, side: Array) -> Array:
    """Return the bubbles' states (rows, D, N) for right sides of the normal equations."""
    place, means = chains.places.place_of_row, np.zeros((len(chains.mean), 3, side.shape[-1]))
    rows = np.empty_like(side)
    rows[place] = side
    return np.asarray(chains.solved(rows, means)[0][place])
