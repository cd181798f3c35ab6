"""A small dataset for batches."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.simulate import simulate


def make_dataset(folder: Path, seed: int) -> Path:
    """A rig with 12 views as dots, a short run as detections with arm sensors: no images."""
    config = run_preset("rise", frames=15)
    config = replace(config, stage=replace(config.stage, accelerometers=("left", "right")))
    simulate(config, rng=np.random.default_rng(seed), out=folder, images=False)
    return folder
