"""Tables of a symmetric target's dots, numbered after random turns."""

from __future__ import annotations

from typing import Any

import numpy as np


def turned(scene: Any, seed: int = 0, *, images: bool = True) -> tuple[Any, Any]:
    """Every image (or every view) numbered after a random turn; and (M,) the turns."""
    rng = np.random.default_rng(seed)
    labels, dots = scene.target.turns(), scene.dots.copy()
    by = ["view", "camera"] if images else ["view"]
    turn = np.zeros(len(dots), int)
    for _, group in dots.groupby(by):
        turn[group.index] = rng.integers(len(labels))
    dots["dot"] = np.array(labels)[turn, dots["dot"].to_numpy()]
    return scene.with_dots(dots), turn


def settled(calibration: Any, scene: Any, true_ids: Any) -> list[int]:
    """The one turn that the final numbering differs from the truth by; empty if there is none."""
    columns = ["view", "camera", "u_px", "v_px"]
    final = calibration.dots.sort_values(columns)["dot"].to_numpy()
    order = scene.dots.sort_values(columns).index.to_numpy()
    truth = np.asarray(true_ids)[order]
    return [
        k for k, label in enumerate(scene.target.turns()) if np.array_equal(label[truth], final)
    ]
