"""Vector's binary recordings (.blf), read object by object.

Nobody has published how they are made; this follows the writer of python-can and Tobias Lorenz's vector_blf.
Behind a head come objects, most of them containers: parts of a stream of further objects, compressed, among
which the frames are. python-can's own reader ends at a damage without a word, and an object that claims to
have no bytes holds it for ever.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, NamedTuple

from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FD_LENGTHS
from pneud.log.files.naming import LogError
from pneud.replay.passing import EXTENDED, FD, NO_IDENTIFIER, REQUEST, SECOND_NS, STANDARD, Passing
from pneud.replay.remarks import Remarks
from pneud.rt.inputs import open_file
from pneud.signals import Frame

_FILE = struct.Struct("<4sL8xQ8xL4x8H16x")  # magic, its size, size of the file, objects, when it began
_MAGIC, _SIGN = b"LOGG", b"LOBJ"
_OBJECT = struct.Struct("<4sHHLL")  # sign, size of the head, its version, size of the object, kind
_TIME = struct.Struct("<L4xQ")  # unit of the time, time
_HEAD_BYTES = ((1, 32), (1, 40), (2, 40))  # by version
_CONTAINER = struct.Struct("<H6xL4x")  # compression, size without it
_CLASSIC = struct.Struct("<HBBL8s")  # channel, flags, DLC, identifier, data
_ERROR = struct.Struct("<H8xB5xL4x8s")  # channel, DLC, identifier, data
_FD_1 = struct.Struct("<HBxL5xBB5x")  # channel, flags, identifier, flags of FD, bytes; then data
_FD_2 = struct.Struct("<BxBxL4xL18xB5x")  # channel, bytes, identifier, flags, direction; then data

_CLASSIC_1, _IN_CONTAINER = 1, 10  # kinds
_KINDS = range(1, 150)  # that there are
_PLAIN, _DEFLATED = 0, 2  # compressions
_SENT, _REMOTE = 0x01, 0x80  # flags of a frame
_REQUESTED = 2  # a direction
_EDL_1, _EDL_2, _REMOTE_2 = 0x01, 0x1000, 0x10  # flags of FD: a frame of CAN FD, a frame that is asked for
_TEN_MICROSECONDS = 1  # unit of the time; else it is a nanosecond
_LARGEST_OBJECT, _LARGEST_CONTAINER = 1 << 20, 1 << 26
_PADDING = 8  # zeros between objects, at the most
_BLOCK = 1 << 16

_CUT = "cut short where the file ends"
_INCOMPLETE = "a container that is not complete"
_STRAY = "bytes that belong to no object, passed over"
_SIZE = "an object whose size cannot be, passed over"
_DAMAGED = "a container that cannot be decompressed, passed over"
_UNKNOWN = "an object of no known kind, passed over"
_OTHER = "an object that is not a frame of CAN"
_UNLIKE = "not a frame, passed over"
_MISSING = "objects that the head tells of are not there"
_OPEN = "the head is not complete: the recorder was stopped short, and what it still held is lost"


class _Head(NamedTuple):
    """What the head says."""

    begin: int  # where the first object is
    file_bytes: int
    objects: int
    start_ns: int


class _Outer(NamedTuple):
    """An object of the file."""

    place: str
    data: bytes
    follows: bool  # nothing was passed over just before it
    fits: bool  # its size can be believed


def read(path: Path, remarks: Remarks, *, fd: bool = False) -> Iterator[Passing]:
    """The frames of a recording in their order; those of CAN FD only where they are wanted.

    Raises:
        OSError: the file cannot be read.
        LogError: it is not such a recording.
    """
    with open_file(path) as file:
        end = file.seek(0, 2)
        head = _head(path, file, end)
        stream = _Stream(head.start_ns, remarks, fd)
        for outer in _objects(file, head.begin, end, remarks):
            if not outer.follows:
                stream.interrupt()
            if _OBJECT.unpack_from(outer.data)[4] != _IN_CONTAINER:
                yield from stream.take(outer.data, outer.place)
                continue
            data, whole = _unpacked(outer, remarks)
            yield from stream.take(data, outer.place)
            if not whole:
                stream.interrupt()
    if stream.interrupt():
        remarks.add(_CUT, f"byte {end}")
    if head.objects == 0 and stream.objects:
        remarks.add(_OPEN, "byte 0")
    lost = head.objects - stream.objects
    if lost > 0:
        remarks.add(_MISSING, f"byte {end}", f": {lost} of {head.objects}")
    elif head.file_bytes > end:
        remarks.add(_CUT, f"byte {end}")


def _head(path: Path, file: IO[bytes], end: int) -> _Head:
    file.seek(0)
    data = file.read(_FILE.size)
    if not data.startswith(_MAGIC):
        raise LogError(f"{path}: is {'not a BLF file' if data else 'empty'}")
    if len(data) < _FILE.size:
        raise LogError(f"{path}: cut short in its head")
    _, size, file_bytes, objects, year, month, _, day, hour, minute, second, ms = _FILE.unpack(data)
    try:
        when = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        start_ns = round(when.timestamp()) * SECOND_NS + ms * 1_000_000
    except ValueError:
        start_ns = 0
    return _Head(size if _FILE.size <= size <= end else _FILE.size, file_bytes, objects, start_ns)


def _objects(file: IO[bytes], at: int, end: int, remarks: Remarks) -> Iterator[_Outer]:
    """The objects of the file, whole or as far as the next one."""
    follows = True
    while at < end:
        place = f"byte {at}"
        file.seek(at)
        head = file.read(_OBJECT.size)
        if not head.startswith(_SIGN) or len(head) < _OBJECT.size:
            following = _find(file, at + 1, end)
            if following - at > _PADDING or any(head[: following - at]):
                remarks.add(_CUT if head.startswith(_SIGN) else _STRAY, place)
                follows = False
            at = following
            continue
        size = _OBJECT.unpack(head)[3]
        following = at + size
        fits = _OBJECT.size <= size <= _LARGEST_CONTAINER and following <= end
        if not fits:
            following = _find(file, at + len(_SIGN), end)
            remarks.add(_CUT if following == end and size else _SIZE, place)
        file.seek(at)
        data = file.read(min(following - at, _LARGEST_CONTAINER))
        if len(data) >= _OBJECT.size:
            yield _Outer(place, data, follows, fits)
        follows = True
        at = following


def _find(file: IO[bytes], at: int, end: int) -> int:
    """Where the next object begins; the end where there is none."""
    while at < end:
        file.seek(at)
        block = file.read(_BLOCK)
        found = block.find(_SIGN)
        if found >= 0:
            return at + found
        if len(block) < len(_SIGN):
            break
        at += len(block) - len(_SIGN) + 1
    return end


def _unpacked(container: _Outer, remarks: Remarks) -> tuple[bytes, bool]:
    """What is in a container, and whether that is all."""
    data = container.data[_OBJECT.size + _CONTAINER.size :]
    try:
        method, size = _CONTAINER.unpack_from(container.data, _OBJECT.size)
        inflater = zlib.decompressobj()
        if method == _DEFLATED:
            data = inflater.decompress(data, _LARGEST_CONTAINER)
        elif method != _PLAIN:
            raise zlib.error
    except (struct.error, zlib.error):
        remarks.add(_DAMAGED, container.place)
        return b"", False
    whole = inflater.eof or (method == _PLAIN and len(data) >= size)
    if not whole and container.fits:
        remarks.add(_INCOMPLETE, container.place)
    return data, whole


class _Stream:
    """The objects that follow one another across the containers.

    Attributes:
        objects: how many there were.
    """

    def __init__(self, start_ns: int, remarks: Remarks, fd: bool) -> None:
        self.objects = 0
        self._takes_fd = fd
        self._start_ns = start_ns
        self._remarks = remarks
        self._tail = b""

    def interrupt(self) -> bool:
        """What comes next does not go on where the last piece ended; whether an object is lost by that."""
        lost = any(self._tail)
        self._tail = b""
        return lost

    def take(self, data: bytes, place: str) -> Iterator[Passing]:
        """The frames in the next piece."""
        data = self._tail + data
        at = 0
        while (found := data.find(_SIGN, at)) >= 0:
            if found - at > _PADDING or any(data[at:found]):
                self._remarks.add(_STRAY, place)
            if found + _OBJECT.size > len(data):
                at = found
                break
            _, head_bytes, version, size, kind = _OBJECT.unpack_from(data, found)
            if not self._plausible(data, found, head_bytes, version, size, kind):
                self._remarks.add(_SIZE, place)
                at = data.find(_SIGN, found + 4)
                if at < 0:
                    at = max(len(data) - 3, found + 4)
                continue
            if found + size > len(data):
                at = found
                break
            self.objects += 1
            at = found + size
            passing = self._passing(data[found:at], head_bytes, kind, place)
            if passing is not None:
                yield passing
        self._tail = data[at:]
        if len(self._tail) > _LARGEST_OBJECT and self.interrupt():  # nothing in it looks like an object
            self._remarks.add(_STRAY, place)

    @staticmethod
    def _plausible(data: bytes, at: int, head_bytes: int, version: int, size: int, kind: int) -> bool:
        if (version, head_bytes) not in _HEAD_BYTES or not head_bytes <= size <= _LARGEST_OBJECT:
            return False
        if kind == _CLASSIC_1 and size == head_bytes + _CLASSIC.size:
            return True
        # another object inside it means that it does not reach that far
        return data.find(_SIGN, at + len(_SIGN), at + size + len(_SIGN) - 1) < 0

    def _passing(self, data: bytes, at: int, kind: int, place: str) -> Passing | None:
        """The frame in an object, if it is one; its content begins at `at`."""
        taken = _TAKEN.get(kind)
        if taken is None:
            known = kind in _KINDS
            self._remarks.add(_OTHER if known else _UNKNOWN, place, partial=not known)
            return None
        unit, time = _TIME.unpack_from(data, _OBJECT.size)
        stamp_ns = self._start_ns + time * (10_000 if unit == _TEN_MICROSECONDS else 1)
        try:
            channel, can_id, content, sent, flexible = taken(data[at:])
            if flexible and not self._takes_fd:
                raise _UnreadableError(FD)
        except struct.error:
            self._remarks.add(_UNLIKE, place)
        except _UnreadableError as e:
            self._remarks.add(str(e), place, partial=str(e) != REQUEST)
        else:
            frame = Frame(stamp_ns, can_id, b"" if can_id & CAN_RTR_FLAG else content)
            return Passing(frame, str(channel - 1), sent)
        return None


class _UnreadableError(Exception):
    """An object is not the frame that it should be; the text says why."""


_Content = tuple[int, int, bytes, bool, bool]  # channel, identifier with its flags, data, sent, of CAN FD


def _classic(content: bytes) -> _Content:
    channel, flags, dlc, number, data = _CLASSIC.unpack_from(content)
    return channel, _identifier(number, flags & _REMOTE), data[:dlc], bool(flags & _SENT), False


def _fd_1(content: bytes) -> _Content:
    """On a bus that carries CAN FD; the frame may be a classic one all the same."""
    channel, flags, number, fd, count = _FD_1.unpack_from(content)
    flexible = bool(fd & _EDL_1)
    data, remote = _fd_data(content[_FD_1.size :], count, flexible), 0 if flexible else flags & _REMOTE
    return channel, _identifier(number, remote), data, bool(flags & _SENT), flexible


def _fd_2(content: bytes) -> _Content:
    channel, count, number, flags, way = _FD_2.unpack_from(content)
    if way == _REQUESTED:
        raise _UnreadableError(REQUEST)
    flexible = bool(flags & _EDL_2)
    data, remote = _fd_data(content[_FD_2.size :], count, flexible), 0 if flexible else flags & _REMOTE_2
    return channel, _identifier(number, remote), data, bool(way), flexible


def _fd_data(content: bytes, count: int, flexible: bool) -> bytes:
    """So many bytes, of a classic frame eight at the most."""
    if not flexible:
        return content[: min(count, 8)]
    if count not in FD_LENGTHS or len(content) < count:
        raise _UnreadableError(_UNLIKE)
    return content[:count]


def _error(content: bytes) -> _Content:
    channel, dlc, number, data = _ERROR.unpack_from(content)
    can_id = number & (EXTENDED if number & CAN_EFF_FLAG else STANDARD)
    return channel, can_id | CAN_ERR_FLAG, data[:dlc], False, False


def _plain_error(content: bytes) -> _Content:
    return content[0] if content else 1, CAN_ERR_FLAG, b"", False, False


_TAKEN = {
    _CLASSIC_1: _classic, 86: _classic, 100: _fd_1, 101: _fd_2,
    73: _error, 2: _plain_error, 104: _plain_error,
}  # fmt: skip
"""What is taken, by kind."""


def _identifier(number: int, remote: int) -> int:
    extended = number & CAN_EFF_FLAG
    can_id = number & EXTENDED
    if not extended and can_id > STANDARD:
        raise _UnreadableError(NO_IDENTIFIER)
    return can_id | extended | (CAN_RTR_FLAG if remote else 0)
