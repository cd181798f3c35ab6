"""What no pixel can tell: ranks of the full Jacobian without priors, and the mirror mirrored."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from telerig.estimator.calibration.start.mirror_ambiguity import mirrored_state
from telerig.factors.calibration import (
    Observations,
    State,
    depth_gauge_residual,
    distance_residual,
    whitened_error,
    whitened_residuals,
)
from telerig.rig.lens_parameters import INDEX
from telerig.rig.pose import rotation_from_rotvec

pytestmark = pytest.mark.usefixtures("without_advice")

RHO_MM = (36.0, 36.0)
TABLE = ("scale_px_per_mm", "centre_u_px", "centre_v_px")
"""The parametrisation of the design's table: a centre per camera, no baseline between them."""
OURS = ("scale_px_per_mm",)
"""The product's: centres held, a full pose of the second camera."""
SHAPE, TILT = ("aspect", "skew"), ("tilt_x", "tilt_y")
TILTED = {"tilt_x": 0.1, "tilt_y": 0.05}


def pose(rotation: Any, translation: Any) -> Any:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out


def make(views: int = 12, *, cameras: int = 2, relief_mm: float = 0.0, **lens: float) -> State:
    """A 5 x 5 plate, tilted both ways by up to some 60 degrees to two cameras 86 degrees apart."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(5)), -1).reshape(-1, 2) * 6.0 - 12
    dots = np.c_[grid + rng.normal(0, 0.02, grid.shape), relief_mm * rng.normal(0, 1, 25)]
    base = rotation_from_rotvec([0.2, 0.75, 0.0])
    poses = [
        pose(base @ rotation_from_rotvec(rng.normal(0, 0.25, 3)), rng.normal(0, 5, 3))
        for _ in range(views)
    ]
    intrinsics = np.zeros((2, 18))
    intrinsics[:, 0], intrinsics[:, 1] = [10.04, 9.97], 1
    for name, value in lens.items():
        intrinsics[:, INDEX[name]] = value
    second = pose(rotation_from_rotvec([0.05, 1.5, 0.02]), np.zeros(3))
    return State(
        intrinsics[:cameras], np.array([np.eye(4), second])[:cameras], np.array(poses), dots
    )


def parallel(state: State, rotvec: Any, roll_rad: float = 0.0) -> State:
    """All views turned alike but for a roll in the plate's own plane."""
    views = state.rig_from_target.copy()
    for view, roll in zip(views, np.linspace(-roll_rad, roll_rad, len(views))):
        view[:3, :3] = rotation_from_rotvec(rotvec) @ rotation_from_rotvec([0.0, 0.0, roll])
    return replace(state, rig_from_target=views)


def every_dot(state: State) -> Observations:
    counts = (len(state.rig_from_target), len(state.intrinsics), len(state.dots_mm))
    view, camera, dot = (a.ravel() for a in np.indices(counts))
    whitener = np.tile(np.eye(2), (len(view), 1, 1))
    uv = np.zeros((len(view), 2))
    return Observations(view, camera, dot, uv, whitener, np.zeros(counts[:2]))


def jacobian(
    state: State, lens: tuple[str, ...], *, baseline: bool, dots: bool = True, depth: bool = True
) -> Any:
    """(2 M, P): per camera the lens, the second camera, per view 6 (5 without depth), dots."""
    obs = every_dot(state)
    full = whitened_residuals(state, obs, RHO_MM[: len(state.intrinsics)])
    columns = []

    def add(block: Any, owner: Any, index: int) -> None:
        columns.append(np.where((owner == index)[:, None, None], block, 0.0))

    for c in range(len(state.intrinsics)):
        add(full.by_intrinsics[..., [INDEX[p] for p in lens]], obs.camera, c)
    if len(state.intrinsics) == 2:
        add(full.by_camera[..., : 6 if baseline else 3], obs.camera, 1)
    for v, view in enumerate(state.rig_from_target):
        along_rig_axes = full.by_view[..., 3:] @ view[:3, :3].T
        moves = [full.by_view[..., :3], along_rig_axes[..., : 3 if depth else 2]]
        add(np.concatenate(moves, -1), obs.view, v)
    if dots:
        for n in range(len(state.dots_mm)):
            add(full.by_dot, obs.dot, n)
    return np.concatenate(columns, -1).reshape(2 * len(obs), -1)


