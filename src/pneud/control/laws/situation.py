"""What a law is asked about, and what it answers."""

from typing import NamedTuple

from pneud.control.feedforward import FrictionAhead
from pneud.control.motion import MotionFilter
from pneud.control.prediction import Motion, Spool
from pneud.physics.valve import SpoolTransition, Valve
from pneud.signals import Estimate, Reference


class Situation(NamedTuple):
    """All that a law may know in a tick.

    `motion`, `goal` and the errors between them are those at the instant at which the command has its effect,
    `lead_s` after the sample.
    """

    e: Estimate  # of the sample
    now: Motion  # of the sample
    motion: Motion
    goal: Reference
    w1: float  # errors (9), w3 with all forces that are known [m, m/s, m/s²]
    w2: float
    w3: float
    pressures_n: float  # force of the pressures on the load, unmatched forces not taken off [N]
    friction: FrictionAhead  # that the reference meets
    force_rate: float  # rate of F̂ beyond that friction [N/s]
    f0: float  # F0 at the sample [N/m]
    f1_fill: float  # F1 at the sample [N/(s V)]
    f1_exhaust: float
    spool: Spool
    applied_v: float  # command that acted when the sample was taken
    h: float  # time to the next tick [s]
    M: float  # moving mass [kg]
    lead_s: float
    spool_ahead: SpoolTransition  # over half of it
    valve: Valve
    filter: MotionFilter


class LawOutput(NamedTuple):
    """A law's answer in one tick."""

    u_v: float  # command it asks for [V], not limited
    s: float  # sliding variable (12) [m/s²]; NaN for a law that has none
    ustar: float  # (19) [m/s³]; NaN likewise


def errors(m: Motion, r: Reference, M: float) -> tuple[float, float, float]:
    """w1, w2, w3 of (9), w3 with all forces that are known [m, m/s, m/s²]."""
    return r.position_m - m.x, r.velocity_m_s - m.v, r.acceleration_m_s2 - m.force_n / M


def within(x: float, most: float) -> float:
    """A value kept between −`most` and `most`."""
    return max(-most, min(most, x))
