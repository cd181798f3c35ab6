"""A lens model says which intrinsics of a camera are free besides the scale; this module names
them.

A model is a set of parameter groups. Its name joins their names by "+": ``kappa+brown``,
``tilt+radial``, ``k1+k2``. The model of a rig is one name for all cameras, or one for each:
``left=brown,right=radial``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from telerig.errors import CalibrationError

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
KNOWN = f"auto, {', '.join([*DISTORTIONS, *GROUPS])}, joined by +, or LEFT=NAME,RIGHT=NAME"

Model = str | Mapping[str, str] | Sequence[str]
"""A lens model of a rig: one name for all cameras, "left=NAME,right=NAME", a mapping from camera to
name, or a sequence with one name for each camera."""


def groups_of(name: str) -> tuple[str, ...]:
    """Return the groups of the model with this name, in the order of `GROUPS`.

    Raises CalibrationError for an unknown name, and for affine together with tilt, because both
    have the same effect on the image.
    """
    found: set[str] = set()
    for part in name.split("+"):
        if part not in GROUPS and part not in DISTORTIONS:
            raise CalibrationError(f"unknown model {name!r}", todo=f"use one of {KNOWN}")
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
    distortion = wanted & {"k1", "k2", "p", "s"}
    named = [n for n, parts in DISTORTIONS.items() if parts and set(parts) == distortion]
    parts = [*lens, *(named or ordered(distortion))]
    parts += ["centre"] if "centre" in wanted else []
    return "+".join(parts) or "none"


def parameters_of(name: str) -> tuple[str, ...]:
    """Return the names of the intrinsics that are free in this model besides the scale."""
    return tuple(p for g in groups_of(name) for p in GROUPS[g])


def models_by_camera(model: Model, cameras: Sequence[str]) -> tuple[str, ...]:
    """Return the model's name for each camera, "auto" for a camera that ``model`` does not mention.

    Raises CalibrationError for an unknown model or camera, and for a sequence whose length is not
    the number of cameras.
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
    """Return ``model`` unchanged after a check of its names. The cameras need not be known for
    this.

    Raises CalibrationError for an unknown name.
    """
    for name in _by_camera(model).values() if "=" in model else [model]:
        if name != AUTO:
            groups_of(name)
    return model


def _by_camera(model: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in model.split(",")]
    return {camera.strip(): name.strip() for camera, _, name in pairs}
