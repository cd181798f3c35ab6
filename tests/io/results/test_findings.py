"""The list of findings is the only statement on a calibration: verdict, words, files, pages."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from calibration_folder import write_calibration_folder
from finding_codes import codes
from report_page import Page, edit

import telerig
from telerig.command_options import CalibrationOptions
from telerig.errors import InputError
from telerig.estimator.batch.batch import do_job, write_batch
from telerig.estimator.batch.jobs import Job
from telerig.io.results.calibration import CalibrationFile
from telerig.io.results.findings import Code, Finding, Status, objections, verdict_of
from telerig.short_text import sentence

pytestmark = pytest.mark.usefixtures("without_advice", "undrawn")

DOCS = Path(__file__).parents[3] / "docs"
MISSING_MANIFEST = "ignore:.*there is no manifest.json"


def one(code: Code) -> Finding:
    """A finding of that kind, at some place with some numbers."""
    names = set(re.findall(r"\{(\w+)", code.value.says))
    numbers = dict.fromkeys(names - {"cameras", "views", "names", "parameters", "text"}, 2.0)
    return code.found(numbers, cameras="left", views=("v1", "v2"), names="left.k1", text="why")


@pytest.mark.parametrize("code", Code, ids=lambda code: code.name)
def test_every_code_can_be_said_and_decides_the_verdict(code: Code) -> None:
    found = one(code)
    assert "{" not in found.words and found.words.endswith(code.value.todo)
    verdict = verdict_of([one(Code.NO_STRUCTURE), found])
    assert verdict.status == code.value.status
    assert verdict.reasons == ((found.words,) if code.value.status != Status.GOOD else ())
    read = Finding.model_validate(json.loads(json.dumps(found.content())))
    assert read == found


def test_the_gravest_objection_decides_and_comes_first() -> None:
    found = [one(c) for c in (Code.MIRRORED, Code.FEW_VIEWS, Code.FEW_KEPT, Code.CHI_SQUARE)]
    against = [finding.code for finding in objections(found)]
    assert against == [Code.FEW_KEPT, Code.FEW_VIEWS, Code.CHI_SQUARE]
    assert verdict_of(found).status == Status.REJECTED
    assert verdict_of([]).status == Status.GOOD


def test_the_table_of_the_documentation_is_that_of_the_code() -> None:
    text = (DOCS / "findings.md").read_text(encoding="utf-8")
    rows = {}
    for code in Code:
        kind = code.value
        limit = "" if kind.limit is None else f"{kind.limit:g} {kind.because}"
        says = re.sub(r"\{[^}]*\}", "…", kind.says).replace("<camera>", "CAMERA")
        todo = kind.todo.replace("<camera>", "CAMERA")
        status = "note" if kind.status == Status.GOOD else kind.status
        rows[code.name] = f"| `{code.name}` | {status} | {says} | {limit} | {todo} |"
    wanted = "\n".join(rows.values())
    found = [line for line in text.splitlines() if line.startswith("| `")]
    assert found == list(rows.values()), f"write into docs/findings.md:\n{wanted}"


def as_it_is(dots: pd.DataFrame) -> pd.DataFrame:
    return dots


def five_views(dots: pd.DataFrame) -> pd.DataFrame:
    return dots[dots["view"] < "view05"]


def wrong_way_round(dots: pd.DataFrame) -> pd.DataFrame:
    """View 5 is numbered from the other corner."""
    turned = dots["view"] == "view05"
    corner = {"dot": 14, "row": 2, "column": 4}
    return dots.assign(**{n: dots[n].where(~turned, last - dots[n]) for n, last in corner.items()})


def spoiled(dots: pd.DataFrame) -> pd.DataFrame:
    """One dot of seven was mistaken for something 30 px nearer to the middle."""
    wrong = np.arange(len(dots)) % 7 == 0
    nearer = dots["u_px"] + 30 * np.sign(256 - dots["u_px"])
    return dots.assign(u_px=dots["u_px"].where(~wrong, nearer))


CASES: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], float, str, list[str]]] = {
    "good": (as_it_is, 90.0, "radial", []),
    "weak": (five_views, 90.0, "radial", ["FEW_VIEWS"]),
    "far from rig.toml": (as_it_is, 28.0, "radial", ["ROTATION_FAR"]),
    "a wrong view": (wrong_way_round, 90.0, "radial", ["ODD_VIEW"]),
    "a poor lens model": (as_it_is, 90.0, "none", ["PATTERN"]),
    "outliers": (spoiled, 90.0, "radial", ["FEW_KEPT"]),
}
"""What happens to the dots, the nominal angle between the cameras, the lens model, codes."""


@pytest.mark.parametrize("case", CASES)
def test_terminal_file_page_and_batch_say_the_same(case: str, tmp_path: Path) -> None:
    change, angle_deg, model, expected = CASES[case]
    data = tmp_path / "tank"
    telerig.simulate("paper", rng=np.random.default_rng(1), out=data, images=False)
    file, rig = data / "calibration" / "dots.csv", data / "rig.toml"
    change(pd.read_csv(file)).to_csv(file, index=False)
    text = rig.read_text(encoding="utf-8")
    stated = f"right_from_left_rotvec_deg = [0.0, {angle_deg}, 0.0]"
    rig.write_text(re.sub(r"right_from_left_rotvec_deg = .*", stated, text), encoding="utf-8")
    job = Job("calibrate", str(data), CalibrationOptions(model))
    record = {"kind": job.kind, "dataset": job.dataset, "run": "", **do_job(job)}
    write_batch([record], tmp_path / "out")

    folder = data / "results" / "calibration"
    stored = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    loaded = telerig.load_calibration(folder)
    against = [f.code.name for f in objections(loaded.findings or ())]
    status, reasons = stored["verdict"]["status"], stored["verdict"].get("reasons", [])
    assert set(expected) <= set(against) and bool(expected) == bool(against), against
    assert [found["code"] for found in stored["findings"]] == codes(loaded)
    assert (status == "GOOD") == (against == []) == (reasons == [])

    lines = loaded.report().splitlines()
    assert lines[0].endswith(f": {status}")
    assert [x.removeprefix("  ! ") for x in lines if x.startswith("  !")] == reasons
    assert [x.removeprefix("  note: ") for x in lines if x.startswith("  note:")] == stored["notes"]

    page = Page(folder / "report.html")
    head, rest = page.spaced.split("RMS;", 1)
    assert f" {status}: " in head and all(sentence(reason) in head for reason in reasons)
    assert ("No check objected" in page.spaced) == (status == "GOOD")
    assert not any(r in rest or sentence(r) in rest for r in reasons)
    for note in stored["notes"]:
        assert note[:1].upper() + note[1:] in rest or note in rest

    assert record["figures"]["flags"] == list(dict.fromkeys(against))
    batch = Page(tmp_path / "out" / "report.html").spaced
    assert " ".join([f"tank {status}", *record["figures"]["flags"]]) in batch
    assert f"1 {status}" in batch or status == "REJECTED"
    assert all(reason in batch for reason in reasons) or status != "REJECTED"


def test_good_with_an_objection_is_not_read(tmp_path: Path) -> None:
    folder = write_calibration_folder(tmp_path / "r", cameras=2)
    found = [one(Code.FEW_VIEWS).content()]
    edit("calibration.json", folder, findings=found, verdict={"status": "GOOD"})
    with pytest.raises(InputError, match=r"status is GOOD, .* \(FEW_VIEWS\)"):
        CalibrationFile.read(folder / "calibration.json")
    edit("calibration.json", folder, findings=[], verdict={"status": "REJECTED"})
    with pytest.raises(InputError, match="there is no objection"):
        CalibrationFile.read(folder / "calibration.json")
    edit("calibration.json", folder, findings=found, verdict={"status": Status.USABLE})
    file = CalibrationFile.read(folder / "calibration.json")
    assert file.verdict == verdict_of([one(Code.FEW_VIEWS)]) and file.notes == ()


@pytest.mark.parametrize(
    ("finding", "words"),
    [
        ({"code": "SOUP"}, "'SOUP' is no code of this version"),
        ({"code": "FEW_VIEWS"}, "FEW_VIEWS lacks count"),
        ({"code": "FEW_VIEWS", "numbers": {"count": "many"}}, "count"),
    ],
)
def test_findings_that_cannot_be_said_are_refused(
    finding: object, words: str, tmp_path: Path
) -> None:
    folder = write_calibration_folder(tmp_path / "r", cameras=2)
    edit("calibration.json", folder, findings=[finding])
    with pytest.raises(InputError, match=words):
        CalibrationFile.read(folder / "calibration.json")
