"""How well bubbles are detected: real pair, rendered truth, overlaps, speed.

Usage: python benchmarks/bubbles.py [--quick] [--real FOLDER] [--out benchmarks/results/bubbles.md]

Real pair: the peer's list of 36 bubbles per view (31 of its pairs sound); distances of our centres
from its circle centres and of sqrt(a b) from its radii, over the sound ones.
Rendered: ``rms`` is the centre error's RMS over both axes in units of the Cramer-Rao bound
(<= 1.5), ``cov`` the RMS of the normalised error (0.9..1.1), ``chi2`` the mean chi2_dof
(0.9..1.1), then the RMS of the plain chain (half-level threshold, cv2.fitEllipse) and of the grey
centroid in the same unit, and the share found. A star marks a figure outside its range.
Overlaps: two bubbles at a distance in units of the larger radius; recall counts bubbles whose
centre is within 0.15 R + 1 px, ``false`` accepted ones without truth, ``merged`` those so flagged;
``cov`` is the median of z^2 / 2 over its expected 0.69: below 1 is cautious.
Speed: whole detection with a given background against background subtraction, threshold,
cv2.connectedComponentsWithStats and cv2.fitEllipse on the same 1280 x 800 frames of 12 bits.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from telerig.estimator.bubbles.detect import detect_bubbles, find_bubbles, outline_points

sys.path.insert(0, str(Path(__file__).parent))
from bubble_outline_renderer import Drawn, centre_bound_px, draw

Array = NDArray[np.float64]
WHITE = 3200.0
UNSOUND = (4, 12, 13, 25, 26)


@dataclass(frozen=True)
class Case:
    """One kind of bubble; ``noise`` as a share of the background, ``heart`` radius over b."""

    radius_px: float
    blur_px: float
    noise: float
    ratio: float = 1.0
    heart: float = 0.0

    def drawn(self, middle: float, rng: np.random.Generator) -> Drawn:
        a, b = self.radius_px * self.ratio**0.5, self.radius_px / self.ratio**0.5
        u, v = middle + rng.uniform(-0.5, 0.5, 2)
        return Drawn((u, v, a, b, rng.uniform(0, np.pi)), heart=self.heart)


CASES = [
    Case(6, 0.7, 0.005),
    Case(6, 1.0, 0.03),
    Case(6, 2.0, 0.01),
    Case(6, 3.0, 0.01),
    Case(6, 0.7, 0.01, heart=0.3),
    Case(6, 1.0, 0.01, ratio=2.0),
    Case(10, 0.7, 0.01, heart=0.4),
    Case(10, 1.0, 0.01, ratio=1.4, heart=0.4),
    Case(10, 3.0, 0.01),
    Case(10, 2.0, 0.01, ratio=2.0),
    Case(14, 1.0, 0.005, ratio=2.0, heart=0.4),
    Case(20, 1.0, 0.01, heart=0.5),
    Case(20, 2.0, 0.03, ratio=1.5, heart=0.4),
    Case(20, 3.0, 0.005, ratio=2.0),
    Case(20, 3.0, 0.01, heart=0.3),
    Case(40, 0.7, 0.005, ratio=2.0, heart=0.5),
    Case(40, 1.5, 0.03, ratio=1.2, heart=0.5),
    Case(40, 3.0, 0.01, ratio=1.3, heart=0.5),
]


def digitised(image: Array, noise: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    soiled = WHITE * (image + noise * rng.standard_normal(image.shape))
    return np.clip(np.round(soiled), 0, 4095).astype(np.uint16)


def plain_chain(
    image: NDArray[np.uint16], background: NDArray[np.uint16]
) -> list[tuple[float, float]]:
    """Background subtraction, threshold, components, fitEllipse: centres."""
    _, mask = cv2.threshold(cv2.subtract(background, image), 0.44 * WHITE, 255, cv2.THRESH_BINARY)
    mask = mask.astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    centres = []
    for label in range(1, count):
        x, y, width, height, area = stats[label]
        if area < 30:
            continue
        part = (labels[y : y + height, x : x + width] == label).astype(np.uint8)
        outlines, _ = cv2.findContours(
            part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(int(x), int(y))
        )
        centres.append(cv2.fitEllipse(max(outlines, key=len))[0])
    return centres


def rendered_row(case: Case, copies: int, pictures: int, rng: np.random.Generator) -> str:
    size = int(2 * case.radius_px * case.ratio**0.5 + 10 * case.blur_px + 14)
    errors, scores, chi2, plain, centroid = [], [], [], [], []
    bounds = []
    for _ in range(pictures):
        bubble = case.drawn((size - 1) / 2, rng)
        truth = np.array(bubble.ellipse[:2])
        clean = draw([bubble], (size, size), blur_px=case.blur_px)
        sigma = float(np.hypot(case.noise, 1 / WHITE / 12**0.5))
        bound = centre_bound_px(bubble, (size, size), blur_px=case.blur_px, sigma=sigma)
        bounds.append(np.trace(bound) / 2)
        image = digitised(np.tile(clean, (1, copies)), case.noise, rng)
        level = np.full(image.shape, WHITE, np.float32)
        table = detect_bubbles(image, background=level)
        tile = np.round((table["u_px"] - truth[0]) / size).to_numpy()
        miss = table[["u_px", "v_px"]].to_numpy() - truth - np.stack([tile * size, 0 * tile], 1)
        covariance = (
            table[["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy().reshape(-1, 2, 2)
        )
        errors.append(miss)
        scores.append(np.einsum("ni,nij,nj->n", miss, np.linalg.inv(covariance), miss) / 2)
        chi2.append(table["chi2_dof"].to_numpy())
        found = np.array(plain_chain(image, np.full(image.shape, int(WHITE), np.uint16)))
        step = np.round((found[:, 0] - truth[0]) / size) * size
        plain.append(found - truth - np.stack([step, 0 * step], 1))
        centroid.append(_grey_centroids(image, size) - truth)
    unit = float(np.sqrt(np.mean(bounds)))
    error = np.concatenate(errors)
    rms, cov = _rms(error) / unit, float(np.sqrt(np.mean(np.concatenate(scores))))
    mean = float(np.mean(np.concatenate(chi2)))
    figures = [
        _marked(rms, 0.0, 1.5),
        _marked(cov, 0.9, 1.1),
        _marked(mean, 0.9, 1.1),
        f"{_rms(np.concatenate(plain)) / unit:.1f}",
        f"{_rms(np.concatenate(centroid)) / unit:.1f}",
        f"{len(error) / (copies * pictures):.3f}",
    ]
    kind = [
        case.radius_px,
        case.blur_px,
        f"{case.noise:.1%}",
        case.ratio,
        case.heart,
        f"{unit:.4f}",
    ]
    return _row(*kind, *figures)


def _grey_centroids(image: NDArray[np.uint16], size: int) -> Array:
    dark = np.maximum(1.0 - image / WHITE - 0.12, 0.0).reshape(size, -1, size).swapaxes(0, 1)
    mass = dark.sum(axis=(1, 2))
    place = np.arange(size)
    return np.stack([(dark.sum(axis=1) @ place) / mass, (dark.sum(axis=2) @ place) / mass], axis=1)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _marked(value: float, low: float, high: float) -> str:
    return f"{value:.2f}" + ("" if low <= value <= high else "*")


def _row(*cells: object) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _head(*cells: str) -> list[str]:
    return [_row(*cells), "|" + "---|" * len(cells)]


def overlap_row(
    radius: float, distance: float, heart: float, pictures: int, rng: np.random.Generator
) -> str:
    found, wrong, merged, errors, scores = 0, 0, 0, [], []
    for _ in range(pictures):
        size = int(4 * radius + 50)
        second = radius * rng.uniform(0.7, 1.0)
        angle = rng.uniform(0, 2 * np.pi)
        half = np.array([np.cos(angle), np.sin(angle)]) * distance * radius / 2
        middle = (size - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
        truth = np.array([middle - half, middle + half])
        bubbles = [
            Drawn((*at, r * 1.02, r / 1.02, rng.uniform(0, 3)), heart=heart)
            for at, r in zip(truth, (radius, second), strict=True)
        ]
        image = digitised(draw(bubbles, (size, size), blur_px=1.0), 0.01, rng)
        table = detect_bubbles(image, background=np.full(image.shape, WHITE))
        whole = ~table["flags"].str.contains("merged").to_numpy(dtype=bool)
        merged += int(np.sum(~whole))
        table = table[whole]
        gap = table[["u_px", "v_px"]].to_numpy()[None] - truth[:, None]
        far = np.hypot(gap[..., 0], gap[..., 1])
        pairs = [
            p for p in zip(*linear_sum_assignment(far), strict=True) if far[p] < 0.15 * radius + 1
        ]
        found, wrong = found + len(pairs), wrong + len(table) - len(pairs)
        for i, j in pairs:
            row, miss = table.iloc[j], gap[i, j]
            s = np.array([[row["suu_px2"], row["suv_px2"]], [row["suv_px2"], row["svv_px2"]]])
            errors.append(miss)
            scores.append(miss @ np.linalg.solve(s, miss) / 2)
    error = np.array(errors).reshape(-1, 2)
    rms, largest = (_rms(error), float(np.max(np.abs(error)))) if len(error) else (np.nan, np.nan)
    cov = float(np.median(scores)) / 0.693 if scores else np.nan
    cells = [f"{found / (2 * pictures):.2f}", wrong, merged, f"{rms:.3f}", f"{largest:.2f}"]
    return _row(radius, distance, heart, *cells, f"{cov:.2f}")


def real_rows(folder: Path, overlays: Path | None) -> list[str]:
    listed = pd.read_csv(folder / "bb3d_list.csv")
    sound = np.setdiff1d(np.arange(len(listed)), UNSOUND)
    rows = []
    for camera in (1, 2):
        image = cv2.imread(str(folder / f"cam{camera}frame000000.tif"), cv2.IMREAD_UNCHANGED)
        bubbles = find_bubbles(image)
        table = bubbles.accepted
        names = [f"cam{camera - 1}_{part}" for part in ("x(col)", "y(row)", "r(px)")]
        circles = listed[names].to_numpy()
        gap = table[["u_px", "v_px"]].to_numpy()[None] - circles[:, None, :2]
        far = np.hypot(gap[..., 0], gap[..., 1])
        nearest, miss = np.argmin(far, axis=1), np.min(far, axis=1)
        radius = np.sqrt(table["a_px"] * table["b_px"]).to_numpy()[nearest] - circles[:, 2]
        rows.append(
            _row(
                camera,
                len(table),
                f"{int(np.sum(miss < 3))}/36",
                _marked(float(np.median(miss[sound])), 0, 0.25),
                _marked(_rms(miss[sound]), 0, 0.30),
                _marked(float(np.median(np.abs(radius[sound]))), 0, 0.15),
                f"{np.mean(radius[sound]):+.3f}",
                f"{bubbles.noise:.4f}",
            )
        )
        if overlays is not None:
            cv2.imwrite(str(overlays / f"bubble_pair_{camera}.png"), overlay(image, bubbles))
    return rows


def overlay(image: NDArray[np.uint16], bubbles: object, zoom: int = 2) -> NDArray[np.uint8]:
    """Accepted outlines (green, flagged orange, merged red) and rejected ones (magenta)."""
    grey = cv2.convertScaleAbs(image, alpha=240.0 / float(np.percentile(image, 99)))
    canvas = cv2.cvtColor(cv2.resize(grey, None, fx=zoom, fy=zoom), cv2.COLOR_GRAY2BGR)
    for _, row in bubbles.accepted.iterrows():
        points = (outline_points(row, 100) + 0.5) * zoom - 0.5
        words = row["flags"]
        colour = (0, 0, 255) if "merged" in words else (0, 160, 255) if words else (0, 200, 0)
        cv2.polylines(
            canvas, [np.round(points * 8).astype(np.int32)], True, colour, 1, cv2.LINE_AA, 3
        )
    for u, v, radius, _ in bubbles.rejected.itertuples(index=False):
        place = (int((u + 0.5) * zoom), int((v + 0.5) * zoom))
        cv2.circle(canvas, place, int(radius * zoom) + 3, (255, 0, 255), 1, cv2.LINE_AA)
    return canvas


def scene(count: int, rng: np.random.Generator) -> Array:
    """1280 x 800 with that many separate bubbles of 12-28 px radius with hearts."""
    image, done = np.ones((800, 1280)), []
    while len(done) < count:
        radius = rng.uniform(12, 28)
        u, v = rng.uniform(60, 1220), rng.uniform(60, 740)
        if any(np.hypot(u - x, v - y) < radius + r + 8 for x, y, r in done):
            continue
        done.append((u, v, radius))
        left, top = int(u) - 50, int(v) - 50
        ellipse = (u - left, v - top, radius * 1.1, radius / 1.1, rng.uniform(0, 3))
        patch = draw([Drawn(ellipse, heart=0.4)], (101, 101), blur_px=1.0)
        image[top : top + 101, left : left + 101] *= patch
    return image


def speed_row(count: int, repeats: int, rng: np.random.Generator) -> str:
    image = digitised(scene(count, rng), 0.01, rng)
    background = np.full(image.shape, int(WHITE), np.uint16)
    level = background.astype(np.float32)
    taken = []
    for _ in range(repeats + 1):
        marks = [_now()]
        plain_chain(image, background)
        marks.append(_now())
        table = detect_bubbles(image, background=level)
        marks.append(_now())
        detect_bubbles(image)
        marks.append(_now())
        taken.append(np.diff(marks, axis=0))
    (first, second, third), cpu = np.moveaxis(np.median(taken[1:], axis=0), 1, 0)
    ratio = _marked(second / first, 0, 5)
    cells = [f"{1e3 * value:.1f}" for value in (first, second, third)]
    rates = [f"{third / first:.2f}", f"{cpu[1] / cpu[0]:.2f}", f"{1 / second:.0f}"]
    return _row(count, len(table), *cells, ratio, *rates)


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def report(quick: bool, real: Path, overlays: Path | None) -> list[str]:
    rng = np.random.default_rng(20)
    lines = ["# Bubble detection", "", "See the docstring of `benchmarks/bubbles.py`.", ""]
    if real.exists():
        lines += ["## Real pair", ""]
        lines += _head(
            *("view", "accepted", "listed found", "centre median px", "centre RMS px"),
            *("radius median px", "radius mean px", "noise"),
        )
        lines += [*real_rows(real, overlays), ""]
    lines += ["## Rendered", ""]
    lines += _head(
        *("R px", "blur px", "noise", "a/b", "heart", "bound px", "rms", "cov", "chi2"),
        *("plain", "centroid", "found"),
    )
    copies, pictures = (25, 2) if quick else (50, 6)
    lines += [rendered_row(case, copies, pictures, rng) for case in CASES]
    lines += ["", "## Overlapping pairs", ""]
    lines += _head(
        *("R px", "distance / R", "heart", "recall", "false", "merged", "rms px", "max px", "cov")
    )
    for heart in (0.0, 0.4):
        for radius in (8.0, 12.0, 20.0):
            for distance in (0.8, 1.0, 1.2, 1.5, 1.8):
                lines.append(overlap_row(radius, distance, heart, 5 if quick else 15, rng))
    lines += ["", "## Speed", ""]
    lines += _head(
        *("bubbles", "found", "plain ms", "ours ms", "ours ms, own background", "ratio"),
        *("ratio, own background", "ratio of processor time", "frames/s"),
    )
    lines += [speed_row(count, 5 if quick else 20, rng) for count in (1, 20)]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    here = Path(__file__).parent
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--real", type=Path, default=here / "../../shared/real/bubble_pair")
    parser.add_argument("--overlays", type=Path, help="folder for pictures of the real pair")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    text = "\n".join(report(options.quick, options.real, options.overlays)) + "\n"
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
