"""Moves of several axes from rest to rest that begin and end together.

`reference.move` from rest goes by a law of time that depends on speed, acceleration and jerk over the
distance alone. Axes that have these in common go by one law, and so does what they carry: in a straight line.
"""

from __future__ import annotations

from collections.abc import Sequence

from pneud.control.reference import Bounds

LEAST_M = 1e-9  # whoever is no further from its end has no way
LEAST = 1e-6  # of any bound: with less, a way would take hours


def alike(ways_m: Sequence[float], bounds: Sequence[Bounds]) -> list[Bounds]:
    """Bounds with which ways of these lengths take the same time, each within its own.

    Args:
        ways_m: distances, not negative.
        bounds: of each, if it went alone.
    """
    going = [(way_m, b) for way_m, b in zip(ways_m, bounds, strict=True) if way_m > LEAST_M]
    if not going:
        return list(bounds)
    speed = min(b.speed_m_s / way_m for way_m, b in going)
    acceleration = min(b.acceleration_m_s2 / way_m for way_m, b in going)
    jerk = min(b.jerk_m_s3 / way_m for way_m, b in going)
    return [
        Bounds(
            _kept(speed * way_m, b.speed_m_s),
            _kept(acceleration * way_m, b.acceleration_m_s2),
            _kept(jerk * way_m, b.jerk_m_s3),
        )
        for way_m, b in zip(ways_m, bounds, strict=True)
    ]


def _kept(wanted: float, most: float) -> float:
    return min(max(wanted, LEAST), most)
