"""What is left out of a lens model and considered all the same: against refits, and the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from telerig.estimator.calibration.lens_choice import (
    Choice,
    Step,
    considered_covariance,
    considered_groups,
)
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.solver import covariance
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.problem import problem_from_dots
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.start.known_target import stereo_states
from telerig.estimator.calibration.thresholds import CONSIDERED_P_VALUE
from telerig.io.simulation.presets import preset
from telerig.rig.lens_parameters import GROUPS
from telerig.rig.triangulation import aligned_shift, triangulate

pytestmark = pytest.mark.usefixtures("without_advice")

NONE: frozenset[str] = frozenset()
STRETCH = frozenset({"affine"})


def left_out(camera: int, added: tuple[str, ...], gain: float, undetermined: bool = False) -> Step:
    return Step(camera, added, (NONE, NONE), gain, -1.0, False, "", undetermined)


def taken(camera: int, added: tuple[str, ...]) -> Step:
    return Step(camera, added, (NONE, NONE), 1e3, 1e3, True)


def choice(*steps: Step) -> Choice:
    state: Any = None
    first = Step(-1, (), (NONE, NONE), np.nan, np.nan, True)
    return Choice((first, *steps), (NONE, NONE), state, "")


def test_what_another_camera_needs_is_considered_whatever_it_gained() -> None:
    made = choice(
        taken(0, ("k1",)), taken(1, ("k1",)), taken(0, ("aspect", "skew")),
        left_out(0, ("k2",), 0.5), left_out(1, ("aspect", "skew"), 0.1), left_out(1, ("k2",), 0.5),
    )  # fmt: skip
    assert considered_groups(made, 2) == (NONE, STRETCH)


def test_a_tilt_is_a_stretch_too() -> None:
    made = choice(taken(0, GROUPS["tilt"]), left_out(1, ("aspect", "skew"), 0.1))
    assert considered_groups(made, 2) == (NONE, STRETCH)


def test_what_is_hardly_chance_is_considered_and_what_no_view_determines_is_not() -> None:
    """Chi-square of two degrees of freedom is beyond -2 ln(chance)."""
    limit = -2 * np.log(CONSIDERED_P_VALUE)
    for gain, found in ((limit - 0.1, NONE), (limit + 0.1, STRETCH)):
        made = choice(left_out(0, ("aspect", "skew"), gain))
        assert considered_groups(made, 2) == (found, NONE)
        vague = choice(left_out(0, ("aspect", "skew"), gain, undetermined=True))
        assert considered_groups(vague, 2) == (NONE, NONE)
    assert considered_groups(None, 2) == (NONE, NONE)


@pytest.fixture(scope="module")
def fitted(scene: Any) -> tuple[Any, Any]:
    """Both images stretched, the model without."""
    made = stretched(scene, 2e-5, 1)
    robust = problem_of(made)
    return robust, solve(robust, start_of(robust, made))


def stretched(scene: Any, right: float, seed: int) -> Any:
    """The left image by 1e-3, the right one by as much as said."""
    config = preset("paper")
    lenses = ({"k1": 2e-3, "aspect": 1.001}, {"k1": -1.5e-3, "skew": right})
    cameras = tuple(
        replace(c, parameters=lens, centre_offset_px=(0.0, 0.0))
        for c, lens in zip(config.cameras, lenses)
    )
    return scene(replace(config, cameras=cameras), seed)


def problem_of(made: Any) -> Any:
    problem = problem_from_dots(made.dots, made.cameras, made.target)
    return replace(problem, solver="numpy").with_model(("affine+radial", "radial"))


def start_of(problem: Any, made: Any) -> Any:
    starts = stereo_states(problem, problem.nominal_mm)
    return min((solve(problem, s, max_iterations=15) for s in starts), key=lambda f: f.cost).state


def test_the_covariance_is_the_richer_models_and_the_square_of_the_way_there(fitted: Any) -> None:
    """Against the richer model fitted to its minimum."""
    problem, solution = fitted
    own = joint_covariance(problem, solution)
    free, joint = considered_covariance(
        problem, solution, own, ("affine+radial", "radial"), (NONE, STRETCH)
    )
    richer = problem.with_model(("affine+radial", "affine+radial"))
    assert free == richer.free
    found = solve(richer, solution.state)
    whole = joint_covariance(richer, found)
    assert joint.names == whole.names
    way = found.state.dots_mm - solution.state.dots_mm
    np.testing.assert_allclose(
        joint.dots, whole.dots + way[:, :, None] * way[:, None], rtol=2e-2, atol=1e-9
    )
    names, matrix = joint.rig_block()
    _, alone = whole.rig_block()
    moved = found.state.intrinsics - solution.state.intrinsics
    for c, camera in enumerate(problem.cameras):
        for p, at in zip(free[c], richer.free_indices(c)):
            i = names.index(f"{camera.name}.{p}")
            assert matrix[i, i] == pytest.approx(alone[i, i] + moved[c, at] ** 2, rel=2e-2)


def test_nothing_considered_changes_nothing(fitted: Any) -> None:
    problem, solution = fitted
    own = joint_covariance(problem, solution)
    given = (problem, solution, own, ("affine+radial", "radial"), (NONE, NONE))
    assert considered_covariance(*given) == (problem.free, own)


def test_of_many_dots_some_are_as_uncertain_as_in_the_whole(
    fitted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the two dots of the known distance among them."""
    problem, solution = fitted
    assert problem.scale is not None
    own = joint_covariance(problem, solution)
    given = (problem, solution, own, ("affine+radial", "radial"), (NONE, STRETCH))
    some = np.array([problem.scale[0][0], 7, problem.scale[0][1]])
    whole = considered_covariance(*given)[1].of_rig_and(some)
    monkeypatch.setattr(covariance, "MANY_PARAMETERS", 10)
    parts = considered_covariance(*given)[1].of_rig_and(some)
    sd = np.sqrt(np.diag(whole))
    assert np.abs((parts - whole) / np.outer(sd, sd)).max() < 1e-7


