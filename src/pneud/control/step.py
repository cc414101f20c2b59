"""The controller of one tick in two pure functions: what is so (`observe`), and what to do about it (`act`).

State goes in and comes out; nothing is kept. The same functions run in the loop, in simulation, in replay and
compiled by numba.
"""

from typing import NamedTuple

from pneud.control.adaptation import (
    Adaptation,
    Learnt,
    cylinder_learnt,
    friction_learnt,
    learn_force,
    learn_valve,
    values_of,
    valve_learnt,
)
from pneud.control.disturbance import Observer, ObserverState
from pneud.control.disturbance import observe as observe_disturbance
from pneud.control.feedforward import (
    Creep,
    bristles_under,
    friction_ahead,
    friction_creeping,
    friction_felt,
    held_by_bristles,
    recalled,
)
from pneud.control.laws.situation import LawOutput, Situation, errors
from pneud.control.laws.sliding import Sliding, SlidingState, command, engage, firmer, law, resistance
from pneud.control.laws.slot import SLIDING, Slot, SlotState, afterwards, demand, joined, taken_over
from pneud.control.motion import MotionFilter, MotionState, at_rest, correct, held, predict
from pneud.control.prediction import Motion, Rates, Spool, ahead, follow, later
from pneud.control.standstill import (
    LAW,
    Standstill,
    StandstillState,
    is_calm,
    is_firm,
    is_held,
    is_quiet,
    is_still,
    keeps_shut,
    nudge,
    quieted,
    read,
    stand,
    stirred,
)
from pneud.physics.cylinder import F0, Cylinder, F1_exhaust, F1_fill, x3_of
from pneud.physics.friction import Friction, relaxation_rate
from pneud.physics.gas import Gas
from pneud.physics.valve import SpoolTransition, Valve, dead_zone_inverse, opening, spool_transition
from pneud.signals import Estimate, Reference

NAN = float("nan")
STILL_RATE = 0.5  # of the rate of F̂ that is fed forward at rest, where much of it answers the law itself
RECALL = 0.05  # share of what F̂ says of the bristles of a standing load that is believed in a tick
SLIDES_M_S = 5e-3  # faster, a load slides
X1_MARGIN = 1e-3  # least chamber length the model is evaluated at [m]


class Controller(NamedTuple):
    """All parameters of the controller."""

    h: float  # nominal sample time [s]
    delay_s: float  # from the sampling instant until the command of that sample acts
    spool_before: SpoolTransition  # of the valve's spool over delay_s
    lead_s: float  # from the sampling instant until the command has its effect; 0 to predict nothing
    spool_ahead: SpoolTransition  # over half of lead_s
    gas: Gas
    cylinder: Cylinder
    valve: Valve
    friction: Friction  # fed forward along the reference; all zero for none
    motion: MotionFilter
    observer: Observer
    sliding: Sliding
    use_x3_hat: bool  # x̂3 of the observer in place of x3: less noise
    use_force: bool  # F̂ in w3
    force_rate_gain: float  # of the low-pass for the rate of F̂ in Z; 0 leaves it out
    blend_kept: float = 0.0  # part of the blend that is left a sample later
    slot: Slot = Slot()  # which law runs
    standstill: Standstill = Standstill()
    adaptation: Adaptation = Adaptation()
    creep: Creep = Creep()


class ControllerState(NamedTuple):
    """All state of the controller."""

    motion: MotionState
    observer: ObserverState
    sliding: SlidingState
    spool: Spool
    applied_v: float  # command that acted when the last sample was taken
    f0: float  # F0 at the last sample [N/m]
    f1_fill: float  # F1 at the last sample [N/(s V)]
    f1_exhaust: float
    force_rate: float  # rate of F̂ beyond the friction fed forward [N/s]
    bristles_m: float  # of the friction fed forward
    force_step_n: float  # that friction's gain until the next sample
    blend: float = 0.0  # leads from one law or set of gains to another [m/s³]
    own: SlotState = SlotState()
    standstill: StandstillState = StandstillState()
    learnt: Learnt = Learnt()


