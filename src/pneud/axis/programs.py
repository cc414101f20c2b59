"""A program in an axis: how it is put together and set going, and what the axis is asked by a step of it.

A step asks what an operator would, by the same way and with the same bounds.
"""

from __future__ import annotations

from pneud.axis.guidance import Course
from pneud.axis.requests import (
    BEYOND_LIMITS,
    BLOCKED,
    FORCE,
    GOTO,
    HOLD,
    HOME,
    JOG,
    MALFORMED,
    NO_PROFILE,
    NOTHING,
    OUT_OF_TRAVEL,
    STEERED,
    TAKEN,
    TRACK,
    WRONG_STATE,
    Asked,
    ask,
)
from pneud.axis.sensing import Belief, just_read
from pneud.axis.standing import Standing
from pneud.axis.state import AxisParameters, AxisState, configured
from pneud.axis.stops import soft_limits
from pneud.control import program
from pneud.control.program import DONE, DUE, ENDED, LATE, NO_RUN, STOPPED, UNDER_WAY, Run, Step, begins
from pneud.control.reference import Bounds
from pneud.control.step import Controller
from pneud.physics.cylinder import Cylinder
from pneud.safety.faults import CENTRES, STOPS, F
from pneud.safety.station import Inputs
from pneud.signals import Estimate, Measurement, Request, RequestKind

RECORD, RUN, GO_ON = int(RequestKind.RECORD), int(RequestKind.RUN), int(RequestKind.GO_ON)
OWN = (RECORD, RUN, GO_ON)
ENDS = (HOLD, GOTO, JOG, TRACK, HOME, FORCE)  # whoever asks for one of these takes over from the program
FIRST_KIND = RECORD
ANNOUNCING = 2  # values of a RECORD that says how many steps come, and whose these are
ANNOUNCED = range(1, program.MOST_STEPS + 1)
MOST_LAPS = 1e9
MOST_MASSES = 100.0  # of the axis's own, that a workpiece may have


def asked_of(request: Request, state: AxisState, present: int, p: AxisParameters) -> Asked:
    """What becomes of a request about a program.

    Args:
        request: one of `OWN`.
        state: after the last tick.
        present: bits of the faults that hold now.
        p: parameters.
    """
    kind, values = request
    if kind == RECORD:
        return _add(values, state, p)
    run, steps = state.run, state.program
    if kind == GO_ON:
        if values:
            return Asked(MALFORMED)
        if run.stage != DONE:
            return Asked(WRONG_STATE)
        return Asked(TAKEN, run=run._replace(stage=DUE))
    if len(values) != 3 or not 0.0 <= values[1] <= MOST_LAPS or values[2] not in (0.0, 1.0):
        return Asked(MALFORMED)
    if run.missing > 0 or run.shared > values[2] or not program.leads(steps):
        return Asked(NO_PROFILE)
    if state.supervisor.state not in STEERED or run.stage >= UNDER_WAY:
        return Asked(WRONG_STATE)
    if present & (CENTRES | STOPS):
        return Asked(BLOCKED)
    first, laps, shared = map(int, values)
    if first == 0:
        if run.stage != STOPPED or run.shared != shared:
            return Asked(NO_PROFILE)
        return Asked(TAKEN, run=program.resumed(run, steps))
    if not 1 <= first <= len(steps):
        return Asked(MALFORMED)
    counts = (0,) * len(steps)
    begun = Run(
        DUE, next=first, laps=laps, shared=shared, mass_kg=run.mass_kg, outputs=run.outputs, counts=counts
    )
    return Asked(TAKEN, run=begun)


def started(state: AxisState, present: int, p: AxisParameters) -> Asked:
    """What becomes of the program where the input start comes on: it begins anew, where one is loaded.

    One that several axes go through together is begun by an operator alone: this one would go by itself. So
    is one that he has handed over to begin it himself: elsewhere than at its first record, perhaps.

    Args:
        state: after the last tick, of an axis without a program under way.
        present: bits of the faults that hold now.
        p: parameters.
    """
    run = state.run
    if run.stage == STOPPED or run.shared != 0 or run.withheld != 0:
        return NOTHING
    asked = asked_of(Request(RUN, (1.0, float(p.roles.laps), 0.0)), state, present, p)
    return NOTHING._replace(run=asked.run)


def _add(values: tuple[float, ...], state: AxisState, p: AxisParameters) -> Asked:
    """No step at all, those that come announced; or one more of them."""
    run = state.run
    if run.stage >= UNDER_WAY:
        return Asked(WRONG_STATE)
    idle = NO_RUN._replace(mass_kg=run.mass_kg, outputs=run.outputs)
    if not values:
        return Asked(TAKEN, program=(), run=idle)
    if len(values) == ANNOUNCING:
        if values[0] not in ANNOUNCED or values[1] not in (program.ALONE, program.SHARED, program.WITHHELD):
            return Asked(MALFORMED)
        shared, withheld = int(values[1] == program.SHARED), int(values[1] == program.WITHHELD)
        coming = idle._replace(missing=int(values[0]), shared=shared, withheld=withheld)
        return Asked(TAKEN, program=(), run=coming)
    step = program.step_of(values)
    if step is None or len(state.program) >= program.MOST_STEPS:
        return Asked(MALFORMED)
    low_m, high_m = soft_limits(p)
    if step.kind == program.GOTO and not low_m <= step.target_m <= high_m:
        return Asked(OUT_OF_TRAVEL)
    bounds = Bounds(step.speed_m_s, step.acceleration_m_s2, step.jerk_m_s3)
    heavy = step.mass_kg > MOST_MASSES * p.controller.cylinder.M
    if heavy or any(wanted > most for wanted, most in zip(bounds, p.motion, strict=True)):
        return Asked(BEYOND_LIMITS)
    idle = idle._replace(missing=max(0, run.missing - 1), shared=run.shared, withheld=run.withheld)
    return Asked(TAKEN, program=(*state.program, step), run=idle)


