"""Exported trajectories, read back by the programs they are meant for."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat, netcdf_file

from telerig.errors import InputError
from telerig.io.exchange.export.netcdf import write_netcdf
from telerig.io.exchange.export.run_results import (
    LAB,
    RIG,
    RunResults,
    identifier,
    read_results,
    run_folder,
    unit_of,
)
from telerig.io.exchange.export.tables import write_hdf5, write_mat, write_trackpy
from telerig.io.exchange.formats import export_results
from telerig.io.files.csv_table import write_table
from telerig.io.results.cameras import CameraRecord
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

CAMERAS = (
    Camera.create("left", (512, 500), 10.0, k1=0.01),
    Camera.create("right", (512, 512), 9.0, camera_from_rig=Pose.from_rotvec([0, 1.5, 0])),
)
FIRST_FRAMES, LENGTHS = {7: 0, 3: 2, 12: 1}, {7: 30, 3: 25, 12: 1}


def table(seed: int = 0) -> pd.DataFrame:
    """Three bubbles in Brownian motion, rows in the order of time as telerig writes them."""
    rng = np.random.default_rng(seed)
    parts = []
    for particle, length in LENGTHS.items():
        frame = FIRST_FRAMES[particle] + np.arange(length)
        places = np.cumsum(rng.normal(0, 0.1, (length, 3)), axis=0)
        one = pd.DataFrame({"frame": frame, "particle": particle, "t_s": 0.01 * frame})
        one[["x_mm", "y_mm", "z_mm"]] = places
        one["vx_mm_s"] = rng.normal(size=length)
        one["observed"] = 1
        one["d_eq_mm"] = np.where(np.arange(length) % 5 == 4, np.nan, 2.5)
        one["flags"] = ["defocus" if i % 7 == 0 else "" for i in range(length)]
        parts.append(one)
    return pd.concat(parts).sort_values(["frame", "particle"]).reset_index(drop=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A results folder of a smoothed run."""
    out = tmp_path / "results" / "rise"
    out.mkdir(parents=True)
    write_table(table(), out / "trajectories.csv")
    offsets = {f"left-1_{axis}_mm": [0.1, -0.2] for axis in "xyz"}
    shake = pd.DataFrame({"frame": [0, 1], "t_s": [0.0, 0.01]} | offsets)
    write_table(shake, out / "shake.csv")
    said = {"verdict": "PARTIAL", "flags": ["SHAKE_UNMEASURED"]}
    (out / "smoothing.json").write_text(json.dumps(said))
    return out


def named(results: RunResults) -> RunResults:
    """The same with names for particles."""
    names = results.points["particle"].map({3: "äb", 7: "b", 12: "c"})
    points = results.points.assign(particle=names.astype(object))
    return RunResults("rise", LAB, points, source="trajectories.csv")


def test_results_are_read_by_particle_with_frame_and_verdict(folder: Path) -> None:
    results = read_results(folder)
    assert results.frame == LAB and results.verdict == "PARTIAL (SHAKE_UNMEASURED)"
    assert results.points["particle"].drop_duplicates().tolist() == [3, 7, 12]
    expected = table().sort_values(["particle", "frame"]).reset_index(drop=True)
    pd.testing.assert_frame_equal(results.points[expected.columns], expected, check_dtype=False)
    (folder / "trajectories.csv").rename(folder / "tracks.csv")
    tracked = read_results(folder)
    assert tracked.frame == RIG and tracked.verdict == "" and tracked.shake is None
    (folder / "tracks.csv").unlink()
    with pytest.raises(InputError, match="has neither"):
        read_results(folder)


def test_hdf5_holds_every_column_bit_for_bit(folder: Path, tmp_path: Path) -> None:
    results = read_results(folder)
    write_hdf5(results, tmp_path / "out.h5", CAMERAS)
    with h5py.File(tmp_path / "out.h5") as file:
        assert file.attrs["frame"] == LAB and "PARTIAL" in file.attrs["verdict"]
        group = file["trajectories"]
        assert list(group.attrs["columns"]) == list(results.points.columns)
        for column in results.points:
            read = group[column].asstr()[:] if column == "flags" else group[column][:]
            np.testing.assert_array_equal(read, results.points[column].to_numpy())
        assert group["vx_mm_s"].attrs["units"] == "mm s-1"
        assert file["shake/left-1_x_mm"][1] == -0.2
        camera = file["cameras/left"].attrs
        values = dict(zip(camera["parameter_names"].split(", "), camera["parameters"]))
        assert values["k1"] == 0.01 and list(camera["image_size_px"]) == [512, 500]


