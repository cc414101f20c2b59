"""Checks that need a memory: what lasts, what stands still, what changes faster than it can.

Their whole memory is one record. A condition of a row with a debounce counts only after it has lasted.
"""

import math
from typing import NamedTuple

from pneud.safety.checks import Limits
from pneud.safety.faults import F
from pneud.signals import Defect, Estimate, Host, Measurement, Source, State, ValveState

SUPPLY_S = 0.05  # time constant of the slow supply pressure that the new one is compared with
HORIZON_S = 0.2  # a supply that leaves its limits within this time is falling
VALVE_V = 0.05  # the valve node may differ so much from a command
STILL_READINGS = 2  # the same so often: no moving load shows that
CHAMBER_PA = 20_000.0  # a chamber pressure may jump so far by noise

NAN = float("nan")
_ENCODER, _PRESSURE, _VALVE = int(Source.ENCODER), int(Source.PRESSURE), int(Source.VALVE)
_LINK_DOWN, _SEND_FAILED = int(Host.LINK_DOWN), int(Host.SEND_FAILED)
_CONFIRMED = int(Defect.CONFIRMED)
_ENABLED, _HOMING = int(ValveState.ENABLED), int(State.HOMING)
_SATURATED_LONG, _SUPPLY_FALLING = 1 << F.SATURATED_LONG, 1 << F.SUPPLY_FALLING
_FORCE_DISAGREES, _VALVE_DISAGREES = 1 << F.FORCE_DISAGREES, 1 << F.VALVE_DISAGREES
_ENCODER_STUCK, _PRESSURE_STUCK = 1 << F.ENCODER_STUCK, 1 << F.PRESSURE_STUCK
_PRESSURE_JUMP = 1 << F.PRESSURE_JUMP
_SEND_BLOCKED, _OVERLOADED = 1 << F.SEND_BLOCKED, 1 << F.OVERLOADED

Since = tuple[int, int, int, int, int, int, int]
"""When each lasting condition began [ns], −1 where it does not hold."""

# the conditions found here that have to last, in the order in which they are remembered
_IN_ORDER = (
    _SATURATED_LONG,
    _SUPPLY_FALLING,
    _FORCE_DISAGREES,
    _VALVE_DISAGREES,
    _ENCODER_STUCK,
    _SEND_BLOCKED,
    _OVERLOADED,
)
LASTING = sum(_IN_ORDER)
_NEVER: Since = (-1, -1, -1, -1, -1, -1, -1)
_VALVE_PLACE = _IN_ORDER.index(_VALVE_DISAGREES)


class Seen(NamedTuple):
    """What was seen last."""

    command_v: float  # the last command but one
    earlier_v: float  # and the one before
    position_m: float  # the last reading
    x3_n: float  # the pressures' force when the reading last changed
    velocity_m_s: float  # the estimate of then
    changed_ns: int  # when that reading was taken
    still: int  # readings since then, all the same to the last digit
    p1_pa: float
    p2_pa: float
    pressure_ns: int  # when they were read
    changed1_m: float  # where the load was when p1 last changed
    changed2_m: float
    supply_pa: float  # the slow one


class Watch(NamedTuple):
    """What has to be remembered from tick to tick."""

    since_ns: Since
    seen: Seen


INITIAL = Watch(
    _NEVER,
    Seen(
        command_v=0.0,
        earlier_v=0.0,
        position_m=NAN,
        x3_n=NAN,
        velocity_m_s=NAN,
        changed_ns=0,
        still=0,
        p1_pa=NAN,
        p2_pa=NAN,
        pressure_ns=0,
        changed1_m=NAN,
        changed2_m=NAN,
        supply_pa=NAN,
    ),
)


def is_disagreeing(w: Watch) -> bool:
    """Whether the valve node did not follow when last heard of."""
    return w.since_ns[_VALVE_PLACE] >= 0


def remember(w: Watch, seen: Seen, lasting: int, t_ns: int, p: Limits) -> tuple[Watch, int]:
    """The memory after a tick, and the conditions that have held for as long as they have to.

    Args:
        w: memory.
        seen: of this tick, as from `look`.
        lasting: likewise.
        t_ns: of this tick.
        p: how long they have to.
    """
    if not lasting:
        return Watch(_NEVER, seen), 0
    saturated_ns, falling_ns, force_ns, valve_ns, encoder_ns, sending_ns, overload_ns = w.since_ns
    since = (
        _since(saturated_ns, lasting & _SATURATED_LONG, t_ns),
        _since(falling_ns, lasting & _SUPPLY_FALLING, t_ns),
        _since(force_ns, lasting & _FORCE_DISAGREES, t_ns),
        _since(valve_ns, lasting & _VALVE_DISAGREES, t_ns),
        _since(encoder_ns, lasting & _ENCODER_STUCK, t_ns),
        _since(sending_ns, lasting & _SEND_BLOCKED, t_ns),
        _since(overload_ns, lasting & _OVERLOADED, t_ns),
    )
    return Watch(since, seen), _lasted(since, lasting, t_ns, p)


