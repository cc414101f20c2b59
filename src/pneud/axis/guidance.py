"""Where the axis is led: along its reference, or home, and what requests and changes of state make of it."""

from typing import NamedTuple

from pneud.axis.requests import Asked
from pneud.axis.sensing import NAN, Belief
from pneud.axis.state import AxisParameters, AxisState, configured, learnt_so_far
from pneud.control import force, homing, leading, probe
from pneud.control.force import Press
from pneud.control.homing import Homing
from pneud.control.leading import GANTRY, Led, aim, anew, shifted, skew_m
from pneud.control.plan import IDLE, LED, Plan, follow, halting, resting
from pneud.control.probe import Probe
from pneud.control.reference import rest
from pneud.control.step import ControllerState, change, forget, join, join_in_motion, resume
from pneud.safety.brake import is_holding
from pneud.safety.faults import F
from pneud.safety.supervisor import HOLDING, HOMING, PRESSING, PROBING, STOPPING, is_engaged
from pneud.signals import Measurement, Reference, Told

# an encoder that was silent, wrong or jumped may have lost count
LOSES_REFERENCE = sum(
    1 << fault
    for fault in (F.ENCODER_MISSING, F.ENCODER_CORRUPT, F.ENCODER_FROZEN, F.ENCODER_ERROR, F.ENCODER_JUMP)
)
# plain numbers: to get at a member of an enumeration takes longer than most of what is done with it
TRAVEL, TRACKING_ERROR, OPERATOR_LOST = 1 << F.TRAVEL, 1 << F.TRACKING_ERROR, 1 << F.OPERATOR_LOST
SKEW, LED_BEYOND = 1 << F.SKEW, 1 << F.LED_BEYOND
FORCE_WINDOW, FORCE_SPEED = 1 << F.FORCE_WINDOW, 1 << F.FORCE_SPEED
FORCE_TIMEOUT, FORCE_DIRECTION = 1 << F.FORCE_TIMEOUT, 1 << F.FORCE_DIRECTION
LOAD_DISAGREES = 1 << F.LOAD_DISAGREES
NO_REFERENCE = Reference(NAN, NAN, NAN, NAN)


class Course(NamedTuple):
    """Where the axis is led."""

    plan: Plan  # what the reference is doing
    reference: Reference
    at_rest: bool  # at the end of the plan, of homing, or of a probe
    homing: Homing
    found: bool  # homing has just found the stop: positions count from there
    zero_m: float
    referenced: bool
    controller: ControllerState | None
    present: int  # bits of the faults that hold now
    probe: Probe
    led: Led  # by another axis
    unled: bool  # which it was, and is no longer
    press: Press


def guide(
    state: AxisState,
    belief: Belief,
    m: Measurement,
    present: int,
    p: AxisParameters,
    told: Told | None = None,
    cell_n: float = NAN,
) -> Course:
    """Go on as the ticks before have set it.

    Args:
        state: after the last tick.
        belief: what is known of the load.
        m: the measurement.
        present: bits of the faults that it shows.
        p: parameters.
        told: by another axis.
        cell_n: what a load cell says; NaN where nothing does.
    """
    law, limits, e, before = state.law, p.limits, belief.estimate, state.supervisor.state
    plan, reference, at_rest, way, found = state.plan, NO_REFERENCE, False, state.homing, False
    controller, zero_m, referenced, probed = belief.controller, state.zero_m, state.referenced, state.probe
    led, unled, skew = state.led, False, NAN
    if p.leading.how >= GANTRY:
        skew = skew_m(told, e.position_m, belief.sampled_ns, p.leading)
        if abs(skew) > p.leading.skew_m:
            present |= SKEW
    press = state.press
    if p.homing.incremental and (not referenced or before == HOMING):
        present &= ~TRAVEL  # the stop lies beyond it
    if before == HOMING:
        way, found, at_rest, failed = homing.proceed(
            way, e, belief.sampled_ns, law.h, law.cylinder.rod_force_n, p.homing
        )
        present |= failed << F.HOMING_FAILED
        if found:
            zero_m, referenced = zero_m + p.homing.stop_m - m.position_m, True
            controller = resume(p.homing.stop_m, m.p1_pa, m.p2_pa, m.supply_pa, law, learnt_so_far(state))
    elif before == PROBING:
        probed = probed._replace(lease=probed.lease - 1 - m.skipped)
        present |= (probed.lease < 0) << F.OPERATOR_LOST
        probed, at_rest = probe.proceed(probed, e, m, belief.sampled_ns, law.h, law.cylinder, law.gas)
    elif before == PRESSING:
        dt = (1 + m.skipped) * law.h
        press, ended = force.proceed(press, e, belief.sampled_ns, dt, law, p.pressing, cell_n)
        present |= given_up(ended)
        reference = force.motion_of(e, law, p.motion.acceleration_m_s2)
        if is_holding(state.brake, p.brake):
            reference = rest(e.position_m)  # whatever is estimated
    elif is_engaged(before):
        if plan.phase == LED:
            guided = leading.follow(
                led, plan.path, plan.since_ns, told, belief.sampled_ns, p.transfer, p.leading
            )
            led, reference, unled = guided.led, guided.reference, guided.lost
            at_rest = guided.at_rest and before == STOPPING  # there is no end to it else
            if guided.beyond:
                present |= LED_BEYOND
        else:
            plan, reference, at_rest = follow(plan, belief.sampled_ns, configured(state, p), state.profile)
        if p.leading.how >= GANTRY:
            led = shifted(led, reference, skew, belief.sampled_ns, p.leading)
        error_m = aim(reference, led, p.leading).position_m - e.position_m
        if controller is not None and not abs(error_m) <= limits.tracking_error_m:
            present |= TRACKING_ERROR
        if plan.jog_m_s != 0.0:
            plan = plan._replace(lease=plan.lease - 1 - m.skipped)
    if present & LOSES_REFERENCE:
        referenced = False
    return Course(
        plan,
        reference,
        at_rest,
        way,
        found,
        zero_m,
        referenced,
        controller,
        present,
        probed,
        led,
        unled,
        press,
    )


