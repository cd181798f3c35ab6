"""Units that are defined by a number: one constant of each, used by all that convert."""

from __future__ import annotations

STANDARD_GRAVITY_M_S2 = 9.80665
"""The unit g in m/s^2, exact (3rd General Conference on Weights and Measures, 1901).

It is what a sensor's g means, everywhere. A laboratory's own gravity differs from it by up to
0.03 m/s^2 and stands in rig.toml, `[stage] gravity_m_s2`.
"""
