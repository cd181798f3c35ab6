"""What several test files share: datasets simulated once, and calibration scenes in memory."""

from __future__ import annotations

import one_thread  # noqa: F401 - before NumPy

# isort: split

import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from batch_dataset import make_results
from compiled_once import compile_one_at_a_time
from made_once import made_once
from run_files import LEFT, RIG, RIGHT, write_images
from undrawn_pages import undrawn_pages

import telerig
from telerig.estimator.calibration import self_calibration
from telerig.estimator.calibration.calibrate import nominal_cameras
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.estimator.smoothing import smooth
from telerig.factors.bubble_motion import Inertia
from telerig.io.machine import parallel
from telerig.io.rig_file.description import RigDescription
from telerig.io.simulation.calibration.scene import View, hand_held_views, true_cameras, true_target
from telerig.io.simulation.calibration_files import exact_dots, rig_description
from telerig.io.simulation.config import SimulationConfig
from telerig.io.simulation.presets import preset
from telerig.rig.camera import Camera
from telerig.rig.target import Target

HALF_VOLUME_MM = 15.0

if "PYTEST_XDIST_WORKER" in os.environ:
    # a worker of xdist has a thread that `threading` does not count: a copy of it can hang
    parallel.can_fork = lambda: False
    compile_one_at_a_time()


def rigidly_aligned(points: Any, onto: Any) -> Any:
    """Points moved by the rotation and shift that fit best (Kabsch)."""
    a, b = points - points.mean(0), onto - onto.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    return a @ u @ flip @ vt + onto.mean(0)


@dataclass(frozen=True)
class Scene:
    """A simulated calibration: what is measured and known, and the truth.

    dots : the table that `self_calibrate` takes, not to be changed in place.
    exact : noise-free pixels of the same rows.
    outlier : (M,) which rows were displaced.  cameras : nominal;  true_cameras : by name.
    """

    dots: pd.DataFrame
    exact: pd.DataFrame
    outlier: Any
    cameras: list[Camera]
    target: Target
    nominal_rotvec_deg: Any
    true_cameras: dict[str, Camera]
    true_views: dict[str, View]
    true_dots_mm: dict[int, Any]
    found: dict[str, Calibration] = field(default_factory=dict, init=False, repr=False)

    def calibrate(self, model: Any = "radial", **options: Any) -> Calibration:
        """`self_calibrate` on this scene, done once for each choice of options."""
        given = {"nominal_rotvec_deg": self.nominal_rotvec_deg, "model": model} | options
        key = repr((sorted(given.items()), self_calibration.next_view))
        if key not in self.found:
            self.found[key] = self_calibrate(self.dots, self.cameras, self.target, **given)
        return self.found[key]

    def changed(self, change: Callable[[pd.DataFrame], pd.DataFrame]) -> Scene:
        """The scene with its table of measured dots changed."""
        return replace(self, dots=change(self.dots.copy()))

    def weights(self, calibration: Calibration) -> Any:
        """(M,) final weights in the order of the scene's table."""
        keys = ["view", "camera", "dot"]
        final = calibration.residuals[[*keys, "weight"]]
        return self.dots[keys].merge(final, on=keys, how="left")["weight"].to_numpy()

    def space_rms_um(self, calibration: Calibration) -> float:
        """RMS error per axis of points of the working volume, triangulated from true pixels.

        After the rotation and shift that fit best: the rig's frame is a matter of gauge.
        """
        truth = np.random.default_rng(0).uniform(-HALF_VOLUME_MM, HALF_VOLUME_MM, (200, 3))
        pixels = [self.true_cameras[c.name].project(truth) for c in calibration.cameras]
        found = calibration.triangulate(*pixels, sigma_px=0.01).points_mm
        return float(1e3 * np.sqrt(((rigidly_aligned(found, truth) - truth) ** 2).mean()))

    def with_dots(self, dots: pd.DataFrame) -> Scene:
        """The same scene with another table of measured dots."""
        return replace(self, dots=dots)


def measured(
    exact: pd.DataFrame, sigma_px: float, rng: np.random.Generator, share: float, outlier_px: float
) -> tuple[pd.DataFrame, Any]:
    """The table with noise, a share of it displaced by ``outlier_px`` in a random direction."""
    dots = exact.copy()
    outlier = rng.random(len(dots)) < share
    angle = rng.uniform(0, 2 * np.pi, len(dots))
    jump = outlier_px * np.stack([np.cos(angle), np.sin(angle)], -1)
    noise = sigma_px * rng.standard_normal((len(dots), 2)) + outlier[:, None] * jump
    dots[["u_px", "v_px"]] = dots[["u_px", "v_px"]].to_numpy() + noise
    dots["suu_px2"] = dots["svv_px2"] = max(sigma_px, 1e-4) ** 2
    dots["suv_px2"] = 0.0
    return dots, outlier


