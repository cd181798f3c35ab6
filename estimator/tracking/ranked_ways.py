"""The best ways to give each row of a table a column of its own, or none: exactly, best first.

Rows are tracks, columns measurements, and a table is one hypothesis about the past.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from heapq import heappop, heappush
from itertools import count

import numpy as np
from scipy.optimize import linear_sum_assignment

from telerig.arrays import Array, Ints

_ROUNDING = 1e-9
"""Prices that change by less (log-likelihood ratio) are final."""

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
    the best way are divided by the first row that differs, and each part has a best way, too. A
    part is solved when no other one can be better.
    """
    best = [_Part.of(_Table.of(k, *table)) for k, table in enumerate(tables)]
    worst = min((part.cost for part in best), default=0.0) + within_log_ratio
    best = [_Part.of(part.narrowed(worst)) for part in best if part.cost <= worst]
    heap: list[tuple[float, int, _Part, int]] = []
    numbers = count()

    def push(cost: float, part: _Part, row: int = -1) -> None:
        if cost <= worst:
            heappush(heap, (cost, next(numbers), part, row))

    for part in best:
        push(part.cost, part)
    found: list[_Part] = []
    while heap and len(found) < most:
        _, _, part, row = heappop(heap)
        if row >= 0:
            solved = part.otherwise(row)
            push(solved.cost, solved)
            continue
        found.append(part)
        for row, bound in enumerate(part.bounds()[part.first :].tolist(), part.first):
            push(bound, part, row)
    if heap:
        found += _of_each_option(best, found, worst)
    return [(part.table.number, part.columns, -part.cost) for part in found]


@dataclass(frozen=True)
class _Table:
    """Hold the costs (negative scores) of a table, without the rows that have no choice.

    number : of the table. names : columns of the P places, -1 for the place none of each row.
    taken : place of each of the R rows; of the rows that have no choice it is final.
    rows, places : (K,) and (L,) numbers of the rows that have a choice and of the places that they
        may take. costs : (K, L), infinite for what is not allowed. base : cost of all other rows.
    """

    number: int
    names: Ints
    taken: Ints
    rows: Ints
    places: Ints
    costs: Array
    base: float

    @staticmethod
    def of(number: int, score: float, options: Options) -> _Table:
        columns = sorted({column for row in options for column, _ in row})
        place = {column: i for i, column in enumerate(columns)}
        rows, every = np.arange(len(options)), np.arange(len(columns) + len(options))
        costs = np.full((len(rows), len(every)), np.inf)
        costs[rows, len(columns) + rows] = 0.0
        for row, scores in enumerate(options):
            for column, own in scores:
                costs[row, place[column]] = -own
        names = np.array([*columns, *(-1 for _ in options)], np.int64)
        return _Table(number, names, np.full(len(rows), -1), rows, every, costs, -score)


@dataclass(frozen=True)
class _Part:
    """Hold a part of the ways of a table, and the best of them.

    allowed : (K, L) costs of the table, infinite for what is not allowed in this part.
    first : number of rows that take the same place in all ways of the part.
    cost : of the best way; infinite if there is none. taken : (K,) what its rows take: positions in
        the table's ``places``.
    """

    table: _Table
    allowed: Array
    first: int
    cost: float
    taken: Ints

    @staticmethod
    def of(table: _Table, allowed: Array | None = None, first: int = 0) -> _Part:
        costs = table.costs if allowed is None else allowed
        try:
            rows, taken = linear_sum_assignment(costs)
        except ValueError:  # no way is allowed
            return _Part(table, costs, first, np.inf, np.zeros(0, np.intp))
        return _Part(table, costs, first, table.base + float(costs[rows, taken].sum()), taken)

    @cached_property
    def more(self) -> Array:
        """What a way costs more than the best one at least, by the place (K, L) that a row takes.

        These are the reduced costs; the prices of the places solve the dual problem.
        """
        own = self.allowed - self.allowed[np.arange(len(self.taken)), self.taken][:, None]
        price, before = np.zeros(own.shape[1]), np.ones(own.shape[1])
        while np.max(before - price, initial=0.0) > _ROUNDING:
            before = price
            price = np.min(own + price[self.taken][:, None], 0, initial=0.0)
        return own + price[self.taken][:, None] - price

    def bounds(self) -> Array:
        """Return for each row a lower bound of the cost of the ways in which it takes another place
        than in the best way (K,)."""
        more = self.more.copy()
        more[np.arange(len(more)), self.taken] = np.inf
        return np.asarray(self.cost + np.min(more, 1, initial=np.inf))

    def narrowed(self, worst: float) -> _Table:
        """Return the table without what no way of at most this cost takes."""
        table, near = self.table, self.cost + self.more <= worst
        free = near.sum(1) > 1
        fixed = np.flatnonzero(~free)
        near[:, self.taken[fixed]] = False
        places = np.flatnonzero(near[free].any(0))
        taken = table.taken.copy()
        taken[table.rows] = table.places[self.taken]
        costs = np.where(near, table.costs, np.inf)[np.ix_(free, places)]
        base = table.base + float(table.costs[fixed, self.taken[fixed]].sum())
        return _Table(
            table.number, table.names, taken, table.rows[free], table.places[places], costs, base
        )

    def otherwise(self, row: int) -> _Part:
        """Return the ways in which this row is the first one that differs from the best way."""
        other, fixed = self.allowed.copy(), np.arange(self.first, row)
        other[fixed] = np.inf
        other[fixed, self.taken[fixed]] = self.allowed[fixed, self.taken[fixed]]
        other[row, self.taken[row]] = np.inf
        return _Part.of(self.table, other, row)

    def through(self, row: int, place: int) -> _Part:
        """Return the ways in which this row takes a given place."""
        other = self.allowed.copy()
        other[row] = np.inf
        other[row, place] = self.allowed[row, place]
        return _Part.of(self.table, other)

    @property
    def columns(self) -> tuple[int, ...]:
        """The column of each row of the whole table in the best way, -1 for none."""
        taken = self.table.taken.copy()
        taken[self.table.rows] = self.table.places[self.taken]
        return tuple(self.table.names[taken].tolist())


def _of_each_option(best: Sequence[_Part], found: Sequence[_Part], worst: float) -> list[_Part]:
    """Return for each option that ``found`` does not use the best way that does, if near enough.

    best : the whole tables.
    """
    used = {option for part in found for option in enumerate(part.columns)}
    trials: dict[tuple[int, int], list[tuple[float, int, int, int]]] = {}
    for k, part in enumerate(best):
        table = part.table
        for option in enumerate(part.columns):
            trials.setdefault(option, []).append((part.cost, k, -1, -1))
        for row, place in np.argwhere(part.cost + part.more <= worst).tolist():
            option = int(table.rows[row]), int(table.names[table.places[place]])
            bound = part.cost + float(part.more[row, place])
            trials.setdefault(option, []).append((bound, k, row, place))
    out: dict[tuple[int, ...], _Part] = {}
    for option in trials.keys() - used:
        nearest, cost = None, worst
        for bound, k, row, place in sorted(trials[option]):
            if bound > cost:
                break
            part = best[k] if row < 0 else best[k].through(row, place)
            if part.cost <= cost:
                nearest, cost = part, part.cost
        if nearest is not None:
            out[nearest.columns] = nearest
    return sorted(out.values(), key=lambda part: part.cost)
