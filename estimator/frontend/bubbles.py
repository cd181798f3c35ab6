"""Bubbles in a backlit image: sub-pixel outlines with covariance, and why the rest are none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.frontend.bubble_geometry import points_on, rough_distance
from telerig.estimator.frontend.bubble_outline import Outlines, Start, fit_outlines
from telerig.estimator.frontend.bubble_pixels import close_pairs
from telerig.estimator.frontend.bubble_regions import (
    Blob,
    Speck,
    find_blobs,
    noise_share,
    screen_level,
)
from telerig.estimator.frontend.bubble_split import Part, split_blobs
from telerig.estimator.frontend.bubble_types import DETECTION_COLUMNS, HARMONIC_COLUMNS

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_REJECTED_COLUMNS = ["u_px", "v_px", "radius_px", "reason"]
_OUTLINE_SAMPLES = 64
_UNIFORM_SHARE = 0.004
_CLIPPED_SHARE = 0.5
_MAX_AXIS_RATIO = 3.5
_DEFOCUS_FACTOR = 2.0
_DEFOCUS_FLOOR_PX = 1.5
_SMALL_EDGES = 3.0


@dataclass(frozen=True)
class Bubbles:
    """``accepted``: columns DETECTION_COLUMNS; ``rejected``: u_px v_px radius_px reason.

    ``noise``: grey sigma as a share of the background; ``reason``: why there is nothing, if so.
    """

    accepted: pd.DataFrame
    rejected: pd.DataFrame
    noise: float
    reason: str


def detect_bubbles(
    image: NDArray[Any],
    *,
    background: NDArray[Any] | None = None,
    min_diameter_px: float = 8.0,
    min_contrast: float = 0.3,
) -> pd.DataFrame:
    """Every bubble of a backlit grey image, unordered, with the columns DETECTION_COLUMNS.

    ``background`` (rows, columns) is the bright-field level; without it the level of the screen
    is estimated from the image itself. ``min_contrast`` is the least depth of a shadow, as a
    share of the background. An image that holds nothing gives an empty table whose
    ``attrs["reason"]`` says why.

    Raises InputError for anything but a 2-D image of finite numbers, and for a background of
    another shape or one that is not positive.
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
    min_diameter_px: float = 8.0,
    min_contrast: float = 0.3,
) -> Bubbles:
    """Like :func:`detect_bubbles`, with what was rejected and why."""
    image = _checked(image, min_diameter_px, min_contrast)
    reason = _nothing_to_see(image)
    if reason:
        return _bubbles(_empty_columns(), [], np.nan, reason)
    ratio, clipped = _normalised(image, background)
    sigma = max(noise_share(ratio), 1e-4)
    blobs, specks = find_blobs(
        ratio, sigma=sigma, min_contrast=min_contrast, min_diameter_px=min_diameter_px
    )
    parts = split_blobs(blobs, min_diameter_px=min_diameter_px)
    if not parts:
        return _bubbles(_empty_columns(), specks, sigma, "no shadow dark and large enough")
    start = _start(parts, blobs, sigma)
    outlines = fit_outlines(ratio, start)
    columns = _columns(outlines, parts, image.shape, clipped)
    against = _reasons(outlines, columns, start, min_diameter_px, min_contrast)
    kept = np.array([not reason for reason in against])
    specks += [
        Speck(float(u), float(v), float(r), why)
        for u, v, r, why in zip(
            columns["u_px"], columns["v_px"], columns["d_eq_px"] / 2.0, against, strict=True
        )
        if why
    ]
    kept_columns = {name: values[kept] for name, values in columns.items()}
    reason = "" if np.any(kept) else "no shadow has a bubble's outline"
    return _bubbles(kept_columns, specks, sigma, reason)


def _bubbles(columns: dict[str, Any], specks: list[Speck], noise: float, reason: str) -> Bubbles:
    import pandas as pd

    accepted = pd.DataFrame(columns, columns=DETECTION_COLUMNS, copy=False)
    accepted.attrs["reason"] = reason
    accepted.attrs["noise"] = noise
    rejected = pd.DataFrame(
        [(speck.u_px, speck.v_px, speck.radius_px, speck.reason) for speck in specks],
        columns=_REJECTED_COLUMNS,
    )
    return Bubbles(accepted, rejected, noise, reason)


def _empty_columns() -> dict[str, Any]:
    columns: dict[str, Any] = {name: np.empty(0) for name in DETECTION_COLUMNS}
    columns["flags"] = np.empty(0, dtype=object)
    return columns


