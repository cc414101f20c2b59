"""What pages are told and may ask: curves, the hand that asks, and files of metrics."""

from __future__ import annotations

import asyncio
import json
import math
import socket
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, cast

import pytest
import uvicorn
from starlette.websockets import WebSocketState
from uvicorn.server import ServerState
from websockets.frames import Frame, Opcode

from pneud.console.endpoint import PlaceError
from pneud.console.protocol import Run, parse
from pneud.log.live.packing import Drawn
from pneud.web import live
from pneud.web.hand import NO_PROGRAMS, ORDERS, Hand
from pneud.web.programs import Listed, Programs
from pneud.web.serving import Line, write_metrics
from pneud.web.strip import SIGNALS, Strip

FIELDS: dict[str, dict[str, Any]] = {
    "goto": {"x_mm": 100.0},
    "jog": {"velocity_mm_s": 5.0},
    "tune_set": {"gains": {"k1": 1.0}},
    "mark": {"text": "x"},
    "run": {"program": "pick", "cycles": 3},
}


def record(t_ms: float, position_m: float) -> Drawn:
    return Drawn(round(t_ms * 1e6), 0.0, position_m, 0.0, 1e5, 1e5, 6e5, 0.0)


def test_a_spike_of_one_tick_is_in_the_curve() -> None:
    strip = Strip()
    strip.add(record(t, 0.7 if t == 33 else 0.1) for t in range(100))
    found = strip.since(-1)
    assert found["t"] == [0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07]  # the fifth is still open
    assert found["position_mm"] == [100.0, 100.0, 100.0, 700.0, 100.0, 100.0, 100.0, 100.0]
    assert all(len(found[name]) == len(found["t"]) for name in SIGNALS)


def test_extremes_keep_their_order_and_gaps_are_gaps() -> None:
    strip = Strip()
    strip.add(
        [
            record(0, 0.3),
            record(1, 0.1),
            record(20, math.nan),
            record(40, 0.1),
            record(41, 0.3),
            record(60, 0),
        ]
    )
    assert strip.since(-1)["position_mm"] == [300.0, 100.0, None, None, 100.0, 300.0]
    assert strip.since(0)["position_mm"] == [None, None, 100.0, 300.0]
    assert strip.since(strip.newest)["t"] == []


def test_a_strip_is_bounded() -> None:
    strip = Strip()
    strip.add(record(20 * n, 0.1) for n in range(5000))
    assert len(strip.since(-1)["t"]) < 1500


# the hand


class Desk:
    """The other end of a hand's connection."""

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []
        self.ends: list[socket.socket] = []

    def connect(self) -> socket.socket:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self.ends.append(ours)
        return theirs

    def heard(self) -> list[bytes]:
        try:
            return self.ends[-1].recv(1 << 16).splitlines()
        except BlockingIOError:
            return []


PROGRAM = 'schema = 1\npoints = "points.toml"\n[[record]]\ndo = "goto"\nto_mm = "there"\n'


def folder_of_programs(folder: Path) -> Programs:
    (folder / "pick.toml").write_text(PROGRAM)
    (folder / "points.toml").write_text("there = 120.0\n")
    (folder / "bad.toml").write_text("schema = \n")
    (folder / "long.toml").write_text(PROGRAM + 600 * '[[record]]\ndo = "goto"\nto_mm = "there"\n')
    return Programs(folder)


def served(talk: Callable[[Desk, Hand], Coroutine[Any, Any, None]], programs: Programs = NO_PROGRAMS) -> Desk:
    desk = Desk()

    async def main() -> None:
        hand = Hand(desk.connect, desk.told.append, programs=programs)
        await talk(desk, hand)
        await hand.let_go()

    asyncio.run(main())
    for end in desk.ends:
        end.close()
    return desk


@pytest.mark.parametrize("verb", ORDERS)
def test_an_order_is_a_request_that_the_console_knows(verb: str, tmp_path: Path) -> None:
    async def talk(desk: Desk, hand: Hand) -> None:
        await hand.ask(verb, 7, dict(FIELDS.get(verb, {})))
        (line,) = desk.heard()
        request = parse(line)
        assert (request.verb, request.id) == (verb, 7)
        if verb in ("goto", "track", "run"):
            assert getattr(request, "attended") is True, "it ends, held, with the page"  # noqa: B009
        if isinstance(request, Run):
            assert request.program is not None
            assert request.program["points"] == {"there": 120.0}
            assert (request.program["name"], request.cycles) == ("pick", 3)

    assert served(talk, folder_of_programs(tmp_path)).told == []


def test_programs_are_those_of_a_folder_and_what_cannot_be_read_says_why(tmp_path: Path) -> None:
    bad, _, pick = folder_of_programs(tmp_path).listed()
    assert pick == Listed("pick", "pick", 1, "")
    assert "bad.toml" in bad.trouble
    assert Programs(tmp_path / "gone").listed() == NO_PROGRAMS.listed() == []


