"""What `rig.toml` states: the rig before calibration. Lengths mm, directions unit vectors.

The types of the fields say what a table of the file may hold (`tables.read_table` checks it); an
object that Python code makes is not checked before it is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, get_args

import numpy as np
from pydantic import ConfigDict, Field

from telerig.arrays import Array
from telerig.errors import InputError, suggestion
from telerig.rig.target import Polarity, Target
from telerig.rig.units import STANDARD_GRAVITY_M_S2
from telerig.rig.windows import Wall

SCHEMA = 1
"""The newest `schema` of rig.toml that is read, and the one that is written."""

MOST_CAMERAS = 4
"""Cameras that a rig may have."""

CARRIAGE = "carriage"
"""`mounted_on` of an accelerometer that sits on the stage itself; no camera may be called so."""

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0, description="a positive number")]
Count = Annotated[int, Field(ge=1, description="a whole number from 1")]
Index = Annotated[float, Field(ge=1, description="a refractive index, 1 or more")]
Text = Annotated[str, Field(min_length=1)]
Direction = Annotated[
    Vector,
    Field(description="three numbers, a direction in the rig frame, like [0.0, -1.0, 0.0]"),
]

Kind = Literal["encoder", "accelerometer", "frames"]
Protocol = Literal["stream", "packets", "zaber", "grbl", "regex"]
KINDS: tuple[Kind, ...] = get_args(Kind)


class Table:
    """A table of rig.toml. Numbers must not be written as text, and must not be NaN.

    The description of each field completes the sentence "... must be" in an error.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(strict=True, allow_inf_nan=False)


@dataclass(frozen=True)
class CameraDescription(Table):
    """What rig.toml states about one camera, with nominal scale and residual perspective."""

    name: str
    image_size_px: Annotated[
        tuple[Count, Count], Field(description="[width, height] in whole pixels")
    ]
    scale_px_per_mm: Annotated[Positive, Field(description="a positive number, nominal, like 10.0")]
    telecentricity_per_mm: Annotated[
        float | None,
        Field(description="a number: 0.0 telecentric, 1 / working distance for a perspective lens"),
    ] = None


@dataclass(frozen=True)
class StageDescription(Table):
    """What rig.toml states about the stage.

    axis : (3,) nominal direction of travel.
    up : (3,) direction against gravity. Both are unit vectors in the rig frame.
    position_sigma_mm : standard deviation of an encoder reading.
    scale_sigma : standard deviation of the encoder's relative scale error; None if the file does
        not state it.
    delay_sigma_s : standard deviation of how much later than the images the encoder is read; None
        if the file does not state it.
    """

    axis: Direction
    up: Direction
    position_sigma_mm: Positive = 0.005
    scale_sigma: Annotated[
        float | None,
        Field(ge=0, lt=0.5, description="a share like 0.001: how far the scale may be off"),
    ] = None
    gravity_m_s2: Annotated[
        float,
        Field(
            ge=9.7,
            le=9.9,
            description="the laboratory's gravity in m/s^2, from 9.7 to 9.9, like 9.80665",
        ),
    ] = STANDARD_GRAVITY_M_S2
    delay_sigma_s: Annotated[
        float | None,
        Field(ge=0, lt=1, description="seconds like 0.0001: how late the encoder may be read"),
    ] = None


@dataclass(frozen=True)
class AccelerometerDescription(Table):
    """What rig.toml states about one accelerometer.

    mounted_on : name of the camera whose arm carries the sensor, or "carriage".
    axes : (3, 3) whose rows are the sensor's axes as unit vectors in the rig frame.
    bias_sigma_m_s2 : prior standard deviation of the bias of each axis.
    range_m_s2 : reading at which the sensor is clipped; None if it is not stated.
    clock : "frames" if its times come from the clock of the frames, "unknown" if the offset of its
        clock has to be found from the images.
    """

    name: str
    mounted_on: Annotated[str, Field(description='a camera\'s name or "carriage"')]
    axes: Annotated[
        tuple[Vector, Vector, Vector],
        Field(description="three rows: the sensor's x, y, z axes in rig coordinates"),
    ]
    noise_density_ug_sqrt_hz: Annotated[
        Positive, Field(description="a positive number (the data sheet's, in micro-g per root Hz)")
    ]
    bias_sigma_m_s2: Positive = 0.2
    range_m_s2: Annotated[
        float | None, Field(gt=0, description="a positive number: 16 g are 156.9 m/s^2")
    ] = None
    clock: Literal["frames", "unknown"] | None = None


