"""The loop's side of the console: when an operator has engaged an axis, and when its console is silent."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from axis_rig import loaded
from pneud import crew
from pneud.axis.cycle import Axis
from pneud.bus.inbox import Inbox
from pneud.config import conversions
from pneud.console import handoff
from pneud.log.live.ring import CONSOLE_GONE, Ring
from pneud.loop.console_watch import SILENT_NS, ConsoleWatch
from pneud.loop.lane import Lane
from pneud.loop.options import Options
from pneud.loop.recorder_watch import RecorderWatch
from pneud.loop.turn import Turn
from pneud.signals import ENGAGED, Answer, Host, Request, RequestKind, State, Tick

NOW_NS = 90_000_000_000
COMMANDS = [
    *(RequestKind.ARM, RequestKind.HOLD, RequestKind.GOTO),
    *(RequestKind.JOG, RequestKind.TRACK, RequestKind.HOME, RequestKind.PROBE),
    RequestKind.RUN,
    RequestKind.FORCE,
]


def tick(state: State, kind: RequestKind | None = None, answer: int = Answer.TAKEN) -> Tick:
    request = Request(kind) if kind is not None else None
    rest: Any = dict.fromkeys(Tick._fields)
    return Tick(**rest | {"state": int(state), "request": request, "answer": int(answer)})


def commanded(beat_ns: int = NOW_NS) -> tuple[ConsoleWatch, Ring]:
    """A watch whose axis an operator has armed."""
    ring = Ring.create(slots=8)
    ring.set_console(beat_ns)
    watch = ConsoleWatch(ring)
    watch.after(tick(State.HOLDING, RequestKind.ARM), asked=True)
    return watch, ring


@pytest.mark.parametrize(
    ("age_ns", "lost"),
    [(-1, False), (0, False), (SILENT_NS - 1, False), (SILENT_NS, False), (SILENT_NS + 1, True)],
)
def test_silent_for_longer_than_the_bound_is_lost(age_ns: int, lost: bool) -> None:
    watch, ring = commanded()
    assert watch.host(NOW_NS + age_ns) == (Host.CONSOLE_LOST if lost else 0)
    ring.set_console(NOW_NS + age_ns)
    assert watch.host(NOW_NS + age_ns) == 0


def test_one_that_is_gone_is_lost_at_once_and_one_that_has_not_begun_is_not() -> None:
    watch, ring = commanded(0)
    assert watch.host(NOW_NS) == 0
    ring.set_console(NOW_NS)
    ring.set_console(CONSOLE_GONE)
    assert watch.host(NOW_NS) == Host.CONSOLE_LOST


def test_one_that_is_gone_is_lost_though_the_next_one_has_begun_before_it_was_looked_at() -> None:
    watch, ring = commanded()
    ring.set_console_gone()
    ring.set_console(NOW_NS + 1)
    assert watch.host(NOW_NS + 2) == Host.CONSOLE_LOST
    watch.after(tick(State.STOPPING), asked=False)
    assert watch.host(NOW_NS + 3) == Host.CONSOLE_LOST
    watch.after(tick(State.FAULT), asked=False)
    watch.after(tick(State.HOLDING, RequestKind.ARM), asked=True)
    assert watch.host(NOW_NS + 4) == 0, "this is the next one's"


def test_a_console_that_died_before_an_operator_steered_is_none_of_his() -> None:
    ring = Ring.create(slots=8)
    watch = ConsoleWatch(ring)
    watch.after(tick(State.TRACKING, RequestKind.ARM), asked=False)
    ring.set_console_gone()
    ring.set_console(NOW_NS)
    assert watch.host(NOW_NS + 1) == 0, "it has armed by itself"
    watch.after(tick(State.MOVING, RequestKind.GOTO), asked=True)
    assert watch.host(NOW_NS + 2) == 0
    ring.set_console_gone()
    ring.set_console(NOW_NS)
    assert watch.host(NOW_NS + 3) == Host.CONSOLE_LOST


@pytest.mark.parametrize("kind", COMMANDS)
def test_what_arms_or_steers_makes_the_axis_the_operators(kind: RequestKind) -> None:
    watch, ring = commanded(CONSOLE_GONE)
    watch = ConsoleWatch(ring)
    watch.after(tick(State.MOVING, kind, Answer.BLOCKED), asked=True)
    watch.after(tick(State.MOVING, kind), asked=False)
    assert watch.host(NOW_NS) == 0
    watch.after(tick(State.MOVING, kind), asked=True)
    watch.after(tick(State.MOVING), asked=False)
    assert watch.host(NOW_NS) == Host.CONSOLE_LOST


@pytest.mark.parametrize("kind", sorted(set(RequestKind) - set(COMMANDS)))
def test_what_asks_for_no_motion_does_not(kind: RequestKind) -> None:
    _, ring = commanded(CONSOLE_GONE)
    watch = ConsoleWatch(ring)
    watch.after(tick(State.TRACKING, kind), asked=True)
    assert watch.host(NOW_NS) == 0


@pytest.mark.parametrize("state", list(State))
def test_it_is_the_operators_until_it_is_disengaged(state: State) -> None:
    watch, _ = commanded(CONSOLE_GONE)
    watch.after(tick(state), asked=False)
    assert watch.host(NOW_NS) == (Host.CONSOLE_LOST if state in ENGAGED else 0)
    watch.after(tick(State.TRACKING), asked=False)
    assert watch.host(NOW_NS) == (Host.CONSOLE_LOST if state in ENGAGED else 0)


def lane(ring: Ring, console: handoff.LoopEnd | None) -> Lane:
    config, codecs = loaded().config, loaded().codecs
    axis = Axis(conversions.axis_of(config, codecs.command_lsb_v))
    options = Options(1000.0, 0.8, 0.0, True, None, end_on_fault=False, no_realtime=False)
    nobody: Any = SimpleNamespace(down=False, tx_failed=0, rx_dropped=0)
    turn = Turn(axis, Inbox(codecs, config.bus), codecs)
    return Lane(turn, nobody, RecorderWatch(ring, 0), options, console=console)


def test_a_lane_knows_an_operators_request_from_the_runs_own() -> None:
    asking, taking = crew.pair()
    ring = Ring.create(slots=8)
    ring.set_console(CONSOLE_GONE)
    one = lane(ring, handoff.LoopEnd(taking))

    def after(state: State, kind: RequestKind | None) -> int:
        one.turn.tick = tick(state, kind)
        one.over()
        one.turn.t_ns = time.monotonic_ns()
        one.prepare(0, ending=False)
        return one.early

    one.prepare(0, ending=False)
    one.request = Request(RequestKind.ARM, (1.0,))
    assert after(State.TRACKING, RequestKind.ARM) == 0, "it has armed by itself"
    handoff.send(asking, 1, Request(RequestKind.GOTO, (0.5,)))
    one.prepare(0, ending=False)
    assert one.request is not None
    assert after(State.MOVING, RequestKind.GOTO) == Host.CONSOLE_LOST
    one.prepare(0, ending=False)
    assert after(State.STOPPING, None) == Host.CONSOLE_LOST
    assert after(State.FAULT, None) == 0
    handoff.send(asking, 2, Request(RequestKind.ARM))
    one.prepare(0, ending=False)
    assert after(State.HOLDING, RequestKind.ARM) == Host.CONSOLE_LOST
    one.prepare(0, ending=True)
    assert after(State.STOPPING, RequestKind.SHUTDOWN) == 0, "the run ends"
    asking.close()


def test_an_axis_that_an_operator_has_engaged_does_not_arm_by_itself_any_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asking, taking = crew.pair()
    one = lane(Ring.create(slots=8), handoff.LoopEnd(taking))
    monkeypatch.setattr(Lane, "_can_arm", lambda _: True)
    one.prepare(0, ending=False)
    assert one.request == Request(RequestKind.ARM, (1.0,)), "it would"
    handoff.send(asking, 1, Request(RequestKind.ARM))
    one.prepare(0, ending=False, may_arm=False)  # the other axes are not ready yet
    assert one.request == Request(RequestKind.ARM)
    one.turn.tick = tick(State.HOLDING, RequestKind.ARM)
    one.over()
    one.turn.tick = tick(State.DISARMED, RequestKind.DISARM)
    one.over()
    one.request = None
    one.prepare(0, ending=False)
    assert not one.request
    asking.close()


def test_the_word_is_the_rings_own() -> None:
    ring = Ring.create(slots=8)
    before = ring.status(), ring.closed, ring.put_count, ring.notes()
    assert ring.console_ns == 0
    ring.set_console((1 << 63) + 5)
    assert ring.console_ns == (1 << 63) + 5
    assert (ring.status(), ring.closed, ring.put_count, ring.notes()) == before
