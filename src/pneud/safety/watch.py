"""Checks that need a memory: what lasts, what stands still, what changes faster than it can.

Their whole memory is one record. A condition of a row with a debounce counts only after it has lasted.
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

from pneud.safety.checks import Limits
from pneud.safety.faults import TABLE, F
from pneud.signals import Estimate, Host, Measurement, Source, State, ValveState

SUPPLY_S = 0.05  # time constant of the slow supply pressure that the new one is compared with
HORIZON_S = 0.2  # a supply that leaves its limits within this time is falling
VALVE_V = 0.05  # the valve node may differ so much from a command
STILL_READINGS = 2  # the same so often: no moving load shows that
CHAMBER_PA = 20_000.0  # a chamber pressure may jump so far by noise

NAN = float("nan")
_ENCODER, _PRESSURE, _VALVE = int(Source.ENCODER), int(Source.PRESSURE), int(Source.VALVE)
_LINK_DOWN, _SEND_FAILED = int(Host.LINK_DOWN), int(Host.SEND_FAILED)
_ENABLED, _HOMING = int(ValveState.ENABLED), int(State.HOMING)
_SATURATED_LONG, _SUPPLY_FALLING = 1 << F.SATURATED_LONG, 1 << F.SUPPLY_FALLING
_FORCE_DISAGREES, _VALVE_DISAGREES = 1 << F.FORCE_DISAGREES, 1 << F.VALVE_DISAGREES
_ENCODER_STUCK, _PRESSURE_STUCK = 1 << F.ENCODER_STUCK, 1 << F.PRESSURE_STUCK
_PRESSURE_JUMP = 1 << F.PRESSURE_JUMP
_SEND_BLOCKED, _OVERLOADED = 1 << F.SEND_BLOCKED, 1 << F.OVERLOADED

Since = tuple[int, int, int, int, int, int, int]
"""When each lasting condition began [ns], −1 where it does not hold."""

# the conditions found here that have to last, and where in Limits stands for how long
LASTING = (
    _SATURATED_LONG
    | _SUPPLY_FALLING
    | _FORCE_DISAGREES
    | _VALVE_DISAGREES
    | _ENCODER_STUCK
    | _SEND_BLOCKED
    | _OVERLOADED
)
_TIMES = tuple((1 << row.bit, Limits._fields.index(row.debounce)) for row in TABLE if LASTING >> row.bit & 1)
_NEVER: Since = (-1, -1, -1, -1, -1, -1, -1)
_VALVE_PLACE = [bit for bit, _ in _TIMES].index(_VALVE_DISAGREES)


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


INITIAL = Watch(_NEVER, Seen(0.0, 0.0, NAN, NAN, NAN, 0, 0, NAN, NAN, 0, NAN, NAN, NAN))


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
    since, found = _lasted(w.since_ns, lasting, t_ns, p)
    return Watch(since, seen), found


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
    (
        command_v,
        earlier_v,
        position_m,
        x3_n,
        velocity_m_s,
        changed_ns,
        still,
        p1_pa,
        p2_pa,
        pressure_ns,
        at1_m,
        at2_m,
        slow_pa,
    ) = w
    (
        t_ns,
        fresh,
        x,
        p1,
        p2,
        supply_pa,
        applied_v,
        _,
        valve_state,
        _,
        _,
        _,
        _,
        _,
        _,
        offset_ns,
        skipped,
        host,
    ) = m
    lasting = bits = 0

    if fresh & _PRESSURE:
        if not engaged or p1 != p1_pa:
            at1_m = x
        elif abs(x - at1_m) > p.stuck_travel_m:
            bits |= _PRESSURE_STUCK
        if not engaged or p2 != p2_pa:
            at2_m = x
        elif abs(x - at2_m) > p.stuck_travel_m:
            bits |= _PRESSURE_STUCK
        elapsed_s = (t_ns - pressure_ns) * 1e-9
        change1_pa, change2_pa = abs(p1 - p1_pa) - CHAMBER_PA, abs(p2 - p2_pa) - CHAMBER_PA
        if change1_pa > 0.0:
            room_m = p.dead_length_1_m + max(0.0, min(x, p.stroke_m))
            if change1_pa * room_m > p.swing_1_pa_m_s * elapsed_s:
                bits |= _PRESSURE_JUMP
        if change2_pa > 0.0:
            room_m = p.dead_length_2_m + max(0.0, min(p.stroke_m - x, p.stroke_m))
            if change2_pa * room_m > p.swing_2_pa_m_s * elapsed_s:
                bits |= _PRESSURE_JUMP
        above = supply_pa - slow_pa
        if supply_pa + above * (HORIZON_S / SUPPLY_S) < p.supply_min_pa:
            lasting |= _SUPPLY_FALLING
        # the first reading, and one that is not finite, are taken as they are
        slow_pa = slow_pa + above * min(1.0, elapsed_s / SUPPLY_S) if math.isfinite(above) else supply_pa
        p1_pa, p2_pa, pressure_ns = p1, p2, t_ns

    if fresh & _ENCODER:
        sampled_ns = t_ns + offset_ns
        if x != position_m or not engaged:
            position_m, x3_n, velocity_m_s, changed_ns, still = x, e.x3_n, e.velocity_m_s, sampled_ns, 0
        else:
            still += 1
            elapsed_s = (sampled_ns - changed_ns) * 1e-9
            braked_m = 0.5 * p.acceleration_m_s2 * elapsed_s * elapsed_s
            if still >= STILL_READINGS and abs(velocity_m_s) * elapsed_s - braked_m > p.still_m:
                bits |= _ENCODER_STUCK
    if engaged:
        if state != _HOMING and abs(e.x3_n - x3_n) > p.stuck_force_n:
            lasting |= _ENCODER_STUCK
        if abs(e.force_n) > p.disagreement_n:
            lasting |= _FORCE_DISAGREES
        if limited:
            lasting |= _SATURATED_LONG
        if valve_state == _ENABLED:
            if fresh & _VALVE:
                if (
                    abs(applied_v - last_v) > VALVE_V
                    and abs(applied_v - command_v) > VALVE_V
                    and abs(applied_v - earlier_v) > VALVE_V
                ):
                    lasting |= _VALVE_DISAGREES
            elif disagreeing:
                lasting |= _VALVE_DISAGREES  # nothing has been heard to the contrary
    if skipped:
        lasting |= _OVERLOADED
    if host & _SEND_FAILED and not host & _LINK_DOWN:
        lasting |= _SEND_BLOCKED

    return (
        Seen(
            last_v,
            command_v,
            position_m,
            x3_n,
            velocity_m_s,
            changed_ns,
            still,
            p1_pa,
            p2_pa,
            pressure_ns,
            at1_m,
            at2_m,
            slow_pa,
        ),
        lasting,
        bits,
    )


def _lasted(since: Since, lasting: int, t_ns: int, p: Limits) -> tuple[Since, int]:
    """Since when each condition has held, and those that have done so for as long as they have to."""
    begun = []
    bits = 0
    for (bit, time), before_ns in zip(_TIMES, since, strict=True):
        began_ns = -1
        if lasting & bit:
            began_ns = before_ns if before_ns >= 0 else t_ns
            if t_ns - began_ns >= p[time]:
                bits |= bit
        begun.append(began_ns)
    return cast(Since, tuple(begun)), bits