def given_up(ended: int) -> int:
    """The fault that ends pressing, 0 for none."""
    if ended == force.FINE:
        return 0
    if ended == force.WINDOW:
        return FORCE_WINDOW
    if ended == force.SPEED:
        return FORCE_SPEED
    if ended == force.APART:
        return LOAD_DISAGREES
    return FORCE_TIMEOUT if ended == force.TIMEOUT else FORCE_DIRECTION


def redirect(
    course: Course, asked: Asked, after: int, state: AxisState, belief: Belief, p: AxisParameters
) -> Course:
    """What a request and a change of state make of it; the law takes over, or changes, without a bump.

    Args:
        course: as it was set before.
        asked: what becomes of a request.
        after: the state of this tick, an engaged one.
        state: after the last tick.
        belief: what is known of the load.
        p: parameters.
    """
    e, now_ns, before = belief.estimate, belief.sampled_ns, state.supervisor.state
    plan, reference, controller, present = course.plan, course.reference, course.controller, course.present
    assert controller is not None  # else a fault has centred an engaged axis, or kept it from arming
    if after == HOMING:
        return _homewards(course, before, belief, p)
    if after == PROBING:
        probed = course.probe
        if asked.probe is not None:
            probed = asked.probe
        return course._replace(probe=probed, reference=rest(e.position_m))
    led = course.led
    if after == PRESSING:
        return _pressing(course, asked, state)
    if asked.plan is not None:
        plan = asked.plan
        if plan.phase == LED:
            led = anew(led, p.leading)
    elif asked.law is None and after == before and plan.lease >= 0 and not course.unled:
        return course  # nothing changes it
    lost = plan.lease < 0
    if lost:
        present |= OPERATOR_LOST
    if before == HOMING:
        plan, reference = resting(e.position_m, now_ns), rest(e.position_m)
    elif not is_engaged(before):
        plan, reference, _ = follow(plan, now_ns, configured(state, p), state.profile)
    elif after == HOLDING and before != HOLDING:
        plan = resting(reference.position_m, now_ns)
    elif lost or course.unled or (after == STOPPING and before != STOPPING and not _is_carried(plan, p)):
        plan = halting(plan, reference, now_ns, p.motion, p.limits.travel_min_m, p.limits.travel_max_m)
    goal = aim(reference, led, p.leading)
    if before == HOMING or not is_engaged(before):
        controller = join(controller, e, goal, state.law)
    elif before == PRESSING:
        controller = join_in_motion(controller, e, goal, state.law)
    if asked.law is not None:
        controller = change(controller, e, goal, state.law, asked.law)
    return course._replace(plan=plan, reference=reference, controller=controller, present=present, led=led)


def _is_carried(plan: Plan, p: AxisParameters) -> bool:
    """Whether the other half of a gantry brings the load to rest, too: apart from it would be askew."""
    return plan.phase == LED and p.leading.how == GANTRY


def _homewards(course: Course, before: int, belief: Belief, p: AxisParameters) -> Course:
    """Homing, from where it begins on: it has a velocity, and no plan."""
    e = belief.estimate
    if before != HOMING:
        begun = homing.set_out(e.position_m, belief.sampled_ns)
        course = course._replace(plan=IDLE, homing=begun, referenced=False)
    velocity_m_s = homing.direction(course.homing.part, p.homing) * p.homing.speed_m_s
    return course._replace(reference=Reference(e.position_m, velocity_m_s, 0.0, 0.0))


def _pressing(course: Course, asked: Asked, state: AxisState) -> Course:
    """Pressing, from where it begins on: there is no plan; the reference is where the load is."""
    controller = course.controller
    assert controller is not None
    if asked.law is not None:
        controller = forget(controller, state.law, asked.law)
    press = course.press
    if asked.press is not None:
        press = asked.press
    return course._replace(plan=IDLE, controller=controller, press=press)
