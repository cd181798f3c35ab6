"""A tracked run in words: the verdict, key numbers, events, flags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.report.page.page import Row, Tile, Verdict, link_to
from telerig.io.results.folders.tracking import (
    NORMAL_MEDIAN,
    TrackResults,
    frame_count,
    learnt_sd_mm,
    ray_miss_ratio,
    ray_miss_sd_mm,
    track_lengths,
)
from telerig.io.results.tracking import share_words
from telerig.short_text import ABSENT, number, sentence, share
from telerig.statistics import median, rms

MOST_EVENTS = 60
_MISS_TOO_LARGE = 3.0
_MATCHED_TOO_FEW = 0.5
_AMBIGUOUS = "ambiguous"


def verdict(results: TrackResults) -> Verdict:
    """How much was found, how well it is known, and what is wrong."""
    points, tracks = len(results.tracks), len(track_lengths(results))
    frames = frame_count(results)
    if not points:
        headline = f"No bubble was followed in {_many(frames, 'frame')}"
        return Verdict(headline, "rejected", (_matched_words(results),), _warnings(results))
    headline = (
        f"{_many(tracks, 'track')}, {_many(points, 'position')} in space, {_many(frames, 'frame')}"
    )
    warnings = _warnings(results)
    common = share_words(results.file.calibration_sd_mm, results.file.extrapolated)
    precision = (_precision_words(results), *common)
    sentences = (_matched_words(results), *precision, _miss_words(results))
    return Verdict(headline, "usable" if warnings else "good", sentences, warnings)


def _many(count: int, word: str) -> str:
    return f"{number(count)} {word}{'' if count == 1 else 's'}"


def _matched(results: TrackResults) -> tuple[int, int] | None:
    """Detections that belong to a bubble seen by two cameras or more, of all."""
    found = len(results.outlines) or results.file.detections or 0
    if found <= 0:
        return None
    seen = results.tracks[[f"{c}_u_px" for c in results.cameras]].notna().to_numpy().sum()
    return min(int(seen), found), found


def _matched_words(results: TrackResults) -> str:
    matched = _matched(results)
    if matched is None:
        return "How many bubbles the single images held is not known."
    part, whole = matched
    return (
        f"{number(whole)} bubbles were found in single images; {share(part, whole)} of them have "
        "a partner in another camera and a track."
    )


def _precision_words(results: TrackResults) -> str:
    x, y, z = (number(median(column), 2) for column in results.sd_um.T)
    return (
        f"A position is known to {x}, {y} and {z} µm in x, y and z (1 sd, median), errors of the "
        "calibration left out."
    )


def _miss_words(results: TrackResults) -> str:
    miss = 1e3 * results.tracks["ray_miss_mm"].to_numpy(float)
    typical, ratio = median(np.abs(miss)), ray_miss_ratio(results, ray_miss_sd_mm(results))
    text = f"The two rays of a bubble miss each other by {number(typical, 2)} µm (median), "
    if len(results.cameras) > 2:
        text = (
            f"The rays of a bubble miss its point by {number(typical, 2)} µm (median of the RMS), "
        )
    if ratio is None:
        return text + "what that should be is not known."
    text += f"{number(ratio, 2)} times what the outlines' noise predicts."
    whole = ray_miss_ratio(results, _with_learnt(results), centred=True)
    if ratio > _MISS_TOO_LARGE and whole is not None and whole < _MISS_TOO_LARGE:
        text += (
            " The vibration of the cameras against each other "
            f"({number(results.pairs.frame_px, 2)} px from frame to frame) and the "
            f"scatter of single pairs of outlines ({number(results.pairs.scatter_px, 2)} px), "
            "both estimated from this run, explain the difference. Of them the covariances in "
            "tracks.csv contain the scatter alone, and only of bubbles without outlines."
        )
    return text


def _with_learnt(results: TrackResults) -> Array | None:
    """Return the sd (N,) of the ray miss by the outlines' noise, shake and scatter."""
    noise, learnt = ray_miss_sd_mm(results), learnt_sd_mm(results)
    return None if noise is None else np.asarray(np.hypot(noise, learnt or 0.0))


