"""MCAP records one by one, so read that a file which is cut short or damaged ends with a sentence."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema, Statistics

from pneud.log.files.naming import LogError
from pneud.rt.inputs import open_file

MAGIC = b"\x89MCAP0\r\n"
SPAN = struct.Struct("<QQ")  # first and last time in a chunk, with which it begins
HEAD = struct.Struct("<BQ")  # of a record: opcode and length of what follows
MESSAGE = struct.Struct("<HIQQ")  # of a message, behind that: channel, sequence, two times
MESSAGE_HEAD = HEAD.size + MESSAGE.size
_LARGEST_CHUNK = 256 * 1024 * 1024
OPCODE_MESSAGE = int(Opcode.MESSAGE)
KNOWN = frozenset(int(code) for code in Opcode)
"""Opcodes of MCAP as it is today; others are of a later one, or private to who wrote them."""
_NO_OPCODE = 0

T = TypeVar("T")

# What the decoders of MCAP and zstd raise on bytes that make no sense.
NONSENSE = (struct.error, ValueError, IndexError, KeyError, MemoryError, OverflowError, McapError)


class DamageError(Exception):
    """A place from which on a file cannot be read; the text says where and why."""


class CutShortError(DamageError):
    """The file ends where more should follow."""


class Piece(NamedTuple):
    """One record of the file."""

    offset: int
    opcode: int
    body: bytes


class LoggedMessage(NamedTuple):
    """One message of a chunk."""

    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


def open_mcap(path: Path, *, damaged: bool = False) -> IO[bytes]:
    """Open a file and read its magic.

    Args:
        path: of the file.
        damaged: a magic of which half the bytes are right will do.

    Raises:
        LogError: no such file, or none of MCAP.
    """
    try:
        file = open_file(path)
    except OSError as e:
        raise LogError(f"{path}: cannot be read: {e.strerror}") from None
    try:
        magic = file.read(len(MAGIC))
    except OSError as e:
        file.close()
        raise LogError(f"{path}: cannot be read: {e.strerror}") from None
    right = sum(a == b for a, b in zip(magic, MAGIC, strict=False))
    if right < (len(MAGIC) // 2 if damaged else len(MAGIC)):
        file.close()
        what = "is empty" if not magic else "is not an MCAP file"
        raise LogError(f"{path}: {what}; give a log that pneud wrote")
    return file


def pieces(file: IO[bytes], *, skip_chunks: bool = False) -> Iterator[Piece]:
    """The records of a file after its magic, up to and including the footer, those not `KNOWN` among them.

    Args:
        file: at the first record.
        skip_chunks: pass over the chunks without reading more of them than their first and last time.

    Raises:
        DamageError: the file goes on in a way that makes no sense; CutShortError where it ends too early.
    """
    end = os.fstat(file.fileno()).st_size
    offset = file.tell()
    while True:
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            raise CutShortError(f"cut short at byte {end}")
        opcode, length = HEAD.unpack(head)
        following = offset + HEAD.size + length
        if opcode == _NO_OPCODE:
            raise DamageError(f"damaged at byte {offset}: no record begins with {opcode}")
        if following > end:
            raise CutShortError(f"cut short at byte {end}, in a record that begins at byte {offset}")
        if skip_chunks and opcode == Opcode.CHUNK:
            span = file.read(min(length, SPAN.size))
            file.seek(following)
            yield Piece(offset, opcode, span.ljust(SPAN.size, b"\0"))
        else:
            body = file.read(length)
            if len(body) < length:
                raise CutShortError(f"cut short at byte {end}")
            yield Piece(offset, opcode, body)
        offset = following
        if opcode == Opcode.FOOTER:
            if file.read(len(MAGIC)) != MAGIC:
                raise CutShortError(f"cut short at byte {end}, after the index")
            return


def stream(body: bytes) -> ReadDataStream:
    """What the records of MCAP read themselves from."""
    return ReadDataStream(BytesIO(body))


def attachment(piece: Piece) -> Attachment:
    """An attachment, its checksum compared.

    Raises:
        DamageError: its bytes are not what was written.
    """
    (crc,) = struct.unpack("<I", piece.body[-4:]) if len(piece.body) >= 4 else (0,)
    if crc and zlib.crc32(piece.body[:-4]) != crc:
        raise DamageError(f"damaged at byte {piece.offset}: checksum of an attachment")
    source = stream(piece.body)
    try:
        attached: Attachment = Attachment.read(source)
        if source.count != len(piece.body):
            raise ValueError("another length than it says")
    except NONSENSE as e:
        raise DamageError(f"damaged at byte {piece.offset}: attachment: {e}") from None
    return attached


def metadata(piece: Piece) -> Metadata:
    """A metadata record.

    Raises:
        DamageError: its bytes make no sense.
    """
    found: Metadata = _record(piece, Metadata, "metadata")
    return found


def message_count(piece: Piece) -> int:
    """How many messages the index tells of.

    Raises:
        DamageError: its bytes make no sense.
    """
    return int(_record(piece, Statistics, "the index").message_count)


def _record(piece: Piece, kind: Any, name: str) -> Any:
    try:
        return kind.read(stream(piece.body))
    except NONSENSE as e:
        raise DamageError(f"damaged at byte {piece.offset}: {name}: {e}") from None


def items(piece: Piece) -> list[Schema | Channel | LoggedMessage]:
    """What a record brings: all that a chunk holds, its checksum compared, or itself outside of chunks.

    Raises:
        DamageError: its bytes are not what was written.
    """
    return items_by(one_by_one, piece)


def items_by(
    split: Callable[[bytes], Iterable[Schema | Channel | LoggedMessage | T]], piece: Piece
) -> list[Schema | Channel | LoggedMessage | T]:
    """As `items`, with another way to take apart what a chunk holds.

    Args:
        split: as `one_by_one`.
        piece: the record.

    Raises:
        DamageError: its bytes are not what was written.
    """
    try:
        if piece.opcode == Opcode.CHUNK:
            return list(split(_decompressed(Chunk.read(stream(piece.body)))))
        if piece.opcode == Opcode.MESSAGE:
            channel, sequence, log_ns, publish_ns = MESSAGE.unpack_from(piece.body)
            return [LoggedMessage(channel, sequence, log_ns, publish_ns, piece.body[MESSAGE.size :])]
        if piece.opcode == Opcode.SCHEMA:
            return [Schema.read(stream(piece.body))]
        if piece.opcode == Opcode.CHANNEL:
            return [Channel.read(stream(piece.body))]
    except (zstandard.ZstdError, RuntimeError):  # the latter is lz4's
        raise DamageError(f"damaged at byte {piece.offset}: a chunk cannot be decompressed") from None
    except NONSENSE as e:
        raise DamageError(f"damaged at byte {piece.offset}: {e}") from None
    return []


def first_ns(piece: Piece) -> int | None:
    """Time of the first message that a record brings, a chunk's by its head alone; None if there is none."""
    if piece.opcode == Opcode.CHUNK and any(piece.body[: SPAN.size]):
        return int(SPAN.unpack_from(piece.body)[0])
    if piece.opcode == Opcode.MESSAGE and len(piece.body) >= MESSAGE.size:
        return int(MESSAGE.unpack_from(piece.body)[2])
    return None


