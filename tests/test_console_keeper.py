"""The console's keeper: another console when one has died or stands still, and what that one takes over."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from axis_rig import loaded
from commands import children, eventually
from log_samples import noisy
from pneud import crew
from pneud.console import handoff
from pneud.console import keeper as keeping
from pneud.console.client import Client
from pneud.console.facts import RunFacts
from pneud.console.keeper import fork_console
from pneud.console.memory import Memory
from pneud.console.status_reply import StatusWatch
from pneud.log.live import notes
from pneud.log.live.ring import CONSOLE_GONE, Ring
from pneud.signals import Answer, Request, RequestKind, State, Tick


class Kept(NamedTuple):
    keeper: int
    ring: Ring
    loop: handoff.LoopEnd
    words: notes.NotesListener
    path: str

    @property
    def console(self) -> int:
        (only,) = children(self.keeper)
        return only

    def lives(self) -> bool:
        return time.monotonic_ns() - self.ring.console_ns < 300_000_000

    def said(self) -> str:
        return "\n".join(message.words for message in self.words.poll())


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """The keeper's patience is a quarter of what it is; ask for it before `kept`."""
    monkeypatch.setattr(keeping, "_APART_S", 0.25)
    monkeypatch.setattr(keeping, "_FARTHEST_S", 2.0)


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Kept]:
    path = str(tmp_path / "s")
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen(8)
    asking, taking = crew.pair()
    words, heard = crew.pair()
    ring = Ring.create(slots=64)
    one = loaded()
    run = RunFacts(one.config, one.path, one.text, "bus", "", "log")
    keeper = fork_console(listener, asking, words, run, ring)
    loop = handoff.LoopEnd(taking, consoles_gone=lambda: ring.consoles_gone)
    yield Kept(keeper, ring, loop, notes.NotesListener(heard), path)
    ring.set_closed()
    if not crew.wait(keeper, 10.0):
        crew.kill(keeper)


def request(kept: Kept) -> Request:
    """The next one that comes to the loop."""
    found = list[Request]()

    def come() -> bool:
        one = kept.loop.take()
        found.extend([one] if one is not None else [])
        return bool(found)

    eventually(come)
    return found[0]


def taken(kept: Kept) -> None:
    """Be the loop that has taken it."""
    rest: Any = dict.fromkeys(Tick._fields, 0)
    kept.loop.answer(Tick(**rest | {"state": int(State.HOLDING), "answer": int(Answer.TAKEN)}))


def answered(kept: Kept, client: Client, kind: RequestKind, verb: str, **fields: object) -> dict[str, object]:
    """Ask, be the loop that takes it, and hear the answer."""
    client.send(verb, **fields)
    assert request(kept).kind == kind
    taken(kept)
    replies: list[dict[str, object]] = []

    def replied() -> bool:
        replies.extend(client.replies())
        return bool(replies)

    eventually(replied)
    return replies[-1]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_console_that_dies_or_stands_still_is_followed_by_another(kept: Kept, number: int) -> None:
    eventually(kept.lives)
    first = kept.console
    with Client(kept.path) as client:
        gains = {"k1": 90000.0}
        assert answered(kept, client, RequestKind.GAINS, "tune_set", gains=gains)["ok"] is True
    os.kill(first, number)
    began = time.monotonic()
    eventually(lambda: kept.ring.console_ns == CONSOLE_GONE)
    assert (time.monotonic() - began > 1.5) == (number == signal.SIGSTOP)
    nothing: Any = [0] * len(Tick._fields)
    kept.loop.answer(Tick(*nothing))  # to one that is no more
    with Client(kept.path) as client:  # who calls meanwhile waits
        eventually(kept.lives)
        assert kept.console != first
        assert not Path(f"/proc/{first}").exists()
        assert client.ask("tune_get")["gains"]["k1"] == 90000.0, "the next one knows what runs"
        assert answered(kept, client, RequestKind.ARM, "arm")["ok"] is True
    said = kept.said()
    why = "was killed (signal 9)" if number == signal.SIGKILL else "stood still for 2 s and was killed"
    assert f"the console {why}; what an operator had engaged comes to rest" in said
    assert "the console was started again" in said


@pytest.mark.slow
def test_consoles_that_die_at_once_are_started_less_and_less_often_which_is_said_once(
    hasty: None, kept: Kept
) -> None:
    eventually(kept.lives)
    began, killed = time.monotonic(), list[float]()
    while len(killed) < 4:
        for pid in children(kept.keeper):
            killed.append(time.monotonic() - began)
            os.kill(pid, signal.SIGKILL)
            eventually(partial(reaped, kept.keeper, pid))
        time.sleep(0.01)
        assert time.monotonic() < began + 20.0
    apart_s = [b - a for a, b in pairwise(killed)]
    # the first may die as late as a start is due; what follows is due so long after the start before
    assert all(due - 0.1 < s < due + 1.0 for s, due in zip(apart_s[1:], (0.5, 1.0), strict=True)), apart_s
    assert apart_s[0] < 0.25 + 1.0
    said = kept.said()
    assert said.count("was killed") == 2
    assert said.count("again and again, and is started every 2 s at most") == 1


