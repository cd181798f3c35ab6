"""A tracked or smoothed run in the viewer: both views, paths in space, shake and speed in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from telerig.arrays import Array, Ints
from telerig.io.dataset.run import RunData
from telerig.io.report.film.views import outlines_px
from telerig.io.report.page.figures import CAMERA_COLOURS, MUTED, NAIVE, SMOOTHED
from telerig.io.report.plot.axes import colour_of
from telerig.io.report.plot.spectrum import shake_spectrum
from telerig.io.results.bodies import ellipsoids_of
from telerig.io.results.folders.smoothing import AXES, SmoothingResults
from telerig.io.results.folders.tracking import TrackResults
from telerig.io.view.stream import grey_levels, log_image, log_series, need_rerun, path, rgb
from telerig.rig.camera import Camera

Images = Callable[[str, int], NDArray[Any] | None]
_RAY_MM = 8.0
"""Half of the part of a ray that is drawn, about the bubble."""
_MOST_SERIES = 12
_MOST_READINGS = 20_000
_NO_TRACK = "#fabe14"


def log_run(
    stream: Any,
    tracks: TrackResults,
    smoothing: SmoothingResults | None,
    cameras: Sequence[Camera],
    detections: pd.DataFrame,
    image: Images,
    frames: Sequence[int],
) -> None:
    """Log a run, on the time lines "frame" and "time".

    cameras : of the rig, empty where they are not known. detections : what `read_outlines` returns.
    image : returns the image of a camera and frame, or None. frames : those whose images, outlines
    and bodies are shown; paths and series are whole.
    """
    rr = need_rerun()
    stream.log("space", rr.ViewCoordinates.RDF, static=True)
    times = _times(tracks, smoothing)
    _log_paths(stream, tracks, smoothing)
    _log_series(stream, tracks, smoothing)
    outlines = outlines_px(detections) if len(detections) else np.zeros((0, 0, 2))
    rows_of = {key: np.asarray(rows) for key, rows
               in detections.groupby(["frame", "camera"]).indices.items()}  # fmt: skip
    bodies = tracks.tracks if smoothing is None else _with_shapes(smoothing, tracks)
    in_space, tracked = _rows_by_frame(bodies), _rows_by_frame(tracks.tracks)
    some = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, 5).astype(int))]
    levels = {c: grey_levels([i for f in some if (i := image(c, f)) is not None])
              for c in tracks.cameras}  # fmt: skip
    for frame in frames:
        stream.set_time("frame", sequence=frame)
        if frame in times:
            stream.set_time("time", duration=times[frame])
        for camera in tracks.cameras:
            picture = image(camera, frame)
            if picture is not None:
                log_image(stream, path("images", camera, "image"), picture, levels[camera])
            rows = rows_of.get((frame, camera), np.zeros(0, np.int64))
            _log_outlines(stream, camera, detections.iloc[rows], outlines[rows])
        if len(cameras):
            _log_rays(stream, tracks, cameras, tracked.get(frame, np.zeros(0, np.int64)))
        _log_bodies(stream, bodies.iloc[in_space.get(frame, np.zeros(0, np.int64))])


def _rows_by_frame(table: pd.DataFrame) -> dict[int, Ints]:
    order = np.argsort(table["frame"].to_numpy(), kind="stable")
    frames, first = np.unique(table["frame"].to_numpy()[order], return_index=True)
    return dict(zip(frames.astype(int).tolist(), np.split(order, first[1:])))


def _times(tracks: TrackResults, smoothing: SmoothingResults | None) -> dict[int, float]:
    table = tracks.tracks if smoothing is None else smoothing.shake
    return dict(zip(table["frame"].astype(int).tolist(), table["t_s"].tolist()))


def _with_shapes(smoothing: SmoothingResults, tracks: TrackResults) -> pd.DataFrame:
    """Return the smoothed rows with the bodies' shapes, where bubbles.csv has them."""
    frames = smoothing.bubble_frames
    return frames if len(frames) else smoothing.trajectories.assign(d_eq_mm=np.nan)


def _log_outlines(stream: Any, camera: str, rows: pd.DataFrame, outlines: Array) -> None:
    rr = need_rerun()
    named = np.isfinite(rows["particle"].to_numpy(float))
    ids = np.nan_to_num(rows["particle"].to_numpy(float)).astype(int)
    colours = [rgb(colour_of(k) if known else _NO_TRACK) for k, known in zip(ids.tolist(), named)]
    words = [f"{k if known else ''} {flags}".strip()
             for k, known, flags in zip(ids.tolist(), named, rows["flags"])]  # fmt: skip
    closed = [np.vstack([outline, outline[:1]]) for outline in outlines]
    stream.log(
        path("images", camera, "outlines"), rr.LineStrips2D(closed, colors=colours, labels=words)
    )


