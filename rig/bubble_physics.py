"""Single bubbles in a liquid: dimensionless numbers, forces, and published laws of rise and shape.

All functions are pure, take SI units (m, m/s, kg/m^3, Pa s, N/m) and broadcast their arguments.
Gas has no viscosity here. `d` is the diameter of the sphere of equal volume; the aspect ratio is
that of a spheroid, equatorial over polar semi-axis, above 1 for an oblate one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.rig.units import STANDARD_GRAVITY_M_S2


@dataclass(frozen=True)
class Liquid:
    """Properties of a liquid, and of the gas in it.

    density, gas_density : kg/m^3
    viscosity : dynamic, Pa s
    surface_tension : N/m
    gravity : m/s^2.
    """

    density: float
    viscosity: float
    surface_tension: float
    gravity: float = STANDARD_GRAVITY_M_S2
    gas_density: float = 0.0

    @property
    def morton(self) -> float:
        """The Morton number g mu^4 (rho - rho_gas) / (rho^2 sigma^3)."""
        lift = self.gravity * (self.density - self.gas_density)
        return lift * self.viscosity**4 / (self.density**2 * self.surface_tension**3)

    def reynolds(self, d: ArrayLike, speed: ArrayLike) -> Array:
        """Return the Reynolds number rho U d / mu for the diameter d (m) and the speed U (m/s)."""
        return np.asarray(self.density * np.multiply(d, speed) / self.viscosity)

    def weber(self, d: ArrayLike, speed: ArrayLike) -> Array:
        """Return the Weber number rho U^2 d / sigma for the diameter d (m) and speed U (m/s)."""
        return np.asarray(self.density * np.multiply(d, np.square(speed)) / self.surface_tension)

    def eotvos(self, d: ArrayLike) -> Array:
        """Return the Eotvos number (rho - rho_gas) g d^2 / sigma for the diameter d (m)."""
        lift = self.gravity * (self.density - self.gas_density)
        return np.asarray(lift * np.square(d) / self.surface_tension)

    def terminal_drag(self, d: ArrayLike, speed: ArrayLike) -> Array:
        """Return the drag coefficient of a bubble that rises steadily: 4 g d / (3 U^2)."""
        lift = self.gravity * (1 - self.gas_density / self.density)
        return np.asarray(4 * lift * np.asarray(d) / (3 * np.square(speed)))


def added_mass(aspect: ArrayLike) -> tuple[Array, Array]:
    """Return the added-mass coefficients of a spheroid, along its pole and across it.

    They multiply the mass of the displaced liquid; 1/2 each for a sphere. Lamb, Hydrodynamics,
    sections 114 and 373: gamma / (2 - gamma) along the pole, where the integral gamma is
    (2/3) F(1, 1; 5/2; 1 - 1/aspect^2), for oblate and prolate spheroids alike; the three integrals
    of an ellipsoid add up to 2.
    """
    from scipy.special import hyp2f1

    gamma = hyp2f1(1.0, 1.0, 2.5, 1 - np.asarray(aspect, float) ** -2.0) * 2 / 3
    return np.asarray(gamma / (2 - gamma)), np.asarray((2 - gamma) / (2 + gamma))


def drag_coefficient(
    d: ArrayLike,
    slip: ArrayLike,
    acceleration: ArrayLike,
    up: ArrayLike,
    mass_coefficient: ArrayLike,
    liquid: Liquid,
) -> Array:
    """Return the drag coefficient (...) from the balance of forces along the slip velocity.

    Buoyancy less weight and drag accelerate the bubble's own and its added mass; a lift force acts
    across the slip and does not enter. With s the slip and e its direction,
    C_D = 4 d / (3 s^2) ((1 - rho_gas/rho) g up.e - (rho_gas/rho + C_A) a.e),
    the reference area being that of the sphere of equal volume. The liquid does not accelerate.

    slip, acceleration : (..., 3) of the bubble relative to the liquid.
    up : (3,) unit vector.
    mass_coefficient : (...) C_A of the body along the slip, see `added_mass`.
    """
    slip = np.asarray(slip, float)
    speed = np.linalg.norm(slip, axis=-1)
    along = slip / speed[..., None]
    ratio = liquid.gas_density / liquid.density
    lift = (1 - ratio) * liquid.gravity * (along @ np.asarray(up, float))
    inertia = (ratio + np.asarray(mass_coefficient)) * (along * acceleration).sum(-1)
    return np.asarray(4 * np.asarray(d) / (3 * speed**2) * (lift - inertia))


def wellek_aspect(eotvos: ArrayLike) -> Array:
    """Return the aspect ratio (equatorial over polar semi-axis) of contaminated bubbles and drops.

    The law is 1 + 0.163 Eo^0.757 (Wellek, Agrawal, Skelland, AIChE J. 12:854, 1966).

    eotvos : Eotvos number Eo.
    """
    return np.asarray(1 + 0.163 * np.asarray(eotvos, float) ** 0.757)


def mendelson_velocity(d: ArrayLike, liquid: Liquid) -> Array:
    """Return the rise velocity (m/s) by Mendelson's wave analogy (AIChE J. 13:250, 1967).

    It holds in water for bubbles of more than 1.3 mm. Smaller ones rise more slowly, because
    surface tension keeps them round.

    d : equivalent diameter in m.
    """
    d = np.asarray(d, float)
    wave = 2 * liquid.surface_tension / (liquid.density * d)
    return np.asarray(np.sqrt(wave + liquid.gravity * d / 2))


def clift_clean_velocity(d: ArrayLike, liquid: Liquid) -> Array:
    """Return the rise velocity (m/s) of bubbles of more than 1.3 mm in pure water.

    The law is eq. 7-3 of Clift, Grace, Weber, Bubbles, Drops and Particles, 1978.

    d : equivalent diameter in m.
    """
    d = np.asarray(d, float)
    wave = 2.14 * liquid.surface_tension / (liquid.density * d)
    return np.asarray(np.sqrt(wave + 0.505 * liquid.gravity * d))


_WATER_VISCOSITY_PA_S = 9e-4


def clift_velocity(d: ArrayLike, liquid: Liquid) -> Array:
    """Return the rise velocity (m/s) of contaminated bubbles and drops.

    The law is eqs 7-5 to 7-9 of Clift, Grace, Weber, Bubbles, Drops and Particles, 1978, for Morton
    numbers below 1e-3 and Eotvos numbers below 40. The result is NaN where the book's parameter H
    is below 2, because such small bubbles are round and the law does not hold.

    d : equivalent diameter in m.
    """
    d = np.asarray(d, float)
    ratio = (liquid.viscosity / _WATER_VISCOSITY_PA_S) ** -0.14
    h = 4 / 3 * liquid.eotvos(d) * liquid.morton**-0.149 * ratio
    j = np.where(h <= 59.3, 0.94 * h**0.757, 3.42 * h**0.441)
    speed = liquid.viscosity / (liquid.density * d) * liquid.morton**-0.149 * (j - 0.857)
    return np.where(h < 2, np.nan, speed)


def tomiyama_drag(reynolds: ArrayLike, eotvos: ArrayLike, contamination: str = "pure") -> Array:
    """Return the drag coefficient of a bubble in a pure, slightly or fully contaminated liquid.

    The law is that of Tomiyama, Kataoka, Zun, Sakaguchi, JSME Int. J. B 41:472, 1998.

    reynolds, eotvos : Reynolds and Eotvos numbers of the bubble.
    contamination : "pure", "slight" or "full". Raises KeyError for another word.
    """
    re, eo = np.asarray(reynolds, float), np.asarray(eotvos, float)
    factor, most = {"pure": (16, 48), "slight": (24, 72), "full": (24, np.inf)}[contamination]
    round_ = np.minimum(factor / re * (1 + 0.15 * re**0.687), most / re)
    return np.asarray(np.maximum(round_, 8 / 3 * eo / (eo + 4)))


def tomiyama_velocity(d: ArrayLike, liquid: Liquid, contamination: str = "pure") -> Array:
    """Return the rise velocity (m/s) at which `tomiyama_drag` balances buoyancy.

    d : equivalent diameter in m. contamination : as in `tomiyama_drag`.
    """
    d = np.asarray(d, float)

    def excess(speed: Array) -> Array:
        law = tomiyama_drag(liquid.reynolds(d, speed), liquid.eotvos(d), contamination)
        return np.asarray(law / liquid.terminal_drag(d, speed))

    return _terminal(excess, d)


def schiller_naumann_drag(reynolds: ArrayLike) -> Array:
    """Return the drag coefficient of a rigid sphere, and of a small contaminated bubble.

    The law is 24 / Re (1 + 0.15 Re^0.687) (Schiller and Naumann, Z. Ver. Dtsch. Ing. 77:318, 1933),
    for Reynolds numbers below 1,000; NaN beyond.

    reynolds : Reynolds number Re.
    """
    re = np.asarray(reynolds, float)
    return np.where(re < 1000, 24 / re * (1 + 0.15 * re**0.687), np.nan)


def moore_aspect_weber(aspect: ArrayLike) -> Array:
    """Return the Weber number at which a clean bubble has a given aspect ratio.

    The law is eq. 2.1 of Moore, J. Fluid Mech. 23:749, 1965, for high Reynolds numbers.

    aspect : equatorial over polar semi-axis, above 1.
    """
    x = np.asarray(aspect, float)
    root, angle = np.sqrt(x**2 - 1), np.arccos(1 / x)
    shape = (x**2 * angle - root) ** 2 / root**6
    return np.asarray(4 * x ** (-4 / 3) * (x**3 + x - 2) * shape)


def moore_drag(reynolds: ArrayLike, aspect: ArrayLike) -> Array:
    """Return the drag coefficient of a clean oblate bubble at high Reynolds number.

    It is (48 / Re) G (1 + H / sqrt(Re)) (Moore, J. Fluid Mech. 23:749, 1965), where G and H depend
    on the aspect ratio. H is the polynomial that Loth (Int. J. Multiphase Flow 34:523, 2008) fitted
    to Moore's table.

    reynolds : Reynolds number Re. aspect : equatorial over polar semi-axis, above 1.
    """
    x = np.maximum(np.asarray(aspect, float), 1 + 1e-4)
    root, angle = np.sqrt(x**2 - 1), np.arccos(1 / x)
    shape = x ** (4 / 3) * root**3 * (root - (2 - x**2) * angle) / (x**2 * angle - root) ** 2 / 3
    wake = np.polyval([0.0195, -0.2134, 1.7026, -2.1461, -1.5732], x)
    re = np.asarray(reynolds, float)
    return np.asarray(48 / re * shape * (1 + wake / np.sqrt(re)))


def moore_velocity(d: ArrayLike, liquid: Liquid) -> Array:
    """Return the rise velocity (m/s) of a clean bubble by `moore_drag` and `moore_aspect_weber`.

    The result is NaN where the Reynolds number is below 50 or the aspect ratio above 2.2, because
    Moore's theory does not hold there.

    d : equivalent diameter in m.
    """
    d = np.asarray(d, float)
    grid = np.linspace(1.001, 2.2, 400)
    weber = moore_aspect_weber(grid)

    def excess(speed: Array) -> Array:
        aspect = np.interp(liquid.weber(d, speed), weber, grid)
        law = moore_drag(liquid.reynolds(d, speed), aspect)
        return np.asarray(law / liquid.terminal_drag(d, speed))

    speed = _terminal(excess, d)
    beyond = (liquid.weber(d, speed) > weber[-1]) | (liquid.reynolds(d, speed) < 50)
    return np.where(beyond, np.nan, speed)


def _terminal(excess: Callable[[Array], Array], d: Array) -> Array:
    """Return by bisection the speeds at which drag over buoyancy, which grows with them, is 1."""
    low, high = np.full(d.shape, np.log(1e-5)), np.full(d.shape, np.log(3.0))
    for _ in range(60):
        middle = (low + high) / 2
        slow = excess(np.exp(middle)) < 1
        low, high = np.where(slow, middle, low), np.where(slow, high, middle)
    return np.asarray(np.exp((low + high) / 2))