def test_what_the_console_finds_wrong_with_a_program_is_told_with_its_file(tmp_path: Path) -> None:
    async def talk(desk: Desk, hand: Hand) -> None:
        await hand.ask("run", 7, {"program": "pick"})
        for number, kind in ((7, "program"), (7, "busy"), (8, "program")):
            error = {"type": kind, "message": "run: record 1 (goto): too far"}
            desk.ends[-1].send(json.dumps({"id": number, "ok": False, "error": error}).encode() + b"\n")
        while len(desk.told) < 3:
            await asyncio.sleep(0)

    told = [one["message"] for one in served(talk, folder_of_programs(tmp_path)).told]
    assert told == ["pick.toml: record 1 (goto): too far", *["run: record 1 (goto): too far"] * 2]


@pytest.mark.parametrize(
    "name", ["../pick", "points", "pick.toml", "", None, 3, {"schema": 1}, "bad", "long"]
)
def test_a_page_runs_what_is_in_the_folder_and_nothing_else(name: object, tmp_path: Path) -> None:
    (tmp_path / "programs").mkdir()
    programs = folder_of_programs(tmp_path / "programs")
    (tmp_path / "pick.toml").write_text(PROGRAM)

    async def talk(desk: Desk, hand: Hand) -> None:
        await hand.ask("run", 7, {"program": name})
        assert not desk.ends or desk.heard() == []

    (told,) = served(talk, programs).told
    assert (told["reply"], told["ok"]) == (7, False)


@pytest.mark.parametrize(
    ("verb", "given"),
    [
        *(
            (verb, {})
            for verb in ("restart", "attach", "probe", "upload", "tune_reload", "observe", "status", "")
        ),
        ("goto", {"x_mm": 1.0, "attended": False}),
        ("jog", {"velocity_mm_s": 1.0, "lease_s": 1.0}),
        ("stop", {"id": 3}),
        ("stop", {"verb": "restart"}),
        ("goto", {"x_mm": math.nan}),
    ],
)
def test_a_page_asks_for_nothing_else(verb: str, given: dict[str, Any]) -> None:
    async def talk(desk: Desk, hand: Hand) -> None:
        await hand.ask(verb, 7, given)
        assert not desk.ends or desk.heard() == []

    (told,) = served(talk).told
    assert (told["reply"], told["ok"]) == (7, False)


def test_replies_come_by_number_and_whoever_goes_hangs_up() -> None:
    async def talk(desk: Desk, hand: Hand) -> None:
        await hand.ask("arm", 1, {})
        refusal = {"v": 1, "id": 1, "ok": False, "error": {"type": "busy", "message": "another commands"}}
        desk.ends[0].sendall(json.dumps(refusal).encode() + b"\n")
        await asyncio.sleep(0.05)
        await hand.ask("goto", 2, {"x_mm": 1.0})
        attends = [hand.attends]
        await hand.let_go()
        assert [*attends, hand.attends] == [True, False]
        assert desk.heard(), "what was asked"
        assert desk.ends[0].recv(1) == b"", "the end of the connection"

    assert served(talk).told == [{"reply": 1, "ok": False, "message": "another commands"}]


def test_whoever_asks_faster_than_the_console_takes_is_told() -> None:
    async def talk(desk: Desk, hand: Hand) -> None:
        for number in range(5000):
            await hand.ask("mark", number, {"text": "x" * 200})

    told = served(talk).told
    assert told
    assert {one["message"] for one in told} == {"too many requests wait"}


def test_a_console_that_is_gone_is_said_and_found_again() -> None:
    gone = True

    async def main() -> None:
        desk = Desk()

        def connect() -> socket.socket:
            if gone:
                raise PlaceError("no running daemon found")
            return desk.connect()

        hand = Hand(connect, desk.told.append)
        await hand.ask("stop", 1, {})
        assert desk.told == [{"reply": 1, "ok": False, "message": "nobody hears: no running daemon found"}]
        nonlocal gone
        gone = False
        await hand.ask("stop", 2, {})
        assert len(desk.heard()) == 1
        desk.ends[0].close()
        await asyncio.sleep(0.05)
        await hand.ask("stop", 3, {})
        assert len(desk.heard()) == 1
        await hand.let_go()

    asyncio.run(main())


# the WebSocket


class Ears:
    """A page's end, without a network."""

    client_state = application_state = WebSocketState.CONNECTED

    def __init__(self) -> None:
        self.said: asyncio.Queue[str] = asyncio.Queue()
        self.heard: list[dict[str, Any]] = []
        self.closed = False

    async def receive_text(self) -> str:
        return await self.said.get()

    async def send_text(self, text: str) -> None:
        self.heard.append(json.loads(text))

    async def close(self, code: int) -> None:
        self.closed = True

    def pictures(self) -> list[int]:
        return [one["picture"] for one in self.heard if "picture" in one]


class Still:
    """An axis that stands."""

    def __init__(self) -> None:
        self.strip = Strip()
        self.told = '{"status":{}}'

    async def look(self, now_s: float) -> None:
        pass

    def rest(self) -> None:
        pass

    def facts(self) -> str:
        return self.told

    def picture(self, now_s: float) -> dict[str, Any]:
        return {}


