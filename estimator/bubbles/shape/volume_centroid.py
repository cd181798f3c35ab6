"""The centre of a bubble's volume from its two outlines.

An outline's centre is not the volume's: a third-degree shape mode of 5 % moves it by up to 4 % of
the radius. The outline's own third harmonics give part of that shift, see
docs/decisions/007-volume-centroid.md.

Two models take the third-degree part of the body (even degrees leave the outlines' centres where
the volume's is). `isotropic`: seven independent Gaussian coefficients; two views then determine the
shift along the coordinate they share and leave the others open. `zonal`: one mode, axisymmetric
about the axis of a spheroid; its one amplitude determines the whole shift.
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
    """What M pairs of outlines measure, relative to a point near the body.

    measured : (M, 8): pixel residuals of the first and the second view (2 + 2) and the coefficients
    of cos 3 phi, sin 3 phi in both (2 + 2); noise : (M, 8, 8).  jacobian : (M, 8, 3) by the point
    (zero for the coefficients).  axes_px : two (M, 2, 2) semi-axes.  sigma : (M,) prior standard
    deviation of each coefficient of degree 3 (of unit mean square).  conversion_px : (M, 4) what
    the pixel residuals hold beside the ellipses' centres; across_px : two (M, 2), the images of
    motions across the shared coordinate, shared_px : two (M, 2), along it.
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
        """(M, 4): the conversion's part that leaves the shared coordinate as it is."""
        parts = []
        for c, (across, shared) in enumerate(zip(self.across_px, self.shared_px)):
            basis = np.stack([across, shared], -1)
            share = np.linalg.solve(basis, self.conversion_px[:, 2 * c : 2 * c + 2, None])
            parts.append(share[:, 0] * across)
        return np.concatenate(parts, -1)


@dataclass(frozen=True)
class Estimate:
    """The centres of volume of the M bubbles in `Views`, estimated under one model of the shape.

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
    """frames : two (M, 3, 2), `EllipsePair.frames` of an ellipsoid that fits the outlines.

    Across the shared coordinate, where this model has no information, the ellipses' centres are
    kept as they are: to re-express them gains 1 % on average and loses 40 % for some modes.
    """
    effect = third_degree_effect(views.axes_px, frames)
    answer = _estimate(views, views.sigma[:, None, None] ** 2 * effect @ _t(effect))
    blind, jacobian = views.blind_px(), views.jacobian[:, :4]
    back = np.linalg.solve(_t(jacobian) @ jacobian, _t(jacobian) @ blind[..., None])[..., 0]
    return replace(answer, step_mm=answer.step_mm - back, shift_px=answer.shift_px + blind)


def zonal(views: Views, projections: tuple[Array, Array], axis_sigma: Array) -> Estimate:
    """The amplitude has the prior of `isotropic`'s root mean square: 7 sigma.

    projections : two (M, 2), where the pole appears in the outlines' unit circles.
    axis_sigma : (M,) their uncertainty.
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
    """(M, 3, 3) of the outlines' centres taken for the volume's, the shape's share included.

    noise : (M, 4, 4) and jacobian : (M, 4, 3) of the pixels.
    """
    weighted = _t(jacobian) @ np.linalg.inv(noise)
    gain = np.asarray(np.linalg.solve(weighted @ jacobian, weighted))
    by_shape = np.asarray(gain @ (sigma * third_degree_effect(axes_px, frames)[:, :4]))
    return np.asarray(gain @ noise @ _t(gain) + by_shape @ _t(by_shape))


def combine(estimates: list[Estimate], prior: Array) -> tuple[Estimate, Array]:
    """Mean of K estimates by their posterior probabilities, and these (K, M); prior (K, M)."""
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
    """(M, 8, 7): what is measured, by the coefficients of degree 3."""
    traces = [silhouette.third_degree_traces(f) for f in frames]
    pixels = [axes @ first for axes, (first, _) in zip(axes_px, traces)]
    return np.concatenate([*pixels, traces[0][1], traces[1][1]], -2)


def _zonal_effect(axes_px: tuple[Array, Array], projections: tuple[Array, Array]) -> Array:
    """(M, 8): what is measured, by the zonal amplitude."""
    traces = [silhouette.zonal_traces(q) for q in projections]
    pixels = [(axes @ first[..., None])[..., 0] for axes, (first, _) in zip(axes_px, traces)]
    return np.concatenate([*pixels, traces[0][1], traces[1][1]], -1)


