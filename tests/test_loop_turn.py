"""The exchange: what is fed, decided, sent and recorded in one tick of one axis."""

from __future__ import annotations

import math
from itertools import islice

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from axis_rig import loaded
from pneud.axis.cycle import Axis
from pneud.bus.inbox import Inbox
from pneud.config import conversions
from pneud.loop.turn import Turn
from pneud.replay.lockstep import Simulation
from pneud.signals import Frame, Record, Request, Timing

UNTIMED = Timing(-1, -1, -1, -1, -1, -1)
COMMAND = loaded().codecs.valve_command


@pytest.fixture(scope="module")
def records() -> list[Record]:
    """Ticks of a run that arms and tracks."""
    return list(islice(Simulation(loaded(), 0.4).records(), 400))


def fresh() -> Turn:
    config, codecs = loaded().config, loaded().codecs
    axis = Axis(conversions.axis_of(config, codecs.command_lsb_v))
    return Turn(axis, Inbox(codecs, config.bus), codecs)


def take(turn: Turn, record: Record, at_once: int = 3) -> Record:
    """The same tick again; so many of the answers come at once."""
    tick = record.tick
    turn.open(record.frames[: record.before])
    turn.begin(tick.t_ns)
    answers = record.frames[record.before :]
    for n in range(0, len(answers), at_once):
        turn.feed(answers[n : n + at_once])
    turn.decide(tick.measurement.skipped, tick.measurement.host, tick.request)
    counter = COMMAND.counter(record.sent[1].data)
    turn.command(loaded().codecs.sync.counter(record.sent[0].data), counter)
    turn.sent(record.sent[1].stamp_ns)
    return turn.record(record.timing, record.sent[0], record.truth_m)


@pytest.mark.parametrize("at_once", [1, 2, 3])
def test_the_same_frames_make_the_same_records_however_they_come(records: list[Record], at_once: int) -> None:
    turn = fresh()
    assert [repr(take(turn, record, at_once)) for record in records] == [repr(record) for record in records]


@pytest.mark.slow
@settings(deadline=None)
@given(st.integers(1, 399))
def test_a_frozen_exchange_goes_on_the_same(records: list[Record], at: int) -> None:
    first, second = fresh(), fresh()
    for record in records[:at]:
        take(first, record)
    second.thaw(**first.freeze())
    for record in records[at : at + 5]:
        assert repr(take(second, record)) == repr(take(first, record))
    assert repr(second.freeze()) == repr(first.freeze())


def test_frames_of_one_tick_are_gone_in_the_next(records: list[Record]) -> None:
    turn = fresh()
    take(turn, records[100])
    assert (len(turn.frames), turn.newest_ns) == (3, records[100].frames[-1].stamp_ns)
    turn.open(())
    assert (turn.frames, turn.before, turn.newest_ns) == ([], 0, 0)


def test_what_was_left_over_is_not_the_newest_answer(records: list[Record]) -> None:
    turn = fresh()
    turn.open(records[0].frames)
    turn.begin(records[1].tick.t_ns)
    assert (turn.before, turn.newest_ns) == (len(records[0].frames), 0)
    assert not turn.inbox.complete  # sampled before SYNC
    turn.feed(records[1].frames[records[1].before :])
    assert turn.newest_ns == records[1].frames[-1].stamp_ns
    assert turn.inbox.complete


def test_a_command_that_could_not_be_sent_is_recorded_as_such(records: list[Record]) -> None:
    turn = fresh()
    take(turn, records[0])
    turn.sent(-1)
    sync = Frame(-1, 0x80, b"\1")
    assert turn.record(UNTIMED, sync, math.nan).sent == (sync, Frame(-1, COMMAND.can_id, turn.data))
    assert turn.inbox.commanded_ns == -1


@given(st.integers(0, 1 << 40), st.integers(1, 240))
def test_counters_are_cut_to_what_the_command_carries(counter: int, sequence: int) -> None:
    turn = fresh()
    turn.begin(1_000_000)
    turn.decide(0, 0, Request(1))
    for data in (turn.command(sequence, counter), turn.centre(counter)):
        assert COMMAND.valid(data)
        assert COMMAND.counter(data) == counter & 255
        assert COMMAND.decode(data)[:2] == (0.0, 0)
    assert COMMAND.decode(turn.data)[2] == sequence
