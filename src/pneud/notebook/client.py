"""A running daemon in the hands of a script or a notebook: one that blocks, and one to await.

What the daemon refuses is a `RefusedError` with the console's own words; where there is no daemon to talk to,
a `PlaceError`. Both clients stop at the end of their `with` block what they have set going.
"""

from __future__ import annotations

import asyncio
import threading
import time
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from pneud.console.attached import attached
from pneud.console.client import Client as Connection
from pneud.console.client import RefusedError
from pneud.console.endpoint import PlaceError
from pneud.log.format.events import EventSource
from pneud.log.format.records import LoggedEvent
from pneud.log.live.ring import RingReader
from pneud.notebook import html, steps
from pneud.notebook.steps import Ask, Dialogue, Pause, Samples

T = TypeVar("T")
_MOVING = ("arm", "goto", "force", "jog", "track", "home")
_LOOK_S = 0.002  # what the loop is writing is complete at the next look
_SHOWN = ("state", "position_mm", "reference_mm", "error_mm", "in_position", "command_v", "bus", "log")


class Status(dict[str, Any]):
    """How the axis is: the fields of `pneud status --json`."""

    def _repr_html_(self) -> str:
        rows = {key: self.get(key) for key in _SHOWN}
        faults = ", ".join(fault["name"] for fault in self.get("faults", ())) or "none"
        return html.facts(str(self.get("name", "axis")), {**rows, "faults": faults})


class _Events:
    """What happens, in words, from the records that the loop leaves in memory."""

    def __init__(self, connection: Connection) -> None:
        fields, ring = attached(connection)
        self._reader: RingReader = ring.reader()
        self._source = EventSource(
            tuple(fields["faults"]),
            time.time_ns() - time.monotonic_ns(),
            fields.get("inputs", ()),
            fields.get("outputs", ()),
        )

    def take(self) -> list[LoggedEvent]:
        records = self._reader.poll()
        time.sleep(_LOOK_S)
        records += self._reader.poll()
        return [event for record in records for event in self._source.after(record)]


class _Base:
    """The connection, and what both kinds of clients have to know of it."""

    def __init__(self, socket: str | Path | None = None, axis: str | None = None) -> None:
        """Connect to a daemon: by its socket, else to the one that runs.

        Args:
            socket: of the daemon.
            axis: that all calls are for, where it has several.

        Raises:
            PlaceError: there is none, there are several, or it may not be talked to.
        """
        self._connection = Connection(None if socket is None else str(socket), axis)
        self._at_end = "stop" if axis is None else "hold"  # a stop is for all axes
        self._lock = threading.Lock()  # a stop may come while another call waits
        self._events: _Events | None = None
        self._moves = False  # something was set going

    def close(self) -> None:
        """Hang up; what is under way goes on, but for a jog."""
        self._connection.close()

    def _ask(self, ask: Ask) -> dict[str, Any]:
        with self._lock:
            reply = self._connection.ask(ask.verb, **ask.fields)
        self._moves = self._moves or ask.verb in _MOVING
        return reply

    def _happened(self) -> list[LoggedEvent]:
        with self._lock:
            if self._events is None:
                self._events = _Events(self._connection)
            return self._events.take()

    def _stopped(self) -> None:
        """Stop what this client has set going, and hang up."""
        try:
            if self._moves:
                with suppress(RefusedError, PlaceError):  # it does not move, or the daemon has gone
                    self._ask(Ask(self._at_end, {}))
        finally:
            self.close()


def _warn(found: tuple[dict[str, Any], list[str]]) -> dict[str, Any]:
    gains, doubts = found
    for doubt in doubts:
        warnings.warn(doubt, stacklevel=3)
    return gains


