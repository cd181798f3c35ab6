"""The report's tables: what calibration.json says, in words and with units."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import GeometryError
from telerig.io.report.page.page import Row, Tile, link_to
from telerig.io.results.cameras import CameraRecord
from telerig.io.results.findings import Status
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import LENS_PARAMETERS, PARAMETERS
from telerig.short_text import ABSENT, number, share, with_sd
from telerig.statistics import rms

WORST = 15
_MANY_SD = 3.0


def key_numbers(results: CalibrationResults) -> list[Tile]:
    """Return the numbers that a reader wants first."""
    s = results.statistics
    per_camera = [f"{n} {number(s.get(f'rms_{n}_px'))}" for n in results.camera_names]
    kept, measured = s.get("dots_kept"), s.get("dots_measured")
    figures = [
        Tile("Residual", f"{number(s.get('rms_px'))} px", f"RMS; {', '.join(per_camera)} px"),
        Tile(
            "Chi-square",
            f"{number(s.get('chi2_dof'))} per dof",
            f"about 1 if the stated noise is right; {number(s.get('degrees_of_freedom'))} dof",
        ),
        Tile(
            "Dots kept",
            share(kept, measured),
            f"{number(kept)} of {number(measured)} in {len(results.views)} views",
        ),
    ]
    return figures + _space_numbers(results, s)


def precision_words(results: CalibrationResults) -> str:
    """Return how well a point is placed, to follow the status; "" for a single camera.

    Only of a good calibration it is certain that errors are what is stated.
    """
    sd_um, status = results.statistics.get("space_sd_um"), results.file.verdict.status
    if status == Status.REJECTED:
        return ": do not measure with this calibration"
    if len(results.cameras) < 2 or sd_um is None:
        return ""
    words = "are good to" if status == Status.GOOD else "have a stated error of"
    return f": points in space {words} {number(sd_um)} µm (1 sd per axis)"


def _space_numbers(results: CalibrationResults, s: Mapping[str, Any]) -> list[Tile]:
    if len(results.cameras) < 2:
        return [Tile("In space", "no depth", "one camera never sees the depth along its axis")]
    precision = f"{number(s.get('space_sd_um'))} µm"
    rejected = results.file.verdict.status == Status.REJECTED
    remark = (
        f"1 sd per axis of a triangulated point; dots are {number(s.get('space_rms_um'))} µm RMS "
        f"from the fit, rays miss by {number(s.get('ray_miss_rms_um'))} µm"
    )
    figures = [] if rejected else [Tile("In space", precision, remark)]
    for name, of in s.get("from_first", {"": s}).items():
        angle = with_sd(of.get("axes_angle_deg"), of.get("axes_angle_sd_deg"))
        which = f"of {results.cameras[0].name} and {name}" if name else "between the optical axes"
        figures.append(Tile("Angle between axes", f"{angle}°", f"1 sd; {which}"))
    if "perspective_centres_distance_mm" in s:
        distance = f"{number(s['perspective_centres_distance_mm'], 4)} mm"
        figures.append(Tile("Base", distance, "between the centres of perspective"))
    return figures


def parameter_rows(results: CalibrationResults) -> list[Row]:
    """Return one row per parameter, one cell per camera: value +- sd, or that it was held."""
    cameras = list(results.file.cameras.values())
    rows = []
    for name in PARAMETERS:
        if name in held_everywhere(results) or (
            name.startswith("wall_") and not results.file.walls
        ):
            continue
        cells = [_parameter_cell(camera, name) for camera in cameras]
        free = any(name in camera.free for camera in cameras)
        rows.append(Row((f"{LENS_PARAMETERS[name].label} ({name})", *cells), faint=not free))
    largest = [_largest_distortion(camera) for camera in results.cameras]
    changes = results.statistics.get("telecentricity") or {}
    perspective = [
        f"{with_sd(1e6 * lens['change_per_mm'], 1e6 * lens['sd_per_mm'])} ppm"
        for lens in changes.values()
    ]
    return [
        *rows,
        Row(("largest distortion in the image", *largest)),
        *([Row(("change of the scale per mm of depth", *perspective))] if perspective else []),
        Row(("field of view, mm", *(_field(camera) for camera in results.cameras))),
    ]


def held_everywhere(results: CalibrationResults) -> list[str]:
    """Return the lens parameters that every camera holds at 0 (the aspect at 1)."""
    cameras = results.file.cameras.values()
    return [
        name for name in PARAMETERS
        if not name.startswith("wall_") and all(
            name not in c.free and c.parameters.get(name, 0.0) == (name == "aspect")
            for c in cameras
        )
    ]  # fmt: skip


def _parameter_cell(camera: CameraRecord, name: str) -> str:
    value = camera.parameters.get(name, 0.0)
    if name not in camera.free:
        return f"{number(value, 7)} (held)"
    return with_sd(value, camera.standard_deviations.get(name))


def _field(camera: Camera) -> str:
    width, height = np.array(camera.image_size_px) / camera["scale_px_per_mm"]
    return f"{number(float(width))} x {number(float(height / camera['aspect']))}"


def _largest_distortion(camera: Camera) -> str:
    """Return how far distortion and sensor tilt move a point, at most, within the image."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 9) for n in camera.image_size_px)), -1)
    straight = camera.with_parameters(**dict.fromkeys(PARAMETERS[PARAMETERS.index("k1") :], 0.0))
    try:
        ideal = projection.ideal_from_pixel(grid, camera.intrinsics, camera.rho_mm)
    except GeometryError:
        return "not invertible in the whole image"
    points = np.concatenate([ideal, np.zeros((*ideal.shape[:-1], 1))], -1)
    moved = grid - projection.pixel_from_camera(points, straight.intrinsics, camera.rho_mm)
    largest_px = float(np.hypot(moved[..., 0], moved[..., 1]).max())
    return f"{number(round(largest_px, 9))} px"  # below 1e-9 px it is rounding