def _decompressed(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        size = max(size, zstandard.frame_content_size(chunk.data))
    if size > _LARGEST_CHUNK:
        raise ValueError(f"a chunk claims to hold {size} bytes")
    data: bytes = chunk.data
    if chunk.compression == "zstd":
        data = zstandard.decompress(data, size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    elif chunk.compression:
        raise ValueError(f"a chunk is compressed with {chunk.compression!r}, which is not known")
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk holds {len(data)} bytes instead of {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("checksum of a chunk")
    return data


def one_by_one(data: bytes) -> Iterator[Schema | Channel | LoggedMessage]:
    """What a chunk holds, decompressed.

    Raises:
        one of `NONSENSE`.
    """
    offset, end = 0, len(data)
    while offset < end:
        item, offset = item_at(data, offset)
        if item is not None:
            yield item


def item_at(data: bytes, offset: int) -> tuple[Schema | Channel | LoggedMessage | None, int]:
    """The record at a place of a chunk, None where it is of no use here, and the place of the next one.

    Raises:
        one of `NONSENSE`.
    """
    opcode, length = HEAD.unpack_from(data, offset)
    following = offset + HEAD.size + length
    if following > len(data):
        raise ValueError("a record reaches beyond its chunk")
    if opcode == OPCODE_MESSAGE:
        head = MESSAGE.unpack_from(data, offset + HEAD.size)
        # half the time of LoggedMessage(…)
        return tuple.__new__(LoggedMessage, (*head, data[offset + MESSAGE_HEAD : following])), following
    if opcode == Opcode.SCHEMA:
        return Schema.read(stream(data[offset + HEAD.size : following])), following
    if opcode == Opcode.CHANNEL:
        return Channel.read(stream(data[offset + HEAD.size : following])), following
    return None, following
