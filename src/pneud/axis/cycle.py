"""One axis: `Axis.cycle` turns a measurement and a request into a command.

No clock, no bus, no file: the rig, the virtual run, the simulation and the replay all run this same
function, and its whole state is one record.
"""

from __future__ import annotations

from typing import NamedTuple

from pneud.axis.requests import ARM, BLOCKED, HOME, NOTHING, TAKEN, AxisParameters, ask
from pneud.axis.sensing import NAN, NO_ESTIMATE, Instants, drive, sense
from pneud.control import homing
from pneud.control.homing import NOWHERE, Homing
from pneud.control.plan import FOLLOWING, IDLE, NONE, Plan, follow, halting, resting
from pneud.control.profile import Profile
from pneud.control.reference import Sine, Way, rest
from pneud.control.step import Controller, ControllerState, change, join, start
from pneud.safety import checks
from pneud.safety.faults import F
from pneud.safety.output import emit
from pneud.safety.supervisor import (
    DISARMED,
    HOLDING,
    HOMING,
    INITIAL,
    STOPPING,
    Supervisor,
    advance,
    is_engaged,
    trip,
)
from pneud.safety.watch import INITIAL as WATCHFUL
from pneud.safety.watch import Watch, is_disagreeing, remember
from pneud.signals import Command, Measurement, Reference, Request, RequestKind, Tick

__all__ = ["FOLLOWING", "Axis", "AxisParameters", "AxisState"]

# an encoder that was silent, wrong or jumped may have lost count
LOSES_REFERENCE = sum(
    1 << fault
    for fault in (F.ENCODER_MISSING, F.ENCODER_CORRUPT, F.ENCODER_FROZEN, F.ENCODER_ERROR, F.ENCODER_JUMP)
)
# plain numbers: to get at a member of an enumeration takes longer than most of what is done with it
TRAVEL, TRACKING_ERROR, OPERATOR_LOST = 1 << F.TRAVEL, 1 << F.TRACKING_ERROR, 1 << F.OPERATOR_LOST
SATURATED, NOT_FINITE = 1 << F.SATURATED, 1 << F.NOT_FINITE
NO_REFERENCE = Reference(NAN, NAN, NAN, NAN)
CENTRED_COMMAND = Command(0.0, 0, 0, NAN, NAN, NAN)


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
    reference: Sine | None = None  # the configured one, where it has been changed

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