def proceed(
    state: AxisState, course: Course, e: Estimate, now_ns: int, t_ns: int, p: AxisParameters
) -> Asked:
    """What a program that is due, or late, asks of its axis.

    Args:
        state: after the last tick.
        course: where the axis is led.
        e: the estimate.
        now_ns: the instant that both belong to.
        t_ns: this tick's SYNC.
        p: parameters.
    """
    run, steps = state.run, state.program
    if state.supervisor.state not in STEERED or course.present & (CENTRES | STOPS):
        return NOTHING  # what it comes to is seen at the end of the tick
    if run.stage == LATE:
        otherwise = steps[run.record - 1].otherwise
        if otherwise == 0:
            return NOTHING._replace(run=program.stopped(run), faults=1 << F.PROGRAM_LATE)
        run = run._replace(stage=DUE, next=otherwise, kept=int(otherwise == run.record), back=0)
    before, again = run, run.kept != 0
    run = begins(run, steps)
    if run.stage == ENDED:
        return NOTHING._replace(run=run)
    step = steps[run.record - 1]
    if step.kind in (program.JUMP, program.REPEAT, program.OUTPUT, program.PASS):
        return NOTHING._replace(run=_at_once(run, step))
    asked, run = _asked(run, step, again, state, course, e, now_ns, p)
    if asked.answer not in (TAKEN, 0):
        before = before._replace(stage=STOPPED, record=run.record, lap=run.lap)
        return NOTHING._replace(run=before, faults=1 << F.PROGRAM)
    law = asked.law
    if step.mass_kg != run.mass_kg:
        law = carrying(state.law, step.mass_kg, p)
    run = program.awaiting(run, step, t_ns, round(state.law.h * 1e9))._replace(mass_kg=step.mass_kg)
    return asked._replace(answer=0, run=run, law=law)


def _at_once(run: Run, step: Step) -> Run:
    """The run behind a step that takes no time."""
    if step.kind == program.JUMP:
        return run._replace(stage=DUE, next=step.to)
    if step.kind == program.REPEAT:
        return program.repeated(run, step)
    if step.kind == program.OUTPUT:
        bit = 1 << step.bit
        run = run._replace(outputs=run.outputs | bit if step.on else run.outputs & ~bit)
    return run._replace(stage=DONE if run.shared else DUE)


def _asked(
    run: Run,
    step: Step,
    again: bool,
    state: AxisState,
    course: Course,
    e: Estimate,
    now_ns: int,
    p: AxisParameters,
) -> tuple[Asked, Run]:
    """What a step that takes its time asks of the axis, and the run with where that leads."""
    if step.kind in program.MOTIONS:
        target_m = step.target_m
        if step.kind == program.MOVE:
            base_m = run.target_m if run.aimed else course.reference.position_m
            target_m = run.target_m if again else base_m + step.target_m
        run = run._replace(aimed=1, target_m=target_m)
        request = Request(GOTO, (target_m, step.speed_m_s, step.acceleration_m_s2, step.jerk_m_s3))
    elif step.kind == program.TRACK:
        run, request = run._replace(aimed=0), Request(TRACK, (0.0,))
    elif step.kind == program.FORCE:
        run = run._replace(aimed=0)
        aim = (step.force_n, step.rate_n_s, step.low_m, step.high_m, step.speed_m_s, step.timeout_s)
        request = Request(FORCE, aim)
    else:
        return NOTHING, run
    return put(request, state, course, e, now_ns, p), run


def put(
    request: Request, state: AxisState, course: Course, e: Estimate, now_ns: int, p: AxisParameters
) -> Asked:
    """What becomes of a request about motion, whoever asks: an operator, or a step.

    Args:
        request: none about a program.
        state: after the last tick.
        course: where the axis is led.
        e: the estimate.
        now_ns: instant that it is of.
        p: parameters.
    """
    return ask(
        request,
        state.supervisor,
        course.present,
        course.plan,
        state.profile,
        course.reference,
        e,
        now_ns,
        state.law,
        configured(state, p),
        state.probe,
        state.press,
        p,
    )


def observed(
    run: Run,
    t_ns: int,
    now: int,
    course: Course,
    belief: Belief,
    m: Measurement,
    standing: Standing,
    inputs: Inputs,
    c: Cylinder,
) -> Run:
    """How far the program is, by what is seen in this tick.

    Args:
        run: how far it was.
        t_ns: instant of this tick's SYNC.
        now: state of this tick.
        course: where the axis is led.
        belief: what is known of the load.
        m: the measurement.
        standing: how the load stood at its target in the last tick.
        inputs: as they are.
        c: the axis's cylinder.
    """
    r, e, phase, read = course.reference, belief.estimate, course.plan.phase, just_read(belief, m)
    return program.look(run, t_ns, now, phase, standing.in_position, e, r, inputs.bits, c.rod_force_n, read)


def carrying(law: Controller, mass_kg: float, p: AxisParameters) -> Controller:
    """The law that reckons with a workpiece beside the axis's own mass."""
    whole_kg = p.controller.cylinder.M + mass_kg
    return law._replace(cylinder=law.cylinder._replace(M=whole_kg), sliding=law.sliding._replace(M=whole_kg))
