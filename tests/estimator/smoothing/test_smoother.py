"""The passes of the smoothing graph: their memory, an interruption, and how states are laid out."""

from __future__ import annotations

import gc
import threading
import weakref
from typing import Any

import numpy as np
import pytest
from shake_learning_data import run, true_model

from telerig.estimator.smoothing.graph import layout
from telerig.estimator.smoothing.graph import solve as solver
from telerig.estimator.smoothing.graph.solve import in_large_stack, solve
from telerig.factors.bubble_motion import BubbleModel, Process, bubble_processes
from telerig.factors.state_space import slow_ou


def test_the_path_is_found_among_other_processes_of_a_bubble(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def more(model: BubbleModel, direction: np.ndarray) -> list[Process]:
        drift = {"rms": ("rms", 0.1), "tau_s": ("tau_s", 0.5)}
        return [*bubble_processes(model, direction), Process("bubble", slow_ou, drift)]

    monkeypatch.setattr(layout, "bubble_processes", more)
    found = layout.bubble_layout(BubbleModel(), 2)
    np.testing.assert_array_equal(found.path_position, [0, 3, 6])
    assert all(found.position[axis, 3 * axis] == 1 for axis in range(3))
    np.testing.assert_array_equal(found.velocity[:, found.path_velocity], np.eye(3))


def test_a_pass_is_freed_before_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    """An outlier takes several passes, each of which may fill the memory."""
    given, *_ = run(np.random.default_rng(1), bubbles=2, seconds=0.1, marks=2)
    made, alive = list[weakref.ref[Any]](), list[int]()

    def counted(*arguments: Any) -> Any:
        alive.append(sum(one() is not None for one in made))
        found = of_graph(*arguments)
        made.append(weakref.ref(found))
        return found

    of_graph = solver._linear_solve
    monkeypatch.setattr(solver, "_linear_solve", counted)
    given.observations.uv_px[5] += 20.0
    found = solve(given, true_model())
    assert found.weights[0][5] == 0
    assert len(alive) > 2 and not any(alive)


def test_an_interruption_gives_the_garbage_collector_back(monkeypatch: pytest.MonkeyPatch) -> None:
    done = threading.Event()

    def interrupted(_self: threading.Thread, _timeout: float | None = None) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "join", interrupted)
        with pytest.raises(KeyboardInterrupt):
            in_large_stack(done.set)
    assert done.wait(10) and gc.isenabled()
