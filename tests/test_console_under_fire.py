"""Messages at the running daemon: of what comes by its socket, nothing reaches the loop that may not."""

from __future__ import annotations

import json
import os
import random
import socket
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fuzzing
from commands import Figures, eventually
from console_bench import COMMANDS, LOOKS, message
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.protocol import VERBS, Error
from pneud.log.format.records import LoggedTick
from pneud.rt.histogram import Histogram
from pneud.safety.faults import F
from pneud.signals import RequestKind, State
from running import Running, running

pytestmark = pytest.mark.realtime

CROWD = 100  # connections
AT_A_TIME = 150  # messages of one client; 200 are taken without delay
QUIET_S = 3.0


def connection(path: str) -> socket.socket:
    found = socket.socket(socket.AF_UNIX)
    found.connect(path)  # waits where many knock
    found.settimeout(20.0)
    return found


class Crowd:
    """Many connections that send whatever hinders, and never read."""

    def __init__(self, path: str, dice: random.Random) -> None:
        self._path, self._dice = path, dice
        self._ones = [self._one() for _ in range(CROWD)]
        self.sent = 0  # bytes
        self.ended = 0  # connections that the daemon ended

    def _one(self) -> socket.socket:
        one = connection(self._path)
        one.setblocking(False)
        return one

    def trouble(self) -> None:
        dice = self._dice
        for n in dice.sample(range(CROWD), 10):
            line = dice.choice(
                [
                    b"[" * dice.randrange(100_000),  # no end to it
                    b'{"v":1,"id":1,"verb":"st',  # half a line
                    json.dumps(message("status")).encode() + b"\n",
                    (json.dumps(message(dice.choice(LOOKS))).encode() + b"\n") * 400,
                    b"rubbish\n" * dice.randrange(5000),
                    b"\0",
                    b"",
                ]
            )
            try:
                self.sent += self._ones[n].send(line)
                if dice.random() < 0.9:
                    continue
            except BlockingIOError:
                continue
            except OSError:
                self.ended += 1
            self._ones[n].close()
            self._ones[n] = self._one()

    def leave(self) -> None:
        for one in self._ones:
            one.close()


def talk(run: Running, dice: random.Random, crowd: Crowd, count: int) -> Counter[str]:
    """So many messages that ask nothing of the loop, each with its reply: how many of each kind."""
    found: Counter[str] = Counter()
    while found.total() < count:
        lines: list[bytes] = []
        while len(lines) < AT_A_TIME:
            drawn = fuzzing.hostile(dice) if dice.random() < 0.9 else look(dice)
            lines += [one for one in drawn.split(b"\n") if one.strip() and not commands(one)]
        found.update(map(kind, exchange(run.socket, b"\n".join(lines) + b"\n", len(lines), dice)))
        crowd.trouble()
    return found


def look(dice: random.Random) -> bytes:
    return json.dumps(message(dice.choice(LOOKS))).encode()


def commands(line: bytes) -> bool:
    return fuzzing.well_formed(line) and json.loads(line)["verb"] not in LOOKS


def exchange(path: str, text: bytes, count: int, dice: random.Random) -> list[dict[str, Any]]:
    """Send it in pieces of any size, and read so many replies, or fewer where the daemon hangs up."""
    received = b""
    with connection(path) as one:
        while text:
            size = dice.choice((1, 7, 1000, 100_000))
            one.sendall(text[:size])
            text = text[size:]
        while received.count(b"\n") < count and (data := one.recv(1 << 16)):
            received += data
    replies = [json.loads(line) for line in received.splitlines()]
    assert len(replies) == count or replies[-1]["error"]["type"] == Error.DISPLACED
    return replies


def kind(reply: dict[str, Any]) -> str:
    """What became of a message; a refusal has to tell why, in one short line."""
    if reply["ok"]:
        return "told"
    error = reply["error"]
    assert error["message"].isprintable()
    assert 0 < len(error["message"]) < 500
    return str(Error(error["type"]))


def lateness_us(ticks: list[LoggedTick]) -> str:
    late = Histogram()
    for tick in ticks:
        late.add(tick.timing.lateness_ns)
    return "/".join(f"{1e-3 * ns:.0f}" for ns in late.percentiles((50.0, 99.0)))