def _log_rays(stream: Any, tracks: TrackResults, cameras: Sequence[Camera], rows: Any) -> None:
    """Log each bubble's ray of every camera as the others see it."""
    rr = need_rerun()
    table = tracks.tracks.iloc[rows]
    points = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    colours = np.array([rgb(colour_of(int(k))) for k in table["particle"]]).reshape(-1, 3)
    strips: dict[str, list[Array]] = {camera.name: [] for camera in cameras}
    shades: dict[str, list[Any]] = {camera.name: [] for camera in cameras}
    for camera in cameras:
        uv = table[[f"{camera.name}_u_px", f"{camera.name}_v_px"]].to_numpy(float)
        for k in np.flatnonzero(np.isfinite(uv).all(1)).tolist():
            origin, direction = camera.unproject(uv[k])
            direction = direction / np.linalg.norm(direction)
            along = (points[k] - origin) @ direction + np.linspace(-_RAY_MM, _RAY_MM, 9)
            ray = origin + along[:, None] * direction
            for other in cameras:
                if other.name != camera.name:
                    strips[other.name].append(other.project(ray))
                    shades[other.name].append([*colours[k], 120])
    for name, lines in strips.items():
        stream.log(path("images", name, "rays"), rr.LineStrips2D(lines, colors=shades[name]))


