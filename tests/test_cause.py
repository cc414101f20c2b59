"""One cause first: what explains the other faults is told before them."""

from __future__ import annotations

import pytest

from pneud.console.status_reply import faults
from pneud.log.live.mileage import whole_life
from pneud.log.live.ring import Kept, Since
from pneud.safety.cause import _STORIES, first_cause
from pneud.safety.faults import FAULT_NAMES, TABLE, F
from pneud.signals import Mileage
from pneud.verbs.status import in_words

# as the axis has them with nothing on its bus
ALONE = (
    *("encoder_missing", "encoder_unreferenced", "pressure_missing", "chamber_pressure", "supply_pressure"),
    *("valve_missing", "travel"),
)


def test_where_no_node_answers_one_cause_explains_all_seven_faults() -> None:
    found = first_cause(ALONE)
    assert found is not None
    assert found.words == "nothing on the bus answers SYNC"
    assert set(found.faults) == set(ALONE)
    assert "power" in found.cure
    assert "home" not in found.cure


@pytest.mark.parametrize(
    ("others", "first"),
    [
        (("link_down", "send_failed"), "the CAN interface is down or gone"),
        (("bus_off",), "the CAN controller has left the bus (bus-off)"),
        (("send_blocked",), "nothing on the bus acknowledges a frame"),
        (("config_changed", "unproven"), "nothing on the bus answers SYNC"),
    ],
)
def test_what_takes_the_bus_away_comes_before_the_silence(others: tuple[str, ...], first: str) -> None:
    found = first_cause((*ALONE, *others))
    assert found is not None
    assert found.words == first


def test_one_node_that_is_silent_explains_what_it_would_have_said_and_no_more() -> None:
    found = first_cause({"pressure_missing", "supply_pressure", "unsettled", "no_realtime"})
    assert found is not None
    assert found.faults == ("pressure_missing", "supply_pressure", "unsettled")
    pair = first_cause({"pressure_missing", "encoder_missing", "travel"})
    assert pair is not None
    assert pair.words.startswith("neither encoder nor pressures")


def test_a_loop_that_stood_still_explains_what_came_of_it() -> None:
    found = first_cause({"valve_timed_out", "tracking_error", "deadline"})
    assert found is not None
    assert found.words == "no tick ran while the axis was engaged"
    assert set(found.faults) == {"valve_timed_out", "tracking_error", "deadline"}


def test_a_burst_hose_explains_the_chamber() -> None:
    found = first_cause({"chamber_pressure", "supply_pressure"})
    assert found is not None
    assert "supply" in found.words


def test_what_explains_nothing_is_told_by_the_table_the_strongest_first() -> None:
    for fault in TABLE:
        alone = first_cause({fault.name})
        assert alone is not None
        assert (alone.words, alone.cure, alone.faults) == (fault.when, fault.cure, (fault.name,))
    found = first_cause(["config_changed", "moving", "tracking_error"])
    assert found is not None
    assert found.faults == ("tracking_error",)


def test_none_and_unknown_ones_have_no_cause() -> None:
    assert first_cause(()) is None
    assert first_cause({"bit 70"}) is None


def test_every_name_is_one_of_the_table() -> None:
    assert {name for story in _STORIES for name in (*story.of, *story.explains)} <= set(FAULT_NAMES)


def test_status_tells_the_cause_before_the_faults_and_no_cures_that_mislead() -> None:
    found = first_cause(ALONE)
    assert found is not None
    told = {
        **dict.fromkeys(
            ("silent_s", "position_mm", "reference_mm", "error_mm", "pressures_bar", "command_v")
        ),
        **dict.fromkeys(
            (
                "hunting",
                "lateness_us",
                "sensor_to_command_us",
                "lease",
                "learnt",
                "program",
                "processes",
            )
        ),
        **dict.fromkeys(("ticks", "skipped", "rate_hz", "log_dropped", "log_written"), 0),
        **dict.fromkeys(("name", "bus", "state", "log", "config"), "x"),
        **{"in_position": False, "config_changed": False, "amiss": {}, "amiss_last_minute": {}},
        "mileage": whole_life(Mileage(), Since(Mileage(), 0.0, Kept.NO)),
        "faults": faults(sum(1 << F[name.upper()] for name in (*ALONE, "config_changed")), 0),
        "cause": {"words": found.words, "cure": found.cure, "faults": list(found.faults)},
    }
    _, cause, *lines = in_words(told)
    assert cause.startswith("nothing on the bus answers SYNC: check")
    named = [line for line in lines if line.startswith("fault ")]
    assert len(named) == 8
    assert not [line for line in named if ": " in line and "config_changed" not in line]
    (changed,) = [line for line in named if "config_changed" in line]
    assert "restart to use it" in changed