def _warnings(results: TrackResults) -> tuple[str, ...]:
    words = []
    if results.pairs.calibration_problem:
        offset, varies = _offset(results.pairs.bias_px)
        words.append(
            "Two cameras disagree along the direction perpendicular to both optical axes"
            + ("" if offset is None else f" (offset {number(offset)} px{varies})")
            + ": this is a calibration problem. Calibrate again before you use these tracks."
        )
    ratio = ray_miss_ratio(results, _with_learnt(results), centred=bool(words))
    if ratio is not None and ratio > _MISS_TOO_LARGE:
        scatter = "Even without their common offset, rays" if words else "Rays"
        words.append(
            f"{scatter} miss by {number(ratio, 2)} times what the outlines' noise predicts: the "
            "calibration, the pairs or the shapes of the bubbles are worse than the covariances "
            "in tracks.csv say."
        )
    matched = _matched(results)
    if matched is not None and matched[0] < _MATCHED_TOO_FEW * matched[1]:
        words.append(
            "More than half of the bubbles have no partner in another camera or no track: see "
            "the doubtful frames."
        )
    stated = [sentence(text) for text in results.file.warnings]
    return (*stated, *words)


def key_numbers(results: TrackResults) -> list[Tile]:
    """Return the most important numbers."""
    lengths, tracks = track_lengths(results), results.tracks
    matched = _matched(results) or (None, None)
    size = tracks["d_eq_mm"].to_numpy(float)
    miss = 1e3 * tracks["ray_miss_mm"].to_numpy(float)
    sd = ray_miss_sd_mm(results)
    of_noise = ""
    if sd is not None:
        of_noise = f"{number(_normal_median(sd), 2)} µm from the outlines' noise; "
    frames = frame_count(results)
    ambiguous = word_counts(tracks)[_AMBIGUOUS]
    each = len(tracks) / frames if frames else None
    return [
        Tile("Tracks", number(len(lengths)),
               f"median length {number(round(median(lengths.astype(float)) or 0))} points, longest "
               f"{number(int(lengths.max())) if len(lengths) else ABSENT}"),
        Tile("Bubbles in a frame", number(each, 3), f"in space, mean of {number(frames)} frames"),
        Tile("Matched", share(*matched),
               f"{number(matched[0])} of {number(matched[1])} bubbles in single images"),
        Tile("Measured position, 1 sd", f"{number(median(results.sd_um.max(axis=1)), 2)} µm",
               "along each point's worst axis, median over points; calibration's share left out"),
        Tile("Ray miss", f"{number(median(np.abs(miss)), 2)} µm",
               f"median; {of_noise}RMS {number(rms(miss), 2)} µm"),
        Tile("Diameter", f"{number(median(size), 3)} mm", "median, sphere of equal volume"),
        *([Tile("Ambiguous", share(ambiguous, len(tracks)),
                f"{number(ambiguous)} bubbles that another grouping explains almost as well")]
          if ambiguous else []),
    ]  # fmt: skip


def _normal_median(sd_mm: Array) -> float | None:
    """Median of |miss| in µm that this noise gives."""
    middle = median(sd_mm)
    return None if middle is None else 1e3 * NORMAL_MEDIAN * middle


def word_counts(table: pd.DataFrame) -> Counter[str]:
    """Return how often each of the words occurs in ``flags``; none where a table has no flags."""
    whole = Counter(table.get("flags", ()))
    counts: Counter[str] = Counter()
    for text, times in whole.items():
        for word in filter(None, text.split("|")):
            counts[word] += times
    return counts


def pair_rows(results: TrackResults) -> list[tuple[str, str]]:
    """Return rows on the agreement of the two views, as learned from the run."""
    pairs = results.file.pairs
    if pairs is None:
        return []
    stages = (
        "without the shift common to a frame", "after a constant", "after the whole bias",
        "for pairs left out of it",
    )  # fmt: skip
    offset, varies = _offset(pairs.bias_px)
    rows = [("offset perpendicular to both optical axes, px", number(offset) + varies)]
    rows += [("scatter of a pair, px", number(pairs.scatter_px))]
    rows += [("shift common to a frame, px", number(pairs.frame_px))]
    return rows + [(f"RMS {stage}, px", number(rms)) for stage, rms in zip(stages, pairs.rms_px)]


