"""One axis: `Axis.cycle` turns a measurement and a request into a command.

No clock, no bus, no file: the rig, the virtual run, the simulation and the replay all run this same
function, and its whole state is one record.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.control.reference import Bounds, Septic, Sine, at, rest, sine, to_rest, transfer
from pneud.control.step import Controller, ControllerState, act, join, observe, start
from pneud.safety.faults import NO_SENSORS, F
from pneud.safety.output import CENTRED, OutputLimits, emit
from pneud.safety.supervisor import INITIAL, Supervisor, advance, is_engaged, trip
from pneud.signals import (
    ALL_SOURCES,
    Command,
    Defect,
    EncoderStatus,
    Estimate,
    Host,
    Measurement,
    Reference,
    Request,
    Source,
    State,
    Tick,
    ValveState,
)

NAN = float("nan")
SETTLE_NS = 50_000_000  # the load is given this long after the reference has come to rest
MOVING_M_S = 0.01  # faster than this cannot be armed
NO_ESTIMATE = Estimate(NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN)
NO_REFERENCE = Reference(NAN, NAN, NAN, NAN)
NO_PATH = Septic(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

# what the reference is doing
NONE, JOINING, FOLLOWING, COMING_TO_REST = 0, 1, 2, 3


class Limits(NamedTuple):
    """What the axis may never exceed."""

    travel_min_m: float
    travel_max_m: float
    speed_m_s: float
    tracking_error_m: float
    chamber_min_pa: float
    chamber_max_pa: float
    supply_min_pa: float
    supply_max_pa: float
    sensor_timeout_ns: int
    valve_timeout_ns: int
    deadline_timeout_ns: int


class AxisParameters(NamedTuple):
    """All parameters of an axis."""

    controller: Controller
    output: OutputLimits
    limits: Limits
    reference: Sine
    transfer: Bounds
    join_at_once: bool  # start on the reference without a transfer


class AxisState(NamedTuple):
    """All state of an axis: freeze it, thaw it, and the same ticks follow."""

    supervisor: Supervisor
    controller: ControllerState | None  # None until all sensors have spoken
    sampled_ns: int  # instant of the last sample
    phase: int
    phase_ns: int  # when the phase began
    path: Septic
    last_v: float  # last command that left


class Axis:
    """The axis; `state` is everything it remembers."""

    def __init__(self, parameters: AxisParameters) -> None:
        """An axis that has just been switched on."""
        self.parameters = parameters
        self.state = AxisState(INITIAL, None, 0, NONE, 0, NO_PATH, 0.0)
        self.failure: Exception | None = None  # the first exception in a cycle

    def freeze(self) -> AxisState:
        """The whole state, to be logged or kept."""
        return self.state

    def thaw(self, state: AxisState) -> None:
        """Go on from a frozen state."""
        self.state = state

    def cycle(self, m: Measurement, request: Request | None, t_ns: int) -> Tick:
        """One tick. An exception in it centres the valve, latches the fault `internal` and is kept in
        `failure`.

        Args:
            m: the newest measurement.
            request: at most one request of the operator.
            t_ns: instant of this tick's SYNC.
        """
        try:
            return self._cycle(m, request, t_ns)
        except Exception as e:
            if self.failure is None:
                self.failure = e
            after = trip(self.state.supervisor, 1 << F.INTERNAL)
            self.state = self.state._replace(supervisor=after, controller=None, phase=NONE, last_v=0.0)
            return Tick(
                t_ns,
                m,
                request,
                NO_ESTIMATE,
                NO_REFERENCE,
                Command(0.0, 0, 0, NAN, NAN, NAN),
                after.state,
                after.latched,
                after.latched,
            )

    def _cycle(self, m: Measurement, request: Request | None, t_ns: int) -> Tick:
        p = self.parameters
        state = self.state
        sampled_ns = t_ns + m.encoder_offset_ns

        lacking = _lacking(m, p.limits)
        controller, estimate = state.controller, NO_ESTIMATE
        if lacking & NO_SENSORS:
            controller = None
        elif controller is None:
            if m.fresh == ALL_SOURCES:
                controller = start(m.position_m, m.p1_pa, m.p2_pa, m.supply_pa, p.controller)
                estimate = _first_estimate(controller)
        else:
            dt = (sampled_ns - state.sampled_ns) * 1e-9
            applied = m.applied_v if m.fresh & Source.VALVE else state.last_v
            controller, estimate = observe(
                controller,
                m.position_m,
                bool(m.fresh & Source.ENCODER),
                m.p1_pa,
                m.p2_pa,
                m.supply_pa,
                applied,
                dt if dt > 0.0 else p.controller.h,
                p.controller,
            )

        before = state.supervisor
        present = lacking | _found(m, p.limits) | _host(m.host)
        engaged = is_engaged(before.state)
        phase, phase_ns, path, reference = state.phase, state.phase_ns, state.path, NO_REFERENCE
        if controller is not None:
            present |= _believed(estimate, p.limits)
            if not engaged and abs(estimate.velocity_m_s) > MOVING_M_S:
                present |= 1 << F.MOVING
            if engaged:
                if phase == JOINING and sampled_ns - phase_ns >= path.T * 1e9:
                    phase, phase_ns = FOLLOWING, phase_ns + round(path.T * 1e9)
                reference = _reference(phase, (sampled_ns - phase_ns) * 1e-9, path, p.reference)
                if not abs(reference.position_m - estimate.position_m) <= p.limits.tracking_error_m:
                    present |= 1 << F.TRACKING_ERROR
        if engaged:
            present |= _engaged_only(m, before, p)

        at_rest = phase == COMING_TO_REST and sampled_ns - phase_ns >= path.T * 1e9 + SETTLE_NS
        after = advance(before, present, request.kind if request is not None else 0, at_rest)

        command = CENTRED
        law_v, s, ustar = NAN, NAN, NAN
        if is_engaged(after.state) and controller is not None:
            if not engaged:
                phase, phase_ns, path = _join(sampled_ns, estimate, p)
                reference = _reference(phase, 0.0, path, p.reference)
                controller = join(controller, estimate, reference, p.controller)
            elif after.state == State.STOPPING and before.state != State.STOPPING:
                phase, phase_ns, path = COMING_TO_REST, sampled_ns, to_rest(reference, p.transfer)
                reference = at(0.0, path)
            controller, answer = act(controller, estimate, reference, p.controller)
            law_v, s, ustar = answer.u_v, answer.s, answer.ustar
            command = emit(law_v, state.last_v, (1 + m.skipped) * p.controller.h, p.output)
            if command.faults:
                after = trip(after, command.faults)
                present |= command.faults
        if not is_engaged(after.state):
            phase = NONE

        self.state = AxisState(after, controller, sampled_ns, phase, phase_ns, path, command.voltage_v)
        return Tick(
            t_ns,
            m,
            request,
            estimate,
            reference,
            Command(command.voltage_v, command.enable, command.saturated, law_v, s, ustar),
            after.state,
            present,
            after.latched,
        )


def _lacking(m: Measurement, limits: Limits) -> int:
    """Faults of sources that have given no valid value for too long, named after what came instead."""
    bits = 0
    for age_ns, defects, first in (
        (m.encoder_age_ns, m.encoder_defects, F.ENCODER_MISSING),
        (m.pressure_age_ns, m.pressure_defects, F.PRESSURE_MISSING),
        (m.valve_age_ns, m.valve_defects, F.VALVE_MISSING),
    ):
        if age_ns > limits.sensor_timeout_ns:
            # missing, corrupt, frozen, late stand in this order in the table
            if defects & Defect.CORRUPT:
                bits |= 1 << (first + 1)
            elif defects & Defect.FROZEN:
                bits |= 1 << (first + 2)
            elif defects & Defect.LATE:
                bits |= 1 << (first + 3)
            else:
                bits |= 1 << first
    return bits


def _found(m: Measurement, limits: Limits) -> int:
    """Faults that a single measurement shows. A value that was never seen is NaN and within no limits."""
    bits = 0
    if m.encoder_status & EncoderStatus.ERROR:
        bits |= 1 << F.ENCODER_ERROR
    if not m.encoder_status & EncoderStatus.REFERENCED:
        bits |= 1 << F.ENCODER_UNREFERENCED
    if not limits.travel_min_m <= m.position_m <= limits.travel_max_m:
        bits |= 1 << F.TRAVEL
    low, high = limits.chamber_min_pa, limits.chamber_max_pa
    if not (low <= m.p1_pa <= high and low <= m.p2_pa <= high):
        bits |= 1 << F.CHAMBER_PRESSURE
    if not limits.supply_min_pa <= m.supply_pa <= limits.supply_max_pa:
        bits |= 1 << F.SUPPLY_PRESSURE
    if m.valve_state == ValveState.TIMED_OUT:
        bits |= 1 << F.VALVE_TIMED_OUT
    elif m.valve_state == ValveState.FAULT:
        bits |= 1 << F.VALVE_FAULT
    return bits


def _host(host: int) -> int:
    """Faults of the machine."""
    bits = 0
    if host:
        for flag, fault in (
            (Host.LINK_DOWN, F.LINK_DOWN),
            (Host.NO_REALTIME, F.NO_REALTIME),
            (Host.RECORDER_LOST, F.RECORDER_LOST),
            (Host.CLOCK_STEP, F.CLOCK_STEP),
            (Host.SEND_FAILED, F.SEND_FAILED),
        ):
            if host & flag:
                bits |= 1 << fault
    return bits


def _believed(e: Estimate, limits: Limits) -> int:
    """Faults that the estimate shows."""
    if not math.isfinite(e.position_m + e.velocity_m_s + e.force_n + e.d_hat_n_s):
        return 1 << F.NOT_FINITE
    return 1 << F.OVERSPEED if abs(e.velocity_m_s) > limits.speed_m_s else 0


def _engaged_only(m: Measurement, s: Supervisor, p: AxisParameters) -> int:
    """Faults that mean something only while the valve is enabled."""
    bits = 0
    if m.skipped * p.controller.h * 1e9 >= p.limits.deadline_timeout_ns:
        bits |= 1 << F.DEADLINE
    since_ns = s.ticks * p.controller.h * 1e9
    if since_ns > p.limits.valve_timeout_ns and m.valve_state in (ValveState.BOOT, ValveState.CENTRED):
        bits |= 1 << F.VALVE_REBOOTED
    return bits


def _first_estimate(s: ControllerState) -> Estimate:
    motion, observer = s.motion, s.observer
    return Estimate(motion.x, motion.v, motion.F, motion.x3, observer.x_hat, observer.d_hat, 0.0, 0.0)


def _join(now_ns: int, e: Estimate, p: AxisParameters) -> tuple[int, int, Septic]:
    first = sine(0.0, p.reference)
    if p.join_at_once:
        return FOLLOWING, now_ns, NO_PATH
    return JOINING, now_ns, transfer(rest(e.position_m), first, p.transfer)


def _reference(phase: int, t: float, path: Septic, p: Sine) -> Reference:
    return sine(t, p) if phase == FOLLOWING else at(t, path)
