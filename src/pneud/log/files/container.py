"""An MCAP file as it is written: chunks that are closed when it is said, messages singly or by the thousand.

It holds what one of the `mcap` library's writer holds; that has no way to be given many messages at once.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any, Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
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

from pneud.log.format.framing import HEAD, MAGIC, MESSAGE, OPCODE_MESSAGE

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_MESSAGE = struct.Struct(f"{HEAD.format}{MESSAGE.format[1:]}")
MESSAGE_BYTES = _MESSAGE.size
"""Of a message's head."""
_ENTRY = struct.Struct("<QQ")  # of an index: time, and place in the chunk
_CHUNK = struct.Struct("<QQQI")  # first and last time, size and checksum of what is compressed
_COMPRESSION = "zstd"


class Output(Protocol):
    """What a file is written into."""

    def write(self, data: bytes) -> int: ...  # noqa: D102
    def tell(self) -> int: ...  # noqa: D102


def message_head(channel: int, sequence: int, time_ns: int, length: int) -> bytes:
    """What a message of a chunk begins with.

    Args:
        channel: its number.
        sequence: of the message.
        time_ns: of log and publication.
        length: bytes of what follows.
    """
    return _MESSAGE.pack(OPCODE_MESSAGE, MESSAGE.size + length, channel, sequence, time_ns, time_ns)


class Container:
    """A file with one chunk open.

    Attributes:
        chunk_bytes: size of the open chunk's messages, uncompressed.
    """

    def __init__(self, output: Output, library: str) -> None:
        """Write the head.

        Args:
            output: where the bytes go.
            library: what the head says.
        """
        self.chunk_bytes = 0
        self._output = output
        self._compressor = zstandard.ZstdCompressor()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}  # messages, by channel
        self._span: tuple[int, int] | None = None  # first and last time of all
        self._chunk = bytearray()
        self._entries: dict[int, bytearray] = {}  # of the open chunk, by channel
        self._chunk_span: tuple[int, int] | None = None
        output.write(MAGIC)
        self._put(Header(profile="", library=library))

    def _put(self, *records: Any) -> int:
        """Write records; how many bytes they took."""
        data = _bytes_of(*records)
        self._output.write(data)
        return len(data)

    def attach(self, time_ns: int, name: str, kind: str, data: bytes) -> None:
        """Add an attachment, before the chunk that is open."""
        offset = self._output.tell()
        length = self._put(Attachment(time_ns, time_ns, name, kind, data))
        self._attachments.append(AttachmentIndex(offset, length, time_ns, time_ns, len(data), name, kind))

    def metadata(self, name: str, data: dict[str, str]) -> None:
        """Add metadata, before the chunk that is open."""
        offset = self._output.tell()
        self._metadata.append(MetadataIndex(offset, self._put(Metadata(name=name, metadata=data)), name))

    def channel(
        self, topic: str, encoding: str, schema: str, schema_encoding: str, descriptors: bytes
    ) -> int:
        """Add a channel with a schema of its own to the open chunk; its number."""
        number = len(self._channels) + 1
        self._schemas.append(Schema(id=number, data=descriptors, encoding=schema_encoding, name=schema))
        self._channels.append(Channel(number, topic, encoding, {}, number))
        self._chunk += _bytes_of(self._schemas[-1], self._channels[-1])
        return number

    def message(self, channel: int, sequence: int, time_ns: int, data: bytes) -> None:
        """Add a message to the open chunk."""
        self._note(channel, _ENTRY.pack(time_ns, len(self._chunk)), 1, time_ns, time_ns)
        self._chunk += message_head(channel, sequence, time_ns, len(data)) + data
        self.chunk_bytes += MESSAGE_BYTES + len(data)

    def messages(self, channel: int, times_ns: NDArray[np.uint64], rows: NDArray[np.uint8]) -> None:
        """Add messages of one length to the open chunk.

        Args:
            channel: of all of them.
            times_ns: never falling.
            rows: a message each, with its head.
        """
        import numpy as np  # noqa: PLC0415 - the recorder does without

        count, length = rows.shape
        if not count:
            return
        entries = np.empty((count, 2), dtype="<u8")
        entries[:, 0] = times_ns
        entries[:, 1] = np.arange(
            len(self._chunk), len(self._chunk) + count * length, length, dtype=np.uint64
        )
        self._note(channel, entries.tobytes(), count, int(times_ns[0]), int(times_ns[-1]))
        self._chunk += rows.tobytes()
        self.chunk_bytes += rows.size

    def _note(self, channel: int, entries: bytes, count: int, first_ns: int, last_ns: int) -> None:
        found = self._entries.get(channel)
        if found is None:
            found = self._entries[channel] = bytearray()
        found += entries
        self._counts[channel] = self._counts.get(channel, 0) + count
        span = self._chunk_span
        self._chunk_span = (
            (first_ns, last_ns) if span is None else (min(span[0], first_ns), max(span[1], last_ns))
        )

    def close_chunk(self) -> None:
        """What comes next goes into another chunk; one without messages stays open."""
        span = self._chunk_span
        if span is None:
            return
        data = bytes(self._chunk)
        compressed = self._compressor.compress(data)
        body = _CHUNK.pack(*span, len(data), zlib.crc32(data)) + _text(_COMPRESSION)
        body += struct.pack("<Q", len(compressed)) + compressed
        begin = self._output.tell()
        self._output.write(HEAD.pack(Opcode.CHUNK, len(body)) + body)
        end = self._output.tell()
        offsets, indexes = {}, bytearray()
        for channel, entries in self._entries.items():
            offsets[channel] = end + len(indexes)
            indexes += HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries))
            indexes += struct.pack("<HI", channel, len(entries)) + entries
        self._output.write(bytes(indexes))
        self._chunks.append(
            ChunkIndex(
                chunk_length=end - begin,
                chunk_start_offset=begin,
                compression=_COMPRESSION,
                compressed_size=len(compressed),
                message_end_time=span[1],
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                message_start_time=span[0],
                uncompressed_size=len(data),
            )
        )
        whole = self._span
        self._span = span if whole is None else (min(whole[0], span[0]), max(whole[1], span[1]))
        self._chunk, self._entries, self._chunk_span, self.chunk_bytes = bytearray(), {}, None, 0

    def finish(self) -> None:
        """Close the chunk and write the index."""
        self.close_chunk()
        self._put(DataEnd(data_section_crc=0))
        begin, summary, offsets = self._output.tell(), bytearray(), []
        for opcode, records in (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ):
            group = _bytes_of(*records)
            offsets.append(SummaryOffset(opcode, begin + len(summary), len(group)))
            summary += group
        offset_begin = begin + len(summary)
        summary += _bytes_of(*offsets)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, begin, offset_begin)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._output.write(bytes(summary) + _bytes_of(Footer(begin, offset_begin, crc)) + MAGIC)

    def _statistics(self) -> Statistics:
        first_ns, last_ns = self._span or (0, 0)
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=last_ns,
            message_start_time=first_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes_of(*records: Any) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data