def _estimate(views: Views, prior: Array) -> Estimate:
    """Generalised least squares for the point, the shape being noise of covariance prior."""
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

    uv_px : (M, 2), covariance_px2 : (M, 2, 2), of the ellipses' centres.  axes_px : (M, 2, 2),
    columns are the semi-axes.  trace : (M, 6) coefficients of cos and sin of 1, 3 and 4 phi of the
    radial displacement of the unit circle (semi-axes are 1), trace_covariance : (M, 6, 6); NaN
    where no harmonics are known.  located : (M,) centre and covariance are usable; shaped : axes
    are too; entire : and no flag says that part of the outline is missing; whole : and harmonics
    are usable.
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
        """Some of the rows."""
        return Outlines(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def outlines_from_table(table: pd.DataFrame, image_size_px: tuple[int, int]) -> Outlines:
    """A detection table's rows; missing columns and words that are no numbers count as unknown.

    So do centres farther out than the image is large, axes of a ratio above 20, and harmonics
    above 30 % of the smaller axis.
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
    """(M, 6, 8): radial harmonics on the unit circle from normal displacements in px.

    A displacement d along the ellipse's normal is d sqrt(b^2 cos^2 + a^2 sin^2) / (a b) along the
    radius of the circle, to first order.
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
    """M bubbles, rig frame.

    points_mm, covariance_mm2 : (M, 3), (M, 3, 3) centre of volume, with the share of the shape that
        two outlines leave open.
    silhouette_points_mm, silhouette_covariance_mm2 : maximum-likelihood point of the two outlines'
        centres, with the covariance of the outlines' noise alone.
    used : (M,) "volume": points_mm is corrected for the shape; "silhouettes": points_mm is
        silhouette_points_mm (harmonics unknown in a view, an outline that is hidden in part or
        leaves the image, or rays that pass farther apart than a bubble is large), covariance_mm2
        with the shape's share; "none": a centre or its covariance is missing, the row is NaN.
    du_px, dv_px : (M, 2) first and second camera: added to the outlines' centres they make them
        measurements of the projected centre of volume; 0 unless used is "volume".
    d_eq_mm, d_eq_sd_mm : (M,) diameter of the sphere of equal volume; semi_axes_mm : (M, 3),
        descending, of the most spherical ellipsoid with these outlines.  ray_miss_mm : (M,) of the
        outlines' centres.
    zonal_probability : (M,) that the third degree is axisymmetric about an oblate body's axis.
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
    """Centres of volume of M pairs of outlines, row i of one table matching row i of the other.

    shape_sigma : standard deviations of the shape's coefficients (harmonics of unit mean square,
    relative to the radius) of degree 3 and 4, one number for both; by default
    `estimate_shape_sigma` of these pairs.

    gap_sigma_px : how far the cameras' own motion or their calibration may part the two views
    along the shared coordinate; so much of the centres' difference says nothing of the shape.

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
    """(2,) standard deviations of the shape's coefficients of degree 3 and 4, learned from a run.

    Empirical Bayes: the mean square of the outlines' third and fourth harmonics, less their noise,
    with a little of `DEFAULT_SHAPE_SIGMA`. Raises InputError for tables of unequal length.
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
    """`estimate_shape_sigma` of outlines."""
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
    """(M,) one degree's sigma^2 from one outline each, unbiased with once the noise taken off."""
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
    """The outlines' centres triangulated."""
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
    """(M,) whether the triangulated point appears inside both outlines, as of one body."""
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
    """Sizes; the centres of volume, or else what the shape adds to the outlines' centres' error."""
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
    """Centres of volume: every shape model, weighted by its evidence."""
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
    """(M, 4, 4) of the two centres moved apart along the shared coordinate."""
    left, right = (image / np.linalg.norm(image, axis=-1, keepdims=True) for image in shared)
    apart = np.concatenate([left, -right], -1) / 2
    return gap_sigma_px**2 * apart[:, :, None] * apart[:, None, :]


