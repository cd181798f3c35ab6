"""Bubbles that one image hides, or that were in doubt: from detections to rows of tracks.csv."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from seeds import few_or_many

import telerig
from telerig.estimator.bubbles.outline.ellipse_geometry import DETECTION_COLUMNS
from telerig.estimator.bubbles.pairing.learning import default_model
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.tracking.linking.frames_to_rows import WANDER, RowMaker
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.io.dataset.run import RunData
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset

Array = NDArray[np.float64]

CAMERAS = tuple(true_cameras(run_preset("swarm").calibration).values())
FRAMES, DT_S, NOISE_PX, SHAKE_PX = 28, 0.002, 0.05, 1.0
FRONT, BACK = 0, 1
PLAIN = default_model(CAMERAS)
PAIR = replace(PLAIN.pairs[0, 1], frame_px=SHAKE_PX * 2**0.5)
MODEL = replace(PLAIN, pairs={(0, 1): PAIR})
DIAMETERS_MM = np.array([3.6, 2.0, 2.4, 1.8, 2.8, 3.1])
START_MM = np.array(
    [[0.0, 9.0, 0.0], [3.2, 9.4, 0.3], [-12, 3, 8], [14, -4, -9], [-9, -8, -12], [10, 12, 12]]
)


def paths(rng: np.random.Generator) -> Array:
    """(FRAMES, 6, 3) mm: rising side by side, swinging; BACK is beside FRONT along x."""
    t = DT_S * np.arange(FRAMES)[:, None]
    phase = rng.uniform(0, 2 * np.pi, (2, 6))
    out = np.tile(START_MM, (FRAMES, 1, 1))
    out[..., 1] -= 250 * t
    out[..., 0] += 0.8 * (np.sin(38 * t + phase[0]) - np.sin(phase[0]))
    out[..., 2] += 0.8 * (np.sin(38 * t + phase[1]) - np.sin(phase[1]))
    out[:, BACK] += [3.2, 0.4, 0.3] + out[:, FRONT] - out[:, BACK]
    out[:, BACK, 2] += 0.5 * np.sin(20 * t[:, 0])
    out[:, BACK, 0] += 0.4 * np.sin(25 * t[:, 0])
    return out


def table(camera: int, frame: int, points: Array, shake_px: Array, rng: np.random.Generator,
          rows: list[int]) -> pd.DataFrame:  # fmt: skip
    uv = CAMERAS[camera].project(points[rows]) + shake_px + rng.normal(0, NOISE_PX, (len(rows), 2))
    radius = DIAMETERS_MM[rows] / 2 * CAMERAS[camera]["scale_px_per_mm"]
    out = pd.DataFrame({name: np.full(len(rows), np.nan) for name in DETECTION_COLUMNS})
    out[["u_px", "v_px"]] = uv
    out["suu_px2"] = out["svv_px2"] = NOISE_PX**2
    out["suv_px2"], out["angle_rad"], out["contrast"], out["edge_px"] = 0.0, 0.0, 0.8, 1.0
    out["a_px"], out["b_px"], out["d_eq_px"] = 1.01 * radius, radius / 1.01, 2 * radius
    out["area_px2"], out["chi2_dof"], out["flags"] = np.pi * radius**2, 1.0, ""
    return out.assign(frame=frame, camera=CAMERAS[camera].name)


def linked(
    seed: int, hidden: set[int] = frozenset(), unseen: set[int] = frozenset(),
    twice: set[int] = frozenset(),
) -> tuple[pd.DataFrame, Array, Array]:  # fmt: skip
    """Rows of tracks.csv, the true points and the cameras' shake (F, 2, 2).

    BACK is hidden in the second camera's ``hidden`` frames and shown by none in the ``unseen``
    ones; ``twice`` : a second bubble of its size is beside it.
    """
    rng = np.random.default_rng(seed)
    truth, shake = paths(rng), rng.normal(0, SHAKE_PX, (FRAMES, 2, 2))
    shapes = Shapes(third=1e-3, fourth=1e-3)
    linker = RowMaker(MODEL, Tracker(), shapes, np.array([0.0, -1.0, 0.0]))
    for frame in range(FRAMES):
        tables = []
        for camera in (0, 1):
            gone = frame in unseen or (camera == 1 and frame in hidden)
            rows = [i for i in range(6) if not (i == BACK and gone)]
            found = table(camera, frame, truth[frame], shake[frame, camera], rng, rows)
            if frame in twice:
                copy = found.iloc[[BACK]].copy()
                found.loc[BACK, "u_px"] -= 0.3
                copy["u_px"] += 0.3
                found = pd.concat([found, copy], ignore_index=True)
            # the two tables list the bubbles in different orders
            tables.append(found if camera == 0 else found.iloc[::-1].reset_index(drop=True))
        assert linker.add(frame, DT_S * frame, None, (tables[0], tables[1])) is None
    last = linker.finish()
    assert last is not None
    return last.tracks, truth, shake


def rows_of_back(found: pd.DataFrame, truth: Array, shake: Array) -> pd.DataFrame:
    """The rows in which BACK is the nearest bubble to the first camera's pixel."""
    keep = []
    for index, row in found.iterrows():
        uv = CAMERAS[0].project(truth[int(row["frame"])]) + shake[int(row["frame"]), 0]
        name = CAMERAS[0].name
        off = np.hypot(uv[:, 0] - row[f"{name}_u_px"], uv[:, 1] - row[f"{name}_v_px"])
        if off.argmin() == BACK:
            keep.append(index)
    return found.loc[keep].set_index("frame")


