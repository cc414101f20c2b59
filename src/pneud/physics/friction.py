"""Friction of piston and rod seals: LuGre bristles with a Stribeck curve."""

from __future__ import annotations

import math
from typing import NamedTuple


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
