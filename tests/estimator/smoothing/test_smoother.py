"""The smoothing graph against a dense Gaussian posterior that shares no discretisation with it."""

from __future__ import annotations

import gc
import threading
import weakref
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from telerig.estimator.smoothing.graph import layout
from telerig.estimator.smoothing.graph import solve as solver
from telerig.estimator.smoothing.graph.layout import graph_layout
from telerig.estimator.smoothing.graph.solve import Options, in_large_stack, solve
from telerig.estimator.smoothing.problem.problem import (
    Accelerometer,
    BroadBand,
    Bubble,
    CarriageModel,
    Mark,
    Observations,
    RigMode,
    ShakeModel,
    SmoothingProblem,
    Stage,
)
from telerig.factors.bubble_motion import BubbleModel, Process, Zigzag, bubble_processes
from telerig.factors.state_space import Component, slow_ou
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

UP = np.array([0.0, -1.0, 0.0])
SIGMA_PX = 0.5
QUIET = Options(robust=False)


def rig() -> tuple[Camera, Camera]:
    rotation = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    return (
        Camera.create("left", (1024, 1024), 10.0),
        Camera.create("right", (1024, 1024), 10.0, camera_from_rig=Pose(rotation, np.zeros(3))),
    )


MODEL = ShakeModel(
    bubble=BubbleModel(
        zigzags=(Zigzag(6.0, 0.05, (2.0, 0.0, 2.0)), Zigzag(12.0, 0.03, (0, 0.2, 0)))
    ),
    modes=(
        RigMode(20.0, 0.03, (0.06, 0.12, 0.06)),
        RigMode(32.0, 0.03, (0.03, 0.07, 0.03), camera=0),
        RigMode(32.0, 0.03, (0.03, 0.07, 0.03), camera=1),
    ),
    encoder_sigma_mm=0.001,
)


def problem(rng: np.random.Generator, *, sensors: bool = False, marks: bool = False) -> Any:
    """Fourteen frames at irregular times with a gap, two bubbles, some pixels missing."""
    cameras, frames = rig(), 14
    t = np.cumsum(rng.uniform(1.5e-3, 3e-3, frames))
    t[9:] += 0.02
    rows = []
    bubbles = []
    for k, (first, last) in enumerate(((0, 13), (3, 10))):
        lab = np.array([1.0, -2.0, 3.0]) * k + 280 * t[:, None] * UP
        place = lab[first : last + 1] + rng.normal(size=(last - first + 1, 3))
        bubbles.append(Bubble(k, first, last, place[0], place))
        for f in range(first, last + 1):
            for c, camera in enumerate(cameras):
                if rng.random() < 0.85 or f in (first, last):
                    seen = camera.project(lab[f] - 280 * t[f] * UP) + rng.normal(size=2)
                    rows.append((k, f, c, seen))
    item, frame, camera_of, uv = (np.array(column) for column in zip(*rows))
    noise = np.array([[1.0, 0.3], [0.3, 1.0]]) * SIGMA_PX**2
    pixels = Observations(item, frame, camera_of, uv, np.tile(noise, (len(uv), 1, 1)))
    sampled = np.sort(np.concatenate([[t[0] - 1e-3], t, t[:-1] + 0.4 * np.diff(t)]))
    encoder = sampled[::2] if sensors else t
    stage = Stage(encoder, 280 * encoder + 0.001 * rng.normal(size=len(encoder)))
    accelerometers = ()
    if sensors:
        times = sampled
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        accelerometers = tuple(
            Accelerometer(
                name,
                j,
                times,
                9806.65 * UP @ turn.T + 300 * rng.normal(size=(len(times), 3)),
                turn,
                7.0,
            )
            for j, name in enumerate(("a", "b"))
        )
    references, features = Observations.none(), ()
    if marks:
        frame = np.repeat(np.arange(frames), 2)
        which = np.tile([0, 1], frames)
        uv = np.array([500.0, 400.0]) + 3 * rng.normal(size=(len(frame), 2)) + 2.8 * frame[:, None]
        noise = np.tile(0.01 * np.eye(2), (len(frame), 1, 1))
        references = Observations(which, frame, which, uv, noise)
        features = (Mark("m0", np.array([1.0, 2, 3])), Mark("m1", np.array([-1.0, 1, 2]), 20.0))
    return SmoothingProblem(
        cameras, t, UP, UP, tuple(bubbles), pixels, stage, accelerometers, features, references
    )


