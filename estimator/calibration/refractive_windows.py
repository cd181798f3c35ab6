"""Refractive windows: plane glass walls between the cameras and the water of a run.

In: a calibration, and the windows that `[walls]` of rig.toml states. Out: the calibration behind
them, and findings on what they do and what is not known of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.solver.problem import prior_sigma, wall_freedom
from telerig.estimator.calibration.thresholds import STRONG_PERSPECTIVE
from telerig.io.results.findings import Code, Finding
from telerig.io.rig_file.description import RigDescription
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import INDEX
from telerig.rig.projection import turned_wall
from telerig.rig.triangulation import aligned_covariance, triangulate_any, working_volume
from telerig.rig.windows import Wall

_NOTABLE_UM = 0.1
_STEP_MM = 10.0


def with_windows(cameras: Sequence[Camera], walls: Mapping[str, Wall]) -> tuple[Camera, ...]:
    """Return the cameras, each with its refractive window if ``walls`` has one for it.

    walls : windows by the camera's name.
    """
    return tuple(replace(c, wall=walls.get(c.name, c.wall)) for c in cameras)


def behind_windows(calibration: Calibration, walls: Mapping[str, Wall]) -> Calibration:
    """Return a calibration that was made in air as one for points in the water behind windows.

    The prior covariance of each window's orientation becomes part of the covariance.

    walls : windows by the camera's name.
    """
    cameras = with_windows(calibration.cameras, walls)
    names, covariance = _with_priors(
        calibration, cameras, calibration.covariance_names, calibration.covariance
    )
    joint_names, joint = calibration.joint_names, calibration.joint_covariance
    if joint_names:
        joint_names, joint = _with_priors(calibration, cameras, joint_names, joint)
    behind = replace(
        calibration, cameras=cameras, covariance=covariance, covariance_names=names,
        free=tuple((*f, *wall_freedom(c)) for f, c in zip(calibration.free, cameras)),
        joint_names=joint_names, joint_covariance=joint,
    )  # fmt: skip
    return replace(behind, statistics=_with_windows_share(behind, calibration))


def _with_windows_share(behind: Calibration, in_air: Calibration) -> dict[str, Any]:
    """Return the statistics with the share of the windows' uncertain orientation added."""
    statistics = dict(in_air.statistics)
    if "space_sd_um" not in statistics or behind.free == in_air.free:
        return statistics
    points = working_volume(in_air.cameras)
    after, before = (_space_variance_um2(c, points) for c in (behind, in_air))
    share = max(after - before, 0.0)
    for name in ("space_sd_um", "space_sd_calibration_um"):
        statistics[name] = float(np.hypot(statistics[name], np.sqrt(share)))
    return statistics | {"space_sd_walls_um": float(np.sqrt(share))}


def _space_variance_um2(calibration: Calibration, points_mm: Array) -> float:
    """Return the calibration's variance per axis, without a common rigid motion of all points."""
    cameras, free = calibration.cameras, calibration.free
    shared = aligned_covariance(cameras, free, calibration.covariance, points_mm)
    return float(1e6 * np.trace(shared) / len(shared))


def _with_priors(
    calibration: Calibration, cameras: Sequence[Camera], names: tuple[str, ...], matrix: Array
) -> tuple[tuple[str, ...], Array]:
    """Return the names and covariance with each camera's window after its intrinsics."""
    grown: list[str] = []
    added: dict[str, float] = {}
    at = 0
    for camera, free in zip(cameras, calibration.free):
        grown += names[at : at + len(free)]
        at += len(free)
        for name in wall_freedom(camera):
            added[f"{camera.name}.{name}"] = float(prior_sigma(camera)[INDEX[name]] ** 2)
            grown.append(f"{camera.name}.{name}")
    grown += names[at:]
    variance = np.array([added.get(name, 0.0) for name in grown])
    out, old = np.diag(variance), np.flatnonzero([name not in added for name in grown])
    out[np.ix_(old, old)] = matrix
    return tuple(grown), out


def model_error_um(used: Sequence[Camera], true: Sequence[Camera]) -> float:
    """Return the largest error (µm) of points that are triangulated with the cameras ``used``
    instead of the ``true`` ones.

    A shift that is common to all points does not count. With one camera, the result is the error
    across its optical axis.
    """
    points = working_volume(tuple(used))
    pixels = [camera.project(points) for camera in true]
    if len(used) > 1:
        wrong = triangulate_any(used, pixels, 1.0).points_mm - points
    else:
        wrong = (pixels[0] - used[0].project(points)) / used[0]["scale_px_per_mm"]
    wrong = wrong - wrong.mean(0)
    return float(1e3 * np.linalg.norm(wrong, axis=-1).max())


def window_findings(calibration: Calibration, rig: RigDescription) -> list[Finding]:
    """Return findings on the effect of the refractive windows and their uncertainty."""
    cameras = [c for c in calibration.cameras if c.wall is not None]
    if not cameras:
        wet = calibration.medium == "water"
        return [Code.NO_WINDOWS.found()] if wet else []
    error = model_error_um(calibration.in_air().cameras, calibration.cameras)
    code = Code.WINDOWS_IN_AIR if calibration.medium == "air" else Code.WINDOWS_IN_WATER
    found = [code.found(cameras=[c.name for c in cameras], error_um=error)]
    for camera in cameras:
        found += _implausible(camera)
        stated = rig.walls.get(camera.name)
        if calibration.medium == "air" and stated is not None and stated.distance_mm is None:
            found += _distance_needed(calibration, camera)
        found += _uncertain(calibration, camera) + _tilt_sign_ambiguous(calibration, camera)
    return found


