"""The movement that was found, as numbers, in words, and as parts of results files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.bubbles.pairing.model import Finding
from telerig.estimator.rig_drift.movement import p_value_of
from telerig.estimator.rig_drift.ray_misses import Pair, offset_roll_pitch
from telerig.rig.pose import Pose
from telerig.rig.triangulation import POSE_COMPONENTS

if TYPE_CHECKING:
    from telerig.estimator.bubbles.pairing.model import PairModel
    from telerig.estimator.calibration.result.calibration import Calibration


FALSE_ALARM = 1e-4
"""Probability of reporting a movement if there is none."""

LATE_SIGMAS = 5.0
"""Cameras are said not to be synchronous if the delay exceeds so many standard deviations."""

_NOT_IDENTIFIED = 0.5
"""A rotation is not reported if its posterior standard deviation is larger than this share of the
prior one."""

_REFINE = ", or smooth the run with --refine-rig"


@dataclass(frozen=True)
class RigChange:
    """The movement of a camera relative to another, the first of a pair, since the calibration.

    camera : name of the camera.
    tangent, covariance : (6,), (6, 6) movement as a tangent of the pose rig_from_<camera>, with the
        components `POSE_COMPONENTS`; 0 in directions that ray misses do not identify.
    place_mm : (3,) mean position of the bubbles in the rig frame, to which the offset refers.
    values, sigmas, prior_sigmas : (3,) estimate, standard deviation and prior standard deviation of
        the offset along the common perpendicular (mm), the roll and the pitch (rad).
    chance : p-value of the hypothesis that nothing has moved.
    pairs : number of pairs used.
    refined : pose rig_from_<camera> that calibration and run give together, or None.
    against : name of the other camera.
    culprit : of more than two cameras the one that has moved, if all others agree; else "".
    late_s, slate_s : how much later it exposes than the other camera, and the standard deviation;
        nan if it was not estimated.
    """

    camera: str
    tangent: Array
    covariance: Array
    place_mm: Array
    values: Array
    sigmas: Array
    prior_sigmas: Array
    chance: float
    pairs: int
    refined: Pose | None = None
    against: str = ""
    culprit: str = ""
    late_s: float = float("nan")
    slate_s: float = float("nan")

    @property
    def moved(self) -> bool:
        """Whether calibration errors, shake and bubble shapes do not explain the ray misses."""
        return self.chance < FALSE_ALARM

    @property
    def unsynchronised(self) -> bool:
        """Whether the cameras do not expose at the same time."""
        return abs(self.late_s) > LATE_SIGMAS * self.slate_s

    def size_words(self) -> str:
        """Return the identifiable part of the movement in words, with standard deviations."""
        offset, *turns = zip(1e6 * self.values, 1e6 * self.sigmas)
        size = _rounded(offset[0] / 1000, offset[1] / 1000)
        text = f"by {size} µm perpendicular to both optical axes"
        identified = self.sigmas[1:] < _NOT_IDENTIFIED * self.prior_sigmas[1:]
        each = zip(("rolled", "pitched"), turns, identified)
        turned = [f"{name} by {_rounded(*turn)} µrad" for name, turn, known in each if known]
        return (
            ", ".join([text, *turned]) if turned else f"{text} (its rotations cannot be determined)"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the content of ``rig_change`` in smoothing.json and tracking.json."""
        names = ("offset_mm", "roll_rad", "pitch_rad")
        out: dict[str, Any] = {"camera": self.camera, "moved": self.moved, "chance": self.chance}
        out |= {"against": self.against, "culprit": self.culprit}
        out |= {n: float(v) for n, v in zip(names, self.values)}
        out |= {f"s{n}": float(s) for n, s in zip(names, self.sigmas)}
        if np.isfinite(self.late_s):
            out |= {"late_s": self.late_s, "slate_s": self.slate_s}
        out |= {
            "place_mm": self.place_mm.tolist(),
            "components": list(POSE_COMPONENTS),
            "tangent": self.tangent.tolist(),
            "covariance": self.covariance.tolist(),
            "pairs": self.pairs,
            "not_seen": "Shifts in the plane of both lines of sight and the angle between them "
            "cause no ray miss. They keep their calibrated values.",
        }
        if self.refined is not None:
            out["rig_from_camera"] = {
                "rotation": self.refined.rotation.tolist(),
                "translation_mm": self.refined.translation_mm.tolist(),
            }
        return out


