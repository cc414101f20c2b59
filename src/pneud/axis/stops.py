"""An axis that lies on an end stop, or beside its travel, and how it is led away from there.

Where a cylinder has lost its air it lies on a stop. An axis can be armed there, and holds still; the first
motion leads it slowly to the nearest position that may be asked for, at rest, and from there as always. Until
then the stop may carry force, and the load may not go further out than it has been.
"""

from __future__ import annotations

from pneud.axis.state import INSIDE, AxisParameters
from pneud.control.reference import Bounds, Septic, move, rest
from pneud.safety.checks import MOVING_M_S, Limits
from pneud.safety.faults import F
from pneud.safety.output import OutputLimits
from pneud.signals import Estimate, Reference

NEAR_M = 0.5e-3  # so close to a stop a load may rest on it
BEYOND_M = 2e-3  # an encoder may show so much behind a stop, which gives, and is not where it is drawn
SLIP_M = 1e-3  # no further out may a load go that is led inside
AWAY = Bounds(0.03, 0.05, 0.5)  # m/s, m/s², m/s³ of the way inside: force has time to change sides
GENTLE = 0.4  # part of the valve's range that may lead away from a stop
TRAVEL, BRAKING_DISTANCE = 1 << F.TRAVEL, 1 << F.BRAKING_DISTANCE
UNHELD = ~(1 << F.ENCODER_STUCK | 1 << F.FORCE_DISAGREES)  # all but what a force of the stop looks like


def inside(p: Limits) -> tuple[float, float]:
    """Between which positions no stop carries the load [m]."""
    return max(p.travel_min_m, NEAR_M), min(p.travel_max_m, p.stroke_m - NEAR_M)


def soft_limits(p: AxisParameters) -> tuple[float, float]:
    """Least and greatest position that may be asked for [m]."""
    limits = p.limits
    low_m, high_m = max(limits.travel_min_m, 0.0), min(limits.travel_max_m, limits.stroke_m)
    return low_m + p.travel_margin_m, high_m - p.travel_margin_m


def outside(before_m: float, position_m: float, engaged: bool, p: Limits) -> float:
    """The innermost position since the axis has been armed outside [m]; `INSIDE` where it is, or was.

    Args:
        before_m: a tick before.
        position_m: now.
        engaged: the axis is; before that, where it lies does not matter.
        p: limits.
    """
    low_m, high_m = inside(p)
    if low_m <= position_m <= high_m or not -BEYOND_M <= position_m <= p.stroke_m + BEYOND_M:
        return INSIDE
    if not engaged:
        return position_m
    if before_m == INSIDE:
        return INSIDE
    return max(before_m, position_m) if position_m < low_m else min(before_m, position_m)


def excused(outside_m: float, position_m: float, e: Estimate, p: Limits) -> int:
    """Bits of the faults that mean nothing outside, as long as the load stays or comes inside.

    Args:
        outside_m: from `outside`.
        position_m: now.
        e: the estimate.
        p: limits.
    """
    if outside_m == INSIDE:
        return 0
    outwards = -1.0 if outside_m < inside(p)[0] else 1.0
    if outwards * (position_m - outside_m) > SLIP_M:
        return 0
    return TRAVEL if outwards * e.velocity_m_s > MOVING_M_S else TRAVEL | BRAKING_DISTANCE


def gentle(p: AxisParameters) -> AxisParameters:
    """With a command so bounded that what the stop carries is no blow when it lets go."""
    output = OutputLimits(GENTLE * p.output.u_max_v, p.output.slew_v_s, p.output.lsb_v)
    return p._replace(output=output)


def way_inside(now: Reference, p: AxisParameters) -> tuple[tuple[Septic, ...], Reference]:
    """The pieces of the way that leads inside first, and where the way goes on from.

    Args:
        now: the reference.
        p: parameters.
    """
    low_m, high_m = inside(p.limits)
    if low_m <= now.position_m <= high_m:
        return (), now
    soft_low_m, soft_high_m = soft_limits(p)
    edge_m = max(soft_low_m, low_m) if now.position_m < low_m else min(soft_high_m, high_m)
    return move(now, edge_m, Bounds(*map(min, AWAY, p.motion))).pieces, rest(edge_m)
