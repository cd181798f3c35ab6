"""What `rig.toml` says of a sensor on a serial line: `[devices.<name>]`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["encoder", "accelerometer", "frames"]
Protocol = Literal["stream", "packets", "zaber", "grbl", "regex"]

KINDS: tuple[Kind, ...] = ("encoder", "accelerometer", "frames")


@dataclass(frozen=True)
class DeviceDescription:
    """One serial line.

    kind : what it tells; an accelerometer is named as in `[accelerometers.<name>]`.
    port : a device file, a port name or a pyserial URL. baud : ignored by USB-native devices.
    protocol : how its bytes read, see `docs/recording.md`. pattern : its regular expression.
    poll : what is sent to ask for one reading, `poll_hz` times a second; None for streams.
    counts_per_mm : encoder counts (or microsteps) in 1 mm. unit_m_s2 : acceleration of one unit.
    time_unit_s, time_bits : of the device's own clock, which wraps at 2**time_bits; 0 never.
    checksum : "xor" demands `*hh` at a line's end, as NMEA 0183 has it.
    latency_s : known least delay of the line, which one-way stamps cannot see; subtracted. For
    frames stamped at the begin of their exposure add minus half the exposure.
    axis : which of GRBL's positions. cameras : those whose frames the counter counts.
    """

    name: str
    kind: Kind
    port: str
    baud: int = 115200
    protocol: Protocol = "stream"
    pattern: str | None = None
    poll: str | None = None
    poll_hz: float = 50.0
    counts_per_mm: float | None = None
    unit_m_s2: float = 1.0
    time_unit_s: float = 1e-6
    time_bits: int = 32
    checksum: Literal["none", "xor"] = "none"
    latency_s: float = 0.0
    axis: Literal["x", "y", "z"] = "x"
    cameras: tuple[str, ...] = ()
