"""What is believed of valve and friction, and the filters: all that may be changed while the axis runs.

Laws and gains are the subject of `tunables`; what protects the axis is for neither. The controller's
parameters follow from these numbers here, so that those of a running axis are the ones of its next start.
"""

import math
from typing import NamedTuple

from pneud.control.feedforward import Creep
from pneud.control.motion import MotionFilter, quickened, triple_pole
from pneud.control.standstill import SLOW_RAD_S, Standstill
from pneud.control.step import Controller
from pneud.physics.friction import Friction

NAMES = (  # in configurations, below [control] or from [valve] on, of all but the last two of `Model`
    *("valve.dead_zone_v", "valve.centre_v", "dead_zone_hold_v"),
    *("friction.coulomb_n", "friction.static_n", "friction.stribeck_speed_m_s", "friction.viscous_n_s_m"),
    *("friction.bristle_stiffness_n_m", "friction.bristle_damping_n_s_m"),
    *("motion.bandwidth_rad_s", "motion.push_bandwidth_rad_s", "motion.push_beyond_m"),
    "force_rate_bandwidth_rad_s",
)
MOST_PUSH_RATIO = (
    2.5  # of the motion filter's bandwidths: so far apart, both have a Lyapunov function in common
)
MOST_RAD_S = 5_000.0  # bandwidth of a filter
MOST_HOLD_V = 1.0
MOST_STIFFER = 20.0  # factor of the bristles' stiffness that may be learnt
LEAST_BENT = 3.0  # steps of the encoder by which bristles have to bend, for their stiffness to be seen
MOST_EDGE = 0.08  # part of the greatest opening that an edge of the dead zone may be learnt to be
WIDEST = 0.35  # dead zone over the greatest command
LEAST_HELD_M = 5e-6  # error that may be left rather than cross the dead zone, at least
BALANCE = 0.03  # of dry friction that may be out of balance while a load counts as held by it
SMOOTH_S = 0.02  # of force and speed of a standing load
SETTLE_S = 1.0  # that the law has, before it gives way to a load that would swing on its bristles
PATIENCE_S, BRIEF_S = 0.1, 0.05  # of hunting, until the valve is closed; where bristles are beyond the law
NEAR_M, FAR_M = 1e-4, 3e-4  # error within which the law may give way, and beyond which it has the load back
DIED = 3.0  # time constants until a swing has died
BEYOND = 0.55  # of the motion filter's bandwidth, above which a swing is seen too late to be damped
SHUT = 0.02  # of the greatest command, up to which the law keeps the valve shut at rest
FIRM = 1.4  # times the law's bandwidth at rest: bristles that swing as fast as the law make it ring
BRISK_S = 5e-3  # sample time with which there is room for that
COARSE_M = 4e-6  # step of an encoder, from which on it keeps the law busy at rest
CALM_S = 0.1  # when the motion filter is calmer there, as far as both have a Lyapunov function in common
QUIET_S = 5e-3  # over which a quiet law smooths its opening, if that is less than its filter takes
AGAIN, WAIT = 3, 1.5  # times that giving way may be of no use there; of the band that is left, where it waits
GRACE_S = 0.08  # that a load has to come to rest when the valve is closed
RESTLESS_V = 0.03  # mean step of the command that is hunting
STEEPEST = 0.858  # slope of exp(−(v/v_s)²), times v_s
PASSING_S = 0.1  # a reference that passes the Stribeck speed in less does not creep


class Model(NamedTuple):
    """The numbers that may be changed; all or none."""

    dead_zone_v: float  # half width about the centre
    centre_v: float
    hold_v: float  # opening not worth a way across the dead zone, at most
    coulomb_n: float
    static_n: float
    stribeck_m_s: float
    viscous_n_s_m: float
    stiffness_n_m: float  # of the bristles
    damping_n_s_m: float  # of the bristles
    motion_rad_s: float  # bandwidth of the motion filter; 0 where it follows from noise, and stays as it is
    push_rad_s: float  # for innovations that are a push; 0 for none
    push_beyond_m: float  # that exceed half a step by more than this
    force_rate_rad_s: float  # of the low-pass for the rate of F̂; 0 leaves it out
    standstill: float  # 1 where a load at rest is left alone, else 0
    creep: float  # 1 where friction is fed forward at the load's own speed, else 0

    @property
    def friction(self) -> Friction:
        """The friction that is fed forward."""
        return Friction(*self[3:9])


