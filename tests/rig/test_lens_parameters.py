"""Names of lens models: what they free, how they are given, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from telerig.errors import CalibrationError
from telerig.estimator.calibration.lens_choice import possible
from telerig.rig.lens_parameters import (
    GROUPS,
    INDEX,
    checked_model,
    groups_of,
    joint_name,
    models_by_camera,
    name_of,
    parameters_of,
    rich_groups,
)

CAMERAS = ("left", "right")


@pytest.mark.parametrize(
    ("name", "free"),
    [
        ("none", ()),
        ("radial", ("k1",)),
        ("k1", ("k1",)),
        ("k1+k2", ("k1", "k2")),
        ("tangential", ("k1", "p1", "p2")),
        ("brown", ("k1", "k2", "p1", "p2")),
        ("prism", ("k1", "k2", "p1", "p2", "s1", "s3")),
        ("kappa", ("kappa_per_mm",)),
        ("kappa+brown+centre",
         ("kappa_per_mm", "k1", "k2", "p1", "p2", "centre_u_px", "centre_v_px")),
        ("affine+radial", ("aspect", "skew", "k1")),
        ("tilt+radial", ("tilt_x", "tilt_y", "image_convergence_per_mm", "k1")),
        ("radial+tilt", ("tilt_x", "tilt_y", "image_convergence_per_mm", "k1")),
    ],
)  # fmt: skip
def test_what_a_name_frees(name: str, free: tuple[str, ...]) -> None:
    assert parameters_of(name) == free
    assert set(free) <= set(INDEX)


def test_every_lens_of_the_ladder_has_one_name() -> None:
    lenses = [*possible(rich_groups(mono=False, strong=False)),
              *possible(rich_groups(mono=False, strong=True))]  # fmt: skip
    names = [name_of(lens) for lens in lenses]
    assert len(names) == 60 + 12 and len(set(names)) == len(names)
    for lens, name in zip(lenses, names):
        assert set(groups_of(name)) == lens
    assert name_of({"k1"}) == "radial" and name_of(()) == "none"


def test_what_no_lens_of_the_ladder_is() -> None:
    plain = possible(rich_groups(mono=False, strong=False))
    assert not any({"affine", "tilt"} <= lens or {"tilt", "s"} <= lens for lens in plain)
    assert not any("k2" in lens and "k1" not in lens for lens in plain)
    assert not any("kappa" in lens for lens in possible(rich_groups(mono=True, strong=False)))
    strong = possible(rich_groups(mono=False, strong=True))
    assert all({"kappa", "centre"} <= lens and not lens & {"s", "tilt"}
               for lens in strong)  # fmt: skip


@pytest.mark.parametrize(
    ("model", "names"),
    [
        ("auto", ("auto", "auto")),
        ("brown", ("brown", "brown")),
        ("left=brown,right=radial", ("brown", "radial")),
        ("right=kappa+radial", ("auto", "kappa+radial")),
        ({"left": "tilt"}, ("tilt", "auto")),
        (["none", "auto"], ("none", "auto")),
    ],
)
def test_models_by_camera(model: Any, names: tuple[str, ...]) -> None:
    assert models_by_camera(model, CAMERAS) == names


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("fisheye", r"unknown model 'fisheye'(.|\n)*use auto, or one or more of none, radial"),
        ("left=brown,right=fisheye", "unknown model 'fisheye'"),
        ("top=brown", "camera 'top', which the rig does not have"),
        ("affine+tilt", "aspect and skew do the same as a tilted sensor"),
        ("k3", "unknown model 'k3'"),
        (["none"], "1 models for 2 cameras"),
    ],
)
def test_refused(model: Any, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        models_by_camera(model, CAMERAS)


def test_a_model_is_checked_before_its_cameras_are_known() -> None:
    assert checked_model("left=brown,right=auto") == "left=brown,right=auto"
    for wrong in ("fisheye", "left=fisheye", "left=auto,right="):
        with pytest.raises(CalibrationError, match="unknown model"):
            checked_model(wrong)


def test_one_name_where_all_are_alike() -> None:
    assert joint_name(("radial", "radial"), CAMERAS) == "radial"
    joint = joint_name(("radial", "none"), CAMERAS)
    assert joint == "left=radial,right=none"
    assert models_by_camera(joint, CAMERAS) == ("radial", "none")


def test_groups_do_not_overlap() -> None:
    parameters = [p for group in GROUPS.values() for p in group]
    assert len(set(parameters)) == len(parameters)
    np.testing.assert_array_equal(sorted(parameters), sorted(set(parameters) & set(INDEX)))
