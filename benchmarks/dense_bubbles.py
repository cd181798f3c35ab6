"""Bubbles that touch and overlap: real frames with labels, and renders of known truth, with peers.

python benchmarks/dense_bubbles.py [FOLDER] [--pictures 6] [--overlays FOLDER] [--out FILE.md]

FOLDER holds bubbles_microgravity, bubbles_backlit, bubble_pair and score_bubbles.py, which are not
part of this repository. Peers get what telerig measured of the image first: the lit field, and the
grey level over that of the screen, without which they find little. Of each peer the setting with
the largest F1 is taken, on each frame anew and once for all frames together: settings are chosen
with the labels. telerig has one setting; its rows that are flagged out of focus are left out.

Renders: ellipses of 4.5 to 40 px radius at random places, with and without bright hearts, behind
out-of-focus ones, until so much of the image is covered. A bubble counts as found when a centre is
within a quarter of its radius and the radius is right to 25 %. ``z`` is the median of the squared
normalised centre error over what it should be, ``beyond`` the share of centres beyond 3 standard
deviations (99 % of a plane; 0.01 expected).
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pandas as pd
from dense_scenes import paired, scored, swarm
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt
from skimage.feature import peak_local_max
from skimage.filters import threshold_otsu
from skimage.measure import label, regionprops
from skimage.segmentation import watershed

from telerig.estimator.bubbles.background.screen import screen_level
from telerig.estimator.bubbles.detect import find_bubbles
from telerig.estimator.bubbles.field import lit_field
from telerig.estimator.bubbles.flat_field import normalised

Array = NDArray[np.float64]
Peer = Callable[..., Array]
ELLIPSE = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]
SEED = 91
COVERED = (0.1, 0.2, 0.3, 0.4)


def prepared(image: NDArray[np.generic]) -> Array:
    """Grey over the level of the screen; what is not the lit field is 1."""
    field = lit_field(image)
    background = None if field is None else screen_level(image, field, falls_off=True)
    seen = image if field is None else np.where(field, image, background).astype(image.dtype)
    return normalised(seen, background)[0].astype(np.float64)


def _regions(labels: NDArray[np.integer], solidity: float) -> Array:
    found = [
        (*reversed(r.centroid), r.axis_major_length / 2, r.axis_minor_length / 2,
         np.pi / 2 - r.orientation)
        for r in regionprops(labels)
        if r.area >= 40 and r.solidity >= solidity and r.axis_minor_length > 0
    ]  # fmt: skip
    return np.array(found).reshape(-1, 5)


def otsu(ratio: Array, *, level: float, solidity: float) -> Array:
    dark = binary_fill_holes(ratio < level * threshold_otsu(ratio))
    return _regions(label(dark), solidity)


def split_by_distance(ratio: Array, *, level: float, apart: int, smooth: float) -> Array:
    dark = binary_fill_holes(ratio < level * threshold_otsu(ratio))
    depth = cv2.GaussianBlur(distance_transform_edt(dark), (0, 0), smooth)
    seeds = np.zeros(dark.shape, int)
    places = peak_local_max(depth, min_distance=apart, labels=label(dark), exclude_border=False)
    seeds[tuple(places.T)] = np.arange(1, len(places) + 1)
    return _regions(watershed(-depth, seeds, mask=dark), 0.0)


def trackpy_features(ratio: Array, *, diameter: int, mass: float, size: float) -> Array:
    import trackpy

    trackpy.quiet()
    grey = np.clip(255.0 * (1.3 - ratio), 0, 255).astype(np.uint8)
    f = trackpy.locate(grey, diameter, percentile=64, engine="auto")
    f = f[f["mass"] >= f["mass"].quantile(mass)] if len(f) else f
    radius = np.full(len(f), size * diameter / 2)
    return np.column_stack([f["x"], f["y"], radius, radius, 0.0 * radius])


def hough(ratio: Array, *, method: int, edge: int, votes: float, apart: int) -> Array:
    grey = cv2.GaussianBlur(np.clip(200.0 * ratio, 0, 255).astype(np.uint8), (0, 0), 1.0)
    found = cv2.HoughCircles(
        grey, method, 1.5 if method == cv2.HOUGH_GRADIENT_ALT else 1.0, apart, param1=edge,
        param2=votes, minRadius=4, maxRadius=80,
    )  # fmt: skip
    circles = np.zeros((0, 3)) if found is None else np.asarray(found, float).reshape(-1, 3)
    return np.column_stack([circles, circles[:, 2], np.zeros(len(circles))])


PEERS: dict[str, tuple[Peer, dict[str, tuple[float, ...]]]] = {
    "Otsu": (otsu, {"level": (0.8, 0.9, 1.0, 1.1), "solidity": (0.0, 0.8)}),
    "watershed": (
        split_by_distance,
        {"level": (0.8, 0.9, 1.0, 1.1), "apart": (3, 8), "smooth": (1.0,)},
    ),
    "trackpy": (
        trackpy_features,
        {"diameter": (9, 13, 17, 23, 31), "mass": (0.0, 0.5), "size": (0.8, 1.0)},
    ),
    "Hough circles": (
        hough,
        {"method": (cv2.HOUGH_GRADIENT,), "edge": (100, 200),
         "votes": (16, 20, 25, 30), "apart": (8,)},
    ),
    "Hough circles, ALT": (
        hough,
        {"method": (cv2.HOUGH_GRADIENT_ALT,), "edge": (100, 300),
         "votes": (0.55, 0.7, 0.8, 0.9), "apart": (5,)},
    ),
}  # fmt: skip


def settings(grid: dict[str, tuple[float, ...]]) -> Iterator[dict[str, float]]:
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


def _scorer(folder: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("score_bubbles", folder / "score_bubbles.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _table(image: str, ellipses: Array) -> pd.DataFrame:
    table = pd.DataFrame(ellipses, columns=ELLIPSE).assign(image=image)
    # Columns of two types, of which pandas 3 makes an array that the scorer may write to.
    return table.astype({"angle_rad": np.float32})


def _f1(true: Array, false: Array, matched: Array, labels: Array) -> Array:
    precision, recall = true / np.maximum(true + false, 1), matched / np.maximum(labels, 1)
    return 2 * precision * recall / np.maximum(precision + recall, 1e-9)


def _row(*cells: object) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _head(*cells: str) -> list[str]:
    return [_row(*cells), "|" + "---|" * len(cells)]


def found_by_telerig(image: NDArray[np.generic]) -> pd.DataFrame:
    table = find_bubbles(image).accepted
    return table[~table["flags"].str.contains("defocus")]


def real_rows(folder: Path) -> list[str]:
    """Recall / precision / F1 of telerig and of every peer at its best setting."""
    scorer, home = _scorer(folder), folder / "bubbles_microgravity"
    files = sorted((home / "images").glob("*.png"))
    images = [cv2.imread(str(f), cv2.IMREAD_UNCHANGED) for f in files]
    ratios = [prepared(image) for image in images]
    names = [f.stem for f in files]

    def counts(found: list[Array]) -> pd.DataFrame:
        every = pd.concat([_table(n, e) for n, e in zip(names, found, strict=True)])
        table, _ = scorer.score(every, home / "labels")
        return table.set_index(["min_d_px", "image"])[["labels", "matched", "true", "false"]]

    begun = time.process_time()
    ours = [found_by_telerig(image)[ELLIPSE].to_numpy(float) for image in images]
    seconds = (time.process_time() - begun) / len(images)
    best = {"telerig": [counts(ours)]}
    for peer, (find, grid) in PEERS.items():
        best[peer] = [counts([find(r, **s) for r in ratios]) for s in settings(grid)]
        print(peer, len(best[peer]), file=sys.stderr, flush=True)
    lines = [f"telerig: {seconds:.1f} s of CPU a frame of one megapixel.", ""]
    for least in (8.0, 20.0):
        lines += [f"Bubbles of {least:g} px and more (recall / precision / F1):", ""]
        lines += _head("found by", *[f"`{n[-6:]}`" for n in names], "one setting for all")
        for finder, tables in best.items():
            cells = []
            for name in [*names, "ALL"]:
                rows = [t.loc[(least, name)].to_numpy(float) for t in tables]
                labels, matched, true, false = np.array(rows).T
                f1 = _f1(true, false, matched, labels)
                k = int(np.argmax(f1))
                precision = true[k] / max(true[k] + false[k], 1)
                cells.append(f"{matched[k] / labels[k]:.2f} / {precision:.2f} / {f1[k]:.2f}")
            lines.append(_row(finder, *cells))
        lines.append("")
    return lines


def backlit_rows(folder: Path) -> list[str]:
    scorer = _scorer(folder)
    tables = []
    for path in sorted((folder / "bubble_pair").glob("cam?frame000000.tif")):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        tables.append(_table(path.stem, found_by_telerig(image)[ELLIPSE].to_numpy(float)))
    table, _ = scorer.score(pd.concat(tables), folder / "bubbles_backlit" / "labels")
    table = table[table["min_d_px"] == 8.0]
    lines = _head("image", "listed", "recall", "precision", "centre error px", "size ratio")
    for r in table.itertuples():
        figures = f"{r.recall:.2f}", f"{r.precision:.2f}", f"{r.centre_error_px:.2f}"
        lines.append(_row(r.image, r.labels, *figures, f"{r.size_ratio:.3f}"))
    return [*lines, ""]


def _peer(found: list[Array], truths: list[Array]) -> tuple[float, str]:
    """F1 of a peer, and its recall, precision and median error of the centres in words."""
    n, h, t, f = np.sum([scored(*both) for both in zip(found, truths, strict=True)], axis=0)
    miss = []
    for one, truth in zip(found, truths, strict=True):
        i, j = paired(one, truth)
        miss.append(np.hypot(*(one[i, :2] - truth[j, :2]).T))
    middle = np.median(np.concatenate(miss)) if sum(map(len, miss)) else np.nan
    f1 = float(_f1(np.array(t), np.array(f), np.array(h), np.array(n)))
    return f1, f"{h / n:.2f} / {t / max(t + f, 1):.2f} / {middle:.2f}"


def render_rows(pictures: int) -> list[str]:
    lines = _head(
        "covered", "hearts", "bubbles", "recall", "precision", "clusters", "centre px (median)",
        "z", "nees", "beyond", *PEERS,
    )  # fmt: skip
    for hearts, covered in itertools.product((True, False), COVERED):
        seeds = [[SEED, hearts, round(100 * covered), k] for k in range(pictures)]
        scenes = [swarm(covered, hearts, np.random.default_rng(seed)) for seed in seeds]
        counts, errors, z, clusters = [], [], [], 0
        for image, truth in scenes:
            bubbles = find_bubbles(image)
            table = bubbles.accepted[~bubbles.accepted["flags"].str.contains("defocus")]
            found = table[ELLIPSE].to_numpy(float)
            counts.append(scored(found, truth))
            i, j = paired(found, truth)
            miss = found[i, :2] - truth[j, :2]
            s = table[["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy(float)[i]
            errors.append(np.hypot(*miss.T))
            z.append(np.einsum("ni,nij,nj->n", miss, np.linalg.inv(s.reshape(-1, 2, 2)), miss))
            clusters += len(bubbles.clusters)
        total, hit, right, wrong = np.sum(counts, axis=0)
        square, cells = np.concatenate(z), []
        ratios = [prepared(image) for image, _ in scenes]
        truths = [truth for _, truth in scenes]
        for find, grid in PEERS.values():
            tried = [
                _peer([find(r, **setting) for r in ratios], truths) for setting in settings(grid)
            ]
            cells.append(max(tried)[1])
        figures = f"{hit / total:.2f}", f"{right / max(right + wrong, 1):.2f}", clusters
        spread = f"{np.median(square) / 1.386:.2f}", f"{np.mean(square) / 2.0:.1f}"
        middle = f"{np.median(np.concatenate(errors)):.3f}"
        beyond = f"{np.mean(square > 9.21):.2f}"
        shown = "yes" if hearts else "no"
        lines.append(
            _row(f"{covered:.0%}", shown, total, *figures, middle, *spread, beyond, *cells)
        )
        print(lines[-1], flush=True)
    return [*lines, ""]


def report(folder: Path | None, pictures: int) -> list[str]:
    lines = ["## Bubbles behind a window, in parabolic flight", ""] if folder else []
    if folder is not None:
        lines += real_rows(folder)
        lines += ["The pair of backlit images (its list leaves bubbles out):", ""]
        lines += backlit_rows(folder)
    if not pictures:
        return lines
    what = "Peers: recall / precision / median error of the centres (px) at the best setting."
    return [*lines, "## Rendered swarms", "", what, "", *render_rows(pictures)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--pictures", type=int, default=4)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    text = "\n".join(report(asked.folder, asked.pictures))
    print(text)
    if asked.out is not None:
        asked.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
