"""What drifts and what nobody knows exactly, learnt slowly and within bounds while the axis moves.

Two gradients descend. What the pressures do beyond their model, seen in volts of opening, moves the edges of
the valve's dead zone, its flow gain and its lag. What the unmatched force has beyond the friction that is fed
forward moves friction's level and stiffness, the load and the mass. All is told as a difference or a factor
of what is configured, so that the default state is the configuration itself.
"""

from typing import NamedTuple

from pneud.control.feedforward import bristles_after
from pneud.control.motion import MotionFilter
from pneud.control.prediction import Spool
from pneud.physics.cylinder import Cylinder
from pneud.physics.friction import Friction, friction_force, relaxation_rate, stribeck
from pneud.physics.valve import Valve

MOVING_M_S = 3e-3  # slower is no motion to learn from
SATURATED = 0.98  # part of the greatest opening beyond which the valve is taken as saturated
EDGE_V = 0.25  # opening up to which the edges are learnt: what is missing of a wide one is flow
OPENING_V = 0.5  # opening at which the flow is learnt best
LAG_V = 0.2  # lagging behind by so much, the lag is
BENT = 0.05  # part of the friction that bristles which are bent for good may lack
STIFFER = 0.01  # part by which the stiffness changes in a sample at most
LAGGING = 0.05  # part of the friction by which F̂ may lag behind the reference's, for bristles to be stiffer
PLAIN = 0.18  # part of the friction that may be amiss without a word of its bristles
SLIDING_M_S = 2e-2  # slower, bristles may hold a load that is shaken
SHAKE_M = 1e-5  # innovation by which the mass is: a load that shakes


class Rate(NamedTuple):
    """How fast a value is learnt, and its bounds; a rate of 0 leaves it as it is configured."""

    per_s: float = 0.0
    least: float = 1.0
    most: float = 1.0


class Adaptation(NamedTuple):
    """What is learnt: differences for edges [V] and load [N], factors for all others."""

    enabled: bool = False
    edges: Rate = Rate(0.0, 0.0, 0.0)  # bounds of an edge's distance from zero [V]
    flow: Rate = Rate()
    lag: Rate = Rate()
    friction: Rate = Rate()
    stiffness: Rate = Rate()
    load: Rate = Rate(0.0, 0.0, 0.0)
    mass: Rate = Rate()


class Shake(NamedTuple):
    """What the motion filter would be off by if the load had been pushed twice as much as it believed."""

    x: float = 0.0  # [m]
    v: float = 0.0  # [m/s]
    a: float = 0.0  # [m/s²]
    pushed: float = 0.0  # [m/s²] at the last sample


class Learnt(NamedTuple):
    """What has been learnt, relative to the configuration."""

    edge_plus_v: float = 0.0  # added to the dead zone's edge for u > 0
    edge_minus_v: float = 0.0  # likewise for u < 0, as a distance from zero
    flow: float = 1.0  # factor of the flow
    lag: float = 1.0  # factor of the spool's lag
    friction: float = 1.0  # factor of the friction
    stiffness: float = 1.0  # factor of the bristles' stiffness
    load_n: float = 0.0  # force against the motion that is no friction
    mass: float = 1.0  # factor of the moving mass
    shake: Shake = Shake()
    usable: bool = False  # the last sample may be learnt from
    moving: bool = False  # the reference moved at the last sample
    bent_m: float = 0.0  # bristles, as the load itself has bent them
    plain: bool = False  # friction and load explained the force when these were bent for good last


def values_of(so_far: Learnt) -> Learnt:
    """What has been learnt, without what is remembered of the last samples."""
    return Learnt(
        so_far.edge_plus_v,
        so_far.edge_minus_v,
        so_far.flow,
        so_far.lag,
        so_far.friction,
        so_far.stiffness,
        so_far.load_n,
        so_far.mass,
    )


def within(value: float, r: Rate) -> float:
    """A value kept within its bounds."""
    return max(r.least, min(r.most, value))


def valve_learnt(valve: Valve, so_far: Learnt) -> Valve:
    """The valve with edges and lag as learnt."""
    plus, minus = valve.dead_zone_v + so_far.edge_plus_v, valve.dead_zone_v + so_far.edge_minus_v
    return Valve(
        valve.u_max_v,
        valve.omega_rad_s / so_far.lag,
        valve.zeta,
        0.5 * (plus + minus),
        valve.centre_v + 0.5 * (plus - minus),
        valve.bent,
        valve.plus,
        valve.minus,
    )


