"""Names of what a recording holds, the same in finished and in live views, and its layout."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from telerig.errors import need_package

FRAME, TIME, VIEW = "frame", "time", "view"
"""The time lines: frames and seconds of a run, views of a calibration."""
RIG, SPACE, BODIES, PATHS = "rig", "space", "space/bubbles", "space/paths"
MAGNIFIED, DEVIATIONS = 1_000.0, 100.0
"""Residuals, and deviations of the dots, are drawn so many times as long as they are."""
SHOWN_S = 10.0
"""How much of its curves a live view shows."""
SPACE_TITLE = "paths; grey: triangulated, and a band of 2 sd"
PLOTS = {
    "ray_miss_um": "ray miss / µm",
    "step_mm": "way from frame to frame / mm",
    "outline_chi2": "chi-square of the outlines per degree of freedom",
    "height_less_line_mm": "height less a straight line / mm",
    "shake_um": "shake / µm",
    "speed_mm_s": "speed / (mm/s)",
    "encoder_residual_um": "encoder less the carriage / µm",
    "encoder_mm": "encoder / mm",
    "accelerometers_m_s2": "accelerometers / (m/s²)",
    "clock_ms": "clocks against the computer's, since the beginning / ms",
    "rate_hz": "readings per second",
}
"""Plots over time by their names, with their titles."""


def need_rerun() -> Any:
    """Return rerun. Raises InputError, with what to install, where it is missing."""
    return need_package("rerun", "view", "the viewer")


def path(*parts: str) -> str:
    """Return the path of an entity; names of cameras and views may hold any character."""
    return str(need_rerun().new_entity_path(list(parts)))


def of_image(camera: str, *part: str) -> str:
    """Return the path of a camera's image, or of something that is drawn into it."""
    return path("images", camera, *part)


def of_plot(plot: str, name: str) -> str:
    """Return the path of one curve of a plot."""
    return path("plots", plot, name.replace(" ", "_"))


def of_spectrum(name: str, axis: str = "") -> str:
    """Return the path of a spectrum: the root of the density in µm/√Hz, over Hz."""
    return path("spectra", *filter(None, (name, axis)))


def run_layout(
    cameras: Sequence[str], plots: Iterable[str], *, space: bool = True, spectra: bool = True,
    live: str = "",
) -> Any:  # fmt: skip
    """Return the layout of a run's window: images, space, and series in time side by side.

    live : the time line that the window follows, of which curves show the last seconds; "" if the
        user moves along the frames.
    """
    need_rerun()
    import rerun.blueprint as rrb

    ranges = None
    if live == TIME:
        begin = rrb.TimeRangeBoundary.cursor_relative(seconds=-SHOWN_S)
        ranges = [rrb.VisibleTimeRange(TIME, start=begin, end=rrb.TimeRangeBoundary.infinite())]
    images = [
        rrb.Spatial2DView(origin=of_image(c), name=f"{c}: outlines with ids, rays of other cameras")
        for c in cameras
    ]
    series = [
        rrb.TimeSeriesView(origin=f"plots/{key}", name=PLOTS[key], time_ranges=ranges)
        for key in plots
    ]
    middle: list[Any] = [rrb.Spatial3DView(origin=SPACE, name=SPACE_TITLE)] if space else []
    if spectra:
        title = "spectrum of the shake / (µm/√Hz) over Hz"
        middle.append(rrb.BarChartView(origin="spectra", name=title))
    columns = (images, middle, series)
    return rrb.Blueprint(
        rrb.Horizontal(*(rrb.Vertical(*column) for column in columns if column)),
        rrb.TimePanel(timeline=live or FRAME, play_state="following" if live else "paused"),
        collapse_panels=True,
    )


def calibration_layout(cameras: Sequence[str]) -> Any:
    """Return the layout of a calibration's window: images on the left, the rig on the right."""
    need_rerun()
    import rerun.blueprint as rrb

    words = f"green: kept, red: left out, orange: residual x {MAGNIFIED:g}"
    images = [rrb.Spatial2DView(origin=of_image(c), name=f"{c}; {words}") for c in cameras]
    deviations = f"dots off a plane, x {DEVIATIONS:g}"
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*images),
            rrb.Vertical(
                rrb.Spatial3DView(origin=RIG, name="rig; grey: poses of all views"),
                rrb.Spatial3DView(origin="target", name=deviations),
                row_shares=[2, 1],
            ),
        ),
        rrb.TimePanel(timeline=VIEW),
        collapse_panels=True,
    )
