"""Pictures of bubbles: paths, velocity, drag, sizes, spectra, from the tables of a run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.report.plot.axes import (
    COLOURS,
    MUTED,
    axes_of,
    colour_of,
    columns_of,
    finite,
    height_and_sides,
)
from telerig.io.report.plot.spectrum import velocity_spectrum
from telerig.io.rig_file.fluid import liquid_of
from telerig.rig.bubble_physics import (
    Liquid,
    clift_clean_velocity,
    clift_velocity,
    mendelson_velocity,
    moore_aspect_weber,
    moore_velocity,
    schiller_naumann_drag,
    tomiyama_velocity,
)

_SUMMARY = "what telerig.bubble_summary returns, or bubble_summary.csv"
_WAVES_FROM_M = 1.3e-3
_MOST_CLOUD = 4000


def path(
    trajectories: pd.DataFrame,
    particles: Iterable[int] | None = None,
    *,
    colour_by: str | None = None,
    y_up: bool = True,
    axes: Any = None,
) -> Any:
    """Draw the paths of bubbles in space; returns 3-D axes.

    trajectories : `Smoothing.trajectories`, bubbles.csv or tracks.csv.
    particles : which bubbles; None for all.
    colour_by : a column that colours the path, like "slip_mm_s"; None for a colour per bubble.
    y_up : the vertical axis is the height, -y.

    Raises InputError for a table without positions.
    """
    axes = axes_of(axes, projection="3d")
    chosen = trajectories
    if particles is not None:
        chosen = trajectories[trajectories["particle"].isin(list(particles))]
    named = height_and_sides(chosen, "{}_mm", y_up)
    whose = chosen["particle"].to_numpy()
    colours = None if colour_by is None else columns_of(chosen, colour_by, made_by="bubbles.csv")[0]
    drawn = None
    for i, k in enumerate(np.unique(whose)):
        mine = whose == k
        place = [values[mine] for _, values in named]
        if colours is None:
            axes.plot(*place, color=COLOURS[i % 4], linewidth=1.0)
        else:
            known = colours[np.isfinite(colours)]
            limits = {"vmin": known.min(), "vmax": known.max()} if len(known) else {}
            drawn = axes.scatter(*place, c=colours[mine], s=3, **limits)
    if drawn is not None:
        axes.figure.colorbar(drawn, ax=axes, label=colour_by, shrink=0.7, pad=0.12)
    for side, (name, _) in zip("xyz", named):
        getattr(axes, f"set_{side}label")(f"{name} / mm")
    axes.set_aspect("equal")
    for side in "xy":
        axes.locator_params(axis=side, nbins=4)
    return axes


def velocity(
    summary: pd.DataFrame, fluid: Any = None, *, by: str | None = None, axes: Any = None
) -> Any:
    """Draw each bubble's mean speed against its diameter, beside published laws; returns axes.

    The speed is ``slip_mm_s``, along the path and relative to the liquid. The laws are of the rise
    velocity, which is smaller for a bubble that zigzags.

    summary : what `telerig.bubble_summary` returns. fluid : a mapping with the keys of [fluid] in
    rig.toml, for the laws (`telerig.rig.bubble_physics`); None for none. by : column whose values
    have a colour each, like "run" of a batch's bubbles.csv; None for one colour.
    Bars are one standard deviation. Raises InputError for a table without sizes or velocities.
    """
    axes = axes_of(axes, xlabel="equivalent diameter / mm", ylabel="speed along the path / (mm/s)")
    d, speed = _points(axes, summary, "d_eq_mm", "slip_mm_s", by)
    known_liquid = liquid_of(fluid)
    if known_liquid is not None:
        grid = _grid(d)
        for name, colour, style, values in _laws(grid, known_liquid[0]):
            axes.plot(1e3 * grid, 1e3 * values, style, color=colour, linewidth=1.0, label=name)
    low, high = float(speed.min()), float(speed.max())
    axes.set_ylim(max(0.0, 0.6 * low), 1.35 * high)
    return axes


def drag(table: pd.DataFrame, fluid: Any = None, *, by: str | None = None, axes: Any = None) -> Any:
    """Draw drag coefficients against Reynolds numbers, beside published laws; returns axes.

    table : what `telerig.bubble_summary` returns (with one standard deviation), or
    `telerig.bubble_table` (a point per frame). fluid, by : as for `velocity`; the laws are drawn
    for bubbles of these sizes that rise steadily, and for a rigid sphere.
    Raises InputError for a table without drag coefficients.
    """
    axes = axes_of(axes, xlabel="Reynolds number", ylabel="drag coefficient")
    if "frame" in table:
        re, coefficient = finite(*columns_of(table, "reynolds", "drag", made_by=_SUMMARY))
        every = len(re) // _MOST_CLOUD + 1
        dots = {"markersize": 2, "alpha": 0.3, "color": COLOURS[0], "markeredgewidth": 0}
        axes.plot(re[::every], coefficient[::every], ".", label="frames", **dots)
    else:
        re, coefficient = _points(axes, table, "reynolds", "drag", by)
    liquid = liquid_of(fluid)
    d = table["d_eq_mm"].to_numpy(float) if "d_eq_mm" in table else np.zeros(0)
    d = d[np.isfinite(d)]
    if liquid is not None and len(d):
        grid = _grid(d)
        for name, colour, style, speed in _laws(grid, liquid[0]):
            law = liquid[0].terminal_drag(grid, speed)
            axes.plot(liquid[0].reynolds(grid, speed), law, style, color=colour, linewidth=1.0,
                      label=name)  # fmt: skip
    low, high = np.quantile(coefficient, [0.02, 0.98])
    margin = 0.5 * max(abs(low), abs(high))
    axes.set_ylim(low - margin if low < 0 else max(0.0, low - margin), high + margin)
    margin = 0.15 * (re.max() - re.min()) + 0.05 * re.max()
    axes.set_xlim(max(0.0, re.min() - margin), re.max() + margin)
    low, high = axes.get_xlim()
    sphere = np.linspace(low, high, 160)[1:]
    if np.isfinite(schiller_naumann_drag(sphere)).any():
        axes.plot(sphere, schiller_naumann_drag(sphere), ":", color=COLOURS[3], linewidth=1.0,
                  label="Schiller, Naumann 1933, sphere")  # fmt: skip
    return axes


def aspect(summary: pd.DataFrame, *, by: str | None = None, axes: Any = None) -> Any:
    """Draw aspect ratios against Weber numbers, beside Moore's law of 1965; returns axes.

    summary, by : as for `velocity`. Bars are one standard deviation. Raises InputError for a table
    without aspect ratios or Weber numbers.
    """
    axes = axes_of(axes, xlabel="Weber number", ylabel="aspect ratio")
    weber, ratio = _points(axes, summary, "weber", "aspect", by)
    law = np.linspace(1.0 + 1e-3, 1.15 * max(float(ratio.max()), 1.2), 160)
    clean = moore_aspect_weber(law)
    seen = clean < 1.15 * weber.max()
    axes.plot(
        clean[seen], law[seen], "--", color=COLOURS[3], linewidth=1.0, label="Moore 1965, pure"
    )
    return axes


def _points(axes: Any, table: pd.DataFrame, x: str, y: str, by: str | None) -> tuple[Array, Array]:
    """Draw points with bars of one standard deviation; return the coordinates of those known.

    Those of the k-th value of the column ``by`` have an id with ".k." in an SVG.
    """
    sds = [f"s{name}" if name == "d_eq_mm" else f"s_{name}" for name in (x, y)]
    found = columns_of(table, x, y, *sds, made_by=_SUMMARY)
    finite(*found[:2])
    good = np.isfinite(found[0]) & np.isfinite(found[1])
    u, v, su, sv = (np.nan_to_num(column[good]) for column in found)
    groups = np.zeros(len(u), np.int64)
    names = ["bubbles, ± 1 sd"]
    if by is not None:
        every, unique = pd.factorize(table[by])
        groups, names = every[good], [str(name) for name in unique]
    for k in np.unique(groups).tolist():
        mine = groups == k
        drawn = axes.errorbar(
            u[mine], v[mine], sv[mine], su[mine], fmt="o", markersize=4, color=colour_of(k),
            linewidth=1.0, capsize=2, label=names[k],
        )  # fmt: skip
        for part in drawn.get_children():
            part.set_gid(f"{y}.{k}.{id(part)}")
    return u, v


def _grid(d_mm: Array) -> Array:
    """Diameters in m about those of the bubbles."""
    low, high = float(d_mm.min()), float(d_mm.max())
    margin = 0.25 * (high - low) + 0.1 * high
    return np.asarray(1e-3 * np.linspace(max(0.2, low - margin), high + margin, 160))


def _laws(d: Array, liquid: Liquid) -> list[tuple[str, str, str, Array]]:
    """Return (name, colour, line style, velocities (m/s)) of laws at diameters d (m).

    The wave analogies hold where surface tension does not keep bubbles round.
    """
    waves = d >= _WAVES_FROM_M
    laws = [
        ("Clift 1978, contaminated", COLOURS[1], "-", clift_velocity(d, liquid)),
        (
            "Clift 1978, pure",
            COLOURS[1],
            "--",
            np.where(waves, clift_clean_velocity(d, liquid), np.nan),
        ),
        ("Mendelson 1967", MUTED, ":", np.where(waves, mendelson_velocity(d, liquid), np.nan)),
        ("Tomiyama 1998, pure", COLOURS[2], "--", tomiyama_velocity(d, liquid)),
        ("Tomiyama 1998, contaminated", COLOURS[2], "-", tomiyama_velocity(d, liquid, "full")),
        ("Moore 1965", COLOURS[3], "--", moore_velocity(d, liquid)),
    ]
    return [law for law in laws if np.isfinite(law[3]).any()]


def sizes(summary: pd.DataFrame, *, bins: int = 20, axes: Any = None) -> Any:
    """Draw the distribution of the diameters by number and by volume; returns axes.

    summary : what `telerig.bubble_summary` returns: every bubble counts once. Lines stand at the
    mean and at the Sauter mean diameter, sum d^3 / sum d^2.
    Raises InputError for a table without sizes.
    """
    (d,) = finite(columns_of(summary, "d_eq_mm", made_by=_SUMMARY)[0])
    axes = axes_of(axes, xlabel="equivalent diameter / mm", ylabel="share of a bin / %")
    span = float(np.ptp(d)) or 0.1 * float(d[0])
    edges = np.linspace(d.min() - 0.05 * span, d.max() + 0.05 * span, min(bins, 2 + 2 * len(d)) + 1)
    for i, (name, weights) in enumerate((("number", np.ones(len(d))), ("volume", d**3))):
        share, _ = np.histogram(d, edges, weights=100 * weights / weights.sum())
        look = {"fill": i == 0, "alpha": 0.45 if i == 0 else 1.0, "linewidth": 1.3}
        axes.stairs(share, edges, color=COLOURS[i], label=f"by {name}", **look)
    sauter = float((d**3).sum() / (d**2).sum())
    axes.axvline(d.mean(), color=COLOURS[0], linewidth=1.0, linestyle="--", label="mean")
    axes.axvline(sauter, color=COLOURS[1], linewidth=1.0, linestyle="--", label="Sauter mean")
    return axes


def spectra(
    trajectories: pd.DataFrame, *, kind: str = "", y_up: bool = True, axes: Any = None
) -> Any:
    """Draw the power spectral density of the velocity along each axis; returns axes.

    trajectories : `Smoothing.trajectories` or bubbles.csv: the mean over the longest tracks. kind :
    "" for the smoothed velocity, "naive_" or "rts_" for the others of trajectories.csv.
    y_up : the vertical is called height. Raises InputError for tracks below 32 frames.
    """
    found = velocity_spectrum(trajectories, kind)
    axes = axes_of(axes, xlabel="frequency / Hz", ylabel="(mm/s)²/Hz", yscale="log")
    for i, name in enumerate(("x", "height" if y_up else "y", "z")):
        axes.plot(
            found.frequency_hz[1:],
            found.density[1:, i],
            color=COLOURS[i],
            linewidth=1.0,
            label=name,
        )
    return axes
