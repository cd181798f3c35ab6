"""The best ways to give each row of a table a column of its own, or none: exactly, best first.

Rows are tracks, columns measurements, and a table is one hypothesis about the past.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count

import numpy as np
from scipy.optimize import linear_sum_assignment

from telerig.arrays import Array, Ints

Options = Sequence[Sequence[tuple[int, float]]]
"""For each row its possible columns with their scores."""

Way = tuple[int, tuple[int, ...], float]
"""A table's index, the column of each row (-1: none), and the total score."""


def alternatives(
    tables: Sequence[tuple[float, Options]], within_log_ratio: float, most: int
) -> list[Way]:
    """Return the best ways to give each row of one of several tables a column of its own or none.

    tables : (score, options) of each, with the same rows; the score is added to those of options.
    within_log_ratio : ways whose score is smaller than the best one's by more than this are left
        out.
    most : number of ways, best first; if there are more, the best way that uses an option follows
        for each option that these do not use.

    The ways are ranked exactly (Murty, Operations Research 16:682, 1968): those that differ from
    the best way are divided by the first row that differs, and each part has a best way, too.
    """
    best = [_Part.of_table(k, *table) for k, table in enumerate(tables)]
    worst = min((part.cost for part in best), default=0.0) + within_log_ratio
    heap: list[tuple[float, int, _Part]] = []
    numbers = count()
    for part in best:
        heappush(heap, (part.cost, next(numbers), part))
    found: list[_Part] = []
    while heap and heap[0][0] <= worst and len(found) < most:
        part = heappop(heap)[2]
        found.append(part)
        for other in part.others():
            heappush(heap, (other.cost, next(numbers), other))
    if len(found) == most:
        found += _of_each_option(best, found, worst)
    return [(part.table, part.columns, -part.cost) for part in found]


@dataclass(frozen=True)
class _Part:
    """Hold a part of the ways of a table, and the best of them.

    table : its number. names : (P,) columns of the places that rows may take, -1 for none.
    costs : (R, P) negative scores, infinite for what is not allowed. base : added to them.
    first : number of rows that take the same place in all ways of the part.
    cost : of the best way; infinite if there is none. taken : (R,) the places that its rows take.
    """

    table: int
    names: Ints
    costs: Array
    base: float
    first: int
    cost: float
    taken: Ints

    @staticmethod
    def of_table(table: int, score: float, options: Options) -> _Part:
        columns = sorted({column for row in options for column, _ in row})
        place = {column: i for i, column in enumerate(columns)}
        rows = np.arange(len(options))
        costs = np.full((len(rows), len(columns) + len(rows)), np.inf)
        costs[rows, len(columns) + rows] = 0.0
        for row, scores in enumerate(options):
            for column, own in scores:
                costs[row, place[column]] = -own
        names = np.array([*columns, *(-1 for _ in options)], np.int64)
        return _Part.of(table, names, costs, -score, 0)

    @staticmethod
    def of(table: int, names: Ints, costs: Array, base: float, first: int) -> _Part:
        try:
            rows, taken = linear_sum_assignment(costs)
            cost = base + float(costs[rows, taken].sum())
        except ValueError:  # no way is allowed
            taken, cost = np.zeros(0, np.intp), np.inf
        return _Part(table, names, costs, base, first, cost, taken)

    def others(self) -> Iterator[_Part]:
        """Yield the other ways of this part, by the first row that differs from its best way."""
        left = self.costs.copy()
        for row in range(self.first, len(self.taken)):
            other, own = left.copy(), left[row, self.taken[row]]
            other[row, self.taken[row]] = np.inf
            if np.isfinite(other[row]).any():
                yield _Part.of(self.table, self.names, other, self.base, row)
            left[row] = np.inf
            left[row, self.taken[row]] = own

    def through(self, row: int, column: int) -> _Part:
        """Return the ways in which this row takes a given column."""
        other = self.costs.copy()
        other[row, self.names != column] = np.inf
        return _Part.of(self.table, self.names, other, self.base, 0)

    @property
    def columns(self) -> tuple[int, ...]:
        """The column of each row in the best way, -1 for none."""
        return tuple(self.names[self.taken].tolist())

    @property
    def options(self) -> set[tuple[int, int]]:
        """All rows and columns that a way may contain."""
        rows, places = np.nonzero(np.isfinite(self.costs))
        return {*zip(rows.tolist(), self.names[places].tolist())}


def _of_each_option(best: Sequence[_Part], found: Sequence[_Part], worst: float) -> list[_Part]:
    """Return for each option that ``found`` does not use the best way that does, if near enough.

    best : the whole tables.
    """
    used = {option for part in found for option in enumerate(part.columns)}
    out: dict[tuple[int, ...], _Part] = {}
    for option in set[tuple[int, int]]().union(*(part.options for part in best)) - used:
        nearest = min((part.through(*option) for part in best), key=lambda part: part.cost)
        if nearest.cost <= worst:
            out[nearest.columns] = nearest
    return sorted(out.values(), key=lambda part: part.cost)
