"""Force of the piston on the load: a loop on x3, and what an axis may do meanwhile.

The force is that of the chambers' gauge pressures, x3 − Patm (A1 − A2), whatever friction takes of it on its
way to what the load is pressed against. With (8), ẋ3 = F0 x2 + F1 u + d, the law is

    F1 u = λ (R − x3) + Ṙ − F0 x2 − d̂,    R = wanted − D x2, kept where the load stays slower than asked for

taken where the command has its effect; d̂ is that of the finite-time observer (10). The wanted force goes
along a ramp that ends softly. D damps the load on what it is pressed against, by the stiffness that it shows.
"""

import math
from typing import NamedTuple

from pneud.control.laws.sliding import command as inverted
from pneud.control.step import SLIDES_M_S, Controller, ControllerState, as_learnt, at_effect
from pneud.control.times import over_ns
from pneud.physics.valve import dead_zone_inverse
from pneud.signals import Estimate, Reference

FINE, WINDOW, SPEED, TIMEOUT, DIRECTION, APART = range(6)

LOOP_RAD_S = 150.0  # bandwidth of the loop on x3, at most
LEADS = 0.5  # of that bandwidth, in terms of the time until a command has its effect
DAMPED = 0.6  # of that bandwidth: the fastest swing of the load that is damped in full
UNTOLD = 0.15  # of that one: of a load whose stiffness is not known yet
SLOWEST_RAD_S = 4.0  # swings that are damped at least
ZETA, FIRST = 0.48, 0.4  # of that damping; part of it while nothing bears the force
SOFT_S = 0.01  # time constant in which the ramp ends
SHORTEST_S = 0.045  # of a ramp, where none is asked for
SPRING_S = 0.015  # in which a stiffness is forgotten
SPRING_M, SPRING_STEPS = 1e-5, 5.0  # travel that tells a stiffness: at least, and in steps of the encoder
GUARD = 0.7  # of the speed that is asked for, at which the load is held
GUARD_RAD_S = 40.0  # how fast
LATE = 1.5  # of the time that this takes: a load goes on before it is braked
CREEP_M_S = 0.02  # so fast it may be wherever it is: it would be at rest within a hair's breadth
SLOW_S = 0.02  # in which the error of the force is smoothed
SHUTS, OPENS = 0.25, 0.5  # of the tolerance: the valve is shut within, and opens beyond
SHUT_M_S = 5e-3  # no faster may the load be then
SPEED_NS, DIRECTION_NS = 20_000_000, 50_000_000  # too fast, and the wrong way, for so long
AT_ONCE = 2.0  # times the speed that is asked for are too much at once
WRONG_SHARE, WRONG_MOST = 0.2, 0.05  # of the way of the force, and of the piston's force: the wrong way
WRONG_M = 0.01  # likewise of the load
LEAST_RATE_N_S = 1.0
LEAST_PLACE = 0.02  # of the stroke and its dead lengths: no chamber counts as shorter
CELL_M_S = 0.02  # the slower the load is than this, the more is believed of the load cell
CELL_S = 0.03  # in which what x3 and a load cell differ by is believed
APART_NS = 100_000_000  # x3 and the load cell, for so long
APART_M_S = 0.05  # while the load is slower
FREE_M_S = 0.01


class Pressing(NamedTuple):
    """What may be asked for, and what counts as reached."""

    out_n: float = 0.0  # greatest force outwards
    in_n: float = 0.0  # and inwards
    rate_n_s: float = 1.0  # where none is asked for
    speed_m_s: float = 1.0  # likewise
    time_s: float = 1.0  # likewise
    tolerance_n: float = 2.0  # of the force, at least
    share: float = 0.01  # and as a part of it
    settled_ns: int = 0  # for so long
    free_n: float = 0.0  # beside its load, what moves with less is not pressed against anything
    valve_n_s: float = math.inf  # without a ramp asked for: no faster at mid-stroke
    cell: bool = False  # a load cell says what the force is
    cell_ns: int = 0  # no older may that be
    apart_n: float = 0.0  # the piston's force may differ from it by no more


class Aim(NamedTuple):
    """What is asked for."""

    force_n: float  # on the load, positive outwards
    rate_n_s: float  # of the ramp
    low_m: float  # window of the travel, stroke coordinate
    high_m: float
    speed_m_s: float  # no faster
    time_s: float  # until the force is reached, at most
    braking_m_s2: float = 1e9  # by which the load could be brought to rest within the window


