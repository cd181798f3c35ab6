"""The result of a self-calibration: cameras, target, poses, covariance, and what can be done.

A calibration is also read from its folder, chosen for a run, or made from imported cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.arrays import Array, as_points
from telerig.errors import CalibrationError, InputError, suggestion
from telerig.estimator.calibration.result.summary import summary
from telerig.io.files.atomic import atomic_path, plain
from telerig.io.files.csv_table import write_table
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS
from telerig.rig.pose import Pose
from telerig.rig.triangulation import (
    POSE_COMPONENTS,
    Triangulation,
    pixel_covariance,
    point_shift_jacobian,
    rig_jacobian,
    seen_covariance,
    triangulate,
    triangulate_views,
)
from telerig.short_text import ShortText, first_of, xarray_dataset

if TYPE_CHECKING:
    import pandas as pd
    import xarray

    from telerig.io.results.calibration import CalibrationFile
    from telerig.io.results.findings import Finding
    from telerig.io.results.folders.calibration import CalibrationResults

_AT_ONCE = 8192
_SCALE_STEP_MM = 1.0


@dataclass(frozen=True, repr=False)
class Calibration(ShortText):
    """Hold a calibrated rig. The rig frame is the first camera's frame.

    dot_ids : (N,) numbers of the target's N dots.
    target_points_mm : (N, 3) their estimated positions in the target's frame.
    target_poses : by name of a view, the pose rig_from_target.
    covariance : (P, P) of the rig block: the free intrinsics of each camera, then the small
        rotation (rad) and translation (mm) of the pose of each camera but the first.
        covariance_names : of these P parameters, with units.
    free : for each camera, the names of its free intrinsics.
    findings : what the checks found; None if nothing was checked. The verdict and the notes are
        made from it.
    statistics, twin, model, diagnostics : the parts of `calibration.json` with these names
        (`docs/files.md`); "twin" is the mirror ambiguity.
    stage : `StageAxis.as_dict`; empty if it is not known.
    medium : "air" or "water", in which the target was. With refractive windows, points that are
        projected or triangulated lie in the water behind them.
    joint_names, joint_covariance : of all parameters of the estimate, including the dots and the
        views' poses; empty if they were not loaded.
    tables : `dots.csv` and `residuals.csv`, by these names; after loading, the results folder
        from which they are read.
    """

    cameras: tuple[Camera, ...]
    dot_ids: NDArray[np.int64]
    target_points_mm: Array
    target_poses: Mapping[str, Pose]
    covariance: Array
    covariance_names: tuple[str, ...]
    free: tuple[tuple[str, ...], ...]
    name: str = ""
    findings: tuple[Finding, ...] | None = None
    statistics: Mapping[str, Any] = field(default_factory=dict)
    twin: Mapping[str, Any] = field(default_factory=dict)
    model: Mapping[str, Any] = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    stage: Mapping[str, Any] = field(default_factory=dict)
    medium: str = "air"
    joint_names: tuple[str, ...] = ()
    joint_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    tables: Mapping[str, pd.DataFrame] | CalibrationResults = field(default_factory=dict)

    @cached_property
    def dots(self) -> pd.DataFrame:
        """The table of `dots.csv`, with a row for each measured dot.

        Of a loaded calibration it is read when it is first asked for. Raises InputError if it is
        not there, as for an imported calibration.
        """
        return self._table("dots.csv")

    @cached_property
    def residuals(self) -> pd.DataFrame:
        """The table of `residuals.csv`, with a row for each measured dot; otherwise like `dots`."""
        return self._table("residuals.csv")

    def _table(self, name: str) -> pd.DataFrame:
        from telerig.io.results.folders.calibration import CalibrationResults

        if isinstance(self.tables, CalibrationResults):
            return self.tables.table(name)
        if name in self.tables:
            return self.tables[name]
        raise InputError(
            f"this calibration has no {name}: it was not made from dots",
            where=f"Calibration {self.name!r}",
            todo="use a calibration of telerig.calibrate, or load one from its folder",
        )

    @property
    def covariance_known(self) -> bool:
        """Whether the errors of the calibration are known; of imported cameras they are not.

        Unknown ones stand as zeros in ``covariance``, and as NaN in `sd`.
        """
        return bool(np.any(self.covariance))

    @property
    def verdict(self) -> dict[str, Any]:
        """Return "status" (a word) and "reasons" (the objections); empty if nothing was checked."""
        from telerig.io.results.findings import verdict_of

        if self.findings is None:
            return {}
        found = verdict_of(self.findings)
        return {"status": str(found.status), "reasons": list(found.reasons)}

    @property
    def rejection(self) -> str:
        """Return the sentence that warns of a calibration that was rejected; "" for any other."""
        if self.verdict.get("status") != "REJECTED":
            return ""
        reason = first_of([str(reason) for reason in self.verdict["reasons"]])
        return f"the calibration is REJECTED, so no number that follows from it is right: {reason}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the sentences on what was found and is no objection."""
        from telerig.io.results.findings import notes_of

        return notes_of(self.findings or ())

    def title(self) -> str:
        """Return the name of the rig and the verdict."""
        return f"Calibration {self.name!r}: {self.verdict.get('status', 'not judged')}"

    def facts(self) -> dict[str, str]:
        """Return the cameras' scales, the residual and the accuracy in space, in words."""
        s = self.statistics
        scales = []
        for camera in self.cameras:
            name = f"{camera.name}.scale_px_per_mm"
            sd = f" ± {self.sd(name):.2g}" if name in self.covariance_names else ""
            scales.append(f"{camera.name} {camera['scale_px_per_mm']:.6g}{sd} px/mm")
        facts = {"cameras": ", ".join(scales)}
        if "views" in s:
            facts["views"] = (
                f"{s['views']}, {s['dots_kept']} of {s['dots_measured']} dots kept, "
                f"residual {s['rms_px']:.4f} px RMS per coordinate"
            )
        if "axes_angle_deg" in s:
            facts["angle"] = (
                f"{s['axes_angle_deg']:.4f} ± {s['axes_angle_sd_deg']:.2g} degrees between the axes"
            )
        if "space_sd_um" in s:
            facts["a point"] = (
                f"triangulated from {s['scatter_px']:.3g} px is good to {s['space_sd_um']:.2f} µm "
                "per axis"
            )
        facts["medium"] = self.medium if self.medium != "air" else ""
        facts["reasons"] = first_of([str(r) for r in self.verdict.get("reasons", ())])
        return facts

    def to_pandas(self) -> pd.DataFrame:
        """Return the parameters of the rig block as a table.

        Its index is the name of the parameter, which ends in its unit. The columns are the
        estimated value, NaN for the small motion of a camera's pose, and the standard deviation
        ``sd``, 0 for a parameter that was held fixed, NaN if it is not known. The errors are
        correlated: ``covariance`` has all of them.
        """
        import pandas as pd

        rows = {}
        for index, camera in enumerate(self.cameras):
            values = {p: camera[p] for p in PARAMETERS}
            values |= dict.fromkeys(POSE_COMPONENTS, np.nan) if index else {}
            for parameter, value in values.items():
                name = f"{camera.name}.{parameter}"
                rows[name] = (float(value), self.sd(name))
        return pd.DataFrame.from_dict(rows, orient="index", columns=["value", "sd"])

    def to_xarray(self) -> xarray.Dataset:
        """Return the table of `to_pandas` with its covariance as an `xarray.Dataset`.

        ``value`` and ``sd`` have the dimension ``parameter``, along which the coordinate ``units``
        lies; ``covariance`` (parameter, parameter_of) is 0 for parameters that were held fixed, and
        NaN if it is not known. Raises InputError if xarray is not installed.
        """
        from telerig.rig.lens_parameters import unit_of_parameter

        table = self.to_pandas()
        place = {name: i for i, name in enumerate(table.index)}
        free = [place[name] for name in self.covariance_names]
        covariance = np.full((len(table), len(table)), 0.0 if self.covariance_known else np.nan)
        if self.covariance_known:
            covariance[np.ix_(free, free)] = self.covariance
        names = table.index.to_numpy()
        words = {"comment": "each in the unit of its parameter: the coordinate units"}
        return xarray_dataset(
            {
                "value": ("parameter", table["value"].to_numpy(), words),
                "sd": ("parameter", table["sd"].to_numpy(), words),
                "covariance": (("parameter", "parameter_of"), covariance, words),
            },
            {
                "parameter": names, "parameter_of": names,
                "units": ("parameter", [unit_of_parameter(name) for name in names]),
            },
            {"title": self.title()},
        )  # fmt: skip

    def camera(self, camera: str | int) -> Camera:
        """Return one camera by name or index; CalibrationError if there is no such camera."""
        if isinstance(camera, (int, np.integer)) and 0 <= camera < len(self.cameras):
            return self.cameras[camera]
        for candidate in self.cameras:
            if isinstance(camera, str) and candidate.name == camera:
                return candidate
        names = ", ".join(repr(c.name) for c in self.cameras)
        raise CalibrationError(
            f"no camera {camera!r:.40} in this calibration", todo=f"it has {names}"
        )

    def in_air(self) -> Calibration:
        """Return the same rig without its refractive windows, for points in air."""
        return replace(self, cameras=tuple(replace(c, wall=None) for c in self.cameras))

    def project(self, camera: str | int, points_mm: ArrayLike) -> Array:
        """Return the pixels (N, 2) at which a camera sees points (N, 3) of the rig frame, in mm.

        With a refractive window, the points lie in the water behind it. Raises InputError for
        another shape.
        """
        return self.camera(camera).project(points_mm)

    def unproject(self, camera: str | int, uv_px: ArrayLike) -> tuple[Array, Array]:
        """Return the rays of pixels (N, 2): origins (N, 3) in mm and unit directions (N, 3).

        They are in the rig frame. With a refractive window they are the rays in the water behind
        it. Raises InputError for another shape.
        """
        return self.camera(camera).unproject(uv_px)

    def undistort_image(self, camera: str | int, image: NDArray[Any]) -> NDArray[Any]:
        """Return the image that the camera would have taken with a lens free of distortion.

        camera : its name or index.
        image : (height, width) or (height, width, channels) of uint8, uint16 or floats.

        Returns an array of the same shape and type, which belongs to the camera
        ``calibration.camera(camera).undistorted()``; pixels that the camera did not see are 0. Each
        pixel is interpolated by a cubic from 4 x 4 others, so the noise of neighbours is
        correlated. Measure dots and bubbles in the original image: all functions of telerig include
        the distortion.
        Raises InputError for an image of another size or type.
        """
        import cv2

        lens = self.camera(camera)
        width, height = lens.image_size_px
        pixels = np.asarray(image)
        if pixels.shape[:2] != (height, width) or pixels.ndim not in (2, 3):
            raise InputError(
                f"the image has the shape {pixels.shape}",
                where=f"Calibration.undistort_image, camera {lens.name}",
                todo=f"give the (height, width) that was calibrated, ({height}, {width})",
            )
        if pixels.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
            raise InputError(
                f"the image has the type {pixels.dtype}",
                where=f"Calibration.undistort_image, camera {lens.name}",
                todo="convert it to uint8, uint16 or floats",
            )
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
        source = lens.distorted_pixel(grid).astype(np.float32)
        return np.asarray(cv2.remap(pixels, source[..., 0], source[..., 1], cv2.INTER_CUBIC))

    def project_covariance(self, camera: str | int, points_mm: ArrayLike) -> Array:
        """Return covariances (N, 2, 2) in px^2 of projections, due to the calibration's errors."""
        index = self.cameras.index(self.camera(camera))
        points = as_points(points_mm, "Calibration.project_covariance")
        jacobian = rig_jacobian(self.cameras, self.free, points)
        rows = jacobian[..., 2 * index : 2 * index + 2, :]
        return rows @ self.covariance @ np.swapaxes(rows, -1, -2)

    def triangulate(
        self,
        uv_first_px: ArrayLike | Mapping[str, ArrayLike],
        uv_second_px: ArrayLike | None = None,
        *,
        sigma_px: ArrayLike | tuple[ArrayLike, ...] | Mapping[str, ArrayLike] | None = None,
        method: str = "ml",
        include_calibration: bool = True,
    ) -> Triangulation:
        """Compute N points in the rig frame from their pixels in two or more cameras.

        uv_first_px, uv_second_px : (N, 2) pixels in the first and in the second camera. For more
            cameras, give ``uv_first_px`` alone: a mapping from the camera's name to (N, 2) pixels,
            NaN where this camera does not see the point.
        sigma_px : noise of the pixels. A number or (N,) are standard deviations in px; (N, 2, 2)
            are covariances in px^2; a pair or a mapping gives each camera its own. None means the
            scatter of this calibration's own dots.
        method : "ml" (maximum likelihood) or "midpoint" (the point midway between the rays).
        include_calibration : whether ``covariance_mm2`` of the result includes the errors of the
            calibration, which are common to all points; ``measurement_covariance_mm2`` never does.

        Returns a `Triangulation`. If the pixels were given by name, its ``ray_miss_mm`` is (N, C),
        with one column for each of the C cameras of this calibration; points that fewer than two
        cameras see are NaN, and ``unplaced`` is their number. Raises CalibrationError for a single
        camera or an unknown name, InputError for shapes that do not match.
        """
        if len(self.cameras) < 2:
            raise CalibrationError(
                "one camera cannot triangulate: the depth along its axis is never seen",
                todo="calibrate two cameras",
            )
        sigma: Any = self.statistics.get("scatter_px", 0.02) if sigma_px is None else sigma_px
        if isinstance(uv_first_px, Mapping):
            if uv_second_px is not None:
                raise InputError(
                    "there is a second array of pixels, although the first argument has the "
                    "pixels of all cameras",
                    todo="give either a mapping of all cameras' pixels, or two arrays",
                )
            return self._triangulate_views(uv_first_px, sigma, method, include_calibration)
        if uv_second_px is None:
            raise InputError(
                "there are pixels of one camera only",
                todo="give two arrays (N, 2), or a mapping of arrays by camera",
            )
        if isinstance(sigma, Mapping):
            sigma = tuple(sigma[c.name] for c in self.cameras[:2] if c.name in sigma)
        if isinstance(sigma, tuple) and len(sigma) != 2:
            names = " and ".join(camera.name for camera in self.cameras[:2])
            raise InputError(
                "sigma_px is not of the two cameras whose pixels are given",
                todo=f"give one value for both, or one for each of {names}",
            )
        two = self if len(self.cameras) == 2 else self.subset(0, 1)
        pair = (two.cameras[0], two.cameras[1])
        found = triangulate(pair, (uv_first_px, uv_second_px), sigma, method)
        if not include_calibration:
            return found
        shape = found.points_mm.shape[:-1]
        sigmas = sigma if isinstance(sigma, tuple) else (sigma, sigma)
        information = np.zeros((*shape, 4, 4))
        for c in range(2):
            block = slice(2 * c, 2 * c + 2)
            information[..., block, block] = np.linalg.inv(pixel_covariance(sigmas[c], shape))
        share = two.common_covariance(found.points_mm, information)
        return replace(found, covariance_mm2=found.covariance_mm2 + share)

    def common_covariance(
        self, points_mm: ArrayLike, information_px: ArrayLike | None = None
    ) -> Array:
        """Return the part of the covariance of triangulated points that the calibration causes.

        points_mm : (..., 3) in the rig frame.
        information_px : (..., 2C, 2C) inverse covariance of the points' pixels in the C cameras, 0
            in cameras that do not see a point; None for equal noise of all pixels.
        Returns (..., 3, 3) in mm^2. The errors that it describes are common to all points of a run.
        """
        points = as_points(points_mm, "Calibration.common_covariance")
        size = 2 * len(self.cameras)
        given = np.eye(size) if information_px is None else np.asarray(information_px, float)
        flat = points.reshape(-1, 3)
        every = np.broadcast_to(given, (*points.shape[:-1], size, size)).reshape(-1, size, size)
        out = np.full((len(flat), 3, 3), np.nan)
        placed = np.flatnonzero(np.isfinite(flat).all(-1))
        for first in range(0, len(placed), _AT_ONCE):
            some = placed[first : first + _AT_ONCE]
            shift = point_shift_jacobian(self.cameras, self.free, flat[some], every[some])
            out[some] = shift @ self.covariance @ np.swapaxes(shift, -1, -2)
        return out.reshape(*points.shape, 3)

    def scale_sd(self, point_mm: ArrayLike) -> float:
        """Return the relative standard deviation of lengths at a point (3,) by the calibration.

        It is that of the cube root of a small volume. 0 where the covariance is not known.
        """
        steps = _SCALE_STEP_MM * np.concatenate([np.eye(3), -np.eye(3)])
        pixels = np.eye(2 * len(self.cameras))
        shift = point_shift_jacobian(
            self.cameras, self.free, np.asarray(point_mm, float) + steps,
            np.broadcast_to(pixels, (6, *pixels.shape)),
        )  # fmt: skip
        growth = np.einsum("iip->p", shift[:3] - shift[3:]) / (6 * _SCALE_STEP_MM)
        return float(np.sqrt(growth @ self.covariance @ growth))

    def share_columns(self, points_mm: ArrayLike) -> dict[str, NDArray[Any]]:
        """Return columns of tracks.csv that state the calibration's part of the points' errors.

        points_mm : (N, 3) in the rig frame. The columns are `CALIBRATION_SHARE` in mm, if the
        covariance is known, and `EXTRAPOLATED`, if its dots are known (see
        `telerig.io.results.tracking`).
        """
        from telerig.io.tables.table import CALIBRATION_SHARE, EXTRAPOLATED

        columns: dict[str, NDArray[Any]] = {}
        if self.covariance_known:
            variance = np.diagonal(self.common_covariance(points_mm), axis1=-2, axis2=-1)
            columns |= dict(zip(CALIBRATION_SHARE, np.sqrt(variance.clip(0)).T))
        beyond = self.beyond_dots(points_mm)
        return columns if beyond is None else columns | {EXTRAPOLATED: beyond.astype(np.int64)}

    def beyond_dots(self, points_mm: ArrayLike) -> NDArray[np.bool_] | None:
        """Return whether points (..., 3) lie beyond the dots of the calibration in any image.

        There the lens is extrapolated. The dots of a camera end at the convex hull of those that
        were used. Returns None if the dots are not known, as for an imported calibration.
        """
        hulls = self.diagnostics.get("dots_hull_px", {})
        if not all(camera.name in hulls for camera in self.cameras):
            return None
        points = as_points(points_mm, "Calibration.beyond_dots")
        out = np.zeros(points.shape[:-1], bool)
        for camera in self.cameras:
            hull = np.asarray(hulls[camera.name], float)
            edge = np.roll(hull, -1, 0) - hull
            away = camera.project(points)[..., None, :] - hull
            side = edge[:, 0] * away[..., 1] - edge[:, 1] * away[..., 0]
            out |= ~((side >= 0).all(-1) | (side <= 0).all(-1))
        return out

    def _triangulate_views(
        self, uv_px: Mapping[str, ArrayLike], sigma: Any, method: str, include_calibration: bool
    ) -> Triangulation:
        """Do the work of `triangulate` for pixels that are given by the camera's name."""
        given = {self.camera(name).name: np.asarray(uv, float) for name, uv in uv_px.items()}
        if len(given) < 2:
            raise InputError(
                f"pixels of {len(given)} camera(s)", todo="give the pixels of two cameras or more"
            )
        shape = next(iter(given.values())).shape
        pixels = [given.get(c.name, np.full(shape, np.nan)) for c in self.cameras]
        if isinstance(sigma, Mapping):
            unknown = sorted(set(given) - set(sigma))
            if unknown:
                todo = "give the pixel noise of every camera whose pixels are given"
                raise InputError(f"sigma_px lacks {', '.join(unknown)}", todo=todo)
            sigma = tuple(sigma.get(c.name, 1.0) for c in self.cameras)
        elif isinstance(sigma, tuple):
            todo = "give sigma_px by camera's name, as the pixels are"
            raise InputError("sigma_px is a tuple", todo=todo)
        found = triangulate_views(self.cameras, pixels, sigma, method)
        if not include_calibration:
            return found
        sigmas = sigma if isinstance(sigma, tuple) else (sigma,) * len(self.cameras)
        covariance = found.covariance_mm2.reshape(-1, 3, 3).copy()
        points = found.points_mm.reshape(-1, 3)
        placed = np.isfinite(points).all(-1)
        count = 2 * len(self.cameras)
        information = np.zeros((len(points), count, count))
        for c, (uv, one) in enumerate(zip(pixels, sigmas)):
            seen = np.isfinite(uv).all(-1)
            block = slice(2 * c, 2 * c + 2)
            noise = seen_covariance(one, seen).reshape(-1, 2, 2)
            inverse = np.linalg.inv(noise) * seen.reshape(-1, 1, 1)
            information[:, block, block] = inverse
        covariance[placed] += self.common_covariance(points[placed], information[placed])
        return replace(found, covariance_mm2=covariance.reshape(found.covariance_mm2.shape))

    def subset(self, *cameras: str | int) -> Calibration:
        """Return the calibration of some of the cameras (names or indices), in the same rig frame.

        The pose of the first of them is taken as exact: its uncertainty moves all triangulated
        points in the same way (an S-transformation of the gauge). Raises CalibrationError if a
        camera does not exist, or if they are not in the order of `rig.toml`; InputError if the
        covariance lacks a parameter.
        """
        chosen = tuple(self.camera(camera) for camera in cameras)
        at = [self.cameras.index(camera) for camera in chosen]
        if not at or any(b <= a for a, b in pairwise(at)):
            raise CalibrationError(
                f"the cameras {', '.join(c.name for c in chosen)} are not in the rig's order",
                todo="name each camera once, in the order of rig.toml",
            )
        names = [f"{self.cameras[c].name}.{p}" for c in at for p in self.free[c]]
        names += [f"{camera.name}.{p}" for camera in chosen[1:] for p in POSE_COMPONENTS]
        rows = np.zeros((len(names), len(self.covariance_names)))
        index = {name: i for i, name in enumerate(self.covariance_names)}
        first_pose = [f"{chosen[0].name}.{p}" for p in POSE_COMPONENTS if at[0] > 0]
        missing = [name for name in [*names, *first_pose] if name not in index]
        if missing:
            raise InputError(
                f"its covariance has no {first_of(missing)}", where=f"Calibration {self.name!r}",
                todo="name every free lens parameter and pose component in covariance_names",
            )  # fmt: skip
        for row, name in enumerate(names):
            rows[row, index[name]] = 1.0
        if at[0] > 0:  # T_b Exp(x_b) seen from T_a Exp(x_a): x_b - Ad(b_from_a) x_a
            own = [index[name] for name in first_pose]
            for k, camera in enumerate(chosen[1:]):
                first = len(rows) - 6 * (len(chosen) - 1 - k)
                b_from_a = camera.camera_from_rig @ chosen[0].rig_from_camera
                rows[first : first + 6, own] = -b_from_a.adjoint()
        return replace(
            self,
            cameras=chosen,
            free=tuple(self.free[c] for c in at),
            covariance=rows @ self.covariance @ rows.T,
            covariance_names=tuple(names),
            joint_names=(),
            joint_covariance=np.zeros((0, 0)),
        )

    def sd(self, name: str) -> float:
        """Return the standard deviation of a parameter in ``covariance_names``; 0 if held fixed.

        It is NaN if it is not known. Raises InputError, with the most similar name, for one that is
        no parameter of this rig.
        """
        if name not in self.covariance_names:
            lens = [f"{camera.name}.{p}" for camera in self.cameras for p in PARAMETERS]
            poses = [f"{c.name}.{p}" for c in self.cameras[1:] for p in POSE_COMPONENTS]
            if name in lens or name in poses:
                return 0.0 if self.covariance_known else float("nan")
            raise InputError(
                f"no parameter is called {name!r}", where="Calibration.sd",
                todo=suggestion(name, [*lens, *poses]),
            )  # fmt: skip
        i = self.covariance_names.index(name)
        return float(np.sqrt(self.covariance[i, i])) if self.covariance_known else float("nan")

    def report(self) -> str:
        """Return a summary in plain words, as text of several lines."""
        return summary(self.record())

    def record(self) -> CalibrationFile:
        """Return the content of `calibration.json`; no file is written."""
        from telerig.io.results.calibration import CalibrationFile
        from telerig.io.results.cameras import CameraRecord, PoseRecord, wall_records

        content = {
            "schema": CalibrationFile.SCHEMA,
            "kind": CalibrationFile.KIND,
            "name": self.name,
            "pixel_origin": "centre",
            "units": {"length": "mm", "image": "px", "angle": "rad unless the name ends in _deg"},
            "gauge": self.diagnostics.get("gauge", ""),
            "medium": self.medium,
            "verdict": self.verdict,
            "findings": self.findings,
            "cameras": {
                c.name: CameraRecord.of_camera(c, {n: self.sd(f"{c.name}.{n}") for n in free})
                for c, free in zip(self.cameras, self.free)
            },
            "walls": wall_records(self.cameras),
            "target": {"dots": self.dot_ids, "points_mm": self.target_points_mm},
            "views": {view: PoseRecord.of_pose(pose) for view, pose in self.target_poses.items()},
            "covariance": {"names": self.covariance_names, "matrix": self.covariance},
            "model": plain(dict(self.model)),
            "stage": plain(dict(self.stage)),
            "twin": plain(dict(self.twin)),
            "statistics": dict(self.statistics),
            "diagnostics": plain(dict(self.diagnostics)),
        }
        return CalibrationFile.model_validate(content)

    def save(self, path: str | Path) -> None:
        """Write `calibration.json`, `covariance.npz`, `dots.csv` and `residuals.csv` into a folder.

        If the path ends in ``.json``, only this file and `covariance.npz` are written, which beside
        a NAME.json other than calibration.json is called NAME.covariance.npz. What is not known is
        not written; an old file of the covariance is then deleted. All files appear together.
        """
        from telerig.io.results.manifest import replaced_results

        place = Path(path)
        if place.suffix == ".json":
            self.record().write(place)
            self._write_covariance(place)
            return
        again = "Calibration.save"
        with replaced_results(place, "calibrate", again=again, inputs={}) as staged:
            self.write_files(staged)

    def write_files(self, folder: Path) -> None:
        """Write the files of `save` into an existing folder, one after the other."""
        from telerig.io.results.folders.calibration import CalibrationResults

        self.record().write(folder / "calibration.json")
        self._write_covariance(folder / "calibration.json")
        for name in ("dots.csv", "residuals.csv"):
            tables = self.tables
            if tables.has(name) if isinstance(tables, CalibrationResults) else name in tables:
                write_table(self._table(name), folder / name)

    def _write_covariance(self, place: Path) -> None:
        """Write the covariance of all parameters beside its file, or delete an old one."""
        from telerig.io.results.calibration import covariance_file, write_joint_covariance

        file = covariance_file(place)
        if self.joint_names:
            with atomic_path(file) as temporary:
                write_joint_covariance(temporary, self.joint_names, self.joint_covariance)
        else:
            file.unlink(missing_ok=True)


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration from a folder or its `calibration.json`, with the covariance beside it.

    Raises InputError if a file is missing, was not written by telerig, has a newer schema, or if
    the two files belong to different calibrations.
    """
    from telerig.io.results.calibration import CalibrationFile, covariance_file
    from telerig.io.results.folders.calibration import CalibrationResults
    from telerig.io.results.manifest import reading

    found = CalibrationResults.at(Path(path))
    with reading(found.folder, (found.name, covariance_file(found.path).name)):
        record, (names, joint) = found.file, found.joint
    if record.covariance is None:
        todo = CalibrationFile.AGAIN
        raise InputError("has no covariance", where=str(found.path), todo=todo)
    return Calibration(
        cameras=found.rig,
        dot_ids=found.dot_ids,
        target_points_mm=found.points_mm,
        target_poses=found.views,
        covariance=record.covariance.matrix,
        covariance_names=record.covariance.names,
        free=tuple(camera.free for camera in record.cameras.values()),
        name=record.name,
        findings=record.findings,
        statistics=record.statistics,
        twin=record.twin.content(),
        model=record.model.content(),
        diagnostics=record.diagnostics.content(),
        stage={} if record.stage is None else record.stage.content(),
        medium=record.medium,
        joint_names=names,
        joint_covariance=joint,
        tables=found,
    )


def of_run(calibration: Calibration, names: Sequence[str]) -> Calibration:
    """Return the calibration of the cameras that recorded a run, by their names.

    The calibration is returned unchanged if ``names`` are not two or more of its cameras;
    `check_calibration` then reports the error.
    """
    known = [camera.name for camera in calibration.cameras]
    if len(names) < 2 or len(names) >= len(known) or not set(names) <= set(known):
        return calibration
    return calibration.subset(*sorted(set(names), key=known.index))


def calibration_for(run: Path, files: Sequence[Path] | None) -> tuple[Calibration, list[Path]]:
    """Read the calibration for a run, either that of its dataset or the one in ``files``.

    files : one calibration.json, its folder or its dataset, or the camera files of OpenLPT (.txt)
    in the order of the cameras; None or empty for that of the run's dataset.
    Returns the calibration and the files that were read. Raises InputError if there is no
    calibration, or if the files do not belong together.
    """
    if not files:
        default = run.resolve().parent.parent / "results" / "calibration" / "calibration.json"
        from telerig.io.dataset.run import run_folder

        run_folder(run)
        if not default.is_file():
            inside = run.resolve().parent.name == "runs"
            raise InputError(
                "there is no calibration" if inside else "is not the folder of a run in a dataset",
                where=str(default if inside else run),
                todo="run `telerig calibrate` on the dataset, or give a calibration with "
                "--calibration"
                if inside
                else "give DATASET/runs/NAME, or the run's calibration with --calibration",
            )
        return load_calibration(default), [default]
    if len(files) == 1 and files[0].suffix != ".txt":
        from telerig.io.results.folders.calibration import CalibrationResults

        found = load_calibration(files[0])
        return found, [CalibrationResults.at(files[0]).path]
    if all(p.suffix == ".txt" for p in files):
        from telerig.io.exchange.importing.openlpt import read_openlpt_cameras

        cameras, *_ = read_openlpt_cameras(list(files))
        return calibration_from_cameras(cameras, name="OpenLPT"), list(files)
    raise InputError(
        f"--calibration was given {len(files)} times: {', '.join(p.name for p in files)}",
        todo="give one calibration.json, or the OpenLPT camera files (.txt) of all cameras",
    )


def calibration_from_cameras(
    cameras: Sequence[Camera],
    *,
    name: str = "imported",
    sigma_px: float = 0.1,
    notes: Sequence[str] = (),
) -> Calibration:
    """Make a `Calibration` from cameras that are taken as exactly known.

    cameras : the frame of the first one has to be the rig frame.
    sigma_px : standard deviation of pixels that `Calibration.triangulate` assumes.
    notes : further sentences for the user, for example the names of the cameras' files.

    The result has no free intrinsics, and the covariance of its poses is zero and not known; its
    verdict, which is IMPORTED, says so. Raises CalibrationError if there is no camera, if two have
    the same name, if the first frame is not the rig frame, or if sigma_px is not positive.
    """
    from telerig.io.results.findings import Code

    names = [c.name for c in cameras]
    if not names or len(set(names)) != len(names):
        raise CalibrationError(
            f"cameras named {names}", todo="give at least one camera, all with different names"
        )
    first = cameras[0].camera_from_rig
    if not np.allclose(np.c_[first.rotation, first.translation_mm], np.eye(3, 4), atol=1e-12):
        raise CalibrationError(
            "the first camera's frame is not the rig frame",
            where=names[0],
            todo="express all poses in the first camera's frame",
        )
    if not sigma_px > 0:
        raise CalibrationError(f"sigma_px is {sigma_px}", todo="give the pixel noise, > 0 px")
    pose_names = tuple(f"{n}.{component}" for n in names[1:] for component in POSE_COMPONENTS)
    return Calibration(
        cameras=(replace(cameras[0], camera_from_rig=Pose.identity()), *cameras[1:]),
        dot_ids=np.zeros(0, np.int64),
        target_points_mm=np.zeros((0, 3)),
        target_poses={},
        covariance=np.zeros((len(pose_names), len(pose_names))),
        covariance_names=pose_names,
        free=tuple(() for _ in cameras),
        name=name,
        findings=(
            Code.NO_UNCERTAINTY.found(),
            *(Code.NOTE.found(text=note) for note in notes),
        ),
        model={"words": "imported and held fixed"},
        diagnostics={"gauge": "as imported"},
        statistics={"scatter_px": float(sigma_px)},
    )
