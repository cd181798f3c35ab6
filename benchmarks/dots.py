"""How well dots are measured, against rendered truth, the Cramer-Rao bound and other methods.

Usage: python benchmarks/dots.py [--quick] [--out benchmarks/results/dots.md]

Each row is one kind of picture. ``rms`` is the centre error's RMS over both axes divided by the
Cramer-Rao bound (<= 1.15), ``bias`` its mean vector's length over the same (<= 0.2), ``chi2`` the
mean chi2_dof (0.9..1.1), ``cov`` the RMS error over the predicted one (0.9..1.1), ``found`` the
share of dots located, ``false`` the number of dots that are none. The columns after it are other
methods' rms in the same unit; they are told each dot's place, the true grey levels and the light
there, so only their estimate of the centre is compared. ``gain`` is the best of them over ours
(>= 1.3 wanted at 2 % noise). A star marks a figure outside its range. The bound is that of one
dot alone: where small tilted dots' blur overlaps (R 4, 65 degrees, 1.5 px) that of all together
is 1.03 times as large.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import telerig

sys.path.insert(0, str(Path(__file__).parent))
from dot_renderer import Scene, centre_bound_px, picture, render, tilted_disc

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """One kind of picture; ``light``: relative change across 512 px, ``noise``: of contrast."""

    radius_px: float
    noise: float = 0.02
    blur_px: float = 0.8
    tilt_deg: float = 0.0
    light: float = 0.0
    bits: int = 8
    polarity: str = "white_on_black"
    pitch_diameters: float = 2.0

    @property
    def contrast(self) -> float:
        return 150.0 if self.bits == 8 else 2400.0

    @property
    def label(self) -> str:
        return (
            f"R {self.radius_px:g} | {100 * self.noise:g} % | {self.blur_px:g} | "
            f"{self.tilt_deg:g} | {100 * self.light:g} % | {self.bits} | "
            f"{'white' if self.polarity.startswith('white') else 'black'}"
        )


CASES = (
    *(Case(r, noise) for r in (4, 6, 10, 20) for noise in (0.005, 0.01, 0.02, 0.03)),
    *(Case(r, 0.02, blur) for r in (4, 10) for blur in (0.6, 1.0, 1.5)),
    *(Case(r, 0.02, tilt_deg=tilt) for r in (4, 10, 20) for tilt in (40, 65)),
    *(Case(r, 0.005, tilt_deg=65, light=0.2) for r in (4, 10, 20)),
    *(Case(r, 0.005, light=0.2) for r in (4, 6, 10, 20)),
    *(Case(r, 0.005, light=0.2, polarity="black_on_white") for r in (4, 10, 20)),
    *(Case(r, 0.005, 1.5, light=0.2, bits=16) for r in (4, 10)),
    *(Case(r, noise, tilt_deg=50, bits=16) for r in (4, 10) for noise in (0.005, 0.02)),
    Case(4, 0.03, 1.5, tilt_deg=65),
    Case(4, 0.005, 0.6, tilt_deg=65),
)


def scene_of(case: Case, rng: np.random.Generator) -> Scene:
    """As many dots on a lattice as fit the picture, each shifted at random by up to a pixel."""
    size = 256 if case.radius_px < 8 else 512
    shape = tilted_disc(case.radius_px, np.deg2rad(case.tilt_deg), rng.uniform(0, np.pi))
    index = np.stack(np.meshgrid(*[np.arange(-40, 41)] * 2), axis=-1).reshape(-1, 2)
    lattice = index * 2.0 * case.pitch_diameters @ shape.T + (size - 1) / 2
    margin = case.radius_px + 4 * case.blur_px + 3
    inside = np.all((lattice > margin) & (lattice < size - 1 - margin), axis=1)
    centres = lattice[inside]
    centres = centres + rng.uniform(-0.5, 0.5, centres.shape)
    low, high = 40.0 * case.contrast / 150, 40.0 * case.contrast / 150 + case.contrast
    white = case.polarity == "white_on_black"
    direction = rng.uniform(0, 2 * np.pi)
    slope = case.light / 512 * np.array([np.cos(direction), np.sin(direction)])
    return Scene(
        size, size, centres, shape, case.blur_px, high if white else low, low if white else high,
        (float(slope[0]), float(slope[1])), 16 if case.radius_px < 8 else 8,
    )  # fmt: skip


def grey_centroid(grey: Array, mask: NDArray[np.uint8], level: float, start: Array) -> Array:
    """Centroid of the grey above a quarter of the contrast, in the dot's own surroundings."""
    weight = np.maximum(grey - level, 0.0) * mask
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]]
    return np.array([np.sum(weight * u), np.sum(weight * v)]) / np.sum(weight) + start


