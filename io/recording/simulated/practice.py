"""The devices, and the rig, of `telerig simulate --devices`."""

from __future__ import annotations

from collections.abc import Sequence

from telerig.io.recording.simulated.signals import SimulatedDevice
from telerig.io.rig_file.description import (
    AccelerometerDescription,
    CameraDescription,
    DeviceDescription,
    RigDescription,
    StageDescription,
)
from telerig.rig.target import Target

WRAP_AFTER_S = 10.0


def practice_devices() -> list[SimulatedDevice]:
    """Encoder at 1 kHz, an accelerometer at 2 kHz on each arm, cameras' frame counter at 100 Hz.

    Their clocks drift, and the encoder's counter wraps after `WRAP_AFTER_S`.
    """
    before_wrap = 2**32 - int(WRAP_AFTER_S * 1e6)
    encoder = DeviceDescription("encoder", "encoder", "", counts_per_mm=1000.0)
    left = DeviceDescription("arm_left", "accelerometer", "")
    right = DeviceDescription("arm_right", "accelerometer", "", protocol="packets", unit_m_s2=1e-3)
    frames = DeviceDescription("frame_counter", "frames", "", cameras=("left", "right"))
    return [
        SimulatedDevice(encoder, 1000.0, drift_ppm=40.0, start_ticks=before_wrap),
        SimulatedDevice(left, 2000.0, drift_ppm=-60.0),
        SimulatedDevice(right, 2000.0, drift_ppm=15.0, start_ticks=123_456),
        SimulatedDevice(frames, 100.0, drift_ppm=5.0),
    ]


def practice_rig(devices: Sequence[DeviceDescription]) -> RigDescription:
    """A rig of two cameras that knows these devices."""
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    sensors = [d.name for d in devices if d.kind == "accelerometer"]
    cameras = {name: CameraDescription(name, (512, 512), 10.0) for name in ("left", "right")}
    return RigDescription(
        name="practice",
        cameras=cameras,
        target=Target(rows=3, columns=5, pitch_mm=(7.0, 7.0), dot_diameter_mm=2.4),
        rotvec_from_first_deg={"right": (0.0, 90.0, 0.0)},
        stage=StageDescription((0.0, -1.0, 0.0), (0.0, -1.0, 0.0)),
        accelerometers={
            name: AccelerometerDescription(name, name.removeprefix("arm_"), axes, 22.5)
            for name in sensors
        },
        devices={d.name: d for d in devices},
    )
