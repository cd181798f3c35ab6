"""Sizes, shapes, forces and oscillations of simulated bubbles beside their truth.

    python benchmarks/bubble_physics.py [--seeds 10] [--first 10] [--bubbles 6] [--frames 250]
        [--images 60]

Bubbles of the preset "forces" obey an equation of motion with a known drag coefficient (Clift et
al. 1978), added mass and lift, in a shaking rig with an encoder, an accelerometer on each arm and
marks. Each run is calibrated, tracked (with given ids) and smoothed; bubbles.csv and
bubble_summary.csv are compared with the truth. A second table gives the same numbers for motion
that is the truth plus the stated errors, so that shape and forces are tested by themselves.

With --images a run of so many frames is rendered, its outlines are found in the images, and it is
smoothed.

For each number: root mean square error, median stated standard deviation, and NEES, the mean square
of error over stated standard deviation: 1 where the statements are right.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

import telerig
from telerig.arrays import Array
from telerig.estimator.physics.frames import frames_table
from telerig.estimator.physics.means import Lasting
from telerig.estimator.physics.summary import summary_table
from telerig.io.rig_file.fluid import liquid_of
from telerig.io.simulation.config import RunConfig
from telerig.io.simulation.images.bodies import surface_modes
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.run.motion import driven_paths
from telerig.io.simulation.run.scene import RunScene, run_scene
from telerig.rig.bubble_physics import Liquid

FRAME_NUMBERS = (
    "d_eq_mm", "aspect", "tilt_deg", "vx_mm_s", "vy_mm_s", "vz_mm_s", "ax_mm_s2", "ay_mm_s2",
    "az_mm_s2", "curvature_1_mm", "reynolds", "weber", "eotvos", "drag",
)  # fmt: skip
BUBBLE_NUMBERS = (
    "d_eq_mm", "aspect", "rise_mm_s", "slip_mm_s", "zigzag_hz", "zigzag_mm", "strouhal", "shape_hz",
    "reynolds", "weber", "eotvos", "drag",
)  # fmt: skip
UP = np.array([0.0, -1.0, 0.0])
_RESOLVED = {"tilt_deg", "curvature_1_mm"}
"""Numbers that cannot be negative: compared where they are more than 3 standard deviations."""


def sd_of(name: str) -> str:
    """The column of a number's standard deviation."""
    if name == "d_eq_mm":
        return "sd_eq_mm"
    motion = name[0] in "va" and name[1:2] in "xyz"
    return f"s{name}" if motion else f"s_{name}"


def true_table(config: RunConfig, seed: int) -> pd.DataFrame:
    """bubbles.csv without errors, of every bubble that exists."""
    scene_rng = np.random.default_rng(seed).spawn(6)[1]
    scene = run_scene(config, dict.fromkeys(("left", "right")), scene_rng)
    liquid = _liquid(config)
    bubbles = len(scene.population.d_eq_mm)
    moments = np.stack(
        [_second_moments(scene, f, np.arange(bubbles)) for f in range(config.frames)], 1
    )
    values, vectors = np.linalg.eigh(moments)
    aspect = np.sqrt(np.sqrt(values[..., 1] * values[..., 2]) / values[..., 0])
    tilt = np.degrees(np.arccos(np.clip(np.abs(vectors[..., :, 0] @ UP), 0, 1)))
    v, a = scene.lab_mm_s, scene.lab_mm_s2
    speed = np.linalg.norm(v, axis=-1)
    d = np.broadcast_to(scene.population.d_eq_mm[:, None], speed.shape)
    columns = {
        "frame": np.broadcast_to(np.arange(config.frames), speed.shape),
        "particle": np.broadcast_to(np.arange(bubbles)[:, None], speed.shape),
        "t_s": np.broadcast_to(scene.t_s, speed.shape),
        "d_eq_mm": d, "aspect": aspect, "tilt_deg": tilt,
        "curvature_1_mm": np.linalg.norm(np.cross(v, a), axis=-1) / speed**3,
        "slip_mm_s": speed,
        "reynolds": liquid.reynolds(1e-3 * d, 1e-3 * speed),
        "weber": liquid.weber(1e-3 * d, 1e-3 * speed),
        "eotvos": liquid.eotvos(1e-3 * d),
        "drag": 4 / 3 * scene.forces.drag_1_mm[:, None] * d,
        "shape_hz": np.broadcast_to(scene.population.swing_hz[:, [2]], speed.shape),
        "lift_hz": np.broadcast_to(scene.forces.lift_hz[:, None], speed.shape),
        "calm_mm": np.broadcast_to(_calm_zigzag_mm(scene)[:, None], speed.shape),
    }  # fmt: skip
    for i, x in enumerate("xyz"):
        columns |= {f"{x}_mm": scene.lab_mm[..., i], f"v{x}_mm_s": v[..., i]}
        columns |= {f"a{x}_mm_s2": a[..., i]}
        columns |= {f"pole_{x}": vectors[..., i, 0]}
    return pd.DataFrame({k: np.ravel(c) for k, c in columns.items()})


