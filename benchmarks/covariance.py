"""Is the reported covariance of a self-calibration the true one? Monte-Carlo over many datasets.

Usage: python benchmarks/covariance.py [--sets 5] [--seeds 40] [--only NAME] [--out FILE.md]

Several sets of hand-held poses; for every dataset target (from its print tolerances), known
distance and image noise are drawn anew, as the estimator assumes. Errors are against the truth in
the same gauge; "reported / observed" is 1 / RMS(error / reported sd), its interval that of
chi-square at 99.9 %. Left out are the two components of the baseline that the gauge holds.
The last column is the same with a
control variate: the errors of one linear step from the truth, whose covariance is known, are taken
from the same noise, which takes most of the chance out.
"Pooled" is the same over all quantities of a case together, its error from the scatter of the
datasets. "NEES" is the normalised error squared of the rig block (1 expected; +- one standard
error). The 3-D map: 125 points in a cube of 30 mm, triangulated from their true pixels, after the
rotation and shift that fit best, each with the RMS of its predicted sd over that of its error.
`Calibration.triangulate` from noisy pixels is judged in the rig's own frame. The Cramer-Rao bound
is that of the true rig.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from calibration_scene import Scene, make_scene
from numpy.typing import NDArray
from rig_truth import (
    aligned,
    bound_um,
    in_gauge,
    linear_deviations,
    point_jacobian,
    rig_errors,
    volume,
    without_advice,
    without_motion,
)
from scipy.stats import chi2

from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.io.simulation.config import SimulationConfig
from telerig.io.simulation.presets import preset
from telerig.rig.camera import Camera
from telerig.rig.triangulation import triangulate

Array = NDArray[np.float64]

GAUGE = ("tx_mm", "tz_mm")
"""Components of the second camera's pose that mostly hold the gauge."""
CHANCE = 1e-3


@dataclass(frozen=True)
class Case:
    """A preset and the model that it is fitted with; ``right`` when the model can describe it."""

    name: str
    config: SimulationConfig
    model: str
    right: bool = True


def cases() -> list[Case]:
    """The last is fitted with too simple a model, to show what that costs."""
    affine = _centred(preset("paper"), {"aspect": 1.004, "skew": 0.002})
    return [
        Case("paper, lenses centred", _centred(preset("paper")), "radial"),
        Case("near_telecentric, centred", _centred(preset("near_telecentric")), "kappa+radial"),
        Case("paper as it is", preset("paper"), "tangential"),
        Case("paper, centred, aspect and skew", affine, "affine+radial"),
        Case("scheimpflug, centred", _centred(preset("scheimpflug")), "tilt+radial"),
        Case("paper at 0.05 px, 7 views", preset("paper", sigma_px=0.05, views=7), "tangential"),
        Case("paper as it is", preset("paper"), "radial", right=False),
    ]


def _centred(
    config: SimulationConfig, parameters: dict[str, float] | None = None
) -> SimulationConfig:
    cameras = tuple(
        replace(c, centre_offset_px=(0.0, 0.0), parameters={**c.parameters, **(parameters or {})})
        for c in config.cameras
    )
    return replace(config, cameras=cameras)


@dataclass
class Samples:
    """One row a dataset. names : of the quantities, the gauge left out."""

    names: tuple[str, ...] = ()
    errors: list[Array] = field(default_factory=list)
    sds: list[Array] = field(default_factory=list)
    linear: list[Array] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    chi2: list[float] = field(default_factory=list)
    floors: list[float] = field(default_factory=list)
    bound_um: list[float] = field(default_factory=list)
    point_um2: list[Array] = field(default_factory=list)
    point_sd2: list[Array] = field(default_factory=list)
    inside: list[Array] = field(default_factory=list)
    point_nees: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def run(case: Case, number: int, sets: int, seeds: int) -> Samples:
    """number : of the case; no two cases share their chance."""
    samples = Samples()
    for poses in range(sets):
        first = make_scene(case.config, np.random.default_rng([number, poses, 10**6]))
        bound, shift = bound_um(first, case.config, case.model), None
        for seed in range(seeds):
            rng = np.random.default_rng([number, poses, seed])
            scene = make_scene(case.config, rng, views=first.views)
            began = time.process_time()
            with without_advice():
                calibration = self_calibrate(
                    scene.dots, scene.nominal, scene.target, model=case.model,
                    nominal_rotvec_deg=scene.nominal_rotvec_deg,
                )  # fmt: skip
            samples.seconds.append(time.process_time() - began)
            samples.bound_um.append(bound)
            shift = _map_jacobian(calibration) if shift is None else shift
            _record(samples, calibration, scene, case, rng, shift)
    return samples


