"""Logs as other programs write them anew: without chunks, otherwise compressed, with records of their own."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

PRIVATE = bytes((0x80,)) + struct.pack("<Q", 5) + b"mine!"
LATER = bytes((0x42,)) + struct.pack("<Q", 300) + bytes(300)  # an opcode that MCAP has not given out yet


def rewrite(
    source: Path,
    target: Path,
    *,
    chunked: bool = True,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_bytes: int = 20_000,
    head_last: bool = False,
    index: bool = True,
    strange: bool = False,
    seed: int = 0,
    key: Callable[[str, Any], Any] | None = None,
) -> None:
    """Write a log anew.

    Args:
        source: one of pneud's.
        target: the other file.
        chunked: gather messages in chunks.
        compression: of the chunks.
        chunk_bytes: their size.
        head_last: metadata and attachments come behind the messages.
        index: have one, with statistics and definitions repeated.
        strange: unknown and private records stand between all others.
        seed: order in which channels are numbered.
        key: of a topic's message, by which all are sorted; as they were without.
    """
    with source.open("rb") as file:
        records: list[Any] = list(StreamReader(file).records)
    kinds = [type(record).__name__ for record in records]
    head = [r for r, kind in zip(records, kinds, strict=True) if kind in ("Attachment", "Metadata")]
    body = [r for r, kind in zip(records, kinds, strict=True) if kind == "Message"]
    schemas = {r.id: r for r, kind in zip(records, kinds, strict=True) if kind == "Schema"}
    channels = {r.id: r for r, kind in zip(records, kinds, strict=True) if kind == "Channel"}
    if key is not None:
        body.sort(key=lambda m: key(channels[m.channel_id].topic, m))
    with target.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=chunk_bytes,
            compression=compression,
            use_chunking=chunked,
            index_types=IndexType.ALL if index else IndexType.NONE,
            use_statistics=index,
            repeat_channels=index,
            repeat_schemas=index,
            use_summary_offsets=index,
        )
        writer.start(library="another program")
        if not head_last:
            _add(writer, head)
        order = list(channels)
        random.Random(seed).shuffle(order)
        writer.register_schema("another.thing", "jsonschema", b"{}")
        numbers = {}
        for number in order:
            c = channels[number]
            s = schemas[c.schema_id]
            numbers[number] = writer.register_channel(
                c.topic, c.message_encoding, writer.register_schema(s.name, s.encoding, s.data)
            )
        other = writer.register_channel("/another", "json", 0)
        for m in body:
            writer.add_message(numbers[m.channel_id], m.log_time, m.data, m.publish_time, m.sequence)
            if m.sequence % 50 == 0:
                writer.add_message(other, m.log_time, b"{}", m.publish_time)
        if head_last:
            _add(writer, head)
        writer.finish()  # type: ignore[no-untyped-call]
    if strange:
        target.write_bytes(b"".join(_with_strangers(target.read_bytes())))


def _add(writer: Writer, head: list[Any]) -> None:
    for record in head:
        if type(record).__name__ == "Metadata":
            writer.add_metadata(record.name, record.metadata)
        else:
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
    writer.add_metadata("another", {"by": "another program"})
    writer.add_attachment(0, 0, "another.bin", "application/octet-stream", bytes(1000))


def _with_strangers(data: bytes) -> Iterator[bytes]:
    """With records that pneud does not know in the data section; places in the index are wrong then."""
    at = 8
    yield data[:at]
    while True:
        (length,) = struct.unpack_from("<Q", data, at + 1)
        if data[at] == Opcode.DATA_END:
            yield data[at:]
            return
        yield PRIVATE
        yield data[at : at + 9 + length]
        yield LATER
        at += 9 + length