def _since(before_ns: int, holds: int, t_ns: int) -> int:
    """Since when a condition has held, −1 where it does not."""
    if not holds:
        return -1
    return before_ns if before_ns >= 0 else t_ns


def _lasted(since: Since, lasting: int, t_ns: int, p: Limits) -> int:
    """The conditions that have held for as long as the fault table says that they have to."""
    saturated_ns, falling_ns, force_ns, valve_ns, encoder_ns, sending_ns, overload_ns = since
    bits = 0
    for bit, began_ns, least_ns in (
        (_SATURATED_LONG, saturated_ns, p.saturation_ns),
        (_SUPPLY_FALLING, falling_ns, p.supply_ns),
        (_FORCE_DISAGREES, force_ns, p.disagreement_ns),
        (_VALVE_DISAGREES, valve_ns, p.valve_timeout_ns),
        (_ENCODER_STUCK, encoder_ns, p.sensor_timeout_ns),
        (_SEND_BLOCKED, sending_ns, p.valve_timeout_ns),
        (_OVERLOADED, overload_ns, p.overload_ns),
    ):
        if lasting & bit and t_ns - began_ns >= least_ns:
            bits |= bit
    return bits


def forget_position(w: Watch) -> Watch:
    """The memory where positions count from somewhere else: nothing has been read yet."""
    seen = w.seen._replace(position_m=NAN, changed1_m=NAN, changed2_m=NAN)
    return w._replace(seen=seen)


def look(
    w: Seen,
    m: Measurement,
    e: Estimate,
    state: int,
    engaged: bool,
    last_v: float,
    limited: int,
    disagreeing: bool,
    p: Limits,
) -> tuple[Seen, int, int]:
    """What this tick shows beside the last one.

    Args:
        w: what was seen last.
        m: the measurement.
        e: the estimate, NaN where there is none.
        state: of the last tick.
        engaged: that state is an engaged one.
        last_v: the last command that left [V].
        limited: 1 where the output chain let through less than the law asked for.
        disagreeing: the valve node did not follow when last heard of.
        p: what it is compared with.

    Returns:
        What has been seen now, bits of conditions that have to last, and bits of the fault table.
    """
    now = seen(w, m, e, engaged, last_v)
    bits, lasting = 0, overloaded(m) | send_blocked(m)
    if m.fresh & _PRESSURE:
        bits |= pressure_jump(w, m, p)
        lasting |= supply_falling(w, m, p)
        if engaged:
            bits |= pressure_stuck(w, m, p)
    if m.fresh & _ENCODER:
        bits |= encoder_stuck_in_motion(now, m, p)
    if engaged:
        lasting |= encoder_stuck_under_force(now, e, state, p) | force_disagrees(e, p)
        lasting |= saturated_long(limited) | valve_disagrees(w, m, last_v, disagreeing)
    return now, lasting, bits


def seen(w: Seen, m: Measurement, e: Estimate, engaged: bool, last_v: float) -> Seen:
    """What has been seen with this measurement; a value that is not read stays as it was.

    While the axis is not engaged, a reading and a pressure count as changed in every tick: standing still
    begins where the axis is engaged.
    """
    position_m, x3_n, velocity_m_s, changed_ns = w.position_m, w.x3_n, w.velocity_m_s, w.changed_ns
    still = w.still
    if m.fresh & _ENCODER:
        still += 1
        if m.position_m != position_m or not engaged:
            position_m, x3_n, velocity_m_s = m.position_m, e.x3_n, e.velocity_m_s
            # a confirmed reading says what the one before it said
            changed_ns, still = m.t_ns + m.encoder_offset_ns, 1 if m.encoder_defects & _CONFIRMED else 0
    p1_pa, p2_pa, pressure_ns, supply_pa = w.p1_pa, w.p2_pa, w.pressure_ns, w.supply_pa
    changed1_m, changed2_m = w.changed1_m, w.changed2_m
    if m.fresh & _PRESSURE:
        if m.p1_pa != p1_pa or not engaged:
            changed1_m = m.position_m
        if m.p2_pa != p2_pa or not engaged:
            changed2_m = m.position_m
        supply_pa = _followed(supply_pa, m.supply_pa, (m.t_ns - pressure_ns) * 1e-9)
        p1_pa, p2_pa, pressure_ns = m.p1_pa, m.p2_pa, m.t_ns
    return Seen(
        command_v=last_v,
        earlier_v=w.command_v,
        position_m=position_m,
        x3_n=x3_n,
        velocity_m_s=velocity_m_s,
        changed_ns=changed_ns,
        still=still,
        p1_pa=p1_pa,
        p2_pa=p2_pa,
        pressure_ns=pressure_ns,
        changed1_m=changed1_m,
        changed2_m=changed2_m,
        supply_pa=supply_pa,
    )