def _map_jacobian(calibration: Calibration) -> Array:
    """(375, P) of the points' errors, common motion set aside; alike in all datasets of a set."""
    sd = np.sqrt(np.diag(calibration.covariance))
    jacobian = point_jacobian(calibration.cameras, calibration.covariance_names, sd, volume())
    return np.asarray(without_motion(volume()) @ jacobian)


def _record(
    samples: Samples,
    calibration: Calibration,
    scene: Scene,
    case: Case,
    rng: np.random.Generator,
    shift_mm: Array,
) -> None:
    names, covariance = calibration.covariance_names, calibration.covariance
    truth, points = list(scene.cameras.values()), volume()
    gauged, shift = in_gauge(truth, case.model)
    seen = [i for i, n in enumerate(names) if not n.endswith(GAUGE)]
    error, sd = rig_errors(calibration, gauged), np.sqrt(np.diag(covariance))
    samples.names = tuple(names[i] for i in seen)
    samples.errors.append(error[seen])
    samples.sds.append(sd[seen])
    samples.linear.append(linear_deviations(scene, case.config, case.model)[seen])
    block = covariance[np.ix_(seen, seen)]
    samples.nees.append(float(error[seen] @ np.linalg.solve(block, error[seen]) / len(seen)))
    samples.chi2.append(float(calibration.statistics["chi2_dof"]))
    samples.floors.append(float(calibration.statistics["noise_floor_px"]))
    pixels = [c.project(points) for c in truth]
    _record_map(samples, calibration, pixels, points + shift, shift_mm)
    _record_points(samples, calibration, pixels, points + shift, case.config.sigma_px, rng)


def _record_map(
    samples: Samples, calibration: Calibration, pixels: list[Array], points: Array, shift_mm: Array
) -> None:
    pair: tuple[Camera, Camera] = (calibration.cameras[0], calibration.cameras[1])
    found = triangulate(pair, (pixels[0], pixels[1]), 1.0).points_mm
    off = aligned(found, points) - points
    variance = np.einsum("ij,ij->i", shift_mm @ calibration.covariance, shift_mm)
    samples.point_um2.append(1e6 * (off**2).mean(-1))
    samples.point_sd2.append(1e6 * variance.reshape(-1, 3).mean(-1))


def _record_points(
    samples: Samples,
    calibration: Calibration,
    pixels: list[Array],
    points: Array,
    noise_px: float,
    rng: np.random.Generator,
) -> None:
    noisy = [uv + noise_px * rng.standard_normal(uv.shape) for uv in pixels]
    measured = calibration.triangulate(*noisy, sigma_px=noise_px)
    off = measured.points_mm - points
    sds = np.sqrt(np.diagonal(measured.covariance_mm2, axis1=-2, axis2=-1))
    samples.inside.append(np.abs(off) / sds)
    solved = np.linalg.solve(measured.covariance_mm2, off[..., None])[..., 0]
    samples.point_nees.append(float((off * solved).sum(-1).mean() / 3))


@dataclass(frozen=True)
class Verdict:
    """One case in a line of the summary; ratios are reported over observed."""

    pooled: float
    pooled_error: float
    controlled: float
    controlled_error: float
    outside: tuple[str, ...]
    space: float
    space_error: float
    low: float
    high: float
    nees: float
    nees_error: float


def verdict(samples: Samples) -> Verdict:
    z2 = (np.array(samples.errors) / np.array(samples.sds)) ** 2
    count = len(z2)
    low, high = interval(count)
    ratios = 1 / np.sqrt(z2.mean(0))
    outside = tuple(n for n, r in zip(samples.names, ratios) if not low <= r <= high)
    each = z2.mean(1)
    pooled = 1 / np.sqrt(each.mean())
    beyond = (z2 - np.array(samples.linear) ** 2).mean(1)
    um2, sd2 = np.array(samples.point_um2), np.array(samples.point_sd2)
    map_ratio = np.sqrt(sd2.mean(0) / um2.mean(0))
    whole = um2.mean(1) / sd2.mean(1)
    return Verdict(
        pooled, 0.5 * pooled * each.std() / each.mean() / np.sqrt(count),
        1 / np.sqrt(1 + beyond.mean()), 0.5 * float(beyond.std() / np.sqrt(count)), outside,
        float(np.sqrt(sd2.mean() / um2.mean())),
        0.5 * float(whole.std() / whole.mean() / np.sqrt(count)),
        float(map_ratio.min()), float(map_ratio.max()),
        float(np.mean(samples.nees)), float(np.std(samples.nees) / np.sqrt(count)),
    )  # fmt: skip


def interval(count: int) -> tuple[float, float]:
    """Of reported over observed sd, for ``count`` datasets when the report is right."""
    low, high = chi2.ppf([CHANCE / 2, 1 - CHANCE / 2], count)
    return float(np.sqrt(count / high)), float(np.sqrt(count / low))