def replied(client: Client) -> bool:
    return bool(client.replies())


def reaped(parent: int, pid: int) -> bool:
    return pid not in children(parent)


def asleep(pid: int) -> int:
    """How often a process has gone to sleep."""
    words = Path(f"/proc/{pid}/status").read_text()
    return int(words.partition("voluntary_ctxt_switches:")[2].split()[0])


@pytest.mark.slow
def test_a_keeper_and_a_console_that_have_nothing_to_do_wake_a_few_times_a_second(kept: Kept) -> None:
    eventually(kept.lives)
    time.sleep(0.5)
    both = (kept.keeper, kept.console)
    before = [asleep(pid) for pid in both]
    time.sleep(2.0)
    keeper, console = (asleep(pid) - n for pid, n in zip(both, before, strict=True))
    assert keeper <= 20
    assert console <= 40


@pytest.mark.slow
def test_half_of_an_upload_goes_with_its_console_and_a_whole_one_stays(hasty: None, kept: Kept) -> None:
    eventually(kept.lives)
    piece = [0.5, 0.1, *[0.0] * 7]
    for whole in (True, False):
        first = kept.console
        with Client(kept.path) as client:
            client.send("upload", first=True, last=whole, pieces=[piece])
            for _ in range(2):  # the profile is emptied, and has a piece
                request(kept)
                taken(kept)
            eventually(partial(replied, client))
            os.kill(first, signal.SIGKILL)
        with Client(kept.path) as client:
            client.send("arm")
            kinds = [request(kept)]
            taken(kept)
            if not whole:
                assert kinds == [Request(RequestKind.PIECE)]
                kinds = [request(kept)]
                taken(kept)
            assert kinds[0].kind == RequestKind.ARM


@pytest.mark.slow
def test_a_console_dies_with_its_keeper_and_falls_silent(kept: Kept) -> None:
    eventually(kept.lives)
    console = kept.console
    crew.kill(kept.keeper)
    eventually(lambda: not kept.lives())
    eventually(lambda: not Path(f"/proc/{console}").exists())
    kept.words.poll()
    assert kept.words.gone


def eventually_says(kept: Kept, words: str) -> None:
    heard: list[str] = []

    def told() -> bool:
        heard.append(kept.said())
        return any(words in said for said in heard)

    eventually(told)


def test_a_signal_to_the_keeper_reaches_the_console_and_a_group_kill_does_not(kept: Kept) -> None:
    eventually(kept.lives)
    first = kept.console
    for pid in (kept.keeper, first):
        os.kill(pid, signal.SIGTERM)
    os.kill(kept.keeper, signal.SIGHUP)
    eventually_says(kept, "SIGHUP: tune from the file")
    assert kept.console == first


def test_a_signal_that_comes_while_there_is_no_console_is_for_the_next_one(hasty: None, kept: Kept) -> None:
    eventually(kept.lives)
    os.kill(kept.console, signal.SIGKILL)
    eventually(lambda: kept.ring.console_ns == CONSOLE_GONE)
    os.kill(kept.keeper, signal.SIGHUP)
    eventually_says(kept, "SIGHUP: tune from the file")


def test_a_console_ends_with_the_run(kept: Kept) -> None:
    eventually(kept.lives)
    console = kept.console
    kept.ring.set_closed()
    assert crew.wait(kept.keeper, 10.0)
    assert not Path(f"/proc/{console}").exists()
    assert "the console" not in kept.said()


def test_a_memory_keeps_the_last_that_fits() -> None:
    memory = Memory()
    assert memory.kept() is None
    for n in range(3):
        memory.keep(n=n, x=0.1, words="µ")
        assert memory.kept() == {"n": n, "x": 0.1, "words": "µ"}
    memory.keep(words="x" * (1 << 18))
    assert memory.kept() == {"n": 2, "x": 0.1, "words": "µ"}
    child = crew.fork(lambda: memory.keep(n=3))
    assert crew.wait(child, 10.0)
    assert memory.kept() == {"n": 3, "x": 0.1, "words": "µ"}


def test_the_next_console_counts_on_from_where_the_one_before_was() -> None:
    ring, memory = Ring.create(slots=64), Memory()
    whole, watch = StatusWatch(ring), StatusWatch(ring, memory=memory)
    for n, record in enumerate(noisy(400)):
        m = record.tick.measurement._replace(skipped=n % 3, fresh=n % 8)
        ring.put(record._replace(tick=record.tick._replace(measurement=m)))
        if n % 20 == 19:
            whole.poll()
            watch.poll()
        if n in (150, 310):  # it has died, between two looks
            watch = StatusWatch(ring, memory=memory)
    found, expected = watch.fields(), whole.fields()
    assert found["skipped"] > 300
    for key in ("skipped", "saturated", "amiss", "amiss_because", "lateness_us", "histograms"):
        assert found[key] == expected[key], key
    assert len(memory.kept_bytes() or b"") < 100_000
