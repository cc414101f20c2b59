"""How a linear law is judged: its loop on the chain of integrators that the model leaves of the axis."""

import math
from typing import NamedTuple

HALVINGS = 60
LOWEST_RAD_S = 1e-6


class OpenLoop(NamedTuple):
    """The open loop as a fraction of polynomials in s, the highest power first."""

    hurwitz: bool  # stable without delay
    criterion: str  # what that asks for, in the names of the gains
    bandwidth_rad_s: float  # of the triple pole with the same gain for the position
    fastest_rad_s: float  # rate of what is explicit: times the sample time, it has a bound
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]


def cube_root(x: float) -> float:
    """The root of a number that is not negative."""
    return float(x ** (1.0 / 3.0))


def delay_margin(numerator: tuple[float, ...], denominator: tuple[float, ...]) -> float:
    """Dead time [s] at which a loop that is stable without any loses its phase margin."""
    low, high = LOWEST_RAD_S, 1.0 + sum(numerator)  # Cauchy's bound on the crossover
    for _ in range(HALVINGS):
        x = math.sqrt(low * high)
        top, bottom = at(numerator, x), at(denominator, x)
        if math.hypot(*top) > math.hypot(*bottom):
            low = x
        else:
            high = x
    x = math.sqrt(low * high)
    top, bottom = at(numerator, x), at(denominator, x)
    turned = math.pi + math.atan2(top[1], top[0]) - math.atan2(bottom[1], bottom[0])
    return max(0.0, math.remainder(turned, 2.0 * math.pi)) / x


def at(polynomial: tuple[float, ...], omega_rad_s: float) -> tuple[float, float]:
    """Real and imaginary part of a polynomial at jω; `complex` would raise for what is too large."""
    real = imaginary = 0.0
    for coefficient in polynomial:
        real, imaginary = coefficient - omega_rad_s * imaginary, omega_rad_s * real
    return real, imaginary