def table(case: Case, samples: Samples) -> list[str]:
    errors, sds = np.array(samples.errors), np.array(samples.sds)
    inside, count = np.array(samples.inside), len(errors)
    low, high = interval(count)
    lines = [
        f"## {case.name}: model {case.model}, {count} datasets",
        "",
        f"| quantity | reported sd | RMS error | reported / observed | in {low:.3f}..{high:.3f} | "
        "mean error / sd | 68 % | 95 % | control variate |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for i, name in enumerate(samples.names):
        z = errors[:, i] / sds[:, i]
        ratio = 1 / np.sqrt((z**2).mean())
        beyond = z**2 - np.array(samples.linear)[:, i] ** 2
        control = 1 / np.sqrt(1 + beyond.mean())
        lines.append(
            f"| {name} | {_rms(sds[:, i]):.3g} | {_rms(errors[:, i]):.3g} | {ratio:.3f} | "
            f"{'yes' if low <= ratio <= high else '**no**'} | {z.mean():+.2f} | "
            f"{np.mean(np.abs(z) < 1):.0%} | {np.mean(np.abs(z) < 1.96):.0%} | "
            f"{control:.3f} +- {0.5 * beyond.std() / np.sqrt(count):.3f} |"
        )
    v = verdict(samples)
    space = np.sqrt(np.array(samples.point_um2).mean(1))
    predicted, bound = np.sqrt(np.mean(samples.point_sd2)), np.array(samples.bound_um)
    return [
        *lines,
        "",
        f"- pooled, reported over observed: **{v.pooled:.3f} +- {v.pooled_error:.3f}**, with the "
        f"control variate {v.controlled:.3f} +- {v.controlled_error:.3f}; rig block "
        f"NEES {v.nees:.3f} +- {v.nees_error:.3f}.",
        f"- chi-square per degree of freedom: {np.mean(samples.chi2):.4f} +- "
        f"{np.std(samples.chi2) / np.sqrt(count):.4f}; a noise floor was found in "
        f"{np.count_nonzero(samples.floors)} datasets.",
        f"- 3-D map, reported over observed: {v.space:.3f} +- {v.space_error:.3f} over all points, "
        f"{v.low:.3f} to {v.high:.3f} point by point.",
        f"- 3-D error of the calibration: median {np.median(space):.3f} µm RMS per axis, RMS "
        f"{_rms(space):.3f}, predicted {predicted:.3f}, Cramer-Rao bound {_rms(bound):.3f}; "
        f"**median over bound {np.median(space / bound):.2f}**, RMS over bound "
        f"{_rms(space) / _rms(bound):.2f}.",
        f"- `Calibration.triangulate` from noisy pixels, in the rig's frame: within 1 sd "
        f"{np.mean(inside < 1):.1%} (68.3), within 1.96 sd {np.mean(inside < 1.96):.1%} (95), "
        f"NEES {np.mean(samples.point_nees):.3f}.",
        f"- {np.median(samples.seconds):.2f} s a calibration (one core).",
        "",
    ]  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def summary(found: list[tuple[Case, Samples]]) -> list[str]:
    lines = [
        "| case | model | pooled | control variate | outside 99.9 % | 3-D map | point by point | "
        "NEES |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case, samples in found:
        v = verdict(samples)
        lines.append(
            f"| {case.name} | {case.model}{'' if case.right else ' (too simple)'} | "
            f"{v.pooled:.3f} +- {v.pooled_error:.3f} | "
            f"{v.controlled:.3f} +- {v.controlled_error:.3f} | "
            f"{len(v.outside)} of {len(samples.names)} {', '.join(v.outside)} | "
            f"{v.space:.3f} +- {v.space_error:.3f} | {v.low:.3f} .. {v.high:.3f} | "
            f"{v.nees:.3f} +- {v.nees_error:.3f} |"
        )
    each = [
        ((np.array(s.errors) / np.array(s.sds)) ** 2).mean(1) for c, s in found if c.right
    ]  # fmt: skip
    if each:
        square = np.mean([e.mean() for e in each])
        error = np.sqrt(sum(e.var() / len(e) for e in each)) / len(each)
        pooled = 1 / np.sqrt(square)
        lines += [
            "",
            f"Pooled over the cases whose model is right: reported over observed **{pooled:.3f} +- "
            f"{0.5 * pooled * error / square:.3f}**.",
        ]
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=40, help="datasets of each set of poses")
    parser.add_argument("--only", default="", help="cases whose name and model contain this")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = []
    for number, case in enumerate(cases()):
        if options.only in f"{case.name}: model {case.model}":
            found.append((case, run(case, number, options.sets, options.seeds)))
            print("\n".join(table(*found[-1])), flush=True)
    words = (__doc__ or "").strip().splitlines()[4:]
    lines = ["# Reported against true covariance", "", *words, "", *summary(found)]
    print("\n".join(summary(found)))
    for case, samples in found:
        lines += table(case, samples)
    if options.out:
        options.out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
