"""A long run is smoothed in pieces: which frames each is solved with, and what they share.

Each piece is solved with more frames on both sides, which are not taken from its solution: 1.5
times as long as the slowest process remembers, and where a bubble is hidden in all of the piece,
from its sightings before and after, if memory allows. What is constant along the run (biases,
delays and scales of sensors, the encoder's scale, the calibration, marks) is known to a piece from
all others: a first round, of pieces without margins, collects the information of each on them
(docs/decisions/032). A run that fits into one piece is solved as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.layout import (
    GraphLayout,
    clocks_of,
    shake_layout,
)
from telerig.estimator.smoothing.graph.linear import constant_priors, constant_values
from telerig.estimator.smoothing.graph.solve import Options, Progress, Solution, solve
from telerig.estimator.smoothing.learning.window import frames_of_observations, most_seen
from telerig.estimator.smoothing.problem.problem import (
    ConstantFamily,
    Known,
    ShakeModel,
    SmoothingProblem,
)
from telerig.estimator.smoothing.problem.window import Window, all_of

MOST_ROWS, MOST_FRAMES = 60_000, 12_000
"""Frames of all bubbles together, and frames, that are solved in one piece."""
_ROWS, _FRAMES = 24_000, 10_000
"""Of a piece of a run that has more. With the margins of 20 bubbles it takes less than 1 GB."""
_DECAY_TIMES = 1.5
_CONSTANT = 1e-6
Sizes = dict[ConstantFamily, tuple[int, int]]
_FAMILIES: tuple[ConstantFamily, ...] = ("sensors", "constants", "marks", "clocks")


@dataclass(frozen=True)
class Piece:
    """One piece of a long run that is smoothed in pieces.

    first, end : the frames for which its results are used, from ``first`` to before ``end``.
    low, high : the frames with which it is solved, which include margins on both sides.
    """

    first: int
    end: int
    low: int
    high: int

    @property
    def own(self) -> range:
        """The frames for which its results are used, counted from its first solved frame."""
        return range(self.first - self.low, self.end - self.low)

    def without_margin(self) -> Piece:
        """Return the same piece without margins, so that it is solved with its own frames only."""
        return Piece(self.first, self.end, self.first, self.end)

    def cut(self, problem: SmoothingProblem) -> Window:
        """Return the part of the run with which it is solved; all of it is the run itself."""
        if (self.low, self.high) == (0, len(problem.t_s)):
            return Window(problem, 0, np.arange(len(problem.bubbles)))
        return all_of(problem, self.low, self.high)


def pieces_of(
    problem: SmoothingProblem, model: ShakeModel, frames: int | None = None
) -> list[Piece]:
    """Return the pieces of a run, equally long; a single one for a run that fits into memory.

    frames : of a piece, without its margins; None for as many as memory allows.
    """
    count, rows = len(problem.t_s), sum(len(b) for b in problem.bubbles)
    if frames is None:
        fits = rows <= MOST_ROWS and count <= MOST_FRAMES
        frames = count if fits else min(_FRAMES, max(int(_ROWS * count / max(rows, 1)), 2))
    number = -(-count // frames)
    edges = np.linspace(0, count, number + 1).round().astype(int).tolist()
    if number == 1:
        return [Piece(0, count, 0, count)]
    margin, sightings = margin_s(problem, model), _Sightings.of(problem)
    out = []
    for first, end in pairwise(edges):
        t = problem.t_s[[first, end - 1]] + np.array([-margin, margin])
        low, high = np.searchsorted(problem.t_s, t, side="right").tolist()
        # a margin longer than the piece itself would cost more than one piece for all
        low, high = max(low, 2 * first - end, 0), min(high, 2 * end - first, count)
        piece = Piece(first, end, min(low, first), max(high, end))
        wider = sightings.reached(piece)
        # as large as a piece becomes with its widest margins
        fits = sightings.rows(wider) <= 3 * _ROWS and wider.high - wider.low <= 3 * _FRAMES
        out.append(wider if fits else piece)
    return out


class _Sightings(NamedTuple):
    """When the B bubbles of a run of F frames are seen.

    first, last : (B,) first and last frame of each.
    keys : frame + F * bubble of all sightings, in ascending order.
    frames : F.
    """

    first: Ints
    last: Ints
    keys: Ints
    frames: int

    @classmethod
    def of(cls, problem: SmoothingProblem) -> _Sightings:
        seen, count = problem.observations, len(problem.t_s)
        ends = np.array([(b.first, b.last) for b in problem.bubbles], np.int64).reshape(-1, 2)
        keys = np.unique(seen.item.astype(np.int64) * count + seen.frame)
        return cls(ends[:, 0], ends[:, 1], keys, count)

    def rows(self, piece: Piece) -> int:
        """Return the number of frames of all bubbles with which a piece is solved."""
        length = np.minimum(self.last, piece.high - 1) - np.maximum(self.first, piece.low) + 1
        return int(length.clip(0).sum())

    def reached(self, piece: Piece) -> Piece:
        """Return the piece with margins that begin at the sightings before and after of bubbles
        that are hidden in all of its own frames: without them only a prior tells their places."""
        here = np.flatnonzero((self.first < piece.first) & (self.last >= piece.end))
        begin = here * self.frames
        after = np.searchsorted(self.keys, begin + piece.first)
        hidden = after == np.searchsorted(self.keys, begin + piece.end)
        here, begin, after = here[hidden], begin[hidden], after[hidden]
        if not len(here):
            return piece
        low = np.maximum(self.keys.take(after - 1, mode="clip") - begin, self.first[here])
        high = np.minimum(self.keys.take(after, mode="clip") - begin, self.last[here]) + 1
        margins = piece.first - piece.low, piece.high - piece.end
        return replace(
            piece,
            low=max(min(piece.first, int(low.min())) - margins[0], 0),
            high=min(max(piece.end, int(high.max())) + margins[1], self.frames),
        )


def with_clock_numbers(problem: SmoothingProblem) -> SmoothingProblem:
    """Return the problem with sensors that share a clock in every part if they do in the run.

    Within a piece two records may have the same times although one of them lacks samples elsewhere;
    thinned records differ where samples of one are masked.
    """
    numbered = zip(problem.accelerometers, clocks_of(problem).tolist())
    return replace(
        problem, accelerometers=tuple(replace(a, clock_number=number) for a, number in numbered)
    )


def piece_with_most(problem: SmoothingProblem, pieces: Sequence[Piece]) -> int:
    """Return the index of a piece in which much is seen, by the rule of `most_seen`."""
    edges = [pieces[0].first, *(piece.end for piece in pieces)]
    return most_seen(np.histogram(frames_of_observations(problem), edges)[0])


def margin_s(problem: SmoothingProblem, model: ShakeModel) -> float:
    """Return by how much neighbouring pieces of a run overlap on either side, in s.

    It is `_DECAY_TIMES` times the longest decay time of the rig's processes and of the bubbles'
    velocity. A bubble's other processes need no overlap, because each frame determines them.
    """
    drifts = [part.drift for part in shake_layout(problem, model).components if part.drift.size]
    rates = np.concatenate([[0.0], *(-np.linalg.eigvals(drift).real for drift in drifts)])
    slowest = 1 / float(np.min(rates[rates > _CONSTANT], initial=np.inf))
    return _DECAY_TIMES * max(slowest, model.bubble.velocity_tau_s)


def solved_pieces(
    problem: SmoothingProblem,
    model: ShakeModel,
    pieces: Sequence[Piece],
    options: Options,
    progress: Progress,
    constants: Constants | None,
    chosen: Sequence[int] | None = None,
) -> Iterator[tuple[Piece, Window, Solution]]:
    """Yield the solution of each piece of a run, one after the other.

    constants : the run's information about them; None where there are none.
    chosen : which pieces; None for all.
    """
    numbers, count = range(len(pieces)) if chosen is None else chosen, len(pieces)
    before = count - len(numbers)
    if before:
        progress(f"going on, {before} of {count} pieces are finished", before / count)
    for done, number in enumerate(numbers, before):
        piece = pieces[number]
        progress(f"piece {done + 1} of {count}", done / count)
        window = piece.cut(problem)
        known = (
            replace(window.problem, known=())
            if constants is None
            else constants.given(window.problem, model, number)
        )
        yield piece, replace(window, problem=known), solve(known, model, options)


class Told(NamedTuple):
    """What a piece without its margins tells of the C constants of the run.

    at : (c,) places of the piece's own constants among those of the run.
    prior, prior_mean : (c,) information and means of their priors.
    information, side : (c, c) information matrix Lambda, and (c,) Lambda times the estimate.
    """

    at: Ints
    prior: Array
    prior_mean: Array
    information: Array
    side: Array

    @classmethod
    def of(cls, solution: Solution, problem: SmoothingProblem) -> Told:
        """Return what a piece's solution tells, whose constants have a joint covariance.

        problem : that of the run.
        """
        graph, state, joint = solution.graph, solution.state, solution.constants
        assert joint is not None
        at = _places(graph, problem, _sizes(problem, graph.model))
        values = _flat(constant_values(graph, state))
        prior, mean, below = np.zeros(len(at)), np.zeros(len(at)), 0
        for linear in constant_priors(graph, state):
            sigma = np.diagonal(linear.blocks[0], axis1=1, axis2=2)
            mine = slice(below, below + sigma.size)
            prior[mine] = sigma.ravel() ** 2
            mean[mine] = values[mine] + (linear.rhs / sigma).ravel()
            below = mine.stop
        whole = np.linalg.inv(joint)
        side = np.asarray(whole @ values - prior * mean)
        return cls(at, prior, mean, np.asarray(whole - np.diag(prior)), side)


def first_round(
    problem: SmoothingProblem,
    model: ShakeModel,
    pieces: Sequence[Piece],
    options: Options,
    progress: Progress,
    chosen: Sequence[int] | None = None,
) -> Iterator[tuple[Piece, Told]]:
    """Yield what each piece tells of the run's constants; nothing where nothing is constant.

    pieces : without margins.
    options : their covariances are not computed.
    chosen : which pieces; None for all.
    """
    if _count(_sizes(problem, model)):
        options = replace(options, covariances=False, draws=False, constants=True)
        for piece, _, solution in solved_pieces(
            problem, model, pieces, options, progress, None, chosen
        ):
            yield piece, Told.of(solution, problem)


@dataclass(frozen=True)
class Constants:
    """Hold the information of each of P pieces of a run about the C constants of the run.

    problem : that of the run.
    pieces : with their margins.
    prior, prior_mean : (C,) information and means of the priors.
    information, side : (P, C, C) information matrix Lambda of each piece without its margins, and
        (P, C) Lambda times its estimate.
    """

    problem: SmoothingProblem
    pieces: tuple[Piece, ...]
    prior: Array
    prior_mean: Array
    information: Array
    side: Array

    @classmethod
    def of(
        cls,
        problem: SmoothingProblem,
        model: ShakeModel,
        pieces: Sequence[Piece],
        told: Iterable[Told],
    ) -> Constants | None:
        """Return the information of all pieces; None where nothing is constant along the run.

        told : by each piece.
        """
        count = _count(_sizes(problem, model))
        if not count:
            return None
        prior, mean = np.ones(count), np.zeros(count)
        information, side = np.zeros((len(pieces), count, count)), np.zeros((len(pieces), count))
        for number, one in enumerate(told):
            prior[one.at], mean[one.at] = one.prior, one.prior_mean
            information[number][np.ix_(one.at, one.at)] = one.information
            side[number][one.at] = one.side
        return cls(problem, tuple(pieces), prior, mean, information, side)

    @property
    def mean(self) -> Array:
        """The constants (C,) that all pieces together determine."""
        side = self.side.sum(0) + self.prior * self.prior_mean
        return np.asarray(np.linalg.solve(self.total, side))

    @property
    def total(self) -> Array:
        """The information matrix (C, C) of all pieces and of the priors."""
        return np.asarray(self.information.sum(0) + np.diag(self.prior))

    def given(self, problem: SmoothingProblem, model: ShakeModel, number: int) -> SmoothingProblem:
        """Return the problem of a piece with the information of all other pieces on the constants.

        What the margins of the piece contain of its neighbours is not counted twice. Factors of
        GTSAM have three keys at most, so the information on each constant is expressed together
        with the constants of encoder and calibration and with the constant before it, in the order
        of the keys; marks are in the order in which they are passed.
        """
        rest, side = self.information.sum(0), self.side.sum(0)
        for other, share in self._shares(number).items():
            rest = rest - share * self.information[other]
            side = side - share * self.side[other]
        covariance = np.linalg.inv(rest + np.diag(self.prior))
        mean = covariance @ (side + self.prior * self.prior_mean)
        here = _here(problem, self.problem, _sizes(self.problem, model))
        shared: _Constant = (("constants", 0), here["constants"][0])
        before: _Constant | None = None
        known = list[Known]()
        if len(shared[1]):
            at = shared[1]
            information = np.linalg.inv(covariance[np.ix_(at, at)]) - np.diag(self.prior[at])
            right = np.linalg.solve(covariance[np.ix_(at, at)], mean[at])
            right -= self.prior[at] * self.prior_mean[at]
            root = _root(information)
            place = np.linalg.lstsq(information, right, rcond=1e-12)[0]
            known.append(Known((shared[0],), (root,), root @ place))
        for family, index, at in _in_turn(here, problem):
            given = [one for one in (shared, before) if one is not None and len(one[1])]
            known.append(_conditional(((family, index), at), given, mean, covariance))
            before = ((family, index), at)
        return replace(problem, known=tuple(known))

    def _shares(self, number: int) -> dict[int, float]:
        """Return for each piece the share of its own frames that one is solved with."""
        low, high = self.pieces[number].low, self.pieces[number].high
        both = np.array([min(high, p.end) - max(low, p.first) for p in self.pieces])
        length = np.array([p.end - p.first for p in self.pieces])
        return {int(i): float(both[i] / length[i]) for i in np.flatnonzero(both > 0)}


_Constant = tuple[tuple[ConstantFamily, int], Ints]
"""Key of a constant, and its (n,) places among those of the run."""


def _in_turn(
    here: Mapping[ConstantFamily, Ints], problem: SmoothingProblem
) -> Iterator[tuple[ConstantFamily, int, Ints]]:
    """Yield family, number and places of all constants but those of encoder and calibration."""
    passed = np.full(len(problem.marks), len(problem.t_s))
    np.minimum.at(passed, problem.references.item, problem.references.frame)
    for family, places in here.items():
        if family != "constants" and places.size:
            order = np.argsort(passed, kind="stable") if family == "marks" else range(len(places))
            yield from ((family, int(index), places[index]) for index in order)


def _conditional(
    one: _Constant, given: Sequence[_Constant], mean: Array, covariance: Array
) -> Known:
    """Return what is known of one constant given others, from the covariance (C, C) of all."""
    key, at = one
    others = np.concatenate([np.zeros(0, np.int64), *(places for _, places in given)])
    cross = covariance[np.ix_(at, others)]
    gain = cross @ np.linalg.pinv(covariance[np.ix_(others, others)], hermitian=True)
    left = covariance[np.ix_(at, at)] - gain @ cross.T
    root = _root(np.linalg.inv(left))
    gains = np.split(gain, np.cumsum([len(places) for _, places in given])[:-1], axis=1)
    return Known(
        (key, *(k for k, _ in given)), (root, *(-root @ g for g in gains if given)),
        root @ (mean[at] - gain @ mean[others]),
    )  # fmt: skip


def _root(information: Array) -> Array:
    """Return R (n, n) with R^T R the given matrix."""
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    return np.asarray(np.sqrt(values.clip(0))[:, None] * vectors.T)


def _flat(values: Mapping[str, Array]) -> Array:
    return np.concatenate([values[family].ravel() for family in _FAMILIES])


def _sizes(problem: SmoothingProblem, model: ShakeModel) -> Sizes:
    """Number and dimension of the run's constants by family."""
    read, share = problem.stage is not None, problem.calibration
    encoder = int(read and model.encoder_scale_sigma > 0)
    directions = 0 if share is None else share.root.shape[1]
    clocks = int(clocks_of(problem).max(initial=-1)) + 1
    return {
        "sensors": (len(problem.accelerometers), 3 + (model.accelerometer_scale_sigma > 0)),
        "constants": (1, encoder + directions),
        "marks": (len(problem.marks), 3),
        "clocks": (clocks, int(model.accelerometer_delay_sigma_s > 0)),
    }


