"""Inputs, outputs and a brake within an axis: what they make of a tick.

Nothing is led while the brake holds the load, and it lets go of what the piston bears. While it holds, an
engaged axis brings the piston's force to what the load takes, and every motion that has been asked for waits
at its beginning, where the reference stands.
"""

from __future__ import annotations

from pneud.axis.guidance import Course
from pneud.axis.sensing import Belief, Driven
from pneud.axis.standing import Standing
from pneud.axis.state import AxisParameters, AxisState, learnt_so_far
from pneud.control import force, homing
from pneud.control.force import Aim, Press
from pneud.control.leading import aim
from pneud.control.plan import GOING, JOINING
from pneud.control.program import Run
from pneud.control.step import Controller, as_learnt, join_in_motion
from pneud.physics.valve import dead_zone_inverse
from pneud.safety import brake, station
from pneud.safety.brake import BALANCING, ENGAGED, RELEASING, Brake, is_holding
from pneud.safety.faults import STOPS
from pneud.safety.output import emit
from pneud.safety.station import Inputs, Judged
from pneud.safety.supervisor import (
    DISARM,
    HOLDING,
    HOMING,
    PRESSING,
    PROBING,
    SHUTDOWN,
    STOPPING,
    Supervisor,
    is_engaged,
)
from pneud.signals import Command, Estimate, Heard, Measurement, Station

NOT_ASKED = Judged(Inputs(), False, 0)  # of inputs that there are none


def waiting(state: AxisState, belief: Belief) -> AxisState:
    """The axis whose motion has not begun yet: it begins now, where the load is.

    Args:
        state: after the last tick, of an axis whose brake holds.
        belief: what is known of the load.
    """
    now, e, now_ns = state.supervisor.state, belief.estimate, belief.sampled_ns
    if now == HOMING:
        return state._replace(homing=homing.set_out(e.position_m, now_ns))
    if now == PROBING:
        begun = state.probe._replace(since_ns=now_ns, from_m=e.position_m, from_n=e.x3_n, usual_n=e.x3_n)
        return state._replace(probe=begun)
    if now == PRESSING:
        pressing = force.begin(state.press.aim, state.press, False, e, now_ns, state.law)
        return state._replace(press=pressing)
    if now != STOPPING and state.plan.phase in (GOING, JOINING):
        return state._replace(plan=state.plan._replace(since_ns=now_ns))
    return state


def may_let_go(b: Brake, s: Supervisor, present: int, kind: int, p: AxisParameters) -> bool:
    """Whether a stop that has come to its end may end: with the valve centred only when the brake holds.

    Args:
        b: the brake.
        s: the supervisor after the last tick.
        present: bits of the faults that hold now.
        kind: what it is asked, 0 for nothing.
        p: parameters.
    """
    if not p.brake.used or s.state != STOPPING or b.hold == ENGAGED:
        return True
    return not (s.centring or present & STOPS != 0 or kind in (DISARM, SHUTDOWN))


def carried(
    state: AxisState, course: Course, m: Measurement, belief: Belief, law: Controller, p: AxisParameters
) -> Driven:
    """What leaves for the valve while the brake holds, or lets go.

    Args:
        state: after the last tick, with the brake.
        course: where the axis is led.
        m: the measurement.
        belief: what is known of the load.
        law: with its gains from now on.
        p: parameters.
    """
    controller, e = course.controller, belief.estimate
    assert controller is not None
    if state.brake.hold in (BALANCING, RELEASING):
        law_v = force.command(state.balance, controller, e, state.last_v, law)
    else:
        law_v = dead_zone_inverse(0.0, as_learnt(law, controller.learnt).valve, 0.0)
    out = emit(law_v, state.last_v, (1 + m.skipped) * law.h, p.output)
    command = Command(out.voltage_v, out.enable, out.saturated, law_v, 0.0, 0.0)
    return Driven(controller, command, out.faults)


def taken_over(course: Course, e: Estimate, law: Controller, p: AxisParameters) -> Course:
    """The law takes over a load that the brake has let go of, without a bump.

    Args:
        course: where the axis is led.
        e: the estimate.
        law: with its gains from now on.
        p: parameters.
    """
    controller = course.controller
    assert controller is not None
    goal = aim(course.reference, course.led, p.leading)
    return course._replace(controller=join_in_motion(controller, e, goal, law))


