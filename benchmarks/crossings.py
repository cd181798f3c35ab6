"""Are bubbles kept apart when they cross, and in swarms? Beside trackpy, laptrack and others.

Usage: python benchmarks/crossings.py [--events 500] [--swarms 4] [--seed 0]
    [--only TEXT] [--linkers NAME ...] [--out FILE.md]
Needs trackpy and laptrack (pip install trackpy laptrack) for the comparison.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from crossing_linkers import (
    Ids,
    Linker,
    laptrack_link,
    plain_prediction,
    telerig,
    trackpy_link,
)
from crossing_scenes import Scene, crossing, swarm
from crossing_scenes import __doc__ as SCENE_TEXT
from scipy.optimize import linear_sum_assignment

GUARD_S = 0.02
SLOW = {"trackpy NearestVelocity", "laptrack"}


def linkers() -> dict[str, Linker]:
    """All trackers; laptrack, which telerig does not install, where it is."""
    every = {
        "telerig": telerig(),
        "telerig, no encoder": telerig(encoder=False),
        "trackpy.link": trackpy_link,
        "trackpy NearestVelocity": lambda scene: trackpy_link(scene, velocity=True),
        "laptrack": laptrack_link,
        "plain prediction": plain_prediction,
    }
    return every if find_spec("laptrack") else {k: v for k, v in every.items() if k != "laptrack"}


def outcome(scene: Scene, ids: Ids) -> str:
    """kept, swap or break: the ids of the two bubbles well before and well after they met."""
    sides = []
    for side in (scene.t_s < -GUARD_S, scene.t_s > GUARD_S):
        at = np.flatnonzero(side)
        at = at[-3:] if scene.t_s[at[0]] < 0 else at[:3]
        sides.append([_majority(scene, ids, at, k) for k in (0, 1)])
    (a0, b0), (a1, b1) = sides
    if -1 in (a0, b0):
        return "not tracked"
    if a1 == b0 or b1 == a0:
        return "swap"
    return "kept" if (a0, b0) == (a1, b1) else "break"


def _majority(scene: Scene, ids: Ids, frames: np.ndarray, bubble: int) -> int:
    mine = [int(i) for f in frames for i, k in zip(ids[f], scene.truth[f]) if k == bubble]
    return max(set(mine), key=mine.count) if mine else -1


def swarm_scores(scene: Scene, ids: Ids) -> dict[str, float]:
    """IDF1, links kept (of the true ones), links wrong (of those made), tracks per bubble."""
    ids = _without_stubs(ids)
    truth, found = np.concatenate(scene.truth), np.concatenate(ids)
    real, given = truth >= 0, found >= 0
    _, t = np.unique(truth[real & given], return_inverse=True)
    _, p = np.unique(found[real & given], return_inverse=True)
    overlap = np.zeros((t.max() + 1, p.max() + 1))
    np.add.at(overlap, (t, p), 1)
    matched = overlap[linear_sum_assignment(-overlap)].sum()
    kept, wrong = _links(truth, found), _links(found, truth)
    return {
        "IDF1": 2 * matched / (real.sum() + given.sum()),
        "links kept": kept,
        "links wrong": 1 - wrong,
        "tracks per bubble": (p.max() + 1) / (t.max() + 1),
    }


def _links(owner: np.ndarray, other: np.ndarray) -> float:
    """Of consecutive detections of one owner, the part that the other labels alike."""
    good = total = 0
    for k in np.unique(owner[owner >= 0]):
        labels = other[owner == k]
        total += len(labels) - 1
        good += int(((labels[1:] == labels[:-1]) & (labels[1:] >= 0)).sum())
    return good / total


def _without_stubs(ids: Ids, shortest: int = 3) -> Ids:
    values, counts = np.unique(np.concatenate(ids), return_counts=True)
    short = values[counts < shortest]
    return [np.where(np.isin(i, short), -1, i) for i in ids]


def run_crossings(events: int, seed: int, who: Mapping[str, Linker], **options: float) -> list[str]:
    lines = []
    for name, link in who.items():
        rng = np.random.default_rng(seed)
        start, spent, results = 0.0, 0.0, []
        many = events // 5 if name in SLOW else events
        for _ in range(many):
            scene = crossing(rng, **options)
            start = time.process_time()
            ids = link(scene)
            spent += time.process_time() - start
            results.append(outcome(scene, ids))
        share = {k: 100 * results.count(k) / many for k in ("swap", "break", "not tracked")}
        frames = many * len(scene.t_s)
        lines.append(
            f"| {name} | {many} | {share['swap']:.1f} | {share['break']:.1f} "
            f"| {share['not tracked']:.1f} "
            f"| {1e3 * spent / frames:.2f} |"
        )
        print(lines[-1], flush=True)
    return lines


def run_swarms(
    swarms: int, seed: int, who: Mapping[str, Linker], rate_hz: float, bubbles: int
) -> list[str]:
    lines = []
    for name, link in who.items():
        rng = np.random.default_rng(seed)
        spent, scores = 0.0, []
        for _ in range(swarms):
            scene = swarm(rng, rate_hz, bubbles)
            start = time.process_time()
            ids = link(scene)
            spent += time.process_time() - start
            scores.append(swarm_scores(scene, ids))
        mean = {k: float(np.mean([s[k] for s in scores])) for k in scores[0]}
        frames = swarms * len(scene.t_s)
        lines.append(
            f"| {name} | {mean['IDF1']:.4f} | {100 * mean['links kept']:.2f} | "
            f"{100 * mean['links wrong']:.3f} | {mean['tracks per bubble']:.2f} | "
            f"{1e3 * spent / frames:.2f} |"
        )
        print(lines[-1], flush=True)
    return lines


CROSSINGS = {
    "500 Hz, both always detected": {"rate_hz": 500.0, "half_s": 0.1},
    "100 Hz, both always detected": {"rate_hz": 100.0},
    "500 Hz, one detection when closer than 0.15 mm": {
        "rate_hz": 500.0,
        "half_s": 0.1,
        "blob_mm": 0.15,
    },
    "100 Hz, one detection when closer than 0.15 mm": {"rate_hz": 100.0, "blob_mm": 0.15},
}
SWARMS = {
    "500 Hz, 20 bubbles": (500.0, 20),
    "500 Hz, 40 bubbles": (500.0, 40),
    "100 Hz, 20 bubbles": (100.0, 20),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=500)
    parser.add_argument("--swarms", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="sections whose title contains this")
    parser.add_argument("--linkers", nargs="*", help="by name [all]")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    who = {k: v for k, v in linkers().items() if not options.linkers or k in options.linkers}
    lines = ["# Crossings and swarms", "", *SCENE_TEXT.splitlines(), ""]
    lines += ["Times: CPU, with other work on the machine.", ""]
    for title, scene in CROSSINGS.items():
        if options.only in title:
            head = "| | events | swaps % | breaks % | not tracked % | ms / frame |"
            lines += [f"## Crossing: {title}", "", head, "|---|---|---|---|---|---|"]
            print(title)
            lines += [*run_crossings(options.events, options.seed, who, **scene), ""]
    for title, (rate, bubbles) in SWARMS.items():
        if options.only in title:
            head = "| | IDF1 | links kept % | links wrong % | tracks per bubble | ms / frame |"
            lines += [f"## Swarm: {title}", "", head, "|---|---|---|---|---|---|"]
            print(title)
            lines += [*run_swarms(options.swarms, options.seed, who, rate, bubbles), ""]
    if options.out:
        options.out.write_text("\n".join(lines))


if __name__ == "__main__":
    main()
