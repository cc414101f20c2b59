"""One axis: `Axis.cycle` turns a measurement and a request into a command.

No clock, no bus, no file: the rig, the virtual run, the simulation and the replay all run this same
function, and its whole state is one record.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from pneud.axis.doubt import listen
from pneud.axis.guidance import NO_REFERENCE, Course, guide, redirect
from pneud.axis.interlock import (
    NOT_ASKED,
    attend,
    carried,
    may_let_go,
    settled,
    stationed,
    taken_over,
)
from pneud.axis.mileage import LOOK_NS, SETTLED_NS, Odometer, count
from pneud.axis.programs import ENDS, FIRST_KIND, asked_of, observed, proceed, put, started
from pneud.axis.requests import ARM, BLOCKED, HOME, NOTHING, PROBE, TAKEN, Asked
from pneud.axis.sensing import (
    ENCODER,
    NAN,
    NO_ESTIMATE,
    PRESSURE,
    Belief,
    Driven,
    drive,
    just_read,
    sense,
)
from pneud.axis.standing import AT_WORK, Standing, judge
from pneud.axis.state import INSIDE, AxisParameters, AxisState, Doubt, learnt_so_far, switched_on
from pneud.axis.stops import UNHELD, excused, gentle, outside
from pneud.control import force, homing, probe
from pneud.control.force import Pressing
from pneud.control.leading import ALONE, NOT_LED, aim, is_at_rest
from pneud.control.plan import FOLLOWING, IDLE, LED, NONE, Plan
from pneud.control.program import DUE, UNDER_WAY, Run, halted, progress, stopped
from pneud.control.step import Controller, forget, unlearnt
from pneud.safety import checks
from pneud.safety.brake import ENGAGING, Brake, is_holding
from pneud.safety.faults import F
from pneud.safety.output import emit
from pneud.safety.station import Inputs, Judged
from pneud.safety.supervisor import (
    DISARMED,
    HOLDING,
    HOMING,
    PRESSING,
    PROBING,
    TRACKING,
    Supervisor,
    advance,
    is_engaged,
    trip,
)
from pneud.safety.watch import Watch, forget_position, remember
from pneud.signals import (
    Command,
    Heard,
    Measurement,
    Mileage,
    Reference,
    Request,
    RequestKind,
    Tick,
    Told,
    Weighed,
)

__all__ = ["FOLLOWING", "Axis", "AxisParameters", "AxisState"]

NOT_FINITE, LOAD_MISSING = 1 << F.NOT_FINITE, 1 << F.LOAD_MISSING
CENTRED_COMMAND = Command(voltage_v=0.0, enable=0, saturated=0, law_v=NAN, s=NAN, ustar=NAN)
REACHED = AT_WORK._replace(in_position=1)  # the force that is asked for


class Scale(NamedTuple):
    """What a load cell says."""

    force_n: float  # NaN where nothing is to be believed
    weighed: Weighed | None  # as it is recorded
    faults: int  # bits of those that this is


NOT_WEIGHED = Scale(NAN, None, 0)


def cycle(
    state: AxisState,
    m: Measurement,
    request: Request | None,
    t_ns: int,
    p: AxisParameters,
    told: Told | None,
    heard: Heard | None,
) -> tuple[AxisState, Tick]:
    """One tick: the state after it, and what it came to.

    Args:
        state: after the last tick.
        m: the newest measurement.
        request: at most one request of the operator.
        t_ns: instant of this tick's SYNC.
        p: parameters.
        told: by the axis that leads this one, or is beside it; None where there is none.
        heard: from inputs and load cell; None where there are none.
    """
    before = state.supervisor
    m = homing.placed(m, state.zero_m, state.referenced) if p.homing.incremental else m
    m, doubt, doubtful = listen(state, m, t_ns, p)
    arming = request is not None and request.kind in (ARM, HOME, PROBE) and before.state == DISARMED
    belief, seen, lasting, present = sense(state, m, arming, t_ns, p)
    outside_m = outside(state.outside_m, m.position_m, is_engaged(before.state), p.limits)
    spared = excused(outside_m, m.position_m, belief.estimate, p.limits)
    judged = NOT_ASKED
    if p.roles.used or p.brake.used:
        state, judged = attend(state, belief, heard, t_ns, p)
    if spared or state.pressed or is_holding(state.brake, p.brake):
        lasting &= UNHELD
    watch, lasted = remember(state.watch, seen, lasting, m.t_ns, p.limits)
    present -= present & spared
    scale = weigh(heard, p.pressing) if p.pressing.cell else NOT_WEIGHED
    present |= lasted | doubtful | judged.faults | scale.faults | checks.of_host(m.host)
    course = guide(state, belief, m, present, p, told, scale.force_n)
    if course.found:
        watch = forget_position(watch)
    asked, run, inputs = heed(state, request, course, belief, judged, t_ns, p)
    law = state.law
    if asked.law is not None:
        law = asked.law
    at_rest = course.at_rest and may_let_go(state.brake, before, course.present | asked.faults, asked.kind, p)
    after = advance(before, course.present | asked.faults, asked.kind, at_rest)
    course, driven = lead(course, asked, after.state, state, belief, m, law, outside_m, p)
    if driven.faults:
        after = trip(after, driven.faults)
    present = found(course, asked, driven)
    if present & NOT_FINITE:
        driven = driven._replace(controller=None)  # it would remember
    if run.stage >= UNDER_WAY:
        run = observed(run, t_ns, after.state, course, belief, m, state.standing, inputs, law.cylinder)
    reference = aim(course.reference, course.led, p.leading)
    stood = stand(state, after.state, belief, m, reference, course, driven.command, t_ns, p)
    done = counted(state, belief, m, course.found, is_engaged(after.state), t_ns)
    if p.roles.used or p.brake.used:
        state = settled(state, inputs, m, belief, course, after.state, stood, t_ns, p)
    tick = Tick(
        t_ns=t_ns,
        measurement=m,
        request=request,
        estimate=belief.estimate,
        reference=reference,
        command=driven.command,
        state=after.state,
        present=present,
        latched=after.latched,
        answer=asked.answer,
        in_position=stood.in_position,
        hunting=stood.hunting,
        told=told,
        program=progress(run),
        station=stationed(state, after, present, stood, run, p),
        weighed=scale.weighed,
    )
    state = put_away(
        state, t_ns, belief, watch, course, asked, law, after, driven, doubt, outside_m, stood, done, run, p
    )
    return state, tick


def weigh(heard: Heard | None, p: Pressing) -> Scale:
    """What the load cell says in a tick.

    Args:
        heard: in this tick.
        p: how old it may be.
    """
    if heard is None or not math.isfinite(heard.force_n):
        return Scale(NAN, None, LOAD_MISSING)
    weighed = Weighed(heard.force_n, heard.force_age_ns)
    if heard.force_age_ns > p.cell_ns:
        return Scale(NAN, weighed, LOAD_MISSING)
    return Scale(heard.force_n, weighed, 0)


def heed(
    state: AxisState,
    request: Request | None,
    course: Course,
    belief: Belief,
    judged: Judged,
    t_ns: int,
    p: AxisParameters,
) -> tuple[Asked, Run, Inputs]:
    """What becomes of a request, or of what the program asks where there is none; and the program with that.

    Args:
        state: after the last tick.
        request: of the operator.
        course: where the axis is led.
        belief: what is known of the load.
        judged: what the inputs come to.
        t_ns: instant of this tick's SYNC.
        p: parameters.
    """
    asked, run, inputs, e = NOTHING, state.run, judged.inputs, belief.estimate
    if request is not None:
        if request.kind >= FIRST_KIND:
            asked = asked_of(request, state, course.present, p)
        else:
            asked = put(request, state, course, e, belief.sampled_ns, p)
            if run.stage >= UNDER_WAY and request.kind in ENDS and asked.answer == TAKEN:
                run = stopped(run)
    elif run.stage >= DUE:
        asked = proceed(state, course, e, belief.sampled_ns, t_ns, p)
    elif judged.starts and run.stage < UNDER_WAY:
        asked = started(state, course.present, p)
    idle = run.stage < UNDER_WAY
    if asked.run is not None:
        run = asked.run
    if judged.starts and idle and run.stage < UNDER_WAY:
        inputs = inputs._replace(refused_ns=t_ns)
    return asked, run, inputs


def lead(
    course: Course,
    asked: Asked,
    now: int,
    state: AxisState,
    belief: Belief,
    m: Measurement,
    law: Controller,
    outside_m: float,
    p: AxisParameters,
) -> tuple[Course, Driven]:
    """Where the axis is led from now on, and what leaves for its valve.

    Args:
        course: where it has been led.
        asked: what becomes of a request.
        now: state of this tick.
        state: after the last tick.
        belief: what is known of the load.
        m: the measurement.
        law: with its gains from now on.
        outside_m: where it lies outside, from `stops.outside`.
        p: parameters.
    """
    driven = Driven(course.controller, CENTRED_COMMAND, 0)
    if is_engaged(now):
        course = redirect(course, asked, now, state, belief, p)
        bounded = p if outside_m == INSIDE else gentle(p)
        if is_holding(state.brake, p.brake) and state.brake.hold != ENGAGING:
            return course, carried(state, course, m, belief, law, bounded)
        if state.brake.fresh != 0:
            course = taken_over(course, belief.estimate, law, p)
        driven = actuate(course, now, m, belief, state.last_v, law, bounded)
        if state.pressed and driven.controller is not None and course.controller is not None:
            # what a load is pressed against is neither friction nor load
            driven = driven._replace(controller=unlearnt(driven.controller, course.controller.learnt))
    elif asked.law is not None and course.controller is not None:
        driven = driven._replace(controller=forget(course.controller, state.law, law))
    return course, driven


def found(course: Course, asked: Asked, driven: Driven) -> int:
    """Bits of all faults that hold in a tick.

    Args:
        course: where the axis is led.
        asked: what becomes of a request.
        driven: what leaves for the valve.
    """
    return course.present | asked.faults | driven.faults | driven.command.saturated << F.SATURATED


def counted(
    state: AxisState, belief: Belief, m: Measurement, found: bool, engaged: bool, t_ns: int
) -> Odometer:
    """What the axis has done, with what it does now; looked at now and then.

    Args:
        state: after the last tick.
        belief: what is known of the load.
        m: the measurement.
        found: positions count from elsewhere since this tick.
        engaged: the axis is.
        t_ns: instant of this tick's SYNC.
    """
    if t_ns - state.odometer.looked_ns < LOOK_NS:
        return state.odometer
    known = belief.controller is not None and not found
    settled = belief.sampled_ns - belief.started_ns > SETTLED_NS
    return count(state.odometer, t_ns, belief.estimate, m, known, settled, engaged, state.law)


def stand(
    state: AxisState,
    now: int,
    belief: Belief,
    m: Measurement,
    r: Reference,
    course: Course,
    command: Command,
    t_ns: int,
    p: AxisParameters,
) -> Standing:
    """How the load stands at its target; not at all where the reference has not come to its end.

    One that is led by another axis stands where that one rests: it never holds by itself.

    Args:
        state: after the last tick.
        now: state of this tick.
        belief: what is known of the load.
        m: the measurement.
        r: the reference.
        course: where the axis is led.
        command: that leaves.
        t_ns: this tick's SYNC.
        p: parameters.
    """
    e = belief.estimate
    if now != HOLDING:
        if now == PRESSING and course.press.reached:
            said = state.supervisor.state == PRESSING and state.standing.in_position != 0
            return REACHED if said or just_read(belief, m) & PRESSURE != 0 else AT_WORK
        led = p.leading.how != ALONE and now == TRACKING and course.plan.phase == LED
        if not led or not is_at_rest(course.led, belief.sampled_ns):
            return AT_WORK
    step_v, error_m = command.voltage_v - state.last_v, r.position_m - e.position_m
    measured = just_read(belief, m) & ENCODER != 0
    return judge(state.standing, t_ns, error_m, e.velocity_m_s, step_v, measured, p.expected)


def actuate(
    course: Course,
    state: int,
    m: Measurement,
    belief: Belief,
    last_v: float,
    law: Controller,
    p: AxisParameters,
) -> Driven:
    """What an engaged axis asks of the valve.

    Args:
        course: where it is led.
        state: of this tick.
        m: the measurement.
        belief: what is known of the load.
        last_v: the last command that left [V].
        law: with its gains from now on.
        p: parameters.
    """
    dt, e = (1 + m.skipped) * law.h, belief.estimate
    if state in (HOMING, PROBING, PRESSING):
        off_n, wanted_n = 0.0, 0.0
        if state == HOMING:
            law_v = homing.command(course.homing, m, e, p.homing, law)
        elif state == PRESSING:
            assert course.controller is not None
            law_v = force.command(course.press, course.controller, e, last_v, law)
            wanted_n = course.press.wanted_n
            off_n = wanted_n - force.piston_n(e, law)
        else:
            law_v = probe.opening_v(course.probe, belief.sampled_ns)
        out = emit(law_v, last_v, dt, p.output)
        command = Command(out.voltage_v, out.enable, out.saturated, law_v, off_n, wanted_n)
        return Driven(course.controller, command, out.faults)
    assert course.controller is not None
    reference = aim(course.reference, course.led, p.leading)
    return drive(course.controller, e, reference, last_v, dt, law, p.output)


def put_away(
    state: AxisState,
    t_ns: int,
    belief: Belief,
    watch: Watch,
    course: Course,
    asked: Asked,
    law: Controller,
    after: Supervisor,
    driven: Driven,
    doubt: Doubt,
    outside_m: float,
    standing: Standing,
    odometer: Odometer,
    run: Run,
    p: AxisParameters,
) -> AxisState:
    """All that has to be remembered of this tick.

    Args:
        state: after the last tick.
        t_ns: instant of this tick's SYNC.
        belief: what is known of the load.
        watch: what the checks remember.
        course: where the axis is led.
        asked: what becomes of a request.
        law: with its gains from now on.
        after: the state of the state machine.
        driven: what leaves for the valve.
        doubt: of readings.
        outside_m: where it lies outside, from `stops.outside`.
        standing: at its target.
        odometer: what the axis has done.
        run: how far the program is.
        p: parameters.
    """
    plan, profile, reference = course.plan, state.profile, state.reference
    if plan.phase != NONE and not is_engaged(after.state):
        plan = IDLE
    if asked.profile is not None:
        profile = asked.profile
    if asked.reference is not None:
        reference = asked.reference
    program = state.program
    if asked.program is not None:
        program = asked.program
    pressed = state.pressed
    if after.state == PRESSING:
        pressed = 1
    elif pressed and force.is_free(belief.estimate, learnt_so_far(state).load_n, p.pressing):
        pressed = 0
    # a homing that is cut may leave the load at the stop, beyond the travel: the axis can be homed again
    cut = state.supervisor.state == HOMING and not is_engaged(after.state)
    return AxisState(
        supervisor=after,
        controller=driven.controller,
        t_ns=t_ns,
        sampled_ns=belief.sampled_ns,
        read_ns=belief.read_ns,
        started_ns=belief.started_ns,
        plan=plan,
        profile=profile,
        last_v=driven.command.voltage_v,
        limited=driven.command.saturated,
        watch=watch,
        law=law,
        zero_m=course.zero_m,
        referenced=course.referenced and not cut,
        homing=course.homing,
        reference=reference,
        standing=standing,
        doubt=doubt,
        outside_m=outside_m,
        learnt=learnt_so_far(state),
        probe=course.probe,
        odometer=odometer,
        led=course.led if is_engaged(after.state) else NOT_LED,
        program=program,
        run=run,
        press=course.press,
        pressed=pressed,
        inputs=state.inputs,
        brake=state.brake,
        balance=state.balance,
    )


def itself(state: AxisState) -> AxisState:
    """The state, of an axis that has it as a record."""
    return state


class Axis:
    """The axis; `state` is everything it remembers."""

    _cycle = staticmethod(cycle)
    _whole = staticmethod(itself)
    _rehearsal: Callable[..., bool] | None = None  # as `_cycle`, for nothing

    def __init__(self, parameters: AxisParameters) -> None:
        """An axis that has just been switched on."""
        self.parameters = parameters
        self._state = switched_on(parameters)
        self.failure: Exception | None = None  # the first exception in a cycle

    @property
    def state(self) -> AxisState:
        """Everything it remembers."""
        return self._whole(self._state)

    @state.setter
    def state(self, state: AxisState) -> None:
        self._state = state

    @property
    def plan(self) -> Plan:
        """What its reference is doing."""
        return self._state.plan

    @property
    def mileage(self) -> Mileage:
        """What it has done in this run."""
        return self._state.odometer.done

    def freeze(self) -> AxisState:
        """The whole state, to be logged or kept."""
        return self.state

    def thaw(self, state: AxisState) -> None:
        """Go on from a frozen state."""
        self.state = state

    def rehearse(self, m: Measurement, t_ns: int) -> bool:
        """Compute a tick that nothing comes of, where that takes less time than there is; whether it did.

        Args:
            m: any measurement, such as the last one.
            t_ns: instant of this tick's SYNC.
        """
        rehearsal = self._rehearsal
        return rehearsal is not None and rehearsal(self._state, m, None, t_ns, self.parameters, None, None)

    def cycle(
        self,
        m: Measurement,
        request: Request | None,
        t_ns: int,
        told: Told | None = None,
        heard: Heard | None = None,
    ) -> Tick:
        """One tick.

        An exception in it centres the valve, latches the fault `internal` and is kept in `failure`.

        Args:
            m: the newest measurement.
            request: at most one request of the operator.
            t_ns: instant of this tick's SYNC.
            told: by the axis that leads this one, or is beside it.
            heard: from the inputs, where there are any.
        """
        try:
            self._state, tick = self._cycle(self._state, m, request, t_ns, self.parameters, told, heard)
            return tick
        except Exception as e:
            if self.failure is None:
                self.failure = e
            bits, kind = 1 << F.INTERNAL, request.kind if request is not None else 0
            after = trip(self.state.supervisor, bits, kind)
            self.state = self.state._replace(
                supervisor=after,
                controller=None,
                t_ns=t_ns,
                plan=IDLE,
                last_v=0.0,
                limited=0,
                led=NOT_LED,
                learnt=learnt_so_far(self.state),
                run=halted(self.state.run),
                brake=Brake(since_ns=t_ns),
            )
            return Tick(
                t_ns=t_ns,
                measurement=m,
                request=request,
                estimate=NO_ESTIMATE,
                reference=NO_REFERENCE,
                command=CENTRED_COMMAND,
                state=after.state,
                present=bits,
                latched=after.latched,
                answer=0 if kind == 0 else TAKEN if kind == RequestKind.SHUTDOWN else BLOCKED,
                told=told,
                program=progress(self.state.run),
                station=stationed(self.state, after, bits, AT_WORK, self.state.run, self.parameters),
            )