def cycle(
    state: AxisState, m: Measurement, request: Request | None, t_ns: int, p: AxisParameters
) -> tuple[AxisState, Tick]:
    """One tick: the state after it, and what it came to.

    Args:
        state: after the last tick.
        m: the newest measurement.
        request: at most one request of the operator.
        t_ns: instant of this tick's SYNC.
        p: parameters.
    """
    law, limits = state.law, p.limits
    changed = state.reference
    configured = _tracked(changed, p.reference)
    h = law.h
    before = state.supervisor
    engaged = is_engaged(before.state)
    incremental, zero_m, referenced = p.homing.incremental, state.zero_m, state.referenced
    if incremental:
        m = homing.placed(m, zero_m, referenced)

    arming = request is not None and request.kind in (ARM, HOME) and before.state == DISARMED
    controller, estimate, instants, seen, lasting, present = sense(
        state.controller,
        Instants(state.t_ns, state.sampled_ns, state.read_ns, state.started_ns),
        state.watch.seen,
        is_disagreeing(state.watch),
        before,
        state.last_v,
        state.limited,
        m,
        t_ns,
        arming,
        law,
        limits,
    )
    sampled_ns = instants.sampled_ns
    present |= checks.of_host(m.host)
    if incremental and (not referenced or before.state == HOMING):
        present &= ~TRAVEL  # the stop lies beyond it
    watched, found = remember(state.watch, seen, lasting, m.t_ns, limits)
    present |= found
    plan, reference, at_rest, way = state.plan, NO_REFERENCE, False, state.homing
    if before.state == HOMING:
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
        plan, reference, at_rest = follow(plan, sampled_ns, configured, state.profile)
        error_m = reference.position_m - estimate.position_m
        if controller is not None and not abs(error_m) <= limits.tracking_error_m:
            present |= TRACKING_ERROR
        if plan.jog_m_s != 0.0:
            plan = plan._replace(lease=plan.lease - 1 - m.skipped)

    asked = NOTHING
    if request is not None:
        asked = ask(
            request,
            before,
            present,
            plan,
            state.profile,
            reference,
            estimate,
            sampled_ns,
            law,
            configured,
            p,
        )
        present |= asked.faults
    if present & LOSES_REFERENCE:
        referenced = False
    profile, gains = state.profile, law
    if asked.profile is not None:
        profile = asked.profile
    if asked.law is not None:
        gains = asked.law
    if asked.reference is not None:
        changed = asked.reference
    after = advance(before, present, asked.kind, at_rest)

    command = CENTRED_COMMAND
    if is_engaged(after.state):
        assert controller is not None  # else a fault has centred an engaged axis, or kept it from arming
        if asked.plan is not None:
            plan = asked.plan
        if after.state == HOMING and before.state != HOMING:
            way, referenced, plan = homing.set_out(estimate.position_m, sampled_ns), False, IDLE
        if plan.lease < 0:
            present |= OPERATOR_LOST
        if after.state == HOMING:
            velocity = homing.direction(way.part, p.homing) * p.homing.speed_m_s
            reference = Reference(estimate.position_m, velocity, 0.0, 0.0)
        elif before.state == HOMING:
            plan, reference = resting(estimate.position_m, sampled_ns), rest(estimate.position_m)
            controller = join(controller, estimate, reference, law)
        elif not engaged:
            plan, reference, _ = follow(plan, sampled_ns, configured, profile)
            controller = join(controller, estimate, reference, law)
        elif after.state == HOLDING and before.state != HOLDING:
            plan = resting(reference.position_m, sampled_ns)
        elif (after.state == STOPPING and before.state != STOPPING) or plan.lease < 0:
            plan = halting(plan, reference, sampled_ns, p.motion, limits.travel_min_m, limits.travel_max_m)
        if asked.law is not None and after.state != HOMING:
            controller = change(controller, estimate, reference, law, gains)
        dt = (1 + m.skipped) * h
        if after.state == HOMING:
            law_v, s, ustar = homing.command(way, m, estimate, p.homing, law), 0.0, 0.0
            voltage_v, enable, saturated, faults = emit(law_v, state.last_v, dt, p.output)
        else:
            controller, law_v, s, ustar, voltage_v, enable, saturated, faults = drive(
                controller, estimate, reference, state.last_v, dt, gains, p.output
            )
        command = Command(voltage_v, enable, saturated, law_v, s, ustar)
        if saturated:
            present |= SATURATED
        if faults:
            after = trip(after, faults)
            present |= faults
    if plan.phase != NONE and not is_engaged(after.state):
        plan = IDLE
    if present & NOT_FINITE:
        controller = None  # it would remember

    state = AxisState(
        after,
        controller,
        t_ns,
        sampled_ns,
        instants.read_ns,
        instants.started_ns,
        plan,
        profile,
        command.voltage_v,
        command.saturated,
        watched,
        gains,
        zero_m,
        referenced,
        way,
        changed,
    )
    tick = Tick(
        t_ns,
        m,
        request,
        estimate,
        reference,
        command,
        after.state,
        present,
        after.latched,
        asked.answer,
    )
    return state, tick


def _tracked(changed: Sine | None, configured: Sine) -> Sine:
    """The reference that the axis tracks when it is told to."""
    if changed is not None:
        return changed
    return configured


class Axis:
    """The axis; `state` is everything it remembers."""

    _cycle = staticmethod(cycle)

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
            self.state, tick = self._cycle(self.state, m, request, t_ns, self.parameters)
            return tick
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
                CENTRED_COMMAND,
                after.state,
                bits,
                after.latched,
                0 if kind == 0 else TAKEN if kind == RequestKind.SHUTDOWN else BLOCKED,
            )