def start(position_m: float, p1_pa: float, p2_pa: float, supply_pa: float, p: Controller) -> ControllerState:
    """State of a load at rest with the valve centred."""
    x1 = chamber_length(position_m, p.cylinder)
    x3 = x3_of(p1_pa, p2_pa, p.cylinder)
    return ControllerState(
        motion=at_rest(position_m, x3, p.cylinder.rod_force_n),
        observer=ObserverState(x3, 0.0, 0.0),
        sliding=SlidingState(0.0),
        spool=Spool(0.0, 0.0),
        applied_v=0.0,
        f0=F0(x1, p1_pa, p2_pa, p.cylinder, p.gas),
        f1_fill=F1_fill(x1, p1_pa, p2_pa, supply_pa, p.cylinder, p.gas),
        f1_exhaust=F1_exhaust(x1, p1_pa, p2_pa, supply_pa, p.cylinder, p.gas),
        force_rate=0.0,
        bristles_m=0.0,
        force_step_n=0.0,
    )


def resume(
    position_m: float, p1_pa: float, p2_pa: float, supply_pa: float, p: Controller, learnt: Learnt
) -> ControllerState:
    """As `start`, with what has been learnt before."""
    state = start(position_m, p1_pa, p2_pa, supply_pa, as_learnt(p, learnt))
    return kept(state, state.bristles_m, state.standstill, values_of(learnt))


def as_learnt(p: Controller, learnt: Learnt) -> Controller:
    """The controller with what has been learnt in place of what is configured."""
    if not p.adaptation.enabled:
        return p
    valve, cylinder, g = valve_learnt(p.valve, learnt), cylinder_learnt(p.cylinder, learnt), p.sliding
    lead_s, spool_before, spool_ahead = p.lead_s, p.spool_before, p.spool_ahead
    if learnt.lag != 1.0:
        if lead_s > 0.0:
            lead_s += 2.0 * p.valve.zeta / p.valve.omega_rad_s * (learnt.lag - 1.0)
        spool_before = spool_transition(p.delay_s, valve)
        spool_ahead = spool_transition(0.5 * lead_s, valve)
    sliding = Sliding(
        g.gains,
        g.eta,
        g.implicit,
        g.horizon_s + (lead_s - p.lead_s),
        g.compensate_d,
        cylinder.M,
        g.invert_dead_zone,
        g.hold_v,
    )
    return Controller(
        p.h,
        p.delay_s,
        spool_before,
        lead_s,
        spool_ahead,
        p.gas,
        cylinder,
        valve,
        friction_learnt(p.friction, learnt),
        p.motion,
        p.observer,
        sliding,
        p.use_x3_hat,
        p.use_force,
        p.force_rate_gain,
        p.blend_kept,
        p.slot,
        p.standstill,
        p.adaptation,
        p.creep,
    )


def chamber_length(position_m: float, c: Cylinder) -> float:
    """Effective displacement x1 [m] of a stroke position, kept where the model has no singularity."""
    return max(X1_MARGIN, min(c.L - X1_MARGIN, position_m + c.x_e1))