def _followed(slow_pa: float, supply_pa: float, elapsed_s: float) -> float:
    """The slow supply pressure; the first reading, and one that is not finite, are taken as they are."""
    above_pa = supply_pa - slow_pa
    if not math.isfinite(above_pa):
        return supply_pa
    return slow_pa + above_pa * min(1.0, elapsed_s / SUPPLY_S)


def pressure_stuck(w: Seen, m: Measurement, p: Limits) -> int:
    """A chamber pressure stands still to the last digit while the load goes far."""
    if (m.p1_pa == w.p1_pa and abs(m.position_m - w.changed1_m) > p.stuck_travel_m) or (
        m.p2_pa == w.p2_pa and abs(m.position_m - w.changed2_m) > p.stuck_travel_m
    ):
        return _PRESSURE_STUCK
    return 0


def pressure_jump(w: Seen, m: Measurement, p: Limits) -> int:
    """A chamber pressure has changed by more than valve and piston can change it."""
    elapsed_s = (m.t_ns - w.pressure_ns) * 1e-9
    # wherever it is read, the piston is in the cylinder
    room1_m = p.dead_length_1_m + max(0.0, min(m.position_m, p.stroke_m))
    room2_m = p.dead_length_2_m + max(0.0, min(p.stroke_m - m.position_m, p.stroke_m))
    if _is_jump(abs(m.p1_pa - w.p1_pa), room1_m, p.swing_1_pa_m_s * elapsed_s) or _is_jump(
        abs(m.p2_pa - w.p2_pa), room2_m, p.swing_2_pa_m_s * elapsed_s
    ):
        return _PRESSURE_JUMP
    return 0


def _is_jump(change_pa: float, room_m: float, swing_pa_m: float) -> bool:
    """Whether a chamber of this length changes by more than its pressure may swing, noise left out."""
    beyond_pa = change_pa - CHAMBER_PA
    return beyond_pa > 0.0 and beyond_pa * room_m > swing_pa_m


def supply_falling(w: Seen, m: Measurement, p: Limits) -> int:
    """The supply pressure, as it falls now, will soon be below its limit."""
    ahead_pa = m.supply_pa + (m.supply_pa - w.supply_pa) * (HORIZON_S / SUPPLY_S)
    return _SUPPLY_FALLING if ahead_pa < p.supply_min_pa else 0


def encoder_stuck_in_motion(now: Seen, m: Measurement, p: Limits) -> int:
    """The position stands still to the last digit though no force could have stopped the load on the way."""
    if now.still < STILL_READINGS:
        return 0
    elapsed_s = (m.t_ns + m.encoder_offset_ns - now.changed_ns) * 1e-9
    braked_m = 0.5 * p.acceleration_m_s2 * elapsed_s * elapsed_s
    return _ENCODER_STUCK if abs(now.velocity_m_s) * elapsed_s - braked_m > p.still_m else 0


def encoder_stuck_under_force(now: Seen, e: Estimate, state: int, p: Limits) -> int:
    """The position stands still to the last digit while the pressures' force changes, except while homing."""
    return _ENCODER_STUCK if state != _HOMING and abs(e.x3_n - now.x3_n) > p.stuck_force_n else 0


def force_disagrees(e: Estimate, p: Limits) -> int:
    """More force than friction and load explain lies between the pressures and the motion."""
    return _FORCE_DISAGREES if abs(e.force_n) > p.disagreement_n else 0


def saturated_long(limited: int) -> int:
    """The output chain let through less than the law asked for."""
    return _SATURATED_LONG if limited else 0


def valve_disagrees(w: Seen, m: Measurement, last_v: float, disagreeing: bool) -> int:
    """The valve node, enabled, puts out none of the last three commands, as far as it is heard."""
    if m.valve_state != _ENABLED:
        return 0
    if m.fresh & _VALVE:
        disagreeing = (
            abs(m.applied_v - last_v) > VALVE_V
            and abs(m.applied_v - w.command_v) > VALVE_V
            and abs(m.applied_v - w.earlier_v) > VALVE_V
        )
    return _VALVE_DISAGREES if disagreeing else 0


def overloaded(m: Measurement) -> int:
    """Ticks were skipped before this one."""
    return _OVERLOADED if m.skipped else 0


def send_blocked(m: Measurement) -> int:
    """Frames could not be sent though the interface is up."""
    return _SEND_BLOCKED if m.host & _SEND_FAILED and not m.host & _LINK_DOWN else 0
