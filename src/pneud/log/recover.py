"""Mends a log that was cut short: every whole chunk goes into a new file with index and footer."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from pneud.log.files import LogError, create_log
from pneud.log.framing import DamageError, Message, attachment, chunk_items, metadata, open_mcap, pieces
from pneud.log.writer import CHUNK_BYTES


class RecoverReport(NamedTuple):
    """What was saved."""

    messages: int
    chunks: int
    damaged_chunks: int  # left out
    damage: str  # where and why reading ended; empty if the source is whole


def recover(src: Path, dst: Path) -> RecoverReport:
    """Write what can be read of a log into a new one.

    Args:
        src: the log, whole or not.
        dst: the new file.

    Raises:
        LogError: the source is no MCAP file, or the new file exists or cannot be written.
    """
    with open_mcap(src) as source:
        descriptor = create_log(dst)
        try:
            with os.fdopen(descriptor, "wb") as target:
                rescue = _Rescue(Writer(target, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD))
                report = rescue.run(source)
                target.flush()
                os.fsync(target.fileno())
        except OSError as e:
            with contextlib.suppress(OSError):
                dst.unlink()
            raise LogError(f"{dst}: cannot be written: {e.strerror}") from None
    return report


class _Rescue:
    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[int, int] = {}
        self._channels: dict[int, int] = {}
        self._messages = 0

    def run(self, source: IO[bytes]) -> RecoverReport:
        chunks = damaged = 0
        damage = ""
        self._writer.start(library="pneud recover")
        try:
            for piece in pieces(source):
                try:
                    if piece.opcode == Opcode.CHUNK:
                        self._chunk(chunk_items(piece))
                        chunks += 1
                    elif piece.opcode == Opcode.ATTACHMENT:
                        a = attachment(piece)
                        self._writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
                    elif piece.opcode == Opcode.METADATA:
                        m = metadata(piece)
                        self._writer.add_metadata(m.name, m.metadata)
                except DamageError as e:
                    damaged += piece.opcode == Opcode.CHUNK
                    damage = damage or str(e)
        except DamageError as e:
            damage = damage or str(e)
        self._writer.finish()  # type: ignore[no-untyped-call]
        return RecoverReport(self._messages, chunks, damaged, damage)

    def _chunk(self, items: list[Schema | Channel | Message]) -> None:
        w = self._writer
        for item in items:
            if isinstance(item, Message):
                channel = self._channels.get(item.channel)
                if channel is not None:
                    w.add_message(channel, item.log_time_ns, item.data, item.publish_time_ns, item.sequence)
                    self._messages += 1
            elif isinstance(item, Schema):
                if item.id not in self._schemas:
                    self._schemas[item.id] = w.register_schema(item.name, item.encoding, item.data)
            elif item.id not in self._channels:
                schema = self._schemas.get(item.schema_id, 0)
                self._channels[item.id] = w.register_channel(
                    item.topic, item.message_encoding, schema, item.metadata
                )
