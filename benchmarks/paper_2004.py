"""The figures of the 2004 paper beside telerig's under the same inputs, in one command.

Usage: python benchmarks/paper_2004.py [--seeds 3] [--out FILE.md]

Coudert, Fournel, Lavest, Collange, Schon (ISFV11, 2004): 12 views of 15 dots in two cameras of
512 x 512 px at 10 px/mm, a rise of one bubble over 59 frames of 10 ms, stage and arms that vibrate.
Everything is simulated; the truth is the simulator's, and every seed counts.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent))
from calibration_scene import make_scene

import telerig
from telerig.estimator.calibration.calibrate import run_calibration
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.estimator.smoothing.truth import motion_error
from telerig.estimator.tracking.truth import score_tracks
from telerig.io.simulation.presets import preset, run_preset
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.triangulation import working_volume

Array = NDArray[np.float64]

RISE_MM_S = 280.0


@dataclass(frozen=True)
class Figures:
    """Of one seed, in the units of the table."""

    dots_px: float
    space_um: dict[float, tuple[float, float]]
    centre_px: float
    volume_px: float
    naive_um: float
    arms_um: float
    references_um: float
    naive_mm_s: float
    arms_mm_s: float
    references_mm_s: float


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def dots_px(data: telerig.Dataset, dots: pd.DataFrame) -> float:
    """RMS per coordinate of the measured dots against truth/dots.csv (centres of the discs)."""
    exact = pd.read_csv(data.path / "truth" / "dots.csv", dtype={"view": str})
    both = dots.merge(exact, on=["view", "camera", "dot"], suffixes=("", "_true"))
    off = both[["u_px", "v_px"]].to_numpy() - both[["u_px_true", "v_px_true"]].to_numpy()
    return rms(off)


def space_um(sigma_px: float, seed: int) -> tuple[float, float]:
    """Length of the 3-D error, RMS, of points whose pixels and calibration dots have this noise.

    Second: what the pixels alone cost with the cameras known.
    """
    rng = np.random.default_rng([seed, 1])
    scene = make_scene(preset("paper", sigma_px=sigma_px), rng)
    found = self_calibrate(
        scene.dots, scene.nominal, scene.target, nominal_rotvec_deg=scene.nominal_rotvec_deg,
        model="radial",
    )  # fmt: skip
    cameras = tuple(scene.cameras.values())
    points = working_volume(cameras, 7)
    noisy = [c.project(points) + sigma_px * rng.standard_normal((len(points), 2)) for c in cameras]
    placed = found.triangulate(noisy[0], noisy[1], sigma_px=sigma_px).points_mm
    known = _with(found, cameras).triangulate(
        noisy[0], noisy[1], sigma_px=sigma_px, include_calibration=False
    )
    return (
        1e3 * rms(np.linalg.norm(Pose.aligning(placed, points).apply(placed) - points, axis=1)),
        1e3 * rms(np.linalg.norm(known.points_mm - points, axis=1)),
    )


def _with(calibration: Calibration, cameras: tuple[Camera, ...]) -> Calibration:
    return replace(calibration, cameras=cameras)


def one(seed: int, folder: Path) -> Figures:
    """Everything from images: calibration, track, and the path by three sets of information."""
    config = run_preset("rise")
    arms = replace(config, stage=replace(config.stage, accelerometers=("left", "right")))
    arms = replace(arms, table=replace(arms.table, references=4))
    data = telerig.simulate(arms, rng=np.random.default_rng(seed), out=folder / str(seed))
    found = run_calibration(data)
    assert found.detected is not None
    (name,) = data.runs
    run = telerig.load_run(data.runs[name].path)
    truth = pd.read_csv(data.path / "truth" / "runs" / name / "bubbles.csv")
    tracks = telerig.track(run, found.calibration)
    score = score_tracks(tracks, truth, [c.name for c in found.calibration.cameras])
    paths = {}
    for words, used in (
        ("arms", replace(run, references=None)),
        ("references", replace(run, accelerometers=None)),
    ):
        paths[words] = telerig.smooth(
            replace(tracks, references=None), found.calibration, stage=used
        ).trajectories
    naive = motion_error(paths["arms"], truth, "naive_")
    by_arms, by_marks = (motion_error(paths[k], truth) for k in ("arms", "references"))
    return Figures(
        dots_px(data, found.detected.dots), {s: space_um(s, seed) for s in (0.03, 0.1)},
        score.centre_px, score.corrected_px,
        naive.position_um, by_arms.position_um, by_marks.position_um,
        naive.velocity_mm_s, by_arms.velocity_mm_s, by_marks.velocity_mm_s,
    )  # fmt: skip


def table(found: list[Figures]) -> str:
    def mean(name: str) -> float:
        return rms(np.array([getattr(f, name) for f in found]))

    def space(sigma: float, which: int) -> float:
        return rms(np.array([f.space_um[sigma][which] for f in found]))

    length = np.sqrt(3)
    rows = [
        ("dots, from images", "0.03 px", f"{mean('dots_px'):.4f} px", "RMS per coordinate"),
        ("space, dots and points of 0.03 px", "5 µm", f"{space(0.03, 0):.2f} µm",
         f"RMS length ({space(0.03, 0) / length:.2f} µm per axis); {space(0.03, 1):.2f} µm with "
         "the cameras known"),
        ("space, dots and points of 0.1 px", "10 µm", f"{space(0.1, 0):.2f} µm",
         f"RMS length ({space(0.1, 0) / length:.2f} µm per axis); {space(0.1, 1):.2f} µm with "
         "the cameras known"),
        ("bubble's centre, from images", "1.5 px", f"{mean('volume_px'):.3f} px",
         f"of volume, RMS per coordinate; {mean('centre_px'):.3f} px for the outline's centre"),
        ("bubble overall, arm accelerometers", "0.5 mm",
         f"{1e-3 * length * mean('arms_um'):.3f} mm",
         f"RMS length; {1e-3 * length * mean('naive_um'):.3f} mm by triangulating and adding the "
         "encoder"),
        ("bubble overall, marks on the tank", "0.5 mm",
         f"{1e-3 * length * mean('references_um'):.3f} mm", "RMS length"),
        ("velocity, arm accelerometers", "1 %", f"{100 * mean('arms_mm_s') / RISE_MM_S:.2f} %",
         f"RMS per axis over {RISE_MM_S:.0f} mm/s; {100 * mean('naive_mm_s') / RISE_MM_S:.2f} % "
         "naive"),
        ("velocity, marks on the tank", "1 %", f"{100 * mean('references_mm_s') / RISE_MM_S:.2f} %",
         "RMS per axis"),
    ]  # fmt: skip
    head = [
        f"# The figures of 2004 and telerig's, {len(found)} seeds", "",
        "Printed by `benchmarks/paper_2004.py`.", "",
        "| figure | 2004 | telerig | how |", "|---|---|---|---|",
    ]  # fmt: skip
    return "\n".join([*head, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=500)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(asked.first, asked.first + asked.seeds):
            found.append(one(seed, Path(folder)))
            print(found[-1], flush=True)
    text = table(found)
    print(text)
    if asked.out:
        asked.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
