"""The outlines of bodies that the same cameras see, ready for a fit.

An outline that is mapped to the unit circle by the axes of its ellipse deviates from another
ellipse by a radial displacement g0 + g1 cos 2 phi + g2 sin 2 phi. White noise along the outline
gives g1 and g2 the same variance v, and g0 half of it; v follows from the covariance of the centre,
which is of order 1. Modes of degree 4 of the body add more, in all views together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.bubbles.shape.sightings import Sightings
from telerig.rig import silhouette
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian, triangulate_views

_PIECE = 20_000
_CONTRADICTION = 6.3e-5
"""Probability (two-sided, of 4 sd) below which outlines contradict each other."""
_COVERED_SD, _UNKNOWN_SD = 0.1, 30.0
"""Standard deviation of g1 of an outline of which a part is covered or outside the image, and of
one whose axes are unknown."""

_ROUND = np.array([0.5, 0.0, 0.0])
"""g of an outline that is the measured one."""
_WHITE = np.diag([0.5, 1.0, 1.0])
_CIRCLE = 5
"""Samples of a rim. Modes of degree 4 have the harmonics 0, 2 and 4, which these distinguish."""
_PHI = 2 * np.pi * np.arange(_CIRCLE) / _CIRCLE
_RIM = np.stack([np.cos(_PHI), np.sin(_PHI)])
_SECOND = np.stack([0.5 + 0 * _PHI, np.cos(2 * _PHI), np.sin(2 * _PHI)]) * 2 / _CIRCLE


def grouped(sightings: Sightings, seen: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Yield bodies that the same cameras see: their rows and the cameras, at least two."""
    there = (seen >= 0) & sightings.located[seen] if len(sightings) else seen >= 0
    kinds, kind = np.unique(there, axis=0, return_inverse=True)
    for k, pattern in enumerate(kinds):
        if pattern.sum() >= 2:
            rows = np.flatnonzero(kind.reshape(-1) == k)
            for piece in np.array_split(rows, -(-len(rows) // _PIECE)):
                yield piece, np.flatnonzero(pattern)


@dataclass(frozen=True)
class Views:
    """B bodies that the same n cameras see.

    sightings : (B, n).
    triangulated : points (B, 3), covariances (B, 3, 3), ray misses (B,) of the outlines' centres.
    pixels, jacobian : (B, n, 2), (B, n, 2, 3) projected points, and derivatives by the points.
    axes_px : (B, n, 2, 2) semi-axes; where they are unknown, those of a sphere of the same size.
    noise : (B, n) variances of g1.
    measure : (B, 3 n, 9) linear map from the moments of a body to g of all outlines, in the unit
        circles of the measured ones.
    """

    sightings: Sightings
    triangulated: tuple[Array, Array, Array]
    pixels: Array
    jacobian: Array
    axes_px: Array
    noise: Array
    measure: Array

    @staticmethod
    def of(sightings: Sightings, cameras: Sequence[Camera]) -> Views:
        """Triangulate the centres of outlines; sightings : (B, n) of n cameras."""
        count = len(cameras)
        found = triangulate_views(
            cameras,
            [sightings.uv_px[:, c] for c in range(count)],
            tuple(sightings.covariance_px2[:, c] for c in range(count)),
        )
        if count == 2:
            rays = [c.unproject(sightings.uv_px[:, i]) for i, c in enumerate(cameras)]
            miss = _signed_miss(rays)
        else:
            miss = np.sqrt((found.ray_miss_mm**2).mean(-1))
        uv, by_point = stacked_jacobian(tuple(cameras), found.points_mm)
        jacobian = by_point.reshape(-1, count, 2, 3)
        scale = np.linalg.det(jacobian @ jacobian.mT) ** 0.25
        shaped = sightings.shaped
        known = np.where(shaped[..., None, None], sightings.axes_px, np.eye(2))
        size = np.sqrt(np.abs(np.linalg.det(known))) / scale
        radius = np.where(shaped, size, 0.0).sum(-1) / np.maximum(shaped.sum(-1), 1)
        sphere = (np.maximum(radius, 1e-6)[:, None] * scale)[..., None, None] * np.eye(2)
        axes = np.where(shaped[..., None, None], known, sphere)
        back = np.linalg.inv(axes)
        noise = np.trace(back @ sightings.covariance_px2 @ back.mT, axis1=-2, axis2=-1) / 2
        noise = noise + np.where(sightings.entire, 0.0, _COVERED_SD**2)
        noise = noise + np.where(shaped, 0.0, _UNKNOWN_SD**2)
        u, v = np.moveaxis(back @ jacobian, -2, 0)
        uu, vv, uv_ = (p[..., :, None] * q[..., None, :] for p, q in ((u, u), (v, v), (u, v)))
        measure = np.stack([(uu + vv) / 4, (uu - vv) / 4, (uv_ + uv_.mT) / 4], 2)
        return Views(
            sightings,
            (found.points_mm, found.covariance_mm2, miss),
            uv.reshape(-1, count, 2),
            jacobian,
            axes,
            noise,
            measure.reshape(-1, 3 * count, 9),
        )

    def take(self, rows: NDArray[Any]) -> Views:
        """Return some of the bodies."""
        points, covariance, miss = self.triangulated
        others = (getattr(self, f.name)[rows] for f in fields(self)[2:])
        return Views(
            self.sightings.take(rows), (points[rows], covariance[rows], miss[rows]), *others
        )

    @property
    def count(self) -> int:
        """The number n of views."""
        return int(self.noise.shape[1])

    @property
    def round(self) -> Array:
        """g (3 n,) of all outlines for a body whose outlines are the measured ones."""
        return np.tile(_ROUND, self.count)

    def inside(self) -> Bools:
        """Return whether (B,) the triangulated point lies inside all outlines."""
        away = np.abs(self.sightings.uv_px - self.pixels).max((1, 2))
        return np.asarray(away < np.linalg.norm(self.axes_px, axis=2).max(-1).min(-1))

    @cached_property
    def free(self) -> tuple[Array, Array, Array]:
        """The ellipsoid that fits best: its moments (B, 3, 3).

        Of those that fit equally well the one of largest volume is taken. Also the directions
        (B, 3 n, k) of g that no ellipsoid explains, and the components (B, k) of the misfit there.
        """
        target = self.round
        if self.count == 2:
            moments, unseen = self._free_of_two()
        else:
            basis = silhouette.SYMMETRIC.reshape(6, 9).T
            left, values, right = np.linalg.svd(self.measure @ basis)
            unseen = left[..., 6:]
            fitted = (((left[..., :6].mT @ target) / values)[:, None] @ right)[:, 0]
            moments = (fitted @ basis.T).reshape(-1, 3, 3)
        return silhouette.proper(moments), unseen, (unseen.mT @ target)

    def _free_of_two(self) -> tuple[Array, Array]:
        """Return `free`'s moments and directions of two views.

        Neither sees the product of both lines of sight d; both see the extent along d1 x d2.
        """
        lines = np.cross(self.jacobian[:, :, 0], self.jacobian[:, :, 1])
        lines /= np.linalg.norm(lines, axis=-1, keepdims=True)
        shear = lines[:, 0, :, None] * lines[:, 1, None, :]
        shear = shear + shear.mT
        both = np.cross(lines[:, 0], lines[:, 1])[:, None, :, None]
        j = self.jacobian
        a, b = np.moveaxis(self.axes_px.mT @ np.linalg.solve(j @ j.mT, j @ both), -2, 0)[..., 0]
        extent = np.stack([a * a + b * b, a * a - b * b, 2 * a * b], -1) * [[1.0], [-1.0]]
        unseen = extent.reshape(-1, 6, 1) / np.linalg.norm(extent, axis=(1, 2))[:, None, None]
        basis = silhouette.SYMMETRIC.reshape(6, 9).T
        regular = self.measure @ basis + unseen * shear[:, *np.triu_indices(3)][:, None]
        fitted = np.linalg.solve(regular, self.round[:, None])[..., 0] @ basis.T
        return silhouette.largest(fitted.reshape(-1, 3, 3), shear), unseen

    @cached_property
    def shared(self) -> Array:
        """Covariance (B, 3 n, 3 n) of g by modes of degree 4 of the body, for excess = 1.

        By the addition theorem, 9 P4 of the cosine between the points of two rims.
        """
        rims = silhouette.rim_frames(self.free[0], self.jacobian, self.axes_px) @ _RIM
        points = rims.mT.reshape(len(rims), -1, 3)
        x2 = (points @ points.mT) ** 2
        legendre = (35 * x2**2 - 30 * x2 + 3) / 8
        n = self.count
        extract = np.kron(np.eye(n), _SECOND)
        scale = 9 / silhouette.TRACE_VARIANCE[4, 2]
        return np.asarray(scale * (extract @ legendre @ extract.T))

    @cached_property
    def white(self) -> Array:
        """Covariance (B, 3 n, 3 n) of g by the stated noise."""
        out = np.zeros((len(self.noise), self.count, 3, self.count, 3))
        each = np.arange(self.count)
        out[:, each, :, each] = np.moveaxis(self.noise, 1, 0)[..., None, None] * _WHITE
        return out.reshape(-1, 3 * self.count, 3 * self.count)

    def misfit_squares(self) -> tuple[Array, Array, Array]:
        """Return squares (B,) of what no ellipsoid explains, their expectation by the stated noise,
        and its derivative by excess^2."""
        _, unseen, misfit = self.free
        white, shared = (
            np.einsum("bik,bij,bjk->b", unseen, c, unseen) for c in (self.white, self.shared)
        )
        return (misfit**2).sum(-1), white, shared

    def precision(self, excess: float) -> Array:
        """Return the inverse covariance (B, 3 n, 3 n) of g of all outlines.

        Outlines that contradict each other, for example because part of one belongs to another
        bubble, are as uncertain as the contradiction is large: one of them, if the others agree.
        """
        covariance = self.white + excess**2 * self.shared
        _, unseen, misfit = self.free
        chi2 = _chi2(misfit, unseen.mT @ covariance @ unseen)
        wrong = np.flatnonzero(chi2 > chdtri(unseen.shape[-1], _CONTRADICTION))
        if len(wrong):
            some = self.take(wrong)
            covariance[wrong] += some._doubt(covariance[wrong], misfit[wrong])
        return np.asarray(np.linalg.inv(covariance))

    def _doubt(self, covariance: Array, misfit: Array) -> Array:
        """Return what has to be added to the covariance (B, 3 n, 3 n) of outlines that contradict
        each other."""
        unseen = self.free[1]
        each = np.eye(self.count)
        unit = np.einsum("vn,ij,nm->vnimj", each, _WHITE, each).reshape(-1, *covariance.shape[1:])
        if self.count == 2:
            share = np.einsum("bik,ij,bjk->b", unseen, unit.sum(0), unseen)
            return np.asarray(((misfit**2).sum(-1) / share)[:, None, None] * unit.sum(0))
        doubted = covariance[:, None] + _UNKNOWN_SD**2 * unit  # (B, view, 3 n, 3 n)
        chi2 = _chi2(misfit[:, None], unseen.mT[:, None] @ doubted @ unseen[:, None])
        size = np.einsum("bik,vij,bjk->bv", unseen, unit, unseen)
        add = ((misfit**2).sum(-1, keepdims=True) / size)[..., None, None] * unit
        worst = chi2.argmin(-1)
        rows = np.arange(len(worst))
        agree = chi2[rows, worst] < chdtri(max(unseen.shape[-1] - 3, 1), _CONTRADICTION)
        return np.asarray(np.where(agree[:, None, None], add[rows, worst], add.mean(1)))


def _signed_miss(rays: Sequence[tuple[Array, Array]]) -> Array:
    (first, along), (second, across) = rays
    normal = np.cross(along, across)
    return np.asarray(((second - first) * normal).sum(-1) / np.linalg.norm(normal, axis=-1))


def _chi2(values: Array, covariance: Array) -> Array:
    return np.asarray((values * np.linalg.solve(covariance, values[..., None])[..., 0]).sum(-1))