def _count(sizes: Sizes) -> int:
    return sum(number * dimension for number, dimension in sizes.values())


def _here(
    problem: SmoothingProblem, whole: SmoothingProblem, sizes: Sizes
) -> dict[ConstantFamily, Ints]:
    """Return the places (N, n) of a piece's constants among the run's, by family."""
    names = [a.name for a in whole.accelerometers]
    sensors = [names.index(a.name) for a in problem.accelerometers]
    clocks = clocks_of(whole)[sensors].tolist()
    marks = [m.name for m in whole.marks]
    chosen: dict[ConstantFamily, list[int]] = {
        "sensors": sensors,
        "constants": [0],
        "marks": [marks.index(m.name) for m in problem.marks],
        "clocks": list(dict.fromkeys(clocks)),
    }
    out, begin = dict[ConstantFamily, Ints](), 0
    for family in _FAMILIES:
        number, size = sizes[family]
        rows = np.array(chosen[family], np.int64).reshape(-1, 1)
        out[family] = begin + rows * size + np.arange(size)
        begin += number * size
    return out


def _places(graph: GraphLayout, whole: SmoothingProblem, sizes: Sizes) -> Ints:
    """Return the places (c,) of a piece's constants among the run's, in the order of its keys."""
    here = _here(graph.problem, whole, sizes)
    return np.concatenate([here[family].ravel() for family in _FAMILIES])