@dataclass
class Dense:
    """One joint Gaussian: mean and covariance of a growing vector, and rows of measurements."""

    mean: list[Any]
    blocks: list[Any]
    rows: list[tuple[dict[int, Any], float, float]]

    def add(self, mean: Any, covariance: Any) -> int:
        self.mean.append(np.atleast_1d(mean))
        self.blocks.append(np.atleast_2d(covariance))
        return len(self.mean) - 1

    def posterior(self) -> tuple[Any, Any, Any, float]:
        sizes = [len(m) for m in self.mean]
        starts = np.r_[0, np.cumsum(sizes)]
        prior = np.zeros((starts[-1], starts[-1]))
        for i, block in enumerate(self.blocks):
            prior[starts[i] : starts[i + 1], starts[i] : starts[i + 1]] = block
        mean = np.concatenate(self.mean)
        operator = np.zeros((len(self.rows), starts[-1]))
        value, noise = np.zeros(len(self.rows)), np.zeros(len(self.rows))
        for r, (terms, y, sigma) in enumerate(self.rows):
            for i, row in terms.items():
                operator[r, starts[i] : starts[i + 1]] += row
            value[r], noise[r] = y, sigma**2
        total = operator @ prior @ operator.T + np.diag(noise)
        gain = np.linalg.solve(total, operator @ prior).T
        rest = value - operator @ mean
        evidence = -0.5 * (
            rest @ np.linalg.solve(total, rest) + np.linalg.slogdet(2 * np.pi * total)[1]
        )
        return mean + gain @ rest, prior - gain @ operator @ prior, starts, float(evidence)


def path_covariance(component: Component, t: Any) -> Any:
    """(n T, n T) joint covariance of a component at times t, from its start at t[0]."""
    n, count = component.size, len(t)
    out = np.zeros((count, n, count, n))
    nodes, weights = np.polynomial.legendre.leggauss(40)
    p = component.start_covariance
    for i in range(count):
        if i:
            dt = t[i] - t[i - 1]
            phi = expm(component.drift * dt)
            p = phi @ p @ phi.T
            for x, w in zip(nodes, weights):
                gain = expm(component.drift * dt * (x + 1) / 2) @ component.noise
                p = p + gain @ gain.T * w * dt / 2
        if component.memoryless:
            p = component.start_covariance
        out[i, :, i] = p
        for j in range(i + 1, count):
            ahead = expm(component.drift * (t[j] - t[i]))
            if component.memoryless:
                ahead = np.zeros((n, n))
            out[i, :, j] = p @ ahead.T
            out[j, :, i] = ahead @ p
    return out.reshape(count * n, count * n)


