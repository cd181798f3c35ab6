"""Centre of volume of a bubble from its two outlines.

The centre of an outline is not the projected centre of volume: a third-degree shape mode of 5 % of
the radius moves it by up to 4 % of the radius. The third harmonics of the outlines determine part
of this displacement (docs/decisions/007-volume-centroid.md).

There are two models of the third-degree part of the shape; even degrees cause no displacement.
`isotropic` has seven independent Gaussian coefficients, and two views determine the displacement
along the shared coordinate only. `zonal` has one mode that is axisymmetric about the axis of a
spheroid, and its amplitude determines the whole displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    AXES_COLUMNS,
    CENTRE_COLUMNS,
    HARMONIC_COLUMNS,
    HARMONICS,
    centre_covariances,
    columns,
    flag_words,
)
from telerig.rig import silhouette
from telerig.rig.camera import Camera
from telerig.rig.silhouette import EllipsePair
from telerig.rig.triangulation import stacked_jacobian, triangulate


@dataclass(frozen=True)
class Views:
    """Measurements of M pairs of outlines, relative to a point near each body.

    measured : (M, 8) pixel residuals (u, v) of the first and of the second view, then the
        coefficients of cos 3 phi and sin 3 phi of both.
    noise : (M, 8, 8) covariance.
    jacobian : (M, 8, 3) derivative by the point (0 for the coefficients).
    axes_px : two (M, 2, 2) semi-axes.
    sigma : (M,) prior standard deviation of each coefficient of degree 3 (harmonics of unit mean
        square).
    conversion_px : (M, 4) the part of the pixel residuals that was added to the ellipses' centres.
    across_px : two (M, 2) images of a motion across the shared coordinate.
    shared_px : two (M, 2) images of a motion along it.
    """

    measured: Array
    noise: Array
    jacobian: Array
    axes_px: tuple[Array, Array]
    sigma: Array
    conversion_px: Array
    across_px: tuple[Array, Array]
    shared_px: tuple[Array, Array]

    def blind_px(self) -> Array:
        """Return the component (M, 4) of the conversion across the shared coordinate."""
        parts = []
        for c, (across, shared) in enumerate(zip(self.across_px, self.shared_px)):
            basis = np.stack([across, shared], -1)
            share = np.linalg.solve(basis, self.conversion_px[:, 2 * c : 2 * c + 2, None])
            parts.append(share[:, 0] * across)
        return np.concatenate(parts, -1)


@dataclass(frozen=True)
class Estimate:
    """Estimated centres of volume of the M bubbles of `Views` under one model of the shape.

    step_mm : (M, 3) from the point near each bubble to its centre of volume.
    covariance_mm2 : (M, 3, 3) covariance of the step.
    shift_px : (M, 4) expected displacement of the outline's centre from the projected centre of
        volume: (u, v) in the first view, then in the second.
    log_evidence : (M,) logarithm of the model's probability density for the data, comparable
        between estimates from the same `Views`.
    """

    step_mm: Array
    covariance_mm2: Array
    shift_px: Array
    log_evidence: Array


def isotropic(views: Views, frames: tuple[Array, Array]) -> Estimate:
    """Estimate the centres of volume with independent coefficients of degree 3.

    Across the shared coordinate, about which this model has no information, the ellipses' centres
    are kept: to correct them gains 1 % on average and loses 40 % for some modes.

    frames : two (M, 3, 2), `EllipsePair.frames` of an ellipsoid with these outlines.
    """
    effect = third_degree_effect(views.axes_px, frames)
    answer = _estimate(views, views.sigma[:, None, None] ** 2 * effect @ _t(effect))
    blind, jacobian = views.blind_px(), views.jacobian[:, :4]
    back = np.linalg.solve(_t(jacobian) @ jacobian, _t(jacobian) @ blind[..., None])[..., 0]
    return replace(answer, step_mm=answer.step_mm - back, shift_px=answer.shift_px + blind)


def zonal(views: Views, projections: tuple[Array, Array], axis_sigma: Array) -> Estimate:
    """Estimate the centres of volume with one axisymmetric mode of degree 3.

    Its prior standard deviation is 7 sigma, with the same expected square as in `isotropic`.

    projections : two (M, 2) positions of the pole in the outlines' unit circles.
    axis_sigma : (M,) their standard deviation.
    """
    effect = _zonal_effect(views.axes_px, projections)[..., None]
    prior = effect @ _t(effect)
    for view in range(2):
        for direction in np.eye(2):
            moved = list(projections)
            moved[view] = projections[view] + axis_sigma[:, None] * direction
            change = _zonal_effect(views.axes_px, (moved[0], moved[1]))[..., None] - effect
            prior = prior + change @ _t(change)
    return _estimate(views, (7 * views.sigma[:, None, None]) ** 2 * prior)


def uncorrected_covariance(
    noise: Array,
    jacobian: Array,
    axes_px: tuple[Array, Array],
    frames: tuple[Array, Array],
    sigma: float,
) -> Array:
    """Return the covariance (M, 3, 3) of uncorrected centres, displacement by the shape included.

    noise, jacobian : (M, 4, 4) and (M, 4, 3) of the pixels.
    axes_px, frames, sigma : as in `Views` and `isotropic`.
    """
    weighted = _t(jacobian) @ np.linalg.inv(noise)
    gain = np.asarray(np.linalg.solve(weighted @ jacobian, weighted))
    by_shape = np.asarray(gain @ (sigma * third_degree_effect(axes_px, frames)[:, :4]))
    return np.asarray(gain @ noise @ _t(gain) + by_shape @ _t(by_shape))


def combine(estimates: list[Estimate], prior: Array) -> tuple[Estimate, Array]:
    """Return the mean of K estimates, weighted by posterior probability, and the weights (K, M).

    prior : (K, M) prior probabilities of the models.
    """
    log_weight = np.stack([a.log_evidence for a in estimates]) + np.log(prior)
    top = log_weight.max(0)
    weight = np.exp(log_weight - top)
    total = weight.sum(0)
    weight /= total
    steps = np.stack([a.step_mm for a in estimates])
    step = (weight[..., None] * steps).sum(0)
    apart = steps - step
    second = (
        np.stack([a.covariance_mm2 for a in estimates]) + apart[..., None] * apart[..., None, :]
    )
    covariance = (weight[..., None, None] * second).sum(0)
    shift = (weight[..., None] * np.stack([a.shift_px for a in estimates])).sum(0)
    return Estimate(step, covariance, shift, top + np.log(total)), weight


def third_degree_effect(axes_px: tuple[Array, Array], frames: tuple[Array, Array]) -> Array:
    """Return the derivative (M, 8, 7) of `Views.measured` by the coefficients of degree 3."""
    traces = [silhouette.third_degree_traces(f) for f in frames]
    pixels = [axes @ first for axes, (first, _) in zip(axes_px, traces)]
    return np.concatenate([*pixels, traces[0][1], traces[1][1]], -2)


def _zonal_effect(axes_px: tuple[Array, Array], projections: tuple[Array, Array]) -> Array:
    """Return the derivative (M, 8) of `Views.measured` by the zonal amplitude."""
    traces = [silhouette.zonal_traces(q) for q in projections]
    pixels = [(axes @ first[..., None])[..., 0] for axes, (first, _) in zip(axes_px, traces)]
    return np.concatenate([*pixels, traces[0][1], traces[1][1]], -1)


def _estimate(views: Views, prior: Array) -> Estimate:
    """Estimate points by generalised least squares.

    prior : (M, 8, 8) covariance that the shape adds to the noise.
    """
    total = views.noise + prior
    inverse = np.linalg.inv(total)
    weighted = _t(views.jacobian) @ inverse
    normal = weighted @ views.jacobian
    covariance = np.asarray(np.linalg.inv(normal))
    step = _mv(covariance @ weighted, views.measured)
    misfit = _mv(inverse, views.measured) - _mv(_t(weighted), step)
    log_det = -np.linalg.slogdet(total)[1] - np.linalg.slogdet(normal)[1]
    log_evidence = 0.5 * (log_det - (views.measured * misfit).sum(-1))
    return Estimate(step, covariance, _mv(prior, misfit)[:, :4], log_evidence)


def _t(matrix: NDArray[Any]) -> Array:
    return np.swapaxes(matrix, -1, -2)


def _mv(matrix: NDArray[Any], vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


_SAMPLES = 32
_LEAST_PX2 = 1e-12
_FLOOR_PX2 = 1e-6  # no outline is known better; keeps the algebra regular
_BLOCKING = ("border", "overlap", "merged")
_TRACE_ORDERS = (1, 3, 4)


@dataclass(frozen=True)
class Outlines:
    """M outlines of one camera.

    uv_px : (M, 2) centres of the ellipses.
    covariance_px2 : (M, 2, 2) of the centres.
    axes_px : (M, 2, 2) whose columns are the semi-axes.
    trace : (M, 6) coefficients of cos and sin of 1, 3 and 4 phi of the radial displacement of the
        unit circle (relative to the semi-axes); NaN if unknown.
    trace_covariance : (M, 6, 6).
    located : (M,) whether centre and covariance are usable.
    shaped : (M,) and the axes, too.
    entire : (M,) and no flag says that part of the outline is missing.
    whole : (M,) and the harmonics are usable.
    """

    uv_px: Array
    covariance_px2: Array
    axes_px: Array
    trace: Array
    trace_covariance: Array
    located: Bools
    shaped: Bools
    entire: Bools
    whole: Bools

    def rows(self, keep: Bools) -> Outlines:
        """Return some of the outlines; keep : (M,) booleans or indices."""
        return Outlines(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def outlines_from_table(table: pd.DataFrame, image_size_px: tuple[int, int]) -> Outlines:
    """Return the outlines of a detection table.

    Values that are missing or not numbers count as unknown. So do centres far outside the image,
    axes with a ratio above 20, and harmonics above 30 % of the smaller axis.

    image_size_px : width and height.
    """
    uv, covariance = columns(table, CENTRE_COLUMNS), centre_covariances(table)
    suu, suv, svv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    size = np.asarray(image_size_px, float)
    located = (np.abs(uv - size / 2) < 1.5 * size).all(-1)
    located &= np.isfinite(suu) & np.isfinite(svv) & (suu > _LEAST_PX2) & (svv > _LEAST_PX2)
    located &= suu * svv - suv**2 > 1e-6 * suu * svv
    a, b, angle = columns(table, AXES_COLUMNS).T
    shaped = located & np.isfinite(angle) & np.isfinite(a) & (b > 0.05 * a) & (a >= b)
    rotation = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1)
    axes = rotation.reshape(-1, 2, 2) * np.stack([a, b], -1)[:, None, :]
    displacement = columns(table, HARMONIC_COLUMNS)
    sigma = columns(table, ["sigma_outline_px"])[:, 0]
    known = (np.abs(displacement) < 0.3 * b[:, None]).all(-1)
    known &= (sigma**2 > _LEAST_PX2) & (sigma < b)
    blocked = np.array([any(word in _BLOCKING for word in row) for row in flag_words(table)], bool)
    gain = _trace_from_displacement(*(np.where(shaped, axis, np.nan) for axis in (a, b)))
    return Outlines(
        uv,
        covariance + _FLOOR_PX2 * np.eye(2),
        axes,
        np.einsum("mij,mj->mi", gain, displacement),
        gain @ np.swapaxes(gain, -1, -2) * (sigma**2 + _FLOOR_PX2)[:, None, None],
        located,
        shaped,
        shaped & ~blocked,
        shaped & known & ~blocked,
    )


def _trace_from_displacement(a_px: Array, b_px: Array) -> Array:
    """Return the matrix (M, 6, 8) from normal displacements (px) to radial harmonics of the unit
    circle.

    To first order, a displacement d along the ellipse's normal is d sqrt(b^2 cos^2 + a^2 sin^2) /
    (a b) along the radius of the circle.
    """
    phi = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    inward = np.stack([f(k * phi) for k in HARMONICS for f in (np.cos, np.sin)])
    outward = np.stack([f(k * phi) for k in _TRACE_ORDERS for f in (np.cos, np.sin)])
    weights = (2 / _SAMPLES * outward[:, None] * inward[None]).reshape(-1, _SAMPLES)
    speed = np.hypot(np.outer(b_px, np.cos(phi)), np.outer(a_px, np.sin(phi)))
    factor = speed / (a_px * b_px)[:, None]
    return np.asarray((factor @ weights.T).reshape(-1, len(outward), len(inward)))


DEFAULT_SHAPE_SIGMA = (0.005, 0.004)
_ZONAL_SHARE = 0.2  # prior probability of a shape that is axisymmetric about the spheroid's axis
_KNOWN_AXIS = 0.15  # rad: beyond this uncertainty of the axis that shape model is left out
_RUN_WEIGHT = 4.0  # harmonics' worth of the run's shape_sigma against a bubble's own four
_DEFAULT_WEIGHT = 0.05  # in bubbles, of DEFAULT_SHAPE_SIGMA in what a run learns
_LARGEST_SIGMA = 0.03  # one bubble's share in what a run learns
_MODEL_ERROR, _CROSS_TERM = 0.02, 8.0  # second order: of the third harmonic, times the fourth
_LEAST_COUPLING, _LARGEST_COUPLING = 0.01, 0.9


@dataclass(frozen=True)
class Bodies:
    """Centres of volume and sizes of M bubbles in the rig frame.

    points_mm, covariance_mm2 : (M, 3), (M, 3, 3) centre of volume; the covariance includes the part
        of the shape that two outlines do not determine.
    silhouette_points_mm, silhouette_covariance_mm2 : (M, 3), (M, 3, 3) triangulated centres of the
        outlines, with the covariance of the outlines' noise alone.
    used : (M,) "volume": points_mm is corrected for the shape. "silhouettes": points_mm is
        silhouette_points_mm, because harmonics are unknown, an outline is incomplete, or the rays
        pass farther apart than the bubble is large. "none": a centre or its covariance is missing,
        and the row is NaN.
    du_px, dv_px : (M, 2) in the first and the second camera: the projected centre of volume minus
        the outline's centre; 0 unless used is "volume".
    d_eq_mm, d_eq_sd_mm : (M,) diameter of the sphere of equal volume.
    semi_axes_mm : (M, 3), descending, of the most spherical ellipsoid with these outlines.
    ray_miss_mm : (M,) of the outlines' centres.
    zonal_probability : (M,) posterior probability of the model `zonal`.
    """

    points_mm: Array
    covariance_mm2: Array
    silhouette_points_mm: Array
    silhouette_covariance_mm2: Array
    used: NDArray[np.str_]
    du_px: Array
    dv_px: Array
    d_eq_mm: Array
    d_eq_sd_mm: Array
    semi_axes_mm: Array
    ray_miss_mm: Array
    zonal_probability: Array


def fit_bodies(
    first: pd.DataFrame,
    second: pd.DataFrame,
    cameras: tuple[Camera, Camera],
    *,
    shape_sigma: ArrayLike | None = None,
    gap_sigma_px: float = 0.0,
) -> Bodies:
    """Estimate centres of volume and sizes from M pairs of outlines.

    first, second : detection tables of M rows; row i of both is one bubble.
    shape_sigma : prior standard deviation of the shape's coefficients of degree 3 and 4 (harmonics
        of unit mean square, relative to the radius), or one number for both. By default
        `estimate_shape_sigma` of these pairs.
    gap_sigma_px : standard deviation of the difference between the two views along the shared
        coordinate that shake or calibration errors can cause, and not the shape.

    Raises InputError for tables of unequal length or a shape_sigma that is not positive.
    """
    outlines = _paired(first, second, cameras)
    sigma = learned_sigma(outlines) if shape_sigma is None else _checked_sigma(shape_sigma)
    located = outlines[0].located & outlines[1].located
    bodies = _empty(len(located))
    _fill_points(bodies, outlines, cameras, located)
    located = bodies.used == "silhouettes"
    shaped = located & outlines[0].shaped & outlines[1].shaped
    shaped[shaped] = _inside_both(bodies.silhouette_points_mm[shaped], outlines, cameras, shaped)
    whole = shaped & outlines[0].whole & outlines[1].whole
    for rows, correct in ((whole, True), (shaped & ~whole, False)):
        if np.any(rows):
            pair = (outlines[0].rows(rows), outlines[1].rows(rows))
            at = np.flatnonzero(rows)
            _fill_shapes(bodies, pair, cameras, at, sigma, gap_sigma_px, correct=correct)
    return bodies


def estimate_shape_sigma(
    first: pd.DataFrame, second: pd.DataFrame, cameras: tuple[Camera, Camera]
) -> Array:
    """Estimate the standard deviations (2,) of the shape's coefficients of degree 3 and 4 from a
    run.

    Empirical Bayes: the mean square of the outlines' third and fourth harmonics minus their noise,
    with `DEFAULT_SHAPE_SIGMA` as a weak prior.

    first, second : detection tables; row i of both is one bubble.

    Raises InputError for tables of unequal length.
    """
    return learned_sigma(_paired(first, second, cameras))


def _paired(
    first: pd.DataFrame, second: pd.DataFrame, cameras: tuple[Camera, Camera]
) -> tuple[Outlines, Outlines]:
    if len(first) != len(second):
        raise InputError(
            f"{len(first)} bubble outlines in the first camera, but {len(second)} in the second",
            todo="row i of one table must be the same bubble as row i of the other",
        )
    left, right = (
        outlines_from_table(table, camera.image_size_px)
        for table, camera in zip((first, second), cameras)
    )
    return left, right


def _checked_sigma(shape_sigma: ArrayLike) -> Array:
    sigma = np.asarray(shape_sigma, float)
    if sigma.shape not in ((), (2,)) or not np.all(np.isfinite(sigma) & (sigma > 0)):
        raise InputError(
            f"shape_sigma {shape_sigma!r}: one positive number, or one each for degree 3 and 4",
            todo="give the shape's rms relative to the radius divided by 2.6, for instance 0.005",
        )
    return np.broadcast_to(sigma, (2,))


def learned_sigma(outlines: tuple[Outlines, Outlines]) -> Array:
    """Return `estimate_shape_sigma` for two sets of outlines."""
    whole = outlines[0].whole & outlines[1].whole
    out = []
    for degree, part, default in zip((3, 4), (slice(2, 4), slice(4, 6)), DEFAULT_SHAPE_SIGMA):
        variance = np.mean([_variance(o.rows(whole), degree, part) for o in outlines], 0)
        variance = np.minimum(variance, _LARGEST_SIGMA**2)
        out.append(
            np.sqrt(
                (max(variance.sum(), 0.0) + _DEFAULT_WEIGHT * default**2)
                / (len(variance) + _DEFAULT_WEIGHT)
            )
        )
    return np.array(out)


def _variance(outlines: Outlines, degree: int, part: slice, less: float = 1.0) -> Array:
    """Return an estimate (M,) of one degree's sigma^2 from each outline alone.

    less : how often the variance of the noise is subtracted; unbiased for 1.
    """
    noise = np.einsum("mii->m", outlines.trace_covariance[:, part, part])
    power = (outlines.trace[:, part] ** 2).sum(-1) - less * noise
    return np.asarray(power / (2 * silhouette.TRACE_VARIANCE[degree, degree]))


def _empty(count: int) -> Bodies:
    def nan(*shape: int) -> Array:
        return np.full((count, *shape), np.nan)

    return Bodies(
        nan(3), nan(3, 3), nan(3), nan(3, 3), np.full(count, "none", "<U11"),
        np.zeros((count, 2)), np.zeros((count, 2)), nan(), nan(), nan(3), nan(), nan(),
    )  # fmt: skip


def _fill_points(
    bodies: Bodies,
    outlines: tuple[Outlines, Outlines],
    cameras: tuple[Camera, Camera],
    rows: Bools,
) -> None:
    """Fill in the triangulated centres of the outlines."""
    pair = [o.rows(rows) for o in outlines]
    found = triangulate(
        cameras, (pair[0].uv_px, pair[1].uv_px), (pair[0].covariance_px2, pair[1].covariance_px2)
    )
    for points in (bodies.points_mm, bodies.silhouette_points_mm):
        points[rows] = found.points_mm
    for covariance in (bodies.covariance_mm2, bodies.silhouette_covariance_mm2):
        covariance[rows] = found.covariance_mm2
    bodies.ray_miss_mm[rows] = found.ray_miss_mm
    bodies.used[np.isfinite(bodies.covariance_mm2).all((1, 2))] = "silhouettes"


def _inside_both(
    points_mm: Array,
    outlines: tuple[Outlines, Outlines],
    cameras: tuple[Camera, Camera],
    rows: Bools,
) -> Bools:
    """Return whether (M,) the triangulated point lies inside both outlines."""
    pixels, _ = stacked_jacobian(cameras, points_mm)
    pair = [o.rows(rows) for o in outlines]
    gap = np.concatenate([o.uv_px for o in pair], -1) - pixels
    extent = np.minimum(*(np.linalg.norm(o.axes_px, axis=1).max(-1) for o in pair))
    return np.asarray((np.abs(gap) < extent[:, None]).all(-1))


def _fill_shapes(
    bodies: Bodies,
    pair: tuple[Outlines, Outlines],
    cameras: tuple[Camera, Camera],
    rows: Ints,
    sigma: Array,
    gap_sigma_px: float,
    *,
    correct: bool,
) -> None:
    """Fill in the sizes, and either corrected centres or the covariance of uncorrected ones."""
    pixels, jacobian = stacked_jacobian(cameras, bodies.silhouette_points_mm[rows])
    axes_px = (pair[0].axes_px, pair[1].axes_px)
    shapes = _ellipsoids((jacobian[:, :2], jacobian[:, 2:]), axes_px)
    squares = np.linalg.eigvalsh(shapes.moments_mm2)
    bodies.semi_axes_mm[rows] = np.sqrt(squares[:, ::-1])
    bodies.d_eq_mm[rows], bodies.d_eq_sd_mm[rows] = _diameter(shapes, pair, sigma)
    if correct:
        _correct(bodies, pair, shapes, pixels, jacobian, rows, sigma, gap_sigma_px)
    else:
        bodies.covariance_mm2[rows] = uncorrected_covariance(
            _pixel_noise(pair), jacobian, axes_px, shapes.pair.frames(shapes.couplings[0]), sigma[0]
        )


def _correct(
    bodies: Bodies,
    pair: tuple[Outlines, Outlines],
    shapes: _Ellipsoids,
    pixels: Array,
    jacobian: Array,
    rows: Ints,
    sigma: Array,
    gap_sigma_px: float,
) -> None:
    """Fill in centres of volume: the mean over the shape models by their evidence."""
    measured, noise, conversion = _measured(pair, pixels)
    shared = _images(jacobian, (shapes.pair.shared, shapes.pair.shared))
    noise[:, :4, :4] += _gap_covariance(shared, gap_sigma_px)
    slope = np.concatenate([jacobian, np.zeros_like(jacobian)], 1)
    views = Views(
        measured,
        noise,
        slope,
        (pair[0].axes_px, pair[1].axes_px),
        _own_sigma(pair, sigma[0]),
        conversion,
        _images(jacobian, shapes.pair.sides),
        shared,
    )
    axis_sigma = _axis_sigma(shapes, pair, sigma)
    estimates = [isotropic(views, shapes.pair.frames(c)) for c in shapes.couplings]
    estimates.append(zonal(views, shapes.poles, axis_sigma))
    zonal_share = np.where(axis_sigma < _KNOWN_AXIS, _ZONAL_SHARE, 1e-9)
    prior = np.stack([(1 - zonal_share) * 0.5, (1 - zonal_share) * 0.5, zonal_share])
    answer, weight = combine(estimates, prior)
    correction = conversion - answer.shift_px
    bodies.points_mm[rows] = bodies.silhouette_points_mm[rows] + answer.step_mm
    bodies.covariance_mm2[rows] = answer.covariance_mm2
    bodies.du_px[rows], bodies.dv_px[rows] = correction[:, 0::2], correction[:, 1::2]
    bodies.used[rows] = "volume"
    bodies.zonal_probability[rows] = weight[-1]


def _gap_covariance(shared: tuple[Array, Array], gap_sigma_px: float) -> Array:
    """Return the covariance (M, 4, 4) of a difference of the two centres along the shared
    coordinate.
    """
    left, right = (image / np.linalg.norm(image, axis=-1, keepdims=True) for image in shared)
    apart = np.concatenate([left, -right], -1) / 2
    return gap_sigma_px**2 * apart[:, :, None] * apart[:, None, :]


@dataclass(frozen=True)
class _Ellipsoids:
    """Ellipsoids with the outlines of M pairs.

    pair : their ellipses in mm.
    moments_mm2 : (M, 3, 3) A A^T of the most spherical ellipsoid.
    oblate_mm2 : (M, 3, 3) A A^T of the nearest oblate spheroid.
    couplings : two (M,), those of both bodies (see `EllipsePair`).
    coupling_sigma : (M,) standard deviation of the first.
    poles : two (M, 2) positions of the spheroid's pole in the outlines' unit circles.
    """

    pair: EllipsePair
    moments_mm2: Array
    oblate_mm2: Array
    couplings: tuple[Array, Array]
    coupling_sigma: Array
    poles: tuple[Array, Array]


def _ellipsoids(jacobians: tuple[Array, Array], axes_px: tuple[Array, Array]) -> _Ellipsoids:
    """Return the ellipsoids; jacobians : two (M, 2, 3), px per mm; axes_px : two (M, 2, 2)."""
    pair = silhouette.ellipse_pair(jacobians, axes_px)
    moments = silhouette.most_spherical(pair)
    pole, oblate = silhouette.oblate_spheroid(pair)
    poles = [
        np.asarray(np.linalg.solve(a, j @ pole[..., None])[..., 0])
        for a, j in zip(axes_px, jacobians)
    ]
    # The coupling is as large as the four like numbers of the anisotropy that are seen.
    logs = np.log(np.linalg.eigvalsh(moments))
    seen = ((logs - logs.mean(-1, keepdims=True)) ** 2).sum(-1)
    round_, flat = (
        np.clip(pair.coupling_of(m), -_LARGEST_COUPLING, _LARGEST_COUPLING)
        for m in (moments, oblate)
    )
    sigma = np.sqrt(seen / 8 + _LEAST_COUPLING**2)
    return _Ellipsoids(pair, moments, oblate, (round_, flat), sigma, (poles[0], poles[1]))


def _images(jacobian: Array, directions: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the images (M, 2) of one direction in each view."""
    left, right = (
        (jacobian[:, 2 * c : 2 * c + 2] @ d[..., None])[..., 0] for c, d in enumerate(directions)
    )
    return left, right


