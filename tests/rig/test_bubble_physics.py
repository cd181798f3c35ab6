"""Laws of single bubbles: closed forms against integrals and limits, correlations against data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from telerig.rig import bubble_physics as physics

WATER = physics.Liquid(998.2, 1.0e-3, 0.0728, 9.81)


@pytest.mark.parametrize("aspect", [0.2, 0.7, 1.0, 1.000001, 1.5, 3.0, 20.0])
def test_added_mass_is_that_of_lambs_integrals(aspect: float) -> None:
    polar2, equator2 = 1.0, aspect**2

    def integral(own: float) -> float:
        def inside(u: float) -> float:
            return 1 / ((own + u) * (equator2 + u) * np.sqrt(polar2 + u))

        value, _ = quad(inside, 0, np.inf, epsabs=1e-12, limit=200)
        return equator2 * value

    along, across = integral(polar2), integral(equator2)
    expected = (along / (2 - along), across / (2 - across))
    assert np.allclose(physics.added_mass(aspect), expected, rtol=1e-6)


def test_added_mass_of_a_sphere_a_disc_and_a_needle() -> None:
    assert np.allclose(physics.added_mass(1.0), 0.5, rtol=1e-14)
    # a disc of radius a moves 8/3 rho a^3 of liquid
    assert np.isclose(physics.added_mass(1e4)[0], 2e4 / np.pi, rtol=1e-3)
    along, across = physics.added_mass(1e-4)
    assert along < 1e-6 and np.isclose(across, 1.0, rtol=1e-4)


def test_a_bubble_that_rises_steadily_has_the_drag_of_its_terminal_velocity() -> None:
    d, speed, up = 3e-3, 0.25, np.array([0.0, -1.0, 0.0])
    found = physics.drag_coefficient(d, speed * up, np.zeros(3), up, 0.5, WATER)
    assert np.isclose(found, 4 * 9.81 * d / (3 * speed**2))
    # without drag it would gain g / C_A
    falling = physics.drag_coefficient(d, speed * up, 9.81 / 0.5 * up, up, 0.5, WATER)
    assert np.isclose(falling, 0.0, atol=1e-12)
    # lift, across the slip, does not enter
    turning = physics.drag_coefficient(d, speed * up, [5.0, 0.0, 3.0], up, 0.5, WATER)
    assert np.isclose(turning, found)


def test_gas_of_the_liquids_density_has_no_buoyancy() -> None:
    neutral = physics.Liquid(1000.0, 1e-3, 0.07, 9.81, gas_density=1000.0)
    up = np.array([0.0, -1.0, 0.0])
    assert physics.drag_coefficient(1e-3, 0.1 * up, np.zeros(3), up, 0.5, neutral) == 0


def test_numbers_of_water() -> None:
    assert np.isclose(WATER.morton, 2.55e-11, rtol=0.01)
    assert np.isclose(WATER.reynolds(2e-3, 0.3), 599, rtol=1e-3)
    assert np.isclose(WATER.eotvos(2.7e-3), 0.98, rtol=0.01)
    assert np.isclose(WATER.weber(1e-3, 0.27), 1.0, rtol=0.01)


def test_rise_velocities_in_water_are_near_the_measured_ones() -> None:
    # pure water: Duineveld, J. Fluid Mech. 292:325, 1995 (0.35 m/s at 1.8 mm, 0.26 at 1 mm);
    # contaminated: Clift et al., figure 7.3 (0.11 m/s at 1 mm, 0.23 at 4 to 6 mm)
    assert np.allclose(physics.moore_velocity([1e-3, 1.8e-3], WATER), [0.26, 0.35], rtol=0.05)
    assert np.isclose(physics.clift_velocity(1e-3, WATER), 0.11, rtol=0.1)
    assert np.allclose(physics.clift_velocity([4e-3, 6e-3], WATER), 0.235, rtol=0.06)
    for law in (physics.mendelson_velocity, physics.clift_clean_velocity):
        assert np.allclose(law(np.array([4e-3, 6e-3]), WATER), 0.235, rtol=0.05)
    assert np.isclose(physics.wellek_aspect(WATER.eotvos(4e-3)), 1.29, atol=0.01)


def test_large_bubbles_in_tomiyamas_law_follow_the_wave_analogy() -> None:
    d = np.array([3e-3, 5e-3, 1e-2])
    for contamination in ("pure", "slight", "full"):
        found = physics.tomiyama_velocity(d, WATER, contamination)
        assert np.allclose(found, physics.mendelson_velocity(d, WATER), rtol=1e-6)
    small = [float(physics.tomiyama_velocity(4e-4, WATER, c)) for c in ("pure", "slight", "full")]
    assert small[0] > small[1] >= small[2]


def test_drag_of_spheres_is_stokes_at_creep_and_the_standard_curve_above() -> None:
    """The standard drag curve has 1.09 at Re = 100 and 0.46 at Re = 1000 (Clift et al., 1978)."""
    assert np.isclose(physics.schiller_naumann_drag(1e-4), 24e4, rtol=1e-3)
    found = physics.schiller_naumann_drag([100.0, 999.0, 1000.0])
    assert np.allclose(found[:2], [1.09, 0.46], rtol=0.05) and np.isnan(found[2])


def test_moores_drag_of_a_sphere_is_levichs() -> None:
    found = physics.moore_drag(400.0, 1.0)
    assert np.isclose(found, 48 / 400 * (1 - 2.211 / np.sqrt(400)), rtol=1e-3)
    assert physics.moore_drag(400.0, 2.0) > 2 * found
    # We(chi) of small deformations: chi = 1 + 9/64 We
    assert np.isclose(physics.moore_aspect_weber(1.01), 0.01 * 64 / 9, rtol=0.02)


def test_laws_say_where_they_do_not_hold() -> None:
    assert np.isnan(physics.clift_velocity(3e-4, WATER))
    assert np.isnan(physics.moore_velocity(5e-3, WATER))
    with pytest.raises(KeyError):
        physics.tomiyama_velocity(1e-3, WATER, "dirty")