def test_mat_is_what_loadmat_reads(folder: Path, tmp_path: Path) -> None:
    results = read_results(folder)
    write_mat(results, tmp_path / "out.mat", CAMERAS)
    read = loadmat(tmp_path / "out.mat", squeeze_me=True, struct_as_record=False)
    for column in results.points:
        values = getattr(read["trajectories"], column)
        if column == "flags":
            assert [str(v) if np.size(v) else "" for v in values] == list(results.points[column])
        else:
            np.testing.assert_array_equal(values, results.points[column].to_numpy())
    assert loadmat(tmp_path / "out.mat")["trajectories"]["x_mm"][0, 0].shape == (56, 1)
    assert read["shake"].left_1_x_mm[1] == -0.2
    assert read["info"].verdict == "PARTIAL (SHAKE_UNMEASURED)"
    matrix = read["cameras"].right.undistorted_matrix
    point = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose((matrix @ [*point, 1])[:2], CAMERAS[1].project(point), atol=1e-12)


def test_names_that_matlab_cannot_tell_apart_are_refused(folder: Path, tmp_path: Path) -> None:
    results = read_results(folder)
    points = results.points.assign(**{"a-b": 1.0, "a_b": 2.0})
    with pytest.raises(InputError, match="the same in MATLAB"):
        write_mat(RunResults("rise", LAB, points), tmp_path / "out.mat")
    assert identifier("1 cam-é") == "n_1_cam__" and not (tmp_path / "out.mat").exists()


def check_netcdf(variables: dict[str, np.ndarray], points: pd.DataFrame) -> None:
    """Trajectories taken apart by rowSize are those of the table."""
    ends = np.cumsum(variables["rowSize"])
    assert ends[-1] == len(points)
    for particle, start, end in zip(variables["trajectory"], [0, *ends], ends):
        one = points[points["particle"] == particle]
        for name, column in [("time", "t_s"), ("x", "x_mm"), ("z", "z_mm"), ("d_eq_mm", "d_eq_mm")]:
            np.testing.assert_array_equal(variables[name][start:end], one[column])
        np.testing.assert_array_equal(variables["frame"][start:end], one["frame"])


def test_netcdf_is_a_contiguous_ragged_array(folder: Path, tmp_path: Path) -> None:
    results = replace(read_results(folder), name="früh")
    path = tmp_path / "out.nc"
    write_netcdf(results, path)
    with netcdf_file(path, mmap=False) as file:
        assert file.title.decode("utf-8") == "Bubble trajectories of run früh"
        assert (file.Conventions, file.featureType) == (b"CF-1.8", b"trajectory")
        assert file.variables["trajectory"].cf_role == b"trajectory_id"
        assert file.variables["rowSize"].sample_dimension == b"obs"
        assert file.variables["vx_mm_s"].units == b"mm s-1"
        check_netcdf({k: v[:] for k, v in file.variables.items()}, results.points)


