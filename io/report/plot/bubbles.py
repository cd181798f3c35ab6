"""Pictures of bubbles: paths, heights, velocities, drag, sizes, from the tables of a run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.report.plot.axes import (
    COLOURS,
    LEFT_OUT,
    MUTED,
    NAIVE,
    SMOOTHED,
    Curve,
    Vertical,
    axes_of,
    axis_number,
    colour_of,
    column_or_none,
    columns_of,
    draw_curves,
    finite,
    nothing_to_draw,
)
from telerig.io.report.plot.tracks import spaced, thinned
from telerig.io.results.bodies import ellipsoids_of
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

__all__ = ["aspect", "aspect_over_time", "drag", "height", "path", "sizes", "speed", "velocity"]

_SUMMARY = "what telerig.bubble_summary returns, or bubble_summary.csv"
_WAVES_FROM_M = 1.3e-3
_MOST_CLOUD = 4000
_MOST_POINTS, _MOST_LINES, _WINDOW, _MOST_BODIES = 8_000, 12, 1_000, 120
_WIDENING, _WIDEST, _FLATTEST = (1, 2, 5, 10, 20), 0.5, 0.02


def path(
    trajectories: pd.DataFrame,
    particles: Iterable[int] | None = None,
    *,
    colour_by: str | None = None,
    up: str = "-y",
    axes: Any = None,
) -> Any:
    """Draw the paths of bubbles in space, with some bubbles as ellipsoids; returns 3-D axes.

    trajectories : `Smoothing.trajectories`, bubbles.csv or tracks.csv; long ones are thinned.
    particles : which bubbles; None for all.
    colour_by : a column that colours the path, like "slip_mm_s"; None for a colour per bubble.
    up : the axis of the rig that points upwards, drawn as the height; "-y" for upright cameras.

    bubbles.csv and tracks.csv have the shapes of bubbles; of diameters alone spheres are drawn, and
    with ``colour_by`` none. Slender paths are drawn wider than true, by a factor that stands above
    them.
    Raises InputError for a table without positions, or with names in place of numbers of bubbles.
    """
    axes, vertical = axes_of(axes, projection="3d"), Vertical.of(up)
    columns_of(trajectories, "particle", "x_mm", "y_mm", "z_mm", made_by="Smoothing.trajectories")
    chosen = trajectories
    if particles is not None:
        chosen = trajectories[trajectories["particle"].isin(list(particles))]
    chosen = thinned(chosen, _MOST_POINTS)
    place = {i: vertical.sign_of(i) * chosen[f"{'xyz'[i]}_mm"].to_numpy(float) for i in range(3)}
    starts = np.flatnonzero(chosen["new"].to_numpy())
    if colour_by is None:
        whose = chosen["particle"].to_numpy()
        for rows in np.split(np.arange(len(chosen)), starts[1:]) if len(chosen) else ():
            line = [place[i][rows] for i in vertical.order]
            axes.plot(*line, color=colour_of(int(whose[rows[0]])), linewidth=1.0)
        frame = np.array([vertical.sign_of(i) * np.eye(3)[i] for i in vertical.order])
        sized = chosen[np.isfinite(chosen.get("d_eq_mm", np.full(len(chosen), np.nan)))]
        points = sized[["x_mm", "y_mm", "z_mm"]].to_numpy(float) @ frame.T
        radius = sized["d_eq_mm"].to_numpy(float)[:, None] / 2 if len(sized) else np.zeros((0, 1))
        axes.auto_scale_xyz(*np.r_[points - radius, points + radius].T)
    else:
        (colours,) = columns_of(chosen, colour_by, made_by="bubbles.csv")
        known = colours[np.isfinite(colours)]
        limits = {"vmin": known.min(), "vmax": known.max()} if len(known) else {}
        drawn = axes.scatter(*(place[i] for i in vertical.order), c=colours, s=3, **limits)
        axes.figure.colorbar(drawn, ax=axes, label=colour_by, shrink=0.7, pad=0.12)
    wider = _widening(axes)
    if colour_by is None and len(sized):
        _draw_bodies(axes, sized, points, frame, wider)
    if wider > 1:
        axes.set_title(f"horizontally {wider} times as wide as true", fontsize=8, y=0.98)
    for side, i in zip("xyz", vertical.order):
        getattr(axes, f"set_{side}label")(f"{vertical.name(i)} / mm")
    for side in "xy":
        axes.locator_params(axis=side, nbins=3)
    axes.tick_params(axis="z", pad=8)
    axes.zaxis.labelpad = 20
    return axes


def _draw_bodies(
    axes: Any, sized: pd.DataFrame, points_mm: Array, frame: Array, wider: int
) -> None:
    """Draw the outlines of some bubbles as they are seen, so few that they leave the paths free.

    sized : N rows of a sorted table with ``d_eq_mm``. points_mm : (N, 3) in the figure's axes,
    which are the rows of ``frame`` (3, 3) in rig axes. wider : how much the figure is widened.
    """
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    particle, diameter = (sized[name].to_numpy(float) for name in ("particle", "d_eq_mm"))
    turn, stretch = np.linspace(0, 2 * np.pi, 24, endpoint=False), np.array([wider, wider, 1.0])
    azimuth, elevation = np.deg2rad([axes.azim, axes.elev])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    level = np.array([-np.cos(azimuth), -np.sin(azimuth), 0.0])
    across = np.array([right, np.sin(elevation) * level + [0, 0, np.cos(elevation)]])
    rows = spaced(stretch * points_mm, particle, wider * diameter, _MOST_BODIES)
    quadrics = frame @ ellipsoids_of(sized.iloc[rows])[0] @ frame.T
    seen = across @ (stretch[:, None] * quadrics * stretch) @ across.T
    squares, directions = np.linalg.eigh(seen)
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    half = np.sqrt(np.maximum(squares, 0.0))[:, None] * circle
    ring = half @ np.swapaxes(directions, 1, 2) @ across / stretch
    colours = [colour_of(int(k)) for k in particle[rows]]
    style = {"facecolors": colours, "edgecolors": colours, "linewidths": 0.5, "alpha": 0.25}
    axes.add_collection3d(Poly3DCollection(points_mm[rows][:, None] + ring, **style))


def _widening(axes: Any) -> int:
    """Set true proportions, or of slender paths wider ones; return by how much."""
    sides = np.array([np.ptp(getattr(axes, f"get_{side}lim")()) for side in "xyz"])
    wider = max(f for f in _WIDENING if f == 1 or f * sides[:2].max() <= _WIDEST * sides[2])
    sides[:2] = np.maximum(wider * sides[:2], _FLATTEST * sides.max())
    for side, drawn in zip("xy", sides / wider):
        low, high = getattr(axes, f"get_{side}lim")()
        middle = 0.5 * (low + high)
        getattr(axes, f"set_{side}lim")(middle - drawn / 2, middle + drawn / 2)
    axes.set_box_aspect(sides, zoom=0.82)
    return wider


def height(
    trajectories: pd.DataFrame,
    particle: int | None = None,
    *,
    axis: str = "",
    up: str = "-y",
    frames: int = 200,
    axes: Any = None,
) -> Any:
    """Draw a bubble's height less a straight line, with bands of ± 2 sd; returns axes.

    trajectories : `Smoothing.trajectories`, of which the naive path (triangulated point plus
    encoder) is drawn beside the smoothed one, or tracks.csv. particle : None for the longest track.
    axis : "x", "y" or "z" instead of the vertical. up : as for `path`. frames : so many from the
    middle.
    Raises InputError for a table without positions.
    """
    vertical = Vertical.of(up)
    number = axis_number(axis) if axis else vertical.axis
    letter, sign = "xyz"[number], vertical.sign_of(number)
    mine = _of_bubble(trajectories, particle)
    first = max(0, (len(mine) - frames) // 2)
    mine = mine.iloc[first : first + frames]
    t, place = columns_of(mine, "t_s", f"{letter}_mm", made_by="Smoothing.trajectories")
    good = np.isfinite(place)
    if not good.any():
        raise nothing_to_draw("choose a bubble with positions")
    line = np.polyfit(t[good] - t[0], place[good], 1) if good.sum() > 1 else [0.0, place[good][0]]
    straight = np.polyval(line, t - t[0])
    sd = column_or_none(mine, f"s{letter}_mm")
    variance = column_or_none(mine, f"s{letter}{letter}_mm2")
    sd = np.sqrt(np.abs(variance)) if sd is None and variance is not None else sd
    curves = []
    naive = column_or_none(mine, f"naive_{letter}_mm")
    if naive is not None:
        dots = {"linestyle": "none", "marker": ".", "markersize": 4}
        curves.append(Curve(t, sign * (naive - straight), NAIVE, "before smoothing", style=dots))
    label = "measured" if naive is None else "smoothed"
    curves.append(Curve(t, sign * (place - straight), SMOOTHED, label, sd))
    name = vertical.name(number)
    axes = axes_of(axes, xlabel="t / s", ylabel=f"{name} less a line / mm")
    draw_curves(axes, curves)
    _unseen(axes, mine)
    return axes


def velocity(
    trajectories: pd.DataFrame,
    particle: int | None = None,
    axis: str = "",
    *,
    up: str = "-y",
    axes: Any = None,
) -> Any:
    """Draw a bubble's velocity over time, smoothed with its band of ± 2 sd, and naive.

    trajectories : `Smoothing.trajectories`. particle : None for the longest track. axis : "x", "y",
    "z"; "" for the vertical. up : as for `path`. Returns axes. Raises InputError for a table
    without velocities.
    """
    vertical = Vertical.of(up)
    number = axis_number(axis) if axis else vertical.axis
    name, sign = f"v{'xyz'[number]}_mm_s", vertical.sign_of(number)
    mine = _of_bubble(trajectories, particle)
    first = max(0, (len(mine) - _WINDOW) // 2)
    mine = mine.iloc[first : first + _WINDOW]
    t, speed = columns_of(mine, "t_s", name, made_by="Smoothing.trajectories")
    finite(speed)
    naive = column_or_none(mine, f"naive_{name}")
    curves = [] if naive is None else [Curve(t, sign * naive, NAIVE, "differences of positions")]
    curves.append(Curve(t, sign * speed, SMOOTHED, "smoothed", column_or_none(mine, f"s{name}")))
    what = "rise" if number == vertical.axis else f"v{'xyz'[number]}"
    axes = axes_of(axes, xlabel="t / s", ylabel=f"{what} / (mm/s)")
    draw_curves(axes, curves)
    _unseen(axes, mine)
    return axes


def _of_bubble(table: pd.DataFrame, particle: int | None) -> pd.DataFrame:
    """Return the rows of a bubble by frame. Raises InputError where it has none."""
    columns_of(table, "particle", made_by="Smoothing.trajectories")
    if particle is None and len(table):
        lengths = table["particle"].value_counts(sort=False).sort_index()
        particle = int(lengths.index[int(np.argmax(lengths.to_numpy()))])
    mine = table[table["particle"] == particle]
    if not len(mine):
        raise nothing_to_draw(f"there is no bubble {particle}")
    return mine.sort_values(by="frame")


def _unseen(axes: Any, mine: pd.DataFrame) -> None:
    """Mark frames in which no image shows the bubble by red ticks."""
    if "observed" in mine:
        t = mine["t_s"].to_numpy(float)[mine["observed"].to_numpy(float) == 0]
        if len(t):
            axes.plot(t, np.full(len(t), 0.015), "|", color=LEFT_OUT, markersize=5,
                      transform=axes.get_xaxis_transform(), zorder=5)  # fmt: skip


def aspect_over_time(
    bubbles: pd.DataFrame, particles: Iterable[int] | None = None, *, axes: Any = None
) -> Any:
    """Draw the aspect ratio of bubbles over time, with bands of ± 2 sd; returns axes.

    bubbles : what `telerig.bubble_table` returns, or bubbles.csv. particles : None for the longest
    tracks. Raises InputError for a table without aspect ratios.
    """
    columns_of(bubbles, "t_s", "aspect", made_by="telerig.bubble_table")
    known = bubbles[np.isfinite(bubbles["aspect"].to_numpy(float))]
    longest = known["particle"].value_counts().index[:_MOST_LINES]
    curves = []
    for particle in longest if particles is None else particles:
        mine = known[known["particle"] == particle]
        t, ratio = mine["t_s"].to_numpy(float), mine["aspect"].to_numpy(float)
        sd = column_or_none(mine, "s_aspect")
        curves.append(Curve(t, ratio, colour_of(int(particle)), sd=sd))
    if not curves:
        raise nothing_to_draw("shapes come from outlines: smooth a run with images")
    axes = axes_of(axes, xlabel="t / s", ylabel="aspect ratio")
    draw_curves(axes, curves)
    return axes


def speed(
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
    d, along = _points(axes, summary, "d_eq_mm", "slip_mm_s", by)
    known_liquid = liquid_of(fluid)
    if known_liquid is not None:
        grid = _grid(d)
        for name, colour, style, values in _laws(grid, known_liquid[0]):
            axes.plot(1e3 * grid, 1e3 * values, style, color=colour, linewidth=1.0, label=name)
    low, high = float(along.min()), float(along.max())
    axes.set_ylim(max(0.0, 0.6 * low), 1.35 * high)
    return axes


def drag(table: pd.DataFrame, fluid: Any = None, *, by: str | None = None, axes: Any = None) -> Any:
    """Draw drag coefficients against Reynolds numbers, beside published laws; returns axes.

    table : what `telerig.bubble_summary` returns (with one standard deviation), or
    `telerig.bubble_table` (a point per frame). fluid, by : as for `speed`; the laws are drawn
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

    summary, by : as for `speed`. Bars are one standard deviation. Raises InputError for a table
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
        for number, part in enumerate(drawn.get_children()):
            part.set_gid(f"{y}.{k}.{number}")
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
