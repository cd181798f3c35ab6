"""Defines units that are given by a number. Every conversion uses the constant from here."""

from __future__ import annotations

STANDARD_GRAVITY_M_S2 = 9.80665
"""The unit g in m/s^2, exact by definition (3rd General Conference on Weights and Measures, 1901).

A sensor that reads in g uses this value everywhere on Earth. The local gravity of a laboratory
differs from it by up to 0.03 m/s^2 and is given in rig.toml, `[stage] gravity_m_s2`.
"""

MICRO_G_M_S2 = 1e-6 * STANDARD_GRAVITY_M_S2
"""The unit of noise densities in data sheets."""

ACCELERATION_UNITS = {
    "m/s^2": 1.0,
    "g": STANDARD_GRAVITY_M_S2,
    "mg": STANDARD_GRAVITY_M_S2 / 1000,
    "mm/s^2": 0.001,
    "cm/s^2": 0.01,
    "ft/s^2": 0.3048,
}
"""The units in which accelerometers may be read, and the size of each in m/s^2."""