@dataclass(frozen=True)
class ReferencesDescription(Table):
    """Describe the marks: dots at unknown places, fixed to the tank and seen by the cameras."""

    kind: Literal["dots"] = "dots"
    polarity: Polarity = "black_on_white"
    dot_diameter_mm: Positive = 1.0


@dataclass(frozen=True)
class FluidDescription(Table):
    """Describe the liquid in which the bubbles rise, and their gas.

    velocity_mm_s : the liquid's own velocity in the lab, along the axes of the rig frame, or one
        number upwards; None when the file does not state it, which counts as a liquid at rest.
    gas_density_kg_m3 : density of the gas, 0 when the file does not state it.
    """

    density_kg_m3: Annotated[Positive, Field(description="a positive number: 998.2 for water")]
    viscosity_pa_s: Annotated[
        Positive, Field(lt=100, description="a positive number in Pa s: 0.001 for water")
    ]
    surface_tension_n_m: Annotated[
        Positive, Field(lt=5, description="a positive number in N/m: 0.0728 for water and air")
    ]
    velocity_mm_s: Annotated[
        float | Vector | None,
        Field(description="three numbers along the rig's axes, or one number upwards"),
    ] = None
    gas_density_kg_m3: Annotated[float, Field(ge=0, description="0 or more: 1.2 for air")] = 0.0


@dataclass(frozen=True)
class FieldDescription(Table):
    """Describe where in a camera's images bubbles are looked for: a polygon, or a mask."""

    camera: str
    region: Annotated[
        tuple[tuple[float, float], ...] | None,
        Field(description="three or more corners (u, v) in px: [[100, 50], [900, 50], [900, 700]]"),
    ] = None
    mask: Annotated[Text | None, Field(description='a file, like "mask.png"')] = None


@dataclass(frozen=True)
class WallDescription(Table):
    """Describe the plane glass between a camera and the water, in that camera's frame.

    normal : (3,) unit vector that points away from the camera (z > 0).
    indices : refractive indices on the camera's side, of the glass, and behind it.
    distance_mm : along the camera's axis from its origin to the near face; None is allowed for
        kappa = 0, where only the image's place depends on it.
    normal_sigma_deg : standard deviation of the normal's direction.
    """

    camera: str
    normal: Annotated[
        Vector, Field(description="three numbers in the camera's frame, like [0.0, 0.0, 1.0]")
    ]
    indices: Annotated[
        tuple[Index, Index, Index],
        Field(description="three refractive indices of 1 or more, like [1.0, 1.52, 1.333]"),
    ]
    thickness_mm: Positive
    distance_mm: Annotated[
        float | None, Field(description="a number, negative before the origin")
    ] = None
    normal_sigma_deg: Annotated[float, Field(ge=0, le=10, description="degrees from 0 to 10")] = 0.0

    def wall(self) -> Wall:
        """Return the `Wall`; without a distance its near face is at the camera's origin."""
        sigma_rad = float(np.radians(self.normal_sigma_deg))
        distance_mm = self.distance_mm or 0.0
        return Wall(np.array(self.normal), distance_mm, self.thickness_mm, self.indices, sigma_rad)