def _checked(image: NDArray[Any], min_diameter_px: float, min_contrast: float) -> NDArray[Any]:
    image = np.asarray(image)
    if image.ndim != 2:
        raise InputError(
            f"a grey image has 2 dimensions, this array has {image.ndim}: {image.shape}",
            where="image",
            todo="convert colour images to grey first (cv2.cvtColor, or one channel of the array)",
        )
    if min(image.shape) < 16 or image.dtype.kind not in "uif":
        raise InputError(
            f"cannot look for bubbles in an array of shape {image.shape} and type {image.dtype}",
            where="image",
            todo="give at least 16 x 16 pixels of an integer or float type",
        )
    if image.dtype.kind == "f" and not np.all(np.isfinite(image)):
        raise InputError(
            "has pixels that are not finite", where="image", todo="replace NaN and infinity"
        )
    if not min_diameter_px >= 4.0:
        raise InputError(
            f"must be at least 4, not {min_diameter_px}", where="min_diameter_px", todo="try 8.0"
        )
    if not 0.05 <= min_contrast < 1.0:
        raise InputError(
            f"must lie in 0.05 .. 1, not {min_contrast}", where="min_contrast", todo="try 0.3"
        )
    return image


def _nothing_to_see(image: NDArray[Any]) -> str:
    low, high = float(image.min()), float(image.max())
    if high <= 0.0:
        return "the image is black"
    if high - low > _UNIFORM_SHARE * high:
        return ""
    if image.dtype.kind in "ui" and high >= 0.98 * _full_scale(image):
        return "the image is saturated"
    return "the image is uniform"


def _full_scale(image: NDArray[Any]) -> float:
    """White of the image's type; 16 bits may hold 10, 12 or 14."""
    if image.dtype.itemsize == 1:
        return 255.0
    high = float(image.max())
    return next((float(2**bits - 1) for bits in (10, 12, 14) if high <= 2**bits - 1), 65535.0)


def _normalised(
    image: NDArray[Any], background: NDArray[Any] | None
) -> tuple[NDArray[np.float32], bool]:
    """Grey over background, and whether the screen is clipped at the sensor's white."""
    import cv2

    grey = image if image.dtype in (np.uint8, np.uint16, np.float32) else image.astype(np.float32)
    if background is None:
        screen = screen_level(grey.astype(np.float32))
    else:
        screen = np.asarray(background)
        if screen.shape != image.shape:
            raise InputError(
                f"shape {screen.shape} differs from the image's {image.shape}",
                where="background",
                todo="estimate the background from images of this camera",
            )
        screen = screen.astype(np.float32, copy=False)
        if not float(screen.min()) > 0.0:
            raise InputError(
                "has pixels that are not positive",
                where="background",
                todo="give the level of the lit screen at every pixel",
            )
    screen = np.maximum(screen, 1e-6 * float(image.max()) + 1e-12)
    ratio = cv2.divide(grey.astype(np.float32, copy=False), screen)
    sample = image[::8, ::8]
    clipped = bool(
        image.dtype.kind in "ui"
        and np.mean(sample == sample.max()) > _CLIPPED_SHARE
        and sample.max() >= 0.98 * _full_scale(image)
    )
    return ratio, clipped


def _start(parts: list[Part], blobs: list[Blob], sigma: float) -> Start:
    own = [blobs[part.blob] for part in parts]
    noise = np.full(len(parts), sigma)
    return Start(
        np.stack([part.ellipse for part in parts]),
        np.zeros((len(parts), len(HARMONIC_COLUMNS))),
        np.array([blob.blur_px for blob in own]),
        np.array([blob.inner for blob in own]),
        noise,
        noise,
    )


def _columns(
    outlines: Outlines, parts: list[Part], shape: tuple[int, ...], clipped: bool
) -> dict[str, Any]:
    ellipse, covariance = outlines.ellipse, outlines.centre_covariance_px2
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
        "edge_px": outlines.blur_px,
        "chi2_dof": outlines.chi2_dof,
        "sigma_outline_px": np.where(outlines.resolved, outlines.sigma_outline_px, np.nan),
        "flags": _flags(outlines, parts, shape, clipped),
    }
    # A half turn of the axes changes the sign of the odd orders.
    turned = np.cos(ellipse[:, 4] - columns["angle_rad"]) < 0.0
    harmonics = np.where(outlines.resolved[:, None], outlines.harmonics, np.nan)
    for index, name in enumerate(HARMONIC_COLUMNS):
        odd = name[1] in "35"
        columns[name] = harmonics[:, index] * np.where(turned & odd, -1.0, 1.0)
    return columns