def _measured(pair: tuple[Outlines, Outlines], pixels: Array) -> tuple[Array, Array, Array]:
    """Return `Views.measured`, `Views.noise` and `Views.conversion_px`."""
    count = len(pixels)
    measured, noise = np.zeros((count, 8)), np.zeros((count, 8, 8))
    conversion = np.zeros((count, 4))
    third2 = np.mean([(o.trace[:, 2:4] ** 2).mean(-1) for o in pair], 0)
    fourth2 = np.mean([(o.trace[:, 4:] ** 2).mean(-1) for o in pair], 0)
    second_order2 = third2 * (_MODEL_ERROR**2 + _CROSS_TERM**2 * fourth2)
    for c, outlines in enumerate(pair):
        pixel, third = slice(2 * c, 2 * c + 2), slice(4 + 2 * c, 6 + 2 * c)
        mix = np.zeros((count, 4, 4))
        mix[:, :2, :2], mix[:, 2:, 2:] = outlines.axes_px, np.eye(2)
        error = outlines.trace_covariance[:, :4, :4]
        error = error + second_order2[:, None, None] * np.eye(4)
        error = mix @ error @ np.swapaxes(mix, -1, -2)
        error[:, :2, :2] += outlines.covariance_px2
        conversion[:, pixel] = np.einsum("mij,mj->mi", outlines.axes_px, outlines.trace[:, :2])
        measured[:, pixel] = outlines.uv_px + conversion[:, pixel] - pixels[:, pixel]
        measured[:, third] = outlines.trace[:, 2:4]
        noise[:, pixel, pixel], noise[:, third, third] = error[:, :2, :2], error[:, 2:, 2:]
        noise[:, pixel, third], noise[:, third, pixel] = error[:, :2, 2:], error[:, 2:, :2]
    return measured, noise, conversion