def pose_rows(results: CalibrationResults) -> list[Row]:
    """Return the pose of every camera against the first; empty for one camera."""
    return [row for camera in results.cameras[1:] for row in _pose_rows(results, camera)]


def _pose_rows(results: CalibrationResults, camera: Camera) -> list[Row]:
    pose, name, first = camera.camera_from_rig, camera.name, results.cameras[0].name
    nominal: Any = results.file.twin.nominal_rotvec_deg
    statistics, which = results.statistics, ""
    if len(results.cameras) > 2:
        nominal = (nominal or {}).get(name)
        statistics, which = (
            statistics.get("from_first", {}).get(name, {}),
            f" of {first} and {name}",
        )
    turn = _tangent_sd(results, name, "r", "_rad")
    place = _tangent_sd(results, name, "t", "_mm")
    angle = with_sd(statistics.get("axes_angle_deg"), statistics.get("axes_angle_sd_deg"))
    return [
        Row((f"angle between the axes{which} (°)", angle), True),
        Row((f"distance between the axes{which} (mm)", _gap(results, camera))),
        Row((f"{name}_from_{first} as rotation vector (°)",
             _fixed(np.degrees(pose.rotvec_rad), 5))),
        Row(("the same, nominal (rig.toml)", _fixed(nominal, 1))),
        Row((f"sd of turns about {name}'s x, y, z (°)", _fixed(_degrees(turn), 5))),
        Row((f"{name}_from_{first} translation (mm)", _fixed(pose.translation_mm, 5))),
        Row((f"sd of shifts along {name}'s x, y, z (mm)", _fixed(place, 5))),
    ]  # fmt: skip


def stage_rows(results: CalibrationResults) -> list[Row]:
    """Return the travel axis and encoder scale from `stage_axis/`; empty without it."""
    stage = results.file.stage
    if stage is None or stage.axis_covariance_rad2 is None:
        return []
    tilts = np.degrees(np.sqrt(np.diagonal(stage.axis_covariance_rad2)))
    scale = with_sd(1e6 * stage.encoder_scale, 1e6 * (stage.encoder_scale_sd or 0.0))
    across, along = (1e3 * (s or 0.0) for s in (stage.wander_sigma_mm, stage.position_sigma_mm))
    return [
        Row(("direction of travel in the rig frame", _fixed(stage.axis.tolist(), 6))),
        Row(("sd of its two tilts (°)", _fixed(tilts.tolist(), 5))),
        Row(("encoder reads too much (ppm of the travel)", scale), True),
        Row(("scatter of the readings along the axis (µm)", number(along, 2))),
        Row(("the carriage's wander across it (µm)", number(across, 2))),
        Row(("chi² per degree of freedom of the dots", number(stage.chi2_dof, 3))),
    ]


def _degrees(radians: list[float] | None) -> list[float] | None:
    return None if radians is None else [float(np.degrees(r)) for r in radians]


def _rig_block(results: CalibrationResults, names: list[str]) -> Array | None:
    block = results.file.covariance
    if block is None or not set(names) <= set(block.names):
        return None
    index = [block.names.index(name) for name in names]
    return np.asarray(block.matrix[np.ix_(index, index)])


