"""The report of a batch, from a batch.json written by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pandas as pd
import pytest
from report_page import Page

from telerig.errors import InputError
from telerig.io.files.csv_table import write_table
from telerig.io.report.batch.report import write_batch_report
from telerig.io.results.batch import short_names
from telerig.io.tables.smoothing import BATCH_BUBBLES


def _job(kind: str, run: str, status: str = "done", words: str = "", **figures: Any) -> Any:
    job = {"kind": kind, "dataset": "/data/tank", "run": run, "status": status, "words": words}
    return job | {"figures": figures, "seconds": 30.0, "host": "a"}


def _write(folder: Path, jobs: Any) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "batch.json").write_text(json.dumps({"jobs": jobs}))
    return folder


def test_the_page_says_what_was_done_and_what_failed(tmp_path: Path) -> None:
    evil = "</script><b>no light"
    flags = ["SHAKE_BELOW_NOISE"]
    jobs = [
        _job("calibrate", "", verdict="GOOD", lens_model="radial", views=12, share_kept=0.995,
             rms_px=0.0123),
        _job("track", "rise", frames=120, tracks=7, points=800),
        _job("smooth", "rise", verdict="RESOLVED", flags=flags, sx_um=23.0, sy_um=13.0, sz_um=24.0),
        _job("track", "fall", "failed", evil),
        _job("smooth", "fall", "left out", "needs fall.track"),
    ]  # fmt: skip
    file = write_batch_report(_write(tmp_path / "out", jobs))
    page = Page(file)
    assert page.ids == ["verdict", "key", "failures", "calibrations", "runs"]
    assert all(load.startswith(("data:", "#")) for load in page.loads)
    for words in (
        "1 of 2 runs done, 1 dataset", "calibrated 1 of 1 1 GOOD",
        "smoothed 1 of 2 1 left out, 1 RESOLVED", "work 2.5 min longest job 30 s, 1 machine",
        "tank GOOD radial 12 99.5% 0.0123", "sd / µm",
        "tank / rise RESOLVED SHAKE_BELOW_NOISE 120 7 800 23.0, 13.0, 24.0",
        "tank / fall track failed",
        f"/data/tank, run fall track failed {evil}",
    ):  # fmt: skip
        assert words in page.spaced, words
    assert evil not in file.read_text(encoding="utf-8")
    assert 'class="verdict usable"' in file.read_text(encoding="utf-8")


def test_bubbles_of_all_runs_are_drawn_by_run(tmp_path: Path) -> None:
    jobs = [_job("smooth", "rise", verdict="RESOLVED"), _job("smooth", "fall", verdict="RESOLVED")]
    jobs[1]["dataset"] = "/other/tank"
    folder = _write(tmp_path / "out", jobs)
    rows = pd.DataFrame(index=range(6), columns=BATCH_BUBBLES.names(), dtype=float)
    d = np.linspace(1.5, 4.0, 6)
    rows = rows.assign(
        dataset=["/data/tank"] * 3 + ["/other/tank"] * 3, run=["rise"] * 3 + ["fall"] * 3,
        particle=[0, 1, 2] * 2, first_frame=0, last_frame=9, frames=10, d_eq_mm=d, sd_eq_mm=0.02,
        slip_mm_s=240.0, s_slip_mm_s=2.0, reynolds=240 * d, s_reynolds=5.0, drag=0.6, s_drag=0.05,
    )  # fmt: skip
    write_table(rows, folder / "bubbles.csv")
    text = write_batch_report(folder).read_text(encoding="utf-8")
    section = text[text.index('id="bubbles"') : text.index('id="calibrations"')
                   if 'id="calibrations"' in text else text.index('id="runs"')]  # fmt: skip
    assert section.count("<svg") == 2, "aspect ratios are not known"
    assert section.count('type="checkbox"') == 2
    assert "data/tank / rise" in section and "other/tank / fall" in section
    for name in ("slip_mm_s", "drag"):
        assert all(f'id="{name}.{k}.' in section for k in (0, 1))
    assert "6 bubbles of 2 runs" in section


def test_figures_of_thousands_of_bubbles_are_images(tmp_path: Path) -> None:
    folder = _write(tmp_path / "out", [_job("smooth", "rise", verdict="RESOLVED")])
    rows = pd.DataFrame(index=range(4100), columns=BATCH_BUBBLES.names(), dtype=float)
    rows = rows.assign(
        dataset="/data/tank", run="rise", particle=np.arange(4100), first_frame=0, last_frame=9,
        frames=10, d_eq_mm=np.linspace(1.5, 4.0, 4100), sd_eq_mm=0.02, slip_mm_s=240.0,
        s_slip_mm_s=2.0,
    )  # fmt: skip
    write_table(rows, folder / "bubbles.csv")
    text = write_batch_report(folder).read_text(encoding="utf-8")
    assert "data:image/png" in text and "4100 bubbles of 1 run" in text


def test_the_headline_names_what_failed_and_short_names_tell_datasets_apart(tmp_path: Path) -> None:
    places = ["/a/x/tank", "/b/x/tank", "/b/pool"]
    assert short_names(places) == dict(zip(places, ("a/x/tank", "b/x/tank", "pool")))
    jobs = [_job("track", f"run{k}", "failed", "no light") for k in range(6)]
    jobs += [_job("smooth", f"run{k}", "left out", "needs") for k in range(6)]
    page = Page(write_batch_report(_write(tmp_path / "out", jobs)))
    assert "Failed: track tank / run0; track tank / run1" in page.spaced
    assert "and 2 more" in page.spaced and "Failed: smooth" not in page.spaced


@pytest.mark.parametrize(
    ("verdicts", "colour", "words"),
    [
        (["RESOLVED"], "good", "Verdicts of 1 smoothed run: 1 RESOLVED."),
        (["RESOLVED", *["UNRESOLVED"] * 4], "usable",
         "Verdicts of 5 smoothed runs: 1 RESOLVED, 4 UNRESOLVED."),
        (["", "PARTIAL"], "usable", "may still contain shake"),
    ],
)  # fmt: skip
def test_a_page_without_failures_says_the_verdicts(
    tmp_path: Path, verdicts: list[str], colour: str, words: str
) -> None:
    jobs = [_job("smooth", f"run{i}", verdict=v) for i, v in enumerate(verdicts)]
    file = write_batch_report(_write(tmp_path / "out", jobs))
    page = Page(file)
    assert words in page.spaced and "No job failed." in page.spaced
    assert "nothing failed" not in page.spaced.lower()
    assert f'class="verdict {colour}"' in file.read_text(encoding="utf-8")
    assert ("may still contain shake" in page.spaced) == (colour == "usable")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no batch here"),
        ("{", "Expecting"),
        ("[]", "not an object"),
        ('{"jobs": 3}', "has a fault at 'jobs'"),
        ('{"jobs": [3]}', "has a fault at 'jobs.0'"),
        ('{"jobs": [{"dataset": "a"}]}', "has a fault at 'jobs.0.kind': Field required"),
        (
            json.dumps({"jobs": [_job("track", "a") | {"dataset": 3}]}),
            "has a fault at 'jobs.0.dataset'",
        ),
        (
            json.dumps({"jobs": [_job("track", "a") | {"figures": [3]}]}),
            "has a fault at 'jobs.0.figures'",
        ),
    ],
)
def test_a_batch_that_cannot_be_read_is_named(
    tmp_path: Path, content: str | None, words: str
) -> None:
    if content is not None:
        (tmp_path / "batch.json").write_text(content)
    before = list(tmp_path.iterdir())
    with pytest.raises(InputError, match=words) as caught:
        write_batch_report(tmp_path)
    assert "batch.json" in str(caught.value) and "->" in str(caught.value)
    assert list(tmp_path.iterdir()) == before


@pytest.mark.parametrize("staged", ["out", "out/.results.part"])
def test_links_reach_datasets_of_any_name(tmp_path: Path, staged: str) -> None:
    """Links are those from where the page will lie."""
    page = tmp_path / "tank #2, 50%" / "results" / "rise" / "report.html"
    page.parent.mkdir(parents=True)
    page.write_text("")
    job = _job("track", "rise") | {"dataset": str(page.parents[2])}
    place = tmp_path / staged
    place.mkdir(parents=True)
    written = write_batch_report(_write(place, [job]), page_folder=tmp_path / "out")
    found = Page(written).loads
    links = [unquote(urlsplit(load).path) for load in found if not load.startswith(("data:", "#"))]
    assert links == ["../tank #2, 50%/results/rise/report.html"]
