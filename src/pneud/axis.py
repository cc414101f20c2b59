"""One axis: `Axis.cycle` turns a measurement and a request into a command.

No clock, no bus, no file: the rig, the virtual run, the simulation and the replay all run this same
function, and its whole state is one record.
"""

from __future__ import annotations

from typing import NamedTuple

from pneud.asking import BLOCKED, NOTHING, TAKEN, AxisParameters, ask
from pneud.control import homing
from pneud.control.homing import NOWHERE, Homing
from pneud.control.plan import FOLLOWING, IDLE, Plan, follow, halting, resting
from pneud.control.profile import Profile
from pneud.control.reference import Way, rest
from pneud.control.step import Controller, ControllerState, act, change, join, observe, start
from pneud.safety import checks
from pneud.safety.faults import NO_SENSORS, F
from pneud.safety.output import CENTRED, emit
from pneud.safety.supervisor import INITIAL, Supervisor, advance, is_engaged, trip
from pneud.safety.watch import INITIAL as WATCHFUL
from pneud.safety.watch import Watch, watch
from pneud.signals import (
    ALL_SOURCES,
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

__all__ = ["FOLLOWING", "Axis", "AxisParameters", "AxisState"]

NAN = float("nan")
# operations on the enum's flags are slow
ENCODER, VALVE = int(Source.ENCODER), int(Source.VALVE)
# an encoder that was silent, wrong or jumped may have lost count
LOSES_REFERENCE = sum(
    1 << fault
    for fault in (F.ENCODER_MISSING, F.ENCODER_CORRUPT, F.ENCODER_FROZEN, F.ENCODER_ERROR, F.ENCODER_JUMP)
)
NO_ESTIMATE = Estimate(NAN, NAN, NAN, NAN, NAN, NAN, NAN, NAN)
NO_REFERENCE = Reference(NAN, NAN, NAN, NAN)


class AxisState(NamedTuple):
    """All state of an axis: freeze it, thaw it, and the same ticks follow."""

    supervisor: Supervisor
    controller: ControllerState | None  # None until all sensors have spoken
    t_ns: int  # of the last tick
    sampled_ns: int  # instant that the estimate holds for
    read_ns: int  # instant of the last encoder reading
    started_ns: int  # since when there have been estimates
    plan: Plan  # what the reference is doing
    profile: Profile  # as uploaded
    last_v: float  # last command that left
    limited: int  # 1 where it was less than the law had asked for
    watch: Watch
    law: Controller  # with its present gains
    zero_m: float  # where an incremental encoder shows 0
    referenced: bool  # whether that is known
    homing: Homing

    @property
    def phase(self) -> int:
        """What the reference is doing."""
        return self.plan.phase

    @property
    def phase_ns(self) -> int:
        """When it began to."""
        return self.plan.since_ns

    @property
    def path(self) -> Way:
        """The way that it goes."""
        return self.plan.path


class Axis:
    """The axis; `state` is everything it remembers."""

    def __init__(self, parameters: AxisParameters) -> None:
        """An axis that has just been switched on."""
        self.parameters = parameters
        self.state = AxisState(
            INITIAL, None, 0, 0, 0, 0, IDLE, (), 0.0, 0, WATCHFUL, parameters.controller, 0.0, False, NOWHERE
        )
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
            after = trip(self.state.supervisor, bits, kind)
            self.state = self.state._replace(
                supervisor=after, controller=None, t_ns=t_ns, plan=IDLE, last_v=0.0, limited=0
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
                0 if kind == 0 else TAKEN if kind == RequestKind.SHUTDOWN else BLOCKED,
            )

    def _cycle(self, m: Measurement, request: Request | None, t_ns: int) -> Tick:
        p, state = self.parameters, self.state
        law, limits = state.law, p.limits
        h = law.h
        before = state.supervisor
        engaged = is_engaged(before.state)
        incremental, zero_m, referenced = p.homing.incremental, state.zero_m, state.referenced
        if incremental:
            m = homing.placed(m, zero_m, referenced)

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
                law,
            )
            if measured:
                read_ns = sampled_ns
        elif m.fresh == ALL_SOURCES:
            controller = start(m.position_m, m.p1_pa, m.p2_pa, m.supply_pa, law)
            estimate = _first_estimate(controller)
            read_ns = started_ns = sampled_ns

        present |= checks.measured(m, limits) | checks.of_host(m.host)
        if incremental and (not referenced or before.state == State.HOMING):
            present &= ~(1 << F.TRAVEL)  # the stop lies beyond it
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
        astray = abs(estimate.x3_hat_n - estimate.x3_n) > limits.disagreement_n
        if astray and not engaged and not present >> F.MOVING & 1:
            # one absurd reading leaves the observer wrong for hours: it begins anew with the next tick
            controller = None
            present |= 1 << F.UNSETTLED
        plan, reference, at_rest, way = state.plan, NO_REFERENCE, False, state.homing
        if engaged:
            present |= checks.engaged(m, estimate, before.state, before.ticks, h, limits)
        if before.state == State.HOMING:
            way, found_stop, at_rest, failed = homing.proceed(
                way, estimate, sampled_ns, h, law.cylinder.rod_force_n, p.homing
            )
            present |= failed << F.HOMING_FAILED
            if found_stop:
                zero_m, referenced = zero_m + p.homing.stop_m - m.position_m, True
                controller = start(p.homing.stop_m, m.p1_pa, m.p2_pa, m.supply_pa, law)
                nowhere = watched.seen._replace(position_m=NAN, changed1_m=NAN, changed2_m=NAN)
                watched = watched._replace(seen=nowhere)
        elif engaged:
            plan, reference, at_rest = follow(plan, sampled_ns, p.reference, state.profile)
            error_m = reference.position_m - estimate.position_m
            if controller is not None and not abs(error_m) <= limits.tracking_error_m:
                present |= 1 << F.TRACKING_ERROR
            if plan.jog_m_s != 0.0:
                plan = plan._replace(lease=plan.lease - 1 - m.skipped)
        else:
            arming = request is not None and request.kind in (RequestKind.ARM, RequestKind.HOME)
            present |= checks.disengaged(m, before.ticks, arming and before.state == State.DISARMED)

        asked = NOTHING
        if request is not None:
            asked = ask(
                request, before, present, plan, state.profile, reference, estimate, sampled_ns, law, p
            )
            present |= asked.faults
        if present & LOSES_REFERENCE:
            referenced = False
        profile = state.profile if asked.profile is None else asked.profile
        after = advance(before, present, asked.kind, at_rest)

        command = CENTRED
        law_v, s, ustar = NAN, NAN, NAN
        if is_engaged(after.state):
            assert controller is not None  # else a fault has centred an engaged axis, or kept it from arming
            if asked.plan is not None:
                plan = asked.plan
            if after.state == State.HOMING and before.state != State.HOMING:
                way, referenced, plan = homing.set_out(estimate.position_m, sampled_ns), False, IDLE
            if plan.lease < 0:
                present |= 1 << F.OPERATOR_LOST
            if after.state == State.HOMING:
                velocity = homing.direction(way.part, p.homing) * p.homing.speed_m_s
                reference = Reference(estimate.position_m, velocity, 0.0, 0.0)
            elif before.state == State.HOMING:
                plan, reference = resting(estimate.position_m, sampled_ns), rest(estimate.position_m)
                controller = join(controller, estimate, reference, law)
            elif not engaged:
                plan, reference, _ = follow(plan, sampled_ns, p.reference, profile)
                controller = join(controller, estimate, reference, law)
            elif after.state == State.HOLDING and before.state != State.HOLDING:
                plan = resting(reference.position_m, sampled_ns)
            elif (after.state == State.STOPPING and before.state != State.STOPPING) or plan.lease < 0:
                plan = halting(
                    plan, reference, sampled_ns, p.motion, limits.travel_min_m, limits.travel_max_m
                )
            if asked.law is not None and after.state != State.HOMING:
                controller = change(controller, estimate, reference, law, asked.law)
            if after.state == State.HOMING:
                law_v, s, ustar = homing.command(way, m, estimate, p.homing, law), 0.0, 0.0
            else:
                controller, answer = act(controller, estimate, reference, asked.law or law)
                law_v, s, ustar = answer.u_v, answer.s, answer.ustar
            command = emit(law_v, state.last_v, (1 + m.skipped) * h, p.output)
            if command.saturated:
                present |= 1 << F.SATURATED
            if command.faults:
                after = trip(after, command.faults)
                present |= command.faults
        if not is_engaged(after.state):
            plan = IDLE
        if present & 1 << F.NOT_FINITE:
            controller = None  # it would remember

        self.state = AxisState(
            after,
            controller,
            t_ns,
            sampled_ns,
            read_ns,
            started_ns,
            plan,
            profile,
            command.voltage_v,
            command.saturated,
            watched,
            asked.law or law,
            zero_m,
            referenced,
            way,
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
            asked.answer,
        )


def _first_estimate(s: ControllerState) -> Estimate:
    motion, observer = s.motion, s.observer
    return Estimate(motion.x, motion.v, motion.F, motion.x3, observer.x_hat, observer.d_hat, 0.0, 0.0)
