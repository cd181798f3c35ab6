"""Results in a notebook: short texts, tables, xarray, a smoothing read from its folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.exchange.export.netcdf import write_netcdf
from telerig.io.exchange.export.opencv import camera_matrices
from telerig.io.exchange.export.run_results import read_results
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.camera import Camera
from telerig.rig.triangulation import POSE_COMPONENTS, Triangulation, triangulate_views
from telerig.short_text import ShortText


class Chain(NamedTuple):
    dataset: telerig.Dataset
    calibration: telerig.Calibration
    tracks: telerig.Tracks
    smoothing: telerig.Smoothing


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    folder = tmp_path_factory.mktemp("prompt") / "<tank & co>"
    config = run_preset("rise", frames=12)
    dataset = telerig.simulate(config, rng=np.random.default_rng(3), out=folder, images=False)
    calibration = calibration_from_cameras(list(true_cameras(config.calibration).values()))
    run = dataset.runs["rise"].load()
    tracks = telerig.track(run, calibration)
    return Chain(
        dataset,
        calibration,
        tracks,
        telerig.smooth(tracks, calibration, stage=run, model="default"),
    )


def points(calibration: telerig.Calibration, count: int = 3) -> Triangulation:
    xyz = np.arange(3.0 * count).reshape(count, 3)
    return calibration.triangulate(*(calibration.project(c, xyz) for c in range(2)))


def test_texts_are_short_and_say_the_verdict(chain: Chain) -> None:
    everything: list[ShortText] = [*chain, points(chain.calibration)]
    for one in everything:
        assert len(repr(one)) < 1000 and repr(one).count("\n") < 10
    assert repr(chain.calibration).startswith("Calibration 'imported': IMPORTED\n")
    verdict = chain.smoothing.verdict["verdict"]
    first = repr(chain.smoothing).splitlines()[0]
    assert first.startswith("Smoothing of run 'rise': Vertical: ") and f". {verdict}" in first
    assert "1 track" in repr(chain.tracks) and "12 points in frames 0 to 11" in repr(chain.tracks)
    assert "3 points" in repr(points(chain.calibration))


def test_tables_for_notebooks_are_well_formed_and_escaped(chain: Chain) -> None:
    class Tags(HTMLParser):
        open_, text = 0, ""

        def handle_starttag(self, tag: str, attrs: object) -> None:
            self.open_ += 1

        def handle_endtag(self, tag: str) -> None:
            self.open_ -= 1

        def handle_data(self, data: str) -> None:
            self.text += data

    parser = Tags()
    parser.feed(chain.dataset._repr_html_())
    assert parser.open_ == 0 and "<tank & co>" in parser.text


def test_a_smoothing_read_again_is_the_one_that_was_saved(chain: Chain, tmp_path: Path) -> None:
    chain.smoothing.save(tmp_path / "rise")
    again = telerig.load_smoothing(tmp_path / "rise")
    pd.testing.assert_frame_equal(again.trajectories, chain.smoothing.trajectories)
    pd.testing.assert_frame_equal(again.shake, chain.smoothing.shake)
    assert again.model == chain.smoothing.model and again.name == "rise"
    assert again.verdict == chain.smoothing.verdict
    assert set(again.summary) == set(chain.smoothing.summary) and again.solution is None
    assert repr(again) == repr(chain.smoothing)
    ours, theirs = chain.smoothing.to_xarray(), again.to_xarray()
    assert ours.equals(theirs)
    again.save(tmp_path / "again")
    for name in ("trajectories.csv", "shake.csv", "smoothing.json"):
        first, second = ((tmp_path / f / name).read_bytes() for f in ("rise", "again"))
        assert first == second, name
    (tmp_path / "again" / "results.h5").write_bytes(b"no HDF5")
    with pytest.raises(InputError):
        telerig.load_smoothing(tmp_path / "again")
    with pytest.raises(InputError, match="not smoothed"):
        telerig.load_smoothing(tmp_path)
    for load in (telerig.load_smoothing, telerig.load_tracks):
        with pytest.raises(InputError, match=r"did you mean rise\?"):
            load(tmp_path / "rize")


def test_xarray_has_the_covariance_and_what_the_netcdf_file_has(
    chain: Chain, tmp_path: Path
) -> None:
    xarray = pytest.importorskip("xarray")
    data = chain.tracks.to_xarray()
    table = chain.tracks.to_pandas().loc[0]
    np.testing.assert_array_equal(data["covariance"].sel(axis="x", axis_of="z"), table["sxz_mm2"])
    np.testing.assert_array_equal(data["covariance"].sel(axis="z", axis_of="x"), table["sxz_mm2"])
    smoothed = chain.smoothing.to_xarray()
    variance = np.diagonal(smoothed["covariance"].to_numpy(), axis1=1, axis2=2)
    np.testing.assert_allclose(variance[:, 1], smoothed["sy_mm"] ** 2)
    assert np.all(np.linalg.eigvalsh(smoothed["covariance"].to_numpy()) > 0)
    assert smoothed["vx_mm_s"].attrs["units"] == "mm s-1"
    chain.smoothing.save(tmp_path / "rise")
    write_netcdf(read_results(tmp_path / "rise"), tmp_path / "rise.nc")
    with xarray.open_dataset(tmp_path / "rise.nc", engine="scipy") as file:
        for name in file.variables:
            np.testing.assert_array_equal(file[name], smoothed[name], err_msg=str(name))
            assert {k: v for k, v in file[name].attrs.items() if k != "coordinates"} == {
                k: v for k, v in smoothed[name].attrs.items() if k != "coordinates"
            }


def test_rows_are_sorted_with_their_covariance(chain: Chain) -> None:
    pytest.importorskip("xarray")
    turned = chain.smoothing.trajectories[::-1].reset_index(drop=True)
    states = dict(chain.smoothing.states)
    states["bubble_covariance"] = states["bubble_covariance"][::-1]
    tables = replace(chain.smoothing.tables, trajectories=turned, states=states)
    swapped = replace(chain.smoothing, tables=tables)
    assert swapped.to_xarray().equals(chain.smoothing.to_xarray())


def test_parameters_as_a_table(chain: Chain) -> None:
    table = chain.calibration.to_pandas()
    assert (
        table.loc["right.scale_px_per_mm", "value"]
        == chain.calibration.camera("right")["scale_px_per_mm"]
    )
    assert np.isnan(table.loc["right.rx_rad", "sd"]) and "left.rx_rad" not in table.index
    triangulated = points(chain.calibration).to_pandas()
    assert list(triangulated["x_mm"].round(9)) == [0.0, 3.0, 6.0]


def test_points_and_parameters_with_their_covariances() -> None:
    pytest.importorskip("xarray")
    cameras = true_cameras(run_preset("rise").calibration)
    free = (("scale_px_per_mm",), ("kappa_per_mm",))
    names = ("left.scale_px_per_mm", "right.kappa_per_mm", *(f"right.{p}" for p in POSE_COMPONENTS))
    covariance = 1e-10 * (np.eye(8) + 0.5)
    calibration = replace(
        calibration_from_cameras(list(cameras.values())),
        covariance=covariance, covariance_names=names, free=free,
    )  # fmt: skip
    data = calibration.to_xarray()
    assert data["covariance"].sel(parameter=names[1], parameter_of=names[2]) == 0.5e-10
    np.testing.assert_allclose(np.diagonal(data["covariance"]), data["sd"] ** 2)
    assert data["units"].sel(parameter="right.kappa_per_mm") == "mm-1"
    assert data["value"].sel(parameter="left.k1") == calibration.camera("left")["k1"]
    found = points(calibration)
    one, table = found.to_xarray(), found.to_pandas()
    np.testing.assert_array_equal(one["covariance"].sel(axis="x", axis_of="z"), table["sxz_mm2"])
    np.testing.assert_array_equal(one["ray_miss_mm"], table["ray_miss_mm"])
    np.testing.assert_array_equal(one["y"], table["y_mm"])
    assert one["covariance"].attrs["units"] == "mm2" and one["z"].attrs["units"] == "mm"
    views = [calibration.project(c, np.arange(12.0).reshape(2, 2, 3)) for c in range(2)]
    several = triangulate_views(calibration.cameras, views, 0.1)
    assert several.to_xarray()["ray_miss_mm"].dims == ("obs", "camera")
    assert several.to_xarray()["seen_by"].to_numpy().tolist() == [2, 2, 2, 2]


def test_undistorted_images_are_those_of_opencv() -> None:
    lens = Camera.create("left", (240, 200), 10.0, k1=0.03, k2=-0.01, p1=0.002)
    calibration = calibration_from_cameras([lens])
    v, u = np.mgrid[:200, :240].astype(np.float32)
    image = 100 + 50 * np.sin(u / 9) * np.cos(v / 11)
    matrix = camera_matrices([lens])[0]
    expected = cv2.undistort(
        image, matrix.camera_matrix, matrix.distortion, None, matrix.camera_matrix
    )
    found = calibration.undistort_image("left", image)
    inside = np.s_[20:-20, 20:-20]
    assert np.abs(found - image)[inside].max() > 5  # the lens is far from straight
    assert np.abs(found - expected)[inside].max() < 0.5  # OpenCV interpolates linearly
    colours = np.repeat(image[..., None], 3, -1).astype(np.uint8)
    assert calibration.undistort_image(0, colours).dtype == np.uint8
    point = np.array([[3.0, -4.0, 1.0]])
    ideal = lens.undistorted().project(point)
    np.testing.assert_allclose(lens.distorted_pixel(ideal), lens.project(point), atol=1e-9)


@pytest.mark.parametrize("image", [np.zeros((240, 200)), np.zeros((200, 240), bool), np.zeros(3)])
def test_images_that_cannot_be_undistorted(image: np.ndarray) -> None:
    calibration = calibration_from_cameras([Camera.create("left", (240, 200), 10.0)])
    with pytest.raises(InputError, match=r"undistort_image, camera left"):
        calibration.undistort_image("left", image)


@pytest.mark.parametrize(
    "call",
    [
        lambda: telerig.calibrate("tank"),
        lambda: telerig.track("tank/runs/rise", None),
        lambda: telerig.compare_calibrations("tank", "tank"),
        lambda: telerig.uncertainty_map("tank"),
    ],
)
def test_a_path_in_place_of_what_it_holds_is_named(call: Callable[[], object]) -> None:
    with pytest.raises(telerig.TelerigError, match=r"was given a str\n  -> give what telerig\."):
        call()


def test_arguments_of_another_kind_are_named() -> None:
    with pytest.raises(telerig.TelerigError, match=r"was given a str\n  -> .*\.rig\.target"):
        telerig.detect_target(np.zeros((40, 40)), "rig.toml")  # type: ignore[arg-type]
    with pytest.raises(telerig.TelerigError, match=r"was given a int\n  -> .*default_rng"):
        telerig.simulate("paper", rng=1)  # type: ignore[arg-type]
