"""A results folder of a smoothed run, written from known signals."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from report_page import edit

from telerig.io.results.folders.smoothing import SmoothingResults, read_smoothing_results

RATE_HZ, SD_MM, SD_MM_S = 500.0, 0.02, 4.0
COMMON_HZ, ARM_HZ, ALONE_HZ = 20.0, 45.0, 80.0
COMMON_UM, ARM_UM, ALONE_UM = 120.0, 50.0, 30.0
AXES = {
    name: {"verdict": "RESOLVED", "flags": [], "q": q, "eta": 0.9961, "sigma_mm": 0.0231,
           "sigma_shake_known_mm": 0.0222, "shake_rms_mm": 0.13}
    for name, q in zip("xyz", (1.01, 1.07, 1.02))
}  # fmt: skip
changed = partial(edit, "smoothing.json")


def _tracks(frames: int, bubbles: int) -> pd.DataFrame:
    """What the tracking part of the page needs of tracks.csv."""
    frame = np.tile(np.arange(frames), bubbles)
    particle = np.repeat(np.arange(bubbles), frames)
    rng = np.random.default_rng(2)
    table = pd.DataFrame({"frame": frame, "particle": particle, "t_s": frame / RATE_HZ})
    table[["x_mm", "y_mm", "z_mm"]] = rng.uniform(-5, 5, (len(table), 3))
    table[["sxx_mm2", "syy_mm2", "szz_mm2"]] = 1e-3
    table[["sxy_mm2", "sxz_mm2", "syz_mm2"]] = 0.0
    for camera in ("left", "right"):
        table[[f"{camera}_u_px", f"{camera}_v_px"]] = rng.uniform(0, 900, (len(table), 2))
        table[[f"{camera}_suu_px2", f"{camera}_svv_px2"]] = 0.25
        table[f"{camera}_suv_px2"] = 0.0
    return table.assign(ray_miss_mm=0.01, d_eq_mm=4.0, confidence=1.0)


def _shake(rng: np.random.Generator, frames: int) -> pd.DataFrame:
    """On y a line that both cameras share and one of the left arm; left x alone sees a third."""
    t = np.arange(frames) / RATE_HZ

    def tone(hz: float, rms_um: float) -> Any:
        return 1e-3 * np.sqrt(2) * rms_um * np.sin(2 * np.pi * (hz * t + rng.random()))

    common, arm, alone = tone(COMMON_HZ, COMMON_UM), tone(ARM_HZ, ARM_UM), tone(ALONE_HZ, ALONE_UM)
    table = pd.DataFrame({"frame": np.arange(frames), "t_s": t})
    for camera, x, y, z in (("left", alone, common + arm, 0.0), ("right", 0.0, common, 0 * t)):
        table[f"{camera}_x_mm"], table[f"{camera}_y_mm"], table[f"{camera}_z_mm"] = x, y, z
        table[[f"s{camera}_x_mm", f"s{camera}_y_mm", f"s{camera}_z_mm"]] = 0.005
    table["right_z_mm"] = 1e-4 * rng.standard_normal(frames)
    return table.assign(position_mm=280 * t, sposition_mm=1e-3)


def _trajectories(rng: np.random.Generator, tracks: pd.DataFrame, shake: pd.DataFrame) -> Any:
    """Straight rise and a zigzag; naive carries the shake on y, RTS half of it."""
    t = tracks["t_s"].to_numpy()
    table = tracks[["frame", "particle", "t_s"]].copy()
    turn = 2 * np.pi * 6.0 * t + tracks["particle"].to_numpy()
    true = {"x": 3 * np.sin(turn), "y": -280 * t, "z": 3 * np.cos(turn)}
    speed = {"x": 36 * np.pi * np.cos(turn), "y": -280 + 0 * t, "z": -36 * np.pi * np.sin(turn)}
    moved = shake["left_y_mm"].to_numpy()[tracks["frame"]]
    moving = np.gradient(shake["left_y_mm"].to_numpy(), 1 / RATE_HZ)[tracks["frame"]]
    for axis in "xyz":
        noise = SD_MM * rng.standard_normal(len(t))
        off = moved if axis == "y" else noise
        off_speed = moving if axis == "y" else 20 * rng.standard_normal(len(t))
        for kind, part in (("", 0.0), ("naive_", 1.0), ("rts_", 0.5)):
            table[f"{kind}{axis}_mm"] = true[axis] + part * off
            table[f"{kind}v{axis}_mm_s"] = speed[axis] + part * off_speed
        table[f"s{axis}_mm"], table[f"sv{axis}_mm_s"] = SD_MM, SD_MM_S
    table["observed"] = 1
    blind = table["frame"].isin([40, 41, 42])
    table.loc[blind, "observed"] = 0
    naive = [n for n in table if n.startswith("naive_")]
    table.loc[blind, naive] = np.nan
    return table


def content() -> dict[str, Any]:
    return {
        "verdict": "RESOLVED", "flags": [], "axes": AXES, "vertical": "y",
        "modes": [], "schema": 1, "cameras": ["left", "right"], "frames": 600, "bubbles": 2,
        "model": {
            "bubble": {"velocity_sigma_mm_s": 10.0, "zigzags": []}, "modes": [],
            "broad_bands": [{"rms_mm": [0.06, 0.13, 0.1], "camera": 0, "low_hz": 22.984973269}],
            "carriage": {"kind": "force", "servo": None},
            "pixel_inflation": 0.945, "mark_inflation": 1.72, "name": "default", "learned": {},
        },
        "unseen": {"left": "along its depth, (0, 0, 1) in rig axes",
                   "right": "along its depth, (-1, 0.00693, 0.0122) in rig axes"},
        "residuals": {"bubbles": {"pixels": 2400, "outliers": 12, "rms_sigmas": 0.933,
                                  "median_sigmas": 0.908}, "references": {"pixels": 0}},
        "encoder": {"scale": 1.0101, "sscale": 0.0001},
        "accelerometers": {"arm_left": {"bias_x_mm_s2": 223.7997, "sbias_x_mm_s2": 0.598,
                                        "delay_s": 1.02e-3, "sdelay_s": 3.1e-5}},
        "bubble_means": {"0": {"x_mm_s": 0.02, "y_mm_s": -281.04, "z_mm_s": -1.37,
                               "sx_mm_s": 5.7, "sy_mm_s": 5.4, "sz_mm_s": 5.7}},
    }  # fmt: skip


def write_folder(folder: Path, *, frames: int = 600, bubbles: int = 2) -> Path:
    rng = np.random.default_rng(4)
    folder.mkdir()
    tracks, shake = _tracks(frames, bubbles), _shake(rng, frames)
    tracking = {"schema": 1, "kind": "telerig tracks", "run": "rise <3>", "frames": frames}
    (folder / "tracking.json").write_text(json.dumps(tracking))
    (folder / "smoothing.json").write_text(json.dumps(content()))
    tracks.to_csv(folder / "tracks.csv", index=False)
    shake.to_csv(folder / "shake.csv", index=False)
    _trajectories(rng, tracks, shake).to_csv(folder / "trajectories.csv", index=False)
    return folder


def read(folder: Path) -> SmoothingResults:
    results = read_smoothing_results(folder, np.array([0.0, -1.0, 0.0]))
    assert results is not None
    return results
