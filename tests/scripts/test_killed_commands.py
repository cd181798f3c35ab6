"""Commands that are killed while they replace results: every reader gets one whole result."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from batch_dataset import make_dataset
from killed_writers import killed_at_every_rename

from telerig.command_options import SmoothingOptions
from telerig.errors import InputError
from telerig.estimator.batch.batch import write_batch
from telerig.estimator.calibration.calibrate import CalibrationRun, run_calibration
from telerig.estimator.calibration.result.calibration import load_calibration
from telerig.estimator.calibration.results_folder import write_results
from telerig.estimator.smoothing.results_folder import smooth_run
from telerig.estimator.tracking.results_folder import write_tracking
from telerig.estimator.tracking.track import TrackOptions
from telerig.estimator.tracking.tracks import load_tracks
from telerig.io.dataset.dataset import Dataset, load_dataset
from telerig.io.exchange.formats import export_results
from telerig.io.report.batch.report import write_batch_report
from telerig.io.report.remake import remake_report, results_folders
from telerig.io.results.folders.calibration import read_calibration_results
from telerig.io.results.folders.smoothing import read_smoothing_results
from telerig.io.results.folders.tracking import read_track_results

pytestmark = pytest.mark.usefixtures("without_advice", "known_low_passes")

Reader = Callable[[Path], Any]


def content(value: Any) -> Any:
    """Everything that was read but the time, in a form that can be compared."""
    if isinstance(value, pd.DataFrame):
        return value.to_csv()
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if is_dataclass(value):
        named = {f.name: getattr(value, f.name) for f in fields(value)}
        read = named | getattr(value, "__dict__", {})
        return {name: content(each) for name, each in read.items()}
    if isinstance(value, Mapping):
        timed = ("finished", "seconds")
        return {str(key): content(each) for key, each in value.items() if key not in timed}
    if isinstance(value, list | tuple):
        return [content(each) for each in value]
    return value.name if isinstance(value, Path) else repr(value)


def exported(to: str) -> Reader:
    def read(folder: Path) -> Any:
        out = folder.parent / "exported"
        export_results(folder, to, out=out)
        return out.read_bytes()

    return read


def page(folder: Path) -> Any:
    (found,) = results_folders(folder)
    text = remake_report(found, folder.parent / "page").read_text()
    ids_differ = re.sub(r'src="data:[^"]*"', "", text)  # in drawings, each time
    return re.sub(r"<tr>.*(finished|seconds).*</tr>", "", ids_differ)


READERS: dict[str, dict[str, Reader]] = {
    "calibrate": {
        "load_calibration": load_calibration, "report": read_calibration_results,
        "export": exported("opencv"),
    },
    "track": {"load_tracks": load_tracks, "report": read_track_results},
    "smooth": {
        "report": lambda folder: read_smoothing_results(folder, np.array([0.0, -1.0, 0.0])),
        "export": exported("trackpy"),
    },
    "batch": {"report": lambda folder: write_batch_report(folder, folder.parent).read_text()},
}  # fmt: skip


@dataclass
class Commands:
    """Two different results of each command, and the folder of the dataset."""

    dataset: Dataset
    calibrations: tuple[CalibrationRun, CalibrationRun]

    def folder(self, command: str) -> Path:
        name = {"calibrate": "calibration", "batch": "batch"}.get(command, "rise")
        return self.dataset.results / name

    def write(self, command: str, which: int, *, report: bool = False) -> None:
        """Write one of the two results. Smoothing needs the tracks, they need a calibration."""
        found = self.calibrations[which].calibration
        run, folder = self.dataset.runs["rise"].load(), self.folder(command)
        if command == "calibrate":
            options = {"model": which}
            write_results(
                self.dataset, self.calibrations[which], folder, command="calibrate",
                options=options, seconds={}, **({} if report else {"report": None}),
            )  # fmt: skip
        elif command == "track":
            write_tracking(
                run, found, folder, options=TrackOptions(), report=report,
                record={"options": {"from": which}},
            )  # fmt: skip
        elif command == "smooth":
            used = replace(run, accelerometers=None) if which else run
            smooth_run(
                used, found, folder, folder, SmoothingOptions(model="default"), report=report
            )
        else:
            job = {"dataset": f"d{which}", "run": "", "kind": "calibrate", "status": "done"}
            write_batch([{**job, "words": "", "figures": {}}], folder, report=report)


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    place = make_dataset(tmp_path_factory.mktemp("killed") / "data", 7)
    data = load_dataset(place)
    return Commands(data, (run_calibration(data, model="none"), run_calibration(data, model="k1")))


def outcomes(
    commands: Commands, command: str, readers: Mapping[str, Reader], *, report: bool = False
) -> dict[str, list[str]]:
    """What each reader got at every step: old, new, refused or a mixture."""
    folder = commands.folder(command)

    def old() -> None:
        if command == "smooth":
            commands.write("track", 0)
        commands.write(command, 0, report=report)

    found: dict[str, list[Any]] = {name: [] for name in readers}
    for _ in killed_at_every_rename(folder, old, lambda: commands.write(command, 1, report=report)):
        for name, read in readers.items():
            try:
                found[name].append(content(read(folder)))
            except InputError as error:
                assert "two different results" in str(error), error
                assert f"run `telerig {command}" in str(error), error
                found[name].append("refused")
    assert all(each[0] != each[-1] for each in found.values()), "the two results differ"
    return {name: [_words(each, got) for got in each] for name, each in found.items()}


def _words(found: list[Any], got: Any) -> str:
    if got == "refused":
        return "refused"
    return "old" if got == found[0] else "new" if got == found[-1] else "a mixture"


@pytest.mark.parametrize(
    "command", ["calibrate", "track", pytest.param("smooth", marks=pytest.mark.slow), "batch"]
)
def test_readers_never_get_a_mixture(commands: Commands, command: str) -> None:
    for name, seen in outcomes(commands, command, READERS[command]).items():
        order = [what for i, what in enumerate(seen) if i == 0 or seen[i - 1] != what]
        assert order == ["old", "refused", "new"], (name, seen)


@pytest.mark.slow
def test_a_new_tracking_leaves_no_old_trajectories_for_export(commands: Commands) -> None:
    """The tracks are old, new or a mixture; the trajectories are exported only with the old."""
    folder = commands.folder("track")
    shutil.rmtree(folder, ignore_errors=True)
    commands.write("calibrate", 0)

    def old() -> None:
        commands.write("track", 0)
        commands.write("smooth", 0)

    got = []
    for _ in killed_at_every_rename(folder, old, lambda: commands.write("track", 1)):
        try:
            export_results(folder, "trackpy", out=folder.parent / "out.csv")
        except InputError as error:
            got.append("stale" if "are stale" in str(error) else "refused")
        else:
            got.append("exported")
    assert got[:2] == ["exported", "exported"]
    assert got[-2:] == ["stale", "stale"]


@pytest.mark.slow
@pytest.mark.parametrize("command", list(READERS))
def test_pages_never_show_a_mixture(commands: Commands, command: str) -> None:
    seen = outcomes(commands, command, {"page": page}, report=True)["page"]
    assert set(seen) == {"old", "new", "refused"}


_KILLED = """
import os, sys
from pathlib import Path
folder, step = Path(sys.argv.pop(1)), int(sys.argv.pop(1))
real, count = os.replace, 0
def killed(source, target):
    global count
    if Path(target).resolve().is_relative_to(folder):
        if count == step:
            os._exit(9)
        count += 1
    real(source, target)