def _log_bodies(stream: Any, rows: pd.DataFrame) -> None:
    rr = need_rerun()
    points = rows[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    quadrics, _ = ellipsoids_of(rows)
    good = np.isfinite(quadrics).all((1, 2)) & np.isfinite(points).all(1)
    squares, axes = np.linalg.eigh(quadrics[good])
    axes = axes * np.sign(np.linalg.det(axes))[:, None, None]
    turned = Rotation.from_matrix(axes).as_quat() if len(axes) else np.zeros((0, 4))
    ids = rows["particle"].to_numpy()[good]
    stream.log("space/bubbles", rr.Ellipsoids3D(
        half_sizes=np.sqrt(squares.clip(0)), centers=points[good],
        quaternions=[rr.Quaternion(xyzw=q) for q in turned],
        colors=[rgb(colour_of(int(k))) for k in ids], labels=[str(int(k)) for k in ids],
        fill_mode="solid",
    ))  # fmt: skip


def _log_paths(stream: Any, tracks: TrackResults, smoothing: SmoothingResults | None) -> None:
    rr = need_rerun()
    kinds: dict[str, tuple[pd.DataFrame, str, str]] = {}
    if smoothing is None or not len(smoothing.trajectories):
        kinds["tracked"] = (tracks.tracks, "", SMOOTHED)
    else:
        kinds["smoothed"] = (smoothing.trajectories, "", SMOOTHED)
        if "naive_x_mm" in smoothing.trajectories:
            kinds["triangulated"] = (smoothing.trajectories, "naive_", NAIVE)
    for name, (table, prefix, colour) in kinds.items():
        lines, shades = [], []
        for particle in np.unique(table["particle"].to_numpy()).tolist():
            mine = table[table["particle"] == particle]
            place = mine[[f"{prefix}{axis}_mm" for axis in AXES]].to_numpy(float)
            lines.append(place[np.isfinite(place).all(1)])
            shades.append(rgb(colour if prefix else colour_of(int(particle))))
        stream.log(f"space/paths/{name}", rr.LineStrips3D(lines, colors=shades), static=True)


def _log_series(stream: Any, tracks: TrackResults, smoothing: SmoothingResults | None) -> None:
    table = tracks.tracks
    for particle in table["particle"].value_counts().index[:_MOST_SERIES].astype(int).tolist():
        mine = table[table["particle"] == particle]
        miss_um = 1e3 * mine["ray_miss_mm"].to_numpy(float)
        _series(stream, mine, "ray_miss_um", f"bubble {particle}", miss_um, colour_of(particle))
    if smoothing is None:
        return
    for particle in smoothing.bubbles[:_MOST_SERIES]:
        mine, name, colour = smoothing.track(particle), f"bubble {particle}", colour_of(particle)
        speed = np.linalg.norm(mine[[f"v{a}_mm_s" for a in AXES]].to_numpy(float), axis=1)
        _series(stream, mine, "speed_mm_s", name, speed, colour)
        t, up = mine["t_s"].to_numpy(float), _heights(mine, "", smoothing.up)
        line = np.polyval(np.polyfit(t, up, 1), t) if len(t) > 1 else up
        _series(stream, mine, "height_less_line_mm", name, up - line, colour)
        if {f"naive_{a}_mm" for a in AXES} <= set(mine):
            before = _heights(mine, "naive_", smoothing.up) - line
            _series(stream, mine, "height_less_line_mm", f"{name}, triangulated", before, MUTED)
    _log_shake(stream, smoothing)


def _heights(rows: pd.DataFrame, prefix: str, up: Array) -> Array:
    return np.asarray(rows[[f"{prefix}{axis}_mm" for axis in AXES]].to_numpy(float) @ up)


def _log_shake(stream: Any, smoothing: SmoothingResults) -> None:
    rr, shake = need_rerun(), smoothing.shake
    for camera in smoothing.cameras:
        spectrum = shake_spectrum(smoothing.shake, camera)
        for axis in smoothing.seen(camera):
            k, name = AXES.index(axis), f"{camera} {axis}"
            values = 1e3 * shake[f"{camera}_{axis}_mm"].to_numpy(float)
            _series(stream, shake, "shake_um", name, values, CAMERA_COLOURS[k])
            if spectrum is not None:
                bars = rr.BarChart(spectrum.density[:, k], abscissa=spectrum.frequency_hz)
                stream.log(path("spectra", name), bars, static=True)


def log_sensors(stream: Any, run: RunData, smoothing: SmoothingResults | None) -> None:
    """Log encoder and accelerometers of a recording; of many readings every k-th.

    Of a smoothed run it is what the encoder reads beyond the carriage's position, else the position
    itself.
    """
    if run.stage is not None:
        t_s, position = (run.stage[c].to_numpy(float) for c in ("t_s", "position_mm"))
        if smoothing is not None and "position_mm" in smoothing.shake:
            there, smooth = (smoothing.shake[c].to_numpy(float) for c in ("t_s", "position_mm"))
            inside = (t_s >= there[0]) & (t_s <= there[-1])
            t_s, position = t_s[inside], position[inside]
            off = 1e3 * (position - np.interp(t_s, there, smooth))
            _readings(stream, run, "encoder_residual_um", "encoder", t_s, off, MUTED)
        else:
            _readings(stream, run, "encoder_mm", "encoder", t_s, position, MUTED)
    for name, rows in [] if run.accelerometers is None else run.accelerometers.groupby("sensor"):
        t_s = rows["t_s"].to_numpy(float)
        for axis, colour in zip(AXES, CAMERA_COLOURS):
            values = rows[f"a{axis}_m_s2"].to_numpy(float)
            _readings(stream, run, "accelerometers_m_s2", f"{name} {axis}", t_s, values, colour)


def _readings(
    stream: Any, run: RunData, plot: str, name: str, t_s: Array, values: Array, colour: str
) -> None:
    """Log readings at times of their own beside the frames in which they were taken."""
    some = slice(None, None, max(1, len(t_s) // _MOST_READINGS))
    frames = np.searchsorted(run.t_s, t_s[some], side="right").clip(1) - 1
    log_series(stream, plot, frames, t_s[some], {name: values[some]}, {name: colour})


def _series(
    stream: Any, rows: pd.DataFrame, plot: str, name: str, values: Array, colour: str
) -> None:
    frames, t_s = rows["frame"].to_numpy(np.int64), rows["t_s"].to_numpy(float)
    log_series(stream, plot, frames, t_s, {name: values}, {name: colour})


def layout(tracks: TrackResults, smoothing: SmoothingResults | None) -> Any:
    """Return the layout of the window: images, space and time series side by side."""
    need_rerun()
    import rerun.blueprint as rrb

    images = [
        rrb.Spatial2DView(origin=path("images", c), name=f"camera {c}") for c in tracks.cameras
    ]
    names = {"ray_miss_um": "ray miss / µm"}
    if smoothing is not None:
        names |= {"height_less_line_mm": "height less a straight line / mm",
                  "shake_um": "shake / µm", "speed_mm_s": "speed / (mm/s)",
                  "encoder_residual_um": "encoder less the carriage / µm"}  # fmt: skip
    names |= {"accelerometers_m_s2": "accelerometers / (m/s²)"}
    plots = [rrb.TimeSeriesView(origin=f"plots/{key}", name=name) for key, name in names.items()]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*images),
            rrb.Spatial3DView(origin="space", name="paths"),
            rrb.Vertical(*plots),
            column_shares=[2, 2, 2],
        ),
        rrb.TimePanel(timeline="frame"),
        collapse_panels=True,
    )
