"""Bubbles in a backlit image: sub-pixel outlines with covariance, and why the rest are none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import partial
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32
from telerig.estimator.bubbles.background.screen import screen_level
from telerig.estimator.bubbles.field import lit_field
from telerig.estimator.bubbles.flat_field import (
    LEAST_BRIGHTNESS,
    brightness,
    checked_background,
    checked_image,
    normalised,
    nothing_to_see,
    rounding_share,
)
from telerig.estimator.bubbles.lighting import NOT_BACKLIT, on_bright_spots, share_of_hearts
from telerig.estimator.bubbles.outline.blobs import (
    Blob,
    Part,
    Rejected,
    contour_moments,
    find_blobs,
    noise_shares,
    split_blobs,
    split_where_flat,
)
from telerig.estimator.bubbles.outline.crowds import WHOLE, around, resolved_crowd, settled
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    DETECTION_COLUMNS,
    HARMONIC_COLUMNS,
    outline_centroid,
    outline_moments,
    outline_points,
    rough_distance,
)
from telerig.estimator.bubbles.outline.outline_fit import (
    Outlines,
    blur_px,
    fit_outlines,
    fits_badly,
    implausible_outlines,
    missed_rims,
    radius_px,
    start_outlines,
    usual_misfit,
)
from telerig.estimator.bubbles.outline.rims import Rims, rims_along
from telerig.rig.outline import points_on

__all__ = [
    "Bubbles",
    "detect_bubbles",
    "find_bubbles",
    "load_compiled_loops",
    "outline_centroid",
    "outline_points",
]

_MAX_AXIS_RATIO, _LEAST_AXIS_PX = 3.0, 1.0
_DEFOCUS_FACTOR = 2.0
_DEFOCUS_FLOOR_PX = 1.5
_SHARP_SHARE = 0.2
"""An edge narrower than this against the radius is sharp, in a crowd of bubbles of many sizes."""
_SMALL_EDGES = 3.0
_MOSTLY_SEEN, _KNOWN_COVERAGE = 0.6, 0.3
_SMUDGE_BLUR, _SMUDGE = 0.4, 0.75
_LEFT_SHARE = 0.15
"""Share of a region's box that may be left over by the bubbles that its rims show."""

_RIMS_PAY = 0.15
"""Share of an image that bubbles cover, beyond which rims are looked for, too: in sparser
ones they give more wrong points than right ones (docs/decisions/035-crowds.md)."""

COVERED_LIMIT, COVERED_LIMIT_EVERYWHERE = 0.1, 0.2
"""Share of an image that bubbles may cover before the user is warned, in a run and in a single
image. In single ones four of five are found up to it (benchmarks/results/real_images.md)."""


@dataclass(frozen=True)
class Bubbles:
    """Hold the bubbles of one image.

    accepted : table with a row for each bubble and the columns DETECTION_COLUMNS.
    shadows : the shadows that are no bubbles.
    noise : standard deviation of the image's noise, as a share of the background's grey level; NaN
        if it was not measured.
    reason : why there are no bubbles, in words; empty if there are some.
    field : (rows, columns) where bubbles were looked for; None for the whole image.
    clusters : outlines (n, 2) in px of dark regions that are no bubble and could not be divided.
    bright_spots : how many outlines were left out as dark hearts of bright spots, in a scene that
        is not backlit.
    covered : share of the image, or of its field, that bubbles and clusters cover; where they
        overlap it is counted twice.
    """

    accepted: pd.DataFrame
    shadows: list[Rejected]
    noise: float
    reason: str
    field: Bools | None = None
    clusters: list[Array] = dataclass_field(default_factory=list)
    covered: float = 0.0
    bright_spots: int = 0

    @property
    def rejected(self) -> pd.DataFrame:
        """Return a table of the shadows that are no bubbles: centre u_px and v_px, radius_px, and
        the reason in words."""
        return pd.DataFrame(self.shadows, columns=list(Rejected._fields))


