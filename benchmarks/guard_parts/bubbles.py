"""Outlines in single images: drawn bubbles against the Cramer-Rao bound, crowds, the real pair."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from bubble_outline_renderer import Drawn, centre_bound_px, draw
from dense_scenes import paired, scored
from dense_scenes import swarm as dense
from numpy.typing import NDArray

import telerig
from guard_parts.inputs import digest
from guard_parts.metrics import Metric, count, error, nees, share, stated_sd, word

Array = NDArray[np.float64]

WHITE = 3200.0
KINDS = {
    "R 6, 3 % noise": (6.0, 1.0, 0.03, 1.0, 0.0),
    "R 10, heart": (10.0, 1.0, 0.01, 1.4, 0.4),
    "R 20, out of focus": (20.0, 3.0, 0.005, 2.0, 0.0),
    "R 40, heart": (40.0, 1.5, 0.03, 1.2, 0.5),
}
"""Radius and blur in px, noise as a share of the background, axis ratio, heart's radius over b."""
COPIES, PICTURES = 40, 2
UNSOUND = (4, 12, 13, 25, 26)
"""Rows of the real pair's list that are no pairs."""
SPREAD = ["suu_px2", "suv_px2", "suv_px2", "svv_px2"]


def drawn(radius: float, blur: float, noise: float, ratio: float, heart: float) -> list[Metric]:
    """One bubble, many times: the centre over its bound, the diameter."""
    rng = np.random.default_rng([35, round(radius)])
    side = int(2 * radius * ratio**0.5 + 10 * blur + 14)
    miss, squares, sds, bounds, sizes, given, total = [], [], [], [], [], [], 0
    for _ in range(PICTURES):
        u, v = (side - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
        axes = radius * ratio**0.5, radius / ratio**0.5
        bubble = Drawn((u, v, *axes, rng.uniform(0, np.pi)), heart=heart)
        clean = np.tile(draw([bubble], (side, side), blur_px=blur), (1, COPIES))
        image = WHITE * (clean + noise * rng.standard_normal(clean.shape))
        image = np.clip(np.round(image), 0, 4095).astype(np.uint16)
        given.append(image)
        sigma = float(np.hypot(noise, 1 / WHITE / 12**0.5))
        bound = centre_bound_px(bubble, (side, side), blur_px=blur, sigma=sigma)
        bounds.append(np.trace(bound) / 2)
        table = telerig.detect_bubbles(image, background=np.full(image.shape, WHITE, np.float32))
        off = table[["u_px", "v_px"]].to_numpy(float) - [u, v]
        off[:, 0] -= side * np.round(off[:, 0] / side)
        s = table[SPREAD].to_numpy(float).reshape(-1, 2, 2)
        near = np.hypot(*off.T) < 0.25 * radius
        total += int(near.sum())
        miss.append(off[near])
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(s), off)[near] / 2)
        sds.append(np.linalg.det(s)[near] ** 0.25)
        sizes.append(table["d_eq_px"].to_numpy(float)[near])
    rms = float(np.sqrt(np.mean(np.concatenate(miss) ** 2)))
    sizes_px = np.concatenate(sizes)
    return [
        error("centre over bound", rms / float(np.sqrt(np.mean(bounds))), "1"),
        stated_sd(np.concatenate(sds), "px"),
        nees(np.concatenate(squares)),
        share("found", total / (COPIES * PICTURES)),
        Metric("diameter bias", float(sizes_px.mean() / (2 * radius) - 1), "1", "same", 0, 1e-3),
        error("diameter scatter", float(sizes_px.std()) / (2 * radius), "1"),
        word("inputs", digest(*given)),
    ]


def crowd(covered: float) -> list[Metric]:
    """Bubbles that overlap: found ones, centres."""
    counts, far, squares, sds, given = [], [], [], [], []
    for k in range(3):
        image, truth = dense(covered, True, np.random.default_rng([35, round(100 * covered), k]))
        given.append(image)
        table = telerig.detect_bubbles(image)
        table = table[~table["flags"].str.contains("defocus")]
        found = table[["u_px", "v_px", "a_px", "b_px", "angle_rad"]].to_numpy(float)
        counts.append(scored(found, truth))
        i, j = paired(found, truth)
        off = found[i, :2] - truth[j, :2]
        s = table[SPREAD].to_numpy(float)[i].reshape(-1, 2, 2)
        far.append(np.hypot(*off.T))
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(s), off))
        sds.append(np.linalg.det(s) ** 0.25)
    total, hit, right, wrong = np.sum(counts, axis=0)
    # A few centres of hidden outlines are far off; medians are of the others.
    return [
        count("true", int(total), "same"),
        share("recall", hit / total),
        share("precision", right / max(right + wrong, 1)),
        error("centre, median", float(np.median(np.concatenate(far))), "px"),
        stated_sd(np.concatenate(sds), "px"),
        nees([np.median(np.concatenate(squares)) / 1.386], "median of NEES"),
        word("inputs", digest(*given)),
    ]


def real_pair() -> list[Metric]:
    """The list of another laboratory, of 36 bubbles a view, 31 of them sound pairs."""
    folder = real_folder() / "bubble_pair"
    if not folder.is_dir():
        return [word("skipped", "the real images are not there")]
    listed = pd.read_csv(folder / "bb3d_list.csv")
    sound = np.setdiff1d(np.arange(len(listed)), UNSOUND)
    out = []
    for camera in (1, 2):
        image: Any = cv2.imread(str(folder / f"cam{camera}frame000000.tif"), cv2.IMREAD_UNCHANGED)
        table = telerig.detect_bubbles(image)
        columns = [f"cam{camera - 1}_{part}" for part in ("x(col)", "y(row)", "r(px)")]
        circles = listed[columns].to_numpy()
        gap = table[["u_px", "v_px"]].to_numpy()[None] - circles[:, None, :2]
        far = np.hypot(gap[..., 0], gap[..., 1])
        nearest, miss = far.argmin(1), far.min(1)
        radius = np.sqrt(table["a_px"] * table["b_px"]).to_numpy()[nearest] - circles[:, 2]
        out += [
            count(f"view {camera} bubbles", len(table), "same"),
            count(f"view {camera} listed found", int((miss < 3).sum()), "higher"),
            error(f"view {camera} centre", float(np.sqrt(np.mean(miss[sound] ** 2))), "px"),
            Metric(f"view {camera} radius", float(radius[sound].mean()), "px", "same", 0, 1e-2),
        ]  # fmt: skip
    return out


def real_folder() -> Path:
    """Return the folder of the real images, beside the repository."""
    return Path(__file__).resolve().parents[3] / "shared" / "real"


TASKS: dict[str, Callable[[], list[Metric]]] = {
    **{name: partial(drawn, *kind) for name, kind in KINDS.items()},
    "10 % covered": partial(crowd, 0.1),
    "30 % covered": partial(crowd, 0.3),
    "real pair": real_pair,
}
