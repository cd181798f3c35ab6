"""Closed-form start of the self-calibration on many random rigs: is it in the right basin?

Usage: python benchmarks/initialisation.py [--rigs 1000] [--seed ONE] [--out FILE.md]

Each rig is drawn anew: angle between the cameras 20-110 deg (every fifth: 110-160 deg with a
two-sided plate), tilts of the plate 5-75 deg, scale 1-100 px/mm, 512-2048 px, 9-42 dots, 6-40
views, dot noise 0.005-0.03 px, print errors of 20 µm in and out of plane, k1 up to 2e-2 and kappa
up to 1e-4 / mm in every camera (print errors and 1 / kappa in proportion to the field of view,
which is 51 mm for the figures given), nominal rotation wrong by up to 8 deg. The start of
`self_calibrate` (closed form, a short solve, the choice of the mirror solution), refined with the
true model, must reach the cost that the same solver reaches from the truth, on the true side.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from calibration_scene import Scene, make_scene

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.self_calibration import best_start
from telerig.estimator.calibration.solver.problem import Problem, held_at_nominal
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.start import mirror_ambiguity
from telerig.estimator.calibration.start.known_target import angle_between
from telerig.factors.calibration import State
from telerig.io.simulation.config import CameraConfig, SimulationConfig
from telerig.io.simulation.presets import preset
from telerig.rig.target import Target

MODEL = "kappa+radial"
REFERENCE_FIELD_MM = 51.2
COST_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Outcome:
    """angle_deg, views, ...: of the rig; cause: empty when the start was good."""

    seed: int
    angle_deg: float
    views: int
    scale: float
    cause: str
    detail: str
    seconds: float


def random_config(rng: np.random.Generator, two_sided: bool) -> SimulationConfig:
    """See the module's docstring."""
    size = int(rng.choice([512, 1024, 2048]))
    scale = float(np.exp(rng.uniform(0, np.log(100))))
    field = size / scale
    unit = field / REFERENCE_FIELD_MM
    cameras = tuple(
        CameraConfig(
            name,
            (size, size),
            scale * rng.uniform(0.95, 1.05),
            scale,
            tuple(rng.normal(0, 3, 2)),
            {"k1": rng.uniform(-2e-2, 2e-2), "kappa_per_mm": rng.uniform(-1e-4, 1e-4) / unit},
        )
        for name in ("left", "right")
    )
    rows, columns = int(rng.integers(3, 7)), int(rng.integers(3, 8))
    pitch = 0.62 * field / np.hypot(rows - 1, columns - 1)
    target = Target(
        rows=rows,
        columns=columns,
        pitch_mm=(pitch, pitch),
        dot_diameter_mm=0.35 * pitch,
        print_sigma_mm=0.02 * unit,
        flatness_sigma_mm=0.02 * unit,
        scale_dots=(0, rows * columns - 1),
        scale_sigma_mm=0.001 * unit,
        two_sided=two_sided,
        plate_thickness_mm=2.0 * unit if two_sided else 0.0,
        plate_index=1.52,
    )
    off = rng.standard_normal(3)
    off *= rng.uniform(0, 8) / np.linalg.norm(off)
    return preset(
        "paper",
        cameras=cameras,
        target=target,
        views=int(rng.integers(6, 41)),
        angle_deg=float(rng.uniform(110, 160) if two_sided else rng.uniform(20, 110)),
        mount_rotvec_deg=tuple(off),
        axis_gap_mm=0.3 * unit,
        tilt_deg=(5.0, 75.0),
        shift_mm=(0.1 * field,) * 3,
        visible_fraction=0.8,
        border_px=2.0,
        sigma_px=float(rng.uniform(0.005, 0.03)),
        marks_visible=False,
    )


def judge(scene: Scene) -> tuple[str, str]:
    """(cause, detail) of a failure; empty strings for a good start."""
    problem = scene.problem()
    nominal = {1: np.array(scene.nominal_rotvec_deg)}
    truth = scene.true_state(problem)
    try:
        problem, start = best_start(problem, problem.nominal_mm)
        start = mirror_ambiguity.choose_solution(start, problem, nominal).state
    except CalibrationError as error:
        return "refused", str(error.what)
    final = problem.with_model(MODEL)
    found = solve(final, held_at_nominal(final, start))
    reference = solve(final, held_at_nominal(final, truth))
    gap = found.cost / reference.cost - 1
    turn = np.degrees(
        angle_between(*(s.state.rig_from_camera[1, :3, :3] for s in (found, reference)))
    )
    if abs(gap) < COST_TOLERANCE and turn < 0.1:
        return "", ""
    detail = f"cost {found.cost:.6g} against {reference.cost:.6g}, rotation {turn:.2f} deg off"
    if gap < -COST_TOLERANCE:
        return "truth's basin is not the lowest", detail
    return _cause(problem, truth, start, float(turn)), detail


def _cause(problem: Problem, truth: State, start: State, turn_deg: float) -> str:
    mirrored = mirror_ambiguity.mirrored_state(truth)
    turns = [
        np.degrees(angle_between(s.rig_from_camera[1, :3, :3], start.rig_from_camera[1, :3, :3]))
        for s in (truth, mirrored)
    ]
    if turns[1] < turns[0] and turns[1] < 10:
        return "wrong mirror solution"
    if turns[0] > 10:
        return "wrong inter-camera rotation"
    off = np.degrees(
        angle_between(truth.rig_from_target[:, :3, :3], start.rig_from_target[:, :3, :3])
    )
    if off.max() > 10:
        return f"tilt sign of {int((off > 10).sum())} view(s)"
    return "did not converge"


def run(rigs: int) -> list[Outcome]:
    outcomes: list[Outcome] = []
    seed = -1
    while len(outcomes) < rigs:
        seed += 1
        rng = np.random.default_rng(seed)
        config = random_config(rng, two_sided=seed % 5 == 4)
        try:
            scene = make_scene(config, rng)
        except InputError:
            continue
        began = time.perf_counter()
        cause, detail = judge(scene)
        seconds = time.perf_counter() - began
        scale = config.cameras[0].nominal_scale_px_per_mm
        outcome = Outcome(seed, config.angle_deg, config.views, scale, cause, detail, seconds)
        outcomes.append(outcome)
        if cause:
            print(f"{len(outcomes)}: {outcome}", flush=True)
    return outcomes


def report(outcomes: list[Outcome]) -> str:
    bad = [o for o in outcomes if o.cause]
    lines = [
        "# Start of the self-calibration on random rigs",
        "",
        *(__doc__ or "").strip().splitlines()[4:],
        "",
        f"**{len(outcomes) - len(bad)} of {len(outcomes)}** rigs start in the right basin "
        f"({len(bad)} failures). Median {np.median([o.seconds for o in outcomes]):.2f} s a rig for "
        "start and both reference solves, one core.",
        "",
    ]
    if bad:
        lines += [
            "| seed | angle deg | views | px/mm | cause | detail |",
            "|---|---|---|---|---|---|",
        ]
        lines += [
            f"| {o.seed} | {o.angle_deg:.0f} | {o.views} | {o.scale:.3g} | {o.cause} | {o.detail} |"
            for o in bad
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=None, help="judge one rig and say why")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.seed is not None:
        rng = np.random.default_rng(options.seed)
        config = random_config(rng, two_sided=options.seed % 5 == 4)
        print(judge(make_scene(config, rng)))
        return
    text = report(run(options.rigs))
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
