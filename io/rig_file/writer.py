"""The text of a `rig.toml`, with a comment where a reader may wonder."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from typing import Any

import numpy as np

from telerig.io.rig_file.description import SCHEMA, RigDescription, Table, rotvec_key
from telerig.rig.target import Target

Line = tuple[str, Any, str]


_COMMENTS = {
    "image_size_px": "width, height",
    "scale_px_per_mm": "nominal, 20 % is good enough",
    "telecentricity_per_mm": (
        "nominal residual perspective; 1 / working distance for a perspective lens"
    ),
    "axis": "nominal travel direction in the rig frame",
    "up": "away from gravity",
    "scale_sigma": "of the encoder, relative",
    "gravity_m_s2": "of the laboratory",
    "delay_sigma_s": "of the encoder against the images",
    "mounted_on": 'a camera or "carriage"',
    "axes": "rows: the sensor's x, y, z axes in rig coordinates",
    "range_m_s2": "beyond it readings are clipped",
    "clock": 'of its times: "frames", or "unknown" for a logger of its own',
    "velocity_mm_s": "of the liquid, along the rig's axes, or one number upwards",
    "normal": "in the camera's frame",
    "indices": "camera side, glass, behind",
    "distance_mm": "of the near face on the camera's axis",
}
_NAMES = ("name", "camera")
"""Fields that are the name of their table."""


def rig_toml(rig: RigDescription) -> str:
    """Return the text of the rig file; keys whose value is None are left out."""
    blocks = [_lines([("schema", SCHEMA, ""), ("name", rig.name, "")])]
    blocks += [_block(f"cameras.{toml_key(c.name)}", _all_fields(c)) for c in rig.cameras.values()]
    if rig.rotvec_from_first_deg:
        comment = "nominal; decides the mirror ambiguity"
        lines = [
            (rotvec_key(name, rig.first), rotvec, comment)
            for name, rotvec in rig.rotvec_from_first_deg.items()
        ]
        blocks.append(_block("stereo", lines))
    blocks.append(_block("target", _target(rig.target)))
    if rig.stage is not None:
        keys = {"axis": f"axis_{rig.first}", "up": f"up_{rig.first}"}
        lines = [(keys.get(key, key), *rest) for key, *rest in _all_fields(rig.stage)]
        blocks.append(_block("stage", lines))
    for sensor in rig.accelerometers.values():
        blocks.append(_block(f"accelerometers.{toml_key(sensor.name)}", _all_fields(sensor)))
    blocks += [
        _block(f"devices.{toml_key(d.name)}", _changed_fields(d)) for d in rig.devices.values()
    ]
    if rig.references is not None:
        blocks.append(_block("references", _all_fields(rig.references)))
    if rig.tracking is not None:
        blocks.append(_block("tracking", [("cameras", rig.tracking, "whose images are paired")]))
    blocks += [
        _block(f"bubbles.{toml_key(f.camera)}", _all_fields(f)) for f in rig.bubbles.values()
    ]
    if rig.fluid is not None:
        blocks.append(_block("fluid", _all_fields(rig.fluid)))
    for wall in rig.walls.values():
        lines = [line for line in _all_fields(wall) if line[:2] != ("normal_sigma_deg", 0.0)]
        blocks.append(_block(f"walls.{toml_key(wall.camera)}", lines))
    return "\n".join(blocks)


def _all_fields(table: Table) -> list[Line]:
    """Return a line for each field of a description; None values are left out on writing."""
    values = {name: value for name, value in vars(table).items() if name not in _NAMES}
    return [(name, value, _COMMENTS.get(name, "")) for name, value in values.items()]


def _changed_fields(table: Any) -> list[Line]:
    """Return a line for each field that differs from its default."""
    usual = {field.name: field.default for field in fields(table)}
    return [line for line in _all_fields(table) if line[1] != usual[line[0]]]


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


def _block(table: str, lines: list[Line]) -> str:
    return f"[{table}]\n" + _lines(lines)


def _lines(lines: list[Line]) -> str:
    text = ""
    for key, value, comment in lines:
        if value is not None:
            text += f"{toml_key(key)} = {_value(value)}" + (f"  # {comment}\n" if comment else "\n")
    return text


def toml_key(key: str) -> str:
    """Return a key as TOML has it: quoted unless it is of letters, digits, - and _."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    """Return a TOML value: text, a truth value, a number with every digit, or a list of them."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return repr(float(value))
    return "[" + ", ".join(_value(item) for item in value) + "]"
