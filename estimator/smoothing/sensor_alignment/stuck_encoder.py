"""An encoder whose reading stays while the carriage moves."""

from __future__ import annotations

import numpy as np

from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.image_motion import directions
from telerig.estimator.smoothing.problem.problem import SmoothingProblem

_STUCK_S = 0.05
_MOVING_MM_S = 20.0


def stuck(problem: SmoothingProblem) -> list[Finding]:
    """Return a finding if the encoder's reading is constant while the carriage must be moving."""
    stage = problem.stage
    if stage is None:
        return []
    t, x = stage.t_s, stage.position_mm
    inside = (t >= problem.t_s[0]) & (t <= problem.t_s[-1])
    t, x = t[inside], x[inside]
    if len(t) < 20:
        return []
    change = np.flatnonzero(np.diff(x) != 0)
    ends = np.r_[-1, change, len(x) - 1]
    longest = int(np.argmax(np.diff(ends)))
    first, last = int(ends[longest]) + 1, int(ends[longest + 1])
    length = float(t[last] - t[first])
    if length < _STUCK_S or last - first < 10:
        return []
    if len(change):
        around = np.r_[np.diff(x[: first + 1])[-10:], np.diff(x[last:])[:10]]
        pace = float(np.median(np.diff(t)))
        moving = len(around) > 0 and np.median(np.abs(around)) / pace > _MOVING_MM_S
    else:
        moving = _sweeps(problem)
    if not moving:
        return []
    return [
        Finding(
            f"the encoder reads {x[first]:.6g} mm from {t[first]:.6g} to {t[last]:.6g} s without "
            "any change, while the carriage moves: it is stuck",
            "stage",
            "leave those rows out or repair the encoder; without the stage's positions, positions "
            "and velocities are relative to the carriage",
            Code.ENCODER_STUCK,
        )
    ]


def _sweeps(problem: SmoothingProblem) -> bool:
    """Return whether the carriage moves according to the images, although the encoder is constant.

    It does if marks move through the images, or if there are none and all bubbles rest in them.
    """
    speeds = []
    for observed in (problem.references, problem.observations):
        for c, camera in enumerate(problem.cameras):
            mine = np.flatnonzero(observed.camera == c)
            axis = directions(camera) @ problem.axis
            if not len(mine) or axis @ axis < 0.1:
                continue
            place = camera.unproject(observed.uv_px[mine])[0] @ directions(camera).T @ axis
            for item in np.unique(observed.item[mine])[:50]:
                one = mine[observed.item[mine] == item]
                x, t = place[observed.item[mine] == item], problem.t_s[observed.frame[one]]
                if len(one) > 10:
                    speeds.append(abs(float(np.polyfit(t - t[0], x, 1)[0])))
        if speeds:
            fast = float(np.median(speeds)) > _MOVING_MM_S
            return fast if observed is problem.references else not fast
    return False
