"""Solvers of one and the same calibration, from a dozen images to four hundred of 2,000 dots.

Usage: python benchmarks/solvers.py [--sizes 12x15,...] [--solvers numpy,...] [--limit 600]
                                    [--out benchmarks/results/solvers.md]

Views x 2 cameras x dots, every dot in every image; model kappa+tangential, dots in 3-D with the
print's tolerance, one known distance; closed-form start. Each run in a process of its own on one
core: CPU seconds from the start to the minimum (the best of several for short ones, without
imports, compilation and the making of the problem), iterations, and the peak memory of the whole
process, Python and its libraries included. A figure counts when its cost is the least of all to
1e-9; every cost is evaluated by the same function.

numpy, numba: the product (`--solver schur`), without and with compiled loops. scipy:
`least_squares`, trf with lsmr (inner tolerance 1e-10: at 1e-6 it stops short of the minimum),
sparse analytic Jacobian from the product's own array functions. ceres: pyceres, DENSE_SCHUR, one
Python cost per measured dot. gtsam: one Python factor and one key per dot, its own optimizer.
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
from pathlib import Path
from typing import Any

import numpy as np
from solver_problem import make_problem

from telerig.estimator.calibration.solver import array_system, graph
from telerig.estimator.calibration.solver.array_system import ArraySystem
from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.projection import State

SIZES = ("12x15", "12x100", "50x400", "200x400", "200x2000")
GROWTH = ("50x100", "50x400", "50x2000", "12x400", "200x400")
SOLVERS = ("numpy", "numba", "scipy", "ceres", "gtsam")
SHORT_S = 2.0
"""Runs shorter than this are repeated."""
Solve = Callable[[Problem, State], tuple[State, int]]


def solver(name: str) -> Solve:
    """A solver by name, compiled and imported."""
    if name in ("numpy", "numba"):
        set_loops(name)
        return product
    if name == "scipy":
        import solver_scipy

        return solver_scipy.solve
    import solver_dotwise

    return solver_dotwise.ceres_solve if name == "ceres" else solver_dotwise.gtsam_solve


def set_loops(name: str) -> None:
    """The product with compiled loops or without; compiles them."""
    array_system.MANY = 0 if name == "numba" else sys.maxsize
    if name == "numba":
        if array_system.compiled_loops() is None:
            raise ImportError("numba is not installed")
        product(*make_problem(6, 12, np.random.default_rng(1)))


def product(problem: Problem, start: State) -> tuple[State, int]:
    from dataclasses import replace

    found = graph.solve(replace(problem, solver="schur"), start)
    return found.state, found.iterations


def one(name: str, size: str) -> dict[str, Any]:
    """A run in this process."""
    views, dots = (int(n) for n in size.split("x"))
    problem, start = make_problem(views, dots, np.random.default_rng(0))
    solve = solver(name)
    best, spent = np.inf, 0.0
    state, iterations = start, 0
    while spent == 0 or (best < SHORT_S and spent < 3 * SHORT_S):
        began = time.process_time()
        state, iterations = solve(problem, start)
        took = time.process_time() - began
        best, spent = min(best, took), spent + took
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    array_system.MANY = sys.maxsize
    cost = ArraySystem(problem, state).cost(state)
    return {"seconds": best, "iterations": iterations, "cost": cost, "peak_mb": peak_mb}


def growth(name: str, size: str) -> dict[str, Any]:
    """Nanoseconds per measured dot of one iteration's parts."""
    views, dots = (int(n) for n in size.split("x"))
    problem, start = make_problem(views, dots, np.random.default_rng(0))
    set_loops(name)
    system = ArraySystem(problem, start)
    equations = system.linearised(start)
    parts = {
        "images": lambda: system.linearised(start),
        "trial": lambda: system.cost(start),
        "step": lambda: equations.step(1e-6),
    }
    out = {}
    for part, work in parts.items():
        best, until = np.inf, time.process_time() + 0.6
        while time.process_time() < until:
            began = time.process_time()
            work()
            best = min(best, time.process_time() - began)
        out[part] = 1e9 * best / len(problem.view)
    return out