def rivals(image: NDArray[np.generic], scene: Scene, case: Case) -> dict[str, Array]:
    """Centres (N, 2) by other methods, NaN where they fail; they are told place and levels."""
    from skimage.measure import find_contours

    names = ("grey centroid", "SimpleBlob", "cv2 contour", "skimage contour")
    result = {name: np.full((len(scene.centres_px), 2), np.nan) for name in names}
    sign = 1.0 if scene.dot_level > scene.ground_level else -1.0
    result["SimpleBlob"] = simple_blobs(image, scene, sign)
    half = np.linalg.norm(scene.image_from_disc, axis=1) + 3.0
    for i, centre in enumerate(np.round(scene.centres_px)):
        low = np.maximum((centre - np.ceil(half)).astype(int), 0)
        high = (centre + np.ceil(half) + 1).astype(int)
        crop = image[low[1] : high[1], low[0] : high[0]].astype(float)
        light = float(scene.light(*scene.centres_px[i]))
        grey = (
            sign * (crop / light - scene.ground_level) / abs(scene.dot_level - scene.ground_level)
        )
        count, labels = cv2.connectedComponents((grey > 0.5).astype(np.uint8))
        here = labels[tuple((centre - low).astype(int)[::-1])]
        if count < 2 or here == 0:
            continue
        blob = (labels == here).astype(np.uint8)
        near = cv2.dilate(blob, np.ones((5, 5), np.uint8))
        result["grey centroid"][i] = grey_centroid(grey, near, 0.25, low)
        outline = max(cv2.findContours(blob, 0, 1)[0], key=len).reshape(-1, 2)
        contours = find_contours(np.where(near > 0, grey, 0.0), 0.5)
        fine = max(contours, key=len)[:, ::-1] if contours else np.zeros((0, 2))
        for name, points in (("cv2 contour", outline), ("skimage contour", fine)):
            if len(points) >= 5:
                centre_uv = cv2.fitEllipse(points.astype(np.float32).reshape(-1, 1, 2))[0]
                result[name][i] = np.array(centre_uv) + low
    return result


def simple_blobs(image: NDArray[np.generic], scene: Scene, sign: float) -> Array:
    """SimpleBlobDetector's nearest key point to each dot."""
    span = float(image.max())
    grey = np.clip(image.astype(float) * (255.0 / span), 0, 255).astype(np.uint8)
    options = cv2.SimpleBlobDetector_Params()
    options.filterByColor, options.blobColor = True, 255 if sign > 0 else 0
    options.filterByArea, options.minArea, options.maxArea = True, 4, 1e5
    options.filterByCircularity = options.filterByConvexity = options.filterByInertia = False
    options.minThreshold, options.maxThreshold, options.thresholdStep = 60, 200, 10
    options.minDistBetweenBlobs = 2
    points = cv2.SimpleBlobDetector_create(options).detect(grey)
    found = np.array([point.pt for point in points]).reshape(-1, 2)
    return matched(scene.centres_px, found)[0]


def matched(truth: Array, found: Array) -> tuple[Array, NDArray[np.int_]]:
    """Found points nearest to each true one within 1.5 px (NaN without), and their rows (-1)."""
    if len(found) == 0:
        return np.full_like(truth, np.nan), np.full(len(truth), -1)
    gap = np.linalg.norm(truth[:, None] - found[None], axis=-1)
    nearest = np.argmin(gap, axis=1)
    good = gap[np.arange(len(truth)), nearest] < 1.5
    return np.where(good[:, None], found[nearest], np.nan), np.where(good, nearest, -1)


@dataclass(frozen=True)
class Score:
    """Figures of one case; see the module's docstring."""

    case: Case
    dots: int
    found: float
    false: int
    bound_px: float
    closed_form_px: float
    rms: float
    bias: float
    chi2: float
    cov: float
    rivals: dict[str, float]

    @property
    def best_rival(self) -> float:
        return min(self.rivals.values())


def run_case(case: Case, seed: int, *, wanted: int) -> Score:
    """Measure about ``wanted`` dots of one case."""
    rng = np.random.default_rng(seed)
    errors, whitened, chi2, other = [], [], [], {}
    total = false = 0
    bounds = []
    while total < wanted:
        scene = scene_of(case, rng)
        sigma = float(np.hypot(case.noise * case.contrast, np.sqrt(1 / 12)))
        bound = centre_bound_px(replace(scene, light_per_px=(0.0, 0.0)), sigma)
        clean = render(scene)
        for _ in range(2):
            image = picture(clean, case.noise * case.contrast, case.bits, rng)
            table = telerig.locate_dots(image)
            centres, rows = matched(scene.centres_px, table[["u_px", "v_px"]].to_numpy())
            light = scene.light(*scene.centres_px.T)[:, None]
            errors.append((centres - scene.centres_px) / (bound / light))
            bounds.append(bound)
            kept = table.iloc[rows[rows >= 0]]
            gap = (centres - scene.centres_px)[rows >= 0]
            whitened.append(mahalanobis(gap, kept))
            chi2.append(kept["chi2_dof"].to_numpy())
            false += len(table) - np.count_nonzero(rows >= 0)
            total += len(scene.centres_px)
            for name, places in rivals(image, scene, case).items():
                other.setdefault(name, []).append((places - scene.centres_px) / (bound / light))
    error = np.concatenate(errors)
    got = ~np.isnan(error[:, 0])
    sigma_edge = np.hypot(case.blur_px, np.sqrt(1 / 12))
    closed = sigma / case.contrast * np.sqrt(2 * sigma_edge / (np.sqrt(np.pi) * case.radius_px))
    return Score(
        case, total, float(np.mean(got)), int(false), float(np.mean(bounds)), float(closed),
        rms(error), float(np.linalg.norm(np.mean(error[got], axis=0))),
        float(np.mean(np.concatenate(chi2))),
        float(np.sqrt(np.mean(np.concatenate(whitened)) / 2)),
        {name: rms(np.concatenate(values)) for name, values in other.items()},
    )  # fmt: skip