def seen_by(ears: Ears, talk: Callable[[Still], Coroutine[Any, Any, None]]) -> None:
    """What a page sees of an axis, a picture every five milliseconds."""

    async def main() -> None:
        axis: Any = Still()
        gallery, anything = live.Gallery(axis), cast(Any, ears)
        page = live.Page(anything, gallery, axis, lambda tell: Hand(Desk().connect, tell))
        work = [asyncio.create_task(gallery.paint()), asyncio.create_task(page.serve(lambda _: False))]
        await talk(axis)
        for one in work:
            one.cancel()
        await asyncio.gather(*work, return_exceptions=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "PERIOD_S", 0.0)
        patch.setattr(live, "_HELD_S", 0.02)
        asyncio.run(main())


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(10.0):
        while not holds():
            await asyncio.sleep(0.001)


def test_who_does_not_say_what_it_sees_gets_a_few_pictures_and_then_the_newest() -> None:
    ears = Ears()

    async def talk(axis: Still) -> None:
        await until(lambda: len(ears.pictures()) == 4)
        axis.told = '{"status":{"name":"x"}}'
        await until(lambda: {"status": {"name": "x"}} in ears.heard)
        assert len(ears.pictures()) == 4
        await asyncio.sleep(0.05)
        ears.said.put_nowait(json.dumps({"seen": ears.pictures()[-1]}))
        await until(lambda: len(ears.pictures()) == 8)
        assert ears.pictures()[4] > ears.pictures()[3] + 1, "those between have not been sent"
        ears.said.put_nowait(json.dumps({"seen": 0}))  # none that is on its way
        await asyncio.sleep(0.03)
        assert len(ears.pictures()) == 8
        assert not ears.closed

    seen_by(ears, talk)


@pytest.mark.parametrize(
    "words",
    [['{"seen": "1"}'], ["[1]"], ["{"], ['{"x": 1}'], ["[" * 4000], ['{"do": "stop"}'] * 101],
)  # fmt: skip
def test_who_says_what_no_page_says_is_dropped_a_little_later(words: list[str]) -> None:
    ears = Ears()

    async def talk(axis: Still) -> None:
        await until(lambda: bool(ears.pictures()))
        for one in words:
            ears.said.put_nowait(one)
        await until(ears.said.empty)
        assert not ears.closed
        await until(lambda: ears.closed)

    seen_by(ears, talk)


class Wire(asyncio.Transport):
    """Takes what is written."""

    def __init__(self) -> None:
        super().__init__()
        self.written, self.aborted = b"", False

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return default

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.written += bytes(data)

    def pause_reading(self) -> None:
        pass

    def is_closing(self) -> bool:
        return self.aborted

    def close(self) -> None:
        pass

    def abort(self) -> None:
        self.aborted = True


def framed(opcode: Opcode, data: bytes = b"", fin: bool = True) -> bytes:
    return Frame(opcode, data, fin).serialize(mask=True, extensions=[])


def on_a_line(talk: Callable[[Line, Wire], None]) -> None:
    """Over a WebSocket that has been accepted."""

    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "websocket.accept"})
        await asyncio.sleep(60.0)

    async def main() -> None:
        config = uvicorn.Config(app, ws=Line, log_config=None, lifespan="off", ws_max_size=4096)
        config.load()
        line, wire = Line(config, ServerState(), {}), Wire()
        line.connection_made(wire)
        line.data_received(
            b"GET /live HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        await until(lambda: wire.written.startswith(b"HTTP/1.1 101"))
        wire.written = b""
        talk(line, wire)
        line.connection_lost(None)

    asyncio.run(main())


def test_pings_of_who_does_not_read_are_not_answered() -> None:
    def talk(line: Line, wire: Wire) -> None:
        line.pause_writing()
        line.data_received(1000 * framed(Opcode.PING, b"x"))
        assert wire.written == b""
        line.resume_writing()
        line.data_received(framed(Opcode.PING, b"y"))
        assert wire.written == b"\x8a\x01y"
        assert not wire.aborted

    on_a_line(talk)


@pytest.mark.parametrize(
    "flood",
    [
        framed(Opcode.TEXT, b"{", fin=False) + 100 * framed(Opcode.CONT, fin=False),
        100 * framed(Opcode.TEXT, b"{}"),
    ],
    ids=["empty pieces", "messages"],
)
def test_what_would_pile_up_ends_the_line(flood: bytes) -> None:
    def talk(line: Line, wire: Wire) -> None:
        line.data_received(flood)
        assert wire.aborted
        assert line.queue.qsize() < 70

    on_a_line(talk)


def test_a_file_of_metrics_is_whole_or_not_there(tmp_path: Path) -> None:
    file = tmp_path / "pneud.prom"
    write_metrics(file, "a 1\n")
    write_metrics(file, "a 2\n")
    assert [path.name for path in tmp_path.iterdir()] == ["pneud.prom"]
    assert file.read_text() == "a 2\n"
    with pytest.raises(OSError, match=r"No such file"):
        write_metrics(tmp_path / "no" / "pneud.prom", "")
