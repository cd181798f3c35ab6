"""Runs tracked: swarms from tables and from images, close passes.

Recall, precision and swaps are those of `track_score`. Calibrations are exact, so that only pairing
and linking are judged; points are compared in pixels, and in space against the stated covariance.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from crossing_scenes import RISE_MM_S, UP, close_pass, shake
from numpy.typing import NDArray
from track_score import full_score, matched, pixels

import telerig
from guard_parts.inputs import digest
from guard_parts.metrics import Metric, count, error, nees, share, stated_sd, word
from guard_parts.product import exact_calibration, run_preset

Array = NDArray[np.float64]

PX_PER_MM, SIZE_PX = 10.0, 2000
PASSES, NEAR_MM, GUARD_S = 5, 0.3, 0.02


def swarm(bubbles: int, frames: int, images: bool, preset: str = "swarm") -> list[Metric]:
    """A preset of the simulator."""
    with tempfile.TemporaryDirectory() as name:
        changes = {"frames": frames} | ({"bubbles": bubbles} if bubbles else {})
        config = run_preset(preset, **changes)
        data = telerig.simulate(
            config, rng=np.random.default_rng(7), out=Path(name) / "set", images=images
        )
        (run_name,) = data.runs
        folder = data.runs[run_name].path
        truth = json.loads((data.path / "truth" / "truth.json").read_text(encoding="utf-8"))
        tracks = telerig.track(telerig.load_run(folder), exact_calibration(truth))
        true = pd.read_csv(data.path / "truth" / "runs" / run_name / "bubbles.csv")
    return scores(tracks, true, list(truth["cameras"]))


def scores(tracks: Any, true: pd.DataFrame, cameras: list[str]) -> list[Metric]:
    s = full_score(tracks, true, cameras)
    bubble, right = matched(tracks.table, true, cameras)
    table, bubble = tracks.table[right], bubble[right]
    # In pixels: a point in space also has the shake of the rig, which is not in its covariance.
    off = pixels(table, cameras, "{c}_{x}_px") + pixels(table, cameras, "{c}_d{x}_px")
    off = off - pixels(bubble, cameras, "{c}_{x}_px")
    sd_px = np.sqrt(table[[f"{c}_s{x}{x}_px2" for c in cameras for x in "uv"]].to_numpy(float))
    sd = np.sqrt(table[[f"s{a}{a}_mm2" for a in "xyz"]].to_numpy(float))
    wide = table["d_eq_mm"].to_numpy(float) / bubble["d_eq_mm"].to_numpy(float) - 1
    wide_sd = (table["sd_eq_mm"] / table["d_eq_mm"]).to_numpy(float)
    return [
        share("recall", s.recall),
        share("precision", s.precision),
        count("swaps", s.swaps),
        count("breaks", s.breaks),
        count("tracks", s.tracks, "same"),
        error("centre of volume", s.corrected_px, "px"),
        error("silhouette", s.silhouette_px, "px"),
        stated_sd(sd_px, "px"),
        nees((off / sd_px) ** 2),
        stated_sd(sd, "µm", "stated sd in space", 1e3),
        Metric("diameter bias", float(wide.mean()), "1", "same", 0.0, 1e-3),
        stated_sd(wide_sd, "1", "stated sd of the diameter"),
        nees((wide / wide_sd) ** 2, "NEES of the diameter"),
        word("inputs", digest(true)),
    ]


def passes(rate_hz: float, runs: int) -> list[Metric]:
    """Close passes, five at once in each run: 0.1 mm apart and 10 ms later 0.3 mm."""
    outcomes: list[str] = []
    squares, sds, given = [], [], []
    for seed in range(runs):
        rng = np.random.default_rng([seed, round(rate_hz), 35])
        with tempfile.TemporaryDirectory() as name:
            t_s, rig_mm, tables = pass_run(Path(name), rate_hz, rng)
            given.append(tables)
            tracks = telerig.track(telerig.load_run(Path(name) / "runs" / "passes"), rig()).table
        points = tracks[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        frame = tracks["frame"].to_numpy(int)
        away = np.linalg.norm(rig_mm[frame] - points[:, None], axis=-1)
        bubble = np.where(away.min(1) < NEAR_MM, away.argmin(1), -1)
        outcomes += [outcome(t_s, frame, tracks["particle"].to_numpy(int), bubble, k)
                     for k in range(PASSES)]  # fmt: skip
        off = (points - rig_mm[frame, bubble])[bubble >= 0]
        sd = np.sqrt(tracks[[f"s{a}{a}_mm2" for a in "xyz"]].to_numpy(float))[bubble >= 0]
        near = np.abs(t_s[frame[bubble >= 0]]) > GUARD_S
        squares.append((off / sd)[near] ** 2)
        sds.append(sd[near])
    return [
        count("passes", len(outcomes), "same"),
        *(count(kind, outcomes.count(kind), "higher" if kind == "kept" else "lower")
          for kind in ("kept", "swap", "break", "not tracked")),
        stated_sd(np.concatenate(sds), "µm", scale=1e3),
        nees(np.concatenate(squares)),
        word("inputs", digest(*given)),
    ]  # fmt: skip


def outcome(
    t_s: Array, frame: NDArray[Any], particle: NDArray[Any], bubble: NDArray[Any], k: int
) -> str:
    """Of one pass: whether both bubbles have the ids after it that they had before it."""
    ids = []
    for before in (True, False):
        side = t_s[frame] < -GUARD_S if before else t_s[frame] > GUARD_S
        for one in (2 * k, 2 * k + 1):
            mine = particle[side & (bubble == one)]
            mine = mine[-3:] if before else mine[:3]
            ids.append(np.bincount(mine).argmax() if len(mine) else -1)
    a0, b0, a1, b1 = ids
    if -1 in (a0, b0):
        return "not tracked"
    if a1 == b0 or b1 == a0:
        return "swap"
    return "kept" if (a0, b0) == (a1, b1) else "break"


def pass_run(
    folder: Path, rate_hz: float, rng: np.random.Generator
) -> tuple[Array, Array, pd.DataFrame]:
    """A dataset of detections. Returns times (F,), the bubbles in the rig frame (F, 10, 3), and the
    table of detections; times are from the passes."""
    t_s = np.arange(-0.15, 0.15, 1 / rate_hz) + rng.uniform(0, 1 / rate_hz)
    pairs = [
        close_pass(t_s, NEAR_MM, rng) + rng.uniform(-30, 30, 3) * [1, 1, 1] for _ in range(PASSES)
    ]
    lab = np.concatenate(pairs, axis=1)
    rig_mm = lab - (RISE_MM_S * t_s[:, None] * UP + shake(t_s, 0.2, rng))[:, None]
    px = float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))
    tables = []
    radius = np.exp(rng.normal(np.log(12.0), 0.2, lab.shape[1]))
    for camera, across in (("left", 0), ("right", 2)):
        sign = 1.0 if camera == "left" else -1.0
        exact = np.stack([sign * rig_mm[..., across], rig_mm[..., 1]], -1) * PX_PER_MM
        uv = exact + (SIZE_PX - 1) / 2 + px * rng.standard_normal(exact.shape)
        order = rng.permuted(np.tile(np.arange(lab.shape[1]), (len(t_s), 1)), axis=1)
        uv = np.take_along_axis(uv, order[..., None], axis=1).reshape(-1, 2)
        size = radius[order.ravel()] * (1 + 0.02 * rng.standard_normal(order.size))
        columns = {
            "frame": np.repeat(np.arange(len(t_s)), lab.shape[1]), "camera": camera,
            "u_px": uv[:, 0], "v_px": uv[:, 1], "sigma_px": px, "a_px": size, "b_px": size,
            "angle_rad": 0.0,
        }  # fmt: skip
        tables.append(pd.DataFrame(columns))
    detections = pd.concat(tables, ignore_index=True)
    stage = RISE_MM_S * t_s + 0.001 * rng.standard_normal(len(t_s))
    run = folder / "runs" / "passes"
    run.mkdir(parents=True)
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    detections.to_csv(run / "detections.csv", index=False)
    times = t_s - t_s[0]
    pd.DataFrame({"frame": np.arange(len(t_s)), "t_s": times}).to_csv(
        run / "frames.csv", index=False
    )
    pd.DataFrame({"t_s": times, "position_mm": stage}).to_csv(run / "stage.csv", index=False)
    return t_s, rig_mm, detections


RIG = f"""schema = 1
name = "passes"
[cameras.left]
image_size_px = [{SIZE_PX}, {SIZE_PX}]
scale_px_per_mm = {PX_PER_MM}
[cameras.right]
image_size_px = [{SIZE_PX}, {SIZE_PX}]
scale_px_per_mm = {PX_PER_MM}
[stereo]
right_from_left_rotvec_deg = [0.0, 90.0, 0.0]
[target]
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
[stage]
axis_left = [0.0, -1.0, 0.0]
"""


def rig() -> Any:
    """The calibration of `pass_run`: x of the right camera is -z of the rig, its depth x."""
    middle = (SIZE_PX - 1) / 2
    lens = {"scale_px_per_mm": PX_PER_MM, "aspect": 1.0, "centre_u_px": middle,
            "centre_v_px": middle}  # fmt: skip
    zero = ("skew", "kappa_per_mm", "k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4",
            "tilt_x", "tilt_y", "image_convergence_per_mm", "wall_x_rad", "wall_y_rad")  # fmt: skip
    turns = {"left": np.eye(3), "right": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])}
    cameras = {
        name: {
            "image_size_px": [SIZE_PX, SIZE_PX], "rho_mm": SIZE_PX / PX_PER_MM / np.sqrt(2),
            "parameters": dict.fromkeys(zero, 0.0) | lens,
            "camera_from_rig": {"rotation": turn.tolist(), "translation_mm": [0.0, 0.0, 0.0]},
        }
        for name, turn in turns.items()
    }  # fmt: skip
    return exact_calibration({"cameras": cameras})


TASKS: dict[str, Callable[[], list[Metric]]] = {
    "20 bubbles, table": partial(swarm, 20, 40, False),
    "60 bubbles, table": partial(swarm, 60, 40, False),
    "20 bubbles, images": partial(swarm, 20, 12, True),
    "one bubble, images": partial(swarm, 0, 12, True, "rise"),
    "close passes at 100 Hz": partial(passes, 100.0, 10),
    "close passes at 200 Hz": partial(passes, 200.0, 10),
}
