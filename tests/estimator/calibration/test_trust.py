"""Can the covariance be believed? Two calibrations, two halves, structure in residuals, maps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from finding_codes import codes, only

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration import self_calibration
from telerig.estimator.calibration.next_view import next_view
from telerig.estimator.calibration.quality.comparison import compare_calibrations
from telerig.estimator.calibration.quality.residual_structure import residual_tests
from telerig.estimator.calibration.quality.uncertainty_map import uncertainty_map
from telerig.estimator.calibration.result.calibration import Calibration, calibration_from_cameras
from telerig.estimator.calibration.solver.gaussian import Estimate
from telerig.io.results.findings import Code, Finding
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

pytestmark = pytest.mark.usefixtures("without_advice")

STILL = range(10, 16)


@pytest.fixture(scope="module")
def at_rest(scene: Any) -> list[Any]:
    """Calibrations of one rig that did not move, by other targets and views."""
    return [scene("paper", seed).calibrate("radial") for seed in STILL]


def test_a_rig_at_rest_has_not_moved(at_rest: list[Any]) -> None:
    found = [compare_calibrations(a, b) for a, b in zip(at_rest[0::2], at_rest[1::2])]
    assert not any(c.moved or c.differs for c in found)
    deviations = np.array([[q.deviations for q in c.changes] for c in found])
    assert 0.6 < np.sqrt(np.mean(deviations**2)) < 1.5
    ratio = [c.field.rms_um / c.field.predicted_um for c in found]
    assert 0.4 < np.sqrt(np.mean(np.square(ratio))) < 1.6
    assert "no movement" in found[0].words()
    assert found[0].as_dict()["verdict"] == "SAME"


def test_a_movement_is_found_with_its_size(scene: Any, at_rest: list[Any]) -> None:
    """The second camera turned by 300 µrad about the rig's z axis, and shifted by 12 µm."""
    after = scene(
        "paper", 40, axis_gap_mm=0.312, mount_rotvec_deg=(0.4 + np.degrees(3e-4), -0.7, 0.5)
    ).calibrate("radial")
    found = compare_calibrations(at_rest[0], after)
    assert found.moved
    assert found.as_dict()["verdict"] == "MOVED"
    turn = np.array([q.change for q in found.changes[:3]])
    sd = np.array([q.sd for q in found.changes[:3]])
    before, now = (c.cameras[1].camera_from_rig.rotation for c in (at_rest[0], after))
    assert np.linalg.norm(turn) == pytest.approx(
        1e6 * np.arccos((np.trace(before.T @ now) - 1) / 2), rel=1e-3
    )
    assert np.all(np.abs(turn - [0.0, 0.0, -300.0]) < 4.5 * sd + 5.0)
    shift = found.changes[3]
    assert abs(abs(shift.change) - 12.0) < 4 * shift.sd
    assert "the rig moved: 1" in found.words()


def test_chance_does_not_judge_what_the_second_order_fills() -> None:
    """A direction ten thousand times better known than the largest error is no evidence."""
    covariance = np.diag([1.0, 0.2, 1e-4]) ** 2
    assert Estimate(np.array([0.5, 0.1, 0.01]), covariance).p_value() > 0.3
    assert Estimate(np.array([0.5, 1.1, 0.01]), covariance).p_value() < 1e-3


@pytest.mark.parametrize("angle", [0.0, 1.5])
def test_rigs_without_uncertainty_are_compared_exactly(angle: float) -> None:
    """Imported calibrations state no covariance, and axes of perspective lenses can be parallel."""
    look = {"kappa_per_mm": 1e-3}

    def rig(turned: float) -> Calibration:
        pose = Pose.from_rotvec([0.0, angle, turned], [300.0 * (angle == 0), 0.0, 0.0])
        left = Camera.create("left", (500, 400), 10.0, **look)
        return calibration_from_cameras(
            [left, Camera.create("right", (500, 400), 10.0, camera_from_rig=pose, **look)]
        )

    same = compare_calibrations(rig(0.0), rig(0.0))
    assert "equal except for rounding" in same.words()
    assert [c.deviations for c in same.changes] == [0.0] * 6
    moved = compare_calibrations(rig(0.0), rig(0.01))
    assert moved.as_dict()["verdict"] == "MOVED"
    assert "the rig moved" in moved.words()


