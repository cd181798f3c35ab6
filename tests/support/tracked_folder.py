"""A results folder of a tracked run, written from a known swarm."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from telerig.io.report.overlays import draw_bubble_overlay
from telerig.io.results.cameras import CameraRecord
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.triangulation import triangulate

SIZE_PX, SCALE, SIGMA_PX, RATE_HZ = (640, 800), 20.0, 0.05, 500.0
WORST = (7, 31)


def two_cameras() -> tuple[Camera, Camera]:
    turned = Pose.from_rotvec([0.0, np.pi / 2, 0.0], [0.0, 0.0, 0.0])
    left = Camera.create("left", SIZE_PX, SCALE)
    return left, Camera.create("right", SIZE_PX, SCALE, camera_from_rig=turned)


def helices(rng: np.random.Generator, bubbles: int, frames: int) -> pd.DataFrame:
    """Bubbles that wind upwards (rig -y), come and go, and are missed now and then."""
    parts = []
    for particle in range(bubbles):
        first = int(rng.integers(0, max(1, frames // 2)))
        frame = np.arange(first, min(frames, first + int(rng.integers(frames // 3, frames))))
        frame = frame[(rng.random(len(frame)) > 0.03) | (frame == first)]
        t = frame / RATE_HZ
        turn = 2 * np.pi * (rng.uniform(5, 8) * t + rng.random())
        centre, radius = rng.uniform(-9, 9, 3), rng.uniform(0.5, 2.5)
        rise = rng.uniform(-20, 20) * (t - t.mean())
        xyz = [
            centre[0] + radius * np.cos(turn),
            centre[1] - rise,
            centre[2] + radius * np.sin(turn),
        ]
        size = rng.uniform(2.0, 3.0)
        parts.append(pd.DataFrame({"frame": frame, "particle": particle, "t_s": t, "d_eq_mm": size}
                                  | dict(zip(("x_mm", "y_mm", "z_mm"), xyz))))  # fmt: skip
    return pd.concat(parts, ignore_index=True).sort_values(["frame", "particle"], ignore_index=True)


def _tracks(rng: np.random.Generator, true: pd.DataFrame, bias_px: float) -> pd.DataFrame:
    cameras, n = two_cameras(), len(true)
    points = true[["x_mm", "y_mm", "z_mm"]].to_numpy()
    covariance = SIGMA_PX**2 * np.array([[1.0, 0.3], [0.3, 1.0]])
    noise = rng.multivariate_normal(np.zeros(2), covariance, (2, n))
    noise[1, :, 1] += bias_px
    uv = [camera.project(points) + error for camera, error in zip(cameras, noise)]
    each = np.broadcast_to(covariance, (n, 2, 2))
    found = triangulate(cameras, (uv[0], uv[1]), (each, each))
    table = true[["frame", "particle", "t_s"]].copy()
    table[["x_mm", "y_mm", "z_mm"]] = found.points_mm
    upper = found.covariance_mm2[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    table[[f"s{pair}_mm2" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")]] = upper
    for camera, pixels in zip(cameras, uv):
        c = camera.name
        table[[f"{c}_u_px", f"{c}_v_px"]] = pixels
        table[[f"{c}_suu_px2", f"{c}_suv_px2", f"{c}_svv_px2"]] = covariance.ravel()[[0, 1, 3]]
        table[[f"{c}_du_px", f"{c}_dv_px"]] = 0.01 * rng.standard_normal((n, 2))
    table["ray_miss_mm"] = found.ray_miss_mm
    table["d_eq_mm"] = true["d_eq_mm"] * (1 + 0.02 * rng.standard_normal(n))
    table["sd_eq_mm"] = 0.02 * true["d_eq_mm"]
    table["confidence"] = 1 - 0.2 * rng.random(n) ** 8
    table["centre"] = np.where(rng.random(n) < 0.8, "volume", "silhouettes")
    table[["silhouettes_x_mm", "silhouettes_y_mm", "silhouettes_z_mm"]] = found.points_mm
    table["flags"] = np.where(rng.random(n) < 0.02, "ambiguous|overlap", "")
    return table


def detections_of(rng: np.random.Generator, tracks: pd.DataFrame) -> pd.DataFrame:
    """Every tracked bubble in both cameras, dirt in no track, and images without a bubble."""
    parts = []
    for camera in ("left", "right"):
        pixels = tracks[[f"{camera}_u_px", f"{camera}_v_px"]].to_numpy()
        seen = tracks[["frame", "particle"]].assign(u_px=pixels[:, 0], v_px=pixels[:, 1])
        many = len(tracks) // 25
        dirt = pd.DataFrame({
            "frame": rng.integers(0, tracks["frame"].max() + 1, many), "particle": np.nan,
            "u_px": rng.uniform(0, 80, many), "v_px": rng.uniform(0, SIZE_PX[1] - 1, many),
        })  # fmt: skip
        parts.append(pd.concat([seen, dirt]).assign(camera=camera))
    table = pd.concat(parts, ignore_index=True)
    table["particle"] = table["particle"].astype("Int64")
    n = len(table)
    table = table.assign(
        suu_px2=2.5e-3, suv_px2=0.0, svv_px2=2.5e-3, a_px=25.0, b_px=22.0, angle_rad=0.1,
        area_px2=1700.0, d_eq_px=47.0, contrast=0.6, edge_px=1.1, chi2_dof=1.0,
        flags=np.where(rng.random(n) < 0.03, "border", ""), reason="",
    )  # fmt: skip
    blank = pd.DataFrame({"frame": [3], "camera": ["right"], "flags": [""], "reason": ["no image"]})
    return pd.concat([table, blank]).sort_values(["frame", "camera"], ignore_index=True)


def _events(tracks: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for particle, mine in tracks.groupby("particle"):
        first, last = mine.iloc[0], mine.iloc[-1]
        rows.append((first.frame, first.t_s, "birth", particle, "seen in 3 of 4 frames"))
        rows.append((last.frame, last.t_s, "death", particle, "unseen for 4 frames, 8 ms"))
    rows.append((31, 0.062, "break", "1 2", 'two continuations, 1.2 nats apart, "unsafe", <cut>'))
    table = pd.DataFrame(rows, columns=["frame", "t_s", "kind", "particles", "reason"])
    return table.sort_values("frame")


def _content(tracks: pd.DataFrame, detections: pd.DataFrame, bias_px: float) -> dict[str, Any]:
    words = [f"The rays of a pair miss each other by {abs(bias_px) + 0.07:.2f} px RMS."]
    if bias_px:
        words.append(
            f"This is a calibration problem: the shared coordinate is off by {bias_px} px."
        )
    found = int(detections["u_px"].notna().sum())
    return {
        "schema": 1, "kind": "telerig tracks", "run": "swarm <3>",
        "frames": int(tracks["frame"].max()) + 1, "detections": found, "points": len(tracks),
        "tracks": int(tracks["particle"].nunique()),
        "detections_without_partner_or_track": found - 2 * len(tracks),
        "frames_without_bubbles": {"left": {}, "right": {"no image": 1}},
        "events": {"birth": 12, "death": 12, "break": 1},
        "pairs": {"bias_px": [bias_px], "scatter_px": 0.07, "frame_px": 0.01,
                  "rms_px": [abs(bias_px) + 0.07, 0.07, 0.07, 0.072],
                  "calibration_problem": bool(bias_px), "words": words},
        "image_size_px": {"left": list(SIZE_PX), "right": list(SIZE_PX)},
        "cameras": {c.name: CameraRecord.of_camera(c).content() for c in two_cameras()},
        "shapes": {"third": 0.011, "fourth": 0.004}, "covariance": "of the measurement alone",
        "notes": ["frames.csv has <no> times"],
        "worst_frames": [{"frame": WORST[0], "score": 4.0, "why": "3 bubbles without a partner"},
                         {"frame": WORST[1], "score": 2.5, "why": "an ambiguous pair & a break"}],
    }  # fmt: skip


def outline(u: float, v: float, radius: float, wobble: float = 0.0) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    far = radius * (1 + wobble * np.cos(3 * turn))
    return np.stack([u + far * np.cos(turn), v + far * np.sin(turn)], -1)


def _pictures(folder: Path, rng: np.random.Generator, detections: pd.DataFrame) -> None:
    for camera in ("left", "right"):
        for frame in WORST:
            here = detections[(detections["frame"] == frame) & (detections["camera"] == camera)]
            here = here[here["u_px"].notna()]
            rings = [outline(u, v, 24, 0.04) for u, v in here[["u_px", "v_px"]].to_numpy()]
            inside = np.zeros((SIZE_PX[1], SIZE_PX[0]), np.uint8)
            cv2.fillPoly(inside, [np.rint(ring).astype(np.int32) for ring in rings], 1)
            image = np.where(inside > 0, 60.0, 200.0) + 3 * rng.standard_normal(inside.shape)
            image = cv2.GaussianBlur(image, (0, 0), 1.2).clip(0, 255).astype(np.uint8)
            labels = ["" if pd.isna(p) else str(p) for p in here["particle"]]
            colours = [(40, 200, 70) if label else (240, 160, 30) for label in labels]
            dust = [(60.0, 90.0, 5.0, "smaller than 8 px"), (300.0, 700.0, 6.0, "no contrast")]
            picture = draw_bubble_overlay(image, rings, labels, colours, rejected=dust)
            file = folder / "overlays" / camera / f"{frame:06d}.jpg"
            file.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(file), picture[..., ::-1])


def write_folder(
    folder: Path, *, bubbles: int = 12, frames: int = 120, bias_px: float = 0.0, drawn: bool = True
) -> Path:
    rng = np.random.default_rng(5)
    tracks = _tracks(rng, helices(rng, bubbles, frames), bias_px)
    detections = detections_of(rng, tracks)
    folder.mkdir()
    (folder / "tracking.json").write_text(json.dumps(_content(tracks, detections, bias_px)))
    (folder / "run.json").write_text(json.dumps({"packages": {"numpy": "9.9"}, "seed": 3}))
    leading = ["frame", "camera", "particle"]
    detections = detections[leading + [n for n in detections if n not in leading]]
    for name, table in (
        ("tracks", tracks),
        ("detections", detections),
        ("events", _events(tracks)),
    ):
        table.to_csv(folder / f"{name}.csv", index=False)
    if drawn:
        _pictures(folder, rng, detections)
    return folder