def detect_bubbles(
    image: NDArray[Any],
    *,
    background: NDArray[Any] | None = None,
    min_diameter_px: float = 8.0,
    min_contrast: float = 0.3,
) -> pd.DataFrame:
    """Find all bubbles in a backlit grey image.

    image : (rows, columns) grey levels.
    background : (rows, columns) grey levels of the lit screen without bubbles; its brightness is
        fitted to that of the image. None estimates them from the image itself, of which a dark
        surround of the screen is then left out.
    min_diameter_px : least equivalent diameter of a bubble, in px; at least 4.
    min_contrast : least depth of a bubble's shadow, as a share of the background.

    Returns a table with a row for each bubble, in no particular order, and the columns
    DETECTION_COLUMNS. If there is no bubble, the table is empty and its ``attrs["reason"]`` says
    why.
    Raises InputError if the image is not a 2-D array of finite numbers, if the background has
    another shape or is not positive, or if an option is out of range.
    """
    return find_bubbles(
        image,
        background=background,
        min_diameter_px=min_diameter_px,
        min_contrast=min_contrast,
    ).accepted


def find_bubbles(
    image: NDArray[Any],
    *,
    background: NDArray[Any] | None = None,
    field: Bools | None = None,
    min_diameter_px: float = 8.0,
    min_contrast: float = 0.3,
) -> Bubbles:
    """Find all bubbles like :func:`detect_bubbles`, and return the rejected shadows as well.

    field : (rows, columns) where bubbles are looked for. Without it and without a background, a
        dark surround of the lit screen is found and left out.
    Dark regions that are single bubbles, or that could be divided into bubbles, need no more. The
    rims of bubbles are looked for around the others, among them those within a bright heart, and in
    the whole image if bubbles cover more than 15 % of it; this takes some 2 s for a megapixel.
    Without a background the covariances allow for light that shadows of other bubbles make uneven,
    and dark hearts of bright spots are left out in scenes that are not backlit.

    The other arguments and the errors are those of :func:`detect_bubbles`.
    """
    image = checked_image(image, min_diameter_px, min_contrast)
    shadows = background is None
    reason, gain = nothing_to_see(image), 1.0
    if reason:
        return _bubbles({}, [], np.nan, reason)
    if background is not None:
        background = checked_background(background, image.shape)
        gain = brightness(image, background, field)
        if not gain > LEAST_BRIGHTNESS:
            return _bubbles({}, [], np.nan, f"the screen has {gain:.0%} of its usual brightness")
    given = field is not None
    if background is None and not given:
        field = lit_field(image)
    if field is not None:
        if background is None:
            background = screen_level(image, field, falls_off=not given)
        outside = np.minimum(background * np.float32(gain), image.max())
        image = np.where(field, image, outside).astype(image.dtype, copy=False)
    ratio, clipped = normalised(image, background, gain)
    found = _found(
        ratio, clipped, rounding_share(image), field, min_diameter_px, min_contrast, shadows
    )
    if shadows:
        found = _without_bright_spots(found, image, field)
    merged = (
        found.accepted["flags"].astype(str).str.contains("merged")
    )  # of which clusters are part
    area = float(found.accepted["area_px2"][~merged].sum())
    area += sum(cv2.contourArea(line.astype(np.float32)) for line in found.clusters)
    looked_at = max(image.size if field is None else np.count_nonzero(field), 1)
    return replace(found, field=field, covered=min(area / looked_at, 1.0))


