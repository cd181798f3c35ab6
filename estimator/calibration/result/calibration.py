"""The result of a self-calibration: cameras, target, poses, covariance, and what can be done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.result.summary import summary
from telerig.estimator.calibration.solver.covariance import point_shift_jacobian, rig_jacobian
from telerig.io.files.atomic import atomic_path, plain
from telerig.io.files.csv_table import write_table
from telerig.io.results.calibration import (
    CalibrationFile,
    CameraRecord,
    PoseRecord,
    read_joint_covariance,
    write_joint_covariance,
)
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.projection import PARAMETERS
from telerig.rig.triangulation import Triangulation, pixel_covariance, triangulate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Calibration:
    """A calibrated rig. The rig frame is the first camera's frame.

    cameras : in the order of `rig.toml`.
    dot_ids : (N,); target_points_mm : (N, 3) estimated dots in the target's frame.
    target_poses : view name -> rig_from_target.
    covariance : (P, P) of the rig block, ``covariance_names`` its components: the free intrinsics
        of each camera, then the tangent (rotation, translation) of rig_from_<second>.
    free : per camera, names of the free intrinsics.
    joint_names, joint_covariance : the whole estimate, or empty when loaded without it.
    stage : travel axis and encoder scale with their covariance (`StageAxis.as_dict`), or empty.
    medium : of the target, "air" or "water". Cameras may have walls either way: points that are
        projected and triangulated lie in the water behind them.
    statistics, twin, model : what `calibration.json` says of them; see docs/files.md.
    """

    cameras: tuple[Camera, ...]
    dot_ids: NDArray[np.int64]
    target_points_mm: Array
    target_poses: Mapping[str, Pose]
    covariance: Array
    covariance_names: tuple[str, ...]
    free: tuple[tuple[str, ...], ...]
    name: str = ""
    verdict: Mapping[str, Any] = field(default_factory=dict)
    statistics: Mapping[str, Any] = field(default_factory=dict)
    twin: Mapping[str, Any] = field(default_factory=dict)
    model: Mapping[str, Any] = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    stage: Mapping[str, Any] = field(default_factory=dict)
    medium: str = "air"
    joint_names: tuple[str, ...] = ()
    joint_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    dots: Any = None
    residuals: Any = None

    def camera(self, camera: str | int) -> Camera:
        """A camera by name or index; raises CalibrationError for one that is not there."""
        if isinstance(camera, (int, np.integer)) and 0 <= camera < len(self.cameras):
            return self.cameras[camera]
        for candidate in self.cameras:
            if candidate.name == camera:
                return candidate
        names = ", ".join(repr(c.name) for c in self.cameras)
        raise CalibrationError(f"no camera {camera!r} in this calibration", todo=f"it has {names}")

    def in_air(self) -> Calibration:
        """The same rig without its walls: for points in air, such as a target held there."""
        return replace(self, cameras=tuple(replace(c, wall=None) for c in self.cameras))

    def project(self, camera: str | int, points_mm: ArrayLike) -> Array:
        """(N, 3) rig points, behind the camera's wall if it has one -> (N, 2) pixels."""
        return self.camera(camera).project(points_mm)

    def unproject(self, camera: str | int, uv_px: ArrayLike) -> tuple[Array, Array]:
        """(N, 2) pixels -> (N, 3) ray origins and (N, 3) unit directions in the rig frame.

        Behind a wall the rays are those in the water.
        """
        return self.camera(camera).unproject(uv_px)

    def project_covariance(self, camera: str | int, points_mm: ArrayLike) -> Array:
        """(N, 2, 2) covariance of projected points (px^2) that comes from the calibration."""
        index = self.cameras.index(self.camera(camera))
        jacobian = rig_jacobian(self.cameras, self.free, np.asarray(points_mm, float))
        rows = jacobian[..., 2 * index : 2 * index + 2, :]
        return rows @ self.covariance @ np.swapaxes(rows, -1, -2)

    def triangulate(
        self,
        uv_first_px: ArrayLike,
        uv_second_px: ArrayLike,
        *,
        sigma_px: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
        method: str = "ml",
        include_calibration: bool = True,
    ) -> Triangulation:
        """Points in the rig frame from pixels in both cameras.

        sigma_px : pixel noise, a scalar, (N,), (N, 2, 2), or a pair of these for the two cameras;
            None takes the scatter of this calibration's own dots.
        method : "ml" or "midpoint".
        include_calibration : add the calibration's share to ``covariance_mm2``. It is common to
            all points; ``measurement_covariance_mm2`` is the share that is not.

        Raises CalibrationError for a single camera, InputError for shapes that do not match.
        """
        if len(self.cameras) != 2:
            raise CalibrationError(
                "one camera cannot triangulate: the depth along its axis is never seen",
                todo="calibrate two cameras",
            )
        sigma: Any = self.statistics.get("scatter_px", 0.02) if sigma_px is None else sigma_px
        pair = (self.cameras[0], self.cameras[1])
        found = triangulate(pair, (uv_first_px, uv_second_px), sigma, method)
        if not include_calibration:
            return found
        shape = found.points_mm.shape[:-1]
        sigmas = sigma if isinstance(sigma, tuple) else (sigma, sigma)
        information = np.zeros((*shape, 4, 4))
        for c in range(2):
            block = slice(2 * c, 2 * c + 2)
            information[..., block, block] = np.linalg.inv(pixel_covariance(sigmas[c], shape))
        shift = point_shift_jacobian(pair, self.free, found.points_mm, information)
        share = shift @ self.covariance @ np.swapaxes(shift, -1, -2)
        return Triangulation(
            found.points_mm,
            found.covariance_mm2 + share,
            found.ray_miss_mm,
            found.measurement_covariance_mm2,
        )

    def sd(self, name: str) -> float:
        """Standard deviation of one component of the rig block; 0 when it is held."""
        if name not in self.covariance_names:
            return 0.0
        i = self.covariance_names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    def report(self) -> str:
        """A summary in plain words."""
        return summary(self.record())

    def record(self) -> CalibrationFile:
        """The content of calibration.json."""
        content = {
            "schema": CalibrationFile.SCHEMA,
            "kind": CalibrationFile.KIND,
            "name": self.name,
            "pixel_origin": "centre",
            "units": {"length": "mm", "image": "px", "angle": "rad unless the name ends in _deg"},
            "gauge": self.diagnostics.get("gauge", ""),
            "medium": self.medium,
            "verdict": plain(dict(self.verdict)),
            "cameras": {c.name: self._camera_record(c, f) for c, f in zip(self.cameras, self.free)},
            "walls": {c.name: c.wall.as_dict() for c in self.cameras if c.wall is not None},
            "target": {"dots": self.dot_ids, "points_mm": self.target_points_mm},
            "views": {view: PoseRecord.of_pose(pose) for view, pose in self.target_poses.items()},
            "covariance": {"names": self.covariance_names, "matrix": self.covariance},
            "model": plain(dict(self.model)),
            "stage": plain(dict(self.stage)),
            "twin": plain(dict(self.twin)),
            "statistics": dict(self.statistics),
            "diagnostics": plain(dict(self.diagnostics)),
            "notes": self.notes,
        }
        return CalibrationFile.model_validate(content)

    def _camera_record(self, camera: Camera, free: tuple[str, ...]) -> CameraRecord:
        deviations = {n: self.sd(f"{camera.name}.{n}") for n in free}
        return CameraRecord(
            image_size_px=camera.image_size_px,
            rho_mm=camera.rho_mm,
            parameters={p: camera[p] for p in PARAMETERS},
            free=free,
            standard_deviations={n: s if np.isfinite(s) else None for n, s in deviations.items()},
            camera_from_rig=PoseRecord.of_pose(camera.camera_from_rig),
        )

    def save(self, path: str | Path) -> None:
        """Write calibration.json, covariance.npz, dots.csv and residuals.csv into a folder.

        A path that ends in ``.json`` writes that file, and covariance.npz beside it.
        """
        place = Path(path)
        alone = place.suffix == ".json"
        folder = place.parent if alone else place
        folder.mkdir(parents=True, exist_ok=True)
        self.record().write(place if alone else folder / "calibration.json")
        if self.joint_names:
            with atomic_path(folder / "covariance.npz") as temporary:
                write_joint_covariance(temporary, self.joint_names, self.joint_covariance)
        else:
            (folder / "covariance.npz").unlink(missing_ok=True)
        for name, table in (("dots.csv", self.dots), ("residuals.csv", self.residuals)):
            if table is not None and not alone:
                write_table(table, folder / name)


