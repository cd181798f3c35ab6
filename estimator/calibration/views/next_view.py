"""The next best view: how to hold the target so that the calibration gains most.

For every candidate pose the covariance that the calibration would have with that view is exact to
first order: the view's information, its own pose eliminated, joins the joint covariance of cameras
and dots (Haner and Heyden, Optimal view path planning for visual SLAM, SCIA 2011, choose views by
the same trace). What is minimised is the calibration's share of the variance of triangulated
points over the working volume. The candidates are a fixed table of poses: a search between its
entries was measured to gain 1 % more, less than a hand holding the target loses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.quality.checks import RECOMMENDED_VIEWS
from telerig.estimator.calibration.solver.covariance import JointCovariance
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.views.gain import ViewGain
from telerig.estimator.calibration.views.poses import (
    Candidates,
    candidates,
    dots_seen,
    new_cells,
    spread_dots,
)
from telerig.estimator.calibration.views.wording import hold_words, reason_words
from telerig.factors.projection import State

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

ENOUGH_SHARE = 0.05
"""A view that lowers the standard deviation by less is not worth taking."""
ALIKE_SHARE = 0.9
"""Of the best gain: among such candidates the one that fills most of the empty image is taken."""
_NOTABLE_SHARE = 0.5
_SHOWN = 3
_WHOLE_UM = 100.0
_MANY_DOTS = 150


@dataclass(frozen=True)
class HeldPose:
    """One way to hold the target: after_um is the 3-D sd that the calibration would then have."""

    rig_from_target: Array
    after_um: float
    words: str
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class NextView:
    """Advice after ``views`` views.

    before_um : standard deviation per axis of points over the working volume, the calibration's
    share, their common rigid motion set aside.  poses : best first; none when no pose of the table
    is seen by two cameras.  size_um : what the stated uncertainty of the target's known
    distance and print leaves, which no view can lower.  marks : ids of the target's marks.
    """

    views: int
    before_um: float
    poses: tuple[HeldPose, ...]
    size_um: float = 0.0
    marks: tuple[int, ...] = ()

    @property
    def after_um(self) -> float:
        return self.poses[0].after_um if self.poses else self.before_um

    @property
    def gain(self) -> float:
        """Share by which the best view lowers the standard deviation."""
        return 1 - self.after_um / self.before_um

    def enough(self) -> bool:
        """Whether there are views enough and another one would bring little."""
        many = self.views >= RECOMMENDED_VIEWS
        return many and bool(self.poses) and self.gain < ENOUGH_SHARE

    def verdict(self) -> str:
        """What another view would bring."""
        if not self.poses:
            good = rounded_um(self.before_um)
            return f"{self.views} views; points are good to {good} µm, and no pose was found to add"
        worth = ": these views are enough" if self.enough() else ""
        return (
            f"{self.views} views; one more would reduce the calibration's share of the errors of "
            f"points from {rounded_um(self.before_um, self.after_um)} to "
            f"{rounded_um(self.after_um, self.before_um)} µm{self._floor()}{worth}"
        )

    def _floor(self) -> str:
        if self.size_um < _NOTABLE_SHARE * self.before_um:
            return ""
        return f" ({rounded_um(self.size_um)} µm remain: the target's size is known no better)"

    def words(self) -> str:
        """Verdict, and how to hold the target."""
        if not self.poses or self.enough():
            return self.verdict()
        best = self.poses[0]
        because = f" ({'; '.join(best.reasons)})" if best.reasons else ""
        return f"{self.verdict()}. Next: {best.words}{because}"

    def as_dict(self) -> dict[str, Any]:
        """For `Calibration.diagnostics`."""
        return {
            "words": self.words(), "verdict": self.verdict(), "views": self.views,
            "before_um": self.before_um, "after_um": self.after_um, "enough": self.enough(),
            "size_um": self.size_um, "marks": list(self.marks),
            "poses": [
                {
                    "words": p.words, "reasons": list(p.reasons), "after_um": p.after_um,
                    "rig_from_target": np.round(p.rig_from_target, 6).tolist(),
                }
                for p in self.poses
            ],
        }  # fmt: skip


def next_view(problem: Problem, state: State, joint: JointCovariance) -> NextView | None:
    """The best ways to hold the target next; None for a single camera, or a rig left undetermined.

    The candidates' noise is the median of the dots so far. Of many dots some stand for all, which
    promises slightly too little, as the dots' own uncertainty is averaged over fewer of them.
    """
    if len(problem.cameras) < 2 or not np.isfinite(joint.rig_block()[1]).all():
        return None
    few, many = spread_dots(problem), spread_dots(problem, _MANY_DOTS)
    gain = ViewGain.of(problem, state, joint, np.union1d(few, many))
    kept = problem.weight > 0
    images = np.unique(np.stack([problem.view[kept], problem.camera[kept]], 1), axis=0)
    views = int((np.bincount(images[:, 0]) > 1).sum())
    found = candidates(problem, state)
    if not len(found):
        return NextView(views, gain.before_um, (), gain.size_um)
    gained_um = gain.before_um - gain.after_um(found, few)
    chosen = found.some(_preferred(problem, state, found, gained_um, few))
    poses = tuple(
        HeldPose(
            chosen.rig_from_target[i],
            float(after_um),
            hold_words(problem, state, chosen.some(slice(i, i + 1))),
            reason_words(problem, state, chosen.some(slice(i, i + 1))),
        )
        for i, after_um in enumerate(gain.after_um(chosen, many))
    )
    marks = problem.dot_ids[problem.target.is_mark(problem.dot_ids)]
    return NextView(views, gain.before_um, poses, gain.size_um, tuple(int(m) for m in marks))


def _preferred(
    problem: Problem, state: State, found: Candidates, gained_um: Array, dots: Ints
) -> Ints:
    """Up to three candidates of different tilts, those nearly as good as the best first.

    The lens model that the views so far have chosen may lack what acts where no dot has been:
    among those nearly as good, the one that fills most of the empty image is preferred.
    """
    order = np.argsort(-gained_um, kind="stable")
    alike = order[gained_um[order] >= ALIKE_SHARE * gained_um[order[0]]]
    seen = dots_seen(problem, state, found.some(alike), dots)
    fills = np.array([new_cells(problem, v, uv).sum() for v, uv in zip(*seen)])
    ranked = np.r_[alike[np.argsort(-fills, kind="stable")], order[len(alike) :]]
    _, first = np.unique(found.tilt[ranked], return_index=True)
    return np.asarray(ranked[np.sort(first)[:_SHOWN]])


def rounded_um(value: float, other: float = np.nan) -> str:
    """Digits enough to tell the two apart, and no powers of ten."""
    if value >= _WHOLE_UM:
        return f"{value:.0f}"
    digits = 2
    while digits < 4 and f"{value:.{digits}g}" == f"{other:.{digits}g}":
        digits += 1
    return f"{value:.{digits}g}"
