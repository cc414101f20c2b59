"""The arithmetic of a tick: what is believed and which faults show, and what leaves for the valve.

Pure functions on numbers, so that the compiled law has each of them as one call.
"""

from typing import NamedTuple

from pneud.axis.state import AxisParameters, AxisState, learnt_so_far
from pneud.control.step import Controller, ControllerState, act, observe, resume
from pneud.safety import checks
from pneud.safety.faults import NO_SENSORS, F
from pneud.safety.output import OutputLimits, emit
from pneud.safety.supervisor import is_engaged
from pneud.safety.watch import Seen, is_disagreeing, look
from pneud.signals import ALL_SOURCES, Command, Defect, Estimate, Measurement, Reference, Source

NAN = float("nan")
NO_ESTIMATE = Estimate(NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN)
ENCODER, PRESSURE, VALVE = int(Source.ENCODER), int(Source.PRESSURE), int(Source.VALVE)
ODD = int(Defect.ODD)
UNSETTLED, MOVING, ENCODER_JUMP = 1 << F.UNSETTLED, 1 << F.MOVING, 1 << F.ENCODER_JUMP


class Belief(NamedTuple):
    """What is known of the load, and since when [ns]."""

    controller: ControllerState | None  # None as long as not all sensors have spoken
    estimate: Estimate
    sampled_ns: int  # the instant that the estimate holds for
    read_ns: int  # of the last encoder reading
    started_ns: int  # since when there have been estimates


class Sensed(NamedTuple):
    """What a measurement comes to."""

    belief: Belief
    seen: Seen
    lasting: int  # bits of conditions that have to last
    present: int  # bits of the faults that hold now


class Driven(NamedTuple):
    """What leaves for the valve."""

    controller: ControllerState | None
    command: Command
    faults: int  # bits of those found on the way out


def sense(state: AxisState, m: Measurement, arming: bool, t_ns: int, p: AxisParameters) -> Sensed:
    """Take one measurement in.

    Args:
        state: after the last tick.
        m: the measurement.
        arming: a disarmed axis is asked to arm.
        t_ns: this tick's SYNC.
        p: parameters.
    """
    before, limits, h = state.supervisor, p.limits, state.law.h
    engaged = is_engaged(before.state)
    present = checks.lacking(m, limits)
    belief = believe(state, m, t_ns, engaged, present, limits.sensor_timeout_ns)
    estimate = belief.estimate
    seen, lasting, bits = look(
        state.watch.seen,
        m,
        estimate,
        before.state,
        engaged,
        state.last_v,
        state.limited,
        is_disagreeing(state.watch),
        limits,
    )
    present |= checks.measured(m, limits) | bits
    if belief.controller is not None:
        present |= checks.believed(estimate, (belief.read_ns - state.read_ns) * 1e-9, limits)
        if not engaged:
            present |= checks.unready(estimate, belief.sampled_ns - belief.started_ns, h)
            astray = abs(estimate.x3_hat_n - estimate.x3_n) > limits.disagreement_n
            if present & ENCODER_JUMP or (astray and not present & MOVING):
                # one absurd reading leaves the estimates wrong for long: they begin anew with the next tick
                belief = belief._replace(controller=None)
                present |= UNSETTLED
    elif not present & NO_SENSORS:
        # sensors that never answer together are not lacking, but there is nothing to arm on
        present |= UNSETTLED
    if engaged:
        present |= checks.engaged(m, estimate, before.state, before.ticks, h, limits)
    else:
        present |= checks.disengaged(m, before.ticks, arming)
    return Sensed(belief, seen, lasting, present)


def believe(
    state: AxisState, m: Measurement, t_ns: int, engaged: bool, lacking: int, timeout_ns: int
) -> Belief:
    """What is known of the load with one more measurement.

    Args:
        state: after the last tick.
        m: the measurement.
        t_ns: this tick's SYNC.
        engaged: the axis was engaged in the last tick.
        lacking: bits of faults; of sources that have been silent for too long nothing is believed.
        timeout_ns: nor is, after so long without a tick, what a disengaged axis knew.
    """
    measured = m.fresh & ENCODER != 0 and not m.encoder_defects & ODD
    # without a reading the offset belongs to an old one
    sampled_ns = t_ns + m.encoder_offset_ns if measured else state.sampled_ns + t_ns - state.t_ns
    elapsed_ns = sampled_ns - state.sampled_ns
    controller, read_ns, started_ns = state.controller, state.read_ns, state.started_ns
    estimate = NO_ESTIMATE
    if lacking & NO_SENSORS or (not engaged and elapsed_ns > timeout_ns):
        controller = None
    if controller is not None:
        controller, estimate = observe(
            controller,
            m.position_m,
            measured,
            m.p1_pa,
            m.p2_pa,
            m.supply_pa,
            m.applied_v if m.fresh & VALVE else state.last_v,
            elapsed_ns * 1e-9 if elapsed_ns > 0 else state.law.h,
            state.law,
        )
        if measured:
            read_ns = sampled_ns
    elif m.fresh == ALL_SOURCES:
        controller = resume(m.position_m, m.p1_pa, m.p2_pa, m.supply_pa, state.law, learnt_so_far(state))
        estimate = first_estimate(controller)
        read_ns, started_ns = sampled_ns, sampled_ns
    return Belief(controller, estimate, sampled_ns, read_ns, started_ns)


def just_read(b: Belief, m: Measurement) -> int:
    """Bits of the sources that the estimate has from this tick; of others it is led on from older readings.

    Args:
        b: what is known of the load.
        m: the measurement.
    """
    others = m.fresh & (PRESSURE | VALVE)
    return others | ENCODER if b.read_ns == b.sampled_ns else others


def first_estimate(s: ControllerState) -> Estimate:
    """What a controller believes that has just started."""
    motion, observer = s.motion, s.observer
    return Estimate(motion.x, motion.v, motion.F, motion.x3, observer.x_hat, observer.d_hat, 0.0, 0.0)


def drive(
    controller: ControllerState,
    e: Estimate,
    r: Reference,
    last_v: float,
    dt: float,
    law: Controller,
    output: OutputLimits,
) -> Driven:
    """The command for an estimate and a reference of the same instant.

    Args:
        controller: as `sense` left it.
        e: the estimate.
        r: the reference.
        last_v: the last command that left [V].
        dt: time since then [s].
        law: with its present gains.
        output: bounds of the command.
    """
    controller, answer = act(controller, e, r, law)
    out = emit(answer.u_v, last_v, dt, output)
    command = Command(out.voltage_v, out.enable, out.saturated, answer.u_v, answer.s, answer.ustar)
    return Driven(controller, command, out.faults)
