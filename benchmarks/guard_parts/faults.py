"""Faults for a proof that the guard notices them: exported functions that give worse results.

They are planted in the exported names of `telerig` (`guard.py --plant NAME`, which no help shows),
so that they say nothing of how the product works. `benchmarks/guard_proof.py` runs them.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd

import telerig

SD = 0.85
MORE = np.sqrt(1.1**2 - 1)
"""Noise that makes an error of 1 sd 10 % larger, in sds."""
EVERY = 33
"""3 % of the bubbles."""
PIXELS = ("suu_px2", "suv_px2", "svv_px2")
SPACE = ("sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2")


def _after(name: str, change: Callable[[Any], Any]) -> None:
    """Make an exported function give ``change`` of its result."""
    original = getattr(telerig, name)

    @wraps(original)
    def changed(*given: Any, **options: Any) -> Any:
        return change(original(*given, **options))

    setattr(telerig, name, changed)


def _scaled(table: pd.DataFrame, columns: tuple[str, ...], factor: float) -> pd.DataFrame:
    return table.assign(**{c: factor * table[c] for c in columns})


def _noisy(table: pd.DataFrame, pairs: tuple[tuple[str, str], ...], root: bool) -> pd.DataFrame:
    """Values with more noise. pairs : columns of values, and of their sds, or variances if root."""
    rng = np.random.default_rng(35)
    out = {}
    for value, spread in pairs:
        sd = table[spread].to_numpy(float)
        sd = np.sqrt(sd) if root else sd
        out[value] = table[value] + MORE * sd * rng.standard_normal(len(table))
    return table.assign(**out)


def _of_paths(change: Callable[[pd.DataFrame], pd.DataFrame]) -> Callable[[Any], Any]:
    """What the parts read of a smoothing, its trajectories changed."""

    def changed(found: Any) -> Any:
        table = change(found.trajectories)
        return SimpleNamespace(trajectories=table, verdict=found.verdict, summary=found.summary)

    return changed


def _of_tracks(change: Callable[[pd.DataFrame], pd.DataFrame]) -> Callable[[Any], Any]:
    return lambda tracks: replace(tracks, table=change(tracks.table))


def _pixels_of(table: pd.DataFrame) -> tuple[str, ...]:
    """The columns of the pixels' covariances in tracks.csv."""
    return tuple(c for c in table if str(c).endswith(PIXELS))


def sd15() -> None:
    """All stated standard deviations are 15 % too small."""
    for name in ("locate_dots", "detect_bubbles"):
        _after(name, lambda table: _scaled(table, PIXELS, SD**2))
    _after("calibrate", lambda found: replace(found, covariance=SD**2 * found.covariance))
    _after("track", _of_tracks(lambda t: _scaled(t, (*SPACE, *_pixels_of(t)), SD**2)))
    sds = ("sx_mm", "sy_mm", "sz_mm")
    _after("smooth", _of_paths(lambda table: _scaled(table, sds, SD)))


def bubbles3() -> None:
    """Every 33rd bubble of an image, or point of a track, is not found."""
    _after("detect_bubbles", lambda t: t[np.arange(len(t)) % EVERY != EVERY // 2])
    _after("track", _of_tracks(lambda t: t[np.arange(len(t)) % EVERY != EVERY // 2]))


def swap() -> None:
    """Two tracks exchange their ids in the middle of one run (of the first with two tracks)."""
    done: list[bool] = []

    def swapped(table: pd.DataFrame) -> pd.DataFrame:
        ids = table["particle"].value_counts().index[:2]
        if done or len(ids) < 2:
            return table
        done.append(True)
        late = table["frame"] > table["frame"].median()
        other = table["particle"].map({ids[0]: ids[1], ids[1]: ids[0]}).fillna(table["particle"])
        particle = table["particle"].where(~late, other).astype(table["particle"].dtype)
        return table.assign(particle=particle)

    _after("track", _of_tracks(swapped))


def error10() -> None:
    """Errors are 10 % larger: of dots, outlines and paths by noise that is not stated, of
    calibrations by two views of twelve that are left out, which is."""
    pixels = (("u_px", "suu_px2"), ("v_px", "svv_px2"))
    for name in ("locate_dots", "detect_bubbles"):
        _after(name, lambda table: _noisy(table, pixels, True))
    space = tuple((f"{a}_mm", f"s{a}{a}_mm2") for a in "xyz")

    def worse(table: pd.DataFrame) -> pd.DataFrame:
        spreads = [c for c in _pixels_of(table) if c[-5:] in ("u_px2", "v_px2") and "suv" not in c]
        views = tuple((f"{c.rsplit('_', 2)[0]}_{c[-5]}_px", c) for c in spreads)
        return _noisy(table, (*space, *views), True)

    _after("track", _of_tracks(worse))
    paths = tuple((f"{a}_mm", f"s{a}_mm") for a in "xyz")
    _after("smooth", _of_paths(lambda table: _noisy(table, paths, False)))
    original = telerig.calibrate

    @wraps(original)
    def from_fewer(dataset: Any, **options: Any) -> Any:
        table = dataset.path / "calibration" / "dots.csv"
        if not table.is_file():
            return original(dataset, **options)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name) / "set"
            shutil.copytree(dataset.path, folder)
            dots = pd.read_csv(table, dtype={"view": str})
            left_out = sorted(set(dots["view"]))[::6]
            kept = dots[~dots["view"].isin(left_out)]
            kept.to_csv(folder / "calibration" / "dots.csv", index=False)
            return original(telerig.load_dataset(folder), **options)

    telerig.calibrate = from_fewer


FAULTS: dict[str, Callable[[], None]] = {
    "sd15": sd15, "bubbles3": bubbles3, "swap": swap, "error10": error10,
}  # fmt: skip


def plant(name: str) -> None:
    """Raises KeyError for an unknown name."""
    FAULTS[name]()