def dense(given: SmoothingProblem, model: ShakeModel) -> tuple[Dense, Any, Any, Any]:
    """The problem as a joint Gaussian; ids of the shake's and the bubbles' components."""
    graph = graph_layout(given, model, np.zeros(len(given.accelerometers)))
    whole = Dense([], [], [])
    times = graph.nodes.t_s
    at_node = lambda row, node, count: np.kron(np.eye(count)[node], row)  # noqa: E731
    shake = []
    for i, c in enumerate(graph.shake.components):
        mean = np.zeros(len(times) * c.size)
        if i == 0:
            mean[:: c.size] = graph.nominal_mm if c.memoryless else graph.nominal_mm[0]
        shake.append(whole.add(mean, path_covariance(c, times)))
    sizes = np.r_[0, np.cumsum([c.size for c in graph.shake.components])]

    def of_shake(row: Any, node: int, gain: float = 1.0) -> dict[int, Any]:
        return {
            shake[i]: gain * at_node(row[sizes[i] : sizes[i + 1]], node, len(times))
            for i in range(len(shake))
        }

    bubbles, means = _add_bubbles(given, whole, graph)
    bubble_sizes = np.r_[0, np.cumsum([c.size for c in graph.bubble.components])]

    def of_bubble(k: int, f: int, row: Any) -> dict[int, Any]:
        """Rows on the components; the mean velocity moves positions by U t, velocities by U."""
        b, out = given.bubbles[k], {}
        count = len(b)
        for i in range(len(bubbles[k])):
            part = row[bubble_sizes[i] : bubble_sizes[i + 1]]
            out[bubbles[k][i]] = at_node(part, f - b.first, count)
        since = given.t_s[f] - given.t_s[b.first]
        out[means[k]] = np.array([row[2 * i] * since + row[2 * i + 1] for i in range(3)])
        return out

    def add_pixels(seen: Observations, m: int, terms_of: Any) -> None:
        camera = given.cameras[seen.camera[m]]
        zero = camera.project(np.zeros(3))
        linear = np.stack([camera.project(e) - zero for e in np.eye(3)], -1)
        root = np.linalg.inv(np.linalg.cholesky(seen.covariance_px2[m]))
        node = int(graph.nodes.of_frame[seen.frame[m]])
        rig_rows = np.outer(UP, graph.shake.position) + graph.shake.offset[seen.camera[m]]
        for line, value in zip(root @ linear, root @ (seen.uv_px[m] - zero)):
            terms = terms_of(line) | of_shake(line @ rig_rows, node, -1.0)
            whole.rows.append((terms, value, 1.0))
        pixel_log_dets.append(np.log(np.abs(np.diag(root))).sum())

    pixel_log_dets: list[float] = []
    for m in range(len(given.observations)):
        k, f = int(given.observations.item[m]), int(given.observations.frame[m])
        add_pixels(
            given.observations,
            m,
            lambda line, k=k, f=f: of_bubble(k, f, line @ graph.bubble.position),
        )
    marks = [whole.add(mark.guess_mm, mark.sigma_mm**2 * np.eye(3)) for mark in given.marks]
    for m in range(len(given.references)):
        which = marks[int(given.references.item[m])]
        add_pixels(given.references, m, lambda line, which=which: {which: line})
    _add_sensors(given, model, whole, graph, of_shake)
    return whole, (graph, shake, sizes), (bubbles, means, of_bubble), sum(pixel_log_dets)


def _add_bubbles(
    given: SmoothingProblem, whole: Dense, graph: Any
) -> tuple[list[list[int]], list[int]]:
    """Ids of every bubble's components, and of its mean velocity."""
    bubbles, means = [], []
    for b in given.bubbles:
        t = given.t_s[b.first : b.last + 1]
        means.append(whole.add(np.zeros(3), 300.0**2 * np.eye(3)))
        ids = []
        for i, c in enumerate(graph.bubble.components):
            mean = np.zeros(len(t) * c.size)
            if i < 3:
                mean[::2] = b.start_mm[i]
            ids.append(whole.add(mean, path_covariance(c, t)))
        bubbles.append(ids)
    return bubbles, means


def _add_sensors(given: Any, model: Any, whole: Dense, graph: Any, of_shake: Any) -> None:
    node_t = graph.nodes.t_s
    if given.stage is not None:
        for t, value in zip(given.stage.t_s, given.stage.position_mm):
            if model.carriage.kind != "readings" or np.min(np.abs(given.t_s - t)) < 1e-12:
                node = int(np.argmin(np.abs(node_t - t)))
                assert abs(node_t[node] - t) < 1e-12
                whole.rows.append((of_shake(graph.shake.position, node), value, 0.001))
    for j, sensor in enumerate(given.accelerometers):
        bias = whole.add(np.zeros(3), sensor.bias_sigma_mm_s2**2 * np.eye(3))
        rows = np.outer(UP, graph.shake.acceleration) + graph.shake.offset_acceleration[j]
        for t, reading in zip(sensor.t_s, sensor.reading_mm_s2):
            node = int(np.argmin(np.abs(node_t - t)))
            assert abs(node_t[node] - t) < 1e-12
            for direction in graph.shake.seen[j]:
                terms = of_shake(direction @ rows, node) | {bias: direction @ sensor.axes.T}
                value = direction @ sensor.axes.T @ reading - 9806.65 * direction @ UP
                whole.rows.append((terms, value, sensor.sigma_mm_s2))