def test_exchanged_cameras_and_other_lenses_are_named(scene: Any, at_rest: list[Any]) -> None:
    made = scene("paper", 41)
    names = made.dots["camera"].map({"left": "right", "right": "left"})
    exchanged = made.with_dots(made.dots.assign(camera=names)).calibrate("radial")
    assert "exchanged" in compare_calibrations(at_rest[0], exchanged).words()
    larger = at_rest[1].cameras[0]["scale_px_per_mm"] * 1.001
    zoomed = at_rest[1].cameras[0].with_parameters(scale_px_per_mm=larger)
    after = replace(at_rest[1], cameras=(zoomed, at_rest[1].cameras[1]))
    words = compare_calibrations(at_rest[0], after).words()
    assert "the magnification changed" in words and "scale of camera left" in words
    assert "exchanged" not in words


def test_other_rigs_are_refused(at_rest: list[Any], scene: Any) -> None:
    one = at_rest[0]
    renamed = replace(one, cameras=(one.cameras[0], replace(one.cameras[1], name="top")))
    with pytest.raises(InputError, match=r"different rigs.*right 512x512.*top 512x512"):
        compare_calibrations(one, renamed)
    turned = replace(one, cameras=one.cameras[::-1])
    with pytest.raises(InputError, match=r"same order in rig\.toml"):
        compare_calibrations(one, turned)
    alone = replace(one, cameras=one.cameras[:1])
    with pytest.raises(InputError, match="one camera"):
        compare_calibrations(alone, alone)


def test_halves_agree_when_the_model_is_right(at_rest: list[Any]) -> None:
    found = [c.diagnostics["halves"] for c in at_rest]
    ratio = [h["rms_um"] / h["predicted_um"] for h in found]
    assert 0.6 < np.sqrt(np.mean(np.square(ratio))) < 1.5
    assert sum("HALVES_AGREE" in codes(c) for c in at_rest) >= len(found) - 1
    assert found[0]["views"] == [6, 6]
    assert np.shape(found[0]["points_mm"]) == np.shape(found[0]["shift_um"])


def test_halves_know_that_the_targets_size_is_common_to_both(scene: Any) -> None:
    """The pitch alone sets the scale: a print error of 20 µm that no half can see as its own."""
    ratio = []
    for seed in range(30, 33):
        made = scene("paper", seed)
        target = replace(made.target, scale_dots=None, scale_distance_mm=None)
        halves = replace(made, target=target).calibrate("radial").diagnostics["halves"]
        ratio.append(halves["rms_um"] / halves["predicted_um"])
    assert 0.6 < np.sqrt(np.mean(np.square(ratio))) < 1.6


def test_halves_and_residuals_object_to_a_wrong_lens_model(scene: Any) -> None:
    """Distortion of half a pixel at the corner, calibrated without."""
    found = scene("dense", 3, sigma_px=0.02, views=8).calibrate("none")
    widening = found.diagnostics["structure"]["widening"]
    assert only(found, Code.HALVES_DISAGREE).numbers["widening"] == widening > 1
    assert "PATTERN" in codes(found)
    assert "! of two calibrations" in found.report()
    named = [finding for finding in found.findings if "better_models" in finding.numbers]
    assert [finding.names for finding in named] == [("tangential",)]