def _offset(bias_px: float | Sequence[float] | None) -> tuple[float | None, str]:
    """Return the constant of the systematic ray miss, and in words that it varies in space."""
    if bias_px is None or isinstance(bias_px, float | int):
        return bias_px, ""
    varies = " in the middle of the paths, different elsewhere" if len(bias_px) > 1 else ""
    return (bias_px[0] if len(bias_px) else None), varies


def flag_rows(results: TrackResults) -> list[Row]:
    """Flags of bubbles and reasons for frames without one: a row each, a column per camera."""
    found = results.outlines
    counts = {c: word_counts(found[found["camera"] == c]) for c in results.cameras}
    words = sorted({word for count in counts.values() for word in count})
    rows = [
        Row((f"flag: {word}", *(number(counts[c][word]) for c in results.cameras)))
        for word in words
    ]
    without = results.file.frames_without_bubbles
    reasons = sorted({reason for by in without.values() for reason in by})
    rows += [
        Row((f"frames without: {reason}",
             *(number(without.get(c, {}).get(reason, 0)) for c in results.cameras)))
        for reason in reasons
    ]  # fmt: skip
    seen = {c: found["camera"] == c for c in results.cameras}
    alone = {c: int(found["particle"][seen[c]].isna().sum()) for c in results.cameras}
    total = Row(("bubbles found", *(number(int(seen[c].sum())) for c in results.cameras)), True)
    lonely = Row(("of them in no track", *(number(alone[c]) for c in results.cameras)))
    return [total, lonely, *rows]


def event_rows(results: TrackResults) -> list[Row]:
    """Return the first events: frame, time, kind, bubbles, reason."""
    return [
        Row((str(e.frame), f"{e.t_s:.4f}", str(e.kind), str(e.particles).replace(" ", ", "),
             str(e.reason)))
        for e in results.events.head(MOST_EVENTS).itertuples()
    ]  # fmt: skip


def event_words(results: TrackResults) -> str:
    """Return the number of events of each kind, in words."""
    counts = results.file.events or results.events["kind"].value_counts().to_dict()
    kinds = [
        f"{kind}: {number(n)}" for kind, n in sorted(counts.items(), key=lambda item: -item[1])
    ]
    rest = len(results.events) - MOST_EVENTS
    text = ", ".join(kinds) + "." if kinds else ""
    if rest > 0:
        text += f" The first {MOST_EVENTS} are listed, {number(rest)} more are in events.csv."
    return text


def doubtful_rows(results: TrackResults, page_folder: Path) -> list[Row]:
    """Return a row for each frame that is doubtful for a reason, with links to its pictures."""
    return [
        Row((f"frame {frame.frame}, {camera}", frame.why), link=link_to(picture, page_folder))
        for frame in results.file.worst_frames
        for camera in results.cameras
        if frame.why and (picture := results.pictures.get((camera, f"{frame.frame:06d}")))
    ]


def marks_words(results: TrackResults, camera: str) -> str:
    """Return sentences on the marks that were followed in a camera's images."""
    table = results.references[results.references["camera"] == camera]
    in_a_frame, stays = (table.groupby(key).size().to_numpy() for key in ("frame", "mark"))
    words = (
        f"{number(len(stays))} marks, {np.median(in_a_frame):.0f} in a frame and each in "
        f"{np.median(stays):.0f} frames (medians)"
    )
    if "sigma_px" in table and table["sigma_px"].notna().any():
        words += f", measured to {number(median(table['sigma_px'].to_numpy(float)))} px"
    return (
        f"{words}. The lines are as parallel as the stage and the shake move all marks alike; one "
        "that goes its own way is not fixed to the tank."
    )