def test_netcdf_by_xarray_and_named_particles(folder: Path, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    results = named(read_results(folder))
    write_netcdf(results, tmp_path / "out.nc")
    with xarray.open_dataset(tmp_path / "out.nc", engine="scipy") as data:
        assert data["time"].dtype == float and data["time"].attrs["units"] == "s"
        np.testing.assert_array_equal(data["time"], results.points["t_s"])
        assert data["particle_name"].values.tolist() == ["äb", "b", "c"]
        assert data["rowSize"].values.tolist() == [25, 30, 1]
        np.testing.assert_array_equal(data["y"], results.points["y_mm"])
        assert set(data["vx_mm_s"].coords) == {"time", "x", "y", "z"}


def test_netcdf_refuses_what_it_cannot_hold(folder: Path, tmp_path: Path) -> None:
    results = read_results(folder)
    points = results.points.assign(particle=results.points["particle"] + 2**40)
    with pytest.raises(InputError, match="beyond 32 bits"):
        write_netcdf(RunResults("rise", LAB, points), tmp_path / "out.nc")
    assert list(tmp_path.glob("*.nc*")) == [] and list(tmp_path.glob(".out*")) == []


def test_trackpy_table_as_pandas_reads_it(folder: Path, tmp_path: Path) -> None:
    results = named(read_results(folder))
    write_trackpy(results, tmp_path / "out.csv")
    read = pd.read_csv(tmp_path / "out.csv")
    assert list(read.columns[:6]) == ["frame", "particle", "x", "y", "z", "particle_name"]
    assert set(zip(read["particle"], read["particle_name"])) == {(0, "äb"), (1, "b"), (2, "c")}
    assert read["frame"].is_monotonic_increasing


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_trackpy_computes_with_it(folder: Path, tmp_path: Path) -> None:
    """Mean squared displacement by trackpy and by hand."""
    trackpy = pytest.importorskip("trackpy")
    write_trackpy(read_results(folder), tmp_path / "out.csv")
    read = pd.read_csv(tmp_path / "out.csv")
    places = table()[["x_mm", "y_mm", "z_mm"]].to_numpy()
    np.testing.assert_array_equal(read[["x", "y", "z"]], places)
    found = trackpy.imsd(read, mpp=1, fps=100, max_lagtime=3, pos_columns=["x", "y", "z"])
    for particle in (3, 7):
        places = read[read["particle"] == particle][["x", "y", "z"]].to_numpy()
        for lag in (1, 2, 3):
            expected = np.mean(np.sum((places[lag:] - places[:-lag]) ** 2, axis=1))
            assert found[particle].iloc[lag - 1] == pytest.approx(expected, rel=1e-9)


def test_given_names_reach_the_export_unchanged(folder: Path, tmp_path: Path) -> None:
    given = table().assign(particle=lambda t: t["particle"].map({3: "007", 7: "7", 12: "12"}))
    (folder / "trajectories.csv").unlink()
    write_table(given, folder / "tracks.csv")
    write_trackpy(read_results(folder), tmp_path / "out.csv")
    read = pd.read_csv(tmp_path / "out.csv", dtype={"particle_name": str})
    assert read.groupby("particle_name").size().to_dict() == {"007": 25, "7": 30, "12": 1}


def test_units_come_from_the_declarations() -> None:
    expected = {"svx_mm_s": "mm s-1", "sxx_mm2": "mm2", "left_u_px": "px", "frame": "1", "t_s": "s",
                "heat_mm": "1"}  # fmt: skip
    assert {name: unit_of(name) for name in expected} == expected


def test_only_the_results_of_runs_are_taken_for_runs(folder: Path, tmp_path: Path) -> None:
    """What an interrupted command left behind is none, and a wrong path finds nobody else's run."""
    left_behind = folder.with_name(".rise.123-abc.part")
    left_behind.mkdir()
    write_table(table(), left_behind / "tracks.csv")
    (tmp_path / "rig.toml").write_text("")
    assert run_folder(tmp_path, None) == folder
    assert run_folder(tmp_path, f"runs/{folder.name}") == folder
    elsewhere = folder.parent / "fall"
    elsewhere.mkdir()
    with pytest.raises(InputError, match="neither a dataset nor a folder of results"):
        run_folder(elsewhere, None)


@pytest.mark.parametrize("smoothed", [False, True])
def test_cameras_are_those_of_the_results_folder(folder: Path, smoothed: bool) -> None:
    """Smoothed with --out elsewhere, a folder has smoothing.json alone."""
    own = Camera.create("left", (512, 500), 11.0)
    rig = {"left": CameraRecord.of_camera(own).content()}
    if smoothed:
        (folder / "smoothing.json").write_text(json.dumps({"rig": rig}))
    else:
        said = {"kind": "telerig tracks", "cameras": rig}
        (folder / "tracking.json").write_text(json.dumps(said))
    beside = folder.parent / "calibration"
    beside.mkdir()
    (beside / "calibration.json").write_text("{")
    export_results(folder, "hdf5", out=folder / "out.h5")
    with h5py.File(folder / "out.h5") as file:
        values = file["cameras/left"].attrs
        names = values["parameter_names"].split(", ")
        assert values["parameters"][names.index("scale_px_per_mm")] == 11.0


def test_only_formats_with_cameras_read_the_calibration(folder: Path, tmp_path: Path) -> None:
    dataset = tmp_path / "dataset"
    shutil.copytree(folder, dataset / "results" / "run1")
    (dataset / "results" / "calibration").mkdir()
    (dataset / "results" / "calibration" / "calibration.json").write_text("{", encoding="utf-8")
    for to in ("netcdf", "trackpy"):
        export_results(dataset, to, out=tmp_path / to)
        assert (tmp_path / to).stat().st_size > 0
    with pytest.raises(InputError, match="cannot be read as JSON"):
        export_results(dataset, "hdf5", out=tmp_path / "hdf5")


@pytest.mark.parametrize(("to", "ending"), [("netcdf", "nc"), ("trackpy", "csv")])
def test_a_column_of_pixels_does_not_replace_the_position(
    folder: Path, tmp_path: Path, to: str, ending: str
) -> None:
    file = folder / "trajectories.csv"
    write_table(pd.read_csv(file, keep_default_na=False, na_values=[""]).assign(x=512.0), file)
    with pytest.raises(InputError, match="has a column 'x'"):
        export_results(folder, to, out=tmp_path / f"out.{ending}")