@pytest.mark.parametrize("seeds", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_the_points_errors_are_those_of_the_covariance(scene: Any, seeds: int) -> None:
    """A stretch of the right camera that is too small to be named, beside a large one of the left.

    Errors of points over their stated standard deviations, mean square per direction: without
    what is considered several times too large.
    """
    found, plain = [], []
    for seed in range(seeds):
        made = stretched(scene, 3e-5, seed)
        calibration = made.calibrate("auto")
        bare = made.calibrate(calibration.model["name"])
        if "skew" in bare.free[1]:
            continue
        assert "skew" in calibration.free[1]
        assert "The data do not exclude other values" in calibration.model["words"]
        np.testing.assert_allclose(
            calibration.cameras[1].intrinsics, bare.cameras[1].intrinsics, rtol=1e-6, atol=1e-9
        )
        found.append(nees(made, calibration))
        plain.append(nees(made, bare))
    assert len(found) >= 0.6 * seeds
    assert np.mean(found) < 1.6
    assert np.mean(plain) > 2.0


def nees(made: Any, calibration: Calibration) -> float:
    axis = np.linspace(-15, 15, 4)
    points = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    truth = [made.true_cameras[c.name] for c in calibration.cameras]
    pixels = [c.project(points) for c in truth]
    pair = (calibration.cameras[0], calibration.cameras[1])
    off = (triangulate(pair, (pixels[0], pixels[1]), 1.0).points_mm - points).ravel()
    values, vectors = np.linalg.eigh(calibration.covariance)
    root = aligned_shift(pair, calibration.free, points) @ (
        vectors * np.sqrt(np.maximum(values, 0))
    )
    directions, sizes, _ = np.linalg.svd(root, full_matrices=False)
    seen = sizes > 1e-2 * sizes.max()
    along = directions[:, seen].T @ off / sizes[seen]
    return float(along @ along / seen.sum())
