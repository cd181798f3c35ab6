"""Solvers of one and the same calibration, from a dozen images to four hundred of 2,000 dots.

Usage: python benchmarks/solvers.py [--sizes 12x15,...] [--solvers numpy,...] [--limit 90]
                                    [--out benchmarks/results/solvers.md]

Views x 2 cameras x dots, every dot in every image; model kappa+tangential, dots in 3-D with the
print's tolerance, one known distance; closed-form start. Each run in a process of its own on one
core: CPU seconds from the start to the minimum (the best of several for short ones, without
imports, compilation and the making of the problem), iterations, and the peak memory of the whole
process, Python and its libraries included. A figure counts when its cost is the least of all to
1e-9; every cost is evaluated by the same function.

gtsam: the dots of the product's Gaussian eliminated by GTSAM, as up to 5,000 measured dots. numpy:
by NumPy, as above. scipy: `least_squares`, trf with
lsmr (inner tolerance 1e-10), sparse analytic Jacobian from the product's own array functions,
its pattern made once. ceres: pyceres, DENSE_SCHUR, one Python cost per measured dot. wrapped: the
product's functions as one `gtsam.CustomFactor` an image and one key a dot, GTSAM's own optimizer.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from solver_problem import make_problem

from telerig.estimator.calibration.solver.nonlinear_graph import nonlinear_graph
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.solver.system import System
from telerig.factors.calibration import State

SIZES = ("12x15", "12x100", "50x400", "200x400", "200x2000")
SOLVERS = ("gtsam", "numpy", "scipy", "ceres", "wrapped")
SHORT_S = 2.0
"""Runs shorter than this are repeated."""
Solve = Callable[[Problem, State], tuple[State, int]]


def solver(name: str) -> Solve:
    """A solver by name, imported."""
    if name in ("gtsam", "numpy"):
        return partial(product, name)
    if name == "wrapped":
        return wrapped
    return import_module(f"solver_{name}").solve  # type: ignore[no-any-return]


def product(name: str, problem: Problem, start: State) -> tuple[State, int]:
    found = solve(replace(problem, solver=name), start)
    return found.state, found.iterations


def wrapped(problem: Problem, start: State) -> tuple[State, int]:
    """GTSAM's Levenberg-Marquardt over the product's functions as factors."""
    import gtsam

    graph, values, keys = nonlinear_graph(problem, start)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-11)
    params.setAbsoluteErrorTol(0.0)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    found = optimizer.optimize()
    intrinsics = start.intrinsics.copy()
    for c, (free, unit) in enumerate(zip(keys.free, keys.unit)):
        intrinsics[c, free] += unit * found.atVector(keys.intrinsics[c])
    cameras = np.array([np.eye(4), *(found.atPose3(k).matrix() for k in keys.camera[1:])])
    views = np.array([found.atPose3(k).matrix() for k in keys.view])
    dots = np.array([found.atVector(k) for k in keys.dots])
    return State(intrinsics, cameras, views, dots), int(optimizer.iterations())


def one(name: str, size: str) -> dict[str, Any]:
    """A run in this process."""
    views, dots = (int(n) for n in size.split("x"))
    problem, start = make_problem(views, dots, np.random.default_rng(0))
    run = solver(name)
    best, spent = np.inf, 0.0
    state, iterations = start, 0
    while spent == 0 or (best < SHORT_S and spent < 3 * SHORT_S):
        began = time.process_time()
        state, iterations = run(problem, start)
        took = time.process_time() - began
        best, spent = min(best, took), spent + took
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    cost = System(problem).gaussian(state).cost
    return {"seconds": best, "iterations": iterations, "cost": cost, "peak_mb": peak_mb}


def in_process(name: str, size: str, limit_s: float) -> dict[str, Any]:
    """The result of a run in a process of its own, or the limit that it went beyond."""
    environment = os.environ | dict.fromkeys(
        ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
    )
    command = [sys.executable, __file__, "--run", name, size]
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return {"beyond": limit_s}
    if done.returncode:
        words = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
        return {"error": words[-1]}
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def table(runs: dict[str, dict[str, Any]], names: list[str]) -> list[str]:
    """One line per size."""
    lines = ["| views x dots | " + " | ".join(names) + " |", "|---|" + "---|" * len(names)]
    for size, found in runs.items():
        least = min((r["cost"] for r in found.values() if "cost" in r), default=np.nan)
        cells = [cell(found.get(name), least) for name in names]
        lines.append(f"| {size} | {' | '.join(cells)} |")
    return lines


def cell(run: dict[str, Any] | None, least: float) -> str:
    if run is None:
        return "-"
    if "beyond" in run:
        return f"more than {run['beyond']:.0f} s"
    if "error" in run:
        return str(run["error"])
    text = f"{run['seconds']:.3g} s, {run['iterations']} it., {run['peak_mb']:.0f} MB"
    off = run["cost"] / least - 1
    return text if off < 1e-9 else f"does not count: cost {off:.1e} above the least ({text})"


def ratios(runs: dict[str, dict[str, Any]]) -> list[str]:
    """How many times faster the product is."""
    lines = [
        "| views x dots | scipy / gtsam | scipy / numpy | ceres / gtsam |",
        "|---|---|---|---|",
    ]
    for size, found in runs.items():
        cells = []
        for ours, other in (("gtsam", "scipy"), ("numpy", "scipy"), ("gtsam", "ceres")):
            seconds = [(found.get(n) or {}).get("seconds") for n in (ours, other)]
            cells.append(f"{seconds[1] / seconds[0]:.1f}" if all(seconds) else "-")
        lines.append(f"| {size} | {' | '.join(cells)} |")
    return lines


WORDS = """\
A limit is of wall time, on a machine shared with other work; "-" was not run. Where nothing but
the product finished, its cost has no independent witness.
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--solvers", default=",".join(SOLVERS))
    parser.add_argument("--limit", type=float, default=90.0, help="seconds a run may take")
    parser.add_argument("--records", type=Path, help="runs done before are kept here, as JSON")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--run", nargs=2, metavar=("SOLVER", "SIZE"), help="one run")
    options = parser.parse_args()
    if options.run:
        print(json.dumps(one(*options.run)))
        return
    names = options.solvers.split(",")
    kept = options.records is not None and options.records.is_file()
    runs: Any = json.loads(options.records.read_text(encoding="utf-8")) if kept else {}
    for size in options.sizes.split(","):
        of_size = runs.setdefault(size, {})
        for name in names:
            if name not in of_size:
                of_size[name] = in_process(name, size, options.limit)
                print(size, name, of_size[name], flush=True)
            if options.records:
                options.records.write_text(json.dumps(runs), encoding="utf-8")
    head = ["# Solvers of the calibration", "", *(__doc__ or "").strip().splitlines()[5:], ""]
    if options.out is None:
        print("\n".join(table(runs, names)))
        return
    lines = [*head, *table(runs, names), "", "How many times faster:", "", *ratios(runs), "", WORDS]
    text = "\n".join(lines)
    print(text)
    if options.out:
        options.out.write_text(text.rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
