"""Tests whether the residuals of all bubbles, or of all marks, of one camera move together.

A right model leaves nothing that all images of a camera share: the shake has taken it. If the
camera is touched, rolls or is refocused, or if what it looks through swings, its images shift, turn
or grow together, from one time on or at one frequency. Each of these motions is a score test (Rao,
Linear Statistical Inference, 1973, section 6e): the sum of the residuals along the motion is
compared with the sums that draws of a right model leave, in which shake and bubbles have followed
it as far as they can. Where they follow nearly all of it, the residuals would show an error of the
priors as such a motion, and it is not tested.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.sensors.response import FALSE_ALARMS
from telerig.estimator.smoothing.graph.linear import pixel_whiteners, white_noise
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.problem.problem import FEWEST_BUBBLES, Observations

_MOTIONS = ("shift", "shift", "turn", "growth")
"""Values of `Disagreement`, in the order of `_derivatives`."""
_CUTS = 20
"""A camera may have been touched at the end of every twentieth of the run. The noise of a step is
that of as many of the lowest frequencies, and of a line that of as many around it."""
_LEAST_CYCLES = 3
_LEAST_OF_STEP, _LEAST_OF_LINE = 0.005, 0.1
"""Shares of a motion's squares that the fit has to leave. Of a step the shake leaves one jump; of a
line in a shake that it follows it leaves the error of the prior, up to six standard deviations in
sound runs."""
_NEAR = 5
"""Neighbouring frequencies at which draws have the same level, which few show badly."""
_LEAST_OF_OTHERS = 0.5
"""Without one bubble or mark at least this share of what is expected of the others is left."""
_LEAST, _ROUNDING = 1e-300, 1e-6


class Scores(NamedTuple):
    """Scores of one motion of a camera's images in F frames: sums of the residuals along it.

    seen, drawn : (F,) of the run, and (F, K) of K draws of a right model.
    full : (F,) their variance if nothing were fitted.
    shares : function from weights (F,) of the frames to whether all bubbles or marks have a share
        in the weighted sum of ``seen``.
    """

    seen: Array
    drawn: Array
    full: Array
    shares: Callable[[Array], bool] = lambda weight: True


class Shared(NamedTuple):
    """A motion that the images of a source share.

    camera : its name.  motion : of `_MOTIONS`.  hz : frequency; None for a step at ``from_s``.
    sigmas : standard deviations of what a right model leaves.
    """

    camera: str
    motion: str
    from_s: float
    to_s: float
    hz: float | None
    sigmas: float


class Found(NamedTuple):
    """A step of a motion at a frame, or a spectral line at a frequency per frame.

    start : frame; 0 for a line.  hz : None for a step.
    size_px : of the step, or the line's amplitude.
    sigmas : standard deviations of what a right model leaves.
    chance : probability that a right model leaves as much at any time, or at any frequency.
    """

    start: int
    hz: float | None
    size_px: float
    sigmas: float
    chance: float


def shared_motion(
    solution: Solution, source: str, drawn: Array, own: range, pieces: float
) -> Shared | None:
    """Return the least probable motion that the images of a source share in a camera, or None.

    It counts if it is found in fewer than `FALSE_ALARMS` of all right runs, and if it is larger
    than the noise that is stated of a bubble's pixel: standard deviations of places hold what is
    smaller. A camera whose shake nothing but the bubbles shows is not tested for a shift, and marks
    of one whose arm has no sensor not for one at a frequency: the arm may swing like that.

    source : "bubbles" or "marks".  drawn : (M, 2, K) its residuals in K draws of a right model.
    own : frames of the solution that count.  pieces : how many times as many the run has.
    """
    problem, best = solution.graph.problem, None
    cameras = problem.cameras
    measured = problem.arms_with_sensor | set(problem.references.camera.tolist())
    least = FALSE_ALARMS / (pieces * 2 * len(cameras) * len(_MOTIONS) * 2)  # steps and lines
    for camera in range(len(cameras)):
        kinds = zip(_MOTIONS, _scores(solution, source == "marks", camera, drawn, own))
        for kind, scores in kinds:
            if kind == "shift" and camera not in measured:
                continue
            for one in strongest(scores):
                swings = source == "marks" and kind == "shift" and one.hz is not None
                if swings and camera not in problem.arms_with_sensor:
                    continue
                if one.chance < least and one.size_px > _stated_px(problem.observations, camera):
                    least, best = one.chance, (one, camera, kind)
    if best is None:
        return None
    one, camera, kind = best
    t_s = problem.t_s[own.start : own.stop]
    rate = (len(t_s) - 1) / float(t_s[-1] - t_s[0])
    hz = None if one.hz is None else one.hz * rate
    start, end = float(t_s[one.start]), float(t_s[-1])
    return Shared(cameras[camera].name, kind, start, end, hz, one.sigmas)


def _scores(
    solution: Solution, marks: bool, camera: int, drawn: Array, own: range
) -> Iterator[Scores]:
    """Yield the scores of each of `_MOTIONS`; none where too few are seen at a time."""
    graph, problem = solution.graph, solution.graph.problem
    obs, noise = problem.observations, white_noise(graph)[camera]
    within = white_noise(graph, 1.0)[camera]  # slow errors of outlines are stated, too
    if marks:
        obs, noise, within = problem.references, np.eye(2), np.eye(2)
    mine = (obs.camera == camera) & (obs.frame >= own.start) & (obs.frame < own.stop)
    seen, frame = obs.of(mine), obs.frame[mine] - own.start
    if len(seen) < max(1, FEWEST_BUBBLES * len(np.unique(frame))):
        return
    root = np.sqrt(solution.weights[int(marks)][mine])[:, None]
    whitener = pixel_whiteners(graph, seen.covariance_px2, noise, marks=marks)
    residual = solution.residuals[int(marks)][mine]
    predicted_px = seen.uv_px + np.linalg.solve(whitener, residual[..., None])[..., 0]
    whitener, residual = whitener * root[:, None], residual @ within * root
    reach = max(problem.cameras[camera].image_size_px) / 2
    for by in _derivatives(predicted_px, frame, reach):
        along = np.einsum("mij,mj->mi", whitener, by)
        score = (along * residual).sum(1)
        of_draws = np.einsum("mi,mik->mk", along, drawn[mine])
        squares = (along**2).sum(1)
        seen_by, drawn_by, full = (
            _by_frame(frame, values, len(own)) for values in (score, of_draws, squares)
        )
        shares = partial(_is_shared, seen.item, frame, score, squares)
        yield Scores(seen_by, drawn_by, full, shares)


def _is_shared(item: Ints, frame: Ints, score: Array, squares: Array, weight: Array) -> bool:
    """Return whether a motion is that of the others, too, without any one bubble or mark.

    A bubble that oscillates has lines of its own, and a mark may be lost: no camera's motion.

    score, squares : (M,) of each sighting, and its variance. Of a motion that all share the
        weighted sum of scores is as the sum of these.
    """
    each = np.zeros(item.max() + 1, weight.dtype)
    np.add.at(each, item, score * weight[frame])
    part = np.bincount(item, squares * np.abs(weight[frame]) ** 2)
    expected = np.abs(each.sum()) * (1 - part / part.sum().clip(_LEAST))
    return bool((np.abs(each.sum() - each) >= _LEAST_OF_OTHERS * expected).all())


def _derivatives(predicted_px: Array, frame: Ints, reach_px: float) -> Array:
    """Return the derivatives (4, M, 2) of pixels: shift along u and v, turn and growth.

    The last two are about the middle of what is seen in the frame, so that they contain no shift,
    and in px at the edge of the image. Measured pixels contain the noise that the residuals do, and
    of bubbles that are close together it would be a growth.
    """
    frame = np.unique(frame, return_inverse=True)[1]
    middle = np.stack([np.bincount(frame, x) for x in predicted_px.T], -1)
    away = (predicted_px - (middle / np.bincount(frame)[:, None])[frame]) / reach_px
    one = np.ones_like(away)
    turn = away[:, ::-1] * [-1.0, 1.0]
    return np.stack([one * [1.0, 0.0], one * [0.0, 1.0], turn, away])


def _by_frame(frame: Ints, values: Array, frames: int) -> Array:
    out = np.zeros((frames, *values.shape[1:]))
    np.add.at(out, frame, values)
    return out


def _stated_px(obs: Observations, camera: int) -> float:
    """Return the median noise of a camera's bubbles along one direction; 0 without bubbles."""
    mine = obs.covariance_px2[obs.camera == camera]
    return float(np.sqrt(np.median(np.trace(mine, axis1=1, axis2=2)) / 2)) if len(mine) else 0.0