def _calm_zigzag_mm(scene: RunScene) -> Array:
    """(B,) amplitude of the zigzag that the swinging lift alone drives."""
    t = scene.t_s
    calm = replace(scene.forces, noise_mm_s2=0.0)
    path = driven_paths(float(t[1] - t[0]), len(t), calm, np.random.default_rng(0))
    out = []
    for hz, velocity in zip(calm.lift_hz, path.lateral_mm_s, strict=True):
        phase = 2 * np.pi * hz * t
        terms = np.stack([np.cos(phase), np.sin(phase), np.ones_like(t), t], -1)
        swing = np.linalg.lstsq(terms, velocity, rcond=None)[0][:2]
        out.append(np.linalg.svd(swing)[1][0] / (2 * np.pi * hz))
    return np.array(out)


def _liquid(config: RunConfig) -> Liquid:
    fluid = config.fluid
    return Liquid(
        fluid.density_kg_m3, fluid.viscosity_pa_s, fluid.surface_tension_n_m,
        config.stage.gravity_m_s2,
    )  # fmt: skip


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_AZIMUTH = 2 * np.pi * np.arange(48) / 48
_SPHERE = np.stack(
    [
        (np.sqrt(1 - _NODES[:, None] ** 2) * np.cos(_AZIMUTH)).ravel(),
        (np.sqrt(1 - _NODES[:, None] ** 2) * np.sin(_AZIMUTH)).ravel(),
        np.repeat(_NODES, 48),
    ],
    -1,
)
_SHARE = np.repeat(_WEIGHTS, 48) * np.pi / 24


def _second_moments(scene: RunScene, frame: int, chosen: Array) -> Array:
    """(B, 3, 3) second moments of the bodies' volumes about their centres, by quadrature."""
    bodies = scene.bodies_lab(frame, chosen)
    radius = 1 + bodies.modes @ surface_modes(_SPHERE).T
    volume = (_SHARE * radius**3).sum(-1) / 3
    centre = np.einsum("n,bn,ni->bi", _SHARE, radius**4, _SPHERE) / 4 / volume[:, None]
    second = np.einsum("n,bn,ni,nj->bij", _SHARE, radius**5, _SPHERE, _SPHERE) / 5
    second = second / volume[:, None, None] - centre[:, :, None] * centre[:, None, :]
    axes = bodies.rotation * bodies.semi_axes_mm[:, None, :]
    return axes @ second @ np.swapaxes(axes, -1, -2)


def true_summary(truth: pd.DataFrame) -> dict[str, float]:
    """What bubble_summary.csv should hold of one bubble, over the frames it was followed.

    Frequency and amplitude are those of the lift that drives the zigzag, without what wanders.
    """
    t = truth["t_s"].to_numpy()
    same = ("d_eq_mm", "aspect", "slip_mm_s", "eotvos", "reynolds", "weber", "drag", "shape_hz")
    out = {name: truth[name].mean() for name in same}
    # of the means, as the table has it
    out["weber"] *= out["slip_mm_s"] ** 2 / (truth["slip_mm_s"] ** 2).mean()
    out["rise_mm_s"] = -(truth["y_mm"].iloc[-1] - truth["y_mm"].iloc[0]) / (t[-1] - t[0])
    out["zigzag_hz"], out["zigzag_mm"] = truth[["lift_hz", "calm_mm"]].iloc[0]
    out["strouhal"] = out["zigzag_hz"] * out["d_eq_mm"] / out["slip_mm_s"]
    return out


def errors(
    frames: pd.DataFrame, summary: pd.DataFrame, truth: pd.DataFrame
) -> list[tuple[str, str, Array, Array, Array]]:
    """(table, number, errors, stated standard deviations, true values)."""
    both = frames.merge(truth, on=["frame", "particle"], suffixes=("", "_true"))
    out = []
    for name in FRAME_NUMBERS:
        true, found, sd = (both[n].to_numpy(float) for n in (f"{name}_true", name, sd_of(name)))
        good = np.isfinite(found) & np.isfinite(sd)
        if name in _RESOLVED:
            good &= found > 3 * sd
        out.append(("frame", name, (found - true)[good], sd[good], true[good]))
    seen = frames[["frame", "particle"]].merge(truth, on=["frame", "particle"])
    known = {k: true_summary(mine) for k, mine in seen.groupby("particle")}
    for name in BUBBLE_NUMBERS:
        rows = [
            (row[name], row[sd_of(name)], known[row["particle"]].get(name, np.nan))
            for row in summary.to_dict("records")
            if row["particle"] in known
        ]
        found, sd, true = np.array(rows, float).reshape(-1, 3).T
        good = np.isfinite(found) & np.isfinite(sd) & np.isfinite(true)
        out.append(("bubble", name, (found - true)[good], sd[good], true[good]))
    return out


