"""A program: steps that an axis goes through by itself, as plain data, and what is looked at in each tick.

A step that is done makes the next one due, which the axis begins in the tick behind it. What a step waits for
is copied into the run when it begins, so that a tick that only waits looks at nothing but numbers.
"""

from typing import NamedTuple

from pneud.control.plan import FOLLOWING
from pneud.control.times import over_ns
from pneud.signals import Estimate, Progress, Reference, Source, Stage, State

# kinds of steps
GOTO, MOVE, TRACK, FORCE, WAIT, UNTIL, JUMP, REPEAT, OUTPUT, PASS = range(1, 11)
KINDS = range(GOTO, PASS + 1)
MOTIONS = (GOTO, MOVE)
LEADS = (GOTO, MOVE, TRACK, FORCE)  # say where the load is from then on
# when a motion is done
AT_ONCE, FAST, EXACT = range(3)
# what is waited for
NOTHING, NEAR, STANDING, JOINED, PRESSED, POSITION, THRUST, INPUT = range(8)
UNTILS = (POSITION, THRUST, INPUT)

MOST_STEPS = 256
# whose steps that are handed over are: one axis's; several axes'; one axis's, for a RUN and no input
ALONE, SHARED, WITHHELD = 0.0, 1.0, 2.0
MOST_TIMES = 1_000_000
MOST_BITS = 32  # inputs, and outputs
LONGEST_S = 1e6
# of the tolerance of a FAST step: where the reference has to be, too, which does so at the same time in every
# round; a load that is as near may be so a little sooner or later
LED_NEAR = 0.75
# and of that of an EXACT step: where the reference stands for its load. That is so some ticks before its way
# has ended; a way of whole periods ends with a tick, or just behind it
LED_THERE = 1e-3

NO_STAGE, STOPPED, ENDED = int(Stage.NONE), int(Stage.STOPPED), int(Stage.ENDED)
UNDER_WAY, DONE = int(Stage.UNDER_WAY), int(Stage.DONE)
DUE, LATE = int(Stage.DUE), int(Stage.LATE)
TRACKING, HOLDING = int(State.TRACKING), int(State.HOLDING)
ENCODER, PRESSURE = int(Source.ENCODER), int(Source.PRESSURE)
PRESSING = 10


class Step(NamedTuple):
    """One record; what its kind has no use for is 0."""

    kind: int
    target_m: float = 0.0  # to go to, or by
    speed_m_s: float = 0.0  # at most; 0, as likewise below: as configured
    acceleration_m_s2: float = 0.0
    jerk_m_s3: float = 0.0
    ends: int = 0  # AT_ONCE, FAST or EXACT
    tolerance_m: float = 0.0  # FAST: of the position; EXACT: of the error
    velocity_m_s: float = 0.0  # EXACT: that counts as standing
    time_s: float = 0.0  # for so long
    timeout_s: float = 0.0  # 0: none
    otherwise: int = 0  # where to go on if it is late; 0: nowhere, that is a fault
    mass_kg: float = 0.0  # of the workpiece that is carried
    what: int = 0  # is waited for
    low: float = 0.0  # between these: metres or newtons
    high: float = 0.0
    bit: int = 0  # of an input or output
    on: int = 0
    to: int = 0  # where to go on; steps count from 1
    times: int = 0  # that what is repeated is done
    force_n: float = 0.0
    rate_n_s: float = 0.0
    low_m: float = 0.0  # window of a force
    high_m: float = 0.0


Program = tuple[Step, ...]

INTEGERS = tuple(place for place, value in enumerate(Step(PASS)) if isinstance(value, int))


