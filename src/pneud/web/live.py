"""A page's WebSocket: pictures out, as many as it takes, and orders in.

A page says of every other picture that it has seen it, and all before it. One that says so late gets fewer
pictures and, with the next one, the curves since the last; nothing piles up here. Where a page that commands
has seen nothing for a second, what it has set going is held. Dropped is who has seen nothing for long, says
what no page says, or more than any does.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from pneud.web.axis import Axis
from pneud.web.hand import Hand

PERIOD_S = 0.04  # of pictures
PAGES = 24  # at most; the console has 32 clients
HANDS = 8  # of them that may command
_UNSEEN = 4  # pictures on their way to one page
_SILENT_S = 1.0  # after which nobody attends to what a page has set going
_GONE_S = 10.0  # after which it has gone
_LOOK_S = 0.2
_WAITING = 32  # replies to one page
_MOST_SAID = 100  # by one page in a second
_HELD_S = 1.0  # in which whoever was mistaken cannot come again
_NO_MORE = 1013  # codes of a WebSocket's end
_MISTAKE = 1008


class Picture(NamedTuple):
    """What a page shows, once."""

    number: int
    newest: int  # bucket of its curves
    text: str


class Gallery:
    """All pages of an axis, and the pictures that are painted for them."""

    def __init__(self, axis: Axis, everybody: set[Page] | None = None) -> None:
        """Nobody looks.

        Args:
            axis: what is painted.
            everybody: the pages of all axes, which are counted together.
        """
        self._axis = axis
        self._everybody: set[Page] = set() if everybody is None else everybody
        self._pages: set[Page] = set()
        self._painted: dict[int, Picture] = {}  # by the bucket behind which curves begin
        self._number = 0

    @property
    def full(self) -> bool:
        """Whether no more pages are served."""
        return len(self._everybody) >= PAGES

    @property
    def hands_full(self) -> bool:
        """Whether no more pages may command."""
        return sum(page.commands for page in self._everybody) >= HANDS

    def enter(self, page: Page) -> None:
        """Paint for one more."""
        self._pages.add(page)
        self._everybody.add(page)

    def leave(self, page: Page) -> None:
        """Paint for one less."""
        self._pages.discard(page)
        self._everybody.discard(page)

    async def paint(self) -> None:
        """Make pictures while somebody looks, for ever."""
        while True:
            began_s = time.monotonic()
            if self._pages:
                await self._axis.look(began_s)
                self._number += 1
                self._painted = {}
                for page in self._pages:
                    page.wake()
            else:
                self._axis.rest()
            await asyncio.sleep(max(0.005, began_s + PERIOD_S - time.monotonic()))

    def picture(self, since: int) -> Picture:
        """The newest picture, with the curves behind a bucket."""
        found = self._painted.get(since)
        if found is None:
            strip = self._axis.strip
            shown = {"picture": self._number, **self._axis.picture(time.monotonic())}
            text = json.dumps({**shown, "curves": strip.since(since)}, separators=(",", ":"))
            found = self._painted[since] = Picture(self._number, strip.newest, text)
        return found


class Page:
    """One page."""

    def __init__(self, socket: WebSocket, gallery: Gallery, axis: Axis, hand: Callable[[Any], Hand]) -> None:
        """Begin.

        Args:
            socket: accepted.
            gallery: has the pictures.
            axis: what they show.
            hand: makes an end of the console that tells what it is given.
        """
        self.commands = False
        self._socket = socket
        self._gallery = gallery
        self._axis = axis
        self._hand = hand(self._tell)
        self._there = asyncio.Event()
        self._words: list[str] = []  # for the page, beside pictures
        self._bucket = -1
        self._away: deque[int] = deque()  # numbers of pictures that were sent and have not been seen
        self._behind = False  # there are so many that it waits
        self._seen_s = time.monotonic()
        self._number = 0  # of the picture sent last
        self._facts = ""
        self._said, self._said_s = 0, 0.0  # how much since when

    def wake(self) -> None:
        """There is something to send, perhaps."""
        self._there.set()

    def _tell(self, message: dict[str, Any]) -> None:
        if len(self._words) < _WAITING:
            self._words.append(json.dumps(message))
        self._there.set()

    async def serve(self, may_command: Callable[[object], bool]) -> None:
        """Serve until one of both ends has gone."""
        self._gallery.enter(self)
        ways = [asyncio.create_task(way) for way in (self._send(), self._watch(), self._receive(may_command))]
        sends, _, hears = ways
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            mistaken = hears.done() and not sends.done()
            self._gallery.leave(self)
            for way in ways:
                way.cancel()
            await asyncio.gather(self._hand.let_go(), *ways, return_exceptions=True)
            if mistaken and self._socket.client_state is WebSocketState.CONNECTED:
                await asyncio.sleep(_HELD_S)
            if self._socket.application_state is WebSocketState.CONNECTED:
                with contextlib.suppress(RuntimeError, TimeoutError, WebSocketDisconnect):
                    await asyncio.wait_for(self._socket.close(_MISTAKE), 0.5)

    async def _send(self) -> None:
        """For ever; slower than others where the page is."""
        while True:
            self._there.clear()
            words, self._words = self._words, []
            if (facts := self._axis.facts()) != self._facts:
                self._facts = facts
                words += [facts] if facts else []
            self._behind = len(self._away) >= _UNSEEN
            if not self._behind:
                picture = self._gallery.picture(self._bucket)
                if picture.number > self._number:
                    words.append(picture.text)
                    self._number, self._bucket = picture.number, picture.newest
                    self._away.append(picture.number)
            for text in words:
                await self._socket.send_text(text)
            await self._there.wait()

    async def _watch(self) -> None:
        """Until the page has seen nothing for long."""
        while (silent_s := time.monotonic() - self._seen_s) < _GONE_S or not self._away:
            if silent_s > _SILENT_S and self._hand.attends and self._away:
                await self._hand.let_go()
                why = f"this page has seen nothing for {_SILENT_S:g} s: what it had set going is held"
                self._tell({"reply": 0, "ok": False, "message": why})
            await asyncio.sleep(_LOOK_S)

    async def _receive(self, may_command: Callable[[object], bool]) -> None:
        """Until the page goes, or says what none says."""
        while True:
            try:
                message = json.loads(await self._socket.receive_text())
            except (WebSocketDisconnect, ValueError, TypeError, KeyError, RecursionError):
                return
            if not isinstance(message, dict) or self._says_too_much():
                return
            if "seen" in message:
                if type(number := message["seen"]) is not int:
                    return
                self._sees(number)
            elif "hello" in message:
                await self._greet(may_command(message["hello"]))
            elif isinstance(verb := message.pop("do", None), str):
                number = message.pop("id", 0)
                if not self.commands or type(number) is not int:
                    self._tell({"reply": number, "ok": False, "message": "this page may only look"})
                    continue
                await self._hand.ask(verb, number, message)
            else:
                return

    def _sees(self, number: int) -> None:
        """The page has seen a picture, and all before it."""
        if self._away and self._away[0] <= number:
            self._seen_s = time.monotonic()
            while self._away and self._away[0] <= number:
                self._away.popleft()
            if self._behind:
                self._there.set()

    def _says_too_much(self) -> bool:
        now_s = time.monotonic()
        if now_s - self._said_s >= 1.0:
            self._said, self._said_s = 0, now_s
        self._said += 1
        return self._said > _MOST_SAID

    async def _greet(self, may_command: bool) -> None:
        why = ""
        if may_command and not self.commands:
            if self._gallery.hands_full:
                why = f"{HANDS} pages command already; this one looks"
            else:
                self.commands = True
                self._seen_s = time.monotonic()
                why = await self._hand.ready()
        self._tell({"welcome": self.commands, "message": why})