def unseen(rows: Any) -> int:
    """Dimension of the null space; asserts a gap of five decades between what is seen and not."""
    length = np.linalg.norm(rows, axis=0)
    silent = length < 1e-9 * length.max()
    singular = np.linalg.svd(rows / np.where(silent, 1.0, length), compute_uv=False)
    singular = np.r_[singular, np.zeros(rows.shape[1] - len(singular))] / singular[0]
    zero = singular < 1e-12
    assert singular[~zero].min() > 1e-7
    return int(zero.sum())


def test_stereo_with_unknown_dots() -> None:
    """6 for the target's frame, 1 for the scale, 3 for the rig against the image offsets."""
    assert unseen(jacobian(make(), TABLE, baseline=False)) == 10
    assert unseen(jacobian(make(), TABLE, baseline=True)) == 13
    assert unseen(jacobian(make(), OURS, baseline=True)) == 9


def test_the_products_gauge_removes_exactly_what_is_unseen() -> None:
    """Ours: 2 depth origins, 1 scale, 6 of the target's frame; in this order, one by one."""
    state = make()
    rows = jacobian(state, OURS, baseline=True)
    at = 2 * len(OURS)
    _, of_pose = depth_gauge_residual(state.rig_from_camera[1], 1.0)
    gauge = np.zeros((2, rows.shape[1]))
    gauge[:, at : at + 6] = of_pose
    _, by_first = distance_residual(state.dots_mm[0], state.dots_mm[24], 33.0, 1.0)
    scale = np.zeros((1, rows.shape[1]))
    scale[:, -75:-72], scale[:, -3:] = by_first, -by_first
    prior = np.eye(rows.shape[1])[-75:]
    assert unseen(np.r_[rows, gauge]) == 7
    assert unseen(np.r_[rows, gauge, scale]) == 6
    assert unseen(np.r_[rows, gauge, scale, prior]) == 0


@pytest.mark.parametrize(
    ("views", "lens", "expected"),
    [
        (12, TABLE + SHAPE, 10),
        (3, TABLE + SHAPE, 10),
        (2, TABLE + SHAPE, 12),
        (2, TABLE, 10),
        (1, TABLE, 12),
    ],
)
def test_few_views_of_a_flat_target(views: int, lens: tuple[str, ...], expected: int) -> None:
    assert unseen(jacobian(make(views), lens, baseline=False)) == expected


@pytest.mark.parametrize(("views", "lens"), [(2, TABLE + SHAPE), (1, TABLE)])
def test_relief_of_the_target_shows_one_direction_more(views: int, lens: tuple[str, ...]) -> None:
    """The table's counts are of a flat plate; any relief at all gives the epipolar directions."""
    state = make(views, relief_mm=0.02)
    assert unseen(jacobian(state, lens, baseline=False)) == 11


def test_aspect_and_skew_or_tilt_but_not_both() -> None:
    both = jacobian(make(**TILTED), TABLE + SHAPE + TILT, baseline=False)
    assert unseen(both) == 14
    assert unseen(jacobian(make(**TILTED), TABLE + TILT, baseline=False)) == 10
    assert unseen(jacobian(make(**TILTED), TABLE + SHAPE, baseline=False)) == 10


def test_a_small_tilt_is_unseen() -> None:
    """A bilateral tilt acts in the second order: at zero its two components vanish per camera."""
    assert unseen(jacobian(make(), TABLE + TILT, baseline=False)) == 14


