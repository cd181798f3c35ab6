"""Outlines that no single bubble has, and a second attempt to split what lies under them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.arcs import arcs_between
from telerig.estimator.bubbles.outline.fit_types import Outlines
from telerig.estimator.bubbles.outline.measures import deepest_dent, outline_curvature
from telerig.estimator.bubbles.outline.regions import Blob
from telerig.estimator.bubbles.outline.split import Part, parts_of_arcs

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_WAISTS = ((0.03, 2.5), (0.3, 1.3), (1.5, 0.0))
"""Depth of a dent and the chi2_dof above which it counts: strong shape modes are dented too, but
then the outline's orders describe them."""
_ASTRAY_PX, _ASTRAY_SHARE = 0.15, 0.005
_SWOLLEN, _LONG = 1.6, 2.3
_SHARPEST_ORDER, _WHOLE = 35.0, 0.9
_FLAT = 0.35
_BETTER = 0.6


def impossible_outlines(outlines: Outlines) -> Mask:
    """Outlines (B,) from which the rim strays, or with a waist, which no single bubble has.

    The slighter the waist, the worse the outline's orders must describe the rim; whether a partly
    hidden outline has one cannot be told.
    """
    dent = deepest_dent(outlines.ellipse, outlines.harmonics)
    radius = np.sqrt(outlines.ellipse[:, 2] * outlines.ellipse[:, 3])
    sure = dent > 3.0 * _SHARPEST_ORDER * outlines.sigma_outline_px / radius
    waist = np.any([(dent > depth) & (outlines.chi2_dof > fit) for depth, fit in _WAISTS], axis=0)
    waist &= sure & (outlines.coverage > _WHOLE)
    astray: Mask = outlines.misfit_px > _ASTRAY_PX + _ASTRAY_SHARE * radius
    impossible: Mask = waist | astray
    return impossible


def unsound_parts(outlines: Outlines, parts: list[Part]) -> Mask:
    """Impossible outlines, and parts of a blob that the fit has carried far from where they
    began: then the split was wrong."""
    began = np.stack([part.ellipse for part in parts])
    ended = outlines.ellipse
    growth = np.sqrt(ended[:, 2] * ended[:, 3] / (began[:, 2] * began[:, 3]))
    jump = np.hypot(ended[:, 0] - began[:, 0], ended[:, 1] - began[:, 1])
    carried = np.maximum(growth, 1.0 / growth) > _SWOLLEN
    carried |= (jump > 0.3 * began[:, 3] + 1.0) | (ended[:, 2] > _LONG * ended[:, 3])
    carried &= np.array([part.shared for part in parts])
    return impossible_outlines(outlines) | carried


def halves_at_waists(
    outlines: Outlines,
    parts: list[Part],
    blobs: list[Blob],
    shape: tuple[int, ...],
    min_diameter_px: float,
) -> dict[int, list[Part]]:
    """For each part that is a whole blob with a waist the two parts that a cut there gives.

    Where the blob's raw outline shows no notch through its blur, its fitted one does.
    """
    alone = np.bincount([part.blob for part in parts]) == 1
    waisted = impossible_outlines(outlines) & (outlines.coverage > _WHOLE)
    halves = {}
    for index in np.flatnonzero(waisted).tolist():
        part = parts[index]
        blob = blobs[part.blob]
        if not alone[part.blob] or blob.touches_border:
            continue
        notches = _flattest(outlines.ellipse[index], outlines.harmonics[index])
        if len(notches) != 2:
            continue
        arcs = arcs_between(blob.contour_px, notches)
        found = parts_of_arcs(arcs, blob, part.blob, shape, min_diameter_px)
        if len(found) == 2:
            halves[index] = found
    return halves


def _flattest(ellipse: Array, harmonics: Array) -> Array:
    """Places (n, 2) where the outline's curvature has a minimum far below that of a circle."""
    points, curvature = outline_curvature(ellipse[None], harmonics[None])
    turn = curvature[0] * np.sqrt(ellipse[2] * ellipse[3])
    low = (turn < _FLAT) & (turn <= np.roll(turn, 1)) & (turn < np.roll(turn, -1))
    flattest: Array = points[0][low]
    return flattest


def agreed(
    halves: dict[int, list[Part]], before: Outlines, parts: list[Part], after: Outlines
) -> dict[int, list[Part]]:
    """The splits whose halves both fit far better than the whole did."""
    sound = ~unsound_parts(after, parts)
    better = {}
    for index, found in halves.items():
        own = [k for k, part in enumerate(parts) if part.blob == found[0].blob]
        limit = _BETTER * before.chi2_dof[index]
        if all(sound[k] and after.chi2_dof[k] < limit for k in own):
            better[index] = found
    return better
