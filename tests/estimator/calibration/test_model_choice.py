"""Choosing a lens model for each camera: against real fits, brute force, and simulated truth."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from telerig.errors import CalibrationError
from telerig.estimator.calibration import lens_choice as model_choice
from telerig.estimator.calibration.lens_choice import (
    Lens,
    QuadraticCost,
    additions,
    model_start,
    possible,
    search,
    steps_to,
)
from telerig.estimator.calibration.self_calibration import choose_model
from telerig.estimator.calibration.solver.problem import Problem, nominal_state, problem_from_dots
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.thresholds import UNDETERMINED
from telerig.io.simulation.presets import preset
from telerig.rig.lens_parameters import GROUPS, name_of, rich_groups

pytestmark = pytest.mark.usefixtures("without_advice")

RICH = rich_groups(mono=False, strong=False)
LENS: dict[str, dict[str, float]] = {
    "none": {},
    "radial": {"k1": -1e-3},
    "k1+k2": {"k1": 2e-3, "k2": -2e-3},
    "brown": {"k1": 2e-3, "k2": 2e-3, "p1": 4e-4, "p2": -3e-4},
    "prism": {"k1": 3e-3, "k2": -3e-3, "p1": 5e-4, "p2": 4e-4, "s1": -9e-4, "s3": 9e-4},
    "kappa+radial": {"kappa_per_mm": 6e-5, "k1": 2e-3},
    "affine": {"aspect": 1.001, "skew": -5e-4},
    "tilt+radial": {"tilt_x": 0.1, "tilt_y": -0.05, "image_convergence_per_mm": 1e-3, "k1": 2e-3},
}
BILATERAL = {"tilt_x": 0.1, "tilt_y": 0.06}


def made_of(scene: Any, left: dict[str, float], right: dict[str, float], seed: int = 1) -> Any:
    """The preset `paper` with other lenses, centred."""
    config = preset("paper")
    cameras = tuple(
        replace(c, parameters=lens, centre_offset_px=(0.0, 0.0))
        for c, lens in zip(config.cameras, (left, right))
    )
    return scene(replace(config, cameras=cameras), seed)


def problem_of(made: Any) -> Problem:
    problem = problem_from_dots(made.dots, made.cameras, made.target)
    return replace(problem, solver="numpy")


def start_of(made: Any, problem: Problem) -> Any:
    """The true poses and dots, nominal lenses."""
    state = nominal_state(problem)
    cameras = [made.true_cameras[c.name].rig_from_camera for c in problem.cameras]
    views = [made.true_views[v].rig_from_target for v in problem.views]
    matrices = [np.array([_matrix(p) for p in poses]) for poses in (cameras, views)]
    return replace(state, rig_from_camera=matrices[0], rig_from_target=matrices[1])


def _matrix(pose: Any) -> Any:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = pose.rotation, pose.translation_mm
    return out


@pytest.fixture(scope="module")
def fitted(scene: Any) -> tuple[Problem, Any, QuadraticCost]:
    """A rig with k1 alone: the rich problem, its fit, its quadratic."""
    made = made_of(scene, LENS["radial"], LENS["radial"])
    problem = problem_of(made).with_model(name_of(RICH))
    rich = solve(problem, start_of(made, problem))
    return problem, rich, QuadraticCost.of(problem, rich)


# --- the quadratic, and the search over it ------------------------------------------------------


@pytest.mark.parametrize(
    "names",
    [("none", "none"), ("radial", "none"), ("radial", "kappa+radial"), ("brown", "affine+radial"),
     ("p+s", "radial"), ("affine+k1+k2", "k1+s")],
)  # fmt: skip
def test_the_quadratic_is_what_fits_find(names: tuple[str, str], fitted: Any) -> None:
    problem, rich, quadratic = fitted
    model = problem.with_model(names)
    cost = solve(model, model_start(model, rich.state)).cost
    lenses = tuple(
        Lens(g for g, parameters in GROUPS.items() if set(parameters) <= set(free))
        for free in model.free
    )
    promised = quadratic.rise(lenses)
    found = 2 * (cost - rich.cost) / quadratic.variance
    assert promised == pytest.approx(found, rel=2e-3, abs=0.02)
    assert quadratic.least == pytest.approx(2 * rich.cost / quadratic.variance, rel=1e-6)


def test_a_tilts_homography_is_in_the_quadratic(scene: Any) -> None:
    """At first order: the real tilt costs what its two directions promise, within a few units."""
    made = made_of(scene, LENS["tilt+radial"], LENS["none"])
    problem = problem_of(made).with_model(name_of(RICH))
    rich = solve(problem, start_of(made, problem))
    quadratic = QuadraticCost.of(problem, rich)
    tilted, flat = (quadratic.rise((lens, Lens())) for lens in (
        Lens({"tilt", "k1"}), Lens({"affine", "k1"})))  # fmt: skip
    model = problem.with_model(("tilt+radial", "none"))
    cost = solve(model, model_start(model, rich.state)).cost
    assert tilted == pytest.approx(2 * (cost - rich.cost) / quadratic.variance, abs=30)
    assert flat > 100 * max(tilted, 1.0)


def test_the_search_finds_what_brute_force_does(fitted: Any) -> None:
    """On quadratics with a few groups really there, weak and strong."""
    _, _, real = fitted
    options = possible(Lens({"kappa", "affine", "k1", "k2", "p"}))
    rng = np.random.default_rng(3)
    covariance = real.minimum.covariance
    factor = np.linalg.cholesky(covariance + 1e-12 * np.diag(np.diag(covariance)))
    for _ in range(4):
        z = rng.normal(0, 1, len(factor)) + rng.choice([0, 0, 5], len(factor))
        quadratic = replace(real, minimum=replace(real.minimum, value=factor @ z))
        best = min(product(options, options), key=quadratic.cost)
        assert quadratic.cost(search(quadratic, [options, options])) == quadratic.cost(best)


def test_the_way_goes_up_one_group_at_a_time(fitted: Any) -> None:
    _, _, quadratic = fitted
    chosen = (Lens({"k1", "k2", "p"}), Lens({"kappa", "k1"}))
    steps = steps_to(quadratic, chosen, (Lens(), Lens()))
    assert steps[-1][2] == chosen and len(steps) == 5
    assert {steps[0][:2], steps[1][:2]} == {(0, "k1"), (1, "k1")}
    order = [(camera, group) for camera, group, _ in steps]
    assert order.index((0, "k1")) < order.index((0, "k2"))
    options = possible(RICH)
    groups = {group for _, group, _ in additions((Lens({"k1"}), Lens()), [options, options])}
    assert groups == {"kappa", "affine", "tilt", "k1", "k2", "p", "s"}


def test_what_the_views_do_not_determine_is_not_chosen(fitted: Any) -> None:
    """A k2 that the data want at ten sd, but whose sd is the prior's."""
    _, _, real = fitted
    i = real.names.index((0, "k2"))
    prior = real.prior.copy()
    prior[i] = real.minimum.sd[i]
    value = real.minimum.value + 10 * real.minimum.covariance[:, i] / prior[i]
    wants = replace(real, minimum=replace(real.minimum, value=value))
    options = [possible(RICH)] * 2
    wanted = search(wants, options)
    assert "k2" in wanted[0]
    vague = replace(wants, prior=0.5 * prior)
    assert vague.sd_over_prior(wanted, 0, "k2") > UNDETERMINED
    assert "k2" not in model_choice._determined(vague, options)[0]


