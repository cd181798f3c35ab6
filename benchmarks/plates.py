"""Plates as other laboratories have them: spoiled renders with known truth, and real images.

python benchmarks/plates.py [FOLDER] [--hearts] [--out benchmarks/results/plates.md]

FOLDER holds plates_discorpy and plates_boofcv, real images that are not part of this repository.
A spoiled plate is drawn by `dot_renderer` and then clipped, compressed or lit unevenly. --hearts:
only plates whose dots have hearts, inner discs that are brighter or darker.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from dot_renderer import Scene, add_disc, render, tilted_disc
from dots import Case as Picture
from dots import mahalanobis, matched, rivals
from numpy.typing import NDArray
from scipy.optimize import least_squares

from telerig.estimator.dots.dataset_dots import detect_target
from telerig.estimator.dots.grid.lattice import (
    Lattice,
    apply_homography,
    fit_homography,
    grow_lattice,
    shape_matrix,
)
from telerig.estimator.dots.locate import measure_dots
from telerig.rig.target import Target

Array = NDArray[np.float64]
Grey = NDArray[np.generic]
SEEDS = 20
SIDE = 9
PEERS = ("SimpleBlob", "skimage contour")


def plate(
    radius_px: float, rng: np.random.Generator, *, dot: float, ground: float, slope: float = 0.0
) -> Scene:
    """SIDE x SIDE dots, two diameters apart, tilted by 25 degrees.

    slope : relative change of the light across the image.
    """
    shape = tilted_disc(radius_px, np.deg2rad(25.0), 0.6)
    index = np.stack(np.meshgrid(*[np.arange(SIDE) - SIDE // 2] * 2), axis=-1).reshape(-1, 2)
    size = int(4 * SIDE * radius_px + 24)
    centres = 4.0 * index @ shape.T + (size - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
    return Scene(
        size, size, centres, shape, blur_px=0.8, dot_level=dot, ground_level=ground,
        light_per_px=(slope / size, 0.0), subpixels=8,
    )  # fmt: skip


def rounded(grey: Array, bits: int = 8) -> Grey:
    dtype = np.uint8 if bits == 8 else np.uint16
    return np.clip(np.rint(grey), 0, np.iinfo(dtype).max).astype(dtype)


def compressed(quality: int) -> Callable[[Array], Grey]:
    def image(grey: Array) -> Grey:
        _, data = cv2.imencode(".jpg", rounded(grey), [cv2.IMWRITE_JPEG_QUALITY, quality])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))

    return image


class Case(NamedTuple):
    name: str
    dot: float
    ground: float
    noise: float
    image: Callable[[Array], Grey] = rounded
    slope: float = 0.0


CASES = (
    Case("sound", 190, 40, 3),
    Case("blacks clipped: ground at 0", 160, 0, 3),
    Case("blacks clipped: ground 12 below 0", 148, -12, 3),
    Case("blacks clipped, 16 bits", 40000, 0, 400, lambda g: rounded(g, 16)),
    Case("whites clipped: ground 15 above 255", 60, 270, 3),
    Case("whites clipped: ground at 250", 60, 250, 4),
    Case("dots clipped to white", 280, 60, 3),
    Case("8 of 16 bits", 190 * 256, 40 * 256, 768, lambda g: rounded(np.rint(g / 256) * 256, 16)),
    Case("12 of 16 bits", 3000 * 16, 600 * 16, 240, lambda g: rounded(np.rint(g / 16) * 16, 16)),
    Case("JPEG 95", 190, 40, 3, compressed(95)),
    Case("JPEG 85", 190, 40, 3, compressed(85)),
    Case("JPEG 75", 190, 40, 3, compressed(75)),
    Case("light changes by 60 %", 150, 40, 2, slope=0.6),
    Case("gamma 0.45", 190, 40, 2, lambda g: rounded(255 * (np.clip(g, 0, 255) / 255) ** 0.45)),
)


def spoiled(case: Case, radius_px: float) -> str:
    found = wrong = 0
    errors, normalised = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        scene = plate(radius_px, rng, dot=case.dot, ground=case.ground, slope=case.slope)
        clean = render(scene)
        image = case.image(clean + case.noise * rng.standard_normal(clean.shape))
        dots = measure_dots(image).dots
        gap = dots[["u_px", "v_px"]].to_numpy()[:, None] - scene.centres_px
        nearest = np.argmin(np.linalg.norm(gap, axis=-1), axis=1)
        error = gap[np.arange(len(gap)), nearest]
        there = np.linalg.norm(error, axis=1) < radius_px
        found += len(set(nearest[there].tolist()))
        wrong += int(np.sum(~there))
        suu, suv, svv = dots[["suu_px2", "suv_px2", "svv_px2"]].to_numpy()[there].T
        u, v = error[there].T
        normalised.append((svv * u * u - 2 * suv * u * v + suu * v * v) / (suu * svv - suv**2))
        errors.append(np.hypot(u, v))
    square, error = np.concatenate(normalised), np.concatenate(errors)
    return (
        f"| {case.name} | {radius_px:g} | {found / (SEEDS * SIDE**2):.1%} | {wrong} "
        f"| {np.sqrt(np.mean(error**2) / 2):.4f} | {error.max():.3f} | {np.sqrt(square.max()):.1f} "
        f"| {square.mean() / 2:.2f} |"
    )


class Hearts(NamedTuple):
    """Dots with inner discs of the relative radius ``size`` +- 10 % and ``extra`` light, relative
    to the dot's, up to ``off`` radii off centre; ``share`` of the dots have one."""

    size: float
    extra: float
    off: float = 0.1
    share: float = 1.0


