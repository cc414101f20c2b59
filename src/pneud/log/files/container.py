"""Writes the MCAP container: chunks of messages closed on demand, index and summary at the end.

The package mcap has a writer of its own; at a thousand messages a second it takes as long as all the rest of
the recording. What every tick passes through here is one `struct`; all other records are that package's.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from itertools import chain
from typing import Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from pneud.log.files.output import Output
from pneud.log.format.framing import MAGIC

_MESSAGE = struct.Struct("<BQHIQQ")
_INDEX = struct.Struct("<BQHI")
_FOOTER = struct.Struct("<BQQQ")
_FOOTER_BYTES = 8 + 8 + 4
_OPCODE_MESSAGE = int(Opcode.MESSAGE)


class Container:
    """One MCAP file that is being written.

    Attributes:
        chunk_bytes: size of the chunk that is open, uncompressed.
    """

    def __init__(self, output: Output, library: str) -> None:
        """Write the head."""
        self.chunk_bytes = 0
        self._output = output
        self._compressor = zstandard.ZstdCompressor()
        self._parts: list[bytes] = []
        self._messages: dict[int, list[tuple[int, int]]] = {}  # log time and place of each, by channel
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}
        output.write(MAGIC + _record(Header(profile="", library=library)))

    def attach(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Add an attachment."""
        record = _record(Attachment(time_ns, time_ns, name, media_type, data))
        self._attachments.append(
            AttachmentIndex(self._output.tell(), len(record), time_ns, time_ns, len(data), name, media_type)
        )
        self._output.write(record)

    def metadata(self, name: str, data: dict[str, str]) -> None:
        """Add metadata, before the chunk that is open."""
        record = _record(Metadata(name, data))
        self._metadata.append(MetadataIndex(self._output.tell(), len(record), name))
        self._output.write(record)

    def register(self, topic: str, encoding: str, schema: str, schema_encoding: str, data: bytes) -> int:
        """Define a channel with its schema, in the chunk that is open.

        Returns:
            The channel's number, from 1.
        """
        number = len(self._channels) + 1
        self._schemas.append(Schema(number, data, schema_encoding, schema))
        self._channels.append(Channel(number, topic, encoding, {}, number))
        for record in (_record(self._schemas[-1]), _record(self._channels[-1])):
            self._parts.append(record)
            self.chunk_bytes += len(record)
        return number

    def message(self, channel: int, sequence: int, log_time_ns: int, data: bytes) -> None:
        """Add a message to the chunk that is open."""
        places = self._messages.get(channel)
        if places is None:
            places = self._messages[channel] = []
        places.append((log_time_ns, self.chunk_bytes))
        size = len(data)
        head = _MESSAGE.pack(_OPCODE_MESSAGE, size + 22, channel, sequence, log_time_ns, log_time_ns)
        self._parts += (head, data)
        self.chunk_bytes += size + _MESSAGE.size

    def close_chunk(self) -> None:
        """Write the chunk, unless there is no message in it."""
        if not self._messages:
            return
        body = b"".join(self._parts)
        packed = self._compressor.compress(body)
        times = [time_ns for places in self._messages.values() for time_ns, _ in places]
        first, last = min(times), max(times)
        record = _record(
            Chunk(
                compression="zstd",
                data=packed,
                message_start_time=first,
                message_end_time=last,
                uncompressed_crc=zlib.crc32(body),
                uncompressed_size=len(body),
            )
        )
        start = self._output.tell()
        self._output.write(record)
        offsets = {}
        for channel, places in self._messages.items():
            offsets[channel] = self._output.tell()
            count = len(places)
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + 16 * count, channel, 16 * count)
            self._output.write(head + struct.pack(f"<{2 * count}Q", *chain.from_iterable(places)))
            self._counts[channel] = self._counts.get(channel, 0) + count
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=start,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=last,
                message_index_length=self._output.tell() - start - len(record),
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=len(body),
            )
        )
        self._parts, self._messages, self.chunk_bytes = [], {}, 0

    def finish(self) -> None:
        """Close the chunk, write index and footer."""
        self.close_chunk()
        self._output.write(_record(DataEnd(0)))
        start = self._output.tell()
        summary = b""
        offsets = b""
        groups: tuple[tuple[Opcode, Iterable[Any]], ...] = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        for opcode, records in groups:
            group = b"".join([_record(record) for record in records])
            if group:
                offsets += _record(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offsets_start = start + len(summary)
        summary += offsets
        crc = zlib.crc32(
            _FOOTER.pack(Opcode.FOOTER, _FOOTER_BYTES, start, offsets_start), zlib.crc32(summary)
        )
        self._output.write(summary + _record(Footer(start, offsets_start, crc)) + MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            schema_count=len(self._schemas),
        )


def _record(record: Any) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    packed: bytes = builder.end()  # type: ignore[no-untyped-call]
    return packed