def _rounded(value: float, sd: float) -> str:
    """Return value ± standard deviation as text, to two digits of the latter."""
    digits = max(0, 1 - math.floor(math.log10(sd))) if sd > 0 else 2
    return f"{value:+.{digits}f} ± {sd:.{digits}f}"


def rig_change_from(
    cameras: Pair,
    tangent: Array,
    covariance: Array,
    prior: Array,
    place_mm: Array,
    pairs: int,
    refined: Pose | None = None,
) -> RigChange:
    """Return a movement with offset, roll and pitch, from its tangent.

    tangent, covariance, prior : (6,), (6, 6), (6, 6) estimate, its covariance and the covariance of
        its prior.
    place_mm : (3,) point to which the offset refers.
    pairs, refined : see `RigChange`.
    """
    rows = offset_roll_pitch(cameras, place_mm)
    sigmas, priors = (np.sqrt(np.diagonal(rows @ c @ rows.T).clip(0)) for c in (covariance, prior))
    return RigChange(
        cameras[1].name, tangent, covariance, place_mm, rows @ tangent, sigmas, priors,
        p_value_of(tangent, covariance, prior), pairs, refined, cameras[0].name,
    )  # fmt: skip


def with_change(
    pairs: Mapping[tuple[int, int], PairModel],
    change: RigChange | None,
    calibration: Calibration,
    misplaced: tuple[int, float, float] | None = None,
) -> dict[str, Any]:
    """Return the part ``pairs`` of tracking.json.

    pairs : the statistics of each pair of cameras; of more than two cameras the numbers are those
    of the pair with the largest gaps. change : the estimated movement, or None. If a camera has
    moved, the sentence on this replaces the one on an offset of the calibration. misplaced : as in
    `RigModel`.
    """
    moved = change is not None and change.moved
    without = [Finding.CALIBRATION_OFFSET] if moved else []
    names = [camera.name for camera in calibration.cameras]
    words = [
        text if len(names) == 2 else f"{names[a]} and {names[b]}: {text}"
        for (a, b), own in pairs.items()
        for text in own.sentences(without)
    ]
    if change is not None and moved:
        unsure = "" if np.any(calibration.covariance) else " (or the calibration was never right)"
        words.append(
            f"Camera {change.camera!r} has moved against {change.against!r} since the "
            f"calibration{unsure}, {change.size_words()}. All positions are wrong because of this "
            f"movement. Calibrate again{_REFINE if len(names) == 2 or change.culprit else ''}."
        )
    if change is not None and change.unsynchronised:
        late = _rounded(1e3 * change.late_s, 1e3 * change.slate_s)
        words.append(
            f"Camera {change.camera!r} exposes {late} ms after {change.against!r}: positions of "
            "moving bubbles are off by up to the way that they move in this time, and ray misses "
            "are larger. Trigger both cameras by one signal, and compare their delays."
        )
    if change is not None and change.culprit:
        words.append(f"The other cameras agree, so it is {change.culprit!r} that has moved.")
    if misplaced is not None:
        camera, u, v = misplaced
        words.append(
            f"This is a calibration problem: the images of camera {names[camera]!r} lie {u:+.2f} "
            f"px in u and {v:+.2f} px in v from where the other cameras' points are expected in "
            "them. "
            "The grouping is not affected, but all positions are: calibrate the rig again."
        )
    problem = moved or misplaced is not None
    worst = max(pairs.values(), key=lambda own: own.gap_rms_px)
    return {
        "bias_px": worst.bias_px,
        "scatter_px": worst.scatter_px,
        "frame_px": worst.frame_px,
        "rms_px": worst.rms_px,
        "calibration_problem": problem or any(m.calibration_problem for m in pairs.values()),
        "words": words,
    }
