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
from telerig.io.report.overlays import grey_levels
from telerig.io.report.plot.axes import (
    COLOURS,
    MUTED,
    NAIVE,
    NO_TRACK,
    SMOOTHED,
    colour_of,
    rgb,
)
from telerig.io.report.plot.spectrum import shake_spectrum
from telerig.io.results.bodies import ellipsoids_of
from telerig.io.results.folders.smoothing import AXES, SmoothingResults
from telerig.io.results.folders.tracking import TrackResults
from telerig.io.tables.table import POINT
from telerig.io.view.calibration import log_cameras
from telerig.io.view.names import (
    BODIES,
    FRAME,
    PATHS,
    SPACE,
    TIME,
    need_rerun,
    of_image,
)
from telerig.io.view.stream import log_image, log_series, log_spectrum
from telerig.rig.camera import Camera

Images = Callable[[str, int], NDArray[Any] | None]
_RAY_MM = 8.0
"""Half of the part of a ray that is drawn, about the bubble."""
_SURE = 0.95
"""A pair of outlines with a smaller probability is marked."""
_BAND_SD = 2.0
_MOST_SERIES = 12
_MOST_READINGS = 20_000


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

    cameras : of the rig, empty where they are not known. detections : from `found_outlines`.
    image : returns the image of a camera and frame, or None. frames : those whose images, outlines
    and bodies are shown; paths and series are whole.
    """
    rr = need_rerun()
    stream.log(SPACE, rr.ViewCoordinates.RDF, static=True)
    times = _times(tracks, smoothing)
    _log_paths(stream, tracks, smoothing)
    log_track_series(stream, tracks.tracks, detections)
    if smoothing is not None:
        _log_smoothed_series(stream, smoothing)
    if len(cameras) and len(tracks.tracks):
        log_cameras(stream, f"{SPACE}/rig", cameras, tracks.points_mm, bodies=False)
    bodies = tracks.tracks if smoothing is None else smoothing.shaped
    found, in_space, tracked = map(_rows_by_frame, (detections, bodies, tracks.tracks))
    hidden = _hidden(tracks.tracks)
    unseen, none = _rows_by_frame(hidden), np.zeros(0, np.int64)
    some = [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, 5).astype(int))]
    levels = {c: grey_levels([i for f in some if (i := image(c, f)) is not None])
              for c in tracks.cameras}  # fmt: skip
    for frame in frames:
        stream.set_time(FRAME, sequence=frame)
        if frame in times:
            stream.set_time(TIME, duration=times[frame])
        for camera in tracks.cameras:
            picture = image(camera, frame)
            if picture is not None:
                log_image(stream, of_image(camera, "image"), picture, levels[camera])
        rows = tracks.tracks.iloc[tracked.get(frame, none)]
        log_outlines(stream, tracks.cameras, detections.iloc[found.get(frame, none)])
        log_rays(stream, cameras, rows)
        _log_hidden(stream, cameras, hidden.iloc[unseen.get(frame, none)], rows)
        here = bodies.iloc[in_space.get(frame, none)]
        if smoothing is not None:
            _log_travel(stream, rows, here)
        log_bodies(stream, here)


def _rows_by_frame(table: pd.DataFrame) -> dict[int, Ints]:
    order = np.argsort(table["frame"].to_numpy(), kind="stable")
    frames, first = np.unique(table["frame"].to_numpy()[order], return_index=True)
    return dict(zip(frames.astype(int).tolist(), np.split(order, first[1:])))


def _times(tracks: TrackResults, smoothing: SmoothingResults | None) -> dict[int, float]:
    table = tracks.tracks if smoothing is None else smoothing.shake
    return dict(zip(table["frame"].astype(int).tolist(), table["t_s"].tolist()))


def _hidden(tracks: pd.DataFrame) -> pd.DataFrame:
    """Return where bubbles are in the frames between those that see them, on straight lines."""
    parts = []
    for particle, mine in tracks.groupby("particle"):
        seen = mine["frame"].to_numpy(np.int64)
        gap = np.setdiff1d(np.arange(seen[0], seen[-1]), seen)
        if len(gap):
            place = {c: np.interp(gap, seen, mine[c].to_numpy(float)) for c in POINT}
            parts.append(pd.DataFrame({"frame": gap, "particle": particle, **place}))
    columns = ["frame", "particle", *POINT]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def log_outlines(stream: Any, cameras: Sequence[str], rows: pd.DataFrame) -> None:
    """Log the outlines of a frame's detections, in the colours of their tracks."""
    rr = need_rerun()
    for camera in cameras:
        mine = rows[rows["camera"] == camera]
        outlines = outlines_px(mine) if len(mine) else np.zeros((0, 1, 2))
        named = np.isfinite(mine["particle"].to_numpy(float))
        ids = np.nan_to_num(mine["particle"].to_numpy(float)).astype(int)
        colours = [
            rgb(colour_of(k) if known else NO_TRACK) for k, known in zip(ids.tolist(), named)
        ]
        words = [f"{k if known else 'no track'} {flags}".strip()
                 for k, known, flags in zip(ids.tolist(), named, mine["flags"])]  # fmt: skip
        closed = [np.vstack([outline, outline[:1]]) for outline in outlines]
        strips = rr.LineStrips2D(closed, colors=colours, labels=words)
        stream.log(of_image(camera, "outlines"), strips)


