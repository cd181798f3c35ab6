"""The tables of a run: what the lab records, and what tracking finds."""

from __future__ import annotations

from dataclasses import replace

from telerig.io.files.csv_table import Column
from telerig.io.tables.table import (
    CAMERA_NAME,
    COVARIANCE,
    FRAME,
    OF_CALIBRATION,
    OF_PIXELS,
    OF_SHAPE,
    PARTICLE,
    PIXEL,
    PIXEL_COVARIANCE,
    POINT,
    SILHOUETTES,
    TIME,
    Table,
    known,
    may,
    named,
    sd,
    sure,
    text,
    xyz,
)

FRAMES = Table(
    "frames.csv",
    "a frame of the run",
    (FRAME, TIME, text("missing", "cameras that dropped the frame, joined by |")),
)
STAGE = Table(
    "stage.csv",
    "a reading of the encoder",
    (
        *sure("t_s", "s", "time of the reading; increases"),
        *sure("position_mm", "mm", "position along the axis of the stage"),
    ),
)
ACCELEROMETER = Table(
    "accelerometer.csv",
    "a reading of one accelerometer",
    (
        *sure("t_s", "s", "time of the reading; increases for each sensor"),
        named("sensor", "name of the sensor in rig.toml"),
        *sure(xyz("a{}_m_s2"), "m s-2", "reading along the sensor's axes, gravity included"),
    ),
)
REFERENCES = Table(
    "references.csv",
    "a mark fixed to the tank in one image",
    (
        FRAME, CAMERA_NAME, named("mark", "name of the mark"),
        *sure(PIXEL, "px", "its centre"), *OF_PIXELS,
    ),
)  # fmt: skip

OUTLINE = (
    *may(["a_px", "b_px"], "px", "semi-axes of the outline's ellipse, the longer first"),
    *may("angle_rad", "rad", "direction of the longer one, from +u towards +v"),
    *may("area_px2", "px2", "area inside the outline"),
    *may("d_eq_px", "px", "diameter of the circle of equal area"),
    *may("contrast", "", "depth of the rim's shadow as a share of the background"),
    *may("edge_px", "px", "blur of the rim"),
    *may("chi2_dof", "", "chi-square per degree of freedom of the fit"),
    *may([f"{part}{k}_px" for k in range(3, 7) for part in "cs"], "px",
         "normal displacement, sum of c_k cos k phi + s_k sin k phi in the eccentric anomaly phi"),
    *sd("sigma_outline_px", "px", "standard deviation of these coefficients"),
    text("flags", "border, defocus, overlap (fitted to the arcs in sight), merged (could not be "
         "split safely), small, saturated; joined by |"),
)  # fmt: skip
DETECTIONS = Table(
    "detections.csv",
    "a bubble in one image",
    (
        FRAME, CAMERA_NAME,
        replace(PARTICLE, blank=True, what="id of the bubble; blank: in no track"),
        *known(PIXEL, "px", "centre of the outline; blank where an image gave nothing"),
        *(replace(one, blank=True) for one in OF_PIXELS), *OUTLINE,
        text("reason", "why an image gave nothing"),
    ),
)  # fmt: skip

CORRECTIONS = Table(
    "corrections.csv",
    "a correction of tracks by hand",
    (
        Column("action", "text", what="drop, join, split or rename"),
        named("particle", "the track, or the one that stays"),
        named("other", "the other track, or the new id", required=False, blank=True),
        Column("frame", "whole", required=False, blank=True, what="from here on; blank: all"),
        Column("reason", "text", what="why"),
    ),
)  # fmt: skip

TRACKS = Table(
    "tracks.csv",
    "a bubble in one frame, seen by two cameras or more",
    (
        FRAME, PARTICLE, TIME,
        *sure(POINT, "mm", "position in the rig frame, shake and travel included"),
        *known(COVARIANCE, "mm2", "covariance of the position by the noise of the measurement"),
        *known([f"{{camera}}_{name}" for name in PIXEL], "px",
             "centre of the outline in the camera's image; blank where it does not see the bubble"),
        *known([f"{{camera}}_{name}" for name in PIXEL_COVARIANCE], "px2",
             "covariance of the corrected centre: noise, and what the unknown shape leaves open"),
        *may(["{camera}_du_px", "{camera}_dv_px"], "px",
             "correction of the outline's centre towards the centre of volume"),
        *known("ray_miss_mm", "mm", "signed distance of the two rays; of more, RMS distance of the "
               "point from them"),
        *known("d_eq_mm", "mm", "diameter of the sphere of equal volume"),
        *sd("sd_eq_mm", "mm"),
        *OF_SHAPE,
        *known("confidence", "", "probability that these outlines and no others are the bubble's"),
        text("centre", "what is at the position: volume (corrected for the shape) or silhouettes"),
        *may(SILHOUETTES, "mm", "centre of the silhouettes"),
        text("flags", "those of all views, and ambiguous, shared; joined by |"),
        *OF_CALIBRATION,
    ),
)  # fmt: skip

EVENTS = Table(
    "events.csv",
    "an event of the tracking",
    (
        FRAME, replace(TIME, blank=True),
        Column("kind", "text",
               what="birth, death, gap, break, split, merge, resolved or correction"),
        Column("particles", "text", blank=True, what="ids of the tracks, with spaces between them"),
        Column("reason", "text", blank=True, what="why"),
    ),
)  # fmt: skip
