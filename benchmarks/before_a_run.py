"""`telerig doctor RUN` on sound recordings and on recordings with one planted trouble each.

    python benchmarks/before_a_run.py --out FOLDER [--sound 10] [--first SEED]

Prints for every recording which checks failed, and for sound recordings with several kinds of
sensors the verdict that was expected from their first half beside that of the whole. The exit code
is 1 if a trouble is not named or a sound recording has a failure.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

import telerig
from telerig.command_options import CalibrationOptions
from telerig.estimator.batch.work import calibrate_dataset
from telerig.estimator.doctor.recording import Recording, check_recording
from telerig.io.dataset.run import load_run
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.simulate import simulate

Image = NDArray[Any]
FRAMES, RATE_HZ, WHITE = 400, 1000 / 3, 255
LATE = 1  # frames, 3 ms


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--out", type=Path, required=True)
    options.add_argument("--sound", type=int, default=10)
    options.add_argument("--first", type=int, default=1)
    given = options.parse_args()
    first, wrong, agreed = given.first, 0, 0
    for seed in range(first, first + given.sound):
        recording = examined(recorded(given.out / f"sound{seed}", seed))
        wrong += bool(report(f"sound {seed}", recording))
    base = given.out / f"sound{first}"
    for name, (plant, expected) in TROUBLES.items():
        place = given.out / name.replace(" ", "_").replace("/", "")
        if plant is None:
            recorded(place, first, shake_mm=2.0, shake_hz=31.0)
        elif not place.exists():
            shutil.copytree(base, place)
            plant(place / "runs" / "rise", np.random.default_rng(first))
        failed = report(name, examined(place))
        wrong += not any(expected in what for what in failed)
    for name, sensors in SENSORS.items():
        place = recorded(given.out / name.replace(" ", "_"), first, images=False, **sensors)
        run = load_run(place / "runs" / "rise")
        calibration = telerig.load_calibration(place / "results" / "calibration")
        seconds = float(np.ptp(run.t_s))
        half = check_recording(run.first(FRAMES // 2), calibration, seconds=seconds)
        tracks = telerig.track(run, calibration)
        whole = telerig.smooth(tracks, calibration, stage=run).verdict["verdict"]
        expected = "" if half.expected is None else str(half.expected)
        agreed += expected == whole
        print(f"{name:32}expected {expected:12} of the whole {whole}", flush=True)
    print(f"{wrong} wrong; {agreed} of {len(SENSORS)} expected verdicts are those of the whole")
    return int(wrong > 0)


def recorded(place: Path, seed: int, images: bool = True, **changes: Any) -> Path:
    """Return a simulated and calibrated dataset; changes : of the stage, and ``bubbles``."""
    if (place / "results" / "calibration" / "calibration.json").is_file():
        return place
    base = run_preset("rise")
    bubbles = changes.pop("bubbles", 4)
    table = replace(base.table, references=changes.pop("references", 0))
    stage = replace(base.stage, **({"accelerometers": ("left", "right")} | changes))
    config = replace(
        base, frames=FRAMES, frame_rate_hz=RATE_HZ, bubbles=bubbles, stage=stage, table=table,
        bubble=replace(base.bubble, d_eq_mm=(3.0, 4.0)),
        motion=replace(base.motion, spread=(0.3, 0.3)),
    )  # fmt: skip
    simulate(config, rng=np.random.default_rng(seed), out=place, images=images)
    folder = place / "results" / "calibration"
    calibrate_dataset(place, folder, CalibrationOptions(), again="", report=False)
    return place


def examined(place: Path) -> Recording:
    calibration = telerig.load_calibration(place / "results" / "calibration")
    return check_recording(load_run(place / "runs" / "rise"), calibration)


def report(name: str, recording: Recording) -> list[str]:
    """Print what failed, and return the names of these checks."""
    failed = [check for check in recording.checks if check.status == "failure"]
    print(f"{name:32}{'; '.join(f'{c.what}: {c.words}' for c in failed) or 'sound'}", flush=True)
    return [check.what for check in failed]


def images(change: Callable[[Image], Image], camera: str = "*") -> Callable[[Path, Any], None]:
    """Return a function that changes all images of a run."""

    def plant(run: Path, rng: np.random.Generator) -> None:
        for path in sorted(run.glob(f"{camera}/*.tif")):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.clip(change(image.astype(float)), 0, WHITE).astype(np.uint8))

    return plant


def uneven(image: Image) -> Image:
    return image * np.linspace(0.3, 1.1, image.shape[1])


def turned(image: Image) -> Image:
    middle = ((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2)
    turn = cv2.getRotationMatrix2D(middle, 0.2, 1.0)
    return cv2.warpAffine(
        image, turn, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def late(run: Path, rng: np.random.Generator) -> None:
    """The right camera's images are those of the frame after."""
    paths = sorted(run.glob("right/*.tif"))
    for path, after in zip(paths, paths[LATE:]):
        shutil.copyfile(after, path)
    for path in paths[-LATE:]:
        path.unlink()


def dropped(run: Path, rng: np.random.Generator) -> None:
    for path in rng.choice(sorted(run.glob("right/*.tif")), FRAMES // 100, replace=False):
        Path(path).unlink()


def doubled(run: Path, rng: np.random.Generator) -> None:
    paths = sorted(run.glob("left/*.tif"))
    for k in rng.choice(np.arange(1, FRAMES), 4, replace=False):
        shutil.copyfile(paths[k - 1], paths[k])


def readings(change: Callable[[pd.DataFrame], pd.DataFrame]) -> Callable[[Path, Any], None]:
    def plant(run: Path, rng: np.random.Generator) -> None:
        path = run / "accelerometer.csv"
        change(pd.read_csv(path)).to_csv(path, index=False)

    return plant


def dead(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(ay_m_s2=table["ay_m_s2"].where(table["sensor"] != "arm_right", 0.0))


def in_g(table: pd.DataFrame) -> pd.DataFrame:
    columns = ["ax_m_s2", "ay_m_s2", "az_m_s2"]
    return table.assign(**{name: table[name] / 9.80665 for name in columns})


TROUBLES: dict[str, tuple[Callable[[Path, Any], None] | None, str]] = {
    "dim": (images(lambda image: 0.15 * image), "light"),
    "saturated": (images(lambda image: 1.6 * image), "saturation"),
    "uneven": (images(uneven), "evenness"),
    "defocused": (images(lambda image: cv2.GaussianBlur(image, (0, 0), 4.0), "left"), "focus"),
    "right camera 3 ms late": (late, "synchrony"),
    "1 % of frames dropped": (dropped, "missing"),
    "doubled frames": (doubled, "doubled"),
    "dead axis": (readings(dead), "sensors"),
    "g for m/s2": (readings(in_g), "sensors"),
    "shake of 2 mm at 31 Hz": (None, "shake"),
    "camera turned by 0.2 degrees": (images(turned, "right"), "cameras since"),
}

SENSORS: dict[str, dict[str, Any]] = {
    "arms": {},
    "arms and one bubble": {"bubbles": 1},
    "encoder": {"accelerometers": ()},
    "encoder and ten bubbles": {"accelerometers": (), "bubbles": 10},
    "carriage": {"accelerometers": ("carriage",)},
    "left arm": {"accelerometers": ("left",)},
    "marks": {"accelerometers": (), "references": 4},
    "marks and arms": {"references": 4},
    "arms, shake at 25 Hz": {"shake_hz": 25.0, "shake_mm": 0.1},
    "encoder, small shake": {"accelerometers": (), "shake_mm": 0.01},
}

if __name__ == "__main__":
    sys.exit(main())
