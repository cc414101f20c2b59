"""A page's own end of the console: what it may ask, and that whoever has gone holds nothing in motion.

The console knows one client per page that commands, which takes the lease as any other does. With the end of
the page it hangs up, which has the axis hold whatever needs an operator.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import Callable
from typing import Any

from pneud.console.endpoint import PlaceError
from pneud.console.line_stream import MAX_LINE, VERSION, line
from pneud.console.records import UNUSABLE, ProgramError
from pneud.web.programs import Programs

ORDERS: dict[str, tuple[str, ...]] = {  # what a page may ask, with the fields that it may give
    **dict.fromkeys(("stop", "disarm", "clear", "hold", "home", "tune_get"), ()),
    "arm": ("unproven",),
    "goto": ("x_mm", "speed_mm_s"),
    "jog": ("velocity_mm_s",),
    "track": (),
    "run": ("program", "record", "cycles"),
    "tune_set": ("gains",),
    "mark": ("text",),
}
_ALWAYS: dict[str, dict[str, Any]] = {
    "goto": {"attended": True},
    "track": {"what": "reference", "attended": True},
    "run": {"attended": True},
    "jog": {"lease_s": 0.3},
}
_ATTENDED = ("goto", "jog", "track", "run")
NO_PROGRAMS = Programs(None)
_LONGEST = 1 << 20  # of a reply
_MOST = 1 << 14  # bytes that the console has not taken yet
_HANG_UP_S = 1.0

Tell = Callable[[dict[str, Any]], None]
"""Is told what has become of a request: its number as `reply`, `ok`, and why not."""


class Hand:
    """One page's.

    Attributes:
        attends: what it asked for last needs it, or is over by now.
    """

    def __init__(
        self,
        connect: Callable[[], socket.socket],
        tell: Tell,
        axis: str | None = None,
        programs: Programs = NO_PROGRAMS,
    ) -> None:
        """Begin without a connection.

        Args:
            connect: makes one; raises PlaceError.
            tell: called with every reply.
            axis: that is commanded, where there are several; the console stops all of them.
            programs: that it may have gone through, by their names.
        """
        self.attends = False
        self._connect = connect
        self._tell = tell
        self._programs = programs
        self._axis = {"axis": axis} if axis is not None else {}
        self._run = (-1, "")  # the last request for a program: its number, and the file
        self._writer: asyncio.StreamWriter | None = None
        self._ear: asyncio.Task[None] | None = None

    async def ready(self) -> str:
        """Have a connection, so that a stop need not wait for one.

        Returns:
            Why there is none; else nothing.
        """
        if self._writer is not None:
            return ""
        try:
            connection = self._connect()
            connection.setblocking(False)
            reader, writer = await asyncio.open_unix_connection(sock=connection, limit=_LONGEST)
        except (PlaceError, OSError) as e:
            return str(e)
        self._writer = writer
        self._ear = asyncio.create_task(self._listen(reader, writer))
        return ""

    async def ask(self, verb: str, number: int, given: dict[str, Any]) -> None:
        """Ask; the reply comes by itself."""
        fields = ORDERS.get(verb)
        if fields is None:
            self._refuse(number, f"a page may not ask for {verb}")
            return
        if surplus := given.keys() - {*fields}:
            self._refuse(number, f"{verb} has no {', '.join(sorted(surplus))}")
            return
        if "program" in given:
            try:
                tree = await asyncio.to_thread(self._programs.tree, given["program"])
                self._run = (number, f"{given['program']}.toml")
                given = {**given, "program": tree}
            except ProgramError as e:
                self._refuse(number, str(e))
                return
        if why := await self.ready():
            self._refuse(number, f"nobody hears: {why}")
            return
        always = {**_ALWAYS.get(verb, {}), **self._axis}
        try:
            request = line({"v": VERSION, "id": number, "verb": verb, **given, **always})
        except ValueError:
            self._refuse(number, "numbers are finite")
            return
        if len(request) > MAX_LINE:
            self._refuse(number, f"{verb} is longer than the {MAX_LINE} bytes that the console takes")
            return
        assert self._writer is not None
        if self._writer.transport.get_write_buffer_size() > _MOST:
            self._refuse(number, "too many requests wait")
            return
        self._writer.write(request)
        self.attends = verb in _ATTENDED or (self.attends and verb in ("mark", "tune_get", "tune_set"))

    def _refuse(self, number: int, why: str) -> None:
        self._tell({"reply": number, "ok": False, "message": why})

    async def _listen(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, ValueError):
            while found := await reader.readline():
                reply = json.loads(found)
                told = {"reply": reply.get("id"), "ok": bool(reply.get("ok"))}
                if not told["ok"]:
                    told["message"] = self._why_not(reply)
                told.update((key, reply[key]) for key in ("gains", "changed", "state") if key in reply)
                self._tell(told)
        writer.close()
        if self._writer is writer:
            self._writer = None

    def _why_not(self, reply: dict[str, Any]) -> str:
        """Why something is not done; what is wrong with a program is told with its file."""
        error, (number, file) = reply.get("error", {}), self._run
        message = str(error.get("message", ""))
        if error.get("type") == UNUSABLE and reply.get("id") == number:
            return f"{file}: {message.removeprefix('run: ')}"
        return message

    async def let_go(self) -> None:
        """Hang up: the lease is given back, and what needed an operator is held."""
        writer, self._writer = self._writer, None
        self.attends = False
        if writer is not None:
            writer.transport.abort()  # what has not been sent by now is not to happen later
        if self._ear is not None:
            with contextlib.suppress(TimeoutError, asyncio.CancelledError):
                await asyncio.wait_for(self._ear, _HANG_UP_S)
            self._ear = None
