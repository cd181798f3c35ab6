"""Dots of a target in single images, against rendered truth and the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from dot_renderer import centre_bound_px, picture, render
from dots import Case, mahalanobis, matched, scene_of

import telerig
from guard_parts.inputs import digest
from guard_parts.metrics import Metric, count, error, nees, share, stated_sd, word

KINDS = {
    "R 4, 2 % noise": Case(4, 0.02),
    "R 10, 65 degrees": Case(10, 0.02, tilt_deg=65),
    "R 10, uneven light, black": Case(10, 0.005, light=0.2, polarity="black_on_white"),
    "R 6, 16 bits": Case(6, 0.005, 1.5, tilt_deg=40, bits=16),
    "R 20, 1 % noise": Case(20, 0.01),
}
WANTED = 160


def measured(case: Case) -> list[Metric]:
    rng = np.random.default_rng([35, round(case.radius_px), round(1e4 * case.noise)])
    errors, squares, sds, fits, given, total, false = [], [], [], [], [], 0, 0
    while total < WANTED:
        scene = scene_of(case, rng)
        sigma = float(np.hypot(case.noise * case.contrast, np.sqrt(1 / 12)))
        bound = centre_bound_px(replace(scene, light_per_px=(0.0, 0.0)), sigma)
        image = picture(render(scene), case.noise * case.contrast, case.bits, rng)
        given.append(image)
        table = telerig.locate_dots(image)
        centres, rows = matched(scene.centres_px, table[["u_px", "v_px"]].to_numpy())
        light = scene.light(*scene.centres_px.T)[:, None]
        off = centres - scene.centres_px
        found = rows >= 0
        kept = table.iloc[rows[found]]
        errors.append((off / (bound / light))[found])
        squares.append(mahalanobis(off[found], kept) / 2)
        s = kept[["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy().reshape(-1, 2, 2)
        sds.append(np.linalg.det(s) ** 0.25)
        fits.append(kept["chi2_dof"].to_numpy())
        false += len(table) - int(found.sum())
        total += len(scene.centres_px)
    every = np.concatenate(errors)
    return [
        error("centre over bound", float(np.sqrt(np.mean(every**2))), "1"),
        stated_sd(np.concatenate(sds), "px"),
        nees(np.concatenate(squares)),
        Metric("chi2_dof", float(np.mean(np.concatenate(fits))), "1", "same", 0.02),
        share("found", len(every) / total),
        count("false", false),
        word("inputs", digest(*given)),
    ]


TASKS: dict[str, Callable[[], list[Metric]]] = {
    name: partial(measured, case) for name, case in KINDS.items()
}
