"""Motions that tell a rig's parameters, as data: what a commissioning asks for, and what each is for.

Places and amplitudes are shares of the travel, so that they suit every axis.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from pneud.study.identification import parameters as key


class Motion(NamedTuple):
    """One of them."""

    kind: Literal["rest", "ramp", "step", "sine", "moves"]
    tells: tuple[str, ...]
    seconds: float
    places: tuple[float, ...] = ()  # where, or from one to the next
    amplitude: float = 0.0  # of a sine
    frequency_hz: float = 0.0
    speed_m_s: float = 0.0  # of moves, at most; 0: the configured one
    opening_v: float = 0.0  # beyond the edge: of a step, or the end of a ramp
    rate_v_s: float = 0.0  # of a ramp, both ways


_EDGES = (key.PLUS, key.MINUS, key.CENTRE, key.HALF, key.PLAY)

MOTIONS: tuple[Motion, ...] = (
    Motion("rest", (key.SEEP,), 2.0, places=(0.5,)),
    Motion("ramp", (*_EDGES, key.STATIC, key.STIFFNESS), 6.0, (0.2, 0.5, 0.8), opening_v=0.2, rate_v_s=0.1),
    Motion(
        "sine", (*_EDGES, key.AREA, key.EXPONENT, key.MASS, key.COULOMB, key.LOAD), 6.0, (0.5,), 0.05, 0.5
    ),
    Motion("sine", (key.MASS, key.VISCOUS, key.BANDWIDTH, key.DELAY), 4.0, (0.5,), 0.02, 2.0),
    Motion("moves", (key.AREA, key.CRITICAL, key.VISCOUS, key.MASS), 8.0, (0.05, 0.95, 0.05, 0.5)),
    Motion("moves", (key.DEAD1, key.DEAD2), 6.0, (0.05, 0.15, 0.95, 0.85, 0.05), speed_m_s=0.3),
    Motion("moves", (key.STATIC, key.STRIBECK, key.COULOMB), 6.0, (0.3, 0.2, 0.22), speed_m_s=0.02),
    Motion("moves", (key.STATIC, key.STIFFNESS, key.DAMPING), 6.0, (0.5, 0.51, 0.5), speed_m_s=0.005),
)
