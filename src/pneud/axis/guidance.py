"""Where the axis is led: along its reference, or home, and what requests and changes of state make of it."""

from __future__ import annotations

from typing import NamedTuple

from pneud.axis.requests import Asked
from pneud.axis.sensing import NAN, Belief
from pneud.axis.state import AxisParameters, AxisState, configured, learnt_so_far
from pneud.control import homing, probe
from pneud.control.homing import Homing
from pneud.control.plan import IDLE, Plan, follow, halting, resting
from pneud.control.probe import Probe
from pneud.control.reference import rest
from pneud.control.step import ControllerState, change, join, resume
from pneud.safety.faults import F
from pneud.safety.supervisor import HOLDING, HOMING, PROBING, STOPPING, is_engaged
from pneud.signals import Measurement, Reference

# an encoder that was silent, wrong or jumped may have lost count
LOSES_REFERENCE = sum(
    1 << fault
    for fault in (F.ENCODER_MISSING, F.ENCODER_CORRUPT, F.ENCODER_FROZEN, F.ENCODER_ERROR, F.ENCODER_JUMP)
)
# plain numbers: to get at a member of an enumeration takes longer than most of what is done with it
TRAVEL, TRACKING_ERROR, OPERATOR_LOST = 1 << F.TRAVEL, 1 << F.TRACKING_ERROR, 1 << F.OPERATOR_LOST
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


def guide(state: AxisState, belief: Belief, m: Measurement, present: int, p: AxisParameters) -> Course:
    """Go on as the ticks before have set it.

    Args:
        state: after the last tick.
        belief: what is known of the load.
        m: the measurement.
        present: bits of the faults that it shows.
        p: parameters.
    """
    law, limits, e, before = state.law, p.limits, belief.estimate, state.supervisor.state
    plan, reference, at_rest, way, found = state.plan, NO_REFERENCE, False, state.homing, False
    controller, zero_m, referenced, probed = belief.controller, state.zero_m, state.referenced, state.probe
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
    elif is_engaged(before):
        plan, reference, at_rest = follow(plan, belief.sampled_ns, configured(state, p), state.profile)
        error_m = reference.position_m - e.position_m
        if controller is not None and not abs(error_m) <= limits.tracking_error_m:
            present |= TRACKING_ERROR
        if plan.jog_m_s != 0.0:
            plan = plan._replace(lease=plan.lease - 1 - m.skipped)
    if present & LOSES_REFERENCE:
        referenced = False
    return Course(plan, reference, at_rest, way, found, zero_m, referenced, controller, present, probed)


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
        asked_for = course.probe if asked.probe is None else asked.probe
        return course._replace(probe=asked_for, reference=rest(e.position_m))
    if asked.plan is not None:
        plan = asked.plan
    elif asked.law is None and after == before and plan.lease >= 0:
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
    elif lost or (after == STOPPING and before != STOPPING):
        plan = halting(plan, reference, now_ns, p.motion, p.limits.travel_min_m, p.limits.travel_max_m)
    if before == HOMING or not is_engaged(before):
        controller = join(controller, e, reference, state.law)
    if asked.law is not None:
        controller = change(controller, e, reference, state.law, asked.law)
    return course._replace(plan=plan, reference=reference, controller=controller, present=present)


def _homewards(course: Course, before: int, belief: Belief, p: AxisParameters) -> Course:
    """Homing, from where it begins on: it has a velocity, and no plan."""
    e = belief.estimate
    if before != HOMING:
        begun = homing.set_out(e.position_m, belief.sampled_ns)
        course = course._replace(plan=IDLE, homing=begun, referenced=False)
    velocity_m_s = homing.direction(course.homing.part, p.homing) * p.homing.speed_m_s
    return course._replace(reference=Reference(e.position_m, velocity_m_s, 0.0, 0.0))