@pytest.mark.parametrize(
    "count",
    [
        pytest.param(4_000, id="few", marks=pytest.mark.slow),
        pytest.param(100_000, id="all", marks=pytest.mark.soak),
    ],
)
def test_messages_at_a_running_daemon_ask_nothing_of_the_loop(
    tmp_path: Path, count: int, figures: Figures
) -> None:
    dice = random.Random(7)
    with running(tmp_path) as run:
        quiet_from = len(run.commands)
        time.sleep(QUIET_S)
        quiet_until = len(run.commands)
        crowd = Crowd(run.socket, dice)
        found = talk(run, dice, crowd, count // 2)
        assert run.status()[0] == "disarmed"
        with Client(run.socket) as operator:
            assert operator.ask("arm")["state"] == "holding"
        found += talk(run, dice, crowd, count // 2)
        assert run.status() == ("holding", [])
        crowd.leave()
        under_fire_until = len(run.commands)
        run.end()
    ticks = list(run.ticks())
    assert run.asked(ticks, RequestKind.ARM, RequestKind.SHUTDOWN)
    assert len({tick.reference.position_m for tick in ticks if tick.state == State.HOLDING}) == 1
    assert {tick.state for tick in ticks} <= {*range(State.DISARMED + 1), State.HOLDING, State.STOPPING}
    kinds = ", ".join(f"{name} {times}" for name, times in found.most_common())
    figures(
        f"{found.total()} messages, each with its reply: {kinds};"
        f" {CROWD} connections that sent {1e-6 * crowd.sent:.0f} MB unread, ended {crowd.ended} times;"
        f" the loop was asked to arm by the operator and nothing else; {run.logged};"
        f" late by p50/p99 {lateness_us(ticks[quiet_from:quiet_until])} µs in quiet,"
        f" {lateness_us(ticks[quiet_until:under_fire_until])} µs meanwhile"
    )


@pytest.mark.slow
@pytest.mark.soak
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
@pytest.mark.parametrize("open_to_all", [False, True])
def test_another_user_moves_nothing(tmp_path: Path, open_to_all: bool, figures: Figures) -> None:
    refused, told = os.pipe()
    with running(tmp_path) as run, Client(run.socket) as operator:
        if open_to_all:
            Path(run.socket).chmod(0o666)
        operator.ask("arm")
        child = os.fork()
        if not child:
            os.setgroups([])
            os.setresgid(65534, 65534, 65534)
            os.setresuid(65534, 65534, 65534)
            os.write(told, json.dumps(dict(tries(run.socket))).encode())
            os._exit(0)
        eventually(lambda: os.waitpid(child, os.WNOHANG)[0] != 0)
        found = json.loads(os.read(refused, 4096))
        run.end()
    each = 10
    looks = dict.fromkeys(LOOKS, "told") if open_to_all else {}
    assert found == {
        verb: {looks.get(verb, "read_only" if open_to_all else "permission denied"): each} for verb in VERBS
    }
    assert run.asked(list(run.ticks()), RequestKind.ARM, RequestKind.SHUTDOWN)
    (answer,) = found["goto"]
    figures(
        f"{len(VERBS)} verbs, {each} times each: {answer}"
        + (f", but for {', '.join(looks)}" if looks else "")
    )


def tries(path: str, each: int = 10) -> Iterator[tuple[str, Counter[str]]]:
    """What somebody hears who tries each verb."""
    for verb in VERBS:
        heard: Counter[str] = Counter()
        for _ in range(each):
            try:
                with Client(path) as client:
                    client.ask(verb, **COMMANDS.get(verb, {}))
                heard["told"] += 1
            except RefusedError as e:
                heard[e.kind] += 1
            except PlaceError as e:
                heard["permission denied" if "permission denied; join the group" in str(e) else str(e)] += 1
        yield verb, heard


@pytest.mark.slow
@pytest.mark.soak
def test_a_lease_that_runs_out_ends_the_jog_and_lets_another_command(
    tmp_path: Path, figures: Figures
) -> None:
    lease_ticks = 200
    with running(tmp_path) as run, Client(run.socket) as one, Client(run.socket) as other:
        one.ask("arm")
        one.ask("jog", velocity_mm_s=20.0, lease_s=1e-3 * lease_ticks)
        with pytest.raises(RefusedError) as refused:
            other.ask("goto", x_mm=430.0)
        assert refused.value.kind == "busy"
        eventually(lambda: run.status()[0] == "holding")

        def may_command() -> bool:
            try:
                return bool(other.ask("goto", x_mm=430.0)["state"] == "moving")
            except RefusedError as e:
                assert e.kind == "busy"
                return False

        eventually(may_command)
        with pytest.raises(RefusedError) as refused:
            one.ask("jog", velocity_mm_s=20.0)
        assert refused.value.kind == "busy"
        eventually(lambda: run.status()[0] == "holding")
        run.end()
    ticks = list(run.ticks())
    (jog,) = (n for n, t in enumerate(ticks) if t.request is not None and t.request.kind == RequestKind.JOG)
    (lost,) = (n for n, t in enumerate(ticks) if t.present >> F.OPERATOR_LOST & 1)
    went_on = sum(1 + tick.skipped for tick in ticks[jog + 1 : lost + 1])
    assert lease_ticks <= went_on <= lease_ticks + 1 + ticks[lost].skipped
    figures(f"a jog leased for {lease_ticks} ticks ended after {went_on}; then the other client commanded")
