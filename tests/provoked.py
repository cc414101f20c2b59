"""Every fault of the table that centres or stops an axis, and how a test provokes it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

import pneud.axis.sensing
from axis_rig import ENCODER, PRESSURE, VALVE, Rig
from pneud.control import step
from pneud.control.laws.situation import LawOutput
from pneud.safety.faults import F
from pneud.signals import EncoderStatus, Frame, Host, Measurement, ValveState

REFERENCED = int(EncoderStatus.REFERENCED)
Provoke = Callable[[Rig, pytest.MonkeyPatch], None]


class Case(NamedTuple):
    fault: F
    provoke: Provoke
    ticks: int = 1  # until the axis has to react
    company: tuple[F, ...] = ()  # faults that cannot but come along
    lasting: bool = True  # the fault is seen also by an axis that is not engaged
    skipped: int = 0


def value(**changes: Any) -> Provoke:
    def provoke(rig: Rig, _: pytest.MonkeyPatch) -> None:
        rig.measurement = lambda m: m._replace(**changes)

    return provoke


def moved(**shifts: float) -> Provoke:
    def provoke(rig: Rig, _: pytest.MonkeyPatch) -> None:
        def shift(m: Measurement) -> Measurement:
            return m._replace(**{name: getattr(m, name) + by for name, by in shifts.items()})

        rig.measurement = shift

    return provoke


def every_other(field: str, by: float) -> Provoke:
    """Every other reading is off."""

    def provoke(rig: Rig, _: pytest.MonkeyPatch) -> None:
        began = rig.count

        def shift(m: Measurement) -> Measurement:
            off = 0.0 if (rig.count - began) % 2 else by
            return m._replace(**{field: getattr(m, field) + off})

        rig.measurement = shift

    return provoke


def limit(**changes: Any) -> Provoke:
    def provoke(rig: Rig, patch: pytest.MonkeyPatch) -> None:
        p = rig.axis.parameters
        patch.setattr(rig.axis, "parameters", p._replace(limits=p.limits._replace(**changes)))

    return provoke


def host(flag: Host) -> Provoke:
    def provoke(rig: Rig, _: pytest.MonkeyPatch) -> None:
        rig.host = int(flag)

    return provoke


def frames(can_id: int, change: Callable[[Frame, Rig], Frame | None]) -> Provoke:
    def provoke(rig: Rig, _: pytest.MonkeyPatch) -> None:
        rig.frame = lambda frame: change(frame, rig) if frame.can_id == can_id else frame

    return provoke


def lost(_: Frame, __: Rig) -> None:
    return None


def corrupt(frame: Frame, _: Rig) -> Frame:
    return frame._replace(data=bytes([frame.data[0] ^ 1]) + frame.data[1:])


def late(frame: Frame, rig: Rig) -> Frame:
    return frame._replace(stamp_ns=rig.t_ns - 1)


def frozen(can_id: int) -> Provoke:
    kept: list[bytes] = []

    def repeat(frame: Frame, _: Rig) -> Frame:
        kept.append(frame.data)
        return frame._replace(data=kept[0])

    def provoke(rig: Rig, patch: pytest.MonkeyPatch) -> None:
        kept.clear()
        frames(can_id, repeat)(rig, patch)

    return provoke


def still(field: str, by: float) -> Provoke:
    """The value stands still, `by` away from where it was."""

    def provoke(rig: Rig, _: pytest.MonkeyPatch) -> None:
        kept: list[float] = []

        def keep(m: Measurement) -> Measurement:
            kept.append(getattr(m, field) + by)
            kept_value: dict[str, Any] = {field: kept[0]}
            return m._replace(**kept_value)

        rig.measurement = keep

    return provoke


def together(*all_of: Provoke) -> Provoke:
    def provoke(rig: Rig, patch: pytest.MonkeyPatch) -> None:
        for one in all_of:
            one(rig, patch)

    return provoke


def falling_supply(rig: Rig, _: pytest.MonkeyPatch) -> None:
    began_ns = rig.t_ns
    rig.measurement = lambda m: m._replace(supply_pa=m.supply_pa - 2e-3 * (m.t_ns - began_ns))


def overdriven(rig: Rig, patch: pytest.MonkeyPatch) -> None:
    def act(*args: Any) -> Any:
        state, answer = step.act(*args)
        return state, answer._replace(u_v=1e3)

    patch.setattr(pneud.axis.sensing, "act", act)


def broken(*_: object) -> None:
    raise ZeroDivisionError


def raises(rig: Rig, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(pneud.axis.sensing, "observe", broken)
    patch.setattr(pneud.axis.sensing, "resume", broken)


def too_much(rig: Rig, patch: pytest.MonkeyPatch) -> None:
    p = rig.axis.parameters
    patch.setattr(rig.axis, "parameters", p._replace(output=p.output._replace(u_max_v=6.0)))
    patch.setattr(pneud.axis.sensing, "act", lambda state, *_: (state, LawOutput(6.0, 0.0, 0.0)))


def law_without_number(rig: Rig, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(pneud.axis.sensing, "act", lambda state, *_: (state, LawOutput(math.nan, 0.0, 0.0)))


SENSORS = [
    case
    for first, can_id in (
        (F.ENCODER_MISSING, ENCODER),
        (F.PRESSURE_MISSING, PRESSURE),
        (F.VALVE_MISSING, VALVE),
    )
    for case in (
        # 50 ticks after the last good SYNC its answer, sampled a little later, is not yet 50 ms old
        Case(first, frames(can_id, lost), 51),
        Case(F(first + 1), frames(can_id, corrupt), 51),
        Case(F(first + 2), frozen(can_id), 52),  # its first frame is a good one
        Case(F(first + 3), frames(can_id, late), 51),
    )
]
CENTRING = [
    *SENSORS,
    Case(F.ENCODER_ERROR, value(encoder_status=REFERENCED | EncoderStatus.ERROR)),
    Case(F.CHAMBER_PRESSURE, value(p1_pa=1_000_020.0), 2, company=(F.PRESSURE_JUMP,)),
    Case(F.CHAMBER_PRESSURE, value(p2_pa=89_980.0), 2, company=(F.PRESSURE_JUMP,)),
    Case(F.CHAMBER_PRESSURE, value(p1_pa=0.0), 2, company=(F.PRESSURE_JUMP,)),
    Case(F.SUPPLY_PRESSURE, value(supply_pa=449_980.0), 2),
    Case(F.SUPPLY_PRESSURE, value(supply_pa=800_020.0), 2),
    Case(F.VALVE_TIMED_OUT, value(valve_state=ValveState.TIMED_OUT)),
    Case(F.VALVE_FAULT, value(valve_state=ValveState.FAULT)),
    Case(F.VALVE_FAULT, value(valve_state=77)),
    Case(F.VALVE_REBOOTED, value(valve_state=ValveState.BOOT), lasting=False),
    Case(F.VALVE_REBOOTED, value(valve_state=ValveState.CENTRED), lasting=False),
    Case(F.TRAVEL, limit(travel_min_m=0.6), lasting=False),
    Case(F.TRAVEL, limit(travel_max_m=0.4), company=(F.BRAKING_DISTANCE,), lasting=False),
    Case(F.OVERSPEED, limit(speed_m_s=1e-9)),
    Case(F.TRACKING_ERROR, limit(tracking_error_m=1e-12), lasting=False),
    Case(F.NOT_FINITE, value(applied_v=math.nan)),
    Case(F.NOT_FINITE, value(supply_pa=math.inf), company=(F.SUPPLY_PRESSURE,)),
    Case(F.NOT_FINITE, value(position_m=math.nan), company=(F.TRAVEL, F.TRACKING_ERROR)),
    Case(F.NOT_FINITE, law_without_number, lasting=False),
    Case(F.COMMAND_RANGE, too_much, lasting=False),
    Case(F.DEADLINE, value(), company=(F.VALVE_TIMED_OUT,), lasting=False, skipped=50),
    Case(F.LINK_DOWN, host(Host.LINK_DOWN)),
    Case(F.OTHER_CONTROLLER, host(Host.OTHER_CONTROLLER)),
    Case(F.INTERNAL, raises),
    Case(F.ENCODER_JUMP, moved(position_m=0.0025), 2),
    Case(F.ENCODER_JUMP, moved(position_m=-0.0025), 2),
    Case(F.ENCODER_LOST_REFERENCE, value(encoder_status=0), lasting=False),
    Case(F.FORCE_DISAGREES, limit(disagreement_n=-1.0), 21, lasting=False),
    Case(F.VALVE_DISAGREES, moved(applied_v=0.6), 51, lasting=False),
    Case(F.ENCODER_STUCK, together(limit(stuck_force_n=1e-9), still("position_m", 0.0)), 52, lasting=False),
    Case(F.PRESSURE_STUCK, together(limit(stuck_travel_m=-1.0), still("p1_pa", 20.0)), 2, lasting=False),
    Case(F.PRESSURE_STUCK, together(limit(stuck_travel_m=-1.0), still("p2_pa", 20.0)), 2, lasting=False),
    Case(F.PRESSURE_JUMP, moved(p1_pa=60_000.0), 2, lasting=False),
    Case(F.PRESSURE_JUMP, moved(p2_pa=-60_000.0), 2, lasting=False),
    Case(F.SEND_BLOCKED, host(Host.SEND_FAILED), 51),
    Case(F.BUS_OFF, host(Host.BUS_OFF)),
    Case(F.IDENTIFIER_CLASH, host(Host.IDENTIFIER_CLASH)),
]
STOPPING = [
    Case(F.SATURATED_LONG, together(limit(saturation_ns=5_000_000), overdriven), 7, lasting=False),
    Case(F.BRAKING_DISTANCE, limit(braking_m_s2=1e-9), lasting=False),
    Case(F.SUPPLY_FALLING, falling_supply, 27, lasting=False),
    Case(F.OVERLOADED, limit(overload_ns=0), skipped=1, lasting=False),
    Case(F.EMERGENCY, host(Host.EMERGENCY)),
    Case(F.HEARTBEAT_LOST, host(Host.HEARTBEAT_LOST)),
    Case(F.BUS_PASSIVE, host(Host.BUS_PASSIVE)),
    Case(F.CONSOLE_LOST, host(Host.CONSOLE_LOST)),
    Case(F.ENCODER_DOUBTFUL, every_other("position_m", 0.001), 30),
    Case(F.ENCODER_DOUBTFUL, every_other("position_m", -0.0001), 30),
    Case(F.PRESSURE_DOUBTFUL, every_other("p1_pa", 100_000.0), 30),
    Case(F.PRESSURE_DOUBTFUL, every_other("supply_pa", -300_000.0), 30),
]


def bits(*faults: F) -> int:
    return sum(1 << fault for fault in faults)


def ids(case: Case) -> str:
    return case.fault.name.lower()
