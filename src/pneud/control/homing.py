"""Homing of an incremental encoder: slowly and with bounded force against an end stop, and back.

The position is not known, and with it neither chamber's volume, so the law of a known axis cannot be used.
Here a velocity is asked for, with damping by the pressures and the loop's gain as if the load stood at the
stop, where the valve acts fastest: further off the same command does less, and the load moves more softly.
"""

from typing import NamedTuple

from pneud.control.step import Controller
from pneud.physics.cylinder import F0, F1_exhaust, F1_fill
from pneud.physics.valve import dead_zone_inverse
from pneud.signals import EncoderStatus, Estimate, Measurement

AWAY, TOWARDS, BACK, HALT = range(
    4
)  # first off the stop, so that a load that is stuck is not taken for homed

STILL_NS = 100_000_000  # standing for so long is standing still
STILL_SHARE = 0.2  # of the speed: below it the load stands
PUSHED_SHARE = 0.8  # of the force: above it the load is held by something
HALT_M_S = 5e-3
VELOCITY_RATE = 20.0  # [1/s] of the velocity's error
LAG_RATE = 4.0  # [1/s] of the way that the load is behind
MOST_LAG_M = 0.06  # enough for friction, and for a dead zone that is not quite as identified
DAMPING_RATE = 100.0  # [1/s] of the acceleration
FORCE_RATE = 60.0  # [1/s] at which the force comes to its bound
_REFERENCED = int(EncoderStatus.REFERENCED)


class HomingParameters(NamedTuple):
    """How an axis finds its zero."""

    incremental: bool  # else the encoder knows it
    side: float  # of the stop: −1 rear, +1 front
    stop_m: float  # where it is, stroke coordinate
    speed_m_s: float
    force_n: float  # the most that presses against the stop
    back_off_m: float  # distance from the stop at the end
    longest_ns: int  # of one part of the way


class Homing(NamedTuple):
    """How far it has come."""

    part: int
    since_ns: int
    from_m: float
    moving_ns: int  # when the load was last seen to be free
    lag_m: float = 0.0  # behind the motion asked for


class Progress(NamedTuple):
    """What a tick of homing has come to."""

    homing: Homing
    found: bool = False  # the load stands at the stop
    done: bool = False
    failed: bool = False


def placed(m: Measurement, zero_m: float, referenced: bool) -> Measurement:
    """What an incremental encoder measures, from its zero, with our own word on whether that is known."""
    known, unknown = m.encoder_status | _REFERENCED, m.encoder_status & ~_REFERENCED
    return m._replace(position_m=m.position_m + zero_m, encoder_status=known if referenced else unknown)


NOWHERE = Homing(AWAY, 0, 0.0, 0)


def set_out(position_m: float, now_ns: int) -> Homing:
    """The beginning."""
    return Homing(AWAY, now_ns, position_m, now_ns)


def direction(part: int, p: HomingParameters) -> float:
    """Which way the load is to go; 0 for nowhere."""
    if part == HALT:
        return 0.0
    return p.side if part == TOWARDS else -p.side


def proceed(
    s: Homing, e: Estimate, now_ns: int, h: float, rod_force_n: float, p: HomingParameters
) -> Progress:
    """One tick on.

    Args:
        s: after the last tick.
        e: the estimate.
        now_ns: the instant that it holds for.
        h: sample time [s].
        rod_force_n: of the atmosphere on the rod's side.
        p: parameters.
    """
    way = direction(s.part, p)
    moved_m = way * (e.position_m - s.from_m)
    if s.part == HALT:
        free = abs(e.velocity_m_s) > HALT_M_S
    else:
        pushed = way * (e.x3_n - rod_force_n) >= PUSHED_SHARE * p.force_n
        free = not pushed or abs(e.velocity_m_s) > STILL_SHARE * p.speed_m_s
    lag_m = s.lag_m + h * (way * p.speed_m_s - e.velocity_m_s)
    s = s._replace(moving_ns=now_ns if free else s.moving_ns, lag_m=max(-MOST_LAG_M, min(MOST_LAG_M, lag_m)))
    still = now_ns - s.moving_ns >= STILL_NS

    if now_ns - s.since_ns > p.longest_ns:
        return Progress(s, failed=True)
    if s.part == AWAY and (still or moved_m >= p.back_off_m):
        return Progress(Homing(TOWARDS, now_ns, e.position_m, now_ns))
    if s.part == TOWARDS and still:
        if moved_m < 0.5 * p.back_off_m:
            return Progress(s, failed=True)  # stuck, not homed
        return Progress(Homing(BACK, now_ns, p.stop_m, now_ns), found=True)
    if s.part == BACK and moved_m >= p.back_off_m:
        return Progress(Homing(HALT, now_ns, e.position_m, now_ns))
    if s.part == BACK and still:
        return Progress(s, failed=True)
    return Progress(s, done=s.part == HALT and still)


def command(s: Homing, m: Measurement, e: Estimate, p: HomingParameters, c: Controller) -> float:
    """What is asked of the valve [V], not limited.

    Args:
        s: homing so far.
        m: the measurement, for its pressures.
        e: the estimate.
        p: parameters.
        c: the controller's.
    """
    k, g = c.cylinder, c.gas
    x1 = p.stop_m + k.x_e1
    way = direction(s.part, p)
    wanted_m_s = way * p.speed_m_s
    force_n = e.x3_n - k.rod_force_n
    acceleration = (force_n - e.force_n) / k.M
    rate = (
        k.M
        * DAMPING_RATE
        * (VELOCITY_RATE * (wanted_m_s - e.velocity_m_s + LAG_RATE * s.lag_m) - acceleration)
    )
    rate -= F0(x1, m.p1_pa, m.p2_pa, k, g) * wanted_m_s
    rate = max(FORCE_RATE * (-p.force_n - force_n), min(FORCE_RATE * (p.force_n - force_n), rate))
    if rate >= 0.0:
        opening_v = rate / F1_fill(x1, m.p1_pa, m.p2_pa, m.supply_pa, k, g)
    else:
        opening_v = rate / F1_exhaust(x1, m.p1_pa, m.p2_pa, m.supply_pa, k, g)
    return dead_zone_inverse(opening_v, c.valve, 0.0) if c.sliding.invert_dead_zone else opening_v
