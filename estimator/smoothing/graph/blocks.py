"""Covariances as an elimination returns them."""

from __future__ import annotations

from dataclasses import dataclass

from telerig.arrays import Array


@dataclass(frozen=True)
class Blocks:
    """Covariances of increments, in their bases.

    own : of each family of keys, (n, d, d); the shake's at the frames.
    cross : (rows, Ds, Db) of the shake with each bubble at the same frame.
    """

    own: list[Array]
    cross: Array
