"""What a printed target costs when its dots are believed, and what freeing them wins.

Usage: python benchmarks/print_errors.py [--seeds 60] [--out FILE.md]

The preset `paper`: dots off by 20 µm (standard deviation, each of x, y and out of the plane) that
nobody tells the estimator, pixel noise 0.01 px. The same tables are calibrated with the dots free
in 3-D, free in the plane, and nominal; also with a stated tolerance that is wrong. 3-D error: RMS
per axis over a cube of 30 mm, after the rotation and shift that fit best.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from calibration_scene import Scene, make_scene
from numpy.typing import NDArray
from rig_truth import aligned, volume

from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.io.simulation.presets import preset
from telerig.rig.triangulation import triangulate

Array = NDArray[np.float64]

KINDS = ("3d", "plane", "nominal")
STATED = (0.02, 0.005, 0.1, 0.5)
PRINTS_MM = (0.005, 0.02, 0.05)


def error_um(scene: Scene, dots_free: str) -> tuple[float, float]:
    """(3-D error, scatter of the dots round the model in px)."""
    calibration = self_calibrate(
        scene.dots,
        scene.nominal,
        scene.target,
        nominal_rotvec_deg=scene.nominal_rotvec_deg,
        model="radial",
        dots_free=dots_free,
    )
    truth, points = list(scene.cameras.values()), volume()
    pixels = tuple(c.project(points) for c in truth)
    found = triangulate((calibration.cameras[0], calibration.cameras[1]), pixels, 1.0)
    off = aligned(found.points_mm, points) - points
    return float(1e3 * np.sqrt((off**2).mean())), calibration.statistics["scatter_px"]


def study(seeds: int, printed_mm: float, stated_mm: float) -> dict[str, tuple[float, float]]:
    """Median 3-D error and scatter per way to treat the dots."""
    base = preset("paper")
    target = replace(base.target, print_sigma_mm=printed_mm, flatness_sigma_mm=printed_mm)
    config = replace(base, target=target)
    found: dict[str, list[tuple[float, float]]] = {k: [] for k in KINDS}
    for seed in range(seeds):
        scene = make_scene(config, np.random.default_rng(seed))
        told = replace(scene.target, print_sigma_mm=stated_mm, flatness_sigma_mm=stated_mm)
        for kind in KINDS:
            found[kind].append(error_um(replace(scene, target=told), kind))
    medians = {k: np.median(np.array(v), 0) for k, v in found.items()}
    return {k: (float(m[0]), float(m[1])) for k, m in medians.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    about = (__doc__ or "").strip().splitlines()[4:]
    lines = [
        "# Print errors of the target",
        "",
        *about,
        "",
        "| dots off by µm | stated µm | 3-D error µm: free in 3-D | in the plane | nominal | "
        "**gain of 3-D over nominal** | scatter px: 3-D | plane | nominal |",
        "|---" * 9 + "|",
    ]
    settings = [(0.02, s) for s in STATED] + [(p, p) for p in PRINTS_MM if p != 0.02]
    for printed, stated in settings:
        row = study(options.seeds, printed, stated)
        errors = " | ".join(f"{row[k][0]:.2f}" for k in KINDS)
        scatters = " | ".join(f"{row[k][1]:.3f}" for k in KINDS)
        gain = row["nominal"][0] / row["3d"][0]
        lines.append(
            f"| {1e3 * printed:g} | {1e3 * stated:g} | {errors} | **{gain:.1f}** | {scatters} |"
        )
        print(lines[-1], flush=True)
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
