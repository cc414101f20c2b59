"""The fault table and the document that shows it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from generators.safety import text
from pneud.config.models import Config
from pneud.safety.checks import Limits
from pneud.safety.fault_row import Reaction
from pneud.safety.faults import (
    BLOCKS_ARM,
    CENTRES,
    FAULT_NAMES,
    NO_SENSORS,
    STOPS,
    TABLE,
    F,
    mask,
    names,
)
from pneud.signals import State

DOCUMENT = Path(__file__).parent.parent / "docs" / "safety.md"


def test_every_bit_has_one_row() -> None:
    assert sorted(fault.bit for fault in TABLE) == list(range(len(F)))
    assert len(TABLE) <= 126  # bits of `present` and `latched` in the log


def test_bits_that_logs_hold_keep_their_meaning() -> None:
    was = """
        encoder_missing encoder_corrupt encoder_frozen encoder_late encoder_error encoder_unreferenced
        pressure_missing pressure_corrupt pressure_frozen pressure_late chamber_pressure supply_pressure
        valve_missing valve_corrupt valve_frozen valve_late valve_timed_out valve_fault valve_rebooted
        travel overspeed tracking_error not_finite command_range deadline link_down no_realtime
        recorder_lost internal moving clock_step send_failed encoder_jump encoder_lost_reference unsettled
        unreachable valve_active other_controller saturated saturated_long braking_distance supply_falling
        force_disagrees valve_disagrees encoder_stuck pressure_stuck pressure_jump send_blocked overloaded
        emergency heartbeat_lost bus_passive bus_off identifier_clash disk_full config_changed
        receive_overflow operator_lost homing_failed console_lost
    """
    names_then = was.split()
    assert list(FAULT_NAMES[: len(names_then)]) == names_then


def test_masks_hold_what_their_reactions_say() -> None:
    assert mask(Reaction.CENTRE) == CENTRES
    assert mask(Reaction.STOP) == STOPS
    shown = mask(Reaction.WARN, Reaction.LIMIT)
    assert (1 << len(F)) - 1 == BLOCKS_ARM | shown
    assert BLOCKS_ARM & shown == 0
    assert len(names(NO_SENSORS)) == 12
    assert NO_SENSORS & ~CENTRES == 0


@pytest.mark.parametrize("fault", TABLE, ids=lambda fault: fault.name)
def test_a_row_can_stand_in_the_table_of_a_document(fault: Any) -> None:
    assert fault.when
    assert fault.cure
    assert not fault.debounce or fault.debounce in Limits._fields
    for words in (fault.when, fault.cure, fault.clears):
        assert "|" not in words
        assert "\n" not in words
        assert not words.endswith(".")


def test_names_come_in_the_order_of_the_table() -> None:
    assert names(0) == []
    assert names(1 << F.TRAVEL | 1 << F.ENCODER_LATE) == ["encoder_late", "travel"]
    assert names((1 << len(F)) - 1) == [fault.name for fault in TABLE]
    assert names(1 << len(F)) == []


def test_the_document_is_current() -> None:
    assert DOCUMENT.read_text(encoding="utf-8") == text(), "make docs/safety.md anew; how stands in its head"


def test_the_document_names_every_fault_and_state() -> None:
    words = text()
    assert all(f"| `{fault.name}` |" in words for fault in TABLE)
    assert all(f"| `{state.label}` |" in words for state in State)


def test_every_key_that_the_document_names_is_in_the_configuration() -> None:
    keys = set(re.findall(r"\b(?:limits|bus|valve)\.[a-z_0-9]+", text()))
    assert len(keys) > 8
    for key in keys:
        section, name = key.split(".")
        model = Config.model_fields[section].annotation
        assert isinstance(model, type)
        assert issubclass(model, BaseModel)
        # limits.travel stands for its two ends
        assert any(field == name or field.startswith(f"{name}_m") for field in model.model_fields), key
