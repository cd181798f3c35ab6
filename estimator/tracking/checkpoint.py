"""The tracker's whole state as plain numbers and lists, exact, so that a run can be resumed."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.errors import InputError
from telerig.estimator.tracking.association.hypotheses import Branch, Cluster
from telerig.estimator.tracking.association.ledger import Ledger
from telerig.estimator.tracking.filter.stage_input import StageMotion
from telerig.estimator.tracking.filter.state import Common, Track, new_filter

if TYPE_CHECKING:
    from telerig.estimator.tracking.tracker import Tracker

_SCHEMA = 1
_PLAIN = (
    "particle",
    "d_eq_mm",
    "d_last_mm",
    "d_before_mm",
    "born_frame",
    "seen_frame",
    "seen_t_s",
    "misses",
)


def to_dict(tracker: Tracker) -> dict[str, Any]:
    return {
        "schema": _SCHEMA,
        "settings": asdict(tracker.settings),
        "axis": list(tracker.axis),
        "next_id": int(tracker.next_id),
        "last": tracker.last,
        "clusters": [[_branch(b) for b in c.branches] for c in tracker.clusters],
        "given": [_track(t) for t in tracker.given],
        "tentative": [_track(t) for t in tracker.tentative],
        "common": tracker.common.covariance.tolist(),
        "stage": tracker.stage.to_dict(),
        "ledger": tracker.ledger.to_dict(),
    }


def restore(tracker: Tracker, stored: dict[str, Any]) -> None:
    if stored.get("schema") != _SCHEMA:
        raise InputError(
            f"a tracker's state of schema {stored.get('schema')}", todo="track the run anew"
        )
    if stored["settings"] != asdict(tracker.settings) or stored["axis"] != list(tracker.axis):
        raise InputError(
            "the stored state was made with other settings or another travel axis",
            todo="resume with the same settings, or track the run anew",
        )
    tracker.next_id = stored["next_id"]
    tracker.last = None if stored["last"] is None else (stored["last"][0], stored["last"][1])
    tracker.clusters = [Cluster([_to_branch(b) for b in c]) for c in stored["clusters"]]
    tracker.given = [_to_track(t) for t in stored["given"]]
    tracker.tentative = [_to_track(t) for t in stored["tentative"]]
    covariance = np.array(stored["common"])
    tracker.common = Common(np.zeros(len(covariance)), covariance)
    tracker.stage = StageMotion(**stored["stage"])
    tracker.ledger = Ledger.from_dict(stored["ledger"])


def _track(track: Track) -> dict[str, Any]:
    return {
        **{name: getattr(track, name) for name in _PLAIN},
        "x": track.filter.x.tolist(),
        "P": track.filter.P.tolist(),
        "history": [list(e) for e in track.history],
        "parent": track.parent,
        "near": track.near,
    }


def _to_track(stored: dict[str, Any]) -> Track:
    out = Track(new_filter(np.array(stored["x"]), np.array(stored["P"])))
    for name in _PLAIN:
        setattr(out, name, stored[name])
    out.history = [(e[0], e[1]) for e in stored["history"]]
    out.parent = None if stored["parent"] is None else (stored["parent"][0], stored["parent"][1])
    out.near = None if stored["near"] is None else (stored["near"][0], stored["near"][1])
    return out


def _branch(branch: Branch) -> dict[str, Any]:
    history = [[p, [list(e) for e in h]] for p, h in branch.history.items()]
    tracks = [_track(t) for t in branch.tracks]
    return {"weight": branch.weight, "tracks": tracks, "history": history}


def _to_branch(stored: dict[str, Any]) -> Branch:
    history = {p: [(e[0], e[1]) for e in h] for p, h in stored["history"]}
    return Branch(stored["weight"], [_to_track(t) for t in stored["tracks"]], history)