def _um(error_um: float) -> str:
    return f"up to {error_um:.1f} µm" if error_um >= _NOTABLE_UM else "less than 0.1 µm"


def _implausible(camera: Camera) -> list[Finding]:
    """Return findings on probable mistakes: the order of the media, the normal's direction."""
    wall, found = camera.wall, list[Finding]()
    if wall is None:
        return []
    first, last = wall.indices[0], wall.indices[-1]
    if first > last:
        found.append(Code.MEDIA_ORDER.found(cameras=camera.name, first=first, last=last))
    leaning = float(np.degrees(np.arccos(min(1.0, abs(wall.normal[2])))))
    if leaning > Code.WINDOW_LEANING.limit:
        found.append(Code.WINDOW_LEANING.found(cameras=camera.name, angle_deg=leaning))
    return found


def _distance_needed(calibration: Calibration, camera: Camera) -> list[Finding]:
    """Return the finding on what the unknown distance of a window does, of a perspective lens.

    With the target in the water the distance would only change scale and kappa.
    """
    if camera.wall is None or camera["kappa_per_mm"] == 0:
        return []
    farther = replace(camera.wall, distance_mm=camera.wall.distance_mm - _STEP_MM)
    moved = with_windows(calibration.cameras, {camera.name: farther})
    error = model_error_um(calibration.cameras, moved)
    if error < Code.WINDOW_DISTANCE.limit:
        return []
    return [Code.WINDOW_DISTANCE.found(cameras=camera.name, error_um=error)]


def _uncertain(calibration: Calibration, camera: Camera) -> list[Finding]:
    """Return the finding on the effect of one standard deviation of a window's orientation."""
    sd = max((calibration.sd(f"{camera.name}.{n}") for n in wall_freedom(camera)), default=0.0)
    if not sd > 0 or camera.wall is None or calibration.medium == "water":
        return []
    turned = camera.with_parameters(wall_x_rad=camera["wall_x_rad"] + sd)
    points = working_volume((camera,))
    moved = (turned.project(points) - camera.project(points)) / camera["scale_px_per_mm"]
    most = 1e3 * float(np.abs(moved - moved.mean(0)).max())
    sd_deg = float(np.degrees(sd))
    return [Code.WINDOW_NORMAL.found(cameras=camera.name, sd_deg=sd_deg, shift_um=most)]


def _tilt_sign_ambiguous(calibration: Calibration, camera: Camera) -> list[Finding]:
    """Return the finding on a window that may lean to the other side.

    Only the tilt's square shows.
    """
    free, wall = wall_freedom(camera), camera.wall
    weak = abs(camera["kappa_per_mm"]) * camera.rho_mm < STRONG_PERSPECTIVE
    if calibration.medium == "air" or not free or wall is None or not weak:
        return []
    normal = turned_wall(camera.intrinsics, wall).normal
    mirrored = normal * [-1, -1, 1]
    apart, from_stated = (_angle_rad(mirrored, n) for n in (normal, wall.normal))
    sd = max(calibration.sd(f"{camera.name}.{name}") for name in free)
    if apart < 3 * sd or from_stated > 3 * wall.normal_sigma_rad:
        return []
    tilt_deg = float(np.degrees(apart / 2))
    return [Code.WINDOW_TILT_SIGN.found(cameras=camera.name, tilt_deg=tilt_deg)]


def _angle_rad(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def window_warnings(rig: RigDescription | None, calibration: Calibration) -> list[str]:
    """Return warnings if the windows of rig.toml and of the calibration differ.

    There is no warning about missing windows in a calibration in water: its scales and axes contain
    the effect of the windows, except for perspective lenses.
    """
    if rig is None:
        return []
    stated = rig.windows
    have = {c.name: c.wall for c in calibration.cameras}
    gone = [name for name, wall in have.items() if wall is not None and name not in stated]
    if gone:
        bare = [replace(c, wall=None) if c.name in gone else c for c in calibration.cameras]
        much = _um(model_error_um(calibration.cameras, bare))
        return [
            f"the calibration has windows for {', '.join(gone)} that rig.toml does not state. If "
            f"the windows have been removed, points are wrong by {much} over the working volume: "
            "calibrate again. Otherwise state them in [walls]"
        ]
    missing = [n for n, wall in stated.items() if n in have and not _same(have[n], wall)]
    if not missing or calibration.medium == "water":
        return []
    error = model_error_um(calibration.cameras, with_windows(calibration.cameras, stated))
    if error < _NOTABLE_UM:
        return []
    return [
        f"the windows that rig.toml states for {', '.join(missing)} are not in the calibration as "
        f"stated: points are wrong by {_um(error)} over the working volume; calibrate again"
    ]


def _same(one: Wall | None, other: Wall) -> bool:
    """Return whether two windows are equal to the digits that a file keeps."""
    if one is None:
        return False
    a, b = (
        np.concatenate([np.atleast_1d(value) for value in wall.as_dict().values()])
        for wall in (one, other)
    )
    return np.allclose(a, b, rtol=1e-9, atol=1e-12)
