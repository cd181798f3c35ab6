"""Faults of clocks, encoder, lenses and cameras that leave a run's shake plausible.

Usage: python benchmarks/rig_faults.py [--seeds 2] [--seed 0] [--only NAME,...] [--out FILE.md]
Scenario S1 with five bubbles, accelerometers on the arms and marks in the tank; rig.toml does not
state how well the encoder's scale is known. Of each fault the page has the verdict, what was said,
and along each axis the error of places and of the motion about each bubble's mean, with the stated
standard deviations. An error beyond two of these that nothing names is silent.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from sensor_fault_kinds import Inputs, copied, inputs_of
from shake_cases import RISE_MM_S, SCENARIOS
from shake_scene import Case, Run, simulate

import telerig
from telerig.errors import TelerigError

Array = NDArray[np.float64]
Change = Callable[[Inputs, Run], None]

CASE = Case(SCENARIOS["S1"], scale_sigma=None)
HEAD = (
    "| fault | seed | verdict | places | motion about the mean | silent | said |\n"
    + 7 * "|---"
    + "|"
)
BEYOND = 2.0
"""Standard deviations beyond which an error that nothing names is silent."""


def _frames_late(frames: int) -> Change:
    """Images of which each was exposed so many frames after its stamp."""

    def change(inputs: Inputs, _run: Run) -> None:
        last = len(inputs["t_s"]) - frames
        for name in ("tracks", "references"):
            table = inputs[name]
            table = table[table["frame"] >= frames].copy()
            table["frame"] -= frames
            if "t_s" in table:
                table["t_s"] = inputs["t_s"][table["frame"]]
            inputs[name] = table.reset_index(drop=True)
        inputs["t_s"] = inputs["t_s"][:last]
        inputs["late"] = frames

    return change


def _encoder(change: Callable[[Array, Array], Array]) -> Change:
    """Readings (E,) changed at times (E,)."""

    def changed(inputs: Inputs, _run: Run) -> None:
        stage = inputs["stage"]
        read = change(stage["position_mm"].to_numpy(float), stage["t_s"].to_numpy(float))
        inputs["stage"] = stage.assign(position_mm=read)

    return changed


def _encoder_late(by_s: float) -> Change:
    def change(inputs: Inputs, _run: Run) -> None:
        inputs["stage"] = inputs["stage"].assign(t_s=inputs["stage"]["t_s"] + by_s)

    return change


def _backlash(read: Array, _t: Array) -> Array:
    """Play of 0.2 mm between the carriage and what is read."""
    out, at = read.copy(), read[0]
    for i, place in enumerate(read):
        at = out[i] = min(max(at, place - 0.1), place + 0.1)
    return out


def _magnified(*which: int) -> Change:
    """A calibration whose magnification is 1 % off in some cameras."""

    def change(inputs: Inputs, _run: Run) -> None:
        calibration = inputs["calibration"]
        cameras = tuple(
            c.with_parameters(scale_px_per_mm=1.01 * c["scale_px_per_mm"]) if j in which else c
            for j, c in enumerate(calibration.cameras)
        )
        inputs["calibration"] = replace(calibration, cameras=cameras)

    return change


def _right_image(moved: Callable[[Array, Array], Array]) -> Change:
    """moved : pixels (n, 2) of the right camera, from pixels at times (n,)."""

    def change(inputs: Inputs, run: Run) -> None:
        for name, columns, mine in (
            ("tracks", ["right_u_px", "right_v_px"], None),
            ("references", ["u_px", "v_px"], "right"),
        ):
            table = inputs[name].copy()
            rows = np.full(len(table), True) if mine is None else table["camera"] == mine
            t = run.t_s[table.loc[rows, "frame"]]
            table.loc[rows, columns] = moved(table.loc[rows, columns].to_numpy(float), t)
            inputs[name] = table

    return change


def _bumped(px: Array, t: Array) -> Array:
    return px + 3.0 * (t > t.max() / 2)[:, None]


def _rolled(px: Array, t: Array) -> Array:
    angle = np.deg2rad(0.2) * (t > t.max() / 2)
    x, y = (px - 511.5).T
    return 511.5 + np.column_stack([x - angle * y, y + angle * x])


def _centres_swing(inputs: Inputs, run: Run) -> None:
    """The marks stay: what swings are centres of bubbles, as of outlines that wobble."""
    table = inputs["tracks"].copy()
    swing = 3 * np.sin(2 * np.pi * 9 * run.t_s[table["frame"]])
    inputs["tracks"] = table.assign(
        right_u_px=table["right_u_px"] + swing, right_v_px=table["right_v_px"] + swing
    )


def _axis_wrong(inputs: Inputs, _run: Run) -> None:
    angle = np.deg2rad(3.0)
    stage = replace(inputs["rig"].stage, axis=(float(np.sin(angle)), -float(np.cos(angle)), 0.0))
    inputs["rig"].stage = stage


FAULTS: dict[str, tuple[str, Change]] = {
    "none": ("nothing", lambda inputs, run: None),
    "frame 1": ("both cameras one frame late", _frames_late(1)),
    "frame 5": ("both cameras five frames late", _frames_late(5)),
    "encoder 1": ("encoder 1 ms late", _encoder_late(1e-3)),
    "encoder 5": ("encoder 5 ms late", _encoder_late(5e-3)),
    "backlash": ("backlash of the encoder, 0.2 mm", _encoder(_backlash)),
    "commanded": ("encoder is the commanded motion", _encoder(lambda read, t: RISE_MM_S * t)),
    "both lenses": ("both magnifications 1 % off", _magnified(0, 1)),
    "right lens": ("the right magnification 1 % off", _magnified(1)),
    "bump": ("right camera bumped by (3, 3) px", _right_image(_bumped)),
    "roll": ("right camera rolled by 0.2 degrees", _right_image(_rolled)),
    "swing": ("right centres swing by 3 px at 9 Hz", _centres_swing),
    "axis": ("stage axis stated 3 degrees wrong", _axis_wrong),
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """error, stated : (2, 3) RMS in µm of places and of motion about the mean, along x, y, z.

    usable : (2, 3) whether ``usable_for`` grades place and path other than "no".
    """

    verdict: str
    said: tuple[str, ...]
    error_um: Array
    stated_um: Array
    usable: NDArray[np.bool_]

    @property
    def silent(self) -> NDArray[np.bool_]:
        """(2, 3) where an error is beyond what is stated, though nothing is withheld."""
        judged = self.usable & (self.verdict not in ("refused", "CONTRADICTED"))
        return judged & (self.error_um > BEYOND * self.stated_um)


def outcome(run: Run, change: Change) -> Outcome:
    inputs = copied(inputs_of(run, "marks", "frames") | {"tracks": run.tracks})
    change(inputs, run)
    late = inputs.pop("late", 0)
    try:
        result = telerig.smooth(**inputs)
    except TelerigError as error:
        nothing = np.full((2, 3), np.nan)
        return Outcome("refused", (str(error.code),), nothing, nothing, np.zeros((2, 3), bool))
    verdict = result.verdict
    said = [str(w) for w in result.summary["warnings"] if "imported calibration" not in str(w)]
    said += [f"{c['source']} {c.get('axis') or ''}: {c['test']} {c['statistic']:.2g}"
             for c in verdict.get("contradictions", ())]  # fmt: skip
    table = result.trajectories
    frame, bubble = table["frame"].to_numpy(), table["particle"].to_numpy()
    off = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    off = off - run.position_mm[bubble, frame + late]
    sd = table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy(float)
    rest = off - pd.DataFrame(off).groupby(bubble).transform("mean").to_numpy()
    shared = np.array([verdict["axes"][a].get("sigma_offset_mm") or 0.0 for a in "xyz"])
    error, stated = (
        np.stack([_rms(a), _rms(b)]) for a, b in ((off, rest), (np.hypot(sd, shared), sd))
    )
    grades = {(u["quantity"], u["axis"]): u["grade"] for u in verdict.get("usable_for", ())}
    usable = [[grades.get((q, a)) != "no" for a in "xyz"] for q in ("place", "path")]
    return Outcome(str(verdict["verdict"]), tuple(said), error, stated, np.array(usable))


def _rms(values: Array) -> Array:
    return np.asarray(1e3 * np.sqrt(np.mean(values**2, axis=0)))


def lines(options: argparse.Namespace) -> Iterator[str]:
    """Yield a row for each fault and seed."""
    for name in options.only.split(","):
        words, change = FAULTS[name]
        for seed in range(options.seed, options.seed + options.seeds):
            found = outcome(simulate(CASE, np.random.default_rng(seed)), change)
            cells = [words, f"{seed}", found.verdict]
            for error, sd, usable in zip(found.error_um, found.stated_um, found.usable):
                each = zip(error, sd, ("" if u else " (no)" for u in usable))
                cells += [", ".join(f"{e:.0f} at {s:.0f}{no}" for e, s, no in each)]
            silent = [
                f"{what} {axis}"
                for what, row in zip(("place", "motion"), found.silent)
                for axis, missed in zip("xyz", row)
                if missed
            ]
            cells += [", ".join(silent), "; ".join(found.said)]
            line = "| " + " | ".join(cells) + " |"
            print(line, flush=True)
            yield line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(FAULTS))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = list(lines(options))
    text = f"""# Faults of clocks, encoder, lenses and cameras

S1, five bubbles, accelerometers on the arms and marks; RMS error in µm of places and of the motion
about each bubble's mean along x, y, z, at the stated standard deviations; "(no)": `usable_for` does
not call the quantity usable. Silent is what is beyond {BEYOND:g} standard deviations although it is
called usable and the verdict is not CONTRADICTED.

{HEAD}
{chr(10).join(rows)}
"""
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