HEARTS = (
    *(Hearts(size, extra) for size in (0.3, 0.5, 0.7, 0.8) for extra in (0.3, 1.5, -0.4)),
    Hearts(0.5, 1.5, 0.0),
    Hearts(0.5, 1.5, 0.1, 0.3),
    Hearts(0.5, -0.4, 0.1, 0.3),
)


def hearted(kind: Hearts, radius_px: float, rng: np.random.Generator) -> tuple[Scene, Array]:
    """A plate without its hearts, and the noise-free image with them."""
    scene = plate(radius_px, rng, dot=110, ground=50)
    image = render(scene)
    for centre in scene.centres_px[rng.uniform(size=SIDE**2) < kind.share]:
        shape = kind.size * rng.uniform(0.9, 1.1) * scene.image_from_disc
        turn, way = rng.uniform(0, 2 * np.pi), kind.off * np.sqrt(rng.uniform())
        shift = scene.image_from_disc @ (way * np.array([np.cos(turn), np.sin(turn)]))
        light = kind.extra * (scene.dot_level - scene.ground_level)
        heart = replace(scene, image_from_disc=shape, dot_level=light, ground_level=0.0)
        add_disc(image, heart, centre + shift)
    return scene, image


def with_hearts(kind: Hearts, radius_px: float, seeds: int = 1) -> str:
    """A row of the table of hearts; peers are those of `dots`, told place and grey levels."""
    found = small = 0
    errors, normalised, theirs = [], [], {name: [] for name in PEERS}
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        scene, clean = hearted(kind, radius_px, rng)
        image = rounded(clean + 2.0 * rng.standard_normal(clean.shape))
        dots = measure_dots(image).dots
        centres, rows = matched(scene.centres_px, dots[["u_px", "v_px"]].to_numpy())
        good = rows >= 0
        dots, error = dots.iloc[rows[good]], (centres - scene.centres_px)[good]
        found += int(np.sum(good))
        area = dots["a_px"] * dots["b_px"] / np.linalg.det(scene.image_from_disc)
        small += int(np.sum(area < 0.9**2))
        normalised.append(mahalanobis(error, dots))
        errors.append(np.linalg.norm(error, axis=1))
        for name, places in rivals(image, scene, Picture(radius_px)).items():
            if name in PEERS:
                theirs[name].append(np.linalg.norm(places - scene.centres_px, axis=1))
    error, square = np.concatenate(errors), np.concatenate(normalised)
    peers = [f"{np.nanmedian(np.concatenate(theirs[name])):.3f}" for name in PEERS]
    return (
        f"| {kind.size:g} | {kind.extra:+g} | {kind.off:g} | {kind.share:.0%} | {radius_px:g} "
        f"| {found / (seeds * SIDE**2):.1%} | {small} | {np.median(error):.4f} | {error.max():.2f} "
        f"| {square.mean() / 2:.2f} | {' | '.join(peers)} |"
    )


def lattice_of(image: Grey) -> tuple[Array, Lattice, float]:
    """Dots (N, 2) of the image, their lattice, and the CPU time in s."""
    begun = time.process_time()
    dots = measure_dots(image, polarity="black_on_white").dots
    points = dots[["u_px", "v_px"]].to_numpy()
    shapes = shape_matrix(*dots[["a_px", "b_px", "angle_rad"]].to_numpy().T)
    lattice = grow_lattice(points, shapes)
    return points, lattice, time.process_time() - begun