def rms(error: Array) -> float:
    """RMS per axis; infinite when more than 5 % are missing."""
    good = error[~np.isnan(error[:, 0])]
    return float(np.sqrt(np.mean(good**2))) if len(good) >= 0.95 * len(error) else np.inf


def mahalanobis(gap: Array, table) -> Array:  # type: ignore[no-untyped-def]
    """(N,) squared error in units of its predicted covariance."""
    suu, suv, svv = table[["suu_px2", "suv_px2", "svv_px2"]].to_numpy().T
    u, v = gap.T
    return (svv * u * u - 2 * suv * u * v + suu * v * v) / (suu * svv - suv**2)


def row(score: Score) -> str:
    """One line of the table."""

    def mark(value: float, good: bool) -> str:
        return f"{value:.2f}{'' if good else '*'}"

    gain = score.best_rival / score.rms
    needed = score.case.noise != 0.02 or gain >= 1.3
    figures = [
        f"{score.dots}", mark(100 * score.found, score.found == 1) + " %", f"{score.false}",
        f"{score.bound_px:.4f}",
        f"{score.closed_form_px:.4f}" if score.case.tilt_deg == 0 else "-",
        mark(score.rms, score.rms <= 1.15), mark(score.bias, score.bias <= 0.2),
        mark(score.chi2, 0.9 <= score.chi2 <= 1.1), mark(score.cov, 0.9 <= score.cov <= 1.1),
        *[f"{score.rivals[name]:.2f}" for name in RIVALS], mark(gain, needed),
    ]  # fmt: skip
    return f"| {score.case.label} | {' | '.join(figures)} |"


RIVALS = ("grey centroid", "SimpleBlob", "cv2 contour", "skimage contour")


def header() -> str:
    names = ["radius px", "noise", "blur px", "tilt deg", "light", "bits", "dots"]
    names += ["n", "found", "false", "bound px", "closed form px", "rms", "bias", "chi2", "cov"]
    names += [*RIVALS, "gain on best"]
    return f"| {' | '.join(names)} |\n|{'---|' * len(names)}"


def speed() -> list[str]:
    """CPU time of a small picture, and of the real ones where they lie beside the repository."""
    case = Case(12, 0.01, tilt_deg=30)
    rng = np.random.default_rng(1)
    shape = tilted_disc(12, np.deg2rad(30), 0.3)
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(3)), axis=-1).reshape(-1, 2)
    centres = 70.0 + 70.0 * grid + rng.uniform(-0.5, 0.5, (15, 2))
    scene = Scene(512, 512, centres, shape, 0.8, 190.0, 40.0, subpixels=8)
    image = picture(render(scene), case.noise * case.contrast, 8, rng)
    lines = [f"15 dots of R 12 in 512 x 512: {1e3 * _fastest(image, 7):.0f} ms"]
    folder = Path(__file__).parents[2] / "shared" / "real" / "dic_stereo_dots"
    paths = sorted(folder.glob("*.jpeg"))
    if not paths:
        return lines
    tables = [telerig.locate_dots(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    counts = [len(table) for table in tables]
    rings = {int(table.ring.sum()) for table in tables}
    seconds = _fastest(cv2.imread(str(paths[0]), cv2.IMREAD_GRAYSCALE), 5)
    lines.append(f"one real picture, 2448 x 2048, {counts[0]} dots of R 46: {seconds:.2f} s")
    lines.append(
        f"{len(paths)} real pictures: {sum(counts)} dots ({min(counts)}..{max(counts)} each; about "
        f"2360 are complete), rings per picture {sorted(rings)}"
    )
    return lines


def _fastest(image: NDArray[np.generic], times: int) -> float:
    spent = []
    for _ in range(times):
        begin = time.process_time()
        telerig.locate_dots(image)
        spent.append(time.process_time() - begin)
    return min(spent)


def main(report: Callable[[str], None] = print) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a third of the dots")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases")
    parser.add_argument("--out", type=Path, help="write the table there as Markdown")
    options = parser.parse_args()
    lines = [header()]
    report(lines[0])
    for k, case in enumerate(CASES):
        if options.only is not None and k not in options.only:
            continue
        lines.append(row(run_case(case, 1000 + k, wanted=150 if options.quick else 600)))
        report(lines[-1])
    notes = speed()
    report("\n".join(notes))
    lines += ["", "CPU time, best of several, and real pictures:", "", *(f"- {n}" for n in notes)]
    if options.out:
        title = "# Dots against the Cramer-Rao bound\n\n```\n" + str(__doc__).strip() + "\n```\n\n"
        options.out.write_text(title + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