def is_sound(m: Model, p: Controller) -> bool:
    """Whether each number is one of its kind, and all go together."""
    dry = m.coulomb_n > 0.0
    forceful = m.force_rate_rad_s > 0.0 or m.friction != p.friction
    return (
        min(m.dead_zone_v, m.coulomb_n, m.viscous_n_s_m, m.stiffness_n_m, m.damping_n_s_m) >= 0.0
        and m.dead_zone_v + abs(m.centre_v) < p.valve.u_max_v
        and (not p.valve.bent or (m.dead_zone_v, m.centre_v) == (p.valve.dead_zone_v, p.valve.centre_v))
        and 0.0 <= m.hold_v <= MOST_HOLD_V
        and m.static_n >= m.coulomb_n
        and m.stribeck_m_s > 0.0
        and (m.stiffness_n_m > 0.0 or not dry)
        and 0.0 <= m.motion_rad_s <= MOST_RAD_S
        and (m.push_rad_s == 0.0 or m.motion_rad_s <= m.push_rad_s <= MOST_PUSH_RATIO * m.motion_rad_s)
        and m.push_beyond_m >= 0.0
        and 0.0 <= m.force_rate_rad_s <= MOST_RAD_S
        and (p.use_force or not forceful)
        and {m.standstill, m.creep} <= {0.0, 1.0}
    )


def is_bearable(m: Model, p: Controller) -> bool:
    """Whether the loop can have a sound one: no dead zone and no friction that no rig has.

    More than there is of either, made up for in full, drives the load on where it should stand.
    """
    piston_n = (p.gas.supply_pa - p.gas.atmosphere_pa) * min(p.cylinder.A1, p.cylinder.A2)
    return m.dead_zone_v <= WIDEST * p.valve.u_max_v and m.static_n < piston_n


def remodelled(m: Model, p: Controller) -> Controller:
    """The controller with other numbers; law and gains stay."""
    step_m, h, M = 2.0 * p.motion.blind_m, p.h, p.cylinder.M
    motion = motion_filter(m, h, step_m) if m.motion_rad_s > 0.0 else p.motion
    hold = hold_v(m.hold_v, M * p.sliding.gains.k1, step_m, p.cylinder.F1_nominal)
    edges = p.adaptation.edges._replace(most=most_edge_v(m.dead_zone_v, p.valve.u_max_v))
    stiffness = p.adaptation.stiffness._replace(most=stiffest(m.coulomb_n, m.stiffness_n_m, step_m))
    return p._replace(
        valve=p.valve._replace(dead_zone_v=m.dead_zone_v, centre_v=m.centre_v),
        friction=m.friction,
        motion=motion,
        sliding=p.sliding._replace(hold_v=hold),
        force_rate_gain=force_rate_gain(m.force_rate_rad_s, h),
        standstill=standing(m, motion, M, step_m, h, p.valve.u_max_v),
        adaptation=p.adaptation._replace(edges=edges, stiffness=stiffness),
        creep=creeping(m, behind(m.friction, motion, M, h)),
    )


def as_replayed(logged: Controller, own: Controller, other: Controller) -> Controller:
    """What of a model was changed in a run stays; all else is another's.

    Args:
        logged: of the run.
        own: with which it began.
        other: with which a replay begins, and its law.
    """
    parts = ("valve", "friction", "motion", "force_rate_gain", "standstill", "adaptation", "creep")
    stays = {name: getattr(logged, name) for name in parts if getattr(logged, name) != getattr(own, name)}
    if logged.sliding.hold_v != own.sliding.hold_v:
        stays["sliding"] = other.sliding._replace(hold_v=logged.sliding.hold_v)
    return other._replace(**stays)


def motion_filter(m: Model, h: float, step_m: float) -> MotionFilter:
    """The motion filter of a bandwidth, for an encoder of a step."""
    found = triple_pole(m.motion_rad_s, h, 0.5 * step_m)
    if m.push_rad_s == 0.0:
        return found
    # a step of the encoder is no push
    return quickened(found, triple_pole(m.push_rad_s, h), max(m.push_beyond_m, step_m))


def force_rate_gain(rad_s: float, h: float) -> float:
    """Gain of the low-pass for the rate of F̂."""
    return 1.0 - math.exp(-rad_s * h)


def hold_v(most_v: float, stiffness: float, step_m: float, F1_nominal: float) -> float:
    """Opening [V] that is not worth a way across the dead zone.

    Nor more than what the law asks for where the load is off by half a step of the encoder: on a small axis,
    whose law asks for little, it would stand beside its target.

    Args:
        most_v: as configured.
        stiffness: rate of the force that the law asks for by position error, M k1.
        step_m: of the encoder.
        F1_nominal: rate of the force by opening.
    """
    return min(most_v, stiffness * max(LEAST_HELD_M, 0.5 * step_m) / F1_nominal)


def most_edge_v(dead_zone_v: float, u_max_v: float) -> float:
    """The farthest from zero that an edge of the dead zone may be learnt to be [V]."""
    return max(MOST_EDGE * u_max_v, dead_zone_v)


