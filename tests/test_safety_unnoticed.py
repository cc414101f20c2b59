"""Which faults are left unnoticed for want of somebody who tells."""

from __future__ import annotations

from typing import Any

import pytest

from pneud.safety.faults import F
from pneud.safety.unnoticed import Devices, Teller, unnoticed
from pneud.signals import ValveState

ALL = Devices(
    sync=True,
    follows=False,
    encoder=Teller(("E",), (), ()),
    pressure=Teller(("P",), (), ()),
    valve=Teller(("V",), (), ()),
    status=True,
    second=False,
    age=True,
    homed=False,
    supply=True,
    applied=True,
    states=frozenset(map(int, ValveState)),
    nodes=True,
    heartbeats=True,
)


def found(**lacks: Any) -> dict[F, bool]:
    """The faults that cannot arise where a rig lacks something, and whether wholly."""
    return {one.fault: one.wholly for one in unnoticed(ALL._replace(**lacks))}


def test_who_tells_everything_leaves_nothing() -> None:
    assert found() == {}


@pytest.mark.parametrize(
    ("lacks", "faults"),
    [
        ({"valve": Teller((), (), ())}, {F(F.VALVE_MISSING + n): True for n in range(4)}),
        ({"pressure": Teller(("P", "Q"), (), ("Q",))}, {F.PRESSURE_CORRUPT: False}),
        ({"pressure": Teller(("P", "Q"), ("Q",), ())}, {F.PRESSURE_FROZEN: False, F.PRESSURE_LATE: False}),
        ({"pressure": Teller(("P",), ("P",), ())}, {F.PRESSURE_FROZEN: True, F.PRESSURE_LATE: False}),
        (
            {"sync": False},
            {F.ENCODER_LATE: False, F.PRESSURE_LATE: True, F.VALVE_LATE: True, F.OTHER_CONTROLLER: False,
             F.IDENTIFIER_CLASH: True},
        ),
        (
            {"status": False},
            {F.ENCODER_ERROR: True, F.ENCODER_LOST_REFERENCE: True, F.ENCODER_UNREFERENCED: True},
        ),
        (
            {"status": False, "second": True, "homed": True},
            {F.ENCODER_ERROR: False, F.ENCODER_LOST_REFERENCE: True},
        ),
        ({"uncounted_inputs": ("I",)}, {F.INPUT_LOST: False}),
        ({"brake_tells": False}, {F.BRAKE_STUCK: True}),
        ({"supply": False}, {F.SUPPLY_PRESSURE: True, F.SUPPLY_FALLING: True}),
        ({"applied": False}, {F.VALVE_DISAGREES: True, F.VALVE_ACTIVE: False}),
        ({"nodes": False}, {F.EMERGENCY: True}),
        ({"heartbeats": False}, {F.HEARTBEAT_LOST: True}),
        (
            {"states": frozenset({int(ValveState.ENABLED), int(ValveState.CENTRED)})},
            {F.VALVE_TIMED_OUT: True, F.VALVE_FAULT: False},
        ),
        (
            {"states": frozenset()},
            {F.VALVE_TIMED_OUT: True, F.VALVE_FAULT: True, F.VALVE_REBOOTED: True, F.VALVE_ACTIVE: False},
        ),
        (
            {"states": frozenset(), "applied": False},
            {F.VALVE_TIMED_OUT: True, F.VALVE_FAULT: True, F.VALVE_REBOOTED: True, F.VALVE_ACTIVE: False,
             F.VALVE_DISAGREES: True},
        ),
        ({"follows": True}, {F.OTHER_CONTROLLER: False}),
    ],
)  # fmt: skip
def test_each_lack_costs_its_faults(lacks: dict[str, Any], faults: dict[F, bool]) -> None:
    assert found(**lacks) == faults


def test_the_stricter_reason_stays_and_names_are_those_of_the_logs() -> None:
    late = unnoticed(ALL._replace(sync=False, age=False, encoder=Teller(("E",), ("E",), ())))
    assert [one.name for one in late][:2] == ["encoder_frozen", "encoder_late"]
    assert late[1].wholly
    assert "bus.sync" in late[1].why
