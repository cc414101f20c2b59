"""What the host has to say: the same conditions, for as long, in a running loop and in simulated time."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from axis_rig import loaded, quick
from pneud.bus.inbox import Inbox
from pneud.bus.wire import CAN_ERR_FLAG, ERR_BUS_OFF
from pneud.loading import load
from pneud.loop.conditions import FOREIGN_NS, Conditions
from pneud.replay.lockstep import Simulation
from pneud.signals import Frame, Host

MS = 1_000_000


@dataclass
class Way:
    """A way to the bus as a test has it."""

    down: bool = False
    tx_failed: int = 0
    rx_dropped: int = 0


def told(conditions: Conditions, t_ns: int, others: int = 0) -> int:
    """What the host has to say in a tick that nothing answers."""
    return conditions.host(conditions.early(t_ns, others))


def parts() -> tuple[Conditions, Inbox, Way]:
    inbox, way = Inbox(loaded().codecs, loaded().config.bus), Way()
    return Conditions(inbox, way), inbox, way


def foreign(t_ns: int) -> Frame:
    sync = loaded().codecs.sync
    return Frame(t_ns, sync.can_id, sync.encode(counter=1))


def test_nothing_is_said_where_nothing_happens() -> None:
    conditions, _, _ = parts()
    assert [told(conditions, t * MS) for t in range(5)] == [0] * 5


@given(st.integers(0, (1 << 15) - 1))
def test_what_comes_from_elsewhere_is_handed_on(others: int) -> None:
    conditions, _, _ = parts()
    assert told(conditions, MS, others) == others
    assert told(conditions, 2 * MS) == 0


@pytest.mark.parametrize(
    ("name", "bit"), [("tx_failed", Host.SEND_FAILED), ("rx_dropped", Host.RECEIVE_OVERFLOW)]
)
def test_losses_count_in_the_tick_that_sees_them(name: str, bit: Host) -> None:
    conditions, _, way = parts()
    setattr(way, name, 3)
    assert told(conditions, MS) == bit
    assert told(conditions, 2 * MS) == 0
    setattr(way, name, 4)
    assert told(conditions, 3 * MS) == bit


def test_losses_before_the_run_do_not_count() -> None:
    conditions = Conditions(parts()[1], Way(tx_failed=5, rx_dropped=7))
    assert told(conditions, MS) == 0


def test_a_link_that_is_down_takes_back_what_its_controller_said() -> None:
    conditions, inbox, way = parts()
    inbox.feed(Frame(MS, CAN_ERR_FLAG | ERR_BUS_OFF, bytes(8)))
    assert told(conditions, MS) == Host.BUS_OFF
    way.down = True
    assert told(conditions, 2 * MS) == Host.BUS_OFF | Host.LINK_DOWN
    assert told(conditions, 3 * MS) == Host.LINK_DOWN
    way.down = False
    assert told(conditions, 4 * MS) == 0


@given(st.lists(st.tuples(st.integers(1, FOREIGN_NS + MS), st.integers(0, 2)), min_size=1, max_size=40))
def test_another_controller_is_present_for_a_second_after_its_last_frame(
    ticks: list[tuple[int, int]],
) -> None:
    """Whatever the distance of the ticks is."""
    conditions, inbox, _ = parts()
    t_ns, last_ns = 0, None
    for passed_ns, frames in ticks:
        t_ns += passed_ns
        for _ in range(frames):
            inbox.feed(foreign(t_ns))
            last_ns = t_ns
        present = last_ns is not None and t_ns - last_ns < FOREIGN_NS
        assert told(conditions, t_ns) == (Host.OTHER_CONTROLLER if present else 0)


def test_another_controller_heard_with_the_answers_is_present_at_once() -> None:
    conditions, inbox, _ = parts()
    early = conditions.early(MS, 0)
    inbox.feed(foreign(MS))
    assert conditions.host(early) == Host.OTHER_CONTROLLER


@pytest.mark.parametrize("rate_hz", [1000.0, 250.0])
def test_one_foreign_sync_lasts_a_second_in_simulated_time(rate_hz: float) -> None:
    run = Simulation(
        load("virtual.toml", None, {"loop": {"rate_hz": rate_hz}}), 1.5, how=quick(), requests={}
    )
    present = []
    for number, record in enumerate(run.records()):
        if number == 20:
            run.node.put(foreign(record.tick.t_ns))
        present.append(bool(record.tick.measurement.host & Host.OTHER_CONTROLLER))
    first = present.index(True)
    assert first == 21
    assert sum(present) == rate_hz
    assert all(present[first : first + int(rate_hz)])