def stiffest(coulomb_n: float, stiffness_n_m: float, step_m: float) -> float:
    """Factor up to which bristles are learnt to be stiffer: they bend by some steps of the encoder."""
    told_n = LEAST_BENT * step_m * stiffness_n_m  # of friction that bends them by just that
    return max(1.0, coulomb_n / told_n) if coulomb_n < MOST_STIFFER * told_n else MOST_STIFFER


def behind(f: Friction, motion: MotionFilter, M: float, h: float) -> float:
    """How far the motion filter lags behind friction that falls with speed: its lag times that pole."""
    fall_n = max(0.0, f.static_n - f.coulomb_n)
    if f.sigma0_n_m <= 0.0 or fall_n == 0.0:
        return 0.0
    pole_rad_s = STEEPEST * fall_n / (f.stribeck_m_s * M)
    return pole_rad_s * 3.0 / seen_rad_s(motion, h)


def seen_rad_s(motion: MotionFilter, h: float) -> float:
    """Bandwidth of the motion filter, by that of a triple pole."""
    omega_rad_s: float = motion.gamma ** (1.0 / 3.0) / h
    return omega_rad_s


def calmer(motion: MotionFilter, h: float) -> MotionFilter:
    """A filter that takes less of what noise explains, and as much as before of what lies beyond."""
    omega_rad_s = -math.log1p(-seen_rad_s(motion, h) * h) / h
    return quickened(triple_pole(omega_rad_s / MOST_PUSH_RATIO, h, motion.blind_m), motion, motion.noise_m)


def creeping(m: Model, lag: float) -> Creep:
    """Where the load's own speed is fed forward: as far as the motion filter knows it in time.

    Friction that falls with speed makes a pole; where the filter lags behind it, it would be fed too late.
    """
    if not m.creep or lag == 0.0:
        return Creep()
    return Creep(1.0 / (1.0 + lag**8), 3.0 * m.stribeck_m_s, m.stribeck_m_s / PASSING_S)


def standing(m: Model, motion: MotionFilter, M: float, step_m: float, h: float, u_max_v: float) -> Standstill:
    """When a load counts as standing still: from mass, friction and the encoder's step.

    Where a swing on the bristles dies at once, or is too fast for the motion filter, the law does no good: it
    soon gives way, and to a load that hunts at any error from which nudges find home. Elsewhere a coarse
    encoder is what keeps the law busy, and the load swinging: there it hears less of it. Where the swing is
    slow, and the law is, it keeps the load, and is quiet.
    """
    if not m.standstill or m.stiffness_n_m <= 0.0 or m.coulomb_n <= 0.0:
        return Standstill()
    omega = math.sqrt(m.stiffness_n_m / M)
    enter_m, stick_m = max(6e-6, 0.8 * step_m), max(0.6e-6, 1.1 * step_m)
    # a force that friction does not hold would have moved the load by more than that in this time
    stick = max(8, math.ceil(math.sqrt(2.0 * M * stick_m / (BALANCE * m.coulomb_n)) / h))
    swing_s = 2.0 * math.pi / omega
    dies_out = 0.5 * m.damping_n_s_m / M * GRACE_S >= DIED
    seen = seen_rad_s(motion, h)
    beyond = dies_out or omega > BEYOND * seen
    coarse = step_m >= COARSE_M and not beyond
    slow = coarse and omega < SLOW_RAD_S and QUIET_S * seen < 1.0
    leave_m = max(11e-6, 1.3 * step_m)
    return Standstill(
        enter_m=enter_m,
        leave_m=leave_m,
        near_m=NEAR_M,
        far_m=FAR_M,
        hunts_m=FAR_M if beyond else NEAR_M,
        leave_m_s=4e-3 + 50.0 * step_m,
        mass_kg=M,
        swing=max(1, round(max(0.02, swing_s) / h)),
        smooth=1.0 - math.exp(-h / SMOOTH_S),
        stuck=max(round(1.5 * stick), round(0.6 * swing_s / h)),
        patience=round((BRIEF_S if beyond else PATIENCE_S) / h),
        grace=round(GRACE_S / h),
        restless=1.0 - math.exp(-h / 0.05),
        restless_v=RESTLESS_V,
        nudge_v=0.1 * u_max_v,
        stick_m=stick_m,
        stick=stick,
        held=1.0 - math.exp(-h / 0.01),
        settle=round((GRACE_S if beyond else SETTLE_S) / h),
        shut_v=SHUT * u_max_v,
        firm=FIRM if h <= BRISK_S else 1.0,
        again=AGAIN if coarse else 1,
        wait_m=WAIT * leave_m if coarse else 0.0,
        trusts=coarse,
        calm=round(CALM_S / h) if coarse else 0,
        filter=calmer(motion, h) if coarse else motion,
        quiet=1.0 - math.exp(-h / QUIET_S) if slow else 0.0,
    )