# --- simulated truth ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("left", "right"),
    [("none", "none"), ("k1+k2", "kappa+radial"), ("brown", "none"), ("affine", "tilt+radial"),
     ("prism", "radial")],
)  # fmt: skip
def test_each_camera_gets_its_own(left: str, right: str, scene: Any) -> None:
    made = made_of(scene, LENS[left], LENS[right])
    problem = problem_of(made)
    _, choice = choose_model(problem, start_of(made, problem), ("auto", "auto"))
    assert choice.names == (left, right), choice.words
    step = choice.steps[-1]
    assert not step.taken and step.bic_gain < 0 and step.words.startswith("held at nominal: ")


def test_a_bilateral_tilt_is_a_stretch_and_says_so(scene: Any) -> None:
    made = made_of(scene, BILATERAL, {})
    calibration = made.calibrate("auto")
    assert calibration.model["by_camera"] == {"left": "affine", "right": "none"}
    assert "images cannot distinguish the two" in calibration.model["words"]
    size = float(np.hypot(*BILATERAL.values()))
    said = f"stretched by {100 * (np.sqrt(1 + size**2) - 1):.2g} %"
    assert said in calibration.model["words"]
    assert made.space_rms_um(calibration) < 1.5


def test_a_tilted_sensor_is_not_taken_for_outliers(scene: Any) -> None:
    made = scene("scheimpflug", 1, outlier_share=0.05)
    calibration = made.calibrate("auto")
    np.testing.assert_array_equal(made.weights(calibration) < 1, made.outlier)
    assert calibration.model["name"] == "left=tilt+radial,right=affine+radial"
    assert made.space_rms_um(calibration) < 1.2


# --- what the user says, and what is written ----------------------------------------------------


@pytest.mark.parametrize(
    ("model", "names"),
    [
        ("left=brown,right=none", ("brown", "none")),
        ({"left": "none", "right": "kappa"}, ("none", "kappa")),
        (("tangential", "auto"), ("tangential", "radial")),
    ],
)
def test_the_user_may_fix_it(model: Any, names: tuple[str, str], scene: Any) -> None:
    made = made_of(scene, LENS["radial"], LENS["radial"])
    calibration = made.calibrate(model)
    assert tuple(calibration.model["by_camera"].values()) == names
    expected = tuple(("scale_px_per_mm", *_parameters(name)) for name in names)
    assert calibration.free == expected
    if "auto" not in model:
        assert calibration.model["ladder"] == [] and "as given" in calibration.model["words"]
    with pytest.raises(CalibrationError, match="camera 'top'"):
        made.calibrate({"top": "brown"})


def _parameters(name: str) -> tuple[str, ...]:
    lens = {"brown": ("k1", "k2", "p"), "tangential": ("k1", "p"), "radial": ("k1",)}
    return tuple(p for g in lens.get(name, (name,) if name != "none" else ()) for p in GROUPS[g])


def test_the_table_says_what_each_step_bought(scene: Any) -> None:
    calibration = made_of(scene, LENS["brown"], LENS["radial"]).calibrate("auto")
    rows = json.loads(json.dumps(calibration.model["ladder"], allow_nan=False))
    taken = [row for row in rows if row["taken"]]
    assert rows[: len(taken)] == taken
    assert taken[0]["added"] == [] and taken[0]["model"] == "none"
    assert taken[-1]["model"] == calibration.model["name"] == "left=brown,right=radial"
    added = sorted((row["camera"], *row["added"]) for row in taken[1:])
    assert added == [("left", "k1"), ("left", "k2"), ("left", "p1", "p2"), ("right", "k1")]
    for row in taken[1:]:
        assert row["chi2_gain"] > row["bic_gain"] > 0 and row["p_value"] < 1e-4
    for row in rows[len(taken) :]:
        assert row["bic_gain"] < 0 and not row["taken"]