def _found(
    ratio: Float32,
    clipped: bool,
    rounding: float,
    field: Bools | None,
    min_diameter_px: float,
    min_contrast: float,
    shadows: bool,
) -> Bubbles:
    noise = noise_shares(ratio, field)
    silent = float(noise[0]) < rounding
    noise = np.full(2, rounding) if silent else noise
    sigma = float(noise[0])
    blobs, rejected = find_blobs(
        ratio, sigma=sigma, min_contrast=min_contrast, min_diameter_px=min_diameter_px
    )
    hearts = [blob for blob in blobs if blob.within]
    blobs = [blob for blob in blobs if not blob.within]
    parts = split_blobs(blobs, ratio.shape, min_diameter_px=min_diameter_px)
    parts, slender = _without_slender(parts)
    rejected += slender
    clusters: list[Array] = []
    fitted = partial(fit_outlines, ratio, noise=noise, shadows=shadows)
    first = fitted(_start(parts, blobs))
    if silent and np.isfinite(first.chi2_dof).any():
        # a screen that is white, or smoothed by a lossy compression, does not tell the rims' noise
        noise = noise * np.sqrt(max(1.0, float(np.nanmedian(first.chi2_dof))))
        sigma, fitted = float(noise[0]), partial(fitted, noise=noise)
        first = fitted(_start(parts, blobs))
    parts, outlines = _undivided(blobs, parts, first, fitted)
    start = _start(parts, blobs)
    odd, bent = implausible_outlines(outlines)
    again = _divided(blobs, parts, outlines, odd, fitted, ratio.shape, min_diameter_px)
    if again is not None:
        parts, outlines = again
        start, (odd, bent) = _start(parts, blobs), implausible_outlines(outlines)
    merged = _merged(odd, outlines, parts)
    known = ~merged & np.isfinite(outlines.ellipse).all(axis=1)
    known &= outlines.coverage > _KNOWN_COVERAGE
    seen = ratio.size if field is None else np.count_nonzero(field)
    covered = np.pi * float(np.nansum(radius_px(outlines) ** 2)) / max(seen, 1)
    whole = is_crowded(covered, len(blobs), _RIMS_PAY)
    crowds, kept = [], known
    if whole or merged.any() or hearts:
        sure = rims_along(ratio, sigma, outlines.ellipse[known])
    look = partial(
        resolved_crowd, ratio, sigma, min_diameter_px=min_diameter_px, min_contrast=min_contrast,
        alone=shadows,
    )  # fmt: skip
    if whole:
        crowds = [look(blobs, parts, sure, WHOLE)]
        rejected, clusters = rejected + crowds[0].rejected, crowds[0].clusters
    else:
        own = np.array([part.blob for part in parts], np.intp)
        kept = np.ones(len(parts), np.bool_)
        for k in np.unique(own[merged & ~_explained(outlines)]).tolist():
            crowd = look([blobs[k]], [], sure, around(blobs[k], ratio.shape))
            crowds.append(crowd)
            clusters += crowd.clusters
            sure = Rims.concat([sure, crowd.rims])
            left = sum(cv2.contourArea(line.astype(np.float32)) for line in crowd.clusters)
            if len(crowd.rims) and left < _LEFT_SHARE * np.prod(blobs[k].box[2:]):
                kept &= known | (own != k)
        for blob in hearts:
            crowds.append(look([], [], sure, around(blob, ratio.shape)))
            sure = Rims.concat([sure, crowds[-1].rims])
    found = [crowd.rims for crowd in crowds if len(crowd.rims)]
    if found:
        every = Rims.concat(found)
        own_start = start_outlines(every.ellipse, every.blur_px, every.inner)
        fit = fitted(own_start, beside=outlines.take(known), shadows=True)
        start = Outlines.concat([start.take(kept), own_start])
        outlines = Outlines.concat([outlines.take(kept), settled(fit, every)])
        # In a crowd it is rather a neighbour in front that bends an outline than a second bubble.
        odd, bent = implausible_outlines(outlines)
        merged = np.concatenate([merged[kept], odd[-len(fit) :] & (not whole)])
    elif whole:
        start, outlines, merged, bent = (
            start.take(kept),
            outlines.take(kept),
            merged[kept],
            bent[kept],
        )
    if not len(start):
        nothing = _bubbles({}, rejected, sigma, "no shadow dark and large enough")
        return replace(nothing, clusters=clusters)
    # A centre is somewhere in its outline, however short the arc that its fit rests on, and all
    # that is known of a bubble of a merged outline is that it is somewhere in it.
    inside = radius_px(outlines)[:, None, None] ** 2 / 4.0 * np.eye(2)
    covariance = inside @ np.linalg.inv(outlines.covariance_px2 + inside) @ outlines.covariance_px2
    within = np.where(merged[:, None, None], inside, bent[:, None, None] * np.eye(2))
    outlines = outlines.changed(covariance_px2=covariance + within)
    columns = _columns(outlines)
    columns["flags"] = _flags(outlines, merged, ratio.shape, field, clipped)
    against = _reasons(outlines, columns, start, min_diameter_px, min_contrast)
    kept = np.array([not reason for reason in against])
    rejected += [
        Rejected(float(u), float(v), float(r), why)
        for u, v, r, why in zip(
            columns["u_px"], columns["v_px"], columns["d_eq_px"] / 2.0, against, strict=True
        )
        if why
    ]
    kept_columns = {name: values[kept] for name, values in columns.items()}
    reason = "" if np.any(kept) else "no shadow has a bubble's outline"
    return replace(_bubbles(kept_columns, rejected, sigma, reason), clusters=clusters)


