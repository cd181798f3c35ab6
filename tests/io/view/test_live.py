"""What the work tells a viewer while it goes on, and a viewer that is slow, dead or missing."""

from __future__ import annotations

import io
import pickle
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fault_recordings import ARM, ENCODER, Account, recorded_with_faults
from viewed import entities, needs_rerun

from telerig import live
from telerig.command_options import SmoothingOptions
from telerig.errors import TelerigWarning
from telerig.estimator.batch.work import smooth_run
from telerig.io.recording.simulated.devices import Faults, SimulatedDevice
from telerig.live import MOST_WAITING, Feed, publish, viewed

BLOCKED = (sys.executable, "-c", "import time; time.sleep(1000)")
DEAD = (sys.executable, "-c", "raise SystemExit('no window')")
SLOW = """
import pickle, sys, time
time.sleep(1)
said = []
while not said or said[-1][0] != "end":
    said.append(pickle.load(sys.stdin.buffer))
open(sys.argv[1], "w").write(" ".join(str(c.get("number", k)) for k, c in said))
"""
DEVICES = [
    SimulatedDevice(ENCODER, 1000.0, 30.0, faults=Faults(garbage_hz=5.0)),
    SimulatedDevice(ARM, 2000.0, -40.0),
]


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(live, "find_spec", lambda _: True)
    monkeypatch.setattr(live, "_VIEWER", BLOCKED)
    monkeypatch.setattr(live, "_END_S", 0.2)
    return monkeypatch


def test_a_slow_viewer_gets_the_first_and_the_newest_messages(tmp_path: Path) -> None:
    feed = Feed((sys.executable, "-c", SLOW, str(tmp_path / "said")))
    some, begun = np.zeros(100_000, np.uint8), time.process_time()
    for number in range(200):
        feed.put("image", {"number": number, "pixels": some})
    assert time.process_time() - begun < 1.0 and len(feed._waiting) == MOST_WAITING
    feed.close()
    *got, end = (tmp_path / "said").read_text().split()
    numbers = [int(text) for text in got]
    assert end == "end" and numbers == sorted(numbers) and numbers[0] == 0
    assert numbers[-MOST_WAITING + 1 :] == list(range(200 - MOST_WAITING + 1, 200))
    assert len(numbers) < 200


def test_a_viewer_that_blocks_for_ever_costs_no_reading(
    tmp_path: Path, viewer: pytest.MonkeyPatch
) -> None:
    with viewed(True, "one"):
        for account in recorded_with_faults(DEVICES, tmp_path, np.random.default_rng(0), 2.5):
            check(account)


def check(one: Account) -> None:
    assert one.wrong == 0 and abs(one.not_accounted) <= 0.02 * one.busy, one


def test_a_viewer_that_ends_early_is_said_at_the_end(viewer: pytest.MonkeyPatch) -> None:
    viewer.setattr(live, "_VIEWER", DEAD)
    viewer.setattr(live, "_END_S", 10.0)
    with pytest.warns(TelerigWarning, match="no window"), viewed(True, "one"):
        for _ in range(20):
            publish("image", pixels=np.zeros(100_000))
            time.sleep(0.02)
    publish("image", pixels=1)
    assert not live.due("image")


def test_without_rerun_the_work_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "find_spec", lambda _: None)
    with pytest.warns(TelerigWarning, match=r"telerig\[view\]"), viewed(True, "one") as address:
        assert address == "" and not live.due("image")


class Kept:
    """A feed that keeps its messages."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.said = folder, io.BytesIO()

    def due(self, kind: str) -> bool:
        return True

    def put(self, kind: str, content: dict[str, Any]) -> None:
        self.said.write(pickle.dumps((kind, content)))


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Kept:
    feed = Kept(tmp_path)
    monkeypatch.setattr(live, "_feeds", [feed])
    return feed


def shown(kept: Kept, file: Path) -> dict[str, int]:
    """Entities of the recording that a viewer makes of the messages."""
    import rerun as rr

    from telerig.io.view.live import show

    kept.said.seek(0)
    stream = rr.RecordingStream("test")
    stream.save(str(file))
    show(stream, kept.said)
    stream.flush()
    stream.disconnect()
    return entities(file)


@needs_rerun
def test_a_recording_has_curves_clocks_and_spectra_while_it_is_made(
    tmp_path: Path, kept: Kept
) -> None:
    recorded_with_faults(DEVICES, tmp_path, np.random.default_rng(0), 2.5)
    found = shown(kept, tmp_path / "live.rrd")
    for entity in (
        "/plots/encoder_mm/encoder", "/plots/clock_ms/arm_left", "/plots/rate_hz/encoder",
        "/spectra/encoder", "/spectra/arm_left/y",
    ):  # fmt: skip
        assert entity in found
    assert (
        len([name for name in found if name.startswith("/plots/accelerometers_m_s2/arm_left_")])
        == 3
    )


@needs_rerun
@pytest.mark.slow
def test_results_beside_other_tracks_are_shown_with_them(
    tank: Path, tmp_path: Path, kept: Kept
) -> None:
    run, out = tank / "runs/rise", tmp_path / "elsewhere"
    smooth_run(
        run, out, SmoothingOptions(model="default"), tracks=tank / "results/rise", again="",
        report=False,
    )  # fmt: skip
    assert not (out / "tracking.json").exists()
    found = shown(kept, tmp_path / "live.rrd")
    assert {"/space/paths/smoothed", "/space/paths/triangulated"} <= set(found)
