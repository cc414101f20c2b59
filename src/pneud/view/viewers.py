"""The run as it goes, for Foxglove, Lichtblick and whoever speaks their WebSocket protocol.

The same topics and schemas as in the log, but for the snapshots of the axis; ticks have what follows from
their fields behind them. Of several axes each topic begins with the axis's name, as in /x/axis/tick. A
process of its own reads the rings and serves; it packs only what somebody has subscribed to. Clients may look
at everything and change nothing.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

from pneud import crew
from pneud.log.format.derived import Deriver
from pneud.log.format.events import EventSource
from pneud.log.format.frames import FramesPacker
from pneud.log.format.header import LogHeader
from pneud.log.format.records import Packer, pack_event
from pneud.log.format.schema import EVENTS, FRAMES, TICK, topics
from pneud.signals import Record
from pneud.view.admission import Admission
from pneud.view.relay import be_alone, start_relay

POLL_S = 0.02
_NICE = 5
TOPICS = (TICK, FRAMES, EVENTS)
_BACKLOG = 8192  # messages for a client that is slow; then the oldest go


class Listener:
    """What clients ask for; called by threads of the server."""

    def __init__(self, parameters: Mapping[str, Any], make: Callable[[str, Any], Any]) -> None:
        self._parameters = {name: make(name, value) for name, value in parameters.items()}
        self._wanted: dict[tuple[int, int], str] = {}
        self.topics: frozenset[str] = frozenset()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody wants a topic."""
        self._wanted[client.id, channel.id] = channel.topic
        self.topics = frozenset(self._wanted.values())

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Somebody wants it no longer, or is gone."""
        self._wanted.pop((client.id, channel.id), None)
        self.topics = frozenset(self._wanted.values())

    def on_get_parameters(self, _client: Any, names: list[str], _request_id: str | None = None) -> list[Any]:
        """The configuration; no names ask for all of it."""
        return [p for name, p in self._parameters.items() if not names or name in names]

    def on_set_parameters(self, client: Any, wanted: list[Any], request_id: str | None = None) -> list[Any]:
        """Nothing changes: the answer is what holds."""
        return self.on_get_parameters(client, [p.name for p in wanted], request_id)

    def on_parameters_subscribe(self, _names: list[str]) -> None:
        """They never change."""

    def on_parameters_unsubscribe(self, _names: list[str]) -> None:
        """They never change."""


class Source(NamedTuple):
    """An axis that viewers look at."""

    poll: Callable[[], list[Record]]  # all records since the last call
    header: LogHeader
    parameters: Mapping[str, Any]  # its configuration, by dotted keys
    name: str = ""  # where there are several

    @property
    def above(self) -> str:
        """What its topics begin with."""
        return f"/{self.name}" if self.name else ""


class _Publisher:
    def __init__(self, source: Source, context: Any, foxglove: Any) -> None:
        header, above = source.header, source.above
        self._poll = source.poll
        self._tick, self._frame, self._event = (above + topic for topic in TOPICS)
        self._packer = Packer(header.detail)
        self._deriver = Deriver(header.fault_names)
        self._frames = FramesPacker()
        self._events = EventSource(header.fault_names, header.realtime_offset_ns, *header.switches)
        self._offset_ns = header.realtime_offset_ns
        self._channels = {
            above + topic: foxglove.Channel(
                above + topic,
                schema=foxglove.Schema(name=schema, encoding="protobuf", data=descriptors),
                message_encoding="protobuf",
                context=context,
            )
            for topic, schema, descriptors, *_ in topics(header.detail, derived=True)
            if topic in TOPICS
        }

    def publish(self, wanted: frozenset[str]) -> None:
        records = self._poll()
        for record in records:
            if self._tick in wanted:
                log_time_ns = record.tick.t_ns + self._offset_ns
                packed = self._packer.tick(record) + self._deriver.behind(record)
                self._channels[self._tick].log(packed, log_time=log_time_ns)
            if self._frame in wanted:
                self._frames.add(record)
            for event in self._events.after(record):  # which has to see every record
                if self._event in wanted:
                    self._channels[self._event].log(pack_event(event), log_time=event.log_time_ns)
        if len(self._frames):
            first_ns = records[0].tick.t_ns + self._offset_ns
            self._channels[self._frame].log(self._frames.take(), log_time=first_ns)


def serve(
    sources: Sequence[Source],
    name: str,
    listener: socket.socket,
    admission: Admission,
    stop: Callable[[], bool],
) -> None:
    """Serve as the whole life of a forked process, until told to stop."""
    leaving = crew.asked_to_leave(signal.SIGTERM, signal.SIGHUP)
    os.nice(_NICE)
    if not be_alone():
        print("pneud: --live: users of this machine can look without being asked", file=sys.stderr)
    import foxglove  # noqa: PLC0415  (an extra, loaded beside the loop's own start)
    from foxglove.websocket import Capability, Parameter  # noqa: PLC0415

    foxglove.set_log_level("CRITICAL")  # a client that goes is no event
    parameters = {
        f"{source.name}.{key}" if source.name else key: value
        for source in sources
        for key, value in source.parameters.items()
    }
    watchers = Listener(parameters, lambda name, value: Parameter(name, value=value))
    context = foxglove.Context()
    publishers = [_Publisher(source, context, foxglove) for source in sources]
    try:
        server = foxglove.start_server(
            name=f"pneud {name}",
            host="127.0.0.1",
            port=0,
            capabilities=[Capability.Parameters],
            server_listener=cast(Any, watchers),
            context=context,
            message_backlog_size=_BACKLOG,
        )
    except Exception as e:
        print(f"pneud: --live: cannot serve: {e}", file=sys.stderr)
        return
    start_relay(listener, admission, server.port)
    try:
        while not leaving() and not stop():
            wanted = watchers.topics
            for publisher in publishers:
                publisher.publish(wanted)
            time.sleep(POLL_S)
    finally:
        server.stop()
