"""The mirror twin: two rigs with the same pixels, and what decides between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.projection import State
from telerig.rig.pose import rotation_from_rotvec, rotvec_from_rotation
from telerig.rig.projection import INDEX

Array = NDArray[np.float64]
_KAPPA = INDEX["kappa_per_mm"]
_D = np.diag([1.0, 1.0, -1.0, 1.0])

ENTOCENTRIC = 0.01
"""kappa * rho beyond which a lens is a perspective one: no telecentric lens errs by 0.6 degrees."""
TIE_DEG = 10.0


@dataclass(frozen=True)
class TwinDecision:
    """Which twin was kept and why; angles are between each twin and the nominal rotation."""

    chosen_cost: float
    other_cost: float
    decided_by: str
    sentence: str
    chosen_rotvec_deg: tuple[float, ...]
    other_rotvec_deg: tuple[float, ...]


def twin_state(state: State) -> State:
    """The twin: D R D and D t for every pose, D X for every dot, -kappa for every camera."""
    intrinsics = state.intrinsics.copy()
    intrinsics[:, _KAPPA] *= -1
    cameras, views = (_D @ m @ _D for m in (state.rig_from_camera, state.rig_from_target))
    return State(intrinsics, cameras, views, state.dots_mm * [1.0, 1.0, -1.0])


def second_from_first(state: State) -> Array:
    """(3, 3) rotation."""
    return np.asarray(state.rig_from_camera[1, :3, :3].T)


def angle_to_nominal_deg(state: State, nominal_rotvec_deg: Array) -> float:
    """Angle between the inter-camera rotation of a state and the nominal one."""
    nominal = rotation_from_rotvec(np.radians(nominal_rotvec_deg))
    turn = rotvec_from_rotation(second_from_first(state) @ nominal.T)
    return float(np.degrees(np.linalg.norm(turn)))


def entocentric_sign(state: State, problem: Problem) -> int:
    """+1 or -1 when perspective is so strong that only one sign of kappa is possible, else 0."""
    strength = state.intrinsics[:, _KAPPA] * np.array(problem.rho_mm)
    if np.all(strength > ENTOCENTRIC):
        return 1
    if np.all(strength < -ENTOCENTRIC):
        return -1
    return 0


def choose_twin(
    state: State, problem: Problem, nominal_rotvec_deg: Array | None
) -> tuple[State, str, str]:
    """(state on the right side, what decided, in words).

    Raises CalibrationError when the two twins are alike far from the nominal rotation, when
    nothing decides, or when nominal rotation and perspective contradict each other.
    """
    other = twin_state(state)
    perspective = entocentric_sign(state, problem)
    nearest = None
    if nominal_rotvec_deg is not None:
        angles = [angle_to_nominal_deg(s, nominal_rotvec_deg) for s in (state, other)]
        margin = abs(angles[0] - angles[1])
        nearest = int(np.argmin(angles))
        if margin < TIE_DEG and perspective == 0:
            raise CalibrationError(
                f"the two mirror twins are {angles[0]:.0f} and {angles[1]:.0f} degrees from the "
                "nominal rotation: too alike to choose",
                where="rig.toml [stereo]",
                todo="correct the nominal second_from_first_rotvec_deg to within 20 degrees",
            )
        words = (
            f"the nominal rotation in rig.toml: {angles[nearest]:.1f} degrees from the kept twin, "
            f"{angles[1 - nearest]:.1f} from the other"
        )
        if perspective and margin >= TIE_DEG and (perspective > 0) != (nearest == 0):
            raise CalibrationError(
                "the nominal rotation puts the second camera on one side, the perspective of the "
                f"lenses on the other ({words}); farther dots are smaller only in the twin that "
                "the nominal rotation rejects",
                where="rig.toml [stereo]",
                todo="check the sign of second_from_first_rotvec_deg",
            )
        if not perspective:
            return (state, other)[nearest], "nominal rotation", words
    if perspective:
        kept = state if perspective > 0 else other
        return kept, "perspective", "the lenses' perspective: farther dots are smaller"
    raise CalibrationError(
        "nothing says on which side the second camera stands: both mirror twins fit alike",
        where="rig.toml [stereo]",
        todo="add the nominal second_from_first_rotvec_deg, 20 degrees is near enough",
    )