class Run(NamedTuple):
    """How far a program is."""

    stage: int = NO_STAGE
    record: int = 0  # the step begun last, from 1
    next: int = 0  # the step behind it
    lap: int = 0  # rounds done
    laps: int = 0  # to do; 0: without end
    shared: int = 0  # 1 where other axes go through the same steps: each waits until all have done one
    since_ns: int = 0  # when the step began
    within_ns: int = -1  # since when what it waits for holds; −1 where it does not
    kept: int = 0  # 1 where the next step, if it is a motion, leads to where it has led before
    led: int = 0  # the last motion that has begun, which goes on, or has left the axis where it is
    back: int = 0  # the step that was stopped, while the axis is led to where it was then; else 0
    aimed: int = 0  # 1 where `target_m` is the last position gone to
    target_m: float = 0.0
    mass_kg: float = 0.0  # of the workpiece that the law reckons with
    outputs: int = 0  # bits
    what: int = NOTHING  # as in the step that is under way
    tolerance_m: float = 0.0
    velocity_m_s: float = 0.0
    low: float = 0.0
    high: float = 0.0
    bit: int = 0
    on: int = 0
    time_ns: int = 0
    timeout_ns: int = 0
    counts: tuple[int, ...] = ()  # rounds of each REPEAT, by its place
    missing: int = 0  # steps that are still to be handed over: with some of them nothing begins
    withheld: int = 0  # 1 until it is begun: for who has handed it over, and no input


NO_RUN = Run()


def progress(run: Run) -> Progress | None:
    """What others see of a run; None where there is none."""
    if run.stage == NO_STAGE and run.outputs == 0:
        return None
    return Progress(run.record, run.lap, run.stage, run.outputs)


def stopped(run: Run) -> Run:
    """The run, stopped where it is; it goes on with the step that is not done yet."""
    if run.stage == DUE:
        return run._replace(stage=STOPPED, within_ns=-1)
    return run._replace(stage=STOPPED, next=run.record, kept=1, within_ns=-1)


def halted(run: Run) -> Run:
    """The run, stopped if it is under way."""
    return stopped(run) if run.stage >= UNDER_WAY else run


def resumed(run: Run, program: Program) -> Run:
    """A stopped run that goes on.

    A step that waits, or does something, is done where the last motion had led: that is done again first.
    """
    if run.back == 0 and run.led > 0 and run.next <= len(program) and program[run.next - 1].kind not in LEADS:
        return run._replace(stage=DUE, next=run.led, back=run.next, kept=1)
    return run._replace(stage=DUE)


def look(
    run: Run,
    t_ns: int,
    state: int,
    phase: int,
    in_position: int,
    e: Estimate,
    r: Reference,
    inputs: int,
    rod_force_n: float,
    read: int,
) -> Run:
    """The run after a tick.

    A load that stands has been near for a while, and is slow at its end: a single velocity, noisy as it is,
    would begin that while anew, and rounds would differ by it. What is said of load and force is said in a
    tick in which they have been read: without a reading no while begins, and none is over.

    Args:
        run: before it.
        t_ns: the tick's SYNC.
        state: of this tick.
        phase: of the reference.
        in_position: as the axis says.
        e: the estimate.
        r: the reference.
        inputs: bits.
        rod_force_n: of the atmosphere on the rod.
        read: bits of the sources that the estimate has from this tick.
    """
    if not (TRACKING <= state <= HOLDING or state == PRESSING):
        return stopped(run)
    if run.stage != UNDER_WAY:
        return run
    what = run.what
    met, slow = what == NOTHING, True
    if what == NEAR:
        led = abs(run.target_m - r.position_m) <= LED_NEAR * run.tolerance_m
        met = led and abs(run.target_m - e.position_m) <= run.tolerance_m
    elif what == STANDING:
        led = abs(run.target_m - r.position_m) <= LED_THERE * run.tolerance_m
        met = led and abs(r.position_m - e.position_m) <= run.tolerance_m
        at_rest = state == HOLDING or r.velocity_m_s == 0.0
        slow = at_rest and abs(e.velocity_m_s) <= run.velocity_m_s
    elif what == JOINED:
        met = phase == FOLLOWING
    elif what == PRESSED:
        # in the tick in which it is asked for, what is said is of the motion before
        met = state == PRESSING and in_position != 0 and t_ns > run.since_ns
    elif what == POSITION:
        met = run.low <= e.position_m <= run.high
    elif what == THRUST:
        met = run.low <= e.x3_n - rod_force_n <= run.high
    elif what == INPUT:
        met = (inputs >> run.bit & 1) == run.on
    if met and not is_seen(what, read):
        within_ns = run.within_ns
    elif met:
        within_ns = run.within_ns if run.within_ns >= 0 else t_ns
        if t_ns - within_ns >= run.time_ns and slow:
            return run._replace(stage=DONE if run.shared != 0 and run.back == 0 else DUE, within_ns=-1)
    else:
        within_ns = -1
    if run.timeout_ns > 0 and t_ns - run.since_ns >= run.timeout_ns:
        return run._replace(stage=LATE, within_ns=-1)
    if within_ns != run.within_ns:
        return run._replace(within_ns=within_ns)
    return run


