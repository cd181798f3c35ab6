"""Lens models by name: which intrinsics besides the scale are free, camera by camera.

A model is a set of groups, its name their names joined by "+": ``kappa+brown``, ``tilt+radial``,
``k1+k2``. A rig's model is one name for all cameras, or ``left=brown,right=radial``.
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
"""Parameters that are freed together, in the order in which every file lists them.

Without kappa the image centre acts only through the distortion, where it equals the tangential
terms to first order and is otherwise a gauge freedom. It is therefore held at the middle of the
image, and p1 and p2 describe a decentred lens (docs/decisions/003). s2 and s4 are never free: they
act like s1 and s3, but nearer to the image's corners (docs/decisions/014).
"""
DISTORTIONS: dict[str, tuple[str, ...]] = {
    "none": (),
    "radial": ("k1",),
    "tangential": ("k1", "p"),
    "brown": ("k1", "k2", "p"),
    "prism": ("k1", "k2", "p", "s"),
}
"""Named sets of distortion groups; each contains the one before it."""
KNOWN = f"auto, {', '.join([*DISTORTIONS, *GROUPS])}, joined by +, or LEFT=NAME,RIGHT=NAME"

Model = str | Mapping[str, str] | Sequence[str]
"""One name for all cameras, "left=NAME,right=NAME", a mapping, or one name per camera."""


def groups_of(name: str) -> tuple[str, ...]:
    """The groups of a model, in the order of `GROUPS`.

    Raises CalibrationError for an unknown name, and for affine together with tilt, whose effects
    are the same.
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
    """The groups in the order of `GROUPS`."""
    return tuple(g for g in GROUPS if g in set(groups))


def name_of(groups: Iterable[str]) -> str:
    """The shortest name of a set of groups."""
    wanted = set(groups)
    lens = [g for g in ("kappa", "affine", "tilt") if g in wanted]
    distortion = wanted & {"k1", "k2", "p", "s"}
    named = [n for n, parts in DISTORTIONS.items() if parts and set(parts) == distortion]
    parts = [*lens, *(named or ordered(distortion))]
    parts += ["centre"] if "centre" in wanted else []
    return "+".join(parts) or "none"


def parameters_of(name: str) -> tuple[str, ...]:
    """Names of the free intrinsics besides the scale."""
    return tuple(p for g in groups_of(name) for p in GROUPS[g])


def models_by_camera(model: Model, cameras: Sequence[str]) -> tuple[str, ...]:
    """One name per camera; "auto" for a camera that the model does not name.

    Raises CalibrationError for unknown models and cameras, and for a sequence whose length is not
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
    """One name where all cameras have the same, else ``left=NAME,right=NAME``."""
    if len(set(names)) == 1:
        return names[0]
    return ",".join(f"{camera}={name}" for camera, name in zip(cameras, names))


def checked_model(model: str) -> str:
    """The model itself, checked before the cameras are known.

    Raises CalibrationError for an unknown name.
    """
    for name in _by_camera(model).values() if "=" in model else [model]:
        if name != AUTO:
            groups_of(name)
    return model


def _by_camera(model: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in model.split(",")]
    return {camera.strip(): name.strip() for camera, _, name in pairs}