def _pixel_noise(pair: tuple[Outlines, Outlines]) -> Array:
    noise = np.zeros((len(pair[0].uv_px), 4, 4))
    noise[:, :2, :2], noise[:, 2:, 2:] = pair[0].covariance_px2, pair[1].covariance_px2
    return noise


def _own_sigma(pair: tuple[Outlines, Outlines], sigma: float) -> Array:
    """Return each bubble's sigma of degree 3 (M,), from its own harmonics and the run's value.

    It is the mean of an inverse gamma distribution, which allows for unobserved components. Twice
    the noise is subtracted, so that a bubble without harmonics is not corrected.
    """
    own = np.sum([2 * _variance(o, 3, slice(2, 4), 2.0) for o in pair], 0)
    return np.asarray(np.sqrt((_RUN_WEIGHT * sigma**2 + np.maximum(own, 0)) / (_RUN_WEIGHT + 2)))


_RIM_EXCESS = (15.3, 37.4)
"""How much larger than the volume's the outlines' size is, over the variances of the shape's
coefficients of degree 3 and 4: a rim is where the body reaches farthest (decision 037)."""
_RUN_SHARE = 2.0  # harmonics' worth of the run's variances against a bubble's own four


def rim_excess(pair: tuple[Outlines, Outlines], sigma: Array) -> Array:
    """Return by how much the outlines of M bubbles exceed the size of their volumes.

    The result (M,) is the logarithm of the diameter from the outlines over the volume-equivalent
    diameter. It grows with the body's modes of degree 3 and 4, because an outline is where the body
    reaches farthest. The result's standard deviation is as large as the result. It is 0 for
    outlines that are not whole.

    pair : the outlines in both views.
    sigma : (2,) standard deviations of the shapes' coefficients of degree 3 and 4 in the run.
    """
    excess = np.zeros(len(pair[0].uv_px))
    whole = pair[0].whole & pair[1].whole
    for k, part, factor in zip(range(2), (slice(2, 4), slice(4, 6)), _RIM_EXCESS):
        own = np.sum([2 * _variance(o, 3 + k, part) for o in pair], 0)
        variance = (_RUN_SHARE * sigma[k] ** 2 + own) / (_RUN_SHARE + 4)
        excess += factor * np.where(whole, np.maximum(variance, 0), 0.0)
    return excess


