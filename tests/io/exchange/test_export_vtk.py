"""Exports for ParaView: the files as XML, and as VTK itself reads them."""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from filmed_run import HALF_AXES_MM, write_run
from smoothed_folder import write_folder

from telerig.errors import InputError
from telerig.io.exchange.export.run_results import LAB, RunResults, read_results
from telerig.io.exchange.export.vtk import PATHS, SERIES, write_vtk


def series(folder: Path) -> dict[float, Path]:
    root = ElementTree.parse(folder / SERIES).getroot()
    return {float(e.attrib["timestep"]): folder / e.attrib["file"] for e in root.iter("DataSet")}


def arrays(file: Path) -> dict[str, np.ndarray]:
    kinds = {"Float64": "<f8", "Int64": "<i8"}
    out = {}
    for element in ElementTree.parse(file).getroot().iter("DataArray"):
        data = base64.b64decode(element.text or "")
        assert int.from_bytes(data[:8], "little") == len(data) - 8
        values = np.frombuffer(data[8:], kinds[element.attrib["type"]])
        width = int(element.attrib.get("NumberOfComponents", 1))
        out[element.attrib["Name"]] = values.reshape(-1, width) if width > 1 else values
    return out


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("vtk") / "results" / "rise")


def test_every_frame_has_its_bubbles_at_its_time(run: Path, tmp_path: Path) -> None:
    results = read_results(run)
    write_vtk(results, tmp_path / "out")
    files = series(tmp_path / "out")
    assert len(files) == len(results.points) and all(file.is_file() for file in files.values())
    for (t_s, file), row in zip(files.items(), results.points.itertuples()):
        found = arrays(file)
        assert t_s == row.t_s and found["particle"].tolist() == [0]
        np.testing.assert_array_equal(found["d_eq_mm"], row.d_eq_mm)
    lengths = np.linalg.eigvalsh(arrays(file)["diameters_mm"].reshape(3, 3))
    np.testing.assert_allclose(lengths, np.sort(2 * HALF_AXES_MM), atol=1e-5)
    path = arrays(tmp_path / "out" / PATHS)
    assert path["offsets"].tolist() == [len(results.points)]


def swarm() -> RunResults:
    """Two bubbles; none is seen in frame 3; the second has no size, and names in place of ids."""
    table = pd.DataFrame({
        "frame": [1, 2, 4, 2, 5], "particle": np.array(["a", "a", "a", "b<", "b<"], object),
        "t_s": [0.1, 0.2, 0.4, 0.2, 0.5], "d_eq_mm": [2.0, 2.0, 2.0, np.nan, np.nan],
        "flags": ["", "x", "", "", ""],
    })  # fmt: skip
    table[["x_mm", "y_mm", "z_mm"]] = np.arange(15.0).reshape(5, 3)
    table[["vx_mm_s", "vy_mm_s", "vz_mm_s"]] = -np.arange(15.0).reshape(5, 3)
    return RunResults("a -- b", LAB, table)


def test_frames_without_bubbles_are_empty_and_old_frames_go(tmp_path: Path) -> None:
    results = swarm()
    write_vtk(results, tmp_path)
    files = series(tmp_path)
    assert list(files) == [0.1, 0.2, 0.3, 0.4, 0.5]
    assert len(arrays(files[0.3])["Points"]) == 0
    second = arrays(files[0.2])
    np.testing.assert_array_equal(second["Points"], [[3, 4, 5], [9, 10, 11]])
    np.testing.assert_array_equal(second["velocity_mm_s"], [[-3, -4, -5], [-9, -10, -11]])
    np.testing.assert_array_equal(second["diameters_mm"][0].reshape(3, 3), 2 * np.eye(3))
    assert not second["diameters_mm"][1].any() and "flags" not in second
    few = RunResults("few", LAB, results.points[results.points["frame"] > 3].reset_index(drop=True))
    write_vtk(few, tmp_path)
    assert {p.name for p in (tmp_path / "frames").iterdir()} == {
        "bubbles_000004.vtp", "bubbles_000005.vtp",
    }  # fmt: skip


def test_times_since_1970_stay_apart(tmp_path: Path) -> None:
    results = swarm()
    late = replace(results, points=results.points.assign(t_s=results.points["t_s"] + 1.7e9))
    write_vtk(late, tmp_path / "out")
    assert len(series(tmp_path / "out")) == 5


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="other files"):
        write_vtk(swarm(), tmp_path)


def test_a_moved_folder_is_read_by_pyvista_with_its_times(run: Path, tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    results = read_results(run)
    write_vtk(results, tmp_path / "out")
    (tmp_path / "elsewhere").mkdir()
    moved = (tmp_path / "out").rename(tmp_path / "elsewhere" / "moved")
    reader = pyvista.PVDReader(str(moved / SERIES))
    np.testing.assert_allclose(reader.time_values, results.points["t_s"])
    reader.set_active_time_point(3)
    bubbles = reader.read()[0]
    place = results.points.loc[3, ["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    np.testing.assert_array_equal(bubbles.points[0], place)
    assert bubbles["d_eq_mm"][0] == results.points["d_eq_mm"][3]


def test_vtk_draws_the_ellipsoids(run: Path, tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    write_vtk(read_results(run), tmp_path / "out")
    file = next(iter(series(tmp_path / "out").values()))
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(file))
    sphere = vtk.vtkSphereSource()
    sphere.SetRadius(0.5)
    sphere.SetThetaResolution(200)
    sphere.SetPhiResolution(200)
    glyph = vtk.vtkTensorGlyph()
    glyph.SetInputConnection(reader.GetOutputPort())
    glyph.SetSourceConnection(sphere.GetOutputPort())
    glyph.Update()
    centre = vtk_to_numpy(reader.GetOutput().GetPoints().GetData())[0]
    surface = vtk_to_numpy(glyph.GetOutput().GetPoints().GetData())
    reach = np.abs(surface - centre).max(0)
    np.testing.assert_allclose(reach, HALF_AXES_MM, rtol=1e-3)
    assert reader.GetOutput().GetPointData().GetScalars().GetName() == "particle"
    lines = vtk.vtkXMLPolyDataReader()
    lines.SetFileName(str(tmp_path / "out" / PATHS))
    lines.Update()
    assert lines.GetOutput().GetNumberOfLines() == 1


def test_a_smoothed_run_has_the_shapes_of_its_bubbles_csv(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "smoothed", frames=60, bubbles=2)
    (folder / "tracks.csv").unlink()  # smoothed into another folder than that of the tracks
    smooth = pd.read_csv(folder / "trajectories.csv")
    bodies = smooth[["frame", "particle"]].assign(
        d_eq_mm=2.0, equator_mm=1.6, polar_mm=0.8, pole_x=0.0, pole_y=-1.0, pole_z=0.0
    )
    pd.concat([bodies[::-1], bodies[:3]]).to_csv(folder / "bubbles.csv", index=False)
    results = read_results(folder)
    write_vtk(results, tmp_path / "out")
    found = arrays(list(series(tmp_path / "out").values())[7])
    assert found["particle"].tolist() == [0, 1]
    np.testing.assert_allclose(found["diameters_mm"][1].reshape(3, 3), np.diag([3.2, 1.6, 3.2]))
    here = results.points[results.points["frame"] == 7]
    np.testing.assert_array_equal(found["Points"], here[["x_mm", "y_mm", "z_mm"]])
