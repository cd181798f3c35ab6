"""Processor time beside peers, which run in turn with the product in the same process."""

from __future__ import annotations

import json
import tempfile
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from dot_renderer import picture, render
from dots import Case, scene_of
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from shake_scenarios import hash_of
from shake_scene import simulate

import telerig
from guard_parts import reference_calibration as reference
from guard_parts.metrics import Metric, cpu_ratio
from guard_parts.product import exact_calibration, preset, run_preset
from guard_parts.smoothing import case_of, smoothed

Array = NDArray[np.float64]

WHITE = 3200
RIVAL_STATES = 27
"""Of a filter of one bubble and two shaking cameras in three axes."""


def ratio(ours: Callable[[], Any], peer: Callable[[], Any], repeats: int) -> float:
    """The least processor times of both, after a first run of each."""
    least = [np.inf, np.inf]
    for k in range(repeats + 1):
        for i, call in enumerate((ours, peer)):
            begun = time.process_time()
            call()
            if k or repeats == 0:
                least[i] = min(least[i], time.process_time() - begun)
    return least[0] / least[1]


def ellipses(image: NDArray[Any], level: float, dark: bool) -> list[Any]:
    """Threshold, outlines and ellipses by OpenCV."""
    kind = cv2.THRESH_BINARY_INV if dark else cv2.THRESH_BINARY
    _, mask = cv2.threshold(image, level, 255, kind)
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [cv2.fitEllipse(o) for o in outlines if len(o) >= 5 and cv2.contourArea(o) > 30]


def dots() -> list[Metric]:
    case = Case(10, 0.01, tilt_deg=30)
    rng = np.random.default_rng(35)
    image = picture(render(scene_of(case, rng)), case.noise * case.contrast, 8, rng)
    spent = ratio(lambda: telerig.locate_dots(image), lambda: ellipses(image, 115, False), 5)
    return [cpu_ratio("locate_dots over OpenCV", spent)]


def bubbles() -> list[Metric]:
    rng = np.random.default_rng(35)
    image = np.full((800, 1280), WHITE, np.float32)
    for u in range(60, 1240, 130):
        for v in range(60, 760, 160):
            radius = rng.uniform(12, 28)
            cv2.circle(image, (u, v), round(radius), 400, -1, cv2.LINE_AA)
    image = cv2.GaussianBlur(image, (0, 0), 1.0) + 32 * rng.standard_normal(image.shape)
    taken = np.clip(np.round(image), 0, 4095).astype(np.uint16)
    level = np.full(taken.shape, WHITE, np.float32)
    spent = ratio(
        lambda: telerig.detect_bubbles(taken, background=level),
        lambda: ellipses(cv2.subtract(np.full_like(taken, WHITE), taken), 0.44 * WHITE, False),
        5,
    )
    return [cpu_ratio("detect_bubbles over OpenCV", spent)]


def calibration() -> list[Metric]:
    with tempfile.TemporaryDirectory() as name:
        data = telerig.simulate(
            preset("paper"), rng=np.random.default_rng(35), out=Path(name) / "set", images=False
        )
        truth = json.loads((data.path / "truth" / "truth.json").read_text(encoding="utf-8"))
        rig = tomllib.loads((data.path / "rig.toml").read_text(encoding="utf-8"))
        table = pd.read_csv(data.path / "calibration" / "dots.csv", dtype={"view": str})
        problem = reference.problem_of(truth, rig, table, ("scale_px_per_mm", "k1"))
        start = reference.truth_of(truth, table)
        spent = ratio(
            lambda: telerig.calibrate(data, model="radial"),
            lambda: reference.solved(problem, start),
            3,
        )
    return [cpu_ratio("calibrate over a NumPy Schur solver", spent)]


def linking() -> list[Metric]:
    with tempfile.TemporaryDirectory() as name:
        config = run_preset("swarm", frames=30, bubbles=20)
        data = telerig.simulate(
            config, rng=np.random.default_rng(35), out=Path(name) / "set", images=False
        )
        (run_name,) = data.runs
        run = telerig.load_run(data.runs[run_name].path)
        truth = json.loads((data.path / "truth" / "truth.json").read_text(encoding="utf-8"))
        table = pd.read_csv(data.runs[run_name].path / "detections.csv")
        known = exact_calibration(truth)
        spent = ratio(lambda: telerig.track(run, known), lambda: kalman_links(table), 2)
    return [cpu_ratio("track over filterpy and SciPy", spent)]


def kalman_links(table: pd.DataFrame) -> None:
    """Pairs by the shared height, links by Kalman filters of constant velocity."""
    from filterpy.kalman import KalmanFilter

    live: list[Any] = []
    for _, frame in table.groupby("frame"):
        first, second = (
            frame.loc[frame["camera"] == c, ["u_px", "v_px"]].to_numpy() for c in ("left", "right")
        )
        apart = np.abs(first[:, None, 1] - second[None, :, 1])
        i, j = linear_sum_assignment(np.minimum(apart, 5.0))
        points = np.c_[first[i], second[j, 0]][apart[i, j] < 5.0]
        for kalman in live:
            kalman.predict()
        taken = set()
        if live:
            expected = np.array([k.x[:3, 0] for k in live])
            away = np.linalg.norm(points[None] - expected[:, None], axis=2)
            for k, m in zip(*linear_sum_assignment(np.minimum(away, 40.0))):
                if away[k, m] < 40.0:
                    live[k].update(points[m][:, None])
                    taken.add(int(m))
        for m in set(range(len(points))) - taken:
            kalman = KalmanFilter(dim_x=6, dim_z=3)
            kalman.F = np.eye(6) + np.eye(6, k=3)
            kalman.H, kalman.R = np.eye(3, 6), 0.01 * np.eye(3)
            kalman.P, kalman.Q = 100.0 * np.eye(6), np.eye(6)
            kalman.x[:3, 0] = points[m]
            live.append(kalman)
        live = live[-40:]


def smoothing() -> list[Metric]:
    case = case_of("S2")
    run = simulate(case, np.random.default_rng([35, hash_of("S2")]))
    inputs = run.inputs("references")
    return [
        cpu_ratio(
            "smooth over filterpy's RTS",
            ratio(lambda: smoothed(inputs), lambda: rts(len(run.t_s)), 1),
        )
    ]


def rts(frames: int) -> None:
    """filterpy's smoother, a dozen pixels a frame."""
    from filterpy.kalman import KalmanFilter

    rng = np.random.default_rng(0)
    peer: Any = KalmanFilter(dim_x=RIVAL_STATES, dim_z=12)
    turn, _ = np.linalg.qr(rng.normal(size=(RIVAL_STATES, RIVAL_STATES)))
    peer.F, peer.H = 0.95 * turn, rng.normal(size=(12, RIVAL_STATES))
    peer.Q, peer.R = np.eye(RIVAL_STATES) * 1e-3, np.eye(12)
    means, covariances, _, _ = peer.batch_filter(rng.normal(size=(frames, 12, 1)))
    peer.rts_smoother(means, covariances)


TASKS: dict[str, Callable[[], list[Metric]]] = {
    "dots": dots, "bubbles": bubbles, "calibration": calibration, "linking": linking,
    "smoothing": smoothing,
}  # fmt: skip
