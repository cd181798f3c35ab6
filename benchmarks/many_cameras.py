"""Tracking with three and four cameras, beside the best two of them.

Usage: python benchmarks/many_cameras.py [--only NAME ...] [--out FILE.md]

Simulated swarms with rendered images (presets `swarm_three` and `swarm_four`, exact calibrations):
bubbles are detected once, and the same detections are tracked by all cameras and by the pair whose
lines of sight are nearest to a right angle. Both are scored by the bubbles that two cameras or more
see whole.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent))
from guard_parts.product import exact_calibration, run_preset

import telerig
from telerig.estimator.bubbles.detect import outline_centroid
from telerig.rig.triangulation import stacked_jacobian

Array = NDArray[np.float64]
NEAR_PX, NEAR_SIGMAS = 3.0, 3.0
"""A row is that of a bubble if every pixel is nearer than this, or than so many of its standard
deviations: of four outlines one may be hidden, and say so."""
SCENES: dict[str, dict[str, Any]] = {
    "three, 20 bubbles": {"preset": "swarm_three", "bubbles": 20, "frames": 12},
    "three, 20 bubbles, no shake": {
        "preset": "swarm_three", "bubbles": 20, "frames": 12, "shake": 0.0
    },
    "three, 60 bubbles": {"preset": "swarm_three", "bubbles": 60, "frames": 8},
    "four, 20 bubbles": {"preset": "swarm_four", "bubbles": 20, "frames": 12},
    "four, 20 bubbles, no shake": {
        "preset": "swarm_four", "bubbles": 20, "frames": 12, "shake": 0.0
    },
    "four, 60 bubbles": {"preset": "swarm_four", "bubbles": 60, "frames": 8},
    "crossings: three, 60 bubbles, 4 % covered":
        {"preset": "swarm_three", "bubbles": 60, "frames": 16, "d_eq_mm": (0.8, 2.0)},
    "three, one gone for 50 of 100 frames (table)":
        {"preset": "swarm_three", "bubbles": 20, "frames": 100, "gone": (25, 75)},
}  # fmt: skip


def scene(folder: Path, given: dict[str, Any]) -> list[dict[str, Any]]:
    """Simulate, track and score; one record for each set of cameras."""
    config = run_preset(given["preset"], frames=given["frames"], bubbles=given["bubbles"])
    if "d_eq_mm" in given:
        config = replace(config, bubble=replace(config.bubble, d_eq_mm=given["d_eq_mm"]))
    if "shake" in given:
        config = replace(config, stage=replace(config.stage, shake_mm=given["shake"]))
    images = "gone" not in given
    data = telerig.simulate(config, rng=np.random.default_rng(7), out=folder / "set", images=images)
    (name,) = data.runs
    run = data.runs[name].path
    truth = json.loads((data.path / "truth" / "truth.json").read_text(encoding="utf-8"))
    calibration = exact_calibration(truth)
    true = pd.read_csv(data.path / "truth" / "runs" / name / "bubbles.csv")
    cameras = [camera.name for camera in calibration.cameras]
    sets: list[tuple[str, list[str], Path]] = []
    if images:
        found = telerig.track(telerig.load_run(run), calibration).detections
        bare = found.drop(columns=["particle", "reason"], errors="ignore")
        size = pd.DataFrame(
            {c.name: c.image_size_px for c in calibration.cameras}, index=["u", "v"]
        )
        limit = size[bare["camera"]].T.to_numpy() - 0.5
        uv = bare[["u_px", "v_px"]].to_numpy(float)  # a table may not have centres beside the image
        inside = ((uv > -0.5) & (uv < limit)).all(1)
        bare[inside].to_csv(run / "detections.csv", index=False)
        pair = right_angle(calibration)
        sets = [("all", cameras, run), (" and ".join(pair), pair, run)]
    else:
        first, end = given["gone"]
        copy = Path(shutil.copytree(data.path, folder / "gone"))
        table = pd.read_csv(run / "detections.csv")
        gone = (table["camera"] == cameras[1]) & table["frame"].between(first, end - 1)
        table[~gone].to_csv(copy / "runs" / name / "detections.csv", index=False)
        sets = [("all", cameras, run), (f"{cameras[1]} gone", cameras, copy / "runs" / name)]
    unseen = true.copy()
    if not images:
        first, end = given["gone"]
        unseen.loc[true["frame"].between(first, end - 1), f"{cameras[1]}_whole"] = 0
    out = []
    for label, names, place in sets:
        begun = time.process_time()
        source = telerig.load_run(place, source="detections", cameras=names)
        tracks = telerig.track(source, calibration)
        spent = time.process_time() - begun
        seen = unseen if place != run else true
        own = scores(tracks, seen, names, cameras)
        if images:
            some = calibration.subset(*names).cameras
            own["over bound"] = over_bound(tracks, seen, some, config.image)
        out.append({"cameras": label, **own, "cpu_s": spent})
    return out


def right_angle(calibration: Any) -> list[str]:
    """The two cameras whose lines of sight are nearest to a right angle."""
    views = [(c.name, c.camera_from_rig.rotation[2]) for c in calibration.cameras]
    best = min(combinations(views, 2), key=lambda pair: abs(float(pair[0][1] @ pair[1][1])))
    return [name for name, _ in best]


def scores(tracks: Any, true: pd.DataFrame, names: list[str], cameras: list[str]) -> dict[str, Any]:
    """Compare tracks by the cameras ``names`` with the truth of all ``cameras``."""
    table = tracks.table
    at, there = (pixels(t, names) for t in (table, true))
    chosen = np.full(len(table), -1)
    rows_of = true.groupby("frame").indices
    spread = pixels(table, names, "{c}_s{x}{x}_px2").sum(-1)
    near = np.maximum(NEAR_PX, NEAR_SIGMAS * np.sqrt(spread))
    for i, frame in enumerate(table["frame"]):
        rows = rows_of.get(frame, np.zeros(0, int))
        off = np.nanmax(np.linalg.norm(there[rows] - at[i], axis=-1) / near[i], axis=1)
        if len(rows) and np.nanmin(off) < 1.0:
            chosen[i] = rows[np.nanargmin(off)]
    shows = chosen >= 0
    right = shows & ~pd.Series(chosen).duplicated().to_numpy()
    # of an outline that the border cuts, neither right nor wrong can be said by its centre
    judged = ~table["flags"].str.contains("border").to_numpy() | right
    in_view = (true[[f"{c}_whole" for c in cameras]].sum(axis=1) >= 2).to_numpy()
    by_these = (true[[f"{c}_whole" for c in names]].sum(axis=1) >= 2).to_numpy()
    hit = np.zeros(len(true), bool)
    hit[chosen[right]] = True
    bubble = true.iloc[chosen[right]].reset_index(drop=True)
    mine = table[right].reset_index(drop=True)
    # a bubble's path between its first and its last point: how many tracks it is in
    parts = mine["particle"].groupby(bubble["particle"]).nunique()
    swaps = sum(int((np.diff(own) != 0).sum())
                for _, own in bubble["particle"].groupby(mine["particle"]))  # fmt: skip
    shift = np.nan_to_num(pixels(mine, names, "{c}_d{x}_px"))
    off_px = (pixels(mine, names) + shift) - pixels(bubble, names)
    sd_px = np.sqrt(pixels(mine, names, "{c}_s{x}{x}_px2"))
    own = (
        mine[["x_mm", "y_mm", "z_mm"]].to_numpy()
        - bubble[["x_rig_mm", "y_rig_mm", "z_rig_mm"]].to_numpy()
    )
    names_of = ["sxx_mm2", "sxy_mm2", "sxz_mm2", "sxy_mm2", "syy_mm2", "syz_mm2",
                "sxz_mm2", "syz_mm2", "szz_mm2"]  # fmt: skip
    spread = mine[names_of].to_numpy().reshape(-1, 3, 3)
    nees = np.einsum("ni,nij,nj->n", own, np.linalg.inv(spread), own) / 3
    sd = np.sqrt(np.trace(spread, axis1=1, axis2=2) / 3)
    return {
        "bubbles in view": int(in_view.sum()),
        "seen by these": int(by_these.sum()),
        "recall": float(hit[in_view].mean()),
        "recall of what these see": float(hit[by_these].mean()),
        "precision": float(right[judged].mean()),
        "swaps": swaps,
        "breaks": int((tracks.events["kind"] == "break").sum()),
        "tracks": int(table["particle"].nunique()),
        "bubbles in two tracks": int((parts > 1).sum()),
        "pixel error": float(np.sqrt(np.nanmean(off_px**2))),
        "pixel NEES": float(np.nanmean((off_px / sd_px) ** 2)),
        "error": float(1e3 * np.sqrt(np.mean(own**2))),
        "median error": float(1e3 * np.median(np.sqrt(np.mean(own**2, axis=1)))),
        "stated sd": float(1e3 * np.sqrt(np.mean(sd**2))),
        "median sd": float(1e3 * np.median(sd)),
        "NEES": float(np.mean(nees)),
        "median of NEES": float(np.median(nees) / 0.789),
    }


def over_bound(tracks: Any, true: pd.DataFrame, cameras: Any, images: Any) -> float:
    """Return RMS error over RMS Cramer-Rao bound of the points that outlines give: centroids of
    their areas, of bubbles that all ``cameras`` see whole and without a neighbour before them.

    The bound of a blurred disc's centre on white noise, its radius, blur and levels unknown (they
    move no centre): sigma sqrt(2 blur / (sqrt(pi) radius)), sigma relative to the contrast.
    """
    names = [c.name for c in cameras]
    clear = true[[f"{c}_whole" for c in names]].all(axis=1)
    clear &= ~true[[f"{c}_overlap" for c in names]].any(axis=1)
    bubbles = true[clear]
    found = tracks.detections[np.isfinite(tracks.detections["u_px"].to_numpy(float))]
    centroid = outline_centroid(found)
    place = pixels(bubbles, names, "{c}_silhouette_{x}_px")
    off = np.full(place.shape, np.nan)
    for c, name in enumerate(names):
        mine = (found["camera"] == name).to_numpy()
        of_frame = {
            f: centroid[mine][rows] for f, rows in found[mine].groupby("frame").indices.items()
        }
        for k, frame in enumerate(bubbles["frame"]):
            away = of_frame.get(frame, np.zeros((0, 2))) - place[k, c]
            if len(away):
                off[k, c] = away[np.hypot(*away.T).argmin()]
    kept = (np.hypot(off[..., 0], off[..., 1]) < NEAR_PX).all(1)
    off, bubbles = off[kept], bubbles[kept]
    radius = np.sqrt(bubbles[[f"{c}_area_px2" for c in names]].to_numpy(float) / np.pi)
    blur = bubbles[[f"{c}_blur_px" for c in names]].to_numpy(float)
    sigma = np.hypot(images.read_noise, images.shot_noise * np.sqrt(images.screen / 2))
    bound = sigma / images.screen * np.sqrt(2 * blur / (np.sqrt(np.pi) * radius))
    points = bubbles[["x_rig_mm", "y_rig_mm", "z_rig_mm"]].to_numpy(float)
    by_point = stacked_jacobian(tuple(cameras), points)[1].reshape(len(off), -1, 2, 3)
    weighted = by_point / bound[..., None, None] ** 2
    covariance = np.linalg.inv(np.einsum("ncij,ncik->njk", weighted, by_point))
    error = np.einsum("njk,ncik,nci->nj", covariance, weighted, off)
    return float(np.sqrt((error**2).sum() / np.trace(covariance, axis1=1, axis2=2).sum()))


def pixels(table: pd.DataFrame, names: list[str], pattern: str = "{c}_{x}_px") -> Array:
    """Return (N, C, 2) from a table's columns."""
    columns = [pattern.format(c=c, x=x) for c in names for x in "uv"]
    return table[columns].to_numpy(float).reshape(len(table), len(names), 2)


