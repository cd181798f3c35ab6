"""The smaller tables of `rig.toml`: stereo, stage, accelerometers, references, walls.

Each function appends the faults that it finds to ``problems``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from telerig.errors import suggestion
from telerig.io.rig_file.description import (
    CARRIAGE,
    AccelerometerDescription,
    CameraDescription,
    ReferencesDescription,
    StageDescription,
    Vector,
    WallDescription,
)
from telerig.io.rig_file.schema import (
    AccelerometerTable,
    Problem,
    ReferencesTable,
    WallTable,
    stage_table,
    stereo_table,
    validate,
)

_GRAZING = np.cos(np.deg2rad(85.0))


def subtables(raw: Any, table: str, problems: list[Problem]) -> dict[str, Any]:
    if isinstance(raw, dict):
        stray = [name for name, content in raw.items() if not isinstance(content, dict)]
        if stray:
            problems.append(
                Problem(
                    table,
                    "",
                    f"holds {', '.join(stray)}, but must hold a table for each name",
                    f"write [{table}.<name>] above them, with the name filled in",
                )
            )
        return {name: content for name, content in raw.items() if name not in stray}
    problems.append(
        Problem(
            "", table, f"is {raw!r}, must be tables", f"write a table [{table}.<name>] for each"
        )
    )
    return {}


def rotvec_from_table(
    raw: dict[str, Any], names: list[str], problems: list[Problem]
) -> Vector | None:
    if "stereo" not in raw or not names:
        return None
    if len(names) == 1:
        problems.append(
            Problem(
                "stereo",
                "",
                f"is given, but {names[0]} is the only camera",
                "remove it, or add the second [cameras.<name>]",
            )
        )
        return None
    table, found = validate(stereo_table(*names[:2]), raw["stereo"], "stereo")
    problems += found
    return _vector(table.rotvec) if table is not None and table.rotvec is not None else None


def stage_from_table(
    raw: dict[str, Any], names: list[str], problems: list[Problem]
) -> StageDescription | None:
    if "stage" not in raw or not names:
        return None
    first = names[0]
    table, found = validate(stage_table(first), raw["stage"], "stage")
    problems += found
    if table is None:
        return None
    axis = _unit(table.axis, "stage", f"axis_{first}", problems)
    up = axis if table.up is None else _unit(table.up, "stage", f"up_{first}", problems)
    return StageDescription(axis, up, table.position_sigma_mm, table.scale_sigma)


def accelerometers_from_tables(
    raw: dict[str, Any], names: list[str], problems: list[Problem]
) -> dict[str, AccelerometerDescription]:
    out: dict[str, AccelerometerDescription] = {}
    for name, content in subtables(
        raw.get("accelerometers", {}), "accelerometers", problems
    ).items():
        place = f"accelerometers.{name}"
        table, found = validate(AccelerometerTable, content, place)
        problems += found
        if table is None:
            continue
        if table.mounted_on not in (*names, CARRIAGE):
            problems.append(
                Problem(
                    place,
                    "mounted_on",
                    f'is {table.mounted_on!r}, which is neither a camera nor "{CARRIAGE}"',
                    suggestion(table.mounted_on, [*names, CARRIAGE]),
                )
            )
        x, y, z = (_unit(row, place, f"axes[{i}]", problems) for i, row in enumerate(table.axes))
        if abs(np.linalg.det([x, y, z])) < 0.1 and all(map(any, table.axes)):
            problems.append(
                Problem(
                    place,
                    "axes",
                    "has rows that lie (nearly) in one plane",
                    "give the three directions of the sensor's axes",
                )
            )
        out[name] = AccelerometerDescription(
            name,
            table.mounted_on,
            (x, y, z),
            table.noise_density_ug_sqrt_hz,
            table.bias_sigma_m_s2,
        )
    return out


def references_from_table(
    raw: dict[str, Any], problems: list[Problem]
) -> ReferencesDescription | None:
    if "references" not in raw:
        return None
    table, found = validate(ReferencesTable, raw["references"], "references")
    problems += found
    if table is None:
        return None
    return ReferencesDescription(table.kind, table.polarity, table.dot_diameter_mm)


def walls_from_tables(
    raw: dict[str, Any], cameras: dict[str, CameraDescription | None], problems: list[Problem]
) -> dict[str, WallDescription]:
    out: dict[str, WallDescription] = {}
    for name, content in subtables(raw.get("walls", {}), "walls", problems).items():
        place = f"walls.{name}"
        if name not in cameras:
            problems.append(
                Problem(place, "", f"there is no camera {name!r}", suggestion(name, list(cameras)))
            )
        table, found = validate(WallTable, content, place)
        problems += found
        if table is None:
            continue
        normal = _unit(table.normal, place, "normal", problems)
        problems += _wall_problems(place, normal, table, cameras.get(name))
        x, y, z = (float(np.copysign(1.0, normal[2])) * component for component in normal)
        out[name] = WallDescription(
            name, (x, y, z), _vector(table.indices), table.thickness_mm, table.distance_mm,
            table.normal_sigma_deg,
        )  # fmt: skip
    return out


def _wall_problems(
    place: str, normal: Vector, table: WallTable, camera: CameraDescription | None
) -> Iterator[Problem]:
    if any(table.normal) and abs(normal[2]) < _GRAZING:
        yield Problem(
            place,
            "normal",
            f"is {table.normal}: the camera would look along the wall",
            "give it in the camera's frame, where z points into the scene; a wall that "
            "faces the camera is [0.0, 0.0, 1.0]",
        )
    if camera is not None and camera.telecentricity_per_mm and table.distance_mm is None:
        yield Problem(
            place,
            "distance_mm",
            f"is missing, and needed because cameras.{camera.name}.telecentricity_per_mm is not 0",
            "add distance_mm from the camera's origin to the wall",
        )


def _vector(values: list[float]) -> Vector:
    x, y, z = values
    return x, y, z


def _unit(values: list[float], table: str, key: str, problems: list[Problem]) -> Vector:
    """The direction of ``values``; vectors that are unit to 1e-12 keep their digits."""
    length = float(np.linalg.norm(values))
    if length == 0.0:
        problems.append(Problem(table, key, "has length zero", "give a direction"))
        return 0.0, 0.0, 0.0
    return _vector(values if abs(length - 1) < 1e-12 else [v / length for v in values])