@dataclass(frozen=True)
class DeviceDescription(Table):
    """One serial line: `[devices.<name>]`.

    kind : what it measures; an accelerometer is named as in `[accelerometers.<name>]`.
    port : a device file, a port name or a pyserial URL.
    baud : ignored by USB-native devices.
    protocol : format of the bytes that the device sends, see `docs/recording.md`.
    pattern : the regular expression of the protocol "regex".
    poll : text that is sent to ask for one reading, `poll_hz` times a second; None for a device
        that sends readings by itself.
    counts_per_mm : encoder counts (or microsteps) in 1 mm.
    unit_m_s2 : acceleration of one unit.
    time_unit_s, time_bits : unit of the device's time stamps, and their number of bits: the stamps
        wrap at 2**time_bits, or never for 0.
    checksum : "xor" demands `*hh` at the end of a line, as in NMEA 0183.
    latency_s : least delay of the line, which is subtracted from all times; recorded times do not
        show it. If frames are stamped at the beginning of their exposure, subtract half the
        exposure from it.
    axis : which of the positions that GRBL sends.
    cameras : the cameras whose frames the counter counts.
    """

    name: str
    kind: Kind
    port: Annotated[Text, Field(description='text like "/dev/ttyUSB0"')]
    baud: Annotated[int, Field(ge=50, description="a whole number like 115200")] = 115200
    protocol: Protocol = "stream"
    pattern: Annotated[str | None, Field(description="a regular expression in single quotes")] = (
        None
    )
    poll: Annotated[
        Text | None,
        Field(description='the text that asks for one reading, like "?" or "/1 get pos\\n"'),
    ] = None
    poll_hz: Positive = 50.0
    counts_per_mm: Annotated[float | None, Field(description="a number that is not 0")] = None
    unit_m_s2: Annotated[Positive, Field(description="a positive number: m/s^2 in one unit")] = 1.0
    time_unit_s: Annotated[
        Positive, Field(description="a positive number: 1e-6 for microseconds")
    ] = 1e-6
    time_bits: Annotated[
        int, Field(ge=0, le=52, description="a whole number from 0 (never wraps) to 52")
    ] = 32
    checksum: Literal["none", "xor"] = "none"
    latency_s: Annotated[float, Field(description="a number of seconds")] = 0.0
    axis: Literal["x", "y", "z"] = "x"
    cameras: Annotated[tuple[str, ...], Field(description="a list of the cameras' names")] = ()

    @property
    def wrap_s(self) -> float:
        """Return after which time its stamps start again, in s; 0 for never."""
        return 2.0**self.time_bits * self.time_unit_s if self.time_bits else 0.0

    def measured(self, values: Mapping[str, Array]) -> dict[str, Array]:
        """Return readings (N,), given as sent, in mm (encoder) or by axis in m/s^2.

        Those of an encoder have the name "". A frame counter measures nothing.
        """
        if self.kind == "accelerometer":
            return {axis: self.unit_m_s2 * values[f"a{axis}"] for axis in "xyz"}
        if "position_mm" in values:
            return {"": values["position_mm"]}
        return {"": values["counts"] / (self.counts_per_mm or 1.0)} if "counts" in values else {}


@dataclass(frozen=True)
class RigDescription:
    """Hold the whole content of `rig.toml`; the first camera's frame is the rig frame.

    cameras, accelerometers, walls, devices : the tables of the file by name. A device is a sensor
        on a serial line.
    rotvec_from_first_deg : by camera, the nominal rotation vector (3,) in degrees of
        <camera>_from_<first>, for the cameras that the file states. It decides the mirror
        ambiguity.
    tracking : the cameras whose images of bubbles are used, in the rig's order; None when the file
        does not state them, which means all that have images in a run.
    stage, references : None when the file has no such table.
    bubbles : by camera, where in its images bubbles are looked for.
    fluid : the liquid of the tank; None when the file has no such table.
    """

    name: str
    cameras: Mapping[str, CameraDescription]
    target: Target
    rotvec_from_first_deg: Mapping[str, Vector] = field(default_factory=dict)
    tracking: tuple[str, ...] | None = None
    stage: StageDescription | None = None
    accelerometers: Mapping[str, AccelerometerDescription] = field(default_factory=dict)
    references: ReferencesDescription | None = None
    walls: Mapping[str, WallDescription] = field(default_factory=dict)
    devices: Mapping[str, DeviceDescription] = field(default_factory=dict)
    bubbles: Mapping[str, FieldDescription] = field(default_factory=dict)
    fluid: FluidDescription | None = None

    @property
    def first(self) -> str:
        """Name of the first camera, whose frame is the rig frame."""
        return next(iter(self.cameras))

    @property
    def others(self) -> tuple[str, ...]:
        """Names of every camera but the first."""
        return tuple(self.cameras)[1:]

    @property
    def tracking_cameras(self) -> tuple[str, ...]:
        """Names of the cameras that tracking uses."""
        return self.tracking or tuple(self.cameras)

    @property
    def windows(self) -> dict[str, Wall]:
        """The windows that `[walls]` states, by camera."""
        return {name: wall.wall() for name, wall in self.walls.items()}

    def camera_name(self, camera: str | int) -> str:
        """Return the camera's name from name or index. Raises InputError for an unknown one."""
        return camera_named(camera, list(self.cameras), where="rig.toml")


def rotvec_key(camera: str, first: str) -> str:
    """Return the key of the table `[stereo]` that holds a camera's nominal rotation."""
    return f"{camera}_from_{first}_rotvec_deg"


def camera_named(camera: str | int, names: list[str], *, where: str) -> str:
    """Return a camera's name from its name or index in ``names``; InputError for another one."""
    if isinstance(camera, int) and 0 <= camera < len(names):
        return names[camera]
    if isinstance(camera, str) and camera in names:
        return camera
    todo = suggestion(str(camera), names)
    raise InputError(f"there is no camera {camera!r}", where=where, todo=todo)