def strongest(scores: Scores) -> Iterator[Found]:
    """Yield the least probable step and spectral line, of those that the fit leaves.

    Draws show the level of a right model, so that steps have Student's and lines Fisher's
    distribution. Noise that is correlated raises the level of all frequencies near one, and counts
    as noise.
    """
    from scipy.ndimage import median_filter
    from scipy.stats import f as fisher
    from scipy.stats import t as student

    frames, draws = scores.drawn.shape
    if frames < 2 * _CUTS:
        return
    total = max(float(scores.full.sum()), _LEAST)
    # an error that is constant is one of the calibration
    seen, drawn = (
        x - np.multiply.outer(scores.full / total, x.sum(0)) for x in (scores.seen, scores.drawn)
    )
    power = np.abs(np.fft.rfft(seen)[1 : (frames + 1) // 2]) ** 2
    each = (np.abs(np.fft.rfft(drawn, axis=0)[1 : len(power) + 1]) ** 2).mean(1)
    level = _averaged(each).clip(_LEAST)
    excess = power / level / np.log(2)  # its median is 1

    start = np.linspace(0, frames, _CUTS + 1)[1:-1].astype(int)
    after = np.arange(frames) >= start[:, None]
    along = after - (after @ scores.full / total)[:, None]
    variance, share = _variance(along, drawn, scores.full)
    correlated = max(1.0, float(np.median(excess[:_CUTS])))
    step = along @ seen
    sigmas = np.abs(step) / np.sqrt(variance * correlated)
    chance = 2 * len(start) * student.sf(sigmas, 2 * draws * _NEAR)
    for i in _least_probable(chance, share >= _LEAST_OF_STEP, lambda i: scores.shares(along[i])):
        size = abs(float(step[i] / variance[i]))
        yield Found(int(start[i]), None, size, float(sigmas[i]), float(chance[i]))

    near = np.abs(np.arange(-_CUTS // 2, _CUTS // 2 + 1)) > _NEAR // 2
    correlated = median_filter(excess, footprint=near).clip(1.0)
    sigmas = np.sqrt(power / level / correlated)
    chance = len(power) * fisher.sf(sigmas**2, 2, 2 * draws * _NEAR)
    slow = np.arange(len(level)) + 1 < _LEAST_CYCLES
    turn = -2j * np.pi * np.arange(frames) / frames
    left = (level / total >= _LEAST_OF_LINE) & ~slow
    for i in _least_probable(chance, left, lambda i: scores.shares(np.exp((1 + i) * turn))):
        size = 2 * float(np.sqrt(power[i]) / level[i])
        yield Found(0, (1 + i) / frames, size, float(sigmas[i]), float(chance[i]))


def _least_probable(chance: Array, left: Bools, shared: Callable[[int], bool]) -> Iterator[int]:
    """Yield the index of the least chance (n,) of those that are left (n,), if there is one.

    What counts as found has to be shared, too.
    """
    for i in np.flatnonzero(left)[np.argsort(chance[left], kind="stable")].tolist():
        if chance[i] >= FALSE_ALARMS or shared(i):
            yield i
            return


def _variance(along: Array, drawn: Array, full: Array) -> tuple[Array, Array]:
    """Return the variances (n,) of sums of scores with weights (n, F), by draws (F, K), and the
    shares (n,) that the fit has left of them.

    Few draws show a sum's square badly, and the level of neighbouring frequencies well: the scores
    over the square root of their full variance have a spectrum that is the same in all of the run.
    Where that is not so, and the squares of the sums are larger, these count.
    """
    root = np.sqrt(full)
    white = np.divide(drawn, root[:, None], out=np.zeros_like(drawn), where=root[:, None] > 0)
    level = (np.abs(np.fft.rfft(white, axis=0)) ** 2).mean(1) / max(np.count_nonzero(full), 1)
    weight = 2 / len(full) * np.abs(np.fft.rfft(along * root)) ** 2
    share = weight @ level / (along**2 @ full).clip(_ROUNDING * max(full.sum(), _LEAST))
    variance = np.maximum(weight @ _averaged(level), ((along @ drawn) ** 2).mean(1))
    return variance.clip(_LEAST), share


def _averaged(values: Array) -> Array:
    """Return the mean of each value and its neighbours, `_NEAR` in all."""
    near = np.ones(_NEAR)
    return np.convolve(values, near, "same") / np.convolve(np.ones(len(values)), near, "same")