def log_rays(stream: Any, cameras: Sequence[Camera], rows: pd.DataFrame) -> None:
    """Log each bubble's ray of every camera, in space and as the other cameras see it.

    Pairs of outlines that are uncertain are marked where the rays begin. rows : of tracks.csv.
    """
    rr = need_rerun()
    points = rows[[*POINT]].to_numpy(float)
    colours = np.array([rgb(colour_of(int(k))) for k in rows["particle"]]).reshape(-1, 3)
    sure = rows["confidence"].to_numpy(float) if "confidence" in rows else np.ones(len(rows))
    strips: dict[str, list[Array]] = {camera.name: [] for camera in cameras}
    shades: dict[str, list[Any]] = {camera.name: [] for camera in cameras}
    words: dict[str, list[str]] = {camera.name: [] for camera in cameras}
    rays = []
    for camera in cameras:
        uv = rows[[f"{camera.name}_u_px", f"{camera.name}_v_px"]].to_numpy(float)
        doubtful = np.flatnonzero((sure < _SURE) & np.isfinite(uv).all(1)).tolist()
        stream.log(of_image(camera.name, "uncertain_pairs"), rr.Points2D(
            uv[doubtful], colors=rgb(NO_TRACK), radii=rr.Radius.ui_points(4.0),
            labels=[f"pair {sure[k]:.0%}" for k in doubtful],
        ))  # fmt: skip
        for k in np.flatnonzero(np.isfinite(uv).all(1)).tolist():
            origin, direction = camera.unproject(uv[k])
            direction = direction / np.linalg.norm(direction)
            along = (points[k] - origin) @ direction + np.linspace(-_RAY_MM, _RAY_MM, 9)
            rays.append(origin + along[:, None] * direction)
            for other in cameras:
                if other.name != camera.name:
                    strips[other.name].append(other.project(rays[-1]))
                    shades[other.name].append([*colours[k], 120])
                    words[other.name].append(f"{rows['particle'].iloc[k]} in {camera.name}")
    for name, lines in strips.items():
        lines_px = rr.LineStrips2D(
            lines, colors=shades[name], labels=words[name], show_labels=False
        )
        stream.log(of_image(name, "rays"), lines_px)
    stream.log(
        f"{SPACE}/rig/rays",
        rr.LineStrips3D(rays, colors=[190, 190, 190], radii=rr.Radius.ui_points(0.5)),
    )


def _log_hidden(
    stream: Any, cameras: Sequence[Camera], hidden: pd.DataFrame, rows: pd.DataFrame
) -> None:
    """Log where bubbles are predicted in the images of cameras that do not see them."""
    rr = need_rerun()
    for camera in cameras:
        blank = rows[~np.isfinite(rows[f"{camera.name}_u_px"].to_numpy(float))]
        both = pd.concat([part for part in (hidden, blank) if len(part)] or [hidden])
        stream.log(of_image(camera.name, "predicted"), rr.Points2D(
            camera.project(both[[*POINT]].to_numpy(float)), radii=rr.Radius.ui_points(3.0),
            colors=[rgb(colour_of(int(k))) for k in both["particle"]],
            labels=[f"{int(k)} hidden" for k in both["particle"]],
        ))  # fmt: skip