def page(records: dict[str, list[dict[str, Any]]]) -> str:
    lines = [
        "# Three and four cameras", "",
        "Rendered images (a table in the last scene), exact calibrations. Recall is of the bubbles",
        "that two of all cameras or more see whole, so a pair is charged with those that others",
        "see; the next column is of those that the cameras of the row see. Errors in space are per",
        "coordinate, with NEES by the stated covariance, as a mean and as a median over that of",
        "chi-square. They are given where the cameras do not shake: elsewhere each shakes by 1 px,",
        "which is in no row's covariance. CPU is that of tracking detections that are there. Over",
        "the bound: RMS error of the points that the centroids of the outlines' areas give, over",
        "the Cramer-Rao bound for the rendered noise, of bubbles that all cameras of the row see",
        "whole and with no other before them.",
        "",
        "| scene | cameras | bubbles in view | recall | of what these see | precision | swaps | "
        "breaks | tracks | bubbles in two tracks | pixel error (px) | NEES | error (µm), median | "
        "stated sd (µm), median | NEES, median | over the bound | CPU (s) |",
        "|---" * 17 + "|",
    ]  # fmt: skip
    for name in SCENES:
        for r in records.get(name, []):
            lines.append(
                f"| {name} | {r['cameras']} | {r['bubbles in view']} | {r['recall']:.4f} | "
                f"{r['recall of what these see']:.4f} | {r['precision']:.4f} | {r['swaps']} | "
                f"{r['breaks']} | {r['tracks']} | {r['bubbles in two tracks']} | "
                f"{r['pixel error']:.3f} | {r['pixel NEES']:.2f} | {space(name, r)} | "
                f"{r.get('over bound', np.nan):.2f} | {r['cpu_s']:.0f} |"
            )
    return "\n".join(lines) + "\n"


def space(name: str, r: dict[str, Any]) -> str:
    """The columns of the errors in space."""
    if "no shake" not in name:
        return "- | - | -"
    error, stated = f"{r['error']:.1f}, {r['median error']:.2f}", f"{r['stated sd']:.2f}"
    return f"{error} | {stated}, {r['median sd']:.2f} | {r['NEES']:.2f}, {r['median of NEES']:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    records: dict[str, list[dict[str, Any]]] = {}
    for name, given in SCENES.items():
        if options.only and not any(word in name for word in options.only):
            continue
        with tempfile.TemporaryDirectory() as folder:
            records[name] = scene(Path(folder), given)
        for record in records[name]:
            print(name, record, flush=True)
    print(page(records))
    if options.out:
        options.out.write_text(page(records), encoding="utf-8")


if __name__ == "__main__":
    main()