def _without_bright_spots(found: Bubbles, image: NDArray[Any], field: Bools | None) -> Bubbles:
    """Return the bubbles without the dark hearts of bright spots, if the scene is not backlit."""
    table = found.accepted
    ellipse = table[["u_px", "v_px", "a_px", "b_px", "angle_rad"]].to_numpy(float)
    bright, seen = on_bright_spots(image, field, ellipse, found.clusters)
    if share_of_hearts(bright, seen) <= NOT_BACKLIT:
        return found
    places = table.loc[bright, ["u_px", "v_px", "d_eq_px"]].to_numpy(float).tolist()
    hearts = [Rejected(u, v, d / 2.0, "dark heart of a bright spot") for u, v, d in places]
    kept = table[~bright].reset_index(drop=True)
    reason = found.reason if len(kept) else "the scene is not backlit"
    kept.attrs |= table.attrs | {"reason": reason}
    return replace(
        found,
        accepted=kept,
        shadows=found.shadows + hearts,
        reason=reason,
        bright_spots=len(hearts),
    )


def load_compiled_loops() -> None:
    """Load or compile the loops that the detection of bubbles uses.

    This is done before copies of this process are made, so that it is done only once. The first
    time in an installation it takes some 15 s.
    """
    image = np.full((64, 96), 200, np.uint8)
    for u in (36, 56):
        cv2.circle(image, (u, 32), 14, (20,), cv2.FILLED)
    blurred = cv2.GaussianBlur(image, (0, 0), 1.0)
    find_bubbles(blurred, background=np.full(image.shape, 200.0, np.float32))


def is_crowded(covered: float, bubbles: float, limit: float) -> bool:
    """Return whether bubbles hide each other more than a limit such as `COVERED_LIMIT` allows.

    covered : share of the image that they cover; bubbles : their number. One bubble cannot hide
        another, however large it is: its own share does not count.
    """
    return covered * (1.0 - 1.0 / max(bubbles, 1.0)) > limit


def crowded_words(where: str, covered: float) -> str:
    """Return a warning for the user about images in which bubbles hide each other.

    where : the images. covered : share of the images that bubbles cover.
    """
    return (
        f"{where}: bubbles cover {covered:.0%} of the images; beyond {COVERED_LIMIT:.0%} they hide "
        "each other: of rendered runs with 17 to 36% covered, 12 to 21% of the bubbles have no "
        "point in space, and one point in 17 is wrong"
    )


def _without_slender(parts: list[Part]) -> tuple[list[Part], list[Rejected]]:
    kept, slender = [], []
    for part in parts:
        u, v, a, b, _ = part.ellipse.tolist()
        if b < _LEAST_AXIS_PX:
            slender.append(Rejected(u, v, (a * b) ** 0.5, "too small to have an outline"))
        elif a <= _MAX_AXIS_RATIO * b:
            kept.append(part)
        else:
            slender.append(Rejected(u, v, (a * b) ** 0.5, f"{a / b:.1f} times as long as wide"))
    return kept, slender


def _bubbles(
    columns: dict[str, Any], rejected: list[Rejected], noise: float, reason: str
) -> Bubbles:
    *names, flags = DETECTION_COLUMNS
    numbers = (
        np.stack([columns[name] for name in names], 1) if columns else np.empty((0, len(names)))
    )
    accepted = pd.DataFrame(numbers, columns=names)
    accepted[flags] = columns.get(flags, np.empty(0, object))
    accepted.attrs["reason"] = reason
    accepted.attrs["noise"] = noise
    return Bubbles(accepted, rejected, noise, reason)


def _start(parts: list[Part], blobs: list[Blob]) -> Outlines:
    own = [blobs[part.blob] for part in parts]
    return start_outlines(
        np.array([part.ellipse for part in parts]).reshape(-1, 5),
        np.array([blob.blur_px for blob in own]),
        np.array([blob.inner for blob in own]),
    )


def _explained(outlines: Outlines) -> Bools:
    """Return whether outlines (B,) leave nothing but noise unexplained of the rims around them."""
    seen = outlines.coverage > _KNOWN_COVERAGE
    return np.asarray(seen & ~(fits_badly(outlines) | missed_rims(outlines)))


