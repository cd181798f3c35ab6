"""Matching across views: the real pair with its own calibration, and random scenes with truth.

Usage: python benchmarks/bubble_pair.py [--quick] [--images ../shared/real/bubble_pair]
           [--out benchmarks/results/bubble_pair.md] [--overlay overlay.png]

The real pair (OpenLPT, MIT) comes with a list of 36 pairs by another program, a peer's answer.
Its README names 31 sound pairs and 5 unsound ones (3 impossible by radius, 2 almost surely
wrong). ``gap only`` is what an assignment by the mismatch alone makes of the same detections.
Random scenes: 1280 x 800 px, cameras 90 degrees apart; a pair is right when both rows are the
same bubble. ``calibration`` compares stated confidence with the share that is right.
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from telerig.estimator.bubbles.detect import detect_bubbles
from telerig.estimator.bubbles.pairing.groups import Groups, compared, views_of
from telerig.estimator.bubbles.pairing.learning import default_model, learn_rig
from telerig.io.exchange.importing.openlpt import read_openlpt_cameras
from telerig.io.images.read import read_image
from telerig.rig.camera import Camera
from telerig.rig.triangulation import triangulate

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from matching_scenes import match_tables
from pair_scene import CAMERAS, PairScene, random_frame

Array = NDArray[np.float64]

UNSOUND = (4, 12, 13, 25, 26)
"""Rows of the list that its README calls impossible or almost surely wrong."""

SCENES = {
    "20 bubbles": PairScene(),
    "20, with history": PairScene(history=True),
    "20, all alike to 1 %, 1 px noise": PairScene(
        sigma=(1.0, 1.0), size_spread=0.01, shape_spread=0.01
    ),
    "the same, with history": PairScene(
        sigma=(1.0, 1.0), size_spread=0.01, shape_spread=0.01, history=True
    ),
    "31, biased by 2 px": PairScene(bubbles=31, bias=2.0),
    "20, cameras shake by 2 px": PairScene(shake=2.0),
    "20, 70 % seen, 8 false in each view": PairScene(seen=0.7, clutter=8.0),
}
EDGES = (0.0, 0.5, 0.8, 0.95, 0.99, 0.999, 1.001)


def listed(folder: Path) -> list[Array]:
    """(36, 3) column, row, radius in each view."""
    table = pd.read_csv(folder / "bb3d_list.csv")
    return [table[[f"cam{c}_x(col)", f"cam{c}_y(row)", f"cam{c}_r(px)"]].to_numpy() for c in (0, 1)]


def circles(rows: Array) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "u_px": rows[:, 0], "v_px": rows[:, 1], "suu_px2": 0.04, "suv_px2": 0.0,
            "svv_px2": 0.04, "a_px": rows[:, 2], "b_px": rows[:, 2], "angle_rad": 0.0,
        }
    )  # fmt: skip


def rows_of_list(table: pd.DataFrame, rows: Array) -> NDArray[np.int64]:
    """The listed circle that each detection is, -1 for none within 4 px."""
    distance = np.linalg.norm(table[["u_px", "v_px"]].to_numpy()[:, None] - rows[:, :2], axis=-1)
    return np.where(distance.min(1) < 4, distance.argmin(1), -1)


def score(tables: list[pd.DataFrame], known: list[Array], first: Array, second: Array) -> str:
    mine = [rows_of_list(t, k) for t, k in zip(tables, known)]
    same = mine[0][first] == mine[1][second]
    hits = mine[0][first][same & (mine[0][first] >= 0)]
    sound, unsound = np.setdiff1d(hits, UNSOUND), np.intersect1d(hits, UNSOUND)
    return f"{len(first)} | {len(sound)} of 31 | {len(unsound)} of 5"


def gap_only(tables: list[pd.DataFrame], cameras: tuple[Camera, Camera]) -> tuple[Array, Array]:
    one, two = views_of(tables, default_model(cameras))
    gap = compared(cameras, one.take(np.s_[:, None]), two.take(None)).gap_px
    rows, columns = linear_sum_assignment(np.minimum(np.abs(gap), 6.0))
    kept = np.abs(gap[rows, columns]) < 6.0
    return rows[kept], columns[kept]


def real_pair(folder: Path, overlay: Path | None) -> list[str]:
    read, *_ = read_openlpt_cameras([folder / "cam1.txt", folder / "cam2.txt"])
    cameras = (read[0], read[1])
    images = [read_image(folder / f"cam{c}frame000000.tif") for c in (1, 2)]
    known = listed(folder)
    rng = np.random.default_rng(0)
    from_list = [circles(k[rng.permutation(len(k))]) for k in known]
    found = [detect_bubbles(image) for image in images]
    lines = [
        "| detections | method | found | pairs | sound | unsound |", "|---|---|---|---|---|---|"
    ]  # fmt: skip
    for name, tables in (("the list's circles", from_list), ("detect_bubbles", found)):
        counts = " + ".join(str(len(t)) for t in tables)
        by_gap = gap_only(tables, cameras)
        lines.append(f"| {name} | gap only | {counts} | {score(tables, known, *by_gap)} |")
        model = learn_rig([(tables[0], tables[1])], cameras)
        pairs = match_tables(tables, model)
        result = score(tables, known, pairs.rows[:, 0], pairs.rows[:, 1])
        lines.append(f"| {name} | telerig | {counts} | {result} |")
        print("\n".join(lines[-2:]))
    lines += ["", "What the model says of the detections of `detect_bubbles`:", ""]
    lines += [f"- {sentence}" for sentence in model.pairs[0, 1].sentences()]
    lines += ["", *agreement(found, known), "", *details(found, known, pairs)]
    if overlay is not None:
        draw(images, found, pairs, overlay)
    return lines


def agreement(found: list[pd.DataFrame], known: list[Array]) -> list[str]:
    lines = ["| view | listed circles found | centre median | centre RMS | radius median (px) |",
             "|---|---|---|---|---|"]  # fmt: skip
    for c, (table, rows) in enumerate(zip(found, known)):
        mine = rows_of_list(table, rows)
        here = table[mine >= 0]
        off = here[["u_px", "v_px"]].to_numpy() - rows[mine[mine >= 0], :2]
        centre = np.linalg.norm(off, axis=1)
        radius = np.sqrt(here["a_px"] * here["b_px"]) - rows[mine[mine >= 0], 2]
        lines.append(
            f"| {c + 1} | {len(np.unique(mine[mine >= 0]))} of {len(rows)} | "
            f"{np.median(centre):.3f} | {np.sqrt(np.mean(centre**2)):.3f} | "
            f"{np.median(np.abs(radius)):.3f} |"
        )
    return lines


def details(found: list[pd.DataFrame], known: list[Array], pairs: Groups) -> list[str]:
    lines = ["| pair | first (u, v) | second (u, v) | list's rows | confidence |",
             "|---|---|---|---|---|"]  # fmt: skip
    mine = [rows_of_list(t, k) for t, k in zip(found, known)]
    for k, (i, j) in enumerate(zip(pairs.rows[:, 0], pairs.rows[:, 1])):
        one, two = found[0].iloc[i], found[1].iloc[j]
        lines.append(
            f"| {k + 1} | {one.u_px:.1f}, {one.v_px:.1f} | {two.u_px:.1f}, {two.v_px:.1f} | "
            f"{mine[0][i]}, {mine[1][j]} | {pairs.probability[k]:.4f}"
            f"{' ambiguous' if pairs.ambiguous[k] else ''} |"
        )
    return lines


def draw(
    images: list[NDArray[np.uint16]], found: list[pd.DataFrame], pairs: Groups, path: Path
) -> None:
    """Both views with outlines; a pair has one number and one colour, what is alone is grey."""
    pictures = []
    for image, table, matched in zip(images, found, (pairs.rows[:, 0], pairs.rows[:, 1])):
        grey = cv2.convertScaleAbs(image, alpha=200.0 / np.percentile(image, 99))
        picture = cv2.cvtColor(cv2.resize(grey, None, fx=2, fy=2), cv2.COLOR_GRAY2BGR)
        number = {int(row): k for k, row in enumerate(matched)}
        for row, d in enumerate(table.itertuples()):
            k = number.get(row)
            hue = np.uint8([[[(k * 67) % 180 if k is not None else 0, 255, 255]]])
            colour = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].tolist()
            colour = colour if k is not None else [128, 128, 128]
            centre = (round(2 * d.u_px), round(2 * d.v_px))
            axes = (round(2 * d.a_px), round(2 * d.b_px))
            cv2.ellipse(picture, centre, axes, np.degrees(d.angle_rad), 0, 360, colour, 2)
            text = "-" if k is None else str(k + 1)
            cv2.putText(picture, text, (centre[0] - 12, centre[1] + 8), 0, 0.8, (0, 0, 0), 5)
            cv2.putText(picture, text, (centre[0] - 12, centre[1] + 8), 0, 0.8, colour, 2)
        pictures.append(picture)
    cv2.imwrite(str(path), np.vstack(pictures))


def random_scenes(frames: int) -> list[str]:
    lines = [
        "| scene | recall | precision | ambiguous | bias (px) | frame shift (px) | "
        "model (s) | match (ms) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    confidence, right = [], []
    for seed, (name, scene) in enumerate(SCENES.items()):
        rng = np.random.default_rng(seed)
        run = [random_frame(scene, rng) for _ in range(frames)]
        start = time.process_time()
        model = learn_rig([(f.first, f.second) for f in run], CAMERAS)
        pair = model.pairs[0, 1]
        learnt, start = time.process_time() - start, time.process_time()
        matches = [match_tables((f.first, f.second), model, f.predicted)
                   for f in run]  # fmt: skip
        each = (time.process_time() - start) / frames
        hits = [_right(f.first, f.second, m) for f, m in zip(run, matches)]
        there = sum(
            len(np.intersect1d(f.first.bubble[f.first.bubble >= 0], f.second.bubble)) for f in run
        )
        made, good = sum(len(m) for m in matches), sum(int(h.sum()) for h in hits)
        unsure = sum(int(m.ambiguous.sum()) for m in matches)
        confidence += [m.probability for m in matches]
        right += hits
        lines.append(
            f"| {name} | {good / there:.4f} | {good / made:.4f} | {unsure / made:.4f} | "
            f"{pair.bias_px[0]:+.2f} | {pair.frame_px:.2f} | {learnt:.2f} | {1e3 * each:.1f} |"
        )
        print(lines[-1])
    return [*lines, "", *calibration(np.concatenate(confidence), np.concatenate(right))]


def _right(first: pd.DataFrame, second: pd.DataFrame, pairs: Groups) -> NDArray[np.bool_]:
    who = first.bubble.to_numpy()[pairs.rows[:, 0]]
    return np.asarray((who >= 0) & (who == second.bubble.to_numpy()[pairs.rows[:, 1]]))


def calibration(confidence: Array, right: Array) -> list[str]:
    lines = ["All scenes together:", "", "| stated | pairs | mean stated | right |",
             "|---|---|---|---|"]  # fmt: skip
    for low, high in pairwise(EDGES):
        use = (confidence >= low) & (confidence < high)
        if use.any():
            lines.append(
                f"| {low:g} to {min(high, 1):g} | {use.sum()} | {confidence[use].mean():.4f} | "
                f"{right[use].mean():.4f} +- {np.sqrt(right[use].var() / use.sum()):.4f} |"
            )
    print("\n".join(lines))
    return lines


def bulk() -> list[str]:
    lines = ["| lens | 100,000 pairs, ML with covariance (s, processor) |", "|---|---|"]
    rng = np.random.default_rng(0)
    points = rng.uniform([-30, -19, -30], [30, 19, 30], (100_000, 3))
    for name, lens in (
        ("telecentric", {}),
        ("kappa 1/1356 per mm", {"kappa_per_mm": 1 / 1356}),
        ("kappa, k1, p1", {"kappa_per_mm": 1 / 1356, "k1": 0.01, "p1": 1e-3}),
    ):
        pair = (CAMERAS[0].with_parameters(**lens), CAMERAS[1].with_parameters(**lens))
        pixels = [c.project(points) + rng.normal(0, 0.1, (100_000, 2)) for c in pair]
        times = []
        for _ in range(3):
            start = time.process_time()
            triangulate(pair, (pixels[0], pixels[1]), 0.1)
            times.append(time.process_time() - start)
        lines.append(f"| {name} | {min(times):.2f} |")
    print("\n".join(lines))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--images", type=Path, default=Path("../shared/real/bubble_pair"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/bubble_pair.md"))
    parser.add_argument("--overlay", type=Path)
    options = parser.parse_args()
    parts = ["# Matching across views", "", "Made by `python benchmarks/bubble_pair.py`."]
    parts += ["", "## The real pair", ""]
    if options.images.is_dir():
        parts += real_pair(options.images, options.overlay)
    else:
        parts += [f"Not run: no images in `{options.images.name}`."]
    parts += ["", "## Random scenes", "", *random_scenes(8 if options.quick else 60)]
    parts += ["", "## Triangulation in bulk", "", *bulk()]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text("\n".join(parts) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