def observe(
    state: ControllerState,
    position_m: float,
    measured: bool,
    p1_pa: float,
    p2_pa: float,
    supply_pa: float,
    applied_v: float,
    dt: float,
    p: Controller,
) -> tuple[ControllerState, Estimate]:
    """Take one sample in.

    Args:
        state: after the last sample.
        position_m: encoder, stroke coordinate.
        measured: False where this tick has no encoder reading; the filter then only predicts.
        p1_pa: pressure of chamber 1, absolute.
        p2_pa: pressure of chamber 2, absolute.
        supply_pa: supply pressure, absolute.
        applied_v: command acting when this sample was taken.
        dt: time since the last sample [s].
        p: parameters.

    Returns:
        The state after this sample, and what is believed.
    """
    prior, p = p, as_learnt(p, state.learnt)
    c, standstill = p.cylinder, state.standstill
    x3 = x3_of(p1_pa, p2_pa, c)
    motion = predict(state.motion, x3, state.force_step_n, c.rod_force_n, c.M, dt)
    if measured:
        calm = is_calm(standstill, p.standstill)
        motion = correct(motion, position_m, c.M, p.h, p.standstill.filter if calm else p.motion)
        standstill = read(standstill, position_m, p.standstill)
        if is_held(standstill, p.standstill):
            motion = held(motion, c.rod_force_n, p.standstill.held)
    x1 = chamber_length(motion.x, c)
    f0 = F0(x1, p1_pa, p2_pa, c, p.gas)
    f1_fill = F1_fill(x1, p1_pa, p2_pa, supply_pa, c, p.gas)
    f1_exhaust = F1_exhaust(x1, p1_pa, p2_pa, supply_pa, c, p.gas)

    # the command before the last one acts for delay_s, then the last one
    before = min(p.delay_s, dt)
    after = dt - before
    middle = follow(state.spool, state.applied_v, p.spool_before)
    spool = follow(middle, applied_v, spool_transition(after, p.valve))
    u1, u2 = opening(middle.position_v, p.valve), opening(spool.position_v, p.valve)
    if p.valve.omega_rad_s == 0.0:
        u_mean = (before * u1 + after * u2) / dt  # without lag it jumps at the start of each part
    else:
        u_mean = 0.5 * (before * (opening(state.spool.position_v, p.valve) + u1) + after * (u1 + u2)) / dt

    f1_sum = state.f1_fill + f1_fill if u_mean >= 0.0 else state.f1_exhaust + f1_exhaust
    f_mean = 0.5 * (state.f0 * state.motion.v + f0 * motion.v + f1_sum * u_mean)
    learnt = state.learnt
    if p.adaptation.enabled:
        fresh = measured and dt < 1.5 * p.h
        missing_v = 2.0 * ((x3 - state.motion.x3) / dt - f_mean) / f1_sum
        learnt = learn_valve(learnt, fresh, missing_v, u_mean, spool, motion.v, dt, prior.valve, p.adaptation)
    observer = observe_disturbance(state.observer, x3, f_mean, dt, p.observer)
    found = (motion.F - state.motion.F - state.force_step_n) / dt
    force_rate = state.force_rate + p.force_rate_gain * (found - state.force_rate)
    return (
        ControllerState(
            motion,
            observer,
            state.sliding,
            spool,
            applied_v,
            f0,
            f1_fill,
            f1_exhaust,
            force_rate,
            state.bristles_m,
            0.0,  # until `act` knows better
            state.blend,
            state.own,
            standstill,
            learnt,
        ),
        Estimate(motion.x, motion.v, motion.F, x3, observer.x_hat, observer.d_hat, motion.innovation, u_mean),
    )


def at_sample(e: Estimate, p: Controller) -> Motion:
    """The motion when the sample was taken, with all forces that are known."""
    x3 = e.x3_hat_n if p.use_x3_hat else e.x3_n
    force = x3 - p.cylinder.rod_force_n - (e.force_n if p.use_force else 0.0)
    return Motion(e.position_m, e.velocity_m_s, force)


def at_effect(state: ControllerState, e: Estimate, gained_n: float, p: Controller) -> Motion:
    """The motion when this tick's command has its effect, the unmatched force having gained `gained_n`."""
    now = at_sample(e, p)
    if p.lead_s <= 0.0:
        return now
    rest = (e.d_hat_n_s if p.sliding.compensate_d else 0.0) - gained_n / p.lead_s
    rates = Rates(state.f0, state.f1_fill, state.f1_exhaust, rest)
    return ahead(
        now, state.spool, state.applied_v, 0.5 * p.lead_s, p.spool_ahead, p.cylinder.M, rates, p.valve
    )


def situation(state: ControllerState, e: Estimate, r: Reference, p: Controller) -> Situation:
    """What a law is asked about, for an estimate and a reference of the same instant."""
    M = p.cylinder.M
    goal = later(r, p.lead_s)
    force_rate = state.force_rate
    if p.standstill.enter_m > 0.0 and is_still(r, goal):
        friction = friction_felt(state.bristles_m, e.velocity_m_s, p.h, p.lead_s, p.friction)
        force_rate *= STILL_RATE
    elif is_still(r, goal):
        friction = friction_ahead(state.bristles_m, r, goal, p.h, p.lead_s, p.friction)
    else:
        friction = friction_creeping(
            state.bristles_m, r, goal, e.velocity_m_s, p.h, p.lead_s, p.friction, p.creep
        )
    motion = at_effect(state, e, friction.ahead_n + p.lead_s * state.force_rate, p)
    w1, w2, w3 = errors(motion, goal, M)
    return Situation(
        e,
        at_sample(e, p),
        motion,
        goal,
        w1,
        w2,
        w3,
        motion.force_n + (e.force_n if p.use_force else 0.0),
        friction,
        force_rate,
        state.f0,
        state.f1_fill,
        state.f1_exhaust,
        state.spool,
        state.applied_v,
        p.h,
        M,
        p.lead_s,
        p.spool_ahead,
        p.valve,
        p.motion,
    )