def _flags(
    outlines: Outlines, parts: list[Part], shape: tuple[int, ...], clipped: bool
) -> NDArray[np.object_]:
    ellipse = outlines.ellipse
    rim = points_on(
        ellipse, outlines.harmonics, np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    )
    reach = outlines.blur_px[:, None]
    beyond = (rim[..., 0] < reach - 0.5) | (rim[..., 0] > shape[1] - 0.5 - reach)
    beyond |= (rim[..., 1] < reach - 0.5) | (rim[..., 1] > shape[0] - 0.5 - reach)
    border = np.any(beyond, axis=1)
    hidden = np.zeros(len(parts), dtype=np.bool_)
    blur, own = outlines.blur_px, np.arange(len(parts))
    for index, other in close_pairs(ellipse, ellipse, blur, blur, own):
        gap = rough_distance(ellipse[other], rim[index, :, 0], rim[index, :, 1])
        hidden[index] |= bool(np.any(gap < 0.0))
    words = {
        "border": border,
        "defocus": _defocused(outlines),
        "overlap": hidden,
        "merged": np.array([part.merged for part in parts]),
        "small": ellipse[:, 3] < _SMALL_EDGES * np.hypot(outlines.blur_px, 0.29),
        "saturated": np.full(len(parts), clipped),
    }
    flags = ["|".join(word for word, on in words.items() if on[i]) for i in range(len(parts))]
    return np.array(flags, dtype=object)


def _defocused(outlines: Outlines) -> Mask:
    sharp = float(np.quantile(outlines.blur_px, 0.25))
    defocused: Mask = outlines.blur_px > max(_DEFOCUS_FACTOR * sharp, _DEFOCUS_FLOOR_PX)
    return defocused


def _reasons(
    outlines: Outlines,
    columns: dict[str, Any],
    start: Start,
    min_diameter_px: float,
    min_contrast: float,
) -> list[str]:
    """Why each fitted outline is no bubble; empty where it is one."""
    reasons = []
    for i in range(outlines.ellipse.shape[0]):
        u, v, a, b, _ = outlines.ellipse[i]
        jump = float(np.hypot(*(outlines.ellipse[i, :2] - start.ellipse[i, :2])))
        if not np.all(np.isfinite(outlines.ellipse[i])):
            reasons.append("the outline's fit failed")
        elif columns["d_eq_px"][i] < min_diameter_px:
            reasons.append(f"smaller than {min_diameter_px:g} px")
        elif columns["contrast"][i] < min_contrast:
            reasons.append(f"contrast {columns['contrast'][i]:.2f} is below {min_contrast:g}")
        elif a > _MAX_AXIS_RATIO * b:
            reasons.append(f"{a / b:.1f} times as long as wide")
        elif jump > 0.3 * a + 2.0 or outlines.coverage[i] < 0.12:
            reasons.append("too little of its outline can be seen")
        else:
            reasons.append("")
    return reasons


def outline_points(row: pd.Series[Any] | dict[str, Any], n: int = 64) -> Array:
    """Outline (n, 2) [px] of one row of the detection table, evenly spaced in the anomaly."""
    ellipse = np.array([[row[name] for name in ("u_px", "v_px", "a_px", "b_px", "angle_rad")]])
    harmonics = np.nan_to_num(np.array([[row[name] for name in HARMONIC_COLUMNS]], dtype=float))
    phi = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    points: Array = points_on(ellipse.astype(float), harmonics, phi)[0]
    return points


def outline_moments(ellipse: Array, harmonics: Array) -> tuple[Array, Array]:
    """Area (B,) and area centroid (B, 2) inside outlines, by Green's theorem.

    Derivatives are spectral, so 64 samples are exact to rounding.
    """
    phi = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_SAMPLES, endpoint=False)
    points = points_on(ellipse, harmonics, phi) - ellipse[:, None, :2]
    order = np.fft.fftfreq(_OUTLINE_SAMPLES, 1.0 / _OUTLINE_SAMPLES)
    place = points[..., 0] + 1j * points[..., 1]
    slope = np.fft.ifft(np.fft.fft(place, axis=1) * 1j * order, axis=1)
    step = 2.0 * np.pi / _OUTLINE_SAMPLES
    area = 0.5 * step * np.sum((np.conj(place) * slope).imag, axis=1)
    x, y = points[..., 0], points[..., 1]
    cu = 0.5 * step * np.sum(x * x * slope.imag, axis=1) / area
    cv = -0.5 * step * np.sum(y * y * slope.real, axis=1) / area
    return area, ellipse[:, :2] + np.stack([cu, cv], axis=1)


def outline_centroid(table: pd.DataFrame) -> Array:
    """Centroid (N, 2) [px] of the area inside each outline of a detection table.

    It differs from the ellipse's centre by the products of the outline's harmonics with each
    other and with the ellipse's flattening.
    """
    ellipse = table[["u_px", "v_px", "a_px", "b_px", "angle_rad"]].to_numpy(dtype=np.float64)
    harmonics = np.nan_to_num(table[HARMONIC_COLUMNS].to_numpy(dtype=np.float64))
    return outline_moments(ellipse, harmonics)[1]