def cylinder_learnt(c: Cylinder, so_far: Learnt) -> Cylinder:
    """The cylinder with the valve's flow and the mass as learnt."""
    return Cylinder(
        c.A1,
        c.A2,
        c.M * so_far.mass,
        c.stroke_m,
        c.x_e1,
        c.L,
        c.c1 * so_far.flow,
        c.F1_nominal,
        c.rod_force_n,
        c.vent,
        c.reverse_flow,
        c.exhaust,
    )


def friction_learnt(f: Friction, so_far: Learnt) -> Friction:
    """The friction with level and stiffness as learnt."""
    return Friction(
        f.coulomb_n * so_far.friction,
        f.static_n * so_far.friction,
        f.stribeck_m_s,
        f.viscous_n_s_m * so_far.friction,
        f.sigma0_n_m * so_far.stiffness,
        f.sigma1_n_s_m,
    )


def learn_valve(
    so_far: Learnt,
    fresh: bool,
    missing_v: float,
    u_v: float,
    spool: Spool,
    v: float,
    dt: float,
    valve: Valve,
    p: Adaptation,
) -> Learnt:
    """What the pressures say of the valve, in one sample.

    Args:
        so_far: as learnt.
        fresh: whether all sensors have been read, one sample after the last.
        missing_v: opening that explains what x3 gained beyond its model since the last sample.
        u_v: mean opening meanwhile, as believed.
        spool: as believed now.
        v: velocity [m/s].
        dt: time since the last sample [s].
        valve: as configured.
        p: rates and bounds.
    """
    plus, minus, flow, lag = so_far.edge_plus_v, so_far.edge_minus_v, so_far.flow, so_far.lag
    usable = fresh and abs(spool.position_v) < SATURATED * valve.u_max_v
    if usable and abs(v) >= MOVING_M_S and so_far.moving and u_v != 0.0:
        missing = dt * max(-valve.u_max_v, min(valve.u_max_v, missing_v))  # one odd reading is no valve
        prior = valve.dead_zone_v
        edge = p.edges.per_s * missing * EDGE_V * EDGE_V / (EDGE_V * EDGE_V + u_v * u_v)
        if u_v > 0.0:
            plus = within(prior + plus - edge, p.edges) - prior
        else:
            minus = within(prior + minus + edge, p.edges) - prior
        flow = within(flow + p.flow.per_s * missing * u_v / (OPENING_V * OPENING_V + u_v * u_v), p.flow)
        if valve.omega_rad_s > 0.0:
            behind = 2.0 * valve.zeta / valve.omega_rad_s * lag * spool.rate_v_s
            lag = within(lag - p.lag.per_s * missing * behind / (LAG_V * LAG_V + behind * behind), p.lag)
    return Learnt(
        plus,
        minus,
        flow,
        lag,
        so_far.friction,
        so_far.stiffness,
        so_far.load_n,
        so_far.mass,
        so_far.shake,
        usable,
        False,  # until `learn_force` knows better
        so_far.bent_m,
        so_far.plain,
    )


def learn_force(
    so_far: Learnt,
    force_n: float,
    friction_n: float,
    v: float,
    goal_v: float,
    pushed_n: float,
    innovation_m: float,
    h: float,
    M: float,
    f: Friction,
    filter: MotionFilter,
    p: Adaptation,
) -> Learnt:
    """What the unmatched force says of friction, load and mass, in one sample.

    Args:
        so_far: as learnt so far.
        force_n: F̂ [N].
        friction_n: friction that the reference meets, as learnt [N].
        v: velocity [m/s].
        goal_v: velocity of the reference [m/s].
        pushed_n: force of the pressures on the load [N].
        innovation_m: of this sample's reading.
        h: sample time [s].
        M: moving mass, as learnt [kg].
        f: friction as configured.
        filter: the motion filter.
        p: rates and bounds.
    """
    psi, shake = shaken(so_far.shake, (pushed_n - so_far.load_n - friction_n) / M, h, filter)
    moving = abs(goal_v) >= MOVING_M_S
    level, stiffness, load, mass = so_far.friction, so_far.stiffness, so_far.load_n, so_far.mass
    # over a gap nobody knows how far the load has bent them
    plain, rest = so_far.plain and so_far.usable, force_n - load - friction_n
    own = friction_learnt(f, so_far)
    bent_m = bristles_after(so_far.bent_m, v, relaxation_rate(v, own), h)
    learning = so_far.usable and moving and v * goal_v > 0.0
    if learning and f.coulomb_n > 0.0:
        met_n = friction_force(v, bent_m, own)
        lag_n = -rest if v > 0.0 else rest
        stiffness, plain = stiffness_corrected(so_far, force_n - load - met_n, met_n, lag_n, v, h, f, p)
    if learning and abs(v) >= MOVING_M_S:
        load = within(load + p.load.per_s * h * rest, p.load)
        if f.coulomb_n > 0.0:
            level = level_corrected(level, rest, friction_n, goal_v, h, f, p)
        if abs(goal_v) >= SLIDING_M_S:
            r = innovation_m - max(-filter.blind_m, min(filter.blind_m, innovation_m))
            r = max(-abs(psi), min(abs(psi), r))
            more = r * psi / (SHAKE_M * SHAKE_M + psi * psi)  # of the acceleration that was believed
            mass = within(mass * (1.0 - p.mass.per_s * h * more), p.mass)
    return Learnt(
        so_far.edge_plus_v,
        so_far.edge_minus_v,
        so_far.flow,
        so_far.lag,
        level,
        stiffness,
        load,
        mass,
        shake,
        so_far.usable,
        moving,
        bent_m,
        plain,
    )