class Press(NamedTuple):
    """How far it has come."""

    aim: Aim
    since_ns: int
    from_m: float
    from_n: float
    wanted_n: float  # on the ramp
    rate_n_s: float  # of it, now
    slow_n: float  # error of the force, smoothed
    at_m: float  # position a tick before
    at_n: float  # F̂ then
    along_j: float = 0.0  # changes of F̂ times changes of position, lately
    way_m2: float = 0.0  # squares of these
    shut: int = 0  # the valve is: the force is as wanted
    within_ns: int = -1  # since when the force is reached, −1 where it is not
    reached: int = 0  # it has been for long enough
    ever: int = 0  # it has been once
    fast_ns: int = -1  # since when too fast
    wrong_ns: int = -1  # since when the wrong way
    bias_n: float = 0.0  # of the piston's force beyond what a load cell says
    apart_ns: int = -1  # since when the two are too far apart


NO_PRESS = Press(Aim(0.0, 1.0, 0.0, 0.0, 1.0, 1.0), 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Progress(NamedTuple):
    """What a tick of pressing has come to."""

    press: Press
    ended: int = FINE  # why it must not go on


def piston_n(e: Estimate, c: Controller) -> float:
    """Force of the piston on the load [N], positive outwards."""
    x3_n = e.x3_hat_n if c.use_x3_hat else e.x3_n
    return x3_n - c.cylinder.rod_force_n


def usual_rate_n_s(force_n: float, e: Estimate, k: Pressing, c: Controller) -> float:
    """Ramp that leads to a force where none is asked for: about as fast as valve and chambers let it.

    F1 is greatest near the ends of the stroke, where one of the chambers is small.

    Args:
        force_n: that is wanted.
        e: the estimate.
        k: what may be asked for.
        c: the controller's parameters.
    """
    L = c.cylinder.L
    x1 = max(LEAST_PLACE * L, min((1.0 - LEAST_PLACE) * L, e.position_m + c.cylinder.x_e1))
    here_n_s = k.valve_n_s * 0.25 * L * (1.0 / x1 + 1.0 / (L - x1))
    return max(LEAST_RATE_N_S, min(k.rate_n_s, here_n_s, abs(force_n - piston_n(e, c)) / SHORTEST_S))


def is_free(e: Estimate, load_n: float, p: Pressing) -> bool:
    """Whether a load that has pressed against something moves without it.

    Args:
        e: the estimate.
        load_n: force on it that is neither friction nor a contact's.
        p: what counts as free.
    """
    return abs(e.force_n - load_n) <= p.free_n and abs(e.velocity_m_s) > FREE_M_S


def motion_of(e: Estimate, c: Controller, most_m_s2: float) -> Reference:
    """The motion of the load, from which a way to a position would begin.

    Args:
        e: the estimate.
        c: the controller's parameters.
        most_m_s2: greatest acceleration that such a way has.
    """
    if abs(e.velocity_m_s) <= SLIDES_M_S:
        return Reference(e.position_m, e.velocity_m_s, 0.0, 0.0)
    a = (piston_n(e, c) - e.force_n) / c.cylinder.M
    return Reference(e.position_m, e.velocity_m_s, max(-most_m_s2, min(most_m_s2, a)), 0.0)


def begin(aim: Aim, before: Press, goes_on: bool, e: Estimate, now_ns: int, c: Controller) -> Press:
    """Pressing, from where force and load are.

    Args:
        aim: what is asked for.
        before: pressing so far.
        goes_on: it is under way: the ramp goes on from where it is.
        e: the estimate.
        now_ns: the instant that it holds for.
        c: the controller's parameters.
    """
    force_n = piston_n(e, c)
    if goes_on:
        return before._replace(
            aim=aim,
            since_ns=now_ns,
            from_m=e.position_m,
            from_n=force_n,
            slow_n=aim.force_n - force_n,
            shut=0,
            within_ns=-1,
            reached=0,
            ever=0,
            fast_ns=-1,
            wrong_ns=-1,
            apart_ns=-1,
        )
    return Press(
        aim, now_ns, e.position_m, force_n, force_n, 0.0, aim.force_n - force_n, e.position_m, e.force_n
    )


def loop_rad_s(c: Controller) -> float:
    """Bandwidth of the loop on x3 [rad/s]: what dead time and sample time leave."""
    return min(LOOP_RAD_S, LEADS / max(c.lead_s, 2.0 * c.h))


def tolerance_n(aim: Aim, p: Pressing) -> float:
    """How far the force may be off [N]."""
    return max(p.tolerance_n, p.share * abs(aim.force_n))


def stiffness_n_m(s: Press, c: Controller) -> float:
    """Stiffness of what the load is pressed against, as it shows, or a usual one as long as it does not."""
    usual = UNTOLD * DAMPED * loop_rad_s(c)
    told_m = max(SPRING_M, 2.0 * SPRING_STEPS * c.motion.blind_m)
    prior_m2 = told_m * told_m
    return (max(0.0, s.along_j) + prior_m2 * c.cylinder.M * usual * usual) / (s.way_m2 + prior_m2)


def damping_n_s_m(s: Press, c: Controller) -> float:
    """What damps the load on that stiffness [N s/m]: less as long as hardly anything bears the force."""
    swing_rad_s = math.sqrt(stiffness_n_m(s, c) / c.cylinder.M)
    way_n = s.aim.force_n - s.from_n
    borne = (s.at_n - s.from_n) / way_n if way_n != 0.0 else 1.0
    share = max(FIRST, min(1.0, FIRST + borne))
    return 2.0 * ZETA * share * c.cylinder.M * max(SLOWEST_RAD_S, min(DAMPED * loop_rad_s(c), swing_rad_s))


def allowed_m_s(aim: Aim, room_m: float, late_s: float) -> float:
    """How fast the load may be where the window ends so far ahead, and braking comes so late [m/s]."""
    lost_m_s = aim.braking_m_s2 * late_s
    braked_m_s = math.sqrt(lost_m_s * lost_m_s + 2.0 * aim.braking_m_s2 * max(0.0, room_m)) - lost_m_s
    most = max(CREEP_M_S, braked_m_s)
    return min(aim.speed_m_s, most)


def braked_after_s(swing_rad_s: float) -> float:
    """How long a load goes on before it is braked [s]; what it swings on helps."""
    rate_rad_s = GUARD_RAD_S + swing_rad_s
    return LATE * GUARD_RAD_S / (rate_rad_s * rate_rad_s)


def bounds_n(s: Press, force_n: float, x: float, v: float, c: Controller) -> tuple[float, float]:
    """Between which forces of the piston the load stays slower than was asked for, and can be braked [N].

    What the load bears at a speed is F̂; what is more drives it, until the stiffness that it is pressed
    against takes that up.

    Args:
        s: pressing so far.
        force_n: F̂.
        x: position of the load [m].
        v: velocity of the load [m/s].
        c: the controller's parameters.
    """
    M = c.cylinder.M
    swing_rad_s = math.sqrt(stiffness_n_m(s, c) / M)
    gain, late_s = GUARD * (GUARD_RAD_S + swing_rad_s), braked_after_s(swing_rad_s)
    inwards = allowed_m_s(s.aim, x - s.aim.low_m, late_s)
    outwards = allowed_m_s(s.aim, s.aim.high_m - x, late_s)
    damped = GUARD_RAD_S * v
    return force_n - M * (gain * inwards + damped), force_n + M * (gain * outwards - damped)


def proceed(
    s: Press, e: Estimate, now_ns: int, dt: float, c: Controller, p: Pressing, cell_n: float = math.nan
) -> Progress:
    """One tick on.

    With a load cell the piston's force is led to what is asked for and what the two differ by: friction,
    weight, and where the pressures are wrong.

    Args:
        s: after the last tick.
        e: the estimate.
        now_ns: the instant that it holds for.
        dt: time since the last tick [s].
        c: the controller's parameters.
        p: what counts as reached.
        cell_n: what the load cell says; NaN where there is none, or it says nothing.
    """
    aim, force_n = s.aim, piston_n(e, c)
    bias_n, told_n, apart_ns = s.bias_n, force_n, -1
    if math.isfinite(cell_n):
        told_n = cell_n
        differ_n = e.force_n - cell_n
        slow = max(0.0, 1.0 - abs(e.velocity_m_s) / CELL_M_S)
        bias_n += slow * min(1.0, dt / CELL_S) * (max(-p.apart_n, min(p.apart_n, differ_n)) - bias_n)
        if abs(differ_n) > p.apart_n and abs(e.velocity_m_s) <= APART_M_S:
            apart_ns = s.apart_ns if s.apart_ns >= 0 else now_ns
    goal_n = aim.force_n + bias_n
    rate_n_s = max(-aim.rate_n_s, min(aim.rate_n_s, (goal_n - s.wanted_n) / max(SOFT_S, dt)))
    wanted_n = s.wanted_n + dt * rate_n_s
    least_n, most_n = bounds_n(s, e.force_n, e.position_m, e.velocity_m_s, c)
    if (rate_n_s > 0.0 and wanted_n > most_n) or (rate_n_s < 0.0 and wanted_n < least_n):
        # a ramp that ran on would be a step where the load comes to what it is to press against
        wanted_n, rate_n_s = max(least_n, min(most_n, wanted_n)), 0.0
    slow_n = s.slow_n + min(1.0, dt / SLOW_S) * (aim.force_n - told_n - s.slow_n)
    kept = max(0.0, 1.0 - dt / SPRING_S)
    dx = e.position_m - s.at_m
    tolerance = tolerance_n(aim, p)
    near = abs(goal_n - wanted_n) <= SHUTS * tolerance and abs(e.velocity_m_s) <= SHUT_M_S
    # what damps a load that swings is no error of the force in the mean; kept, it would drive the load on
    near = near and abs(goal_n - force_n) <= OPENS * tolerance
    shut = 1 if near and abs(slow_n) <= (OPENS if s.shut else SHUTS) * tolerance else 0
    within_ns = -1
    if abs(slow_n) <= tolerance:
        within_ns = s.within_ns if s.within_ns >= 0 else now_ns
    reached = 1 if within_ns >= 0 and now_ns - within_ns >= p.settled_ns else 0
    fast_ns = -1
    if abs(e.velocity_m_s) > aim.speed_m_s:
        fast_ns = s.fast_ns if s.fast_ns >= 0 else now_ns
    wrong_ns = -1
    if is_wrong(s, e, force_n, p):
        wrong_ns = s.wrong_ns if s.wrong_ns >= 0 else now_ns
    after = Press(
        aim,
        s.since_ns,
        s.from_m,
        s.from_n,
        wanted_n,
        rate_n_s,
        slow_n,
        e.position_m,
        e.force_n,
        kept * s.along_j + dx * (e.force_n - s.at_n),
        kept * s.way_m2 + dx * dx,
        shut,
        within_ns,
        reached,
        1 if reached or s.ever else 0,
        fast_ns,
        wrong_ns,
        bias_n,
        apart_ns,
    )
    return Progress(after, ended(after, e, now_ns, round(c.h * 1e9)))


def is_wrong(s: Press, e: Estimate, force_n: float, p: Pressing) -> bool:
    """Whether force or load have gone the wrong way."""
    way_n = s.aim.force_n - s.from_n
    least_n = max(WRONG_SHARE * abs(way_n), WRONG_MOST * min(p.out_n, p.in_n))
    towards = math.copysign(1.0, way_n)
    return towards * (force_n - s.from_n) < -least_n or towards * (e.position_m - s.from_m) < -WRONG_M


def ended(s: Press, e: Estimate, now_ns: int, period_ns: int) -> int:
    """Why it must not go on, `FINE` where it may."""
    aim = s.aim
    if not aim.low_m <= e.position_m <= aim.high_m:
        return WINDOW
    if abs(e.velocity_m_s) > AT_ONCE * aim.speed_m_s or (s.fast_ns >= 0 and now_ns - s.fast_ns >= SPEED_NS):
        return SPEED
    if s.wrong_ns >= 0 and now_ns - s.wrong_ns >= DIRECTION_NS:
        return DIRECTION
    if s.apart_ns >= 0 and now_ns - s.apart_ns >= APART_NS:
        return APART
    if not s.ever and now_ns - s.since_ns >= over_ns(aim.time_s, period_ns):
        return TIMEOUT
    return FINE


def command(s: Press, state: ControllerState, e: Estimate, last_v: float, c: Controller) -> float:
    """What is asked of the valve [V], not limited.

    Args:
        s: pressing so far.
        state: the controller's.
        e: the estimate.
        last_v: the last command that left [V].
        c: the controller's parameters.
    """
    p = as_learnt(c, state.learnt)
    if s.shut:
        return dead_zone_inverse(0.0, p.valve, 0.0)
    M, loop = p.cylinder.M, loop_rad_s(p)
    motion = at_effect(state, e, 0.0, p)
    outside_n = e.force_n if p.use_force else 0.0
    damping = damping_n_s_m(s, p)
    goal_n = s.wanted_n + p.lead_s * s.rate_n_s - damping * motion.v
    goal_rate = s.rate_n_s - damping * motion.force_n / M
    least_n, most_n = bounds_n(s, e.force_n, e.position_m, motion.v, p)
    if not least_n <= goal_n <= most_n:
        goal_n = max(least_n, min(most_n, goal_n))
        goal_rate = -GUARD_RAD_S * motion.force_n
    rate = loop * (goal_n - motion.force_n - outside_n) + goal_rate - state.f0 * motion.v - e.d_hat_n_s
    wanted_v = rate / (state.f1_fill if rate >= 0.0 else state.f1_exhaust)
    return inverted(wanted_v, last_v, p.sliding, p.valve)