def _undivided(
    blobs: list[Blob], parts: list[Part], outlines: Outlines, fitted: Callable[..., Outlines]
) -> tuple[list[Part], Outlines]:
    """Return parts and outlines with one merged part for each region that its parts do not explain
    better than a single outline with its harmonics does.

    Several ellipses along such a rim may as well be one bent bubble.
    """
    own = np.array([part.blob for part in parts], np.intp)
    shared = [part.shared and not blobs[part.blob].touches_border for part in parts]
    several = np.unique(own[shared])
    if not len(several):
        return parts, outlines
    ellipses = contour_moments([blobs[k].contour_px for k in several])[0]
    ones = [Part(e, k, merged=True) for e, k in zip(ellipses, several.tolist(), strict=True)]
    fit = fitted(_start(ones, blobs), beside=outlines.take(~np.isin(own, several)))
    worst = np.zeros(len(blobs))
    np.fmax.at(worst, own, outlines.chi2_dof)
    fits = (fit.chi2_dof <= worst[several]) & _explained(fit)
    kept = np.concatenate([~np.isin(own, several[fits]), fits])
    parts = [part for part, good in zip([*parts, *ones], kept.tolist(), strict=True) if good]
    return parts, Outlines.concat([outlines, fit]).take(kept)


def _divided(
    blobs: list[Blob],
    parts: list[Part],
    outlines: Outlines,
    odd: Bools,
    fitted: Callable[..., Outlines],
    shape: tuple[int, ...],
    min_diameter_px: float,
) -> tuple[list[Part], Outlines] | None:
    """Return the parts of an image and their outlines, those along a whole dark region that no
    single bubble has divided where several fit and are seen well; None if there are none such.

    odd : (B,) which outlines are implausible.
    """
    usual = usual_misfit(outlines)
    again = [
        new
        for part, unlike in zip(parts, (odd | fits_badly(outlines, usual)).tolist(), strict=True)
        if unlike and not (part.merged or part.shared or blobs[part.blob].touches_border)
        for new in split_where_flat(blobs[part.blob], part.blob, shape, min_diameter_px)
    ]
    if not again:
        return None
    one, several = (np.array([part.blob for part in some]) for some in (parts, again))
    others = outlines.take(~np.isin(one, several))
    fit = fitted(_start(again, blobs), beside=others)
    bad = implausible_outlines(Outlines.concat([others, fit]))[0][len(others) :]
    bad |= fits_badly(fit, usual) | ~(fit.coverage > _KNOWN_COVERAGE)
    sound = ~np.isin(several, several[bad])
    if not np.any(sound):
        return None
    kept = np.concatenate([~np.isin(one, several[sound]), sound])
    parts = [part for part, good in zip([*parts, *again], kept.tolist(), strict=True) if good]
    return parts, Outlines.concat([outlines, fit]).take(kept)


def _columns(outlines: Outlines) -> dict[str, Any]:
    ellipse, covariance = outlines.ellipse, outlines.covariance_px2
    area, _ = outline_moments(ellipse, outlines.harmonics)
    columns: dict[str, Any] = {
        "u_px": ellipse[:, 0],
        "v_px": ellipse[:, 1],
        "suu_px2": covariance[:, 0, 0],
        "suv_px2": covariance[:, 0, 1],
        "svv_px2": covariance[:, 1, 1],
        "a_px": ellipse[:, 2],
        "b_px": ellipse[:, 3],
        "angle_rad": (ellipse[:, 4] + np.pi / 2.0) % np.pi - np.pi / 2.0,
        "area_px2": area,
        "d_eq_px": 2.0 * np.sqrt(area / np.pi),
        "contrast": (outlines.outer - outlines.inner) / outlines.outer,
        "edge_px": blur_px(outlines),
        "chi2_dof": outlines.chi2_dof,
        "sigma_outline_px": outlines.sigma_outline_px,
    }
    # A half turn of the axes changes the sign of the odd orders.
    turned = np.cos(ellipse[:, 4] - columns["angle_rad"]) < 0.0
    resolved = np.isfinite(outlines.sigma_outline_px)[:, None]
    harmonics = np.where(resolved, outlines.harmonics, np.nan)
    for index, name in enumerate(HARMONIC_COLUMNS):
        odd = name[1] in "35"
        columns[name] = harmonics[:, index] * np.where(turned & odd, -1.0, 1.0)
    return columns


