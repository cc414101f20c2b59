"""Reads a log as a stream, as far as it can be read, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from pneud.log.files import LogError
from pneud.log.framing import (
    CutShortError,
    DamageError,
    Message,
    Piece,
    attachment,
    chunk_items,
    metadata,
    open_mcap,
    pieces,
)
from pneud.log.records import LoggedEvent, LoggedTick, unpack, unpack_event
from pneud.log.schema import EVENTS, FRAMES, METADATA, SCHEMA, SETUP, TICK, TIMING


class RawTick(NamedTuple):
    """The messages of one tick, as they stand in the log."""

    number: int  # counts the records of the loop from 1; a gap is where records were dropped
    log_time_ns: int  # Unix
    schema: str  # name of the tick's message, which tells the level of detail
    tick: bytes
    frames: bytes
    timing: bytes


class LogReader:
    """One log; every iteration begins anew at its start.

    Attributes:
        path: the file.
        metadata: what the log says about its run: schema, bus, rate_hz, versions, fingerprint, …
        setup: the report of the real-time set-up; empty if there was none.
        config_name: name of the attached configuration.
        config_text: its text.
        dbc_name: name of the attached DBC.
        dbc: its bytes.
        truncated: after an iteration: the file ends too early or goes on damaged.
        damage: after an iteration: where and why; empty if the file is whole.
        missing: after an iteration: records of the loop that are not in the file, before its last one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, str] = {}
        self.setup: dict[str, str] = {}
        self.config_name = ""
        self.config_text = ""
        self.dbc_name = ""
        self.dbc = b""
        self.truncated = False
        self.damage = ""
        self.missing = 0
        self._read_head()

    @property
    def rate_hz(self) -> float:
        """Ticks per second."""
        return float(self.metadata["rate_hz"])

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Names of the faults by bit number."""
        return tuple(name for name in self.metadata["faults"].split(",") if name)

    def __iter__(self) -> Iterator[LoggedTick]:
        """The ticks in their order. `truncated`, `damage` and `missing` are valid when it ends."""
        for raw in self.raw():
            if isinstance(raw, LoggedEvent):
                continue
            try:
                tick = unpack(*raw)
            except (DecodeError, KeyError, ValueError) as e:
                self.damaged_at(raw.number, e)
                return
            yield tick

    def raw(self) -> Iterator[RawTick | LoggedEvent]:
        """Ticks as bytes, and events, in the order of the file; otherwise as an iteration over the ticks."""
        self.missing = 0
        waiting: dict[str, bytes] = {}
        current, last = -1, 0
        for topic, schema, message in self._messages():
            if topic == EVENTS:
                try:
                    event = unpack_event(message.log_time_ns, message.data)
                except (DecodeError, ValueError) as e:
                    self._damaged(f"damaged in an event: {e}")
                    return
                yield event
                continue
            if message.sequence != current:
                current = message.sequence
                waiting = {}
            waiting[topic] = message.data
            if topic == TICK:
                tick_schema = schema
            if len(waiting) < 3:
                continue
            try:
                raw = RawTick(
                    current, message.log_time_ns, tick_schema, waiting[TICK], waiting[FRAMES], waiting[TIMING]
                )
            except KeyError as e:
                self.damaged_at(current, e)
                return
            self.missing += max(0, current - last - 1)
            last = current
            waiting = {}
            yield raw

    def damaged_at(self, number: int, why: Exception) -> None:
        """Note that a record cannot be decoded."""
        self._damaged(f"damaged in record {number}: {why}")

    def events(self) -> Iterator[LoggedEvent]:
        """What happened, in words."""
        for raw in self.raw():
            if isinstance(raw, LoggedEvent):
                yield raw

    def _damaged(self, words: str) -> None:
        self.truncated = True
        self.damage = words

    def _messages(self) -> Iterator[tuple[str, str, Message]]:
        """Topic, schema and message; ends at the first place that cannot be read."""
        self.truncated = False
        self.damage = ""
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        with open_mcap(self.path) as file:
            try:
                for piece in pieces(file):
                    if piece.opcode != Opcode.CHUNK:
                        continue
                    for item in chunk_items(piece):
                        if isinstance(item, Message):
                            channel = channels.get(item.channel)
                            if channel is not None:
                                yield *channel, item
                        elif isinstance(item, Schema):
                            schemas[item.id] = item.name
                        elif isinstance(item, Channel) and item.schema_id in schemas:
                            channels[item.id] = (item.topic, schemas[item.schema_id])
            except DamageError as e:
                self._damaged(str(e))

    def _read_head(self) -> None:
        attachments: dict[str, bytes] = {}
        with open_mcap(self.path) as file:
            try:
                for piece in pieces(file, skip_chunks=True):
                    # Another tool may have moved the head behind the chunks: look on until it is there.
                    if piece.opcode in (Opcode.CHUNK, Opcode.DATA_END) and self.metadata:
                        break
                    self._head_piece(piece, attachments)
            except CutShortError as e:
                if not self.metadata:
                    raise LogError(f"{self.path}: {e}, before anything was logged") from None
            except DamageError as e:
                if not self.metadata:
                    raise LogError(f"{self.path}: {e}") from None
        self._check_head(attachments)

    def _head_piece(self, piece: Piece, attachments: dict[str, bytes]) -> None:
        if piece.opcode == Opcode.ATTACHMENT:
            attached = attachment(piece)
            attachments[attached.name] = attached.data
        elif piece.opcode == Opcode.METADATA:
            found = metadata(piece)
            if found.name == METADATA:
                self.metadata = found.metadata
            elif found.name == SETUP:
                self.setup = found.metadata

    def _check_head(self, attachments: dict[str, bytes]) -> None:
        m = self.metadata
        if not m:
            raise LogError(f"{self.path}: is an MCAP file, but no log of pneud")
        if m.get("schema") != str(SCHEMA):
            raise LogError(
                f"{self.path}: has log schema {m.get('schema')}, this pneud reads {SCHEMA};"
                f" use the version that wrote it ({m.get('pneud', 'unknown')})"
            )
        try:
            self.config_name, self.dbc_name = m["config"], m["dbc"]
            self.config_text = attachments[self.config_name].decode()
            self.dbc = attachments[self.dbc_name]
            float(m["rate_hz"]), m["faults"]
        except (KeyError, ValueError) as e:
            raise LogError(f"{self.path}: its head is incomplete: {e}") from None


def read_log(path: str | Path) -> LogReader:
    """Open a log.

    Raises:
        LogError: no such file, not a log of pneud, or of another schema.
    """
    return LogReader(Path(path))
