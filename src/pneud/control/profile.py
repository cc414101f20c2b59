"""An uploaded profile: polynomials that meet up to the jerk, checked one by one."""

from typing import NamedTuple

from pneud.control.reference import Bounds, Septic, at
from pneud.signals import Reference

Profile = tuple[Septic, ...]

MOST_PIECES = 4096
SHORTEST_S, LONGEST_S = 1e-6, 1e5
POINTS = 16
# what counts as meeting [m, m/s, m/s², m/s³]; a step of this size moves no command
MEETS = Reference(1e-6, 1e-6, 1e-4, 1e-1)
ROUNDING = 1.0 + 1e-6  # pieces planned up to a bound may exceed it by this


class Extent(NamedTuple):
    """How far a piece goes, as seen in POINTS + 1 points of it; turns between them are allowed for."""

    low_m: float
    high_m: float
    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float


def extent(piece: Septic) -> Extent:
    """How far a piece goes."""
    step_s = piece.T / POINTS
    before = at(0.0, piece)
    low = high = before.position_m
    speed, acceleration, jerk = abs(before.velocity_m_s), abs(before.acceleration_m_s2), abs(before.jerk_m_s3)
    for i in range(1, POINTS + 1):
        r = at(i * step_s, piece)
        x, v, a, j = r
        turned = 0.0
        if v * before.velocity_m_s < 0.0:
            most_a = max(abs(a), abs(before.acceleration_m_s2))
            turned = step_s * min(0.125 * step_s * most_a, abs(v), abs(before.velocity_m_s))
        low, high = min(low, x - turned), max(high, x + turned)
        speed, acceleration, jerk = max(speed, abs(v)), max(acceleration, abs(a)), max(jerk, abs(j))
        before = r
    return Extent(low, high, speed, acceleration, jerk)


def meet(before: Septic, piece: Septic) -> bool:
    """Whether a piece goes on where the one before it ends."""
    end, begin = at(before.T, before), at(0.0, piece)
    return all(abs(a - b) <= tolerance for a, b, tolerance in zip(end, begin, MEETS, strict=True))


def is_inside(e: Extent, low_m: float, high_m: float) -> bool:
    """Whether a piece stays between two positions."""
    return low_m <= e.low_m and e.high_m <= high_m


def is_within(e: Extent, bounds: Bounds) -> bool:
    """Whether a piece keeps the bounds."""
    return (
        e.speed_m_s <= ROUNDING * bounds.speed_m_s
        and e.acceleration_m_s2 <= ROUNDING * bounds.acceleration_m_s2
        and e.jerk_m_s3 <= ROUNDING * bounds.jerk_m_s3
    )


def ends_at_rest(profile: Profile) -> bool:
    """Whether there is a profile, and it ends at rest."""
    if not profile:
        return False
    end = at(profile[-1].T, profile[-1])
    return all(abs(rate) <= tolerance for rate, tolerance in zip(end[1:], MEETS[1:], strict=True))