os.replace = killed
from telerig.scripts.main import app
app(sys.argv[1:])
"""


@pytest.mark.slow
def test_processes_that_are_killed(tmp_path: Path) -> None:
    """The same with real processes: what is left behind is removed by the next command."""
    data = make_dataset(tmp_path / "da ta", 7)
    run = data / "runs" / "rise"

    def telerig(folder: Path, step: int, *words: str) -> subprocess.CompletedProcess[str]:
        program = [sys.executable, "-c", _KILLED, str(folder.resolve()), str(step), *words]
        return subprocess.run(program, capture_output=True, text=True, check=False)

    calibration, results = data / "results" / "calibration", data / "results" / "rise"
    done = (
        (calibration, ("calibrate", str(data), "--no-report")),
        (results, ("track", str(run), "--no-report")),
        (results, ("smooth", str(run), "--no-report")),
    )
    for folder, words in done:
        step = 0
        while (ended := telerig(folder, step, *words)).returncode == 9:
            step += 1
            left = [p for p in data.rglob(".*.part*") if p.parent != folder]
            if not left:  # the results are whole; only the rows before corrections move in last
                assert (folder.parent / f".{folder.name}.work").is_dir() and words[0] == "track"
            assert len(left) <= 1, "the files that were not renamed"
            read = telerig(Path("/nowhere"), 0, "export", str(data), "--to", "trackpy")
            assert read.returncode in (0, 2), read.stderr
        assert ended.returncode == 0, ended.stderr
        assert step > 4
        assert list(data.rglob(".*.part*")) == []
