"""A tracked run in a few lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def tracking_words(summary: Mapping[str, Any], seconds: float) -> str:
    """What `telerig track` prints."""
    tracks = "1 track" if summary["tracks"] == 1 else f"{summary['tracks']} tracks"
    lines = [
        f"Run {summary['run']!r}: {tracks}, {summary['points']} points in space "
        f"from {summary['detections']} detections in {summary['frames']} frames ({seconds:.1f} s)",
    ]
    left = summary["detections_without_partner_or_track"]
    if left:
        lines.append(f"  {left} detections have no partner in the other view, or no track")
    for camera, reasons in summary["frames_without_bubbles"].items():
        lines += [
            f"  camera {camera}: {count} frames without a bubble: {reason}"
            for reason, count in reasons.items()
        ]
    kinds = {k: n for k, n in summary["events"].items() if k not in ("birth", "death")}
    if kinds:
        lines.append("  " + ", ".join(f"{n} x {kind}" for kind, n in kinds.items()))
    lines += [f"  {word}" for word in summary["pairs"]["words"]]
    lines += [f"  {word}" for word in summary.get("references", {}).get("words", [])]
    lines += [f"  warning: {warning}" for warning in summary.get("warnings", [])]
    lines += [f"  note: {note}" for note in summary["notes"]]
    return "\n".join(lines)