def in_process(kind: str, name: str, size: str, limit_s: float) -> dict[str, Any]:
    """The result of a run in a process of its own, or the limit that it went beyond."""
    environment = os.environ | dict.fromkeys(
        ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
    )
    command = [sys.executable, __file__, "--run", kind, name, size]
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return {"beyond": limit_s}
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[-1]}
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
    lines = ["| views x dots | numpy: scipy | numpy: ceres | numba: scipy |", "|---|---|---|---|"]
    for size, found in runs.items():
        cells = []
        for ours, other in (("numpy", "scipy"), ("numpy", "ceres"), ("numba", "scipy")):
            seconds = [(found.get(n) or {}).get("seconds") for n in (ours, other)]
            cells.append(f"{seconds[1] / seconds[0]:.1f}" if all(seconds) else "-")
        lines.append(f"| {size} | {' | '.join(cells)} |")
    return lines


def growth_table(limit_s: float) -> list[str]:
    lines = [
        "| views x dots | numpy: images | trial | step | sum | numba: images | trial | sum |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for size in GROWTH:
        plain, loops = (in_process("growth", n, size, limit_s) for n in ("numpy", "numba"))
        if "step" not in plain:
            continue
        cells = [plain["images"], plain["trial"], plain["step"], sum(plain.values())]
        if "step" in loops:
            cells += [loops["images"], loops["trial"], sum(loops.values())]
        lines.append(f"| {size} | " + " | ".join(f"{c:.0f}" for c in cells) + " |")
        print(lines[-1], flush=True)
    return lines


WORDS = """\
Per iteration, measured dot and CPU core, in nanoseconds ("images": all derivatives and sums;
"trial": the cost of a tried step; "step": the damped solution):

{growth}

At 50 views and 100, 400 and 2,000 dots the sums are alike: the largest over the smallest is
1.09 with numpy, 1.14 to 1.21 with numba (three rounds, the sizes in turn). Before, 50x100 took
937 (numba 784) beside 537 (450) of 50x400: its third chunk was half as large as the others, so
that work arrays changed their shape and were allocated anew, and what glibc gives back to the
system it takes again as fresh pages at 5 us each, up to 600 an iteration. Now chunks are of one
size, arrays keep their memory whatever their shape, and the library is told to keep what is
freed (`rig/memory.py: keep_freed_memory`). What is left at 100 dots is the step: one
factorisation is shared by fewer dots (37 ns a measured dot at 100, 10 at 400), and so are the
triangular solves (20 and 10).

The images' share does not grow with the views. The step does while the dots are many: each dot
adds an outer product to one half of the matrix of all V views, (6 V)^2 x 3 / 2 / (2 V) = 27 V
multiply-adds a measured dot, at some 17 a nanosecond in the BLAS (79 ns at 50 views, 318 at
200), and the one factorisation, (6 V)^3 / 6, is shared by all of them (107 ns at 200x400): 425
of the 435. Where dots are fewer than twice the views, the views are eliminated instead; where
each view sees a part of the dots, the outer products are of the views that do.

A limit is of wall time, on a machine shared with other work; "-" was not run. Where nothing but
the product finished, its cost has no independent witness.
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--solvers", default=",".join(SOLVERS))
    parser.add_argument("--limit", type=float, default=600.0, help="seconds a run may take")
    parser.add_argument("--records", type=Path, help="runs done before are kept here, as JSON")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--run", nargs=3, metavar=("KIND", "SOLVER", "SIZE"), help="one run")
    options = parser.parse_args()
    if options.run:
        kind, name, size = options.run
        print(json.dumps((growth if kind == "growth" else one)(name, size)))
        return
    names = options.solvers.split(",")
    kept = options.records is not None and options.records.is_file()
    runs: Any = json.loads(options.records.read_text(encoding="utf-8")) if kept else {}
    for size in options.sizes.split(","):
        of_size = runs.setdefault(size, {})
        for name in names:
            if name not in of_size:
                of_size[name] = in_process("one", name, size, options.limit)
                print(size, name, of_size[name], flush=True)
            if options.records:
                options.records.write_text(json.dumps(runs), encoding="utf-8")
    head = ["# Solvers of the calibration", "", *(__doc__ or "").strip().splitlines()[5:], ""]
    if options.out is None:
        print("\n".join(table(runs, names)))
        return
    grown = WORDS.format(growth="\n".join(growth_table(options.limit)))
    lines = [*head, *table(runs, names), "", "How many times faster:", "", *ratios(runs), "", grown]
    text = "\n".join(lines)
    print(text)
    if options.out:
        options.out.write_text(text.rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
