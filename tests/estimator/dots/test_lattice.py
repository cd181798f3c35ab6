"""Growing a lattice from unordered dots: every dot on the grid, at consistent places."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from seeds import few_or_many

from telerig.errors import DetectionError
from telerig.estimator.dots.grid.lattice import (
    NOT_ON_GRID,
    OFF_PLACE,
    SECOND_DOT,
    Cell,
    Lattice,
    apply_homography,
    fit_affine,
    fit_homography,
    grow_lattice,
)

Array = NDArray[np.float64]


def grid(rows: int, columns: int, pitch: tuple[float, float] = (7.0, 7.0)) -> Array:
    row, column = np.divmod(np.arange(rows * columns), columns)
    xy = np.stack([column * pitch[0], row * pitch[1]], -1)
    return np.asarray(xy - xy.mean(0))


def tilted_view(tilt_rad: float, azimuth_rad: float, roll_rad: float, slant: float) -> Array:
    """Homography of a plane tilted about an axis in the image, weakly in perspective."""

    def turn(angle: float) -> Array:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s], [s, c]])

    linear = turn(azimuth_rad) @ np.diag([1.0, np.cos(tilt_rad)]) @ turn(roll_rad - azimuth_rad)
    depth = np.sin(tilt_rad) * turn(roll_rad - azimuth_rad)[1]
    return np.vstack([np.column_stack([linear, [0, 0]]), [*(slant * depth), 1.0]])


def seen(homography: Array, xy: Array, radius: float) -> tuple[Array, Array]:
    """Points and the shape matrices of circles there, by finite differences."""
    steps = [np.array([1e-4, 0.0]), np.array([0.0, 1e-4])]
    moved = [
        apply_homography(homography, xy + s) - apply_homography(homography, xy - s) for s in steps
    ]
    jacobian = np.stack(moved, -1) / 2e-4
    shape = radius**2 * jacobian @ np.swapaxes(jacobian, 1, 2)
    return apply_homography(homography, xy), shape


def agrees(lattice: Lattice, rows_columns: Array) -> bool:
    """Whether the places are the given integers up to one turn, mirror and shift."""
    design = np.column_stack([lattice.places, np.ones(len(lattice.places))])
    fit = np.round(np.linalg.lstsq(design, rows_columns, rcond=None)[0])
    return bool(np.all(design @ fit == rows_columns)) and abs(np.linalg.det(fit[:2])) == 1


@pytest.mark.parametrize("ratio", [1.0, 1.4, 0.5])
@few_or_many(8, 60)
def test_random_views_of_a_grid_with_gaps_and_dirt(ratio: float, draws: int) -> None:
    failures = 0
    for seed in range(draws):
        rng = np.random.default_rng([int(10 * ratio), seed])
        rows, columns = 9, 11
        xy = grid(rows, columns, (7.0 * ratio, 7.0))
        view = tilted_view(
            np.deg2rad(rng.uniform(0, 75)), *rng.uniform(0, 2 * np.pi, 2), rng.uniform(-2e-3, 2e-3)
        )
        scale = np.diag([12.0, 12.0, 1.0])
        points, shapes = seen(scale @ view, xy, 1.2 * min(1, ratio))
        keep = rng.random(len(points)) > 0.1
        truth = np.stack(np.divmod(np.arange(len(points)), columns), -1)[keep]
        dirt = rng.uniform(points.min(0), points.max(0), (5, 2))
        order = rng.permutation(keep.sum() + 5)
        points = np.concatenate([points[keep], dirt])[order]
        shapes = np.concatenate([shapes[keep], shapes[:5] * rng.uniform(0.2, 2, (5, 1, 1))])[order]
        points = points + 0.1 * rng.standard_normal(points.shape)
        lattice = grow_lattice(points, shapes, cell=Cell(max(ratio, 1 / ratio), 0.0))
        true = order[lattice.index]
        real = true < keep.sum()
        placed = Lattice(*(getattr(lattice, f)[real] for f in ("index", "places")), *[None] * 4)  # type: ignore[arg-type]
        failures += not (agrees(placed, truth[true[real]]) and real.sum() == keep.sum())
        assert len(lattice.index) + len(lattice.unplaced) == len(points)
        assert len(lattice.reasons) == len(lattice.unplaced)
    assert failures == 0


def test_axes_turn_as_u_and_v_and_pitch_vectors_are_the_steps() -> None:
    points, shapes = seen(tilted_view(0.9, 0.4, 2.0, 1e-3) * [[20], [20], [1]], grid(6, 8), 1.2)
    lattice = grow_lattice(points, shapes)
    assert np.all(np.linalg.det(lattice.basis_px) > 0)
    where = {tuple(place): k for k, place in enumerate(lattice.places.tolist())}
    inner = [(i, j) for i, j in where if (i + 1, j) in where and (i - 1, j) in where]
    for i, j in inner:
        ahead, behind = lattice.index[where[i + 1, j]], lattice.index[where[i - 1, j]]
        step = (points[ahead] - points[behind]) / 2
        assert np.linalg.norm(lattice.basis_px[where[i, j], 0] - step) < 0.05 * np.linalg.norm(step)


def test_every_dot_left_out_has_its_reason() -> None:
    points, shapes = seen(np.diag([10.0, 10.0, 1.0]), grid(6, 6), 1.2)
    points[14] += [9.0, -8.0]
    extra = np.array([points[0] - [35.0, 10.0], points[7] + [5.0, 0.0]])
    lattice = grow_lattice(
        np.concatenate([points, extra]), np.concatenate([shapes, shapes[:2]]), floor_px=0.3
    )
    reasons = dict(zip(lattice.unplaced.tolist(), lattice.reasons))
    assert reasons == {14: OFF_PLACE, 36: NOT_ON_GRID, 37: SECOND_DOT}


def test_a_displaced_dot_within_the_print_tolerance_stays() -> None:
    points, shapes = seen(np.diag([10.0, 10.0, 1.0]), grid(6, 6), 1.2)
    points[14] += [0.2, 0.1]
    assert len(grow_lattice(points, shapes, floor_px=0.3).index) == 36


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_dots_are_an_error(count: int) -> None:
    points, shapes = seen(np.diag([10.0, 10.0, 1.0]), grid(1, max(count, 1)), 1.2)
    with pytest.raises(DetectionError, match="too few"):
        grow_lattice(points[:count], shapes[:count])


def test_dots_without_a_grid_are_an_error() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 1000, (12, 2))
    with pytest.raises(DetectionError, match="lie on a grid"):
        grow_lattice(points, np.broadcast_to(25 * np.eye(2), (12, 2, 2)))


def test_homography_and_affine_fits_recover_their_map() -> None:
    rng = np.random.default_rng(0)
    source = rng.uniform(-50, 50, (20, 2))
    homography = np.array([[9.0, 1.0, 400.0], [-2.0, 7.0, 300.0], [1e-3, -2e-3, 1.0]])
    found = fit_homography(source, apply_homography(homography, source))
    np.testing.assert_allclose(found / found[2, 2], homography, rtol=1e-6)
    homography[2] = [0, 0, 1]
    affine = fit_affine(source, apply_homography(homography, source))
    np.testing.assert_allclose(affine, homography, atol=1e-9)
