"""The axis as pages see it: the records of its ring, and what its console says now and then.

Nothing here commands. Where daemon or console goes, it is looked for again; records are read only while
somebody looks.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from pneud.console.attached import attached
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.log.live.packing import drawn, unpacked
from pneud.log.live.ring import Ring, RingReader
from pneud.rt.processes import with_own
from pneud.safety.cause import first_cause
from pneud.signals import Record, state_name
from pneud.view import mileage
from pneud.view.banner import Banner, Level, banner_of, faults_of
from pneud.view.info import ScreenInfo, info_of
from pneud.web.strip import Strip

_STATUS_S = 0.5
_AGAIN_S = 1.0
_COMPLETE_S = 0.002
_LEVELS = {Level.GOOD: "good", Level.LOOK: "look", Level.BAD: "bad"}
_KEPT = (
    "name",
    "bus",
    "log",
    "lease",
    "limits",
    "rate_hz",
    "order",
    "amiss_last_minute",
    "log_dropped",
    "program",
)


class Axis:
    """One daemon's axis.

    Attributes:
        status: as the console told it last; None where no daemon answers.
        strip: its curves.
    """

    def __init__(self, connect: Callable[[], Client], choice: Sequence[str] = ()) -> None:
        """Begin; `follow` does the work.

        Args:
            connect: makes a connection; raises PlaceError.
            choice: the axes that a page may show, this one among them; none where there is no other.
        """
        self._choice = list(choice)
        self.status: dict[str, Any] | None = None
        self.strip = Strip()
        self._connect = connect
        self._client: Client | None = None
        self._lost = "not yet connected"
        self._ring: Ring | None = None
        self._reader: RingReader | None = None
        self._info: ScreenInfo | None = None
        self._last: Record | None = None
        self._heard_s = -math.inf
        self._told_of: dict[str, Any] | None = None  # the status that `facts` was made of
        self._told = ""

    def attach(self) -> None:
        """Connect; blocks.

        Raises:
            PlaceError: there is no daemon, or one of another version.
            RefusedError: it refuses to be looked at.
        """
        client = self._connect()
        try:
            client.ask("observe")
            fields, ring = attached(client)
            self.status = client.ask("status")
        except BaseException:
            client.close()
            raise
        self._client, self._lost = client, ""
        self._ring, self._info = ring, info_of(fields, first_cause)
        self._reader, self._last = None, None

    async def follow(self) -> None:
        """Ask how the axis is, for ever."""
        while True:
            await asyncio.sleep(_STATUS_S)
            try:
                if self._client is None:
                    await asyncio.to_thread(self.attach)
                await asyncio.to_thread(self._ask)
            except (PlaceError, RefusedError, OSError) as e:
                self._leave(str(e))
                await asyncio.sleep(_AGAIN_S - _STATUS_S)

    def _ask(self) -> None:
        assert self._client is not None
        assert self._ring is not None
        if self._ring.closed:
            raise PlaceError("the daemon has ended")
        self.status = self._client.ask("status")

    def _leave(self, why: str) -> None:
        if self._client is not None:
            self._client.close()
        self._client, self.status, self._lost = None, None, why

    async def look(self, now_s: float) -> None:
        """Read what the loop has left."""
        ring, reader = self._ring, self._reader
        if ring is None:
            return
        if reader is None:
            self._heard_s = now_s
            begun = await asyncio.to_thread(_begun, ring)
            if ring is not self._ring:  # another daemon has come meanwhile
                return
            self._reader, self.strip = begun
            reader = begun[0]
        records = reader.raw()
        if records:
            self.strip.add(map(drawn, records))
            self._last, self._heard_s = unpacked(records[-1]), now_s

    def rest(self) -> None:
        """Nobody looks: the next look begins anew with what is then in the ring."""
        self._reader = None

    def picture(self, now_s: float) -> dict[str, Any]:
        """What a page shows beside the curves."""
        banner = self._banner(now_s)
        found: dict[str, Any] = {"level": _LEVELS[banner.level], "words": banner.words, "then": banner.then}
        last = self._last
        if last is None or self._info is None:
            return {**found, "state": "unknown", "faults": []}
        tick, m = last.tick, last.tick.measurement
        return {
            **found,
            "state": state_name(tick.state),
            "faults": [[name, _LEVELS[level]] for name, level in faults_of(last, self._info)],
            "in_position": bool(tick.in_position),
            "saturated": bool(tick.command.saturated),
            "position_mm": _known(tick.estimate.position_m * 1e3, 3),
            "velocity_mm_s": _known(tick.estimate.velocity_m_s * 1e3, 1),
            "reference_mm": _known(tick.reference.position_m * 1e3, 3),
            "error_mm": _known(tick.error_m * 1e3, 3),
            "p1_bar": _known(m.p1_pa * 1e-5, 3),
            "p2_bar": _known(m.p2_pa * 1e-5, 3),
            "supply_bar": _known(m.supply_pa * 1e-5, 3),
            "command_v": _known(tick.command.voltage_v, 3),
        }

    def _banner(self, now_s: float) -> Banner:
        if self._lost or self._info is None:
            return Banner(Level.BAD, f"no daemon to be seen: {self._lost}", "it is looked for again", ())
        return banner_of(self._last, self._info, now_s - self._heard_s)

    def facts(self) -> str:
        """What of the status a page is told, made once for all of them; nothing where there is none."""
        status = self.status
        if status is None:
            return ""
        if status is not self._told_of:
            done = mileage.in_words(status["mileage"])
            told = {**{key: status.get(key) for key in _KEPT}, "done": done, "choice": self._choice}
            self._told_of, self._told = status, json.dumps({"status": told}, separators=(",", ":"))
        return self._told

    def close(self) -> None:
        """Hang up."""
        with contextlib.suppress(OSError):
            self._leave("")


def statuses_of(axes: Iterable[Axis]) -> list[Mapping[str, Any]]:
    """For metrics, with what this process has used."""
    return with_own([axis.status for axis in axes if axis.status is not None], "web")


def _begun(ring: Ring) -> tuple[RingReader, Strip]:
    """A reader, and what the ring has of the past; that is a thousand times what a look finds."""
    reader, strip = ring.reader(), Strip()
    for _ in range(2):  # the first one only finds out what is complete
        strip.add(map(drawn, reader.raw()))
        time.sleep(_COMPLETE_S)
    return reader, strip


def _known(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None
