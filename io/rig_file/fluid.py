"""The liquid of [fluid] in rig.toml, or of a mapping with its keys, as laws of bubbles take it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError, suggestion
from telerig.io.rig_file.description import FluidDescription
from telerig.rig.bubble_physics import Liquid
from telerig.rig.units import STANDARD_GRAVITY_M_S2


def liquid_of(fluid: Any, gravity_m_s2: float = STANDARD_GRAVITY_M_S2) -> tuple[Liquid, Any] | None:
    """Return the liquid and its velocity in mm/s, or None where no liquid is described.

    The velocity is three numbers, a single upward one, or None for a liquid at rest.
    fluid : a `FluidDescription`, a mapping with its keys, or None.
    Raises InputError for a missing or unknown key and for a property that is not positive.
    """
    values = dict(fluid) if isinstance(fluid, Mapping) else vars(fluid) if fluid else {}
    if not values:
        return None
    known = [field.name for field in fields(FluidDescription)]
    for key in values:
        if key not in known:
            raise InputError(f"unknown key {key!r}", where="fluid", todo=suggestion(key, known))
    needed = ("density_kg_m3", "viscosity_pa_s", "surface_tension_n_m")
    for key in needed:
        value = values.get(key)
        if not isinstance(value, int | float | np.number) or not 0 < float(value) < np.inf:
            what = "is missing" if value is None else f"is {value!r}"
            raise InputError(what, where=f"fluid {key}", todo="give a positive number in SI units")
    density, viscosity, tension = (float(values[key]) for key in needed)
    gas = float(values.get("gas_density_kg_m3") or 0.0)
    if not 0 <= gas < density:
        todo = "give 0 or more, and less than that of the liquid"
        raise InputError(f"is {gas:g}", where="fluid gas_density_kg_m3", todo=todo)
    return Liquid(density, viscosity, tension, gravity_m_s2, gas), values.get("velocity_mm_s")


def liquid_velocity(velocity: Any, up: Array) -> Array:
    """Return the velocity (3,) of the liquid in mm/s, in rig axes.

    velocity : three numbers, one number (the upward velocity), or None for a liquid at rest. up :
    (3,) unit vector against gravity. Raises InputError for anything else.
    """
    if velocity is None:
        return np.zeros(3)
    value = np.asarray(velocity, float)
    if value.shape not in ((), (3,)) or not np.isfinite(value).all():
        todo = "give three numbers along the rig's axes, or one number upwards"
        raise InputError(f"is {velocity!r}", where="fluid velocity_mm_s", todo=todo)
    return np.asarray(value * up if value.shape == () else value)