def join(state: ControllerState, e: Estimate, r: Reference, p: Controller) -> ControllerState:
    """The state with s(0) = 0 for a law that takes over now; the bristles take what force they can."""
    p, force_n = as_learnt(p, state.learnt), e.force_n - state.learnt.load_n
    bristles_m = bristles_under(force_n, p.friction)
    state = carried(state, state.sliding, bristles_m, 0.0, 0.0, state.own)
    s = situation(state, e, r, p)
    own = joined(s, e.force_n - held_by_bristles(force_n, p.friction), p.slot)
    return carried(state, engage(s.w3), bristles_m, 0.0, 0.0, own)


def join_in_motion(state: ControllerState, e: Estimate, r: Reference, p: Controller) -> ControllerState:
    """As `join`, for a load that moves: its bristles are bent as far as that speed bends them in the end."""
    if abs(e.velocity_m_s) <= SLIDES_M_S:
        return join(state, e, r, p)
    p = as_learnt(p, state.learnt)
    rate = relaxation_rate(e.velocity_m_s, p.friction)
    bristles_m = e.velocity_m_s / rate if rate > 0.0 else 0.0
    state = carried(state, state.sliding, bristles_m, 0.0, 0.0, state.own)
    s = situation(state, e, r, p)
    return carried(state, engage(s.w3), bristles_m, 0.0, 0.0, joined(s, e.force_n - s.friction.now_n, p.slot))


def change(
    state: ControllerState, e: Estimate, r: Reference, before: Controller, after: Controller
) -> ControllerState:
    """The state with which the next command under another law or other gains is that of the one before."""
    if not alike(before, after):
        return _believe(state, e, r, before, after)
    before, after = as_learnt(before, state.learnt), as_learnt(after, state.learnt)
    s = situation(state, e, r, after)
    sliding, own = state.sliding, taken_over(state.own, s, before.slot, after.slot)
    if before.slot.kind != SLIDING:
        sliding = engage(s.w3)
    changed = carried(state, sliding, state.bristles_m, state.force_step_n, state.blend, own)
    blend = state.blend + _resistance(state, e, r, before) - _resistance(changed, e, r, after)
    return carried(changed, sliding, state.bristles_m, state.force_step_n, blend, own)


def _believe(
    state: ControllerState, e: Estimate, r: Reference, before: Controller, after: Controller
) -> ControllerState:
    """As `change`, where what is believed of valve and friction, or a filter, changes as well."""
    _, usual = act(state, e, r, before)
    had, learnt = as_learnt(before, state.learnt), forgotten(state.learnt, before, after)
    p, held_n = as_learnt(after, learnt), had.friction.sigma0_n_m * state.bristles_m
    state = kept(state, bristles_under(held_n, p.friction), state.standstill, learnt)
    s = situation(state, e, r, p)
    sliding, own = state.sliding, taken_over(state.own, s, before.slot, after.slot)
    if before.slot.kind != SLIDING:
        sliding = engage(s.w3)
    changed = carried(state, sliding, state.bristles_m, state.force_step_n, 0.0, own)
    if p.standstill.enter_m > 0.0 and state.standstill.mode != LAW:  # a valve that is closed, where it is now
        return changed
    opening_v = usual.u_v
    if p.sliding.invert_dead_zone:
        opening_v = opening(opening_v, p.valve)
    u_max = p.valve.u_max_v
    opening_v = max(-u_max, min(u_max, opening_v))
    coming = opening_v * (s.f1_fill if opening_v >= 0.0 else s.f1_exhaust)
    wanted = s.M * (s.goal.jerk_m_s3 - _resistance(changed, e, r, p)) + s.friction.rate_n_s + s.force_rate
    blend = (wanted - coming) / s.M
    return carried(changed, sliding, state.bristles_m, state.force_step_n, blend, own)