def given_motion(
    frames: pd.DataFrame, smoothing: telerig.Smoothing, truth: pd.DataFrame, config: RunConfig,
    rng: np.random.Generator,
) -> tuple[pd.DataFrame, pd.DataFrame]:  # fmt: skip
    """Both tables for motion that is the truth plus 0.02 mm, 2 mm/s and 100 mm/s^2."""
    table = frames[["frame", "particle", "t_s"]].merge(
        truth.drop(columns=["d_eq_mm", "aspect", "tilt_deg", "t_s"]), on=["frame", "particle"]
    )
    for pattern, sd in (("{}_mm", 0.02), ("v{}_mm_s", 2.0), ("a{}_mm_s2", 100.0)):
        for x in "xyz":
            name = pattern.format(x)
            table[name] += sd * rng.standard_normal(len(table))
            table[f"s{name}"] = sd
    fluid = {k: v for k, v in vars(config.fluid).items() if k != "law"}
    gravity = config.stage.gravity_m_s2
    made = frames_table(table.assign(observed=1), smoothing.bodies, UP, gravity, fluid)
    known, lasting = liquid_of(fluid, gravity), Lasting.of(smoothing.summary["bodies"])
    liquid = None if known is None else known[0]
    return made, summary_table(made, UP, liquid, lasting=lasting)


def case(config: RunConfig, seed: int) -> dict[str, list[tuple[str, str, Array, Array, Array]]]:
    """The errors of one run: smoothed, and with given motion."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = telerig.simulate(
            config, rng=np.random.default_rng(seed), out=Path(folder) / "d", images=False
        )
        calibration = telerig.calibrate(dataset)
        run = dataset.runs[config.name].load()
        tracks = telerig.track(run, calibration)
        smoothing = telerig.smooth(tracks, calibration, stage=run)
    frames = telerig.bubble_table(smoothing)
    truth = true_table(config, seed)
    made = given_motion(frames, smoothing, truth, config, np.random.default_rng([seed, 1]))
    alone = [e for e in errors(*made, truth) if e[0] == "frame" or e[1] in ("d_eq_mm", "aspect")]
    return {
        "smoothed": errors(frames, telerig.bubble_summary(smoothing, frames), truth),
        "motion given": alone,
    }


def from_images(config: RunConfig, seed: int) -> list[tuple[str, str, Array, Array, Array]]:
    """Errors of bubbles whose outlines were found in rendered images."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = telerig.simulate(config, rng=np.random.default_rng(seed), out=Path(folder) / "d")
        calibration, run = telerig.calibrate(dataset), dataset.runs[config.name].load()
        tracks = telerig.track(run, calibration)
        smoothing = telerig.smooth(tracks, calibration, stage=run)
    frames = telerig.bubble_table(smoothing)
    truth = tracked_truth(frames, true_table(config, seed))
    return errors(frames, telerig.bubble_summary(smoothing, frames), truth)


def tracked_truth(frames: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """Rows of the truth with the numbers of the tracks, which are the nearest in every frame."""
    parts, place = [], ["x_mm", "y_mm", "z_mm"]
    for frame, true in truth.groupby("frame"):
        mine = frames[frames["frame"] == frame]
        away = mine[place].to_numpy()[:, None] - true[place].to_numpy()
        nearest = np.linalg.norm(away, axis=-1).argmin(1) if len(mine) else []
        parts.append(true.iloc[nearest].assign(particle=mine["particle"].to_numpy()))
    return pd.concat(parts)


def pooled(cases: list[dict[str, list[tuple[str, str, Array, Array, Array]]]]) -> pd.DataFrame:
    """One row per number: count, relative bias, RMS error, median sd, NEES."""
    rows = []
    for kind in cases[0]:
        for i, (table, name, *_) in enumerate(cases[0][kind]):
            error, sd, true = (np.concatenate([c[kind][i][j] for c in cases]) for j in (2, 3, 4))
            if not len(error):
                continue
            rows.append(
                {
                    "motion": kind, "per": table, "number": name, "count": len(error),
                    "bias": error.mean() / np.abs(true).mean(),
                    "rms": np.sqrt((error**2).mean()), "sd": np.median(sd),
                    "nees": ((error / sd) ** 2).mean(),
                    "within_2sd": np.mean(np.abs(error) < 2 * sd),
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=10, help="the first seed")
    parser.add_argument("--bubbles", type=int, default=6)
    parser.add_argument("--frames", type=int, default=250)
    parser.add_argument("--images", type=int, default=0)
    arguments = parser.parse_args()
    config = run_preset("forces", bubbles=arguments.bubbles, frames=arguments.frames)
    start, cases = time.process_time(), []
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        cases.append(case(config, seed))
        if arguments.images:
            fewer = replace(config, frames=arguments.images)
            cases[-1]["from images"] = from_images(fewer, seed)
    table = pooled(cases)
    print(f"{arguments.seeds} seeds, {time.process_time() - start:.0f} s of CPU\n")
    print(
        "| motion | per | number | count | bias, % | RMS error | median sd | NEES | within 2 sd |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for row in table.itertuples():
        print(
            f"| {row.motion} | {row.per} | {row.number} | {row[4]} | {100 * row.bias:+.2f} | "
            f"{row.rms:.4g} | {row.sd:.4g} | {row.nees:.2f} | {100 * row.within_2sd:.1f} % |"
        )


if __name__ == "__main__":
    main()