def load_calibration(path: str | Path) -> Calibration:
    """Read ``calibration.json`` (or its folder), with covariance.npz if it lies beside.

    Raises InputError when a file is missing, is not what telerig wrote, or is of a newer schema.
    """
    place = Path(path)
    file = place / "calibration.json" if place.is_dir() else place
    record = CalibrationFile.read(file)
    if record.covariance is None:
        raise InputError("has no covariance", where=str(file), todo=CalibrationFile.AGAIN)
    names, joint = read_joint_covariance(file.parent / "covariance.npz")
    rig = record.covariance.matrix
    if names and not np.allclose(joint[: len(rig), : len(rig)], rig, rtol=1e-9, atol=0):
        raise InputError(
            "this covariance belongs to another calibration than the calibration.json beside it",
            where=str(file.parent / "covariance.npz"),
            todo="copy both files together, or delete this one",
        )
    return Calibration(
        cameras=record.rig_cameras(behind_walls=True),
        dot_ids=record.target.dots,
        target_points_mm=record.target.points_mm,
        target_poses={view: pose.pose() for view, pose in record.views.items()},
        covariance=rig,
        covariance_names=record.covariance.names,
        free=tuple(camera.free for camera in record.cameras.values()),
        name=record.name,
        verdict=record.verdict.content(),
        statistics=record.statistics,
        twin=record.twin.content(),
        model=record.model.content(),
        diagnostics=record.diagnostics.content(),
        notes=record.notes,
        stage={} if record.stage is None else record.stage.content(),
        medium=record.medium,
        joint_names=names,
        joint_covariance=joint,
    )