def published(path: Path) -> Callable[[Array], Array]:
    """Discorpy's map from undistorted to distorted pixels (N, 2)."""
    values = [float(line.split(":")[1]) for line in path.read_text().splitlines()]
    centre, factors = np.array(values[:2]), values[2:]

    def distorted(points: Array) -> Array:
        offset = points - centre
        along = np.polyval(factors[::-1], np.hypot(*offset.T))
        return np.asarray(centre + offset * along[:, None])

    return distorted


def radial(numbers: Array) -> Callable[[Array], Array]:
    """The radial distortion with k1, k2, k3 about a centre, in units of 700 px."""
    centre, k = numbers[:2], numbers[2:]

    def distorted(points: Array) -> Array:
        offset = (points - centre) / 700.0
        square = np.sum(offset**2, axis=1)
        along = 1.0 + square * (k[0] + square * (k[1] + square * k[2]))
        return np.asarray(centre + 700.0 * offset * along[:, None])

    return distorted


def fitted(
    places: Array, points: Array, distorted: Callable[[Array], Callable[[Array], Array]],
    start: Array,
) -> Array:  # fmt: skip
    """Pixels (N, 2) of the places under the best homography and distortion."""
    homography = fit_homography(places, points)
    begin = np.r_[(homography / homography[2, 2]).ravel()[:8], start]

    def pixels(numbers: Array) -> Array:
        matrix = np.append(numbers[:8], 1.0).reshape(3, 3)
        return distorted(numbers[8:])(apply_homography(matrix, places))

    found = least_squares(
        lambda x: (pixels(x) - points).ravel(), begin, x_scale="jac", loss="soft_l1", f_scale=0.1
    )
    return pixels(found.x)


def real(folder: Path) -> list[str]:
    plates, boof = folder / "plates_discorpy", folder / "plates_boofcv"
    lines = []
    for name, whole in (("dot_pattern_02", 1324), ("dot_pattern_05", 4414)):
        image = cv2.imread(str(plates / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        points, lattice, seconds = lattice_of(image)
        lines.append(
            f"- discorpy {name}: {len(points)} dots, {whole} whole ones by its README; "
            f"{len(lattice.index)} of them on the grid; {seconds:.1f} s of CPU"
        )
    places, points = lattice.places.astype(float), points[lattice.index]
    theirs = fitted(places, points, lambda _: published(plates / "coef_dot_05.txt"), np.zeros(0))
    ours = fitted(places, points, radial, np.array([640.0, 400.0, 0.0, 0.0, 0.0]))
    between = np.linalg.norm(theirs - ours, axis=1)
    for words, model in (("published distortion", theirs), ("k1, k2, k3 and centre", ours)):
        off = np.linalg.norm(points - model, axis=1)
        lines.append(
            f"  - {words} and a homography, fitted to our dots: "
            f"{np.sqrt(np.mean(off**2)):.3f} px RMS, {off.max():.2f} px at most"
        )
    lines.append(f"  - the two differ by at most {between.max():.2f} px over the plate")
    image = cv2.imread(str(boof / "image00002.jpg"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    target = Target(
        rows=8, columns=10, pitch_mm=(25.0, 25.0), dot_diameter_mm=15.0, polarity="black_on_white"
    )
    lines.append(f"- BoofCV image00002: {len(detect_target(image, target))} of 80 dots numbered")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--hearts", action="store_true", help="only plates with hearts")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    lines = [
        "# Plates of other laboratories", "",
        f"Rendered: {SIDE} x {SIDE} dots, tilt 25 degrees, blur 0.8 px, {SEEDS} plates a row. "
        "NEES: mean squared normalised error per coordinate, 1 if the stated standard "
        "deviations are true.", "",
        "| plate | radius px | found | false | RMS px | worst px | worst sd | NEES |",
        "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for case in () if options.hearts else CASES:
        for radius_px in (3.0, 6.0):
            lines.append(spoiled(case, radius_px))
            print(lines[-1], flush=True)
    lines += [
        "", "Dots with hearts, inner discs: extra light relative to the dot's, noise 2 of a "
        "contrast of 60, one plate a row. On the heart: dots whose radius is below 0.9 of the true "
        "one. The peers are told each dot's place and the true grey levels; median errors.", "",
        "| heart's radius | extra light | off centre | dots with hearts | radius px | found "
        f"| on the heart | median error px | worst px | NEES | {' | '.join(PEERS)} |",
        f"|{(10 + len(PEERS)) * '---|'}",
    ]  # fmt: skip
    for kind in HEARTS:
        for radius_px in (5.0, 8.0, 15.0):
            lines.append(with_hearts(kind, radius_px))
            print(lines[-1], flush=True)
    if options.folder is not None:
        lines += ["", "Real images:", "", *real(options.folder)]
        print("\n".join(lines[-7:]))
    if options.out is not None:
        options.out.write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