def alike(p: Controller, q: Controller) -> bool:
    """Whether two controllers differ in law and gains alone."""
    return (
        p.valve == q.valve
        and p.friction == q.friction
        and p.motion == q.motion
        and p.sliding.hold_v == q.sliding.hold_v
        and p.force_rate_gain == q.force_rate_gain
    )


def forgotten(so_far: Learnt, before: Controller, after: Controller) -> Learnt:
    """What has been learnt, but for what is changed: that is learnt anew from its new value."""
    if before.valve != after.valve:
        so_far = so_far._replace(edge_plus_v=0.0, edge_minus_v=0.0)
    if before.friction != after.friction:
        so_far = so_far._replace(friction=1.0, stiffness=1.0)
    return so_far


def forget(state: ControllerState, before: Controller, after: Controller) -> ControllerState:
    """The state of an axis that nobody leads, as `change` has it of one that is led."""
    return kept(state, state.bristles_m, state.standstill, forgotten(state.learnt, before, after))


def unlearnt(state: ControllerState, learnt: Learnt) -> ControllerState:
    """The state of a tick from which nothing is learnt beyond what has been."""
    return kept(state, state.bristles_m, state.standstill, learnt)


def _resistance(state: ControllerState, e: Estimate, r: Reference, p: Controller) -> float:
    """What the law in the slot takes from the jerk of the reference, without blend [m/s³]."""
    s = situation(state, e, r, p)
    if p.slot.kind == SLIDING:
        drift = state.f0 * s.motion.v / s.M
        q = arriving(is_still(r, s.goal), state.standstill, p)
        return drift + resistance(state.sliding, s.w1, s.w2, s.w3, e.d_hat_n_s, p.h, q)
    _, Z = demand(state.own, s, p.slot)
    return s.goal.jerk_m_s3 + (s.friction.rate_n_s + s.force_rate - Z) / s.M


def act(
    state: ControllerState, e: Estimate, r: Reference, p: Controller
) -> tuple[ControllerState, LawOutput]:
    """The command for an estimate and a reference of one instant: the law's, or that of a standing load."""
    prior, p = p, as_learnt(p, state.learnt)
    s = situation(state, e, r, p)
    learnt = taught(state.learnt, s, r, prior, p)
    if p.standstill.enter_m <= 0.0:
        state, out = tracked(state, s, p.sliding, p)
        return kept(state, state.bristles_m, state.standstill, learnt), out
    still, friction_n = is_still(r, s.goal), e.force_n - learnt.load_n
    error_m = s.goal.position_m - e.position_m
    standstill = stand(
        state.standstill,
        error_m,
        e.velocity_m_s,
        s.now.force_n,
        e.x3_hat_n,
        friction_n,
        still,
        p.friction if p.standstill.trusts else prior.friction,
        p.standstill,
    )
    bristles_m = s.friction.bristles_m
    if still:
        bristles_m = recalled(bristles_m, friction_n, RECALL, p.friction)
    if standstill.mode != LAW:
        state, out = left_alone(state, standstill, friction_n, s, p)
    else:
        state, out = tracked(state, s, arriving(still, standstill, p), p)
        if still:
            asked_v = opening(out.u_v, p.valve)
            shut = opening(state.applied_v, p.valve) == 0.0
            if is_quiet(standstill, p.friction, p.standstill):
                standstill = quieted(standstill, asked_v, p.standstill)
                out = LawOutput(dead_zone_inverse(standstill.given_v, p.valve, 0.0), out.s, out.ustar)
            elif keeps_shut(error_m, asked_v, shut, p.standstill):
                out = LawOutput(dead_zone_inverse(0.0, p.valve, 0.0), out.s, out.ustar)
            u_max = p.valve.u_max_v
            step_v = abs(max(-u_max, min(u_max, out.u_v)) - state.applied_v)
            standstill = stirred(standstill, step_v, p.standstill)
    return kept(state, bristles_m, standstill, learnt), out


