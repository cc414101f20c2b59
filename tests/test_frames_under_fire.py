"""Frames at the running daemon: whatever comes by its bus, nothing moves that should not."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import pytest

import fuzzing
from axis_rig import loaded
from commands import Figures, eventually, pneud
from fuzzing import Bare
from pneud.bus.wire import CAN_ERR_FLAG, ERR_RESTARTED
from pneud.console.client import Client, RefusedError
from pneud.safety.supervisor import is_engaged
from running import Running, running

PER_MS = 10  # frames that are sent at once, every millisecond
AT_ONCE = 5000  # frames between two times that the axis is armed: of a stranger, and hostile
ASK_S = 0.25  # how often the daemon has to answer meanwhile
# the controller is well again, and no node has an emergency any more
ALL_WELL: list[Bare] = [
    (CAN_ERR_FLAG | ERR_RESTARTED, bytes(8)),
    *((0x080 + node, bytes(8)) for node in range(1, 128)),
]
Status = tuple[str, list[str]]

frames_sent = pytest.mark.parametrize(
    "count",
    [
        pytest.param(20_000, id="few", marks=pytest.mark.slow),
        pytest.param(500_000, id="all", marks=pytest.mark.soak),
    ],
)


def fire(run: Running, frames: Iterable[Bare]) -> list[Status]:
    """Send frames, and ask for the status meanwhile and then."""
    source, found, asked_s = iter(frames), list[Status](), time.monotonic()
    while batch := list(islice(source, PER_MS)):
        began_s = time.monotonic()
        for can_id, data in batch:
            run.send(can_id, data)
        if began_s > asked_s + ASK_S:
            asked_s = began_s
            found.append(run.status())
        time.sleep(max(0.0, began_s + 1e-3 - time.monotonic()))
    return [*found, run.status()]


def not_moving(frames: Iterator[Bare]) -> Iterator[Bare]:
    """Without those at which the valve node opens: another controller would move the load with them."""
    command = loaded().codecs.valve_command
    for can_id, data in frames:
        if can_id != command.can_id or not command.valid(data) or command.decode(data)[1] != 1:
            yield can_id, data


@frames_sent
def test_frames_at_a_disarmed_daemon_move_nothing(tmp_path: Path, count: int, figures: Figures) -> None:
    with running(tmp_path) as run:
        began_s = time.monotonic()
        found = fire(run, islice(fuzzing.frames(loaded().codecs, 3), count))
        took_s = time.monotonic() - began_s
        run.end()
    assert not any(is_engaged(tick.state) for tick in run.ticks())
    assert all(data[:3] == bytes(3) for data in run.commands)
    assert {state for state, _ in found} <= {"disarmed", "waiting", "fault"}
    figures(
        f"{run.sent} frames in {took_s:.0f} s, {run.link.peers_dropped} not read; {run.syncs} ticks, in each"
        f" SYNC and 0 V, Enable 0 on the bus; status asked and told {len(found)} times; {run.logged}"
    )


@frames_sent
def test_frames_at_an_armed_daemon_make_it_centre_and_a_strangers_do_not(
    tmp_path: Path, count: int, figures: Figures
) -> None:
    foreign = fuzzing.strangers(loaded().codecs, 4)
    hostile = not_moving(fuzzing.frames(loaded().codecs, 5))
    sent = times = answers = 0
    with running(tmp_path) as run:
        with Client(run.socket) as operator:

            def tracks() -> bool:
                """Again and again: say that all is well, clear, arm."""
                for can_id, data in ALL_WELL:
                    run.send(can_id, data)
                state = operator.ask("status")["state"]
                try:
                    if state == "fault":
                        operator.ask("clear")
                    elif state == "disarmed":
                        operator.ask("arm")
                        operator.ask("track", what="reference")
                except RefusedError:
                    pass  # what there was lasts for a second more
                return bool(state == "tracking")

            while sent < count:
                eventually(tracks)
                found = fire(run, islice(foreign, AT_ONCE))
                assert all(status == ("tracking", []) for status in found), found
                after = fire(run, islice(hostile, AT_ONCE))
                assert after[-1][0] == "fault"
                sent += 2 * AT_ONCE
                times += 1
                answers += len(found) + len(after)
        run.end()
    engaged = sum(is_engaged(tick.state) for tick in run.ticks())
    assert engaged > times
    replayed = json.loads(pneud("replay", run.log, "--json", timeout=600.0).stdout)
    assert replayed["identical"] is True
    figures(
        f"{sent} frames, {run.link.peers_dropped} not read; {times} times armed, as often centred;"
        f" {engaged} of {run.syncs} ticks engaged, in all others 0 V, Enable 0 on the bus;"
        f" status asked and told {answers} times; {run.logged}, replay identical in {replayed['ticks']}"
    )