class Client(_Base):
    """A client whose calls come back when what they ask for is done.

    Lengths are millimetres in the stroke coordinate, as with the commands of the shell.

    Examples:
        >>> with pneud.Client() as axis:  # stops at its end
        ...     arrived = axis.goto(480.0, tolerance_mm=0.5)
        >>> abs(arrived["position_mm"] - 480.0) < 0.5
        True
    """

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped()

    def _run(self, dialogue: Dialogue[T]) -> T:
        try:
            step = next(dialogue)
            while True:
                if isinstance(step, Pause):
                    time.sleep(step.s)
                    step = dialogue.send(None)
                    continue
                try:
                    reply = self._ask(step)
                except (RefusedError, PlaceError) as e:
                    step = dialogue.throw(e)
                else:
                    step = dialogue.send(reply)
        except StopIteration as end:
            found: T = end.value
            return found

    def status(self) -> Status:
        """How the axis is.

        Examples:
            >>> axis.status()["name"]
            'virtual'
        """
        return Status(self._run(steps.asked("status")))

    def events(self) -> list[LoggedEvent]:
        """What has happened since the last call; at the first one, in the last seconds.

        Examples:
            >>> {event.name for event in axis.events()} >= {"state"}
            True

        Raises:
            PlaceError: the daemon is of another version.
        """
        return self._happened()

    def arm(self, *, unproven: bool = False) -> str:
        """Engage and hold, and the state then.

        Args:
            unproven: also without a movement test that was passed, for this run.

        Examples:
            >>> axis.arm()
            'holding'
        """
        return str(self._run(steps.asked("arm", unproven=unproven or None))["state"])

    def disarm(self) -> str:
        """Stop, then centre the valve.

        Examples:
            >>> axis.disarm()
            'stopping'
        """
        return self._plain("disarm")

    def stop(self) -> str:
        """Stop now; whoever else commands, and whatever waits.

        Examples:
            >>> axis.stop()
            'stopping'
        """
        return self._plain("stop")

    def hold(self) -> str:
        """Come to rest and hold.

        Examples:
            >>> axis.hold() in ("moving", "holding")
            True
        """
        return self._plain("hold")

    def home(self) -> str:
        """Find the zero of an incremental encoder."""
        return self._plain("home")

    def clear(self) -> str:
        """Clear what is latched, once its cause is gone."""
        return self._plain("clear")

    def _plain(self, verb: str) -> str:
        return str(self._run(steps.asked(verb))["state"])

    def mark(self, text: str) -> None:
        """Leave a remark in the log.

        Examples:
            >>> axis.mark("begins")
        """
        self._run(steps.asked("mark", text=text))

    def goto(
        self,
        x_mm: float,
        *,
        wait: bool = True,
        tolerance_mm: float | None = None,
        timeout_s: float | None = None,
        speed_mm_s: float | None = None,
        acceleration_mm_s2: float | None = None,
        jerk_mm_s3: float | None = None,
    ) -> Status:
        """Go to a position, and wait until the load is there.

        Args:
            x_mm: where.
            wait: come back when the load is in position; else when the way has begun.
            tolerance_mm: of the error; None for the configured tolerances.
            timeout_s: from now; None for some seconds from the end of the way.
            speed_mm_s: at most; None for the configured bound, as below.
            acceleration_mm_s2: at most.
            jerk_mm_s3: at most.

        Returns:
            How the axis is then; without `wait`, the reply to the order.

        Examples:
            >>> axis.goto(450.0, speed_mm_s=100.0)["in_position"]
            True

        Raises:
            RefusedError: it may not go there (`kind` is `out_of_travel`, …) or does not come there (`fault`,
                `replaced`, `stopped`, `gone`, `timeout`).
        """
        bounds = {
            "speed_mm_s": speed_mm_s,
            "acceleration_mm_s2": acceleration_mm_s2,
            "jerk_mm_s3": jerk_mm_s3,
        }
        return Status(self._run(steps.goto(x_mm, wait, tolerance_mm, timeout_s, **bounds)))

    def force(
        self,
        force_n: float,
        *,
        wait: bool = True,
        rate_n_s: float | None = None,
        between_mm: tuple[float, float] | None = None,
        speed_mm_s: float | None = None,
        timeout_s: float | None = None,
    ) -> Status:
        """Press with a force of the piston, and wait until it is there.

        Args:
            force_n: on the load; positive outwards.
            wait: come back when the force is within its tolerance; else when the ramp has begun.
            rate_n_s: of the ramp; None for the configured one, as below.
            between_mm: window of the travel; None for all of it.
            speed_mm_s: at most.
            timeout_s: to have reached the force; the axis stops after it.

        Returns:
            How the axis is then; without `wait`, the reply to the order.

        Examples:
            >>> pressed = axis.force(15.0, between_mm=(400.0, 600.0))  # which friction bears
            >>> pressed["state"], abs(pressed["force_n"] - 15.0) < 3.0
            ('pressing', True)

        Raises:
            RefusedError: it may not press so (`kind` is `beyond_limits`, …) or the force does not come
                (`fault`, `replaced`, `stopped`, `gone`).
        """
        bounds = {"rate_n_s": rate_n_s, "speed_mm_s": speed_mm_s, "timeout_s": timeout_s}
        return Status(self._run(steps.force(force_n, wait, between_mm, **bounds)))

    def jog(self, velocity_mm_s: float, for_s: float) -> str:
        """Move at a speed for a time, then hold; should this program die, its lease runs out.

        Examples:
            >>> axis.jog(20.0, for_s=0.2) in ("moving", "holding")
            True
        """
        return str(self._run(steps.jog(velocity_mm_s, for_s))["state"])

    def track(self, what: str | Path | Samples | None = None, *, wait: bool = False) -> Status:
        """Follow the configured reference, or a profile.

        Args:
            what: times [s] and positions [mm], or a file with them; None for the configured reference.
            wait: come back at the profile's end.

        Examples:
            >>> reached = axis.track(([0.0, 0.5, 1.0], [450.0, 455.0, 450.0]), wait=True)
            >>> abs(reached["position_mm"] - 450.0) < 0.5
            True

        Raises:
            ConfigError: these are no samples.
            RefusedError: the profile is more than the axis may do, or it does not come to its end.
        """
        return Status(self._run(steps.track(what, wait)))

    def tune(self, values: Mapping[str, float | str] | None = None) -> dict[str, Any]:
        """Change gains and reference, all or none and without a step; those that run then.

        What `pneud check` would warn of is a warning here.

        Args:
            values: by the names of `pneud tune`, or by keys of the file; None to look only.

        Examples:
            >>> axis.tune({"k1": 90000.0})["k1"]
            90000.0

        Raises:
            RefusedError: the loop could not be stable with them, or there is no such value.
        """
        return _warn(self._run(steps.tune(dict(values or {}))))


