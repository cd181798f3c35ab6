"""A calibration in the viewer: the rig with all poses, and every view's image with its dots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.io.report.overlays import grey_levels
from telerig.io.report.plot.axes import KEPT, LEFT_OUT, camera_colour, rgb
from telerig.io.report.plot.outline import camera_outline, rig_outline
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.io.view.names import DEVIATIONS, MAGNIFIED, RIG, VIEW, need_rerun, of_image, path
from telerig.io.view.stream import log_image
from telerig.rig.camera import Camera

Images = Callable[[str, str], NDArray[Any] | None]
_BOX = [0, 1, 2, 3, 0, 4, 5, 1, 5, 6, 2, 6, 7, 3, 7, 4]


def log_calibration(stream: Any, results: CalibrationResults, image: Images) -> None:
    """Log a calibration, with a time line of its views.

    image : returns the image of a camera and view, or None.
    """
    rr = need_rerun()
    stream.log(RIG, rr.ViewCoordinates.RDF, static=True)
    outline = rig_outline(results.cameras, results.views, results.points_mm)
    log_cameras(stream, RIG, results.cameras, outline.plates_mm.reshape(-1, 3))
    some = list(results.views)[:3]
    levels = {c: grey_levels([i for v in some if (i := image(c, v)) is not None])
              for c in results.camera_names}  # fmt: skip
    for k, view in enumerate(results.views):
        stream.set_time(VIEW, sequence=k)
        loop = outline.plates_mm[k][[0, 1, 2, 3, 0]]
        stream.log(f"{RIG}/target/plate", rr.LineStrips3D([loop], labels=[view]))
        stream.log(f"{RIG}/target/dots", rr.Points3D(outline.dots_mm[k], radii=0.15))
        for camera in results.camera_names:
            _log_view(stream, results, camera, view, image, levels[camera])
    plates = outline.plates_mm[:, [0, 1, 2, 3, 0]]
    thin = rr.Radius.ui_points(0.5)
    poses = rr.LineStrips3D(list(plates), colors=[170, 170, 170], radii=thin)
    stream.log(f"{RIG}/all_poses", poses, static=True)
    off = results.points_mm - _flat(results.points_mm)
    arrows = rr.Arrows3D(origins=results.points_mm, vectors=DEVIATIONS * off,
                         labels=[str(d) for d in results.dot_ids], show_labels=False)  # fmt: skip
    stream.log("target/deviations", arrows, static=True)


def _flat(points_mm: Any) -> Any:
    """Return the points (N, 3) moved onto their plane."""
    middle = points_mm.mean(0)
    normal = np.linalg.svd(points_mm - middle)[2][-1]
    return points_mm - np.outer((points_mm - middle) @ normal, normal)


def _log_view(
    stream: Any, results: CalibrationResults, camera: str, view: str, image: Images,
    levels: tuple[float, float],
) -> None:  # fmt: skip
    rr = need_rerun()
    place, picture = of_image(camera), image(camera, view)
    if picture is None:
        stream.log(f"{place}/image", rr.Clear(recursive=False))
    else:
        log_image(stream, f"{place}/image", picture, levels)
    table = results.residuals
    mine = table[(table["camera"] == camera) & (table["view"] == view)]
    uv = mine[["u_px", "v_px"]].to_numpy(float)
    kept = mine["kept"].to_numpy(bool)
    colours = np.where(kept[:, None], rgb(KEPT), rgb(LEFT_OUT))
    words = [f"{dot} {reason}".strip() for dot, reason in zip(mine["dot"], mine["reason"])]
    stream.log(f"{place}/dots", rr.Points2D(uv, colors=colours, radii=rr.Radius.ui_points(2.5),
                                            labels=words, show_labels=False))  # fmt: skip
    arrows = MAGNIFIED * mine[["du_px", "dv_px"]].to_numpy(float)
    stream.log(f"{place}/residuals", rr.Arrows2D(origins=uv, vectors=arrows, colors=[255, 160, 0]))
    rejected = results.rejected
    if len(rejected):
        those = rejected[(rejected["camera"] == camera) & (rejected["view"] == view)]
        points = those[["u_px", "v_px"]].to_numpy(float)
        stream.log(f"{place}/rejected", rr.Points2D(
            points, colors=rgb(LEFT_OUT), radii=rr.Radius.ui_points(4.0),
            labels=those["reason"].tolist(), show_labels=False,
        ))  # fmt: skip


def log_cameras(
    stream: Any, place: str, cameras: Sequence[Camera], points_mm: Array, bodies: bool = True
) -> None:
    """Log what cameras see round points (N, 3), their optical axes, and their bodies, at a place.

    Bodies stand where they are drawn; their distance is not measured.
    """
    rr = need_rerun()
    for i, camera in enumerate(camera_outline(camera, points_mm) for camera in cameras):
        colour, entity = rgb(camera_colour(i)), f"{place}/{path('cameras', camera.name)}"
        body, field = (part.reshape(8, 3)[_BOX] for part in (camera.body_mm, camera.field_mm))
        if bodies:
            stream.log(f"{entity}/body", rr.LineStrips3D([body], colors=colour), static=True)
        thin = rr.Radius.ui_points(0.4)
        stream.log(f"{entity}/field", rr.LineStrips3D(
            [field], colors=[(c + 2 * 255) // 3 for c in colour], radii=thin
        ), static=True)  # fmt: skip
        stream.log(f"{entity}/axis",
                   rr.LineStrips3D([camera.axis_mm], colors=colour, labels=[camera.name]),
                   static=True)  # fmt: skip