@pytest.mark.slow
def test_the_next_view_has_the_noise_of_the_covariance(
    scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same images with more stated noise, and with noise widened by a pattern: one gain."""
    monkeypatch.setattr(self_calibration, "next_view", next_view)
    made = scene("dense", 3, sigma_px=0.02, views=8)
    found = made.calibrate("none")
    widening, advice = found.diagnostics["structure"]["widening"], found.diagnostics["next_view"]
    floor = found.statistics["noise_floor_px"]
    noisy = made.dots.assign(suu_px2=(widening * floor) ** 2, svv_px2=(widening * floor) ** 2)
    stated = made.with_dots(noisy).calibrate("none").diagnostics["next_view"]
    gain, expected = (1 - a["after_um"] / a["before_um"] for a in (advice, stated))
    assert gain == pytest.approx(expected, rel=0.2)


def test_halves_need_views(scene: Any) -> None:
    few = scene("paper", 1, views=7).calibrate("radial")
    assert "HALVES_NOT_COMPARED" in codes(few) and few.diagnostics["halves"] == {}


class _Structure:
    """What the tests of some residuals found: p-values of each test, findings, widening."""

    def __init__(self, problem: Any, residuals: Any) -> None:
        leverage = np.full((len(residuals), 2, 2), 0.0)
        found, self.findings = residual_tests(problem, residuals, leverage)
        self.tests, self.widening = found["tests"], found["widening"]
        self.sound = codes(self) == ["NO_STRUCTURE"]


class _Dots:
    """Twelve images of 40 dots each, in two cameras."""

    def __init__(self, rng: np.random.Generator) -> None:
        count = 12 * 2 * 40
        self.view = np.repeat(np.arange(12), 80)
        self.camera = np.tile(np.repeat([0, 1], 40), 12)
        self.uv_px = rng.uniform(0, 511, (count, 2))
        self.views = tuple(f"v{i}" for i in range(12))
        self.cameras = [_Camera("left"), _Camera("right")]
        self.free = (("k1",), ("k1",))

    def observations(self) -> Any:
        return self


class _Camera:
    image_size_px = (512, 512)

    def __init__(self, name: str) -> None:
        self.name = name


def test_noise_has_no_structure() -> None:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(40):
        dots = _Dots(rng)
        found.append(_Structure(dots, rng.standard_normal((960, 2))))
    assert sum(not f.sound for f in found) <= 1
    assert np.median([f.widening for f in found]) == 1
    assert max(f.widening for f in found) < 1.5
    chances = np.array([t["p_value"] for f in found for t in f.tests])
    assert 0.35 < np.mean(chances < 0.5) < 0.65
    assert np.mean(chances < 0.05) < 0.09


def test_each_structure_is_named() -> None:
    rng = np.random.default_rng(1)
    dots = _Dots(rng)
    noise = rng.standard_normal((960, 2))
    left = dots.camera == 0

    region = noise + 2.0 * ((dots.uv_px[:, :1] < 120) & left[:, None])
    found = _Structure(dots, region)
    assert 5 < found.widening < 8
    assert _of_left(found, Code.PATTERN).numbers["widening"] == found.widening
    wave = np.stack([np.sin(dots.uv_px[:, 0] / 30 + dots.view), np.cos(dots.uv_px[:, 1] / 30)], -1)
    together = noise + 1.5 * wave * left[:, None]
    assert _of_left(_Structure(dots, together), Code.NEIGHBOURS).numbers["correlation"] > 0.1


def test_a_pattern_that_widens_is_named() -> None:
    rng = np.random.default_rng(1)
    dots = _Dots(rng)
    noise = rng.standard_normal((960, 2))
    at = (dots.uv_px[:, :1] < 120) & (dots.camera == 0)[:, None]
    chances = []
    for size in np.linspace(0.0, 1.0, 21):
        found = _Structure(dots, noise + size * at)
        chances.append(found.tests[0]["p_value"] * 2)
        assert found.sound == (found.widening == 1.0)
    assert min(chances) < 1e-3 < max(chances)


def _of_left(found: _Structure, code: Code) -> Finding:
    """The finding of that test; the other camera is sound."""
    assert {finding.cameras for finding in found.findings} == {("left",)}
    return only(found, code)


def test_the_map_is_the_scatter_of_triangulated_points(at_rest: list[Any]) -> None:
    """Measurement: Monte-Carlo over pixels. Calibration: over rigs drawn from its covariance."""
    calibration, rng = at_rest[0], np.random.default_rng(3)
    found = uncertainty_map(calibration, sigma_px=0.05, steps=3)
    point = found.points_mm[[0]]
    pixels = [calibration.project(c, point) for c in (0, 1)]
    noisy = [p + 0.05 * rng.standard_normal((4000, 2)) for p in pixels]
    points = calibration.triangulate(*noisy, sigma_px=0.05).points_mm
    assert np.allclose(np.cov(points.T), found.measurement_mm2[0], atol=0.08 * 0.005**2)
    whole = calibration.triangulate(*pixels, sigma_px=0.05).covariance_mm2[0]
    assert np.allclose(found.calibration_mm2[0] + found.measurement_mm2[0], whole, rtol=1e-9)


def test_the_map_needs_two_cameras(at_rest: list[Any]) -> None:
    one = at_rest[0]
    with pytest.raises(CalibrationError, match="one camera cannot triangulate"):
        uncertainty_map(replace(one, cameras=one.cameras[:1]))
