"""Covariances that know that the hyper-parameters were learned (Laplace's approximation).

Every learned parameter is moved by one standard deviation up and down; by how much the smoothed
positions, velocities and offsets move with it is added to their covariances. The parameters count
as independent, which errs on the wide side where they are not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.shake_channels import Channel, channels_of
from telerig.estimator.shake_evidence import ChannelPosterior, channel_posterior
from telerig.estimator.shake_parameters import value_of, with_values
from telerig.estimator.smoother.model import ShakeModel
from telerig.estimator.smoother.solve import Covariances, Solution

Array = NDArray[np.float64]

_FARTHEST = 0.5


def inflated(solution: Solution) -> Solution:
    """The solution with the spread by its model's ``learned`` parameters in its covariances.

    Bubbles beyond those that learning looks at get the mean spread of those. Unchanged without
    covariances or learned parameters.
    """
    found, model, problem = solution.covariances, solution.frame.model, solution.frame.problem
    if found is None or not model.learned or not problem.bubbles:
        return solution
    channels = [c for c in channels_of(problem, solution.weights) if c.samples]
    directions = np.array([c.direction for c in channels])
    spreads = [_spread(c, model) for c in channels]
    # coordinates along the channels, which need not be at right angles, back into the lab
    lab = np.linalg.pinv(directions)
    bubbles = found.bubbles.copy()
    for kind, rows in ((0, solution.frame.bubble.position), (1, solution.frame.bubble.velocity)):
        along = np.stack([_rows(solution, c, s[kind]) for c, s in zip(channels, spreads)], -1)
        into = np.linalg.pinv(rows) @ lab
        bubbles += np.einsum("ik,nk,jk->nij", into, along, into, optimize=True)
    shake = _shaken(solution, channels, [s[2] for s in spreads], found)
    return replace(solution, covariances=replace(found, bubbles=bubbles, shake=shake))


def _spread(channel: Channel, model: ShakeModel) -> tuple[Array, Array, Array]:
    """Variances (B, F) of positions and velocities, (J, F) of offsets, by the parameters."""
    total = [np.zeros(1), np.zeros(1), np.zeros(1)]
    for name, sigma in model.learned.items():
        at, step = value_of(model, name), min(sigma, _FARTHEST)
        up, down = (
            channel_posterior(channel, with_values(model, [name], [at * np.exp(sign * step)]))
            for sign in (1, -1)
        )
        for i, (high, low) in enumerate(zip(_means(up), _means(down))):
            total[i] = total[i] + ((high - low) / 2 * (sigma / step)) ** 2
    return total[0], total[1], total[2]


def _means(found: ChannelPosterior) -> tuple[Array, Array, Array]:
    return found.position_mm, found.velocity_mm_s, found.offset_mm


def _rows(solution: Solution, channel: Channel, variance: Array) -> Array:
    """(rows,) of the bubbles' states, from (B, F) of the channel's bubbles."""
    frame = solution.frame
    number = np.full(len(frame.problem.bubbles), -1)
    movers = channel.bubble[channel.moving]
    number[movers] = np.arange(len(movers))
    mine = number[frame.bubble_of_row]
    each = variance[mine, frame.frame_of_row]
    return np.asarray(np.where(mine >= 0, each, variance.mean(0)[frame.frame_of_row]))


def _shaken(
    solution: Solution, channels: list[Channel], spreads: list[Array], found: Covariances
) -> Array:
    """(F, D, D) covariance of the shake's states, offsets widened along what the cameras see."""
    layout, out = solution.frame.shake, found.shake.copy()
    for channel, variance in zip(channels, spreads):
        rows = np.einsum("i,cid->cd", channel.direction, layout.offset[list(channel.cameras)])
        if not np.any(rows):
            continue
        into = np.linalg.pinv(rows)
        out += np.einsum("dk,kf,ek->fde", into, variance, into, optimize=True)
    return out
