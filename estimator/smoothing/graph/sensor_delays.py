"""Delays of the accelerometers: the nodes of the states move with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.estimator.smoothing.graph.state import Frame, State, frame_of

_DELAY_STEP_S = 3e-5
_DELAY_LEAP_S = 2e-3


def late(frame: Frame, state: State) -> bool:
    """Whether a sensor's delay has moved so far that its samples belong elsewhere."""
    if not (frame.sensor_flags[1] and frame.problem.accelerometers):
        return False
    return bool(np.max(np.abs(state.clocks)) >= _DELAY_STEP_S)


def restamped(frame: Frame, state: State) -> tuple[Frame, State, bool]:
    """Move the nodes of sensors whose estimated delay has moved."""
    if not late(frame, state):
        return frame, state, False
    leap = np.clip(state.clocks[frame.clock_of, 0], -_DELAY_LEAP_S, _DELAY_LEAP_S)
    fresh = frame_of(frame.problem, frame.model, frame.delays_s + leap)
    shake = np.stack(
        [np.interp(fresh.nodes.t_s, frame.nodes.t_s, column) for column in state.shake.T], -1
    )
    clocks = np.zeros_like(state.clocks)
    return fresh, replace(state, shake=shake, clocks=clocks), True