def compare(given: SmoothingProblem, model: ShakeModel) -> None:
    """Means to 1e-6 mm, covariances to 1e-6 relative, the log evidence to 1e-5."""
    whole, (graph, shake, sizes), (_bubbles, _means, of_bubble), log_dets = dense(given, model)
    mean, covariance, starts, evidence = whole.posterior()
    solution = solve(given, model, QUIET)
    found = solution.covariances
    assert found is not None

    def spread(terms: dict[int, Any]) -> Any:
        row = np.zeros(starts[-1])
        for i, part in terms.items():
            row[starts[i] : starts[i + 1]] = part
        return row

    for k, b in enumerate(given.bubbles):
        for f in (b.first, (b.first + b.last) // 2, b.last):
            r = int(graph.row(np.array([k]), np.array([f]))[0])
            for rows in (graph.bubble.position, graph.bubble.velocity):
                whole_rows = np.array([spread(of_bubble(k, f, line)) for line in rows])
                expected, got = whole_rows @ mean, rows @ solution.state.bubbles[r]
                scale = 1.0 if rows is graph.bubble.position else 100.0
                np.testing.assert_allclose(got, expected, atol=1e-6 * scale)
                wanted = whole_rows @ covariance @ whole_rows.T
                here = rows @ found.bubbles[r] @ rows.T
                np.testing.assert_allclose(here, wanted, rtol=1e-6, atol=1e-6 * wanted.max())
    for f in (0, len(given.t_s) - 1):
        node = int(graph.nodes.of_frame[f])
        for c in range(2):
            rows = graph.shake.offset[c]
            whole_rows = np.zeros((3, starts[-1]))
            for i, which in enumerate(shake):
                width = sizes[i + 1] - sizes[i]
                begin = starts[which] + node * width
                whole_rows[:, begin : begin + width] = rows[:, sizes[i] : sizes[i + 1]]
            np.testing.assert_allclose(
                rows @ solution.state.shake[node], whole_rows @ mean, atol=1e-6
            )
            wanted = whole_rows @ covariance @ whole_rows.T
            got = rows @ found.shake[f] @ rows.T
            np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-6 * wanted.max())
    assert solution.log_evidence == pytest.approx(evidence + log_dets, abs=2e-4, rel=1e-8)


def test_images_and_encoder_equal_the_dense_posterior(rng: np.random.Generator) -> None:
    compare(problem(rng), MODEL)


def test_a_bubble_unseen_from_its_first_frame_on_equals_the_dense_posterior(
    rng: np.random.Generator,
) -> None:
    """As in a window of a run that begins while the bubble is hidden."""
    given = problem(rng)
    seen = given.observations
    keep = ~((seen.item == 1) & (seen.frame <= 4))
    parts = {name: getattr(seen, name)[keep] for name in vars(seen)}
    compare(replace(given, observations=Observations(**parts)), MODEL)


def test_references_equal_the_dense_posterior(rng: np.random.Generator) -> None:
    compare(problem(rng, marks=True), MODEL)


def test_white_force_modes_equal_the_dense_posterior(rng: np.random.Generator) -> None:
    modes = tuple(replace(m, force_hz=None) for m in MODEL.modes)
    compare(problem(rng), replace(MODEL, modes=modes))


def test_broad_band_equals_the_dense_posterior(rng: np.random.Generator) -> None:
    bands = tuple(BroadBand((0.2,) * 3, j) for j in range(2))
    compare(problem(rng, marks=True), replace(MODEL, modes=(), broad_bands=bands))


def test_accelerometers_equal_the_dense_posterior(rng: np.random.Generator) -> None:
    """Sensors at their own rate, mounted askew, and an encoder between the frames."""
    given = problem(rng, sensors=True)
    compare(given, replace(MODEL, carriage=CarriageModel("force", 1000.0)))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


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


def test_a_pass_is_freed_before_the_next(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An outlier takes several passes, each of which may fill the memory."""
    given, made, alive = problem(rng), list[weakref.ref[Any]](), list[int]()

    def counted(*arguments: Any) -> Any:
        alive.append(sum(one() is not None for one in made))
        found = of_graph(*arguments)
        made.append(weakref.ref(found))
        return found

    of_graph = solver._linear_solve
    monkeypatch.setattr(solver, "_linear_solve", counted)
    given.observations.uv_px[5] += 20.0
    found = solve(given, MODEL)
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