def is_seen(what: int, read: int) -> bool:
    """Whether what is waited for could be seen in a tick, and is not led on from older readings.

    Args:
        what: is waited for.
        read: bits of the sources that the estimate has from this tick.
    """
    if what in (NEAR, STANDING, POSITION):
        return read & ENCODER != 0
    return what != THRUST or read & PRESSURE != 0


def begins(run: Run, program: Program) -> Run:
    """The run whose next step is the one under way; behind the last one a round is done, or all are."""
    record, lap, counts = run.next, run.lap, run.counts
    if record > len(program):
        record, lap, counts = 1, lap + 1, (0,) * len(program)
        if lap == run.laps:
            return run._replace(stage=ENDED, lap=lap, kept=0)
    back = 0 if run.back == record else run.back
    return run._replace(
        stage=UNDER_WAY,
        record=record,
        next=back if back > 0 else record + 1,
        back=back,
        lap=lap,
        counts=counts,
        within_ns=-1,
        kept=0,
    )


def repeated(run: Run, step: Step) -> Run:
    """The run that goes back to what is repeated, or on behind it."""
    place = run.record - 1
    done = run.counts[place] + 1
    again = done < step.times
    counts = (*run.counts[:place], done if again else 0, *run.counts[place + 1 :])
    return run._replace(stage=DUE, next=step.to if again else run.next, counts=counts)


def awaiting(run: Run, step: Step, t_ns: int, period_ns: int) -> Run:
    """The run that waits for what its step waits for.

    Args:
        run: whose step begins.
        step: the step.
        t_ns: the tick's SYNC.
        period_ns: of the ticks.
    """
    what = step.what
    if step.kind in MOTIONS:
        what = (NOTHING, NEAR, STANDING)[step.ends]
    elif step.kind == TRACK:
        what = JOINED
    elif step.kind == FORCE:
        what = PRESSED
    return run._replace(
        stage=UNDER_WAY,
        since_ns=t_ns,
        led=run.record if step.kind in LEADS else run.led,
        what=what,
        tolerance_m=step.tolerance_m,
        velocity_m_s=step.velocity_m_s,
        low=step.low,
        high=step.high,
        bit=step.bit,
        on=step.on,
        time_ns=over_ns(step.time_s, period_ns),
        timeout_ns=max(1, over_ns(step.timeout_s, period_ns)) if step.timeout_s > 0.0 else 0,
    )


def step_of(values: tuple[float, ...]) -> Step | None:
    """The step of a request's values; None where they are none."""
    if len(values) != len(Step._fields):
        return None
    whole = [int(values[place]) for place in INTEGERS]
    if any(values[place] != number for place, number in zip(INTEGERS, whole, strict=True)):
        return None
    parts: list[float] = list(values)
    for place, number in zip(INTEGERS, whole, strict=True):
        parts[place] = number
    step = Step._make(parts)
    return step if is_sound(step) else None


def is_sound(s: Step) -> bool:
    """Whether each number is one of its kind; where it leads to is for `leads`."""
    return (
        s.kind in KINDS
        and s.ends in (AT_ONCE, FAST, EXACT)
        and min(s.speed_m_s, s.acceleration_m_s2, s.jerk_m_s3, s.tolerance_m, s.velocity_m_s) >= 0.0
        and 0.0 <= s.time_s <= LONGEST_S
        and 0.0 <= s.timeout_s <= LONGEST_S
        and s.mass_kg >= 0.0
        and (s.what in UNTILS if s.kind == UNTIL else s.what == NOTHING)
        and 0 <= s.bit < MOST_BITS
        and s.on in (0, 1)
        and s.low <= s.high
        and 0 <= s.times <= MOST_TIMES
        and (s.kind != REPEAT or s.times > 0)
    )


def leads(program: Program) -> bool:
    """Whether there is a program, and every step that goes elsewhere goes to one of it."""
    most = len(program)
    return most > 0 and all(
        (s.kind not in (JUMP, REPEAT) or 1 <= s.to <= most) and 0 <= s.otherwise <= most for s in program
    )
