"""Results whose inputs have changed: pages say so, exports refuse them, smoothing warns."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import pytest
from typer.testing import CliRunner

from telerig.estimator.doctor.checks import check_dataset
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("without_advice", "known_low_passes", "undrawn")


def telerig(*words: object) -> tuple[int, str]:
    """Exit code and everything that the command says."""
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


def again(command: str, data: Path) -> tuple[int, str]:
    quick = ("--model", "default") if command == "smooth" else ()
    return telerig(command, data / "runs" / "rise", "--quiet", "--no-report", *quick)


@pytest.fixture(scope="module")
def calibrated_again(tank: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset that was smoothed, and then calibrated with another lens model."""
    data = Path(shutil.copytree(tank, tmp_path_factory.mktemp("stale") / "my data"))
    assert telerig("export", data, "--to", "hdf5")[0] == 0, "nothing is stale yet"
    assert telerig("calibrate", data, "--model", "none", "--quiet", "--no-report")[0] == 0
    return data


@pytest.fixture
def data(calibrated_again: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(calibrated_again, tmp_path / "my data"))


def test_export_refuses_stale_trajectories(data: Path) -> None:
    code, said = telerig("export", data, "--to", "hdf5")
    assert code == 2
    assert "calibration/calibration.json has changed since they were made" in said
    assert "--accept stale" in said
    assert "telerig track" in said.partition("telerig smooth")[0], "in the order of the commands"
    code, said = telerig("export", data, "--to", "hdf5", "--accept", "stale")
    assert code == 0, said
    with h5py.File(data / "results" / "export" / "rise.h5") as file:
        assert "calibration.json has changed" in file.attrs["accepted"]
    assert telerig("export", data, "--to", "opencv")[0] == 0, "the calibration itself is fresh"


def test_doctor_names_stale_results(data: Path) -> None:
    """A comment in rig.toml makes nothing stale."""
    found = {c.what: c for c in check_dataset(data) if c.what.startswith("results ")}
    assert found["results calibration"].status == "ok"
    assert found["results rise"].status == "warning"
    assert "calibration/calibration.json has changed" in found["results rise"].words
    rig = data / "rig.toml"
    rig.write_text(rig.read_text() + "\n# a remark\n")
    assert "results calibration" in {c.what for c in check_dataset(data) if c.status == "ok"}


def test_cameras_of_a_stale_calibration_say_so(data: Path) -> None:
    rig = data / "rig.toml"
    flat = "flatness_sigma_mm = 0.3\nprint_sigma_mm"
    rig.write_text(rig.read_text().replace("print_sigma_mm", flat))
    for to, file in (
        ("halcon", "halcon/cameras.hdev.txt"),
        ("opencv", "opencv.yml"),
    ):
        assert telerig("export", data, "--to", to)[0] == 2
        assert telerig("export", data, "--to", to, "--accept", "stale")[0] == 0
        assert "rig.toml has changed" in (data / "results" / "export" / file).read_text()


@pytest.mark.slow
def test_the_page_begins_with_it_and_smoothing_warns(data: Path) -> None:
    folder = data / "results" / "rise"
    code, said = telerig("report", folder)
    assert code == 0
    assert "are stale" in said
    page = (folder / "report.html").read_text()
    banner = page[page.index('id="stale"') : page.index("</section>")]
    assert "calibration/calibration.json has changed" in banner
    code, said = again("smooth", data)
    assert code == 0
    assert "warning: The results of `telerig track" in " ".join(said.split())
    code, said = telerig("export", data, "--to", "trackpy")
    assert code == 2, "what follows from stale tracks is stale"
    assert "tracks.csv is stale itself" in said
    for command in ("track", "smooth"):
        code, said = again(command, data)
        assert code == 0
        assert "stale" not in said
    assert telerig("export", data, "--to", "trackpy")[0] == 0
