"""Calibrated in air, used in water behind glass: errors as predicted, and gone with the walls.

What the cameras see through the walls comes from `ray_tracer`, which shares no code with telerig.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finding_codes import only
from numpy.typing import NDArray
from ray_tracer import trace_pixels
from typer.testing import CliRunner

import telerig
from telerig.command_options import CalibrationOptions
from telerig.errors import InputError
from telerig.estimator.batch.jobs import Job, check_options, jobs_of
from telerig.estimator.calibration.calibrate import run_calibration
from telerig.estimator.calibration.refractive_windows import (
    behind_windows,
    window_findings,
    window_warnings,
    with_windows,
)
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.factors.measurements import image_of_point
from telerig.io.dataset.dataset import load_dataset
from telerig.io.exchange.export.halcon import halcon_cameras
from telerig.io.exchange.export.opencv import camera_matrices
from telerig.io.results.calibration import CalibrationFile
from telerig.io.results.findings import Code
from telerig.io.results.folders.calibration import read_calibration_results
from telerig.io.rig_file.description import WallDescription
from telerig.io.rig_file.rig_file import read_rig_toml, write_rig_toml
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import preset
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS
from telerig.rig.projection import turned_wall
from telerig.rig.windows import Wall
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("without_advice", "undrawn")

Array = NDArray[np.float64]

INDICES = (1.0, 1.52, 1.333)
SHEAR_UM = 131  # per 30 mm of depth at 1 degree
FRAMES = 12
LENS = [name for name in PARAMETERS if not name.startswith("wall_")]


def wall(tilt_deg: float, towards_deg: float = 0.0, sigma_deg: float = 0.0) -> Wall:
    tilt, azimuth = np.radians(tilt_deg), np.radians(towards_deg)
    aside = np.sin(tilt) * np.array([np.cos(azimuth), np.sin(azimuth)])
    normal = np.array([*aside, np.cos(tilt)])
    return Wall(normal, -60.0, 10.0, INDICES, float(np.radians(sigma_deg)))


WALLS = {"left": wall(1.0), "right": wall(0.0)}


def traced(camera: Camera, glass: Wall, points_mm: Array) -> Array:
    lens = {name: camera[name] for name in LENS} | {"rho_mm": camera.rho_mm}
    stated = {
        "normal": glass.normal, "distance_mm": glass.distance_mm,
        "thickness_mm": glass.thickness_mm, "indices": glass.indices,
    }  # fmt: skip
    return trace_pixels(lens, stated, camera.camera_from_rig.apply(points_mm), "snell")


def rising() -> Array:
    """(FRAMES, 3 bubbles, 3) rig points, mm."""
    start = np.array([[-8.0, 6.0, -12.0], [2.0, 4.0, 0.0], [7.0, 8.0, 12.0]])
    return start - np.arange(FRAMES)[:, None, None] * np.array([0.1, 0.8, 0.05])


@pytest.fixture(scope="module")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Target views in air, walls in rig.toml, one run behind them."""
    folder = tmp_path_factory.mktemp("tank") / "set"
    telerig.simulate("paper", rng=np.random.default_rng(5), out=folder, images=False)
    with (folder / "rig.toml").open("a", encoding="utf-8") as file:
        for name, glass in WALLS.items():
            file.write(
                f"\n[walls.{name}]\nnormal = {glass.normal.tolist()}\nindices = {list(INDICES)}\n"
                f"thickness_mm = {glass.thickness_mm}\ndistance_mm = {glass.distance_mm}\n"
            )
    run = folder / "runs" / "rise"
    run.mkdir(parents=True)
    (run / "run.toml").write_text("frame_rate_hz = 100.0\nstart_s = 0.0\n", encoding="utf-8")
    points, rows = rising(), []
    for camera in true_cameras(preset("paper")).values():
        uv = traced(camera, WALLS[camera.name], points.reshape(-1, 3)).reshape(FRAMES, -1, 2)
        for (f, p), (u, v) in zip(np.ndindex(uv.shape[:2]), uv.reshape(-1, 2)):
            rows.append((f, camera.name, u, v, p + 1))
    columns = ["frame", "camera", "u_px", "v_px", "particle"]
    pd.DataFrame(rows, columns=columns).to_csv(run / "detections.csv", index=False)
    return folder


@pytest.fixture(scope="module")
def in_air(tank: Path) -> Calibration:
    return telerig.calibrate(load_dataset(tank))


