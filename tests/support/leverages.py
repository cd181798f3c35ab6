"""Leverages of pixels from the posterior's covariance: another way to what residuals are drawn for.

They hold where the encoder's scale and the calibration are known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.linear import images
from telerig.estimator.smoothing.graph.solve import Solution

SAMPLED = 1000


def leverages(solution: Solution) -> list[tuple[Ints, Array]]:
    """Return by camera var(prediction) / var(noise) (m, 2) of some bubbles' pixels (m,)."""
    graph, found = solution.graph, solution.covariances
    observed = graph.problem.observations
    if found is None or not len(observed):
        return []
    every = [np.flatnonzero(observed.camera == camera) for camera in np.unique(observed.camera)]
    chosen = [m[np.linspace(0, len(m) - 1, min(len(m), SAMPLED)).astype(int)] for m in every]
    few = replace(graph.problem, observations=observed.of(np.concatenate(chosen)))
    weight = np.ones(len(few.observations))
    linear = images(replace(graph, problem=few), solution.state, weight).linear
    out = []
    for some, part in zip(chosen, linear, strict=True):
        row, node = np.asarray(part.keys[0]) - graph.base().bubbles, np.asarray(part.keys[1])
        at = graph.frame_of_row[row]
        by_bubble = part.blocks[0] @ np.linalg.inv(graph.bubble_basis(row))
        by_shake = part.blocks[1] @ np.linalg.inv(graph.shake_basis(node))
        if graph.to_frames is not None:
            by_shake = by_shake @ np.linalg.inv(graph.to_frames[at])
        both = by_shake @ found.cross[found.cross_of_row[row]]
        leverage = (by_bubble @ found.bubbles[row] * by_bubble).sum(-1)
        leverage += (by_shake @ found.shake[at] * by_shake).sum(-1)
        leverage += 2 * (both * by_bubble).sum(-1)
        out.append((some, leverage))
    return out
