"""The real stereo pairs of a printed target: residuals, share of dots kept, angle, kappa = 0.

python benchmarks/real_images.py FOLDER [--out benchmarks/results/real_images.md]

FOLDER holds CalB-sys2-00NN_0.jpeg (left) and _1.jpeg (right), or dic_stereo_dots with these, and
plates_discorpy and plates_boofcv, which `plates.real` measures, and the images of bubbles that
`dense_bubbles` measures (more than half an hour).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from dense_bubbles import report as bubbles_report
from plates import real

import telerig
from telerig.estimator.calibration.calibrate import nominal_cameras
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.estimator.dots.dataset_dots import detect_dataset

RIG = """
schema = 1
name = "printed target, long lenses"
[cameras.left]
image_size_px = [2448, 2048]
scale_px_per_mm = 66.0
[cameras.right]
image_size_px = [2448, 2048]
scale_px_per_mm = 66.0
[stereo]
right_from_left_rotvec_deg = [0.0, 27.0, 0.0]
[target]
layout = "grid"
rows = 8
columns = 10
pitch_mm = 3.5
dot_diameter_mm = 1.38
polarity = "black_on_white"
marks = [[0, 0], [0, 5], [3, 0]]
mark_style = "ring"
extent = "unbounded"
print_sigma_mm = 0.02
"""

CASES = (
    ("3d", "auto", 4.5),
    ("plane", "auto", 4.5),
    ("plane", "auto", 4.0),
    ("plane", "auto", 3.75),
    ("plane", "auto", 3.5),
    ("plane", "kappa+prism+centre", 4.5),
    ("nominal", "kappa+brown+centre", 4.5),
    ("3d", "brown", 4.5),
)
"""What dots may do, lens model, and standard deviations beyond which a dot is left out."""


def make_dataset(images: Path, folder: Path) -> Path:
    """A dataset of links to the images."""
    for index, camera in enumerate(("left", "right")):
        target = folder / "calibration" / camera
        target.mkdir(parents=True)
        for path in sorted(images.glob(f"CalB-sys2-*_{index}.jpeg")):
            (target / f"{path.stem.split('-')[-1].split('_')[0]}.jpeg").symlink_to(path.resolve())
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    pairs = options.folder / "dic_stereo_dots"
    whole = pairs.is_dir()
    with tempfile.TemporaryDirectory() as temporary:
        data = telerig.load_dataset(
            make_dataset(pairs if whole else options.folder, Path(temporary) / "set")
        )
        begun = time.perf_counter()
        found = detect_dataset(data)
        lines = [
            "# Real images: 14 stereo pairs, printed target, lenses not telecentric", "",
            f"{len(found.dots)} dots numbered in {len(found.images)} images, "
            f"{time.perf_counter() - begun:.0f} s", "",
            "| dots | model | limit | kept | RMS px | floor px | angle deg | sd (formal) "
            "| centres mm | out of plane µm | verdict | s |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|",
        ]  # fmt: skip
        for dots_free, model, limit in CASES:
            lines.append(case(data, found.dots, dots_free, model, limit))
            print(lines[-1], flush=True)
    if whole:
        lines += ["", "Plates of other laboratories:", "", *real(options.folder)]
        lines += ["", *bubbles_report(options.folder, 3)]
    text = "\n".join([*lines, ""])
    print(text)
    if options.out is not None:
        options.out.write_text(text, encoding="utf-8")


def case(data: telerig.Dataset, dots: object, dots_free: str, model: str, limit: float) -> str:
    begun = time.perf_counter()
    result = self_calibrate(
        dots,  # type: ignore[arg-type]
        nominal_cameras(data.rig), data.target, model=model, dots_free=dots_free, outlier_sd=limit,
        nominal_rotvec_deg=data.rig.rotvec_from_first_deg,
    )  # fmt: skip
    s = result.statistics
    return (
        f"| {dots_free} | {result.model['name']} | {limit} | {s['share_kept']:.1%} "
        f"| {s['rms_px']:.4f} "
        f"| {s['noise_floor_px']:.4f} | {s['axes_angle_deg']:.3f} | {s['axes_angle_sd_deg']:.3f} "
        f"({s['axes_angle_formal_sd_deg']:.3f}) "
        f"| {s.get('perspective_centres_distance_mm', float('nan')):.2f} "
        f"| {1e3 * s['target_out_of_plane_rms_mm']:.1f} | {result.verdict['status']} "
        f"| {time.perf_counter() - begun:.0f} |"
    )


if __name__ == "__main__":
    main()
