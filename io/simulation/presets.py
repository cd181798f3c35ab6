"""Named examples of simulated calibrations and runs. Their names stand in `preset_names`, too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeVar

from telerig.errors import InputError
from telerig.io.simulation.config import (
    BubbleConfig,
    CameraConfig,
    FluidConfig,
    ImageConfig,
    MotionConfig,
    RunConfig,
    SimulationConfig,
    StageConfig,
    TableConfig,
)
from telerig.rig.target import Target

Config = TypeVar("Config", bound=SimulationConfig | RunConfig)


def preset(name: str, **changes: Any) -> SimulationConfig:
    """Return a named calibration with fields replaced: ``preset("paper", angle_deg=40.0)``."""
    return _chosen(PRESETS, name, changes)


def run_preset(name: str, **changes: Any) -> RunConfig:
    """Return a named run with fields replaced: ``run_preset("swarm", frames=20, bubbles=40)``."""
    return _chosen(RUN_PRESETS, name, changes)


def any_preset(name: str) -> SimulationConfig | RunConfig:
    """Return a named calibration or run. Raises InputError for an unknown name."""
    both: dict[str, SimulationConfig | RunConfig] = {**PRESETS, **RUN_PRESETS}
    return _chosen(both, name, {})


def _chosen(presets: Mapping[str, Config], name: str, changes: Mapping[str, Any]) -> Config:
    if name not in presets:
        raise InputError(f"there is no preset {name!r}", todo=f"choose one of {', '.join(presets)}")
    fields = presets[name].__dataclass_fields__
    unknown = sorted(set(changes) - set(fields))
    if unknown:
        raise InputError(
            f"the preset {name} has no setting {', '.join(unknown)}",
            todo=f"choose among {', '.join(fields)}",
        )
    return replace(presets[name], **changes)


def _small_target(scale: float = 1.0, **changes: Any) -> Target:
    """Return a target of 3 x 5 dots; scale : of all lengths, 1 for dots of 2.4 mm, 7 mm apart."""
    target = Target(
        rows=3,
        columns=5,
        pitch_mm=(7.0 * scale, 7.0 * scale),
        dot_diameter_mm=2.4 * scale,
        marks=((1, 2), (1, 3), (0, 2)),
        mark_diameter_mm=3.6 * scale,
        scale_dots=(0, 14),
    )
    return replace(target, **changes)


def _pair(
    left: Mapping[str, float] | None = None,
    right: Mapping[str, float] | None = None,
    size_px: tuple[int, int] = (512, 512),
    scale_px_per_mm: float = 10.0,
) -> tuple[CameraConfig, CameraConfig]:
    """Return two cameras whose true scales and centres differ a little from the nominal ones."""
    nominal, ratio = scale_px_per_mm, scale_px_per_mm / 10
    left, right = left or {"k1": 2e-3}, right or {"k1": -1.5e-3}
    return (
        CameraConfig("left", size_px, 10.04 * ratio, nominal, (2.3, -1.7), left),
        CameraConfig("right", size_px, 9.97 * ratio, nominal, (-3.1, 0.8), right),
    )


def _like_paper(
    name: str, size_px: tuple[int, int], scale_px_per_mm: float, target_scale: float
) -> SimulationConfig:
    """Return the calibration `paper` for cameras of another size and scale."""
    cameras = _pair(size_px=size_px, scale_px_per_mm=scale_px_per_mm)
    reach = 15.0 * target_scale
    target = _small_target(target_scale)
    return SimulationConfig(name, cameras, target, shift_mm=(reach, reach, reach))


def _three_cameras() -> tuple[CameraConfig, ...]:
    return (
        CameraConfig("left", centre_offset_px=(2.3, -1.7), scale_px_per_mm=10.04),
        CameraConfig("middle", centre_offset_px=(-3.1, 0.8), scale_px_per_mm=9.97),
        CameraConfig("right", centre_offset_px=(1.2, 2.6), scale_px_per_mm=10.02),
    )


def _around(count: int, name: str) -> SimulationConfig:
    """Return a calibration for runs like `swarm`, seen by three or four cameras around the tank."""
    names = ("left", "middle", "right") if count == 3 else ("first", "second", "third", "fourth")
    truth = ((20.08, 2.3, -1.7), (19.94, -3.1, 0.8), (20.04, 1.2, 2.6), (19.9, 2.8, -2.2))
    cameras = tuple(
        CameraConfig(one, (1280, 800), scale, 20.0, (u, v), {"k1": k1})
        for one, (scale, u, v), k1 in zip(names, truth, (2e-3, -1.5e-3, 1e-3, -2e-3))
    )
    together = (*pairwise(names), *zip(names, names[1:], names[2:]))
    return SimulationConfig(
        name, cameras, _small_target(0.8), views=15, angle_deg=60.0 if count == 3 else 45.0,
        tilt_deg=(8.0, 65.0), shift_mm=(12.0, 12.0, 12.0), seen_by=together,
    )  # fmt: skip


def _unbounded_target() -> Target:
    marks = ((0, 0), (0, 5), (3, 0))
    grid = Target(extent="unbounded")
    origin, along = (int(grid.id_from_row_column(*mark)) for mark in marks[:2])
    return Target(
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


_CALIBRATIONS = (
    SimulationConfig("paper", _pair(), _small_target()),
    SimulationConfig(
        "dense",
        (
            CameraConfig("left", (1024, 1024), 20.06, 20.0, (4.2, -3.0), {"k1": 4e-3, "p1": 3e-4}),
            CameraConfig(
                "right", (1024, 1024), 19.95, 20.0, (-5.5, 2.1), {"k1": -3e-3, "p2": 2e-4}
            ),
        ),
        Target(
            rows=20,
            columns=20,
            pitch_mm=(2.2, 2.2),
            dot_diameter_mm=1.1,
            marks=((9, 9), (9, 11), (11, 9)),
            mark_diameter_mm=1.6,
            scale_dots=(105, 294),
            print_sigma_mm=0.005,
            flatness_sigma_mm=0.01,
        ),
        visible_fraction=0.7,
        shift_mm=(6.0, 6.0, 6.0),
    ),
    SimulationConfig(
        "scheimpflug",
        _pair(
            {"k1": 2e-3, "tilt_x": 0.12, "tilt_y": -0.02, "image_convergence_per_mm": 1 / 650},
            {"k1": -1.5e-3, "tilt_x": -0.1, "tilt_y": 0.03},
        ),
        _small_target(),
    ),
    SimulationConfig(
        "near_telecentric",
        _pair({"k1": 2e-3, "kappa_per_mm": 1e-4}, {"k1": -1.5e-3, "kappa_per_mm": -5e-5}),
        _small_target(),
    ),
    SimulationConfig(
        "symmetric",
        _pair(),
        Target(rows=5, columns=7, pitch_mm=(4.5, 4.5), dot_diameter_mm=2.0, scale_dots=(0, 34)),
    ),
    SimulationConfig(
        "unbounded",
        _pair(),
        _unbounded_target(),
        angle_deg=60.0,
        tilt_deg=(15.0, 55.0),
        shift_mm=(12.0, 12.0, 12.0),
        margin_dots=16,
        visible_fraction=0.0,
        light_gradient=0.4,
        vignetting=0.3,
        dirt=12,
    ),
    SimulationConfig(
        "two_sided",
        _pair(),
        _small_target(two_sided=True, plate_thickness_mm=2.0, plate_index=1.52),
        angle_deg=150.0,
        tilt_deg=(10.0, 60.0),
        background=0.1,
    ),
    SimulationConfig(
        "three",
        _three_cameras(),
        _small_target(),
        views=15,
        angle_deg=60.0,
        tilt_deg=(8.0, 65.0),
        seen_by=(
            ("left", "middle"),
            ("middle", "right"),
            ("left", "middle", "right"),
        ),
    ),
)


def _scenario(
    name: str, frame_rate_hz: float, shake_hz: float, shake_mm: float, sigma_px: float
) -> RunConfig:
    """Return a benchmark of the smoother: 0.1 mm/px, 1.5 s (S0: 59 frames), everything measured."""
    return RunConfig(
        name,
        _like_paper(name, (1024, 1024), 10.0, 1.0),
        frames=59 if name == "S0" else round(1.5 * frame_rate_hz),
        frame_rate_hz=frame_rate_hz,
        motion=MotionConfig(
            "stochastic", wander_mm_s=10.0, lateral_oscillation=(2.0, 6.0, 0.03), spread=(0.5, 0.5)
        ),
        stage=StageConfig(
            ramp_s=0.1, shake_hz=shake_hz, shake_mm=shake_mm, accelerometers=("left", "right")
        ),
        table=TableConfig(sigma_px=sigma_px, centre="volume", particle_ids=True, references=4),
    )


_SWARM = RunConfig(
    "swarm",
    _like_paper("swarm", (1280, 800), 20.0, 0.8),
    frames=100,
    frame_rate_hz=500.0,
    bubbles=20,
    bubble=BubbleConfig(
        d_eq_mm=(0.8, 4.0),
        aspect=(1.0, 1.35),
        triaxial=0.04,
        modes_static={3: 0.006, 4: 0.004},
        modes_oscillating={2: 0.02, 3: 0.012},
    ),
    motion=MotionConfig(
        "stochastic",
        rise_mm_s=(220.0, 280.0),
        wander_mm_s=10.0,
        lateral_oscillation=(0.8, 6.0, 0.05),
        spread=(0.9, 0.9),
    ),
    stage=StageConfig(follow=0.6, ramp_s=0.0, shake_mm=0.05),
    image=ImageConfig(window_dirt=30, lens_dirt=25, defocus_px_per_mm=0.05),
)


_RUNS = (
    RunConfig(
        "rise",
        SimulationConfig("rise", _pair(), _small_target()),
        bubble=BubbleConfig(
            d_eq_mm=(4.0, 5.0), modes_static={3: 0.02}, modes_oscillating={2: 0.04, 3: 0.03}
        ),
    ),
    _SWARM,
    replace(_SWARM, name="swarm_three", calibration=_around(3, "swarm_three")),
    replace(_SWARM, name="swarm_four", calibration=_around(4, "swarm_four")),
    RunConfig(
        "crossing",
        _like_paper("crossing", (1280, 800), 40.0, 0.45),
        frames=30,
        bubbles=10,
        bubble=BubbleConfig(d_eq_mm=(0.22, 0.24), aspect=(1.0, 1.05), triaxial=0.0),
        motion=MotionConfig(
            "stochastic",
            wander_mm_s=10.0,
            lateral_oscillation=(0.5, 6.0, 0.03),
            spread=(0.6, 0.6),
            pairs=True,
        ),
        stage=StageConfig(ramp_s=0.0, shake_mm=0.2),
        table=TableConfig(centre="volume"),
    ),
    RunConfig(
        "forces",
        _like_paper("forces", (1280, 800), 20.0, 0.8),
        frames=250,
        frame_rate_hz=500.0,
        bubbles=6,
        bubble=BubbleConfig(
            d_eq_mm=(1.5, 4.5), aspect="wellek", triaxial=0.04, modes_oscillating={2: 0.02}
        ),
        motion=MotionConfig("forces", rise_mm_s=(220.0, 260.0), spread=(0.8, 0.8)),
        stage=StageConfig(
            ramp_s=0.0,
            shake_mm=0.05,
            accelerometers=("left", "right"),
        ),
        table=TableConfig(
            sigma_px=0.05, centre="volume", particle_ids=True, noisy_axes=True, references=4
        ),
        fluid=FluidConfig(),
    ),
    _scenario("S0", 100.0, shake_hz=12.0, shake_mm=0.2, sigma_px=1.5),
    _scenario("S1", 500.0, shake_hz=8.0, shake_mm=0.2, sigma_px=0.5),
    _scenario("S2", 500.0, shake_hz=20.0, shake_mm=0.2, sigma_px=0.5),
    _scenario("S3", 500.0, shake_hz=12.0, shake_mm=0.2, sigma_px=0.5),
    _scenario("S4", 1000.0, shake_hz=40.0, shake_mm=0.5, sigma_px=0.1),
    _scenario("S5", 100.0, shake_hz=8.0, shake_mm=0.05, sigma_px=1.5),
    _scenario("S6", 500.0, shake_hz=8.0, shake_mm=0.5, sigma_px=0.5),
)

PRESETS: Mapping[str, SimulationConfig] = {one.name: one for one in _CALIBRATIONS}
RUN_PRESETS: Mapping[str, RunConfig] = {one.name: one for one in _RUNS}
