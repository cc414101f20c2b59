"""What a run comes to: counted until it is told to end, faults to the very end."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from axis_rig import loaded
from pneud.bus.inbox import Counts
from pneud.log.files.columns import blocks
from pneud.log.files.naming import new_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.loop.summary import percentiles_us, summarise
from pneud.loop.tally import Tally
from pneud.notebook.summary import summary_of
from pneud.replay.ending import Ending
from pneud.replay.lockstep import Simulation, header_of
from pneud.report.gather import gather
from pneud.report.timing import in_words
from pneud.signals import Answer, Record, Request, RequestKind, State, Timing

NONE = Request(RequestKind.STOP)
BITS = st.integers(0, (1 << 40) - 1)
TICKS = st.lists(
    st.tuples(st.sampled_from(State), BITS, BITS, st.integers(0, 50), st.integers(-1, 10**7)), max_size=30
)


@pytest.fixture(scope="module")
def record() -> Record:
    """One that follows the reference."""
    return list(islice(Simulation(loaded(), 0.3).records(), 300))[-1]


def altered(record: Record, state: int, present: int, latched: int, skipped: int, latency_ns: int) -> Record:
    m = record.tick.measurement._replace(skipped=skipped)
    tick = record.tick._replace(state=int(state), present=present, latched=latched, measurement=m)
    return record._replace(tick=tick, timing=Timing(5000, 0, 0, 0, latency_ns, -1))


@given(TICKS, st.integers(0, 30))
def test_all_is_counted_until_the_end_and_faults_beyond(
    record: Record, ticks: list[tuple[int, int, int, int, int]], end: int
) -> None:
    tally, present, latched = Tally(truth=True, timed=True), 0, 0
    for number, one in enumerate(ticks):
        tally.add(altered(record, *one), ending=number >= end)
        present, latched = present | one[1], latched | one[2]
    counted = ticks[:end]
    assert (tally.ever_present, tally.ever_latched) == (present, latched)
    # a stall that went on to the tick in which it ends is the run's
    stalled = sum(one[3] for one in ticks[end : end + 1])
    assert (tally.ticks, tally.skipped) == (len(counted), sum(one[3] for one in counted) + stalled)
    assert (tally.state, tally.present) == (counted[-1][:2] if counted else (State.STARTING, 0))
    assert tally.lateness.count == len(counted) + (stalled > 0)
    assert tally.latency.count == sum(one[4] >= 0 for one in counted)


@pytest.mark.parametrize("told", [RequestKind.SHUTDOWN, RequestKind.RESTART])
def test_a_run_and_its_log_are_counted_alike_whatever_has_ended_it(tmp_path: Path, told: RequestKind) -> None:
    tally, ended, behind = Tally(truth=True, timed=True), False, 0
    with new_log(tmp_path / "x.mcap") as descriptor:
        writer = LogWriter(descriptor, header_of(loaded())._replace(bus="unixcan:x"))
        for number, one in enumerate(Simulation(loaded(), 0.3).records()):
            last = (one.tick.request or NONE).kind == RequestKind.SHUTDOWN
            ended = ended or (last and told == RequestKind.SHUTDOWN)
            behind += ended
            stalled = {250: 3}.get(number, 7 if ended else 0)
            timed = altered(one, one.tick.state, one.tick.present, one.tick.latched, stalled, -1)
            if last:
                tick = timed.tick._replace(request=Request(told), answer=int(Answer.TAKEN))
                timed = timed._replace(tick=tick)
            elif number == 200:  # while it is engaged
                refused = timed.tick._replace(
                    request=Request(RequestKind.RESTART), answer=int(Answer.WRONG_STATE)
                )
                timed = timed._replace(tick=refused)
            tally.add(timed, ending=ended)
            ended = ended or last  # by the tick in which it was taken
            writer.write(timed)
        writer.close()
    log = read_log(tmp_path / "x.mcap")
    assert behind > 1
    assert tally.skipped == 3 + 7
    found = summary_of(log)
    assert (found["ticks"], found["skipped"]) == (tally.ticks, tally.skipped)
    assert found["lateness_us"] == percentiles_us(tally.lateness)
    told_of = gather(log).counted
    assert (told_of.ticks, told_of.skipped, told_of.state) == (tally.ticks, tally.skipped, tally.state)
    assert "; 10 ticks skipped" in in_words(log)[0]
    (block,) = blocks(log)
    for cut in (tally.ticks - 1, tally.ticks, tally.ticks + 1):  # wherever a block ends
        ending = Ending()
        parts = (block.part(0, cut), block.part(cut, len(block.number)))
        (first, here), (second, there) = map(ending.look, parts)
        assert first + second == tally.ticks
        found_at = [at for at in (here, None if there is None else cut + there) if at is not None]
        assert found_at == [tally.ticks]


def test_simulated_time_is_never_late(record: Record) -> None:
    tally = Tally(truth=True, timed=False)
    tally.add(altered(record, State.TRACKING, 0, 0, 3, 1000), ending=False)
    assert (tally.ticks, tally.skipped, tally.lateness.count, tally.latency.count) == (1, 0, 0, 0)
    s = summarise(
        tally,
        bus="simulated",
        rate_hz=1000.0,
        counts=Counts(0, 0, 0, 0, 0, 0, 0, ()),
        tx=0,
        rx_dropped=0,
        log=None,
        log_dropped=0,
    )
    assert (s["state"], s["lateness_us"], s["sensor_to_command_us"]) == ("tracking", None, None)
