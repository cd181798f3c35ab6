"""Background: both layers of a moving rig, against scenes of which all is known."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from telerig.errors import DetectionError, InputError
from telerig.estimator.bubbles.background.from_run import Background, estimate_background

Array = NDArray[np.float64]

WIDTH, HEIGHT = 320, 200
LEVEL = 170.0


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], scale: float) -> Array:
    """Unit standard deviation."""
    out = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), scale)
    return np.asarray(out / out.std(), float)


def dirt(rng: np.random.Generator, shape: tuple[int, int], count: int) -> Array:
    """A factor below 1: specks of 2 to 8 px with soft edges."""
    out = np.zeros(shape)
    v, u = np.mgrid[: shape[0], : shape[1]]
    for _ in range(count):
        at = rng.uniform([0, 0], shape)
        radius = rng.uniform(2, 8)
        r = np.hypot(v - at[0], u - at[1])
        out = np.maximum(
            out, rng.uniform(0.1, 0.5) / (1 + np.exp(np.minimum(r - radius, 50) / 0.8))
        )
    return np.asarray(1 - out)


@dataclass
class Scene:
    """A run whose layers are known; the lab's texture is read by Fourier shift, exactly.

    followed : whether a bubble stays in the middle.  busy : how many others rise through.
    """

    frames: int = 80
    seed: int = 0
    size: tuple[int, int] = (HEIGHT, WIDTH)
    travel_px: float = 270.0
    sideways_px: float = 0.0
    texture: float = 0.03
    flicker: float = 0.02
    noise: float = 0.008
    followed: bool = True
    wobble_px: float = 6.0
    busy: int = 6
    bits: int = 8

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        height, width = self.size
        v, u = np.mgrid[:height, :width].astype(float)
        x, y = (u - width / 2) / width, (v - height / 2) / width
        self.rig = 1 - 0.5 * x**2 - 0.7 * y**2 + 0.1 * x - 0.08 * y
        self.rig *= dirt(rng, self.size, 12)
        t = np.arange(self.frames)
        travel = self.travel_px * t / max(self.frames - 1, 1)
        shake = 1.5 * np.sin(0.7 * t)
        self.shift = np.stack(
            [self.sideways_px * t / self.frames, travel + shake * (travel > 0)], 1
        )
        tall = height + int(np.ceil(self.shift[:, 1].max())) + 80
        wide = width + int(np.ceil(self.shift[:, 0].max())) + 80
        texture = self.texture * smooth_noise(rng, (tall, wide), 3.0)
        self.lab = (1 + texture) * dirt(rng, (tall, wide), tall // 20)
        self.gain = 1 + self.flicker * rng.standard_normal(self.frames)
        self.middle = np.array([width / 2, height / 2]) + self.wobble_px * np.stack(
            [np.sin(0.5 * t + 0.3), np.cos(0.37 * t)], 1
        )
        self.others = rng.uniform(0, [width, 2 * height], (self.busy, 2))
        self.speed = rng.uniform(-2, 2, (self.busy, 2)) + [0, 3]
        self.rng = rng

    def bubbles(self, frame: int) -> Array:
        """(H, W) share of the light that passes."""
        height, width = self.size
        places = [*((self.others + frame * self.speed) % [width, 2 * height])]
        radii = [12.0 + k % 9 for k in range(self.busy)]
        if self.followed:
            places.append(self.middle[frame])
            radii.append(28.0)
        out = np.ones(self.size)
        for (pu, pv), radius in zip(places, radii):
            reach = int(1.5 * radius)
            top, left = max(int(pv) - reach, 0), max(int(pu) - reach, 0)
            part = out[top : int(pv) + reach, left : int(pu) + reach]
            v, u = np.mgrid[: part.shape[0], : part.shape[1]]
            r = np.hypot(u + left - pu, v + top - pv) / radius
            disc = 1 / (1 + np.exp((r - 1) * radius / 0.8))
            heart = 0.7 * np.exp(-((r / 0.35) ** 2))
            part *= 1 - disc * (0.9 - heart)
        return out

    def level(self, shift: Any) -> Array:
        """(H, W) the truth at gain 1."""
        height, width = self.size
        shift_v, shift_u = float(shift[1]), float(shift[0])
        row, column = int(np.floor(shift_v)), int(np.floor(shift_u))
        window = self.lab[row : row + height + 40, column : column + width + 40]
        part = np.fft.rfft2(np.pad(window, ((40, 0), (40, 0)), mode="reflect"))
        f_v = np.fft.fftfreq(window.shape[0] + 40)[:, None]
        f_u = np.fft.rfftfreq(window.shape[1] + 40)[None]
        part = part * np.exp(2j * np.pi * (f_v * (shift_v - row) + f_u * (shift_u - column)))
        moved = np.fft.irfft2(part, s=(window.shape[0] + 40, window.shape[1] + 40))
        return LEVEL * self.rig * moved[40 : 40 + height, 40 : 40 + width]

    def image(self, frame: int) -> NDArray[Any]:
        level = self.level(self.shift[frame]) * self.gain[frame] * self.bubbles(frame)
        level = level * (1 + self.noise * np.random.default_rng(frame).standard_normal(self.size))
        scale = 1 if self.bits == 8 else (1 << self.bits) / 256
        kind = np.uint8 if self.bits == 8 else np.uint16
        return np.clip(np.rint(level * scale), 0, (1 << self.bits) - 1).astype(kind)

    def relative_error(self, background: Background, frame: int) -> Array:
        """(H, W) of the level, after one factor for the frame."""
        ratio = background.of_frame(frame) / self.level(self.shift[frame])
        return np.asarray(ratio / np.median(ratio) - 1)

    def always_covered(self) -> NDArray[np.bool_]:
        return np.max([self.bubbles(k) for k in range(self.frames)], axis=0) < 0.9


def estimated(scene: Scene, **options: Any) -> Background:
    return estimate_background(scene.image, scene.frames, shift_px=scene.shift, **options)


def errors(scene: Scene, background: Background) -> tuple[Array, Array]:
    """Of frames that were not sampled: outside the pixels that are always hidden, and there."""
    hidden = scene.always_covered()
    used = set(background.frames.tolist())
    middle = range(scene.frames // 5, scene.frames * 4 // 5, 7)
    maps = np.array([scene.relative_error(background, k) for k in middle if k not in used])
    return maps[:, ~hidden], maps[:, hidden]


SCENES = {
    "screen stays behind": Scene(),
    "screen comes along": Scene(travel_px=0, texture=0),
    "nothing followed": Scene(followed=False),
    "almost no wobble": Scene(wobble_px=1),
    "strong texture": Scene(texture=0.08),
    "12 bit, aslant": Scene(bits=12, sideways_px=60),
}


@pytest.mark.parametrize("name", SCENES)
def test_level_within_half_a_percent(name: str) -> None:
    scene = SCENES[name]
    background = estimated(scene)
    free, hidden = errors(scene, background)
    assert np.sqrt(np.mean(free**2)) < 0.006
    assert np.median(np.abs(free)) < 0.003 and np.quantile(np.abs(free), 0.95) < 0.008
    if hidden.size:
        bound = 0.01 if scene.texture < 0.05 else 0.02
        assert np.sqrt(np.mean(hidden**2)) < bound
    assert background.noise == pytest.approx(scene.noise, rel=0.25)


def test_hidden_pixels_are_marked_and_dirt_is_not() -> None:
    scene = Scene()
    background = estimated(scene)
    hidden = scene.always_covered()
    assert background.covered[hidden].mean() > 0.99
    near = cv2.dilate(hidden.astype(np.uint8), np.ones((25, 25), np.uint8)).astype(bool)
    assert not background.covered[~near].any(), "dirt that stays is background"


def test_the_lab_layer_is_worth_it() -> None:
    scene = Scene(texture=0.08)
    with_lab, _ = errors(scene, estimated(scene))
    without, _ = errors(scene, estimate_background(scene.image, scene.frames))
    assert with_lab.std() < 0.15 * without.std()


def test_black_things_on_the_tank_leave_the_level_positive() -> None:
    """Splines through the edge of a black tape are negative beside it."""
    scene = Scene()
    scene.lab[60:110, :80] = scene.lab[250:300, :80] = 1e-3
    background = estimated(scene)
    assert min(background.of_frame(k).min() for k in range(0, scene.frames, 9)) > 0


def test_missing_frames_and_unknown_shifts_are_passed_over() -> None:
    scene = Scene(frames=60)
    shift = scene.shift.copy()
    shift[:10] = np.nan
    background = estimate_background(
        lambda k: None if k % 3 == 0 else scene.image(k),
        scene.frames,
        shift_px=shift,
        max_frames=20,
    )
    assert len(background.frames) == 20
    assert background.frames.min() >= 10 and np.all(background.frames % 3 != 0)
    np.testing.assert_array_equal(background.at((np.nan, 0.0)), background.rig_level)


def test_uneven_sampling() -> None:
    """Even spacing would hide every texture with the period of the spacing."""
    scene = Scene(frames=400, size=(64, 64), followed=False, busy=0)
    gaps = np.diff(estimated(scene).frames)
    assert len(set(gaps.tolist())) > 5 and gaps.max() < 3 * gaps.mean()


def test_a_single_image() -> None:
    scene = Scene(travel_px=0, texture=0)
    background = estimate_background(lambda _: scene.image(7), 1)
    error = np.abs(scene.relative_error(background, 7))
    clean = scene.rig / cv2.blur(scene.rig, (61, 61)) > 0.97
    assert np.median(error[clean & (scene.bubbles(7) > 0.99)]) < 0.01
    assert np.median(error[clean & (scene.bubbles(7) < 0.5)]) < 0.03
    assert background.covered[scene.bubbles(7) < 0.5].mean() > 0.98


def test_too_few_frames_give_a_smooth_surface() -> None:
    scene = Scene(frames=2, travel_px=0, texture=0)
    background = estimated(scene)
    assert len(background.frames) == 2 and background.lab_factor is None


def test_a_single_frame_tells_the_level_behind_its_bubbles() -> None:
    """The broad mean of the screen alone is off by 1.5 % here."""
    v, u = np.mgrid[:400, :600].astype(float)
    screen = 180.0 * (1.0 + 0.3 * (u - 300.0) / 600.0)
    behind = (u - 200.0) ** 2 + (v - 150.0) ** 2 < 30.0**2
    image = np.where(behind, 0.2, 1.0) * screen + np.random.default_rng(0).normal(0, 1.5, v.shape)
    found = estimate_background(lambda _: image.round().astype(np.uint8), 1)
    assert np.abs(found.rig_level / screen - 1.0)[behind].max() < 0.002
    assert found.covered[behind].all() and found.covered.mean() < 0.05


def test_refusals() -> None:
    with pytest.raises(DetectionError, match="no frame can be used"):
        estimate_background(lambda k: None, 5)
    with pytest.raises(InputError, match="differ in size"):
        estimate_background(lambda k: np.ones((40, 40 + k % 2), np.uint8), 5)
    with pytest.raises(InputError, match=r"give \(5, 2\)"):
        estimate_background(lambda k: np.ones((40, 40), np.uint8), 5, shift_px=np.zeros((4, 2)))


def test_large_images_are_fast_enough_to_normalise() -> None:
    lab = np.ones((3000, 1280), np.float32)
    level = np.full((800, 1280), 170, np.float32)
    background = Background(level, np.zeros((800, 1280), bool), lab)
    start = time.process_time()
    for k in range(20):
        background.at((0.0, 100.3 + k))
    assert (time.process_time() - start) / 20 < 0.03
