"""A page's WebSocket: pictures out, as many as it takes, and orders in.

A page says of each picture that it has seen it. One that says so late gets fewer pictures and, with the next
one, the curves since the last; nothing piles up here. Where a page that commands has seen nothing for a
second, what it has set going is held; who has seen nothing for long is dropped.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from pneud.web.axis import Axis
from pneud.web.hand import Hand

PERIOD_S = 0.04  # of pictures
PAGES = 24  # at most; the console has 32 clients
HANDS = 8  # of them that may command
_UNSEEN = 3  # pictures on their way to one page
_SILENT_S = 1.0  # after which nobody attends to what a page has set going
_GONE_S = 10.0  # after which it has gone
_LOOK_S = 0.2
_WAITING = 32  # replies to one page
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
        self._sent = self._seen = 0
        self._seen_s = time.monotonic()
        self._number = 0  # of the picture sent last
        self._facts: dict[str, Any] = {}

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
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._gallery.leave(self)
            for way in ways:
                way.cancel()
            await asyncio.gather(self._hand.let_go(), *ways, return_exceptions=True)
            if self._socket.application_state is WebSocketState.CONNECTED:
                with contextlib.suppress(RuntimeError, TimeoutError, WebSocketDisconnect):
                    await asyncio.wait_for(self._socket.close(_MISTAKE), 0.5)

    async def _send(self) -> None:
        """For ever; slower than others where the page is."""
        while True:
            words, self._words = self._words, []
            if (facts := self._axis.facts()) != self._facts:
                self._facts = facts
                words.append(json.dumps({"status": facts}))
            if self._sent - self._seen < _UNSEEN:
                picture = self._gallery.picture(self._bucket)
                if picture.number > self._number:
                    words.append(picture.text)
                    self._number, self._bucket = picture.number, picture.newest
                    self._sent += 1
            for text in words:
                await self._socket.send_text(text)
            self._there.clear()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._there.wait(), 0.25)

    async def _watch(self) -> None:
        """Until the page has seen nothing for long."""
        while (silent_s := time.monotonic() - self._seen_s) < _GONE_S or self._sent == self._seen:
            if silent_s > _SILENT_S and self._hand.attends and self._sent > self._seen:
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
            if not isinstance(message, dict):
                return
            if "seen" in message:
                self._seen = min(self._seen + 1, self._sent)
                self._seen_s = time.monotonic()
                self._there.set()
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