def error_mm(calibration: Calibration, tank: Path) -> Array:
    """(FRAMES, 3, 3) of tracked bubbles, a common shift set aside: the rig's origin is a gauge."""
    table = telerig.track(telerig.load_run(tank / "runs" / "rise"), calibration).table
    table = table.sort_values(["frame", "particle"])
    assert len(table) == 3 * FRAMES
    found = table[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(FRAMES, 3, 3)
    wrong = found - rising()
    return np.asarray(wrong - wrong.mean((0, 1)))


def test_without_the_wall_depth_shears_as_predicted_and_with_it_does_not(
    tank: Path, in_air: Calibration
) -> None:
    depth = rising()[..., 2].ravel()

    def shear_um(wrong: Array) -> Array:
        return np.asarray(30e3 * np.polyfit(depth, wrong.reshape(-1, 3), 1)[0])

    assert shear_um(error_mm(in_air.in_air(), tank))[0] == pytest.approx(-SHEAR_UM, abs=3)
    seen = error_mm(in_air, tank)
    assert np.abs(shear_um(seen)).max() < 3
    assert np.abs(seen).max() < 3e-3


def test_the_warnings_say_how_large_the_error_would_be(tank: Path, in_air: Calibration) -> None:
    half = 0.5 * 0.6 * 512 / 10.0  # of the working volume
    stated = only(in_air, Code.WINDOWS_IN_AIR).numbers["error_um"]
    assert stated == pytest.approx(SHEAR_UM / 30 * half, rel=0.05)

    run = telerig.load_run(tank / "runs" / "rise")
    found = telerig.track(run, in_air.in_air())
    warning = next(n for n in found.summary["warnings"] if "rig.toml states for left" in n)
    assert float(warning.split("up to ")[1].split(" µm")[0]) == pytest.approx(stated, rel=0.05)
    assert not window_warnings(run.rig, in_air)
    assert not window_warnings(run.rig, replace(in_air.in_air(), medium="water"))
    assert not window_warnings(None, in_air)
    (gone,) = window_warnings(replace(run.rig, walls={}), in_air)
    assert "windows for left, right that rig.toml does not state" in gone
    assert float(gone.split("up to ")[1].split(" µm")[0]) == pytest.approx(stated, rel=0.05)


@pytest.mark.parametrize(("kappa", "distance"), [(7e-5, None), (7e-5, -60.0), (0.0, None)])
def test_a_lens_that_is_not_telecentric_needs_the_distance_of_its_window(
    kappa: float, distance: float | None, in_air: Calibration
) -> None:
    """Points look farther from the axis, or nearer to it, by kappa (1 - 1/n) times the distance."""
    lens = [c.with_parameters(kappa_per_mm=kappa) for c in in_air.in_air().cameras]
    described = {c.name: WallDescription(c.name, (0, 0, 1), INDICES, 10.0, distance) for c in lens}
    windows = {name: one.wall() for name, one in described.items()}
    dry = replace(in_air.in_air(), cameras=tuple(lens))
    rig = SimpleNamespace(walls=described)
    calibration = behind_windows(dry, windows)
    found = [f for f in window_findings(calibration, rig) if f.code is Code.WINDOW_DISTANCE]
    if kappa == 0 or distance is not None:
        assert not found
        return
    assert [finding.cameras for finding in found] == [("left",), ("right",)]
    half = 0.5 * 0.6 * 512 / 10.0  # of the working volume
    for finding, camera in zip(found, calibration.cameras):
        assert camera.wall is not None
        away = kappa * (1 - 1 / INDICES[-1]) * 10.0 * half
        both_see_y = np.hypot(1.0, 0.5)
        assert finding.numbers["error_um"] == pytest.approx(1e3 * away * both_see_y, rel=0.02)
    assert not [
        f for f in window_findings(replace(calibration, medium="water"), rig)
        if f.code is Code.WINDOW_DISTANCE
    ]  # fmt: skip


def test_findings_on_walls_are_right(in_air: Calibration) -> None:
    dry = replace(in_air.in_air(), free=in_air.free)

    def said(glass: Wall) -> dict[str, dict[str, float]]:
        calibration = behind_windows(dry, {"left": glass})
        described = WallDescription("left", (0.0, 0.0, 1.0), INDICES, 10.0, -60.0)
        found = window_findings(calibration, SimpleNamespace(walls={"left": described}))
        return {finding.code.name: finding.numbers for finding in found}

    assert said(wall(0.0))["WINDOWS_IN_AIR"]["error_um"] < 0.1
    assert list(said(wall(1.0))) == ["WINDOWS_IN_AIR"]
    assert "MEDIA_ORDER" in said(replace(wall(1.0), indices=INDICES[::-1]))
    assert said(wall(79.0))["WINDOW_LEANING"]["angle_deg"] == pytest.approx(79.0)
    assert said(wall(0.0, sigma_deg=0.5))["WINDOW_NORMAL"]["sd_deg"] == pytest.approx(0.5)
    assert not window_findings(dry, SimpleNamespace(walls={}))
    (wet,) = window_findings(replace(dry, medium="water"), SimpleNamespace(walls={}))
    assert wet.code is Code.NO_WINDOWS


def test_the_errors_in_space_hold_the_walls_share(in_air: Calibration) -> None:
    """The normal's two tilts bend rays by b = sigma (1 - 1 / n), and shear depth into x and y.

    Half of a shear is a turn. Of x the whole is seen, b^2 / 2; of y, which both cameras see, the
    mean: b^2 / 8.
    """
    dry = replace(in_air.in_air(), free=in_air.free)
    sd = {s: behind_windows(dry, {"left": wall(0.0, sigma_deg=s)}).statistics for s in (0.0, 0.5)}
    assert sd[0.0]["space_sd_um"] == dry.statistics["space_sd_um"]
    share = np.sqrt(sd[0.5]["space_sd_um"] ** 2 - sd[0.0]["space_sd_um"] ** 2)
    assert share == pytest.approx(sd[0.5]["space_sd_walls_um"])
    bend = np.radians(0.5) * (1 - 1 / INDICES[2])
    depth_sd_um = 1e3 * 0.6 * 51.2 / np.sqrt(8.0)  # of five steps
    assert share == pytest.approx(bend * depth_sd_um * np.sqrt((1 / 2 + 1 / 8) / 3), rel=0.02)


def test_files_keep_walls_and_medium(tank: Path, in_air: Calibration, tmp_path: Path) -> None:
    in_air.save(tmp_path)
    again = telerig.load_calibration(tmp_path)
    points = rising()[0]
    assert again.medium == "air"
    for camera in again.cameras:
        name = camera.name
        expected = traced(in_air.in_air().camera(name), WALLS[name], points)
        np.testing.assert_allclose(again.project(name, points), expected, rtol=0, atol=1e-9)
    assert not window_warnings(load_dataset(tank).rig, again)
    assert all(
        c.wall is not None
        for c in CalibrationFile.read(tmp_path / "calibration.json").rig_cameras(windows=True)
    )
    assert all(c.wall is None for c in read_calibration_results(tmp_path).cameras)

    content = json.loads((tmp_path / "calibration.json").read_text(encoding="utf-8"))
    del content["walls"], content["medium"]
    for camera in content["cameras"].values():
        del camera["parameters"]["wall_x_rad"], camera["parameters"]["wall_y_rad"]
    (tmp_path / "calibration.json").write_text(json.dumps(content), encoding="utf-8")
    old = telerig.load_calibration(tmp_path)
    assert old.medium == "air" and all(c.wall is None for c in old.cameras)


def test_what_is_not_known_of_a_wall_reaches_the_points(in_air: Calibration) -> None:
    sigma_deg = 0.1
    air = replace(in_air.in_air(), free=in_air.free)
    wet = behind_windows(air, {"left": wall(1.0, sigma_deg=sigma_deg)})
    known = behind_windows(air, {"left": wall(1.0)})
    assert wet.free[0][-2:] == ("wall_x_rad", "wall_y_rad")
    assert wet.sd("left.wall_y_rad") == pytest.approx(np.radians(sigma_deg))
    rows = len(wet.covariance)
    np.testing.assert_array_equal(wet.joint_covariance[:rows, :rows], wet.covariance)
    assert wet.joint_names[:rows] == wet.covariance_names
    old = [n for n in wet.covariance_names if n in air.covariance_names]
    assert tuple(old) == air.covariance_names

    point = np.array([[3.0, -2.0, 12.0]])
    uv = [wet.project(i, point) for i in (0, 1)]
    grown = [c.triangulate(uv[0], uv[1], sigma_px=0.01).covariance_mm2[0] for c in (wet, known)]

    def seen(tilt_rad: Array) -> Array:
        turned = behind_windows(air, {"left": wall(1.0).turned(tilt_rad)})
        return turned.triangulate(uv[0], uv[1], sigma_px=0.01).points_mm[0]

    root = np.array([(seen(t) - seen(-t)) / 2 for t in np.radians(sigma_deg) * np.eye(2)])
    expected = root.T @ root
    difference = grown[0] - grown[1]
    np.testing.assert_allclose(difference, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("kappa", [0.0, 1e-4])
def test_exported_matrices_are_those_of_the_water(in_air: Calibration, kappa: float) -> None:
    straight = [
        c.with_parameters(k1=0.0, k2=0.0, p1=0.0, p2=0.0, kappa_per_mm=kappa)
        for c in in_air.cameras
    ]
    for found in camera_matrices(straight):
        assert found.undistorted_misfit.max_px < (1e-9 if kappa == 0 else 0.02)
        assert found.affine_misfit.max_px < (1e-9 if kappa == 0 else 1.0)
    left, right = halcon_cameras(straight)
    assert any("refractive window is left out" in note for note in left.notes)
    assert left.misfit.max_px > 0.1
    assert kappa or right.misfit.max_px < 1e-9


def test_a_sign_that_nothing_decides_is_said(scene: Callable[..., Any]) -> None:
    walls = {"left": wall(5.0), "right": wall(0.0)}
    made, _, dots = in_water(walls, 0.0, scene)
    for sigma_deg, open_ in ((6.0, True), (1.0, False)):
        stated = {"left": wall(4.0, sigma_deg=sigma_deg), "right": wall(0.0)}
        found = self_calibrate(
            dots, with_windows(made.cameras, stated), made.target, model="none",
            nominal_rotvec_deg=made.nominal_rotvec_deg,
        )  # fmt: skip
        descriptions = {
            n: WallDescription(n, (0.0, 0.0, 1.0), INDICES, 10.0, -60.0) for n in stated
        }
        rig = SimpleNamespace(walls=descriptions)
        findings = window_findings(replace(found, medium="water"), rig)
        assert any(f.code is Code.WINDOW_TILT_SIGN for f in findings) == open_


def in_water(
    walls: dict[str, Wall], kappa_per_mm: float, scene: Callable[..., Any]
) -> tuple[Any, tuple[Camera, ...], pd.DataFrame]:
    """A scene of which the target was in the water; true cameras; the dots they see."""
    made = scene("paper", 1)
    lens = {
        "kappa_per_mm": kappa_per_mm, "k1": 0.0, "centre_u_px": 255.5, "centre_v_px": 255.5
    }  # fmt: skip
    true = tuple(c.with_parameters(**lens) for c in made.true_cameras.values())
    behind = with_windows(true, walls)
    rng, dots = np.random.default_rng(1), made.exact.copy()
    for camera in behind:
        mine = (dots["camera"] == camera.name).to_numpy()
        points = np.concatenate([
            made.true_views[v].rig_from_target.apply(made.true_dots_mm[d][None])
            for v, d in zip(dots.loc[mine, "view"], dots.loc[mine, "dot"])
        ])  # fmt: skip
        noise = 0.01 * rng.standard_normal((len(points), 2))
        dots.loc[mine, ["u_px", "v_px"]] = camera.project(points) + noise
    dots["suu_px2"] = dots["svv_px2"] = 1e-4
    dots["suv_px2"] = 0.0
    return made, behind, dots


def test_a_perspective_lens_from_air_into_water(scene: Callable[..., Any]) -> None:
    kappa = 1 / 300
    made, true, dots = in_water({}, kappa, scene)
    nominal = [c.with_parameters(kappa_per_mm=kappa) for c in made.cameras]
    air = self_calibrate(
        dots, nominal, made.target, nominal_rotvec_deg=made.nominal_rotvec_deg, model="kappa"
    )
    points = np.random.default_rng(0).uniform(-12, 12, (20, 3))
    uv = [traced(c, WALLS[c.name], points) for c in true]
    wrong = {}
    for calibration in (air, behind_windows(air, WALLS)):
        seen = calibration.triangulate(uv[0], uv[1], sigma_px=0.01).points_mm - points
        wrong[calibration is air] = np.abs(seen - seen.mean(0)).max()
    assert wrong[False] < 2e-3 < 0.3 < wrong[True]


def test_the_smoother_sees_through_the_wall(in_air: Calibration) -> None:
    camera, points = in_air.cameras[0], rising()
    axis, position = np.array([0.0, -1.0, 0.0]), 7.0
    seen = image_of_point(camera, points + axis * position, position, axis, np.zeros(3))
    np.testing.assert_allclose(seen.uv_px, camera.project(points), atol=1e-9)
    for i, step in enumerate(1e-3 * np.eye(3)):
        slope = (camera.project(points + step) - camera.project(points - step)) / 2e-3
        np.testing.assert_allclose(seen.by_point[..., i], slope, atol=1e-6)


def test_rig_toml_states_the_wall(tank: Path, tmp_path: Path) -> None:
    rig = load_dataset(tank).rig
    walls = {n: replace(w, normal_sigma_deg=0.25) for n, w in rig.walls.items()}
    write_rig_toml(replace(rig, walls=walls), tmp_path / "rig.toml")
    again = read_rig_toml(tmp_path / "rig.toml")
    assert again.walls == walls
    stated = again.windows["left"]
    assert stated.normal_sigma_rad == pytest.approx(np.radians(0.25))
    assert stated.distance_mm == -60.0
    text = (tmp_path / "rig.toml").read_text(encoding="utf-8").replace("= 0.25", "= -0.25")
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="normal_sigma_deg"):
        read_rig_toml(tmp_path / "rig.toml")


def test_run_and_batch_pass_the_medium_on(tank: Path) -> None:
    jobs = jobs_of([tank], calibrating=CalibrationOptions(medium="water"))
    assert isinstance(jobs[0].options, CalibrationOptions) and jobs[0].options.medium == "water"
    assert Job.from_json(jobs[0].as_json()) == jobs[0]
    with pytest.raises(InputError, match="unknown medium 'oil'"):
        check_options(None, CalibrationOptions(medium="oil"))


@pytest.mark.parametrize(("kappa", "model"), [(0.0, "none"), (1 / 300, "kappa")])
def test_a_target_in_the_water_shows_how_the_walls_stand(
    kappa: float, model: str, scene: Callable[..., Any]
) -> None:
    """Telecentric lenses see a tilt in the second order, its sign by perspective or beforehand."""
    walls = {"left": wall(5.0), "right": wall(3.0, 100.0)}
    made, true, dots = in_water(walls, kappa, scene)
    nominal = [c.with_parameters(kappa_per_mm=kappa) for c in made.cameras]
    stated = {"left": wall(4.0, 5.0, 1.0), "right": wall(3.5, 90.0, 1.0)}
    found = {
        how: self_calibrate(
            dots, with_windows(nominal, given), made.target,
            nominal_rotvec_deg=made.nominal_rotvec_deg, model=model,
        )
        for how, given in (("ignored", {}), ("estimated", stated), ("known", walls))
    }  # fmt: skip
    for camera, glass in zip(found["estimated"].cameras, walls.values()):
        assert camera.wall is not None
        stands = turned_wall(camera.intrinsics, camera.wall)
        off = np.arccos(stands.normal @ glass.normal)
        sd = [found["estimated"].sd(f"{camera.name}.{n}") for n in ("wall_x_rad", "wall_y_rad")]
        assert max(sd) < np.radians(0.2)
        assert off < 3.5 * np.hypot(*sd)
    rms = {how: c.statistics["rms_px"] for how, c in found.items()}
    assert rms["ignored"] > 2 * rms["known"]
    assert rms["estimated"] < 1.05 * rms["known"]
    points = np.random.default_rng(0).uniform(-12, 12, (100, 3))
    uv = [c.project(points) for c in true]
    space = {}
    for how, calibration in found.items():
        seen = calibration.triangulate(uv[0], uv[1], sigma_px=0.01).points_mm
        a, b = seen - seen.mean(0), points - points.mean(0)
        u, _, vt = np.linalg.svd(a.T @ b)
        space[how] = float(np.sqrt(((a @ u @ vt - b) ** 2).mean()))
    assert space["known"] < 5e-4 and space["estimated"] < 1e-3 < space["ignored"]


def test_the_command_records_the_medium(tank: Path, tmp_path: Path) -> None:
    command = ["calibrate", str(tank), "--medium", "water", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*command, "--model", "none", "--quiet"])
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "out" / "calibration.json").read_text(encoding="utf-8"))
    assert "WINDOWS_IN_WATER" in [found["code"] for found in content["findings"]]
    assert content["medium"] == "water" and set(content["walls"]) == {"left", "right"}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "(wall_x_rad)" in page
    with pytest.raises(InputError, match="unknown medium 'oil'"):
        run_calibration(load_dataset(tank), medium="oil")


def test_a_wall_without_distance_stands_at_the_origin(tank: Path, tmp_path: Path) -> None:
    bare = tmp_path / "set"
    (bare / "calibration").mkdir(parents=True)
    text = (tank / "rig.toml").read_text(encoding="utf-8")
    kept = [line for line in text.splitlines() if not line.startswith("distance_mm")]
    (bare / "rig.toml").write_text("\n".join(kept), encoding="utf-8")
    dots = (tank / "calibration" / "dots.csv").read_bytes()
    (bare / "calibration" / "dots.csv").write_bytes(dots)
    found = telerig.calibrate(load_dataset(bare), model="radial")
    wrong = error_mm(found, tank)
    assert np.abs(wrong).max() < 3e-3
