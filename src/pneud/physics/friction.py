"""Friction of piston and rod seals: LuGre bristles with a Stribeck curve."""

import math
from typing import NamedTuple

from pneud.physics.series import decay

NO_FRICTION_N = 1e-6  # dry friction below this is none: its bristles would relax infinitely fast


class Friction(NamedTuple):
    """Parameters of the LuGre model."""

    coulomb_n: float
    static_n: float
    stribeck_m_s: float
    viscous_n_s_m: float
    sigma0_n_m: float  # bristle stiffness
    sigma1_n_s_m: float  # bristle damping


def stribeck(v: float, f: Friction) -> float:
    """Magnitude g(v) [N] of dry friction in steady sliding at velocity v [m/s]."""
    ratio = v / f.stribeck_m_s
    return f.coulomb_n + (f.static_n - f.coulomb_n) * math.exp(-ratio * ratio)


def relaxation_rate(v: float, f: Friction) -> float:
    """Rate a = σ0|v|/g(v) [1/s] in ż = v − a z; negative where there is no dry friction."""
    if f.sigma0_n_m <= 0.0:
        return -1.0
    dry = stribeck(v, f)
    if dry < NO_FRICTION_N:
        return -1.0
    return f.sigma0_n_m * abs(v) / dry


def friction_force(v: float, z: float, f: Friction) -> float:
    """Friction force [N] against the motion, σ0 z + σ1 ż + σ2 v (Canudas de Wit et al., 1995).

    Args:
        v: velocity [m/s].
        z: mean deflection of the bristles [m].
        f: parameters.
    """
    a = relaxation_rate(v, f)
    if a < 0.0:
        return f.viscous_n_s_m * v
    return f.sigma0_n_m * z + f.sigma1_n_s_m * (v - a * z) + f.viscous_n_s_m * v


def slide(
    v: float, z: float, guess: float, force_n: float, mass_kg: float, h: float, f: Friction
) -> tuple[float, float]:
    """Mean velocity [m/s] over a step and bristle deflection [m] at its end, under a force held constant.

    The bristles follow their exact solution for the mean velocity, the mass the implicit midpoint rule:
    second order, and stable for any stiffness, damping and speed. The velocity at the end of the step is
    2·mean − v.

    Args:
        v: velocity at the start [m/s].
        z: bristle deflection at the start [m].
        guess: velocity expected in the middle of the step, for the bristles' relaxation rate [m/s].
        force_n: mean of all other forces over the step [N].
        mass_kg: moving mass.
        h: step [s].
        f: parameters.
    """
    gain = 0.5 * h / mass_kg
    a = relaxation_rate(guess, f)
    if a < 0.0:
        return (v + gain * force_n) / (1.0 + gain * f.viscous_n_s_m), 0.0
    left, away = decay(a * h)
    # over the step: mean z = left z + h away mean, mean ż = left (mean − a z)
    mean = (v + gain * (force_n - left * z * (f.sigma0_n_m - f.sigma1_n_s_m * a))) / (
        1.0 + gain * (f.sigma0_n_m * (h * away) + f.sigma1_n_s_m * left + f.viscous_n_s_m)
    )
    return mean, z + h * left * (mean - a * z)
