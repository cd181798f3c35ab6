"""A small dataset for commands, and the same with all of its results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from telerig.errors import TelerigError
from telerig.estimator.batch import batch
from telerig.estimator.batch.jobs import Job
from telerig.estimator.calibration import self_calibration
from telerig.estimator.smoothing import smooth
from telerig.factors.bubble_motion import Inertia
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.simulate import simulate
from telerig.scripts.main import app


def make_dataset(folder: Path, seed: int) -> Path:
    """A rig with 12 views as dots, a short run as detections with arm sensors: no images."""
    config = run_preset("rise", frames=24)
    config = replace(config, stage=replace(config.stage, accelerometers=("left", "right")))
    simulate(config, rng=np.random.default_rng(seed), out=folder, images=False)
    return folder


def outcome_here(job: Job) -> dict[str, Any]:
    """A job's result without a process of its own; to take the place of `batch._outcome`."""
    try:
        return batch.do_job(job)
    except TelerigError as error:
        return batch.failure(batch.FAILED, str(error))


def make_results(folder: Path) -> None:
    """The dataset with what `telerig batch` makes of it, whose own results are in ``batch/``.

    No next view is proposed, and the bubbles' low-pass is given: each takes seconds.
    """
    make_dataset(folder, 5)
    known = Inertia((0.001,) * 3)
    words = ["batch", str(folder), "--out", str(folder / "batch"), "--no-report", "--workers", "1"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "_outcome", outcome_here)
        patch.setattr(self_calibration, "next_view", lambda *_: None)
        patch.setattr(smooth, "learned_inertia", lambda _: known)
        done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    (folder / "batch" / "said.txt").write_text(done.output, encoding="utf-8")
