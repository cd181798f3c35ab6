"""How good is the acceleration of bubbles, is its standard deviation true, and what is simpler?

Usage: python benchmarks/acceleration.py [--seeds 10] [--noise 0.1,0.5,1.5] [--bubbles KIND,...]
       [--information marks,arms,images] [--out FILE.md] [--csv FILE.csv] [--read FILE.csv ...]
`telerig.smooth` of five bubbles at 500 Hz over 1.5 s under a shake of 0.2 mm at 20 Hz. The bubbles
are made here, with the truth of their acceleration. Simpler estimates differentiate a path: with
the rig known (the same pixel noise and no shake, so that noise alone is in their way), and the
smoothed path. Their widths and tolerances are those that are best for the truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.random import Generator
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_cases import SCENARIOS, WANDER, ZIGZAG
from shake_scene import LATERAL, RISE_MM_S, UP, Case, H, Run, simulate

from telerig.estimator.smoothing.smooth import smooth
from telerig.io.simulation.run.motion import constant_speed_path, square_root

Array = NDArray[np.float64]
KINDS = {
    "random, 3 ms": 0.003, "random, 10 ms": 0.01, "zigzag": 0.01
}  # fmt: skip
WINDOWS = (5, 9, 15, 21, 31, 41, 61, 81, 121)
TOLERANCES = np.geomspace(0.3, 3.0, 9)


def random_motion(
    wander: tuple[float, float], swing: tuple[float, float, float] | None, low_pass_s: float,
    t: Array, paths: int, rng: Generator,
) -> Array:  # fmt: skip
    """(3, paths, N): position, velocity and acceleration of wander and swing after a low-pass.

    States: filtered position, filtered velocity, wander's velocity, swing and its velocity. The
    covariance of a step is an integral over the impulse response, by Gauss-Legendre.
    """
    from scipy.linalg import expm, solve_continuous_lyapunov

    (sigma, tau), (reach, hz, damping) = wander, swing or (0.0, 1.0, 1.0)
    w = 2 * np.pi * hz
    drift, noise = np.zeros((5, 5)), np.zeros((5, 2))
    drift[0, 1] = drift[3, 4] = 1.0
    drift[1, 1:] = np.array([-1.0, 1.0, 0.0, 1.0]) / low_pass_s
    drift[2, 2], drift[4, 3:] = -1 / tau, (-(w**2), -2 * damping * w)
    noise[2, 0], noise[4, 1] = sigma * np.sqrt(2 / tau), 2 * reach * np.sqrt(damping * w**3)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    gains = [expm(drift * H * (x + 1) / 2) @ noise for x in nodes]
    step = sum(g @ g.T * weight * H / 2 for g, weight in zip(gains, weights))
    start = np.zeros((5, 5))
    start[1:, 1:] = solve_continuous_lyapunov(drift[1:, 1:], -noise[1:] @ noise[1:].T)
    transition, root = expm(drift * H), square_root(step)
    states = np.empty((len(t), paths, 5))
    states[0] = rng.standard_normal((paths, 5)) @ square_root(start).T
    for i, kick in enumerate(rng.standard_normal((len(t) - 1, paths, 5)) @ root.T):
        states[i + 1] = states[i] @ transition.T + kick
    whole = np.stack([states[..., 0], states[..., 1], states @ drift[1]])
    return np.asarray(whole.swapaxes(1, 2))


def moving(kind: str, t: Array, rng: Generator) -> tuple[Array, Array, Array]:
    """Positions, velocities and accelerations (5, N, 3) of five bubbles in the lab."""
    low_pass = KINDS[kind]
    if kind != "zigzag":
        up = random_motion(WANDER, ZIGZAG, low_pass, t, 5, rng)
        across = random_motion(WANDER, LATERAL, low_pass, t, 10, rng).reshape(3, 2, 5, len(t))
        up[0] += RISE_MM_S * t
        up[1] += RISE_MM_S
    else:
        drawn = random_motion((3.0, 0.3), None, low_pass, t, 15, rng).reshape(3, 3, 5, len(t))
        paths = []
        for _ in range(5):
            hz, reach = rng.uniform(5, 8), rng.uniform(2, 5)
            turns = {k: rng.uniform(0, 2 * np.pi) for k in ("azimuth_rad", "phase_rad")}
            paths.append(constant_speed_path(t, RISE_MM_S, hz, (reach, 0.0), **turns))
        height = np.stack([[p.height_mm, p.height_mm_s] for p in paths], 1)
        lateral = np.stack([[p.lateral_mm, p.lateral_mm_s] for p in paths], 1)
        # the paths are smooth: differences of the exact velocity over 1 ms are good to 1e-4
        up = np.concatenate([height, np.gradient(height[1:], H, axis=-1)]) + drawn[:, 0]
        lateral = np.concatenate([lateral, np.gradient(lateral[1:], H, axis=2)])
        across = np.moveaxis(lateral, -1, 1) + drawn[:, 1:]
    whole = np.stack([across[:, 0], up * UP[1], across[:, 1]], -1)
    return whole[0] + rng.uniform(-5, 5, (5, 1, 3)), whole[1], whole[2]


def central(t: Array, path: Array, _width: float) -> Array:
    """Second differences over one frame on either side."""
    return np.asarray(np.gradient(np.gradient(path, t, axis=0), t, axis=0))


def savitzky_golay(t: Array, path: Array, width: float) -> Array:
    from scipy.signal import savgol_filter

    return np.asarray(savgol_filter(path, int(width), 3, deriv=2, delta=t[1] - t[0], axis=0))


def spline(sigma_mm: float) -> Callable[[Array, Array, float], Array]:
    def fitted(t: Array, path: Array, tolerance: float) -> Array:
        """Quintic smoothing B-splines whose residuals are ``tolerance`` times the noise."""
        from scipy.interpolate import splev, splrep

        weight = np.full(len(t), 1 / sigma_mm)
        each = [splrep(t, x, weight, k=5, s=tolerance**2 * len(t)) for x in path.T]
        return np.stack([splev(t, one, der=2) for one in each], -1)

    return fitted


def middle(frames: int) -> slice:
    return slice(frames // 10, frames - frames // 10)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def measured(kind: str, noise_px: float, information: str, seed: int) -> list[dict[str, Any]]:
    """One row for each method; the best of each width or tolerance is chosen over all seeds."""
    rng = np.random.default_rng([seed, sorted(KINDS).index(kind), round(1000 * noise_px)])
    scenario = replace(SCENARIOS["S2"], noise_px=noise_px)
    kept: list[Array] = []

    def bubbles(t: Array) -> tuple[Array, Array]:
        place, velocity, acceleration = moving(kind, t, rng)
        kept.append(acceleration)
        return place, velocity

    run: Run = simulate(Case(scenario), rng, bubbles=bubbles)
    truth = kept[0][:, :: round(1 / (H * scenario.rate_hz))]
    begun = time.process_time()
    given = run.inputs("five")
    if information == "marks":
        given["references"] = run.references
    elif information == "arms":
        given["accelerometers"] = run.inputs("arms")["accelerometers"]
    found = smooth(**given)
    seconds = time.process_time() - begun
    inside = middle(scenario.frames)
    table = found.trajectories.sort_values(["particle", "frame"])
    shape = truth.shape

    def of(pattern: str) -> Array:
        return table[[pattern.format(a) for a in "xyz"]].to_numpy().reshape(shape)

    off, sd = of("a{}_mm_s2") - truth, of("sa{}_mm_s2")
    ratio = (off[:, inside] / sd[:, inside]) ** 2
    common = {"bubbles": kind, "noise_px": noise_px, "information": information, "seed": seed}
    bands = found.summary["acceleration_bandwidth_hz"]
    times = list(found.summary["inertia_by_axis_s"].values())
    rows = [
        {"method": "telerig", "width": 0.0, "error": rms(off[:, inside]), "sd": rms(sd[:, inside]),
         "nees": float(ratio.mean()), **{f"nees_{a}": float(ratio[..., i].mean())
                                         for i, a in enumerate("xyz")},
         "truth": rms(truth), "inertia_ms": 1e3 * float(np.median(times)),
         "band_hz": float(np.mean(list(bands.values()))), "seconds": seconds,
         "verdict": found.verdict["verdict"]}
    ]  # fmt: skip
    calm = run.oracle.sort_values(["particle", "frame"])[["x_mm", "y_mm", "z_mm"]]
    seen = calm.to_numpy().reshape(shape) + run.stage["position_mm"].to_numpy()[:, None] * UP
    paths = {"rig known": seen, "smoothed path": of("{}_mm")}
    for source, path in paths.items():
        sigma = noise_px * 0.1 if source == "rig known" else rms(of("s{}_mm"))
        for name, method, widths in (
            ("central differences", central, (0.0,)),
            ("Savitzky-Golay", savitzky_golay, WINDOWS),
            ("B-spline", spline(sigma), TOLERANCES if source == "rig known" else ()),
        ):
            for width in widths:
                each = [method(run.t_s, one, width) for one in path]
                error = rms((np.stack(each) - truth)[:, inside])
                rows.append({"method": f"{name}, {source}", "width": width, "error": error})
    return [common | row for row in rows]


def report(table: pd.DataFrame) -> list[str]:
    """One line for each kind of bubbles, noise and information."""
    methods = [m for m in table["method"].unique() if m != "telerig"]
    lines = [
        "| bubbles | px | information | seeds | RMS acceleration | telerig | stated sd | NEES "
        "| NEES x, y, z | low-pass, ms | band, Hz | verdicts | " + " | ".join(methods) + " |",
        "|---" * (12 + len(methods)) + "|",
    ]
    for key, mine in table.groupby(["bubbles", "noise_px", "information"], sort=False):
        ours = mine[mine["method"] == "telerig"]
        nees, error = ours["nees"], ours["nees"].std(ddof=1) / np.sqrt(len(ours))
        cells = [
            str(key[0]), f"{key[1]:g}", str(key[2]), str(len(ours)), f"{rms(ours['truth']):.0f}",
            f"**{rms(ours['error']):.0f}**", f"{rms(ours['sd']):.0f}",
            f"{nees.mean():.2f} ± {error:.2f}",
            ", ".join(f"{ours[f'nees_{a}'].mean():.2f}" for a in "xyz"),
            f"{ours['inertia_ms'].median():.1f}", f"{ours['band_hz'].median():.0f}",
            ", ".join(f"{n} {v}" for v, n in ours["verdict"].value_counts().items()),
        ]  # fmt: skip
        for name in methods:
            of_width = mine[mine["method"] == name].groupby("width")["error"].apply(rms)
            cells.append(f"{of_width.min():.0f}")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main(arguments: Iterable[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--noise", default="0.1,0.5,1.5")
    parser.add_argument("--bubbles", default=";".join(KINDS))
    parser.add_argument("--information", default="marks")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--read", type=Path, nargs="*", default=[])
    given = parser.parse_args(None if arguments is None else list(arguments))
    parts = [pd.read_csv(path) for path in given.read]
    rows: list[dict[str, Any]] = []
    for kind in given.bubbles.split(";"):
        for noise in map(float, given.noise.split(",")):
            for information in given.information.split(","):
                for seed in range(0 if given.read else given.seeds):
                    rows += measured(kind, noise, information, seed)
                    first = rows[-1] | next(r for r in reversed(rows) if r["method"] == "telerig")
                    print({k: first[k] for k in ("bubbles", "noise_px", "seed", "error", "nees",
                                                 "inertia_ms", "seconds")}, flush=True)  # fmt: skip
                    if given.csv:
                        pd.DataFrame(rows).to_csv(given.csv, index=False)
    text = "\n".join(report(pd.concat([*parts, pd.DataFrame(rows)])))
    print(text)
    if given.out:
        given.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
