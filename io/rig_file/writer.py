"""The text of a `rig.toml`, with a comment where a reader may wonder."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from typing import Any

import numpy as np

from telerig.io.rig_file.description import (
    SCHEMA,
    AccelerometerDescription,
    CameraDescription,
    RigDescription,
    StageDescription,
    WallDescription,
)
from telerig.io.rig_file.device_description import DeviceDescription
from telerig.rig.target import Target

Line = tuple[str, Any, str]


def rig_toml(rig: RigDescription) -> str:
    """The text of the rig file; keys whose value is None are left out."""
    blocks = [_lines([("schema", SCHEMA, ""), ("name", rig.name, "")])]
    blocks += [_block(f"cameras.{_key(c.name)}", _camera(c)) for c in rig.cameras.values()]
    if rig.second_from_first_rotvec_deg is not None:
        key = f"{rig.second}_from_{rig.first}_rotvec_deg"
        comment = "nominal; decides the mirror twin"
        blocks.append(_block("stereo", [(key, rig.second_from_first_rotvec_deg, comment)]))
    blocks.append(_block("target", _target(rig.target)))
    if rig.stage is not None:
        blocks.append(_block("stage", _stage(rig.stage, rig.first)))
    for sensor in rig.accelerometers.values():
        blocks.append(_block(f"accelerometers.{_key(sensor.name)}", _accelerometer(sensor)))
    blocks += [_block(f"devices.{_key(d.name)}", _device(d)) for d in rig.devices.values()]
    if rig.references is not None:
        r = rig.references
        keys = ("kind", "polarity", "dot_diameter_mm")
        blocks.append(_block("references", [(key, getattr(r, key), "") for key in keys]))
    blocks += [_block(f"walls.{_key(w.camera)}", _wall(w)) for w in rig.walls.values()]
    return "\n".join(blocks)


def _camera(camera: CameraDescription) -> list[Line]:
    return [
        ("image_size_px", camera.image_size_px, "width, height"),
        ("scale_px_per_mm", camera.scale_px_per_mm, "nominal, 20 % is good enough"),
        (
            "telecentricity_per_mm",
            camera.telecentricity_per_mm,
            "nominal residual perspective; 1 / working distance for a perspective lens",
        ),
    ]


def _target(t: Target) -> list[Line]:
    grid = t.layout == "grid"
    block = "the block in which dots are counted" if t.extent == "unbounded" else ""
    pitch = t.pitch_mm[0] if t.pitch_mm[0] == t.pitch_mm[1] else t.pitch_mm
    plate = t.two_sided or t.plate_thickness_mm > 0
    return [
        ("layout", t.layout, ""),
        ("rows", t.rows if grid and t.rows else None, block),
        ("columns", t.columns if grid and t.columns else None, ""),
        ("pitch_mm", pitch if grid else None, "x, y" if pitch is t.pitch_mm else ""),
        ("points_mm", None if grid else t.points_mm, "nominal x, y of each dot"),
        ("dot_diameter_mm", t.dot_diameter_mm, ""),
        ("polarity", t.polarity, ""),
        ("marks", t.marks or None, "row, column"),
        ("mark_style", t.mark_style, ""),
        ("mark_diameter_mm", t.mark_diameter_mm, ""),
        ("extent", t.extent if grid else None, ""),
        ("print_sigma_mm", t.print_sigma_mm, "how far a dot may be from its nominal place"),
        ("flatness_sigma_mm", t.flatness_sigma_mm, "and out of the plane"),
        ("scale_dots", _scale_dots(t), "two dots whose distance is known: sets the scale"),
        ("scale_distance_mm", t.scale_distance_mm, ""),
        ("scale_sigma_mm", t.scale_sigma_mm, ""),
        ("two_sided", t.two_sided or None, "the plate is transparent"),
        ("plate_thickness_mm", t.plate_thickness_mm or None, ""),
        ("plate_index", t.plate_index if plate else None, ""),
    ]


def _scale_dots(t: Target) -> Any:
    if t.scale_dots is None or t.bounded:
        return t.scale_dots
    return np.transpose(t.row_column_from_id(np.array(t.scale_dots)))


def _stage(stage: StageDescription, first: str) -> list[Line]:
    lines: list[Line] = [
        (f"axis_{first}", stage.axis, "nominal travel direction in the rig frame"),
        (f"up_{first}", stage.up, "away from gravity"),
        ("position_sigma_mm", stage.position_sigma_mm, ""),
    ]
    if stage.scale_sigma is not None:
        lines.append(("scale_sigma", stage.scale_sigma, "of the encoder, relative"))
    return lines


def _accelerometer(sensor: AccelerometerDescription) -> list[Line]:
    return [
        ("mounted_on", sensor.mounted_on, 'a camera or "carriage"'),
        ("axes", sensor.axes, "rows: the sensor's x, y, z axes in rig coordinates"),
        ("noise_density_ug_sqrt_hz", sensor.noise_density_ug_sqrt_hz, ""),
        ("bias_sigma_m_s2", sensor.bias_sigma_m_s2, ""),
    ]


def _device(device: DeviceDescription) -> list[Line]:
    usual = {f.name: f.default for f in fields(device)}
    given = {key: getattr(device, key) for key in usual if key != "name"}
    return [(key, value, "") for key, value in given.items() if value != usual[key]]


def _wall(wall: WallDescription) -> list[Line]:
    return [
        ("normal", wall.normal, "in the camera's frame"),
        ("indices", wall.indices, "camera side, glass, behind"),
        ("thickness_mm", wall.thickness_mm, ""),
        ("distance_mm", wall.distance_mm, "of the near face on the camera's axis"),
        ("normal_sigma_deg", wall.normal_sigma_deg or None, ""),
    ]


def _block(table: str, lines: list[Line]) -> str:
    return f"[{table}]\n" + _lines(lines)


def _lines(lines: list[Line]) -> str:
    text = ""
    for key, value, comment in lines:
        if value is not None:
            text += f"{_key(key)} = {_value(value)}" + (f"  # {comment}\n" if comment else "\n")
    return text


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    """A TOML value: text, a truth value, a number with every digit, or a list of them."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return repr(float(value))
    return "[" + ", ".join(_value(item) for item in value) + "]"
