"""Symmetric targets: images numbered after different turns are brought to agree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finding_codes import codes
from turned_images import settled, turned

import telerig
from telerig.errors import CalibrationError
from telerig.io.simulation.presets import preset
from telerig.rig.target import Target

pytestmark = pytest.mark.usefixtures("without_advice")

SQUARE = Target(
    rows=5, columns=5, pitch_mm=(5.0, 5.0), dot_diameter_mm=2.0, scale_dots=(0, 24)
)  # fmt: skip

_Q, _R = np.mgrid[-3:4, -3:4].reshape(2, -1)
HEXAGON = Target(
    layout="points",
    points_mm=3.5 * np.stack([_Q + _R / 2, _R * np.sqrt(0.75)], -1)[np.abs(_Q + _R) <= 3],
    dot_diameter_mm=1.5, scale_dots=(0, 36),
)  # fmt: skip


def test_turns_are_turns() -> None:
    for target, order in ((SQUARE, 4), (replace(SQUARE, columns=7), 2), (HEXAGON, 6)):
        labels = target.turns()
        assert len(labels) == order
        np.testing.assert_array_equal(labels[0], target.ids())
        nominal = target.nominal_mm(target.ids())[:, :2]
        centred = nominal - nominal.mean(0)
        for k, label in enumerate(labels):
            angle = 2 * np.pi * k / order
            spin = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            places = centred @ spin.T
            assert min(
                np.abs(centred[label] - places).max(), np.abs(centred[label] - centred @ spin).max()
            ) < 1e-9  # fmt: skip


@pytest.mark.parametrize(
    ("target", "seed"), [(None, 0), (SQUARE, 1), (HEXAGON, 0)],
    ids=["2-fold", "4-fold", "6-fold, listed points"],
)  # fmt: skip
def test_images_turned_at_random(seed: int, target: Target | None, scene: Any) -> None:
    changes = {} if target is None else {"target": target}
    right = scene("symmetric", seed, **changes)
    made, turn = turned(right, seed)
    assert len(set(turn)) >= len(made.target.turns()) - 1
    calibration = made.calibrate("radial")
    assert settled(calibration, made, right.dots["dot"]) != []
    assert calibration.statistics["noise_floor_px"] == 0
    assert calibration.statistics["share_kept"] > 0.995
    assert "TURNS_KNOWN" in codes(calibration)


@pytest.mark.parametrize("turn", [False, True], ids=["numbered alike", "turned at random"])
def test_dots_that_no_image_shows(turn: bool, scene: Any) -> None:
    """Every real plate has a hidden dot: an image's numbering turns it into another number."""
    right = scene("symmetric", 1)
    right = right.with_dots(right.dots[~right.dots["dot"].isin([3, 31])].reset_index(drop=True))
    made = turned(right, 1)[0] if turn else right
    calibration = made.calibrate("radial")
    assert settled(calibration, made, right.dots["dot"]) != []
    assert len(calibration.target_points_mm) == len(made.target.ids()) - 2
    assert calibration.statistics["share_kept"] > 0.995


def test_outliers_do_not_confuse_the_turns(scene: Any) -> None:
    right = scene("symmetric", 1, outlier_share=0.05)
    made, _ = turned(right, 1)
    calibration = made.calibrate("radial")
    assert settled(calibration, made, right.dots["dot"]) != []
    wrong = calibration.dots.sort_values(["view", "camera", "u_px", "v_px"])
    weights = calibration.residuals.loc[wrong.index, "weight"].to_numpy()
    order = made.dots.sort_values(["view", "camera", "u_px", "v_px"]).index.to_numpy()
    np.testing.assert_array_equal(weights < 1, made.outlier[order])


def test_one_camera(scene: Any) -> None:
    right = scene("symmetric", 1)
    mine = right.dots["camera"] == "left"
    right = replace(
        right, dots=right.dots[mine].reset_index(drop=True), cameras=right.cameras[:1],
        nominal_rotvec_deg=None,
    )  # fmt: skip
    made, _ = turned(right, 2)
    calibration = made.calibrate("radial")
    assert settled(calibration, made, right.dots["dot"]) != []
    assert calibration.statistics["noise_floor_px"] == 0


def test_a_perfect_print_leaves_the_turns_undecided_but_harmless(scene: Any) -> None:
    made, _ = turned(scene("symmetric", 1, print_factor=0.0), 1)
    calibration = made.calibrate("radial")
    assert made.space_rms_um(calibration) < 1.0
    assert "TURNS_UNKNOWN" in codes(calibration)


def test_a_known_distance_that_a_turn_moves_is_trusted_less(scene: Any) -> None:
    """On a square target nobody knows which diagonal was measured."""
    made, _ = turned(scene("symmetric", 2, target=SQUARE), 2)
    calibration = made.calibrate("radial")
    assert "TURNED_DISTANCE" in codes(calibration)
    scale_sd = calibration.sd("left.scale_px_per_mm") / calibration.cameras[0]["scale_px_per_mm"]
    error = calibration.cameras[0]["scale_px_per_mm"] / made.true_cameras["left"]["scale_px_per_mm"]
    assert abs(error - 1) < 3 * scale_sd
    oblong = scene("symmetric", 2).calibrate("radial")
    assert "TURNED_DISTANCE" not in codes(oblong)


def test_a_print_is_stretched_whose_distance_a_turn_moves(scene: Any) -> None:
    made = scene("symmetric", 3, target=replace(preset("symmetric").target, scale_dots=(0, 6)))
    pitch_mm = tuple(pitch / 1.003 for pitch in made.target.pitch_mm)
    made = replace(made, target=replace(made.target, pitch_mm=pitch_mm))
    calibration = made.calibrate("radial")
    for camera in calibration.cameras:
        error = camera["scale_px_per_mm"] - made.true_cameras[camera.name]["scale_px_per_mm"]
        assert abs(error) < 3 * calibration.sd(f"{camera.name}.scale_px_per_mm")


@pytest.mark.parametrize("marks", [((0, 0),), ((0, 0), (0, 5))])
def test_symmetric_marks_on_an_unbounded_grid_are_refused(marks: Any, scene: Any) -> None:
    made = scene("unbounded", 2)
    made = replace(made, target=replace(made.target, marks=marks))
    with pytest.raises(CalibrationError, match="look the same after a turn"):
        made.calibrate("radial")


def test_dots_keep_their_own_covariances(tmp_path: Path) -> None:
    """In dots.csv of the results, where the dots of turned images have got new numbers."""
    rng = np.random.default_rng(3)
    data = telerig.simulate("symmetric", rng=rng, out=tmp_path / "set", images=False)
    file, labels = data.path / "calibration" / "dots.csv", data.target.turns()
    given = pd.read_csv(file, dtype={"view": str}).drop(columns=["row", "column"], errors="ignore")
    given["sigma_px"] = rng.uniform(0.01, 0.02, len(given))
    mine = (given["camera"] == "right") & (given["view"] == given["view"].iloc[0])
    given.loc[mine, "dot"] = labels[1][given.loc[mine, "dot"]]
    given.to_csv(file, index=False)
    found = telerig.calibrate(telerig.load_dataset(data.path), model="radial").dots
    keys = ["view", "camera", "u_px", "v_px"]
    both = found.merge(given, on=keys, suffixes=("", "_given"))
    assert (both["dot"] != both["dot_given"]).any() and len(both) == len(found) == len(given)
    np.testing.assert_allclose(np.sqrt(both["suu_px2"]), both["sigma_px"], rtol=1e-9)
