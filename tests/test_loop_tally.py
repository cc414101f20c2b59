"""What a run comes to: counted until it is told to end, faults to the very end."""

from __future__ import annotations

from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from axis_rig import loaded
from pneud.bus.inbox import Counts
from pneud.loop.summary import summarise
from pneud.loop.tally import Tally
from pneud.replay.lockstep import Simulation
from pneud.signals import Record, State, Timing

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
    assert (tally.ticks, tally.skipped) == (len(counted), sum(one[3] for one in counted))
    assert (tally.state, tally.present) == (counted[-1][:2] if counted else (State.STARTING, 0))
    assert tally.lateness.count == len(counted)
    assert tally.latency.count == sum(one[4] >= 0 for one in counted)


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
