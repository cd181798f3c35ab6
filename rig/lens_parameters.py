"""Names the parameters of a camera's lens, with all that is known of each, and the lens models.

A lens model says which of them are free besides the scale. It is a set of parameter groups, and its
name joins their names by "+": ``kappa+brown``, ``tilt+radial``, ``k1+k2``. The model of a rig is
one name for all cameras, or one for each: ``left=brown,right=radial``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from telerig.errors import CalibrationError


class Scales(NamedTuple):
    """The sizes of a camera to which priors and steps of its parameters refer."""

    px_per_mm: float
    rho_mm: float
    width_px: int

    @property
    def corner_px(self) -> float:
        """The distance of an image corner from the centre."""
        return self.px_per_mm * self.rho_mm


@dataclass(frozen=True)
class LensParameter:
    """One parameter of a camera, whose name ends with its unit.

    prior_sd : standard deviation of its weak prior, several times the values of usual telecentric
        lenses, which only bounds a parameter that the data do not determine.
    term : the kind of its term in the distortion; "" for none.
    optional : whether it is 0 in a file that does not name it.
    step : the change that moves a pixel at the image corner by about 1 px.
    """

    name: str
    label: str
    prior_sd: Callable[[Scales], float]
    term: Literal["", "radial", "tangential", "prism"] = ""
    optional: bool = False
    step: Callable[[Scales], float] = lambda of: 1 / of.corner_px


_TABLE = (
    LensParameter(
        "scale_px_per_mm", "scale, px/mm", lambda of: 0.5 * of.px_per_mm,
        step=lambda of: of.px_per_mm / of.corner_px,
    ),
    LensParameter("aspect", "aspect, v scale over u scale", lambda _: 0.1),
    LensParameter("skew", "skew", lambda _: 0.1),
    LensParameter(
        "centre_u_px", "image centre u, px", lambda of: 0.05 * of.width_px, step=lambda _: 1.0
    ),
    LensParameter(
        "centre_v_px", "image centre v, px", lambda of: 0.05 * of.width_px, step=lambda _: 1.0
    ),
    LensParameter(
        "kappa_per_mm", "residual perspective κ, 1/mm", lambda of: 0.5 / of.rho_mm,
        step=lambda of: 1 / of.corner_px / of.rho_mm,
    ),
    LensParameter("k1", "radial distortion 1", lambda _: 0.5, "radial"),
    LensParameter("k2", "radial distortion 2", lambda _: 0.5, "radial"),
    LensParameter("k3", "radial distortion 3", lambda _: 0.5, "radial"),
    LensParameter("p1", "tangential distortion 1", lambda _: 0.2, "tangential"),
    LensParameter("p2", "tangential distortion 2", lambda _: 0.2, "tangential"),
    LensParameter("s1", "thin prism 1", lambda _: 0.2, "prism"),
    LensParameter("s2", "thin prism 2", lambda _: 0.2, "prism"),
    LensParameter("s3", "thin prism 3", lambda _: 0.2, "prism"),
    LensParameter("s4", "thin prism 4", lambda _: 0.2, "prism"),
    LensParameter("tilt_x", "sensor tilt about v, tangent", lambda _: 0.3),
    LensParameter("tilt_y", "sensor tilt about u, tangent", lambda _: 0.3),
    LensParameter(
        "image_convergence_per_mm", "image-side convergence, 1/mm", lambda _: 0.05,
        step=lambda of: 10 / of.corner_px / of.rho_mm,
    ),
    LensParameter(
        "wall_x_rad", "wall's normal from the stated one, x", lambda _: 0.1, optional=True,
        step=lambda of: 4 / of.corner_px,
    ),
    LensParameter(
        "wall_y_rad", "wall's normal from the stated one, y", lambda _: 0.1, optional=True,
        step=lambda of: 4 / of.corner_px,
    ),
)  # fmt: skip
"""The intrinsics of a camera in the order of every array that holds them. Terms of one kind in the
distortion stand together, and the order of the kinds is fixed. If a window's description states the
standard deviation of its normal, this replaces the prior of the last two."""
LENS_PARAMETERS = {parameter.name: parameter for parameter in _TABLE}
PARAMETERS = tuple(LENS_PARAMETERS)
INDEX = {name: i for i, name in enumerate(PARAMETERS)}
COEFFICIENTS = tuple(p.name for p in _TABLE if p.term)
"""The parameters of the distortion."""

AUTO = "auto"
GROUPS: dict[str, tuple[str, ...]] = {
    "kappa": ("kappa_per_mm",),
    "affine": ("aspect", "skew"),
    "tilt": ("tilt_x", "tilt_y", "image_convergence_per_mm"),
    "k1": ("k1",),
    "k2": ("k2",),
    "p": ("p1", "p2"),
    "s": ("s1", "s3"),
    "centre": ("centre_u_px", "centre_v_px"),
}
"""The parameters of each group, which are freed together. Every file lists them in this order.