def units(row: pd.Series, truth: Array, shake: Array) -> tuple[float, float]:
    """Error of the hidden pixel along u (px), and over the sd that the row states of its point."""
    other = CAMERAS[1]
    frame = int(row.name)
    uv = other.project(truth[frame, BACK][None])[0] + shake[frame, 1]
    error = np.array([row[f"{other.name}_u_px"], row[f"{other.name}_v_px"]]) - uv
    point = row[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    s = row[["sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2"]].to_numpy(float)
    covariance = np.array([[s[0], s[1], s[2]], [s[1], s[3], s[4]], [s[2], s[4], s[5]]])
    step = 1e-3 * np.eye(3)
    by_point = (other.project(point + step) - other.project(point - step)).T / 2e-3
    sd = np.sqrt((by_point @ covariance @ by_point.T)[0, 0])
    return float(error[0]), float(error[0] / sd)


@few_or_many(2, 6)
def test_a_bubble_that_passes_behind_another_keeps_its_points(draws: int) -> None:
    hidden, every = set(range(14, 22)), []
    for seed in range(draws):
        found, truth, shake = linked(seed, hidden)
        back = rows_of_back(found, truth, shake)
        assert len(set(back["particle"])) == 1
        shared = back[back["flags"].str.contains("shared")]
        assert set(shared.index) == hidden
        assert set(back.index) == set(range(FRAMES))
        wander = WANDER * 1e-3 * DIAMETERS_MM[BACK] / 2 * CAMERAS[0]["scale_px_per_mm"]
        seen = shared[f"{CAMERAS[0].name}_suu_px2"].to_numpy(float)
        assert seen == pytest.approx(NOISE_PX**2 + wander**2, rel=1e-6)
        every += [units(row, truth, shake) for _, row in shared.iterrows()]
    errors, sigmas = np.array(every).T
    assert np.abs(errors).max() < 3.0
    assert np.sqrt(np.mean(sigmas**2)) < 1.5


def test_the_shared_pixel_follows_the_hiding_cameras_own_shake() -> None:
    found, truth, shake = linked(3, {16, 17, 18})
    back = rows_of_back(found, truth, shake)
    name = CAMERAS[1].name
    for frame in (16, 17, 18):
        uv = CAMERAS[1].project(truth[frame, BACK][None])[0] + shake[frame, 1]
        assert back.loc[frame, f"{name}_v_px"] == pytest.approx(uv[1], abs=0.35)


@few_or_many(2, 4)
def test_a_bubble_born_behind_another_is_followed_back(draws: int) -> None:
    every = []
    for seed in range(draws):
        found, truth, shake = linked(seed, set(range(8)))
        back = rows_of_back(found, truth, shake)
        assert len(set(back["particle"])) == 1
        early = back[back.index < 8]
        assert set(early.index) >= {4, 5, 6, 7}
        assert early["flags"].str.contains("shared").all()
        every += [units(row, truth, shake) for _, row in early.iterrows()]
    errors, sigmas = np.array(every).T
    assert np.abs(errors).max() < 6.0
    assert np.sqrt(np.mean(sigmas**2)) < 1.6


def test_first_pairs_in_doubt_are_the_tracks_own_and_nothing_is_invented() -> None:
    found, truth, shake = linked(0, unseen={2, 3})
    back = rows_of_back(found, truth, shake)
    assert len(set(back["particle"])) == 1
    assert set(back.index) == set(range(FRAMES)) - {2, 3}
    assert not back["flags"].str.contains("shared").any()


def test_of_two_alike_neither_is_guessed() -> None:
    found, truth, shake = linked(0, unseen={2, 3}, twice={1})
    back = rows_of_back(found, truth, shake)
    assert 1 not in set(back.index)
    assert set(back.index) >= set(range(4, FRAMES))


def test_no_detection_is_given_twice() -> None:
    found, _, _ = linked(1, set(range(10, 16)))
    first = found[["frame", f"{CAMERAS[0].name}_u_px", f"{CAMERAS[0].name}_v_px"]]
    assert not first.duplicated().any()
    assert not found.duplicated(["frame", "particle"]).any()


def test_a_point_that_one_image_hides_counts_one_detection(tmp_path: Path) -> None:
    """The number of detections without a partner is that of the detections in no pair."""
    rng, hidden = np.random.default_rng(3), set(range(14, 22))
    truth = paths(rng)
    found = pd.concat(
        table(camera, frame, truth[frame], np.zeros(2), rng,
              [i for i in range(6) if not (i == BACK and camera == 1 and frame in hidden)])
        for frame in range(FRAMES) for camera in (0, 1)
    ).assign(particle="")  # fmt: skip
    names = tuple(c.name for c in CAMERAS)
    sizes = {c.name: c.image_size_px for c in CAMERAS}
    run = RunData("r", tmp_path, names, FRAMES, DT_S * np.arange(FRAMES), None, sizes,
                  "detections", detections=found.reset_index(drop=True))  # fmt: skip
    tracks = telerig.track(run, calibration_from_cameras(list(CAMERAS)))
    shared = int(tracks.table["flags"].str.contains("shared").sum())
    left = tracks.summary["detections_without_partner_or_track"]
    assert shared > 0 and left == len(found) - 2 * (len(tracks.table) - shared) >= shared
