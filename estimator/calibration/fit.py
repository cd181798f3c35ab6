"""Everything that a finished self-calibration knows, before it is put into words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.lens.choice import Choice
from telerig.estimator.calibration.quality.checks import PreCheck
from telerig.estimator.calibration.solver.robust import RobustFit
from telerig.rig.lens_models import joint_name

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """A finished self-calibration.

    models : the chosen one of each camera.  choice : None when they were given.
    centre_held : the cameras' poses with the image centres held, when perspective frees them.
    """

    robust: RobustFit
    twin_cost: float
    twin_by: str
    twin_words: str
    models: tuple[str, ...]
    model_words: str
    choice: Choice | None
    centre_held: Array | None
    pre: PreCheck
    notes: tuple[str, ...]

    @property
    def model(self) -> str:
        """In one name."""
        return joint_name(self.models, [c.name for c in self.robust.problem.cameras])