def _flags(
    outlines: Outlines,
    merged: Bools,
    shape: tuple[int, ...],
    field: Bools | None,
    clipped: bool,
) -> NDArray[np.object_]:
    ellipse = outlines.ellipse
    rim = points_on(ellipse, outlines.harmonics, np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False))
    blur = blur_px(outlines)
    reach = blur[:, None]
    beyond = (rim[..., 0] < reach - 0.5) | (rim[..., 0] > shape[1] - 0.5 - reach)
    beyond |= (rim[..., 1] < reach - 0.5) | (rim[..., 1] > shape[0] - 0.5 - reach)
    if field is not None:
        column, row = (np.round(rim[..., i]).astype(int) for i in (0, 1))
        within = cv2.erode(field.astype(np.uint8), np.ones((5, 5), np.uint8))
        beyond |= within[row.clip(0, shape[0] - 1), column.clip(0, shape[1] - 1)] == 0
    border = np.any(beyond, axis=1)
    apart = np.linalg.norm(ellipse[:, None, :2] - ellipse[:, :2], axis=2)
    near = np.argwhere(apart < 1.1 * (ellipse[:, None, 2] + ellipse[:, 2]))
    one, other = near[near[:, 0] != near[:, 1]].T
    gap = rough_distance(ellipse[one, None], rim[other, :, 0], rim[other, :, 1])
    hidden = np.zeros(len(ellipse), np.bool_)
    hidden[other[np.any(gap < 0.0, axis=1)]] = True
    words = {
        "border": border,
        "defocus": _defocused(outlines),
        "overlap": hidden,
        "merged": merged,
        "small": ellipse[:, 3] < _SMALL_EDGES * np.hypot(blur, 0.29),
        "saturated": np.full(len(ellipse), clipped),
    }
    flags = ["|".join(word for word, on in words.items() if on[i]) for i in range(len(ellipse))]
    return np.array(flags, dtype=object)


def _merged(odd: Bools, outlines: Outlines, parts: list[Part]) -> Bools:
    """Return (B,) whether each outline belongs to merged bubbles.

    This is so for blobs that could not be split and for implausible outlines. If one part of a blob
    is implausible, then so are all parts of it of which less than 60 % of the outline is visible.
    """
    merged: Bools = odd | np.array([part.merged for part in parts], np.bool_)
    own = np.array([part.blob for part in parts], np.intp)
    return np.asarray(merged | (np.isin(own, own[merged]) & (outlines.coverage < _MOSTLY_SEEN)))


def _defocused(outlines: Outlines) -> Bools:
    """Return which outlines (B,) are out of focus, compared with the sharp ones of the image."""
    blur = blur_px(outlines)
    least = max(_DEFOCUS_FACTOR * float(np.quantile(blur, 0.25)), _DEFOCUS_FLOOR_PX)
    return np.asarray(blur > np.maximum(least, _SHARP_SHARE * radius_px(outlines)))


def _reasons(
    outlines: Outlines,
    columns: dict[str, Any],
    start: Outlines,
    min_diameter_px: float,
    min_contrast: float,
) -> list[str]:
    """Return for each fitted outline why it is no bubble; an empty text means that it is one."""
    ellipse, covariance = outlines.ellipse, outlines.covariance_px2
    every = np.concatenate([ellipse, covariance.reshape(-1, 4)], axis=1)
    finite: Bools = np.asarray(np.isfinite(every).all(1))
    determinant = np.linalg.det(np.where(finite[:, None, None], covariance, 0.0))
    known: Bools = finite & (determinant > 0.0) & (covariance[:, 0, 0] > 0.0)
    d_eq, contrast, (a, b) = columns["d_eq_px"], columns["contrast"], ellipse[:, 2:4].T
    typical = float(np.median(contrast))
    smudge: Bools = (blur_px(outlines) > _SMUDGE_BLUR * b) & (contrast < _SMUDGE * typical)
    jump: Array = np.linalg.norm(ellipse[:, :2] - start.ellipse[:, :2], axis=1)
    unseen = (jump > 0.3 * a + 2.0) | (outlines.coverage < 0.12)
    reasons = [""] * len(a)
    for i in np.flatnonzero(
        ~known | (d_eq < min_diameter_px) | (contrast < min_contrast)
        | (a > _MAX_AXIS_RATIO * b) | smudge | unseen
    ).tolist():  # fmt: skip
        if not known[i]:
            reasons[i] = "the outline's fit failed"
        elif d_eq[i] < min_diameter_px:
            reasons[i] = f"smaller than {min_diameter_px:g} px"
        elif contrast[i] < min_contrast:
            reasons[i] = f"contrast {contrast[i]:.2f} is below {min_contrast:g}"
        elif a[i] > _MAX_AXIS_RATIO * b[i]:
            reasons[i] = f"{a[i] / b[i]:.1f} times as long as wide"
        elif smudge[i]:
            reasons[i] = "a smudge: blurred beyond its size, fainter than the bubbles"
        else:
            reasons[i] = "too little of its outline can be seen"
    return reasons
