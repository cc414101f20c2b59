"""Mends a log that was cut short or damaged: every whole chunk goes into a new file with index and footer.

What stands in one place of a log only would be lost with it: the head is repeated at the end of a log, and
what its first chunk defines is known of every log of this schema. Messages that another program has written
without chunks are saved one by one.
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer

from pneud.log.files.naming import new_log
from pneud.log.files.part import CONFIG_TEXT, CRC, DBC, check_intact, checked
from pneud.log.files.writer import CHUNK_BYTES
from pneud.log.format import framing
from pneud.log.format.frames import FrameBlock
from pneud.log.format.framing import DamageError, LoggedMessage, Piece, attachment, items, metadata, open_mcap
from pneud.log.format.meanings import READABLE
from pneud.log.format.schema import COPY, FRAMES, METADATA, TICK, Topic, topics

_COMPRESSION = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")  # in a chunk's head
_COMPRESSION_BYTES = 8
_COMPRESSION_AT = 9 + 8 + 8 + 8 + 4  # from the chunk's beginning
_SEARCHED_BYTES = 1 << 20
_LAST_SEQUENCE = (1 << 32) - 1  # of MCAP's messages
_MOST_TICKS = 1 << 16  # that may wait for one message of frames
_ASSUMED = 1 << 16  # schemas numbered from here on are ours; MCAP's numbers end below


class RecoverReport(NamedTuple):
    """What was saved."""

    messages: int
    ticks: int  # among them, with their frames
    chunks: int
    damaged_chunks: int  # left out
    parted: int  # ticks whose frames are lost, and frames of ticks that are: left out
    damage: str  # the first place that could not be read, and why; empty if the source is whole


def recover(src: Path, dst: Path, read: Callable[[int], None] = lambda _: None) -> RecoverReport:
    """Write what can be read of a log into a new one.

    Args:
        src: the log.
        dst: the new one.
        read: told how many bytes of it have been read, now and then.

    Raises:
        LogError: the source is no MCAP file, or the new file exists.
        OSError: it cannot be written.
    """
    with (
        open_mcap(src, damaged=True) as source,
        new_log(dst) as descriptor,
        os.fdopen(descriptor, "wb") as target,
    ):
        writer = Writer(target, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        return _Rescue(writer).run(source, read)


class _Channels:
    """The channels of the source, and those of the new file that stand for them."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._written: dict[tuple[str, str, str], int] = {}  # by topic, encoding and name of the schema

    def learn(self, item: Schema | Channel) -> None:
        """Take a definition; a later one counts."""
        if isinstance(item, Schema):
            self._schemas[item.id] = item
        else:
            self._channels[item.id] = item

    def assume(self, number: int, topic: Topic) -> None:
        """Know a channel before it is defined, and though its definition may be lost."""
        if number not in self._channels:
            schema = _ASSUMED + number
            self.learn(Schema(schema, topic.descriptors, topic.schema_encoding, topic.schema))
            self.learn(Channel(number, topic.topic, topic.encoding, {}, schema))
        self.number(number)

    def topic(self, source: int) -> str:
        """What the source's channel is about."""
        return self._channels[source].topic

    def number(self, source: int) -> int | None:
        """The channel of the new file; None where the source's was never defined."""
        channel = self._channels.get(source)
        if channel is None:
            return None
        schema = self._schemas.get(channel.schema_id)
        key = channel.topic, channel.message_encoding, "" if schema is None else schema.name
        if key not in self._written:
            w = self._writer
            of = 0 if schema is None else w.register_schema(schema.name, schema.encoding, schema.data)
            self._written[key] = w.register_channel(
                channel.topic, channel.message_encoding, of, channel.metadata
            )
        return self._written[key]


