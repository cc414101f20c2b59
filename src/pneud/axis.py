"""One axis: `Axis.cycle` turns a measurement and a request into a command.

No clock, no bus, no file: the rig, the virtual run, the simulation and the replay all run this same
function, and its whole state is one record.
"""

from __future__ import annotations

from typing import NamedTuple

from pneud.control.reference import Bounds, Sine, Way, along, between_rests, sine, stays, stop, transfer, way
from pneud.control.step import Controller, ControllerState, act, join, observe, start
from pneud.safety import checks
from pneud.safety.checks import Limits
from pneud.safety.faults import BLOCKS_ARM, NO_SENSORS, F
from pneud.safety.output import CENTRED, OutputLimits, emit
from pneud.safety.supervisor import INITIAL, Supervisor, advance, is_engaged, trip
from pneud.safety.watch import INITIAL as WATCHFUL
from pneud.safety.watch import Watch, watch
from pneud.signals import (
    ALL_SOURCES,
    Answer,
    Command,
    Estimate,
    Measurement,
    Reference,
    Request,
    RequestKind,
    Source,
    State,
    Tick,
)

NAN = float("nan")
# operations on the enum's flags are slow
ENCODER, VALVE = int(Source.ENCODER), int(Source.VALVE)
NO_REQUEST, TAKEN, WRONG_STATE = int(Answer.NONE), int(Answer.TAKEN), int(Answer.WRONG_STATE)
BLOCKED, MALFORMED, CLOSING = int(Answer.BLOCKED), int(Answer.MALFORMED), int(Answer.CLOSING)
SETTLE_NS = 50_000_000  # the load is given this long after the reference has come to rest
NO_ESTIMATE = Estimate(NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN)
NO_REFERENCE = Reference(NAN, NAN, NAN, NAN)
NO_PATH = way(between_rests(0.0, 0.0, Bounds(1.0, 1.0, 1.0)))

# what the reference is doing
NONE, JOINING, FOLLOWING, COMING_TO_REST = 0, 1, 2, 3


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
    t_ns: int  # of the last tick
    sampled_ns: int  # instant that the estimate holds for
    read_ns: int  # instant of the last encoder reading
    started_ns: int  # since when there have been estimates
    phase: int
    phase_ns: int  # when the phase began
    path: Way
    last_v: float  # last command that left
    limited: int  # 1 where it was less than the law had asked for
    watch: Watch