If kappa is 0, the image centre acts only through the distortion. To first order its effect is that
of the tangential terms, and otherwise it is a gauge freedom. It is therefore held at the middle of
the image, and p1 and p2 describe a decentred lens (docs/decisions/003). s2 and s4 are never free:
they act like s1 and s3, but closer to the corners of the image (docs/decisions/014).
"""
DISTORTIONS: dict[str, tuple[str, ...]] = {
    "none": (),
    "radial": ("k1",),
    "tangential": ("k1", "p"),
    "brown": ("k1", "k2", "p"),
    "prism": ("k1", "k2", "p", "s"),
}
"""Named sets of distortion groups. Each set contains the one before it."""
NAMES = (*DISTORTIONS, *GROUPS)
"""The names that a model can have, and that can be joined by +."""
PLAIN_GROUPS = tuple(g for g in GROUPS if g not in ("tilt", "centre"))
"""The groups that remain when tilt, which acts like affine, and the image centre, which acts like
the tangential terms, are left out."""

Model = str | Mapping[str, str] | Sequence[str]
"""A lens model of a rig: one name for all cameras, "left=NAME,right=NAME", a mapping from camera to
name, or a sequence with one name for each camera."""


def groups_of(name: str) -> tuple[str, ...]:
    """Return the groups of the model with this name, in the order of `GROUPS`.

    Raises CalibrationError for an unknown name, and for affine with tilt, which act alike.
    """
    found: set[str] = set()
    for part in name.split("+"):
        if part not in GROUPS and part not in DISTORTIONS:
            raise CalibrationError(
                f"unknown model {name!r}",
                todo=f"use auto, or one or more of {', '.join(NAMES)} joined by +, or a model for "
                "each camera: LEFT=NAME,RIGHT=NAME",
            )
        found |= set(DISTORTIONS.get(part, (part,)))
    if {"affine", "tilt"} <= found:
        raise CalibrationError(
            f"model {name!r} is ambiguous: aspect and skew do the same as a tilted sensor",
            todo="free either affine or tilt",
        )
    return ordered(found)


def ordered(groups: Iterable[str]) -> tuple[str, ...]:
    """Return the given groups in the order of `GROUPS`."""
    return tuple(g for g in GROUPS if g in set(groups))


def name_of(groups: Iterable[str]) -> str:
    """Return the shortest name of a set of groups."""
    wanted = set(groups)
    lens = [g for g in ("kappa", "affine", "tilt") if g in wanted]
    distortion = wanted - {*lens, "centre"}
    named = [n for n, parts in DISTORTIONS.items() if parts and set(parts) == distortion]
    parts = [*lens, *(named or ordered(distortion))]
    parts += ["centre"] if "centre" in wanted else []
    return "+".join(parts) or "none"


def rich_groups(*, mono: bool, strong: bool) -> frozenset[str]:
    """Return the parameter groups that are tried for a camera whose model is chosen automatically.

    mono : whether the rig has one camera only; kappa is then not tried.
    strong : whether the lens has strong perspective; kappa and the image centre are then tried, but
    s is not. With a free image centre, s and p give the image of a rotated camera
    (docs/decisions/014).
    """
    if strong:
        return frozenset(PLAIN_GROUPS) - {"s"} | {"centre"}
    return frozenset(PLAIN_GROUPS) - ({"kappa"} if mono else set())


def parameters_of(name: str) -> tuple[str, ...]:
    """Return the names of the intrinsics that are free in this model besides the scale."""
    return tuple(p for g in groups_of(name) for p in GROUPS[g])


def models_by_camera(model: Model, cameras: Sequence[str]) -> tuple[str, ...]:
    """Return the model's name for each camera, "auto" for one that ``model`` does not mention.

    Raises CalibrationError for an unknown model or camera, and for a wrong number of models.
    """
    if isinstance(model, str) and "=" in model:
        model = _by_camera(model)
    if isinstance(model, Mapping):
        unknown = [name for name in model if name not in cameras]
        if unknown:
            raise CalibrationError(
                f"there is a lens model for camera {unknown[0]!r}, which the rig does not have",
                todo=f"use the rig's cameras: {', '.join(cameras)}",
            )
        names = tuple(model.get(camera, AUTO) for camera in cameras)
    else:
        names = (model,) * len(cameras) if isinstance(model, str) else tuple(model)
    if len(names) != len(cameras):
        raise CalibrationError(
            f"there are {len(names)} models for {len(cameras)} cameras",
            todo="give one model, or one for each camera",
        )
    for name in names:
        if name != AUTO:
            groups_of(name)
    return names


def joint_name(names: Sequence[str], cameras: Sequence[str]) -> str:
    """Return the common name if all cameras have the same model, else ``left=NAME,right=NAME``."""
    if len(set(names)) == 1:
        return names[0]
    return ",".join(f"{camera}={name}" for camera, name in zip(cameras, names))


def checked_model(model: str) -> str:
    """Return ``model`` unchanged. Raises CalibrationError for an unknown name of a lens model.

    The names of cameras in "left=NAME,right=NAME" are not checked.
    """
    for name in _by_camera(model).values() if "=" in model else [model]:
        if name != AUTO:
            groups_of(name)
    return model


def _by_camera(model: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in model.split(",")]
    return {camera.strip(): name.strip() for camera, _, name in pairs}


def unit_of_parameter(name: str) -> str:
    """Return the unit of a parameter of cameras, as UDUNITS has it, from its name; "1" for none."""
    ends = {
        "_px_per_mm": "px mm-1", "_per_mm": "mm-1", "_px": "px", "_mm": "mm", "_rad": "rad"
    }  # fmt: skip
    return next((unit for end, unit in ends.items() if name.endswith(end)), "1")