def _log_travel(stream: Any, rows: pd.DataFrame, smoothed: pd.DataFrame) -> None:
    """Log how far the rig has moved: the tank's frame less the rig's, of the same bubbles."""
    rr = need_rerun()
    if f"naive_{POINT[0]}" not in smoothed:
        return
    both = rows.merge(smoothed, on="particle", suffixes=("", "_smoothed"))
    moved = both[[f"naive_{c}" for c in POINT]].to_numpy(float) - both[[*POINT]].to_numpy(float)
    if np.isfinite(moved).all(1).any():
        stream.log(f"{SPACE}/rig", rr.Transform3D(translation=np.nanmedian(moved, axis=0)))


def log_bodies(stream: Any, rows: pd.DataFrame) -> None:
    """Log the bodies of a frame's bubbles in space; rows : of tracks.csv, one per bubble."""
    rr = need_rerun()
    points = rows[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    quadrics, _ = ellipsoids_of(rows)
    good = np.isfinite(quadrics).all((1, 2)) & np.isfinite(points).all(1)
    squares, axes = np.linalg.eigh(quadrics[good])
    axes = axes * np.sign(np.linalg.det(axes))[:, None, None]
    turned = Rotation.from_matrix(axes).as_quat() if len(axes) else np.zeros((0, 4))
    ids = rows["particle"].to_numpy()[good]
    stream.log(BODIES, rr.Ellipsoids3D(
        half_sizes=np.sqrt(squares.clip(0)), centers=points[good],
        quaternions=[rr.Quaternion(xyzw=q) for q in turned],
        colors=[rgb(colour_of(int(k))) for k in ids], labels=[str(int(k)) for k in ids],
        fill_mode="solid",
    ))  # fmt: skip


def _log_paths(stream: Any, tracks: TrackResults, smoothing: SmoothingResults | None) -> None:
    rr = need_rerun()
    kinds: dict[str, tuple[pd.DataFrame, str, str]] = {}
    bands: list[Array] = []
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
            if name == "smoothed" and smoothing is not None:
                sd = mine[[f"s{axis}_mm" for axis in AXES]].to_numpy(float) * smoothing.up
                bands += [place + side * _BAND_SD * sd for side in (-1, 1)]
        stream.log(f"{PATHS}/{name}", rr.LineStrips3D(lines, colors=shades), static=True)
    stream.log(
        f"{PATHS}/bands",
        rr.LineStrips3D(bands, colors=[190, 190, 190], radii=rr.Radius.ui_points(0.4)),
        static=True,
    )


def log_track_series(stream: Any, tracks: pd.DataFrame, detections: pd.DataFrame) -> None:
    """Log ray miss, way and fit of the outlines of the longest tracks, or of some frames."""
    table = detections if "chi2_dof" in detections else detections.assign(chi2_dof=np.nan)
    fits = table.groupby(["frame", "particle"])["chi2_dof"].mean()
    for particle in tracks["particle"].value_counts().index[:_MOST_SERIES].astype(int).tolist():
        mine, name = tracks[tracks["particle"] == particle], f"bubble {particle}"
        miss_um = 1e3 * mine["ray_miss_mm"].to_numpy(float)
        _series(stream, mine, "ray_miss_um", name, miss_um, colour_of(particle))
        steps = np.diff(mine[[*POINT]].to_numpy(float), axis=0)
        ways = np.linalg.norm(steps, axis=1) / np.diff(mine["frame"])
        _series(stream, mine.iloc[1:], "step_mm", name, ways, colour_of(particle))
        fit = fits.reindex([(f, particle) for f in mine["frame"]]).to_numpy(float)
        _series(stream, mine, "outline_chi2", name, fit, colour_of(particle))


def _log_smoothed_series(stream: Any, smoothing: SmoothingResults) -> None:
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
    shake = smoothing.shake
    for camera in smoothing.cameras:
        spectrum = shake_spectrum(shake, camera)
        if spectrum is not None:
            log_spectrum(stream, camera, spectrum, static=True)
        for axis in smoothing.seen(camera):
            values = 1e3 * shake[f"{camera}_{axis}_mm"].to_numpy(float)
            colour = COLOURS[AXES.index(axis)]
            _series(stream, shake, "shake_um", f"{camera} {axis}", values, colour)


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
        for axis, colour in zip(AXES, COLOURS):
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
