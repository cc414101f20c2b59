"""The banner answers: how it is, why it cannot be armed, what to do next, and which key does it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pneud.safety.cause import first_cause
from pneud.safety.faults import BLOCKS_ARM, FAULT_NAMES, F
from pneud.signals import Hunting, Record, State
from pneud.view.banner import Banner, Level, banner_of
from pneud.view.disk import Disk
from pneud.view.history import History
from pneud.view.margins import margins_of
from pneud.view.screen import timing_verdict
from test_view import INFO, RECORD, T0, at

BANNER_INFO = INFO._replace(fault_names=FAULT_NAMES, blocks_arm=BLOCKS_ARM, first_cause=first_cause)


def bits(*faults: F) -> int:
    return sum(1 << fault for fault in faults)


def banner(state: State, present: int = 0, latched: int = 0, silent_s: float = 0.0, **more: Any) -> Banner:
    tick = RECORD.tick._replace(state=int(state), present=present, latched=latched, **more)
    return banner_of(RECORD._replace(tick=tick), BANNER_INFO, silent_s)


def test_without_any_node_one_sentence_says_what_is_wrong() -> None:
    alone = bits(
        *(F.ENCODER_MISSING, F.ENCODER_UNREFERENCED, F.PRESSURE_MISSING, F.CHAMBER_PRESSURE),
        *(F.SUPPLY_PRESSURE, F.VALVE_MISSING, F.TRAVEL),
    )
    found = banner(State.WAITING, alone)
    assert found.words == "waits: nothing on the bus answers SYNC"
    assert found.level == Level.LOOK


@pytest.mark.parametrize(
    ("state", "present", "words", "then", "key"),
    [
        (State.DISARMED, 0, "nothing is in the way", "a arms", "a"),
        (State.DISARMED, bits(F.CONFIG_CHANGED), "nothing is in the way", "a arms", "a"),
        (State.DISARMED, bits(F.ENCODER_UNREFERENCED), "cannot be armed", "r homes it", "r"),
        (State.DISARMED, bits(F.UNPROVEN), "cannot be armed", "pneud commission", "q"),
        (State.TRACKING, 0, "follows the reference", "space stops", "g"),
        (State.HOLDING, 0, "holds still", "t follows", "t"),
        (State.TRACKING, bits(F.DISK_FULL), "disk or its quota is full", "make room", "h"),
        (State.STOPPING, 0, "comes to rest", "space", " "),
    ],
)
def test_what_it_is_what_to_do_and_which_key(
    state: State, present: int, words: str, then: str, key: str
) -> None:
    found = banner(state, present)
    assert words in found.words
    assert then in found.then
    assert key in found.keys


def test_a_fault_says_whether_it_is_over_and_that_c_clears_it() -> None:
    there = banner(State.FAULT, bits(F.SUPPLY_PRESSURE), bits(F.SUPPLY_PRESSURE))
    assert there.level == Level.BAD
    assert "over" not in there.words
    assert there.then.endswith("then c clears")
    over = banner(State.FAULT, 0, bits(F.SUPPLY_PRESSURE))
    assert over.words.endswith("(over)")
    assert over.then.startswith("c clears it, then a arms")
    other = banner(State.FAULT, bits(F.ENCODER_UNREFERENCED), bits(F.SUPPLY_PRESSURE))
    assert "now the encoder has no reference" in other.words


def test_hunting_and_silence_come_before_what_is_well() -> None:
    assert banner(State.HOLDING, hunting=int(Hunting.FRICTION)).level == Level.LOOK
    silent = banner(State.TRACKING, silent_s=1.0)
    assert silent.level == Level.BAD
    assert silent.words.startswith("no ticks for 1.0 s")
    assert banner_of(None, BANNER_INFO, 0.0).words == "waiting for the first tick"


def test_every_state_has_a_stop_first_and_every_fault_a_cure() -> None:
    for state in State:
        found = banner(state)
        assert found.keys[0] == " "
        assert found.keys[-1] == "q"
        for fault in F:
            found = banner(state, bits(fault), bits(fault) if state == State.FAULT else 0)
            assert found.words
            assert found.level != Level.GOOD


def history_of(*records: Record) -> History:
    history = History()
    history.add(records)
    return history


def test_timing_is_a_verdict_first() -> None:
    on_time = history_of(*(at(i) for i in range(100)))
    assert timing_verdict(on_time, 1000.0, T0 + 10**8) == (Level.GOOD, "on time: no tick skipped in 10 s")
    late = RECORD._replace(timing=RECORD.timing._replace(lateness_ns=400_000))
    level, words = timing_verdict(history_of(*(at(i, late) for i in range(100))), 1000.0, T0 + 10**8)
    assert level == Level.LOOK
    assert "400" in words
    skips = history_of(at(0), *(at(5000 + i, skipped=1 if i == 50 else 0) for i in range(100)))
    assert timing_verdict(skips, 1000.0, T0 + 6 * 10**9)[0] == Level.LOOK
    assert timing_verdict(skips, 1000.0, T0 + 16 * 10**9)[0] == Level.GOOD, "it is long ago"
    many = history_of(at(0), *(at(5000 + i, skipped=1) for i in range(100)))
    assert timing_verdict(many, 1000.0, T0 + 6 * 10**9)[0] == Level.BAD


def test_what_the_last_seconds_were_like() -> None:
    limited = RECORD._replace(
        tick=RECORD.tick._replace(command=RECORD.tick.command._replace(saturated=1)), sent=RECORD.frames[:2]
    )
    history = history_of(*(at(i, limited if i % 4 == 0 else RECORD) for i in range(2000)))
    assert history.saturated_lately(T0 + 2 * 10**9) == pytest.approx(0.25, abs=0.01)
    assert history.saturated_lately(T0 + 20 * 10**9) != history.saturated_lately(T0)
    frames_s = 1000 * 3 + 250 * 2
    assert history.bus_bit_s == pytest.approx(1.1 * 111 * frames_s, rel=0.01)


def test_margins_are_what_is_left_of_what_is_allowed() -> None:
    info = BANNER_INFO._replace(
        speed_m_s=2.0, supply_min_pa=4.5e5, supply_max_pa=8e5, area_1_m2=1.2566e-3, area_2_m2=1.0566e-3,
        atmosphere_pa=1.01e5,
    )  # fmt: skip
    speed, supply, force = margins_of(RECORD, history_of(RECORD), info)
    assert (speed.left, supply.left) == ("1843 mm/s", "1.50 bar")
    assert speed.used == pytest.approx(0.1571 / 2)
    assert supply.used == pytest.approx(1 - 1.504 / 1.75)
    assert force.used == pytest.approx(100.0 / (600_400 * 1.2566e-3 - 1.01e5 * 1.0566e-3))
    unknown = margins_of(RECORD, history_of(RECORD), INFO)
    assert all(math.isnan(margin.used) for margin in unknown)


def test_how_long_the_disk_lasts(tmp_path: Any) -> None:
    disk = Disk(str(tmp_path / "run.mcap"))
    assert disk.in_words() == ("-", False)
    for second in range(20):
        disk.look(float(second), 1000 * second if second < 10 else 1000 * (second - 10))  # the next part
    assert disk.left_s > 0.0
    disk = Disk(str(tmp_path / "run.mcap"), quota_bytes=3.6e6)
    for second in range(20):
        disk.look(float(second), 1000 * second)
    assert disk.in_words() == ("keeps 1.0 h", False)
    gone = Disk("/nowhere/at/all/run.mcap")
    for second in range(20):
        gone.look(float(second), 1000 * second)
    assert gone.in_words() == ("-", False)