def _diameter(
    shapes: _Ellipsoids, pair: tuple[Outlines, Outlines], sigma: Array
) -> tuple[Array, Array]:
    """Return the equivalent diameter (M,) and its standard deviation, in mm.

    The standard deviation includes three contributions: the coupling of the viewing directions (for
    which the mean of the most spherical ellipsoid and the oblate spheroid is taken), modes of
    degree 4, and the outlines' noise. The excess of the rims is subtracted.
    """
    logs = [np.log(np.linalg.det(m)) / 6 for m in (shapes.moments_mm2, shapes.oblate_mm2)]
    unseen = np.hypot((logs[1] - logs[0]) / 2, shapes.coupling_sigma**2 / np.sqrt(18))
    diameter = 2 * np.exp((logs[0] + logs[1]) / 2 - rim_excess(pair, sigma))
    relative2 = (
        unseen**2 + 0.8 * sigma[1] ** 2 + (30 * sigma[0] ** 2) ** 2 + _relative_noise2(pair) / 8
    )
    return diameter, diameter * np.sqrt(relative2)


def _axis_sigma(shapes: _Ellipsoids, pair: tuple[Outlines, Outlines], sigma: Array) -> Array:
    """Return the sd (M,) of a spheroid's axis: relative errors of the ellipses over its
    flatness."""
    squares = np.linalg.eigvalsh(shapes.oblate_mm2)
    flatness = 1 - squares[:, 0] / squares[:, 2]
    error2 = 4 * _relative_noise2(pair) + (6.7 * sigma[1]) ** 2 + (80 * sigma[0] ** 2) ** 2
    return np.asarray(np.clip(np.sqrt(error2) / (flatness + 1e-6), 0.01, 0.7))


def _relative_noise2(pair: tuple[Outlines, Outlines]) -> Array:
    noise2 = [np.trace(o.covariance_px2, axis1=1, axis2=2) / np.linalg.det(o.axes_px) for o in pair]
    return np.asarray(np.abs(np.sum(noise2, 0)))
