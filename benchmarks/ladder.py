"""Does the ladder of lens models find the right one? Random rigs of every rung.

Usage: python benchmarks/ladder.py [--first 200] [--seeds 100] [--weak-seeds 15] [--out FILE.md]

A rig of seed s and a rung is drawn: 10 to 24 hand-held views, 15 to 100 dots, axes 50 to 100
degrees apart, image noise 0.005 to 0.02 px, target printed to 20 µm, image centres on the axes.
Each parameter of the rung is between three times what is detectable (three standard deviations of
the rung's own fit, so nine of them) and "big" (`BIG`), log-uniform; of a pair (p1 and p2, ...) the
length, its direction at random. A second table has them between one and three times what is
detectable: near the limit. kappa, tilt and aspect+skew come with k1 in every second rig;
every second tilted sensor is behind a lens that is telecentric on both sides (w = 0), where
aspect+skew has the same pixels and is counted as right. "mixed" has another rung in each camera.

Right: in both cameras exactly the parameters of the truth. Over: some besides. Under: some lack.
Space: 200 fresh points in a cube of 30 mm, triangulated from their true pixels, RMS distance from
the truth after the rigid motion that fits best; of the chosen model over that of the true one.

Seeds from 1000 on served to develop; seeds below 200 to set the price of a group (decision 014).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from calibration_scene import Scene, make_scene
from covariance import aligned
from numpy.typing import NDArray

from telerig.estimator.calibration.lens_choice import model_start
from telerig.estimator.calibration.self_calibration import choose_model
from telerig.estimator.calibration.solver.problem import (
    Problem,
    cameras_from_state,
    held_at_nominal,
)
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.solver.system import System
from telerig.factors.calibration import State
from telerig.io.simulation.config import CameraConfig, SimulationConfig
from telerig.rig.lens_parameters import name_of
from telerig.rig.target import Target
from telerig.rig.triangulation import triangulate

Array = NDArray[np.float64]

RUNGS: dict[str, tuple[str, ...]] = {
    "none": (),
    "k1": ("k1",),
    "k1+k2": ("k1", "k2"),
    "Brown": ("k1", "k2", "p"),
    "thin prism": ("k1", "k2", "p", "s"),
    "kappa": ("kappa",),
    "tilt": ("tilt",),
    "aspect+skew": ("affine",),
}
PARTS: dict[str, tuple[tuple[str, ...], ...]] = {
    "k1": (("k1",),), "k2": (("k2",),), "p": (("p1", "p2"),), "s": (("s1", "s3"),),
    "kappa": (("kappa_per_mm",),), "affine": (("aspect", "skew"),),
    "tilt": (("image_convergence_per_mm",),),
}  # fmt: skip
BIG = {
    "k1": 2e-2, "k2": 2e-2, "p1": 3e-3, "s1": 3e-3, "kappa_per_mm": 5e-3, "aspect": 1e-2,
    "image_convergence_per_mm": 1 / 300,
}  # fmt: skip
"""kappa is times rho. Half the image diagonal is 1: k1 of 0.02 is 7 px in the corner."""
TILT = (0.05, 0.2)
DETECTABLE = 3.0
VOLUME_MM = 15.0


@dataclass(frozen=True)
class Outcome:
    chosen: tuple[frozenset[str], ...]
    truth: tuple[frozenset[str], ...]
    ratio: float
    seconds: float
    size: str

    @property
    def right(self) -> bool:
        return self.chosen == self.truth

    @property
    def over(self) -> bool:
        return any(_parts(c) - _parts(t) for c, t in zip(self.chosen, self.truth))

    @property
    def under(self) -> bool:
        return any(_parts(t) - _parts(c) for c, t in zip(self.chosen, self.truth))


def _parts(groups: frozenset[str]) -> frozenset[str]:
    """A tilt is a stretch and something more."""
    return groups | {"affine"} if "tilt" in groups else groups


def drawn_config(rng: np.random.Generator) -> SimulationConfig:
    """Target, views and angle; ideal lenses."""
    rows, columns = int(rng.integers(3, 10)), int(rng.integers(5, 12))
    width, height = rng.uniform(22, 30), rng.uniform(14, 26)
    pitch = (width / (columns - 1), height / (rows - 1))
    target = Target(
        rows=rows, columns=columns, pitch_mm=pitch, dot_diameter_mm=0.35 * min(pitch),
        marks=((1, 2), (1, 3), (0, 2)), mark_diameter_mm=0.5 * min(pitch),
        scale_dots=(0, rows * columns - 1),
    )  # fmt: skip
    angle = float(rng.uniform(50, 100))
    cameras = tuple(CameraConfig(n, (512, 512), rng.uniform(9.8, 10.2), 10.0)
                    for n in ("left", "right"))  # fmt: skip
    return SimulationConfig(
        "ladder", cameras, target, views=int(rng.integers(10, 25)), angle_deg=angle,
        tilt_deg=(max(10.0, angle / 2 - 20), min(75.0, angle / 2 + 20)), border_px=3.0,
        visible_fraction=0.8, marks_visible=False, sigma_px=float(rng.uniform(0.005, 0.02)),
    )  # fmt: skip


def drawn_groups(rung: str, rng: np.random.Generator) -> frozenset[str]:
    groups = set(RUNGS[rung])
    if rung in ("kappa", "tilt", "aspect+skew") and rng.random() < 0.5:
        groups.add("k1")
    return frozenset(groups)


def drawn_scene(
    rungs: tuple[str, str], weak: bool, rng: np.random.Generator
) -> tuple[Scene, tuple[frozenset[str], ...]]:
    """A rig, its views, the dots; and what is free of each camera in the right model."""
    config = drawn_config(rng)
    groups = [drawn_groups(rung, rng) for rung in rungs]
    tilts = [_tilt(rng) if "tilt" in g else {} for g in groups]
    ideal = make_scene(_with(config, tilts), rng)
    problem = replace(ideal.problem().with_model([name_of(g) for g in groups]), solver="numpy")
    truth = replace(ideal.true_state(problem), dots_mm=problem.nominal_mm)
    gaussian = System(problem).gaussian(truth)
    sds = iter(np.sqrt(np.diag(gaussian.marginal(np.arange(gaussian.rig)))))
    sd = [{p: float(next(sds)) for p in free} for free in problem.free]
    lenses, right = [], []
    for c, g in enumerate(groups):
        bilateral = "tilt" in g and rng.random() < 0.5
        drawn = {
            name: value
            for group in sorted(g) if not (group == "tilt" and bilateral)
            for pair in PARTS[group]
            for name, value in _sizes(pair, sd[c], problem.cameras[c].rho_mm, weak, rng).items()
        }  # fmt: skip
        lenses.append(tilts[c] | drawn)
        right.append(frozenset({"affine"} | g - {"tilt"}) if bilateral else g)
    return make_scene(_with(config, lenses), rng, views=ideal.views), tuple(right)


def _tilt(rng: np.random.Generator) -> dict[str, float]:
    size, angle = rng.uniform(*TILT), rng.uniform(0, 2 * np.pi)
    return {"tilt_x": size * np.cos(angle), "tilt_y": size * np.sin(angle)}


def _sizes(
    pair: tuple[str, ...],
    sd: dict[str, float],
    rho_mm: float,
    weak: bool,
    rng: np.random.Generator,
) -> dict[str, float]:
    detectable = DETECTABLE * max(sd[p] for p in pair)
    big = BIG[pair[0]] / (rho_mm if pair[0] == "kappa_per_mm" else 1.0)
    least, most = (detectable, 3 * detectable) if weak else (3 * detectable, big)
    size = float(np.exp(rng.uniform(np.log(least), np.log(max(most, least)))))
    if len(pair) == 1:
        positive = pair[0] == "image_convergence_per_mm" or rng.random() < 0.5
        return {pair[0]: size if positive else -size}
    angle = rng.uniform(0, 2 * np.pi)
    values = {pair[0]: size * np.cos(angle), pair[1]: size * np.sin(angle)}
    return {p: v + (1.0 if p == "aspect" else 0.0) for p, v in values.items()}


def _with(config: SimulationConfig, lenses: list[dict[str, float]]) -> SimulationConfig:
    cameras = tuple(replace(c, parameters=p) for c, p in zip(config.cameras, lenses))
    return replace(config, cameras=cameras)


def space_mm(scene: Scene, problem: Problem, state: State, points: Array) -> float:
    pixels = [camera.project(points) for camera in scene.cameras.values()]
    first, second = cameras_from_state(problem, state)
    found = triangulate((first, second), (pixels[0], pixels[1]), 0.01).points_mm
    return float(np.sqrt(((aligned(found, points) - points) ** 2).sum(-1).mean()))


def outcome(rungs: tuple[str, str], weak: bool, rng: np.random.Generator) -> Outcome:
    scene, truth = drawn_scene(rungs, weak, rng)
    problem = replace(scene.problem(), solver="numpy")
    start = held_at_nominal(problem, scene.true_state(problem))
    begun = time.process_time()
    robust, choice = choose_model(problem, start, ("auto", "auto"))
    seconds = time.process_time() - begun
    points = rng.uniform(-VOLUME_MM, VOLUME_MM, (200, 3))
    errors = []
    for lenses in (choice.lenses, truth):
        model = robust.problem.with_model([name_of(lens) for lens in lenses])
        fitted = solve(model, model_start(model, robust.solution.state), relative=1e-8)
        errors.append(space_mm(scene, problem, fitted.state, points))
    size = f"{len(problem.views)} views, {len(problem.dot_ids)} dots"
    return Outcome(choice.lenses, truth, errors[0] / errors[1], seconds, size)


def drawn_rungs(rung: str, rng: np.random.Generator) -> tuple[str, str]:
    if rung != "mixed":
        return rung, rung
    first, second = rng.choice(list(RUNGS), 2, replace=False)
    return str(first), str(second)


def row(rung: str, outcomes: list[Outcome]) -> str:
    count = len(outcomes)
    ratio = np.array([o.ratio for o in outcomes])
    return (
        f"| {rung} | {sum(o.right for o in outcomes) / count:.0%} "
        f"| {sum(o.over for o in outcomes) / count:.0%} "
        f"| {sum(o.under for o in outcomes) / count:.0%} "
        f"| {np.percentile(ratio, 95):.3f} | {ratio.max():.3f} "
        f"| {sum(o.over and o.ratio > 1.05 for o in outcomes)} "
        f"| {np.median([o.seconds for o in outcomes]):.2f} |"
    )


HEAD = [
    "| rung | right | over | under | space, 95 % | space, worst | over and worse than 5 % "
    "| s (median) |",
    "|---|---|---|---|---|---|---|---|",
]


def table(rungs: list[str], seeds: range, weak: bool, verbose: bool) -> list[str]:
    lines = []
    for rung in rungs:
        outcomes = []
        for seed in seeds:
            rng = np.random.default_rng([seed, [*RUNGS, "mixed"].index(rung), int(weak)])
            found = outcome(drawn_rungs(rung, rng), weak, rng)
            outcomes.append(found)
            if verbose and not (found.right and found.ratio < 1.05):
                names = [[name_of(g) for g in lens] for lens in (found.truth, found.chosen)]
                print(f"  seed {seed}: {found.size}, {names[0]} -> {names[1]}, {found.ratio:.3f}")
        lines.append(row(rung, outcomes))
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--weak-seeds", type=int, default=15)
    parser.add_argument("--rungs", default=",".join([*RUNGS, "mixed"]))
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    begun, first, rungs = time.perf_counter(), options.first, options.rungs.split(",")
    lines = ["# The ladder of lens models", "", *(__doc__ or "").strip().splitlines()[4:]]
    for weak, count in ((False, options.seeds), (True, options.weak_seeds)):
        if count == 0:
            continue
        title = "near the limit" if weak else "three times detectable and more"
        heading = ["", f"## Sizes {title}: seeds {first} to {first + count - 1}", "", *HEAD]
        print("\n".join(heading))
        seeds = range(first, first + count)
        lines += heading + table(rungs, seeds, weak, options.verbose)
    lines += ["", f"{(time.perf_counter() - begun) / 60:.0f} minutes on one core.", ""]
    if options.out:
        options.out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