def arriving(still: bool, s: StandstillState, p: Controller) -> Sliding:
    """The law's parameters: firmer ones while a load comes to rest, as long as giving way may be of use."""
    return firmer(p.sliding, p.standstill.firm) if still and is_firm(s, p.standstill) else p.sliding


def taught(so_far: Learnt, s: Situation, r: Reference, prior: Controller, p: Controller) -> Learnt:
    """What has been learnt once the force has been looked at, the parameters as configured and as learnt."""
    if not p.adaptation.enabled:
        return so_far
    return learn_force(
        so_far,
        s.e.force_n,
        s.friction.now_n,
        s.e.velocity_m_s,
        r.velocity_m_s,
        s.e.x3_n - p.cylinder.rod_force_n,
        s.e.innovation_m,
        p.h,
        p.cylinder.M,
        prior.friction,
        p.motion,
        p.adaptation,
    )


def left_alone(
    state: ControllerState, standstill: StandstillState, friction_n: float, s: Situation, p: Controller
) -> tuple[ControllerState, LawOutput]:
    """A load that stands: the valve closed or nudging, and the law ready to take over with s = 0."""
    u_v = nudge(standstill, s.e.x3_hat_n, p.h, s.f1_fill, s.f1_exhaust, p.standstill)
    if p.sliding.invert_dead_zone:
        u_v = dead_zone_inverse(u_v, p.valve, 0.0)
    own = joined(s, s.e.force_n - held_by_bristles(friction_n, p.friction), p.slot)
    state = carried(state, engage(s.w3), state.bristles_m, 0.0, state.blend * p.blend_kept, own)
    return state, LawOutput(u_v, 0.0, 0.0)


def tracked(
    state: ControllerState, s: Situation, q: Sliding, p: Controller
) -> tuple[ControllerState, LawOutput]:
    """The law's command in a situation; `q` are the parameters that hold for the sliding law in this tick."""
    friction, blend = s.friction, state.blend * p.blend_kept
    if p.slot.kind != SLIDING:
        own, Z = demand(state.own, s, p.slot)
        Z -= s.M * state.blend
        wanted = Z / (s.f1_fill if Z >= 0.0 else s.f1_exhaust)
        own = afterwards(own, s, Z, abs(wanted) <= p.valve.u_max_v, p.slot)
        u_v = command(wanted, state.applied_v, p.sliding, p.valve)
        state = carried(state, state.sliding, friction.bristles_m, friction.step_n, blend, own)
        return state, LawOutput(u_v, NAN, NAN)
    sliding, out = law(
        state.sliding,
        s.w1,
        s.w2,
        s.w3,
        s.goal.jerk_m_s3,
        state.f0 * s.motion.v,
        s.e.d_hat_n_s,
        friction.rate_n_s + s.force_rate,
        state.f1_fill,
        state.f1_exhaust,
        p.h,
        q,
        p.valve,
        state.applied_v,
        state.blend,
    )
    return carried(state, sliding, friction.bristles_m, friction.step_n, blend, state.own), out


def carried(
    s: ControllerState,
    sliding: SlidingState,
    bristles_m: float,
    force_step_n: float,
    blend: float,
    own: SlotState,
) -> ControllerState:
    """The state with what a law leaves in it; written out, since numba knows no _replace."""
    return ControllerState(
        s.motion,
        s.observer,
        sliding,
        s.spool,
        s.applied_v,
        s.f0,
        s.f1_fill,
        s.f1_exhaust,
        s.force_rate,
        bristles_m,
        force_step_n,
        blend,
        own,
        s.standstill,
        s.learnt,
    )


def kept(
    s: ControllerState, bristles_m: float, standstill: StandstillState, learnt: Learnt
) -> ControllerState:
    """The state with what is known of standstill and model; written out likewise."""
    return ControllerState(
        s.motion,
        s.observer,
        s.sliding,
        s.spool,
        s.applied_v,
        s.f0,
        s.f1_fill,
        s.f1_exhaust,
        s.force_rate,
        bristles_m,
        s.force_step_n,
        s.blend,
        s.own,
        standstill,
        learnt,
    )