def _tangent_sd(
    results: CalibrationResults, camera: str, kind: str, unit: str
) -> list[float] | None:
    block = _rig_block(results, [f"{camera}.{kind}{axis}{unit}" for axis in "xyz"])
    return None if block is None else [float(s) for s in np.sqrt(np.diag(block))]


def _gap(results: CalibrationResults, camera: Camera) -> str:
    """Return the length of the common perpendicular; the tangent is of rig_from_camera."""
    camera_from_rig = camera.camera_from_rig
    across = np.cross([0.0, 0.0, 1.0], camera_from_rig.rotation[2])
    if np.linalg.norm(across) < 1e-6:
        return "the axes are parallel"
    across /= np.linalg.norm(across)
    gap = abs(float(across @ camera_from_rig.inverse().translation_mm))
    block = _rig_block(results, [f"{camera.name}.t{axis}_mm" for axis in "xyz"])
    if block is None:
        return number(gap, 5)
    inside = camera_from_rig.rotation @ across
    return with_sd(gap, float(np.sqrt(inside @ block @ inside)))


def _fixed(values: Any, decimals: int) -> str:
    if values is None:
        return ABSENT
    return "(" + ", ".join(f"{round(float(v), decimals) + 0.0:.{decimals}f}" for v in values) + ")"


def ladder_rows(results: CalibrationResults) -> list[Row]:
    """Return the steps of the ladder of lens models, taken or not; none for a given model."""
    model = results.file.model
    return [
        Row(
            (
                f"+ {', '.join(step.added)} ({step.camera})" if step.added else step.model,
                _or_blank(step.chi2_gain, 3),
                _or_blank(step.bic_gain, 3),
                _chance(step.p_value),
                step.words or ("taken" if step.added else ""),
            ),
            strong=step.model == model.name,
            faint=not step.taken,
        )
        for step in model.ladder
    ]


def _or_blank(value: float | None, digits: int) -> str:
    return "" if value is None else number(value, digits)


def _chance(p_value: float | None) -> str:
    if p_value is None:
        return ""
    return "< 10⁻¹²" if p_value < 1e-12 else number(p_value, 2)


def worst_rows(results: CalibrationResults) -> list[Row]:
    """Return the dots that were left out or count less, by their residual."""
    table = results.residuals[results.residuals["weight"] < 1]
    whitened = "whitened_u" in table
    columns = ["whitened_u", "whitened_v"] if whitened else ["du_px", "dv_px"]
    size = np.hypot(*table[columns].to_numpy().T)
    order = np.lexsort((-size, table["kept"].to_numpy()))
    return [
        Row(
            (
                str(dot.view), str(dot.camera), str(dot.dot), f"{dot.row}, {dot.column}",
                f"{dot.du_px:+.4f}", f"{dot.dv_px:+.4f}", f"{dot.length_px:.4f}",
                f"{dot.weight:.3g}", str(dot.reason),
            ),
            strong=not bool(dot.kept),
        )
        for dot in table.iloc[order[:WORST]].itertuples()
    ]  # fmt: skip


def view_rows(results: CalibrationResults, page_folder: Path) -> list[Row]:
    """Return a row for each view: dots kept of those measured by camera, and the RMS of both axes.

    It links to the picture of the first camera that has one.
    """
    rows = []
    for view, mine in results.residuals.groupby("view", sort=False):
        counts = [
            share_of(int(seen["kept"].sum()), len(seen))
            for name in results.camera_names
            for seen in (mine[mine["camera"] == name],)
        ]
        kept = mine.loc[mine["kept"], ["du_px", "dv_px"]].to_numpy(float)
        files = [results.overlays.get((name, str(view))) for name in results.camera_names]
        file = next(filter(None, files), None)
        link = "" if file is None else link_to(file, page_folder)
        rows.append(Row((str(view), *counts, number(rms(kept.ravel()))), link=link))
    return rows


def share_of(part: int, whole: int) -> str:
    """Return "PART of WHOLE" in figures, like "178 of 180"; "-" if the whole is 0."""
    return f"{part} of {whole}" if whole else "-"


def change_rows(results: CalibrationResults) -> list[Row]:
    """Return a row for each quantity that comparison.json compares with an earlier calibration.

    Its cells: the quantity, its change with standard deviation and unit, and the change divided by
    that standard deviation.
    """
    rows = []
    for change in results.comparison.changes:
        cells = (
            change.quantity,
            f"{with_sd(change.change, change.sd)} {change.unit}",
            ABSENT if change.deviations is None else f"{change.deviations:.1f}",
        )
        rows.append(Row(cells, strong=abs(change.deviations or 0.0) > _MANY_SD))
    return rows