class Axis:
    """The axis; `state` is everything it remembers."""

    def __init__(self, parameters: AxisParameters) -> None:
        """An axis that has just been switched on."""
        self.parameters = parameters
        self.state = AxisState(INITIAL, None, 0, 0, 0, 0, NONE, 0, NO_PATH, 0.0, 0, WATCHFUL)
        self.failure: Exception | None = None  # the first exception in a cycle

    def freeze(self) -> AxisState:
        """The whole state, to be logged or kept."""
        return self.state

    def thaw(self, state: AxisState) -> None:
        """Go on from a frozen state."""
        self.state = state

    def cycle(self, m: Measurement, request: Request | None, t_ns: int) -> Tick:
        """One tick.

        An exception in it centres the valve, latches the fault `internal` and is kept in `failure`.

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
            bits, kind = 1 << F.INTERNAL, request.kind if request is not None else 0
            before = self.state.supervisor
            after = trip(before, bits, kind)
            self.state = self.state._replace(
                supervisor=after, controller=None, t_ns=t_ns, phase=NONE, last_v=0.0, limited=0
            )
            return Tick(
                t_ns,
                m,
                request,
                NO_ESTIMATE,
                NO_REFERENCE,
                Command(0.0, 0, 0, NAN, NAN, NAN),
                after.state,
                bits,
                after.latched,
                _answer(kind, before, after, bits),
            )

    def _cycle(self, m: Measurement, request: Request | None, t_ns: int) -> Tick:
        p, state = self.parameters, self.state
        limits, h = p.limits, p.controller.h
        before = state.supervisor
        engaged = is_engaged(before.state)
        kind = request.kind if request is not None else 0
        arming = kind == RequestKind.ARM and before.state == State.DISARMED

        present = checks.lacking(m, limits)
        measured = bool(m.fresh & ENCODER)
        controller, estimate = state.controller, NO_ESTIMATE
        # without a reading the offset belongs to an old one
        sampled_ns = t_ns + m.encoder_offset_ns if measured else state.sampled_ns + t_ns - state.t_ns
        read_ns, started_ns = state.read_ns, state.started_ns
        elapsed_ns = sampled_ns - state.sampled_ns
        if present & NO_SENSORS or (not engaged and elapsed_ns > limits.sensor_timeout_ns):
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
                elapsed_ns * 1e-9 if elapsed_ns > 0 else h,
                p.controller,
            )
            if measured:
                read_ns = sampled_ns
        elif m.fresh == ALL_SOURCES:
            controller = start(m.position_m, m.p1_pa, m.p2_pa, m.supply_pa, p.controller)
            estimate = _first_estimate(controller)
            read_ns = started_ns = sampled_ns

        present |= checks.measured(m, limits) | checks.of_host(m.host)
        watched, found = watch(
            state.watch, m, estimate, before.state, engaged, state.last_v, state.limited, limits
        )
        present |= found
        if controller is None:
            # sensors that never answer together are not lacking, but there is nothing to arm on
            present |= 0 if present & NO_SENSORS else 1 << F.UNSETTLED
        else:
            present |= checks.believed(estimate, (read_ns - state.read_ns) * 1e-9, limits)
            if not engaged:
                present |= checks.unready(estimate, sampled_ns - started_ns, h)
        phase, phase_ns, path, reference = state.phase, state.phase_ns, state.path, NO_REFERENCE
        if engaged:
            present |= checks.engaged(m, estimate, before.state, before.ticks, h, limits)
            if phase == JOINING and sampled_ns - phase_ns >= path.T * 1e9:
                phase, phase_ns = FOLLOWING, phase_ns + round(path.T * 1e9)
            reference = _reference(phase, (sampled_ns - phase_ns) * 1e-9, path, p.reference)
            error_m = reference.position_m - estimate.position_m
            if controller is not None and not abs(error_m) <= limits.tracking_error_m:
                present |= 1 << F.TRACKING_ERROR
        else:
            present |= checks.disengaged(m, before.ticks, arming)
            if arming and not present & BLOCKS_ARM:
                phase, phase_ns, path = _join(sampled_ns, estimate, p)
                reference = _reference(phase, 0.0, path, p.reference)
                if not _reachable(phase, path, reference, estimate, p):
                    present |= 1 << F.UNREACHABLE

        at_rest = phase == COMING_TO_REST and sampled_ns - phase_ns >= path.T * 1e9 + SETTLE_NS
        after = advance(before, present, kind, at_rest)

        command = CENTRED
        law_v, s, ustar = NAN, NAN, NAN
        if is_engaged(after.state):
            assert controller is not None  # else a fault has centred an engaged axis, or kept it from arming
            if not engaged:
                controller = join(controller, estimate, reference, p.controller)
            elif after.state == State.STOPPING and before.state != State.STOPPING:
                path = stop(reference, p.transfer, limits.travel_min_m, limits.travel_max_m)
                phase, phase_ns, reference = COMING_TO_REST, sampled_ns, along(0.0, path)
            controller, answer = act(controller, estimate, reference, p.controller)
            law_v, s, ustar = answer.u_v, answer.s, answer.ustar
            command = emit(law_v, state.last_v, (1 + m.skipped) * h, p.output)
            if command.saturated:
                present |= 1 << F.SATURATED
            if command.faults:
                after = trip(after, command.faults)
                present |= command.faults
        if not is_engaged(after.state):
            phase = NONE
        if present & 1 << F.NOT_FINITE:
            controller = None  # it would remember

        self.state = AxisState(
            after,
            controller,
            t_ns,
            sampled_ns,
            read_ns,
            started_ns,
            phase,
            phase_ns,
            path,
            command.voltage_v,
            command.saturated,
            watched,
        )
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
            _answer(kind, before, after, present),
        )


def _answer(kind: int, before: Supervisor, after: Supervisor, present: int) -> int:
    if kind == 0:
        return NO_REQUEST
    if kind in (RequestKind.SHUTDOWN, RequestKind.MARK):
        return TAKEN
    if kind == RequestKind.ARM:
        wrong, done = before.state != State.DISARMED, is_engaged(after.state)
    elif kind == RequestKind.DISARM:
        wrong, done = not is_engaged(before.state), True
    elif kind == RequestKind.CLEAR:
        wrong, done = before.state != State.FAULT, after.state != State.FAULT
    else:
        return MALFORMED
    if wrong:
        return WRONG_STATE
    if done:
        return TAKEN
    return CLOSING if before.closing and not present & BLOCKS_ARM else BLOCKED


def _first_estimate(s: ControllerState) -> Estimate:
    motion, observer = s.motion, s.observer
    return Estimate(motion.x, motion.v, motion.F, motion.x3, observer.x_hat, observer.d_hat, 0.0, 0.0)


def _join(now_ns: int, e: Estimate, p: AxisParameters) -> tuple[int, int, Way]:
    first = sine(0.0, p.reference)
    if p.join_at_once:
        return FOLLOWING, now_ns, NO_PATH
    return JOINING, now_ns, transfer(e.position_m, first, p.transfer)


def _reference(phase: int, t: float, path: Way, p: Sine) -> Reference:
    return sine(t, p) if phase == FOLLOWING else along(t, path)


def _reachable(phase: int, path: Way, first: Reference, e: Estimate, p: AxisParameters) -> bool:
    if phase == FOLLOWING:
        return abs(first.position_m - e.position_m) <= p.limits.tracking_error_m
    return stays(path, p.limits.travel_min_m, p.limits.travel_max_m)