def test_distortion_and_its_centre() -> None:
    """One centre for distortion and image: k1 sees the rig's shift (10 - 3), until it is zero.

    With a centre of its own (to first order p1 and p2) the distortion leaves the table's 10.
    """
    state = make(k1=0.02)
    assert unseen(jacobian(state, (*TABLE, "k1"), baseline=False)) == 7
    assert unseen(jacobian(make(), (*TABLE, "k1"), baseline=False)) == 10
    assert unseen(jacobian(state, (*TABLE, "k1", "p1", "p2"), baseline=False)) == 10
    assert unseen(jacobian(state, (*OURS, "k1", "p1", "p2"), baseline=True)) == 9


def test_kappa_keeps_the_depth_origin_unseen() -> None:
    """A shift of the depth origin re-scales scale and kappa together: still 9 in our variables."""
    state = make(kappa_per_mm=1e-3)
    assert unseen(jacobian(state, (*OURS, "kappa_per_mm"), baseline=True)) == 9
    free_centre = jacobian(state, (*TABLE, "kappa_per_mm"), baseline=True)
    assert unseen(free_centre) == 9


@pytest.mark.parametrize(("roll_rad", "count"), [(0.0, 11), (0.3, 10)])
def test_parallel_views_leave_a_bas_relief_unless_they_roll(roll_rad: float, count: int) -> None:
    state = parallel(make(), [0.2, 0.75, 0.0], roll_rad=roll_rad)
    assert unseen(jacobian(state, TABLE, baseline=False)) == count


def test_stereo_with_known_dots() -> None:
    """3; for parallel views too, unless frontal to a camera, where a tilt is stationary."""
    assert unseen(jacobian(make(), TABLE, baseline=False, dots=False)) == 3
    tilted = parallel(make(), [0.2, 0.75, 0.0])
    assert unseen(jacobian(tilted, TABLE, baseline=False, dots=False)) == 3
    frontal = parallel(make(), [0.0, 0.0, 0.0])
    assert unseen(jacobian(frontal, TABLE, baseline=False, dots=False)) == 4


def test_mono_with_known_dots() -> None:
    state = make(cameras=1)
    assert unseen(jacobian(state, TABLE, baseline=False, dots=False, depth=False)) == 2
    with_depth = jacobian(state, TABLE, baseline=False, dots=False)
    assert unseen(with_depth) == 2 + len(state.rig_from_target)


@pytest.mark.parametrize("kappa", [0.0, 1e-4, 3e-3])
def test_the_mirror_twin_has_the_same_pixels(kappa: float) -> None:
    """Of lenses with distortion and tilt too; with kappa, the twin's is the opposite."""
    state = make(
        relief_mm=0.5, k1=0.02, p1=1e-3, s1=1e-3, aspect=1.01, kappa_per_mm=kappa, **TILTED
    )
    second = state.rig_from_camera.copy()
    second[1, :3, 3] = [0.3, -0.1, 0.7]
    state = replace(state, rig_from_camera=second)
    mirrored = mirrored_state(state)
    here, there = (whitened_error(s, every_dot(s), RHO_MM) for s in (state, mirrored))
    np.testing.assert_allclose(here, there, atol=1e-10)
    assert np.abs(mirrored.intrinsics[:, INDEX["kappa_per_mm"]] + kappa).max() == 0
    turn = state.rig_from_camera[1, :3, :3].T @ mirrored.rig_from_camera[1, :3, :3]
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) > 160
    for pose_matrix in (*mirrored.rig_from_target, *mirrored.rig_from_camera):
        assert np.linalg.det(pose_matrix[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(mirrored_state(mirrored).rig_from_target, state.rig_from_target)
    keeps_kappa = replace(mirrored, intrinsics=state.intrinsics)
    moved = np.abs(whitened_error(keeps_kappa, every_dot(state), RHO_MM) - here).max()
    assert (moved > 1e-3) == (kappa != 0)
