"""What a simulated calibration is like: every number that can be set, and named examples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from telerig.errors import InputError
from telerig.rig.target import Target

Range = tuple[float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class CameraConfig:
    """A true camera, and what the rig file will say of it.

    scale_px_per_mm : true; nominal_scale_px_per_mm : in `rig.toml`.
    centre_offset_px : of the optical axis from the image's centre.
    parameters : further true parameters by their names in `telerig.rig.projection.PARAMETERS`.
    nominal_telecentricity_per_mm : in `rig.toml`; None leaves it out.
    """

    name: str
    image_size_px: tuple[int, int] = (512, 512)
    scale_px_per_mm: float = 10.0
    nominal_scale_px_per_mm: float = 10.0
    centre_offset_px: Range = (0.0, 0.0)
    parameters: Mapping[str, float] = field(default_factory=dict)
    nominal_telecentricity_per_mm: float | None = None


@dataclass(frozen=True)
class SimulationConfig:
    """A rig, a target, hand-held poses and the quality of the images.

    Rig: the second camera is turned by ``angle_deg`` about the rig's y axis, then by the mounting
    error ``mount_rotvec_deg``, which the rig file does not know; the optical axes pass each other
    at ``axis_gap_mm``. One or two cameras.

    Target: true dots are off by ``target.print_sigma_mm`` in the plane and
    ``target.flatness_sigma_mm`` out of it, times ``print_factor``. The known distance is measured
    on the true dots, within ``target.scale_sigma_mm``. Of an unbounded grid, ``margin_dots``
    beyond the block exist. ``ring_hole_ratio`` is a ring's hole over its diameter.

    Poses: the angle between each optical axis and the plate's normal is within ``tilt_deg``, the
    roll within +-``roll_deg``, the middle of the target within +-``shift_mm`` of the rig's origin
    along the rig's axes. At least ``visible_fraction`` of the dots lie wholly inside the images,
    ``border_px`` from their border, and the marks too if ``marks_visible``. The last
    ``single_camera_views`` views are seen by one camera only, in turn.

    Dot tables (no images): ``sigma_px`` per coordinate; a share ``outlier_fraction`` is off by
    ``outlier_px`` (standard deviation) besides. With ``sigma_px`` 0 the table is exact.

    Images: ``blur_px`` (Gaussian sigma); ``noise`` is that of reading over the contrast between
    dot and plate; ``shot_noise`` at full scale, over full scale; ``white``, ``black`` and
    ``background`` are fractions of full scale. ``light_gradient`` per half diagonal in a random
    direction, ``vignetting`` in the corners, ``exposure_spread`` from image to image (relative),
    ``glare`` (strength over full scale) at a random place, ``dirt`` specks per plate.
    """

    name: str
    cameras: tuple[CameraConfig, ...]
    target: Target
    views: int = 12
    angle_deg: float = 90.0
    mount_rotvec_deg: Vector = (0.4, -0.7, 0.5)
    axis_gap_mm: float = 0.3
    print_factor: float = 1.0
    margin_dots: int = 0
    plate_margin_mm: float = 4.0
    ring_hole_ratio: float = 0.4
    tilt_deg: Range = (25.0, 65.0)
    roll_deg: float = 180.0
    shift_mm: Vector = (15.0, 15.0, 15.0)
    visible_fraction: float = 1.0
    marks_visible: bool = True
    border_px: float = 6.0
    single_camera_views: int = 0
    sigma_px: float = 0.01
    outlier_fraction: float = 0.0
    outlier_px: float = 10.0
    blur_px: float = 0.8
    noise: float = 0.01
    shot_noise: float = 0.0
    bit_depth: int = 8
    white: float = 0.7
    black: float = 0.1
    background: float = 0.22
    light_gradient: float = 0.15
    vignetting: float = 0.1
    exposure_spread: float = 0.05
    glare: float = 0.0
    glare_radius_px: float = 20.0
    dirt: int = 0
    dirt_diameter_mm: Range = (0.1, 0.5)

    def __post_init__(self) -> None:
        """Raises InputError for values that no simulation can have."""
        faults = [
            ("views", self.views < 1, "at least 1"),
            (
                "tilt_deg",
                not 0 <= self.tilt_deg[0] < self.tilt_deg[1] <= 85,
                "0 <= low < high <= 85",
            ),
            ("visible_fraction", not 0 <= self.visible_fraction <= 1, "between 0 and 1"),
            ("outlier_fraction", not 0 <= self.outlier_fraction <= 1, "between 0 and 1"),
            ("single_camera_views", not 0 <= self.single_camera_views <= self.views, "0 to views"),
        ]
        amounts = ("sigma_px", "outlier_px", "blur_px", "noise", "shot_noise", "print_factor",
                   "margin_dots", "dirt", "exposure_spread", "glare")  # fmt: skip
        faults += [(name, not getattr(self, name) >= 0, "0 or more") for name in amounts]
        for name, wrong, wanted in faults:
            if wrong:
                raise InputError(
                    f"{name} is {getattr(self, name)}",
                    where=f"simulation {self.name!r}",
                    todo=f"must be {wanted}",
                )


def preset(name: str, **changes: Any) -> SimulationConfig:
    """A named example, with some fields replaced: ``preset("paper", angle_deg=40.0, views=8)``.

    Raises InputError for an unknown name or field.
    """
    if name not in PRESETS:
        raise InputError(f"no preset {name!r}", todo=f"choose one of {', '.join(PRESETS)}")
    unknown = set(changes) - set(SimulationConfig.__dataclass_fields__)
    if unknown:
        raise InputError(
            f"a simulation has no setting {sorted(unknown)}",
            todo=f"choose among {', '.join(SimulationConfig.__dataclass_fields__)}",
        )
    return replace(PRESETS[name](), **changes)


def _pair(
    left: Mapping[str, float] | None = None, right: Mapping[str, float] | None = None
) -> tuple[CameraConfig, CameraConfig]:
    return (
        CameraConfig("left", (512, 512), 10.04, 10.0, (2.3, -1.7), left or {"k1": 2e-3}),
        CameraConfig("right", (512, 512), 9.97, 10.0, (-3.1, 0.8), right or {"k1": -1.5e-3}),
    )


def _small_target() -> Target:
    return Target(
        rows=3,
        columns=5,
        pitch_mm=(7.0, 7.0),
        dot_diameter_mm=2.4,
        marks=((1, 2), (1, 3), (0, 2)),
        mark_diameter_mm=3.6,
        scale_dots=(0, 14),
    )


def _paper() -> SimulationConfig:
    return SimulationConfig("paper", _pair(), _small_target())


def _dense() -> SimulationConfig:
    cameras = (
        CameraConfig("left", (1024, 1024), 20.06, 20.0, (4.2, -3.0), {"k1": 4e-3, "p1": 3e-4}),
        CameraConfig("right", (1024, 1024), 19.95, 20.0, (-5.5, 2.1), {"k1": -3e-3, "p2": 2e-4}),
    )
    target = Target(
        rows=20,
        columns=20,
        pitch_mm=(2.2, 2.2),
        dot_diameter_mm=1.1,
        marks=((9, 9), (9, 11), (11, 9)),
        mark_diameter_mm=1.6,
        scale_dots=(105, 294),
        print_sigma_mm=0.005,
        flatness_sigma_mm=0.01,
    )
    return SimulationConfig(
        "dense", cameras, target, visible_fraction=0.7, shift_mm=(6.0, 6.0, 6.0)
    )


def _scheimpflug() -> SimulationConfig:
    left = {
        "k1": 2e-3,
        "tilt_x": 0.12,
        "tilt_y": -0.02,
        "image_convergence_per_mm": 1 / 650,
    }
    return SimulationConfig(
        "scheimpflug", _pair(left, {"k1": -1.5e-3, "tilt_x": -0.1, "tilt_y": 0.03}), _small_target()
    )


def _near_telecentric() -> SimulationConfig:
    left = {"k1": 2e-3, "kappa_per_mm": 1e-4}
    right = {"k1": -1.5e-3, "kappa_per_mm": -5e-5}
    return SimulationConfig("near_telecentric", _pair(left, right), _small_target())


def _symmetric() -> SimulationConfig:
    target = Target(
        rows=5,
        columns=7,
        pitch_mm=(4.5, 4.5),
        dot_diameter_mm=2.0,
        scale_dots=(0, 34),
    )
    return SimulationConfig("symmetric", _pair(), target)


def _unbounded() -> SimulationConfig:
    grid = Target(extent="unbounded")
    marks = ((0, 0), (0, 5), (3, 0))
    origin, along = (int(grid.id_from_row_column(*mark)) for mark in marks[:2])
    target = Target(
        rows=4,
        columns=6,
        pitch_mm=(5.0, 5.0),
        dot_diameter_mm=2.2,
        polarity="black_on_white",
        marks=marks,
        mark_style="ring",
        extent="unbounded",
        scale_dots=(origin, along),
    )
    return SimulationConfig(
        "unbounded",
        _pair(),
        target,
        angle_deg=60.0,
        tilt_deg=(15.0, 55.0),
        shift_mm=(12.0, 12.0, 12.0),
        margin_dots=16,
        visible_fraction=0.0,
        light_gradient=0.4,
        vignetting=0.3,
        dirt=12,
    )


def _two_sided() -> SimulationConfig:
    target = replace(_small_target(), two_sided=True, plate_thickness_mm=2.0, plate_index=1.52)
    return SimulationConfig(
        "two_sided", _pair(), target, angle_deg=150.0, tilt_deg=(10.0, 60.0), background=0.1
    )


PRESETS: Mapping[str, Callable[[], SimulationConfig]] = {
    "paper": _paper,
    "dense": _dense,
    "scheimpflug": _scheimpflug,
    "near_telecentric": _near_telecentric,
    "symmetric": _symmetric,
    "unbounded": _unbounded,
    "two_sided": _two_sided,
}
"""Named examples; `preset` makes one."""