def level_corrected(
    level: float, rest_n: float, friction_n: float, goal_v: float, h: float, f: Friction, p: Adaptation
) -> float:
    """Level of the friction after one sample.

    It is learnt where friction changes most, just after a reversal: there alone an error costs.

    Args:
        level: as learnt.
        rest_n: force that friction and load do not explain [N].
        friction_n: friction that the reference meets, as learnt [N].
        goal_v: velocity of the reference [m/s].
        h: sample time [s].
        f: friction as configured, with dry friction in it.
        p: rates and bounds.
    """
    dry = stribeck(goal_v, f) * level
    rest = max(-dry, min(dry, rest_n))
    speed = goal_v / f.stribeck_m_s
    weight = 1.0 / (1.0 + speed * speed * speed * speed)
    step = h / (dry * dry)
    return within(level + p.friction.per_s * step * weight * rest * friction_n * level, p.friction)


def stiffness_corrected(
    so_far: Learnt,
    rest_n: float,
    friction_n: float,
    lag_n: float,
    v: float,
    h: float,
    f: Friction,
    p: Adaptation,
) -> tuple[float, bool]:
    """Stiffness of the bristles after one sample, and whether all force was explained lately.

    Bristles that bend less far than believed hold the load back while the reference goes on: they show as
    force that comes too soon for the way that the load itself has gone. For a moment, a load that changes
    looks just like that: they are learnt after reversals before which nothing was left to explain. F̂ is fed
    forward along the reference: bristles that come sooner there than F̂ does are stiff enough.

    Args:
        so_far: as learnt.
        rest_n: force that load and the friction of the load's own motion do not explain [N].
        friction_n: that friction, as learnt [N].
        lag_n: by which F̂ lags behind load and the reference's friction, in the direction of the motion [N].
        v: velocity of the load [m/s].
        h: sample time [s].
        f: friction as configured, with dry friction in it.
        p: rates and bounds.
    """
    dry = stribeck(v, f) * so_far.friction
    rest = max(-dry, min(dry, rest_n))
    steady = (dry if v > 0.0 else -dry) + f.viscous_n_s_m * so_far.friction * v
    short = steady - friction_n  # what bristles that still bend have not taken yet
    if short * v < 0.0:
        short = 0.0
    odd = rest - max(-PLAIN * dry, min(PLAIN * dry, rest))
    stiffness, plain = so_far.stiffness, so_far.plain
    if abs(short) <= BENT * dry:
        plain = odd == 0.0
    if plain and (odd * short < 0.0 or lag_n <= LAGGING * dry):
        more = max(-STIFFER, min(STIFFER, p.stiffness.per_s * h / (dry * dry) * odd * short))
        stiffness = within(stiffness * (1.0 + more), p.stiffness)
    return stiffness, plain


def shaken(s: Shake, a: float, h: float, p: MotionFilter) -> tuple[float, Shake]:
    """The innovation [m] by an acceleration [m/s²] unknown to the filter, and the state after it."""
    x = s.x + h * (s.v + h * ((s.pushed + s.a) / 3.0 + (a + s.a) / 6.0))
    v = s.v + h * (0.5 * (s.pushed + a) + s.a)
    return x, Shake(x - p.alpha * x, v - p.beta * x / h, s.a - p.gamma * x / (h * h), a)