def _nominal(rig: RigDescription) -> Any:
    """The nominal rotation of the second camera of a pair, or by camera for more."""
    nominal = rig.rotvec_from_first_deg
    return nominal if len(nominal) > 1 else next(iter(nominal.values()), None)


def make_scene(
    config: str | SimulationConfig = "paper",
    seed: int = 0,
    outlier_share: float = 0.0,
    outlier_px: float = 20.0,
    **changes: Any,
) -> Scene:
    """A scene from a preset (with changed fields) or a configuration; equal ones are one object."""
    settings = preset(config, **changes) if isinstance(config, str) else config
    key = pickle.dumps((settings, seed, outlier_share, outlier_px))
    if key not in _scenes:
        _scenes[key] = _new_scene(settings, seed, outlier_share, outlier_px)
    return _scenes[key]


_scenes: dict[bytes, Scene] = {}


def _new_scene(
    settings: SimulationConfig, seed: int, outlier_share: float, outlier_px: float
) -> Scene:
    scene_rng, noise_rng = np.random.default_rng(seed).spawn(2)
    cameras = dict(true_cameras(settings))
    target = true_target(settings, scene_rng)
    views = hand_held_views(settings, cameras, target, scene_rng)
    exact = exact_dots(settings, cameras, target, views)
    exact = exact[exact["inside"] == 1].reset_index(drop=True)
    dots, outlier = measured(exact, settings.sigma_px, noise_rng, outlier_share, outlier_px)
    rig = rig_description(settings, target)
    return Scene(
        dots,
        exact,
        outlier,
        list(nominal_cameras(rig)),
        rig.target,
        _nominal(rig),
        cameras,
        {v.name: v for v in views},
        dict(zip(target.ids.tolist(), target.points_mm)),
    )


@pytest.fixture(scope="session")
def scene() -> Callable[..., Scene]:
    """`make_scene`: scene("paper", seed, outlier_share=0.05, angle_deg=60.0, ...)."""
    return make_scene


@pytest.fixture(scope="module")
def without_advice() -> Iterator[None]:
    """Calibrations of this module propose no next view: a quarter of their time, or more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(self_calibration, "next_view", _no_view)
        yield


def _no_view(*_: object) -> None:
    return None


@pytest.fixture(scope="session")
def paper_images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The preset `paper` with images; read only."""

    def make(folder: Path) -> None:
        telerig.simulate("paper", rng=np.random.default_rng(11), out=folder)

    return made_once(tmp_path_factory, "paper", make)


@pytest.fixture
def paper_copy(paper_images: Path, tmp_path: Path) -> Path:
    """A copy of `paper_images` to spoil."""
    return Path(shutil.copytree(paper_images, tmp_path / "set"))


@pytest.fixture(scope="session")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of `batch_dataset` with all of its results; read only."""
    return made_once(tmp_path_factory, "tank", make_results)


@pytest.fixture
def tank_copy(tank: Path, tmp_path: Path) -> Path:
    """A copy of `tank` to spoil."""
    return Path(shutil.copytree(tank, tmp_path / "my tank"))


@pytest.fixture(scope="module")
def known_low_passes() -> Iterator[None]:
    """Smoothings of this module are given the bubbles' low-pass; to learn it takes seconds."""
    known = Inertia((0.001,) * 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(smooth, "learned_inertia", lambda _: known)
        yield


@pytest.fixture(scope="module")
def undrawn() -> Iterator[None]:
    """Pages of this module are written without their drawings, which take seconds."""
    with undrawn_pages():
        yield


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """An empty run of a dataset, at 100 frames a second."""
    (tmp_path / "rig.toml").write_text(RIG)
    folder = tmp_path / "runs" / "rise"
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text("frame_rate_hz = 100.0\nstart_s = 2.0\n")
    return folder


@pytest.fixture
def full_run(run_folder: Path) -> Path:
    """The same with six frames of both cameras."""
    write_images(run_folder / "left", LEFT)
    write_images(run_folder / "right", RIGHT)
    return run_folder