@dataclass(frozen=True)
class _Ellipsoids:
    """The ellipsoids that M pairs of outlines allow.

    pair : their ellipses in mm.  moments_mm2, oblate_mm2 : (M, 3, 3) A A^T of the most spherical
    ellipsoid and of the nearest oblate spheroid; couplings : two (M,), theirs (`EllipsePair`);
    coupling_sigma : (M,) uncertainty of the first.  poles : two (M, 2), where the spheroid's pole
    appears in the outlines' unit circles.
    """

    pair: EllipsePair
    moments_mm2: Array
    oblate_mm2: Array
    couplings: tuple[Array, Array]
    coupling_sigma: Array
    poles: tuple[Array, Array]


def _ellipsoids(jacobians: tuple[Array, Array], axes_px: tuple[Array, Array]) -> _Ellipsoids:
    """jacobians : two (M, 2, 3), px per mm.  axes_px : two (M, 2, 2), columns are semi-axes."""
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
    """Two (M, 2): the first direction in the first view, the second in the second."""
    left, right = (
        (jacobian[:, 2 * c : 2 * c + 2] @ d[..., None])[..., 0] for c, d in enumerate(directions)
    )
    return left, right


def _measured(pair: tuple[Outlines, Outlines], pixels: Array) -> tuple[Array, Array, Array]:
    """`Views.measured`, `Views.noise`, and (M, 4) what was added to the ellipses' centres."""
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
    """(M,) each bubble's sigma of degree 3: the run's, as `_RUN_WEIGHT` harmonics, and its own.

    Mean of an inverse gamma distribution, so that the blind components are covered; less twice the
    noise, so that a bubble without shape is left alone.
    """
    own = np.sum([2 * _variance(o, 3, slice(2, 4), 2.0) for o in pair], 0)
    return np.asarray(np.sqrt((_RUN_WEIGHT * sigma**2 + np.maximum(own, 0)) / (_RUN_WEIGHT + 2)))


_RIM_EXCESS = (15.3, 37.4)
"""How much larger than the volume's the outlines' size is, over the variances of the shape's
coefficients of degree 3 and 4: a rim is where the body reaches farthest (decision 037)."""
_RUN_SHARE = 2.0  # harmonics' worth of the run's variances against a bubble's own four


def rim_excess(pair: tuple[Outlines, Outlines], sigma: Array) -> Array:
    """(M,) log of the outlines' size over the volume's, by the third and fourth harmonics.

    sigma : (2,) of the run. Its standard deviation is as large as itself. 0 where no harmonics are
    known.
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
    """(M,) volume's diameter and its standard deviation.

    Three things are open: the coupling of the viewing directions (the mean of the most spherical
    ellipsoid and the oblate spheroid is taken), the fourth degree's share of the ellipses, and the
    outlines' noise. The rims' excess is taken off.
    """
    logs = [np.log(np.linalg.det(m)) / 6 for m in (shapes.moments_mm2, shapes.oblate_mm2)]
    unseen = np.hypot((logs[1] - logs[0]) / 2, shapes.coupling_sigma**2 / np.sqrt(18))
    diameter = 2 * np.exp((logs[0] + logs[1]) / 2 - rim_excess(pair, sigma))
    relative2 = (
        unseen**2 + 0.8 * sigma[1] ** 2 + (30 * sigma[0] ** 2) ** 2 + _relative_noise2(pair) / 8
    )
    return diameter, diameter * np.sqrt(relative2)


def _axis_sigma(shapes: _Ellipsoids, pair: tuple[Outlines, Outlines], sigma: Array) -> Array:
    """(M,) how well a spheroid's axis is known: errors of the ellipses over its flatness."""
    squares = np.linalg.eigvalsh(shapes.oblate_mm2)
    flatness = 1 - squares[:, 0] / squares[:, 2]
    error2 = 4 * _relative_noise2(pair) + (6.7 * sigma[1]) ** 2 + (80 * sigma[0] ** 2) ** 2
    return np.asarray(np.clip(np.sqrt(error2) / (flatness + 1e-6), 0.01, 0.7))


def _relative_noise2(pair: tuple[Outlines, Outlines]) -> Array:
    noise2 = [np.trace(o.covariance_px2, axis1=1, axis2=2) / np.linalg.det(o.axes_px) for o in pair]
    return np.asarray(np.abs(np.sum(noise2, 0)))