class _Rescue:
    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels = _Channels(writer)
        self._messages = 0
        self._saved_ticks = 0
        self._strangers = 0
        self._ticks: dict[int, tuple[int, LoggedMessage]] = {}  # by number, whose frames are still to come
        self._parted = 0
        self._promised = 0
        self._damage = ""
        self._damaged_chunks = 0
        self._attachments: dict[str, Attachment] = {}
        self._metadata: list[Metadata] = []

    def run(self, source: IO[bytes], read: Callable[[int], None]) -> RecoverReport:
        self._writer.start(library="pneud recover")
        self._read_head(source)
        for a in self._attachments.values():
            self._writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        for m in self._metadata:
            self._writer.add_metadata(m.name, m.metadata)
        self._define()
        source.seek(len(framing.MAGIC))
        chunks = 0
        for piece in self._pieces(source):
            read(piece.offset)
            if piece.opcode == Opcode.DATA_END:
                break
            try:
                found = items(piece)
            except DamageError as e:
                self._damaged_chunks += piece.opcode == Opcode.CHUNK
                self._damage = self._damage or str(e)
                continue
            self._save(found)
            chunks += piece.opcode == Opcode.CHUNK
        self._writer.finish()  # type: ignore[no-untyped-call]
        if self._strangers:
            self._damage = (
                self._damage or f"{self._strangers} messages are of channels that are nowhere defined"
            )
        lost = self._promised - self._messages
        if lost > 0:
            self._damage = self._damage or f"{lost} of {self._promised} messages are not there"
        parted = self._parted + len(self._ticks)
        return RecoverReport(
            self._messages, self._saved_ticks, chunks, self._damaged_chunks, parted, self._damage
        )

    def _pieces(self, source: IO[bytes], *, skip_chunks: bool = False) -> Iterator[Piece]:
        """The records, going on at the next chunk where one makes no sense."""
        while True:
            last = source.tell() + 1
            try:
                for piece in framing.pieces(source, skip_chunks=skip_chunks):
                    if piece.opcode in framing.KNOWN:  # another may be the first of what makes no sense
                        last = piece.offset + 1
                    yield piece
                return
            except DamageError as e:
                self._damage = self._damage or str(e)
            following = _next_chunk(source, last)
            if following is None:
                return
            source.seek(following)

    def _read_head(self, source: IO[bytes]) -> None:
        """Attachments and metadata, or what the copy of them at the end says."""
        copy: dict[str, str] = {}
        source.seek(len(framing.MAGIC))
        for piece in self._pieces(source, skip_chunks=True):
            try:
                if piece.opcode == Opcode.ATTACHMENT:
                    a = attachment(piece)
                    self._attachments[a.name] = a
                elif piece.opcode == Opcode.METADATA:
                    m = metadata(piece)
                    check_intact(m, piece.offset)
                    if m.name == COPY:
                        copy = m.metadata
                    else:
                        self._metadata.append(m)
                elif piece.opcode == Opcode.STATISTICS:
                    self._promised = framing.message_count(piece)
                elif piece.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):  # the index repeats them
                    for item in items(piece):
                        if not isinstance(item, LoggedMessage):
                            self._channels.learn(item)
            except DamageError as e:
                self._damage = self._damage or str(e)
        if copy:
            try:
                self._complete(copy)
            except (KeyError, ValueError):
                self._damage = self._damage or "the copy of the head is incomplete"

    def _complete(self, copy: dict[str, str]) -> None:
        head = {k: v for k, v in copy.items() if k not in (CONFIG_TEXT, DBC, CRC)}
        if not any(m.name == METADATA for m in self._metadata):
            self._metadata.insert(0, Metadata(METADATA, checked(head)))
        config, dbc = head["config"], head["dbc"]
        for name, kind, data in (
            (config, "application/toml", copy[CONFIG_TEXT].encode()),
            (dbc, "application/vnd.can-dbc", base64.b64decode(copy[DBC])),
        ):
            if name not in self._attachments:
                self._attachments[name] = Attachment(0, 0, name, kind, data)

    def _define(self) -> None:
        """Know the channels of a log of this schema before its first chunk is read; they number from 1."""
        head: dict[str, Any] = next((m.metadata for m in self._metadata if m.name == METADATA), {})
        detail = head.get("detail")
        if head.get("schema") not in READABLE or detail not in ("compact", "full"):
            return
        for number, t in enumerate(topics(detail), start=1):
            self._channels.assume(number, t)

    def _save(self, found: list[Schema | Channel | LoggedMessage]) -> None:
        for item in found:
            if not isinstance(item, LoggedMessage):
                self._channels.learn(item)
                continue
            channel = self._channels.number(item.channel)
            if channel is None:
                self._strangers += 1
                continue
            topic = self._channels.topic(item.channel)
            if topic == TICK:
                self._ticks[item.sequence] = channel, item
                if len(self._ticks) > _MOST_TICKS:
                    del self._ticks[next(iter(self._ticks))]
                    self._parted += 1
            elif topic != FRAMES:
                self._write(channel, item)
            elif ticks := self._ticks_of(item):
                for its_channel, tick in ticks:
                    self._write(its_channel, tick)
                self._saved_ticks += len(ticks)
                self._write(channel, item)

    def _ticks_of(self, frames: LoggedMessage) -> list[tuple[int, LoggedMessage]]:
        """The ticks that frames belong to; none where one of them is lost, so that all of them are."""
        try:
            numbers = range(frames.sequence, frames.sequence + FrameBlock(frames.data).count)
        except (DecodeError, ValueError):
            numbers = range(0)
        found = [self._ticks.pop(number & _LAST_SEQUENCE, None) for number in numbers]
        ticks = [tick for tick in found if tick is not None]
        if ticks and len(ticks) == len(found):
            return ticks
        self._parted += len(ticks) + 1
        return []

    def _write(self, channel: int, item: LoggedMessage) -> None:
        self._writer.add_message(channel, item.log_time_ns, item.data, item.publish_time_ns, item.sequence)
        self._messages += 1


def _next_chunk(file: IO[bytes], start: int) -> int | None:
    """Where the next chunk seems to begin, by the name of its compression; None if there is no other."""
    at = start + _COMPRESSION_AT
    while True:
        file.seek(at)
        block = file.read(_SEARCHED_BYTES)
        named = _COMPRESSION.search(block)
        if named is not None:
            place = named.start()
            found = at + place - _COMPRESSION_AT
            file.seek(found)
            if file.read(1)[0] == Opcode.CHUNK:
                return found
            at += place + 1
        elif len(block) < _SEARCHED_BYTES:
            return None
        else:
            at += len(block) - _COMPRESSION_BYTES + 1