class AsyncClient(_Base):
    """A client to await; a call that is under way holds nothing else up, a stop least of all.

    Examples:
        >>> async def there_and_back():
        ...     async with pneud.AsyncClient() as axis:
        ...         await axis.goto(440.0)
        ...         return await axis.goto(450.0)
        >>> asyncio.run(there_and_back())["in_position"]
        True
    """

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self._stopped)

    async def _run(self, dialogue: Dialogue[T]) -> T:
        try:
            step = next(dialogue)
            while True:
                if isinstance(step, Pause):
                    await asyncio.sleep(step.s)
                    step = dialogue.send(None)
                    continue
                try:
                    reply = await asyncio.to_thread(self._ask, step)
                except (RefusedError, PlaceError) as e:
                    step = dialogue.throw(e)
                else:
                    step = dialogue.send(reply)
        except StopIteration as end:
            found: T = end.value
            return found

    async def status(self) -> Status:
        """As `Client.status`."""
        return Status(await self._run(steps.asked("status")))

    async def events(self) -> list[LoggedEvent]:
        """As `Client.events`."""
        return await asyncio.to_thread(self._happened)

    async def arm(self, *, unproven: bool = False) -> str:
        """As `Client.arm`."""
        return str((await self._run(steps.asked("arm", unproven=unproven or None)))["state"])

    async def disarm(self) -> str:
        """As `Client.disarm`."""
        return await self._plain("disarm")

    async def stop(self) -> str:
        """As `Client.stop`."""
        return await self._plain("stop")

    async def hold(self) -> str:
        """As `Client.hold`."""
        return await self._plain("hold")

    async def home(self) -> str:
        """As `Client.home`."""
        return await self._plain("home")

    async def clear(self) -> str:
        """As `Client.clear`."""
        return await self._plain("clear")

    async def _plain(self, verb: str) -> str:
        return str((await self._run(steps.asked(verb)))["state"])

    async def mark(self, text: str) -> None:
        """As `Client.mark`."""
        await self._run(steps.asked("mark", text=text))

    async def goto(
        self,
        x_mm: float,
        *,
        wait: bool = True,
        tolerance_mm: float | None = None,
        timeout_s: float | None = None,
        **bounds: float | None,
    ) -> Status:
        """As `Client.goto`, whose other bounds are `bounds`."""
        return Status(await self._run(steps.goto(x_mm, wait, tolerance_mm, timeout_s, **bounds)))

    async def force(
        self,
        force_n: float,
        *,
        wait: bool = True,
        between_mm: tuple[float, float] | None = None,
        **bounds: float | None,
    ) -> Status:
        """As `Client.force`, whose other bounds are `bounds`."""
        return Status(await self._run(steps.force(force_n, wait, between_mm, **bounds)))

    async def jog(self, velocity_mm_s: float, for_s: float) -> str:
        """As `Client.jog`."""
        return str((await self._run(steps.jog(velocity_mm_s, for_s)))["state"])

    async def track(self, what: str | Path | Samples | None = None, *, wait: bool = False) -> Status:
        """As `Client.track`."""
        return Status(await self._run(steps.track(what, wait)))

    async def tune(self, values: Mapping[str, float | str] | None = None) -> dict[str, Any]:
        """As `Client.tune`."""
        return _warn(await self._run(steps.tune(dict(values or {}))))