def balanced(state: AxisState, m: Measurement, belief: Belief, p: AxisParameters) -> Press:
    """How far the piston's force has come to what the load takes.

    Args:
        state: after the last tick, with the brake.
        m: the measurement.
        belief: what is known of the load.
        p: parameters.
    """
    e, now_ns, law = belief.estimate, belief.sampled_ns, state.law
    if state.brake.hold in (BALANCING, RELEASING):
        return force.proceed(state.balance, e, now_ns, (1 + m.skipped) * law.h, law, p.pressing).press
    k, limits = p.pressing, p.limits
    wanted = Aim(
        learnt_so_far(state).load_n,
        k.rate_n_s,
        limits.travel_min_m,
        limits.travel_max_m,
        k.speed_m_s,
        k.time_s,
    )
    return force.begin(wanted, state.balance, False, e, now_ns, law)


def braked(
    b: Brake,
    balance: Press,
    after: int,
    at_rest: bool,
    in_position: int,
    inputs: int,
    t_ns: int,
    p: AxisParameters,
) -> Brake:
    """What the brake does from this tick on.

    Args:
        b: as it was judged in this tick.
        balance: how far the piston's force has come.
        after: state of this tick.
        at_rest: the reference has come to its end.
        in_position: 1 where the load has.
        inputs: bits.
        t_ns: this tick's SYNC.
        p: parameters.
    """
    engaged = is_engaged(after)
    wanted = brake.is_wanted(b, after == STOPPING, after == HOLDING, at_rest, in_position, p.brake)
    reached = balance.reached != 0
    return brake.proceed(b, engaged, wanted, reached, inputs, t_ns, p.brake)


def attend(
    state: AxisState, belief: Belief, heard: Heard | None, t_ns: int, p: AxisParameters
) -> tuple[AxisState, Judged]:
    """What inputs and brake have to say before anything is decided; and the axis, whose motion may wait.

    Args:
        state: after the last tick.
        belief: what is known of the load.
        heard: from the inputs.
        t_ns: instant of this tick's SYNC.
        p: parameters.
    """
    judged = station.judge(state.inputs, heard, t_ns, p.roles)
    if p.brake.used:
        now, faults = brake.judge(state.brake, judged.inputs.bits, t_ns, p.brake)
        if is_holding(now, p.brake) and is_engaged(state.supervisor.state):
            state = waiting(state, belief)
        state = state._replace(brake=now)
        judged = judged._replace(faults=judged.faults | faults)
    return state, judged


def settled(
    state: AxisState,
    inputs: Inputs,
    m: Measurement,
    belief: Belief,
    course: Course,
    after: int,
    stood: Standing,
    t_ns: int,
    p: AxisParameters,
) -> AxisState:
    """The axis with its inputs, and with what its brake does from now on.

    Args:
        state: after the last tick, with the brake as it was judged.
        inputs: of this tick.
        m: the measurement.
        belief: what is known of the load.
        course: where the axis is led.
        after: state of this tick.
        stood: how the load stands at its target.
        t_ns: instant of this tick's SYNC.
        p: parameters.
    """
    if not p.brake.used:
        return state._replace(inputs=inputs)
    balance = state.balance
    if is_engaged(after) and is_holding(state.brake, p.brake):
        balance = balanced(state, m, belief, p)
    now = braked(state.brake, balance, after, course.at_rest, stood.in_position, inputs.bits, t_ns, p)
    return state._replace(inputs=inputs, brake=now, balance=balance)


def stationed(
    state: AxisState, after: Supervisor, present: int, stood: Standing, run: Run, p: AxisParameters
) -> Station | None:
    """What inputs say and outputs put out; None where there are none.

    Args:
        state: with inputs and brake of this tick.
        after: the state of the state machine.
        present: bits of the faults that hold now.
        stood: how the load stands at its target.
        run: how far the program is.
        p: parameters.
    """
    if not p.roles.used and not p.brake.used:
        return None
    bits, hold = state.inputs.bits, state.brake.hold
    return station.told(
        bits, after.state, present, after.latched, stood.in_position, run.outputs, hold, p.roles, p.brake
    )
