"""The ring through which the loop hands its records over: never waits, never locks, makes no system call.

One process puts (the loop), any number of forked ones read. The mapping has no name and lives as long as one
of them does, so what the loop has put outlives the loop. A record fills one slot, or several where a tick
brought many frames. Each slot carries its sequence number at both ends, in native aligned 64-bit words, which
are not torn; a reader takes only what was already complete at its previous look, so that no memory barrier is
needed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import mmap
import os
import pickle
import struct
import sys
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, TypeVar

from pneud.log.format.record_layout import NUMBERS
from pneud.log.live.packing import REFUSALS, Pack, Skimmed, packed, skimmed, unpacked
from pneud.signals import Frame, Mileage, Record, Tick

# 64-bit words of the head of the mapping; the loop's, the console's and the recorder's lie in different cache
# lines.
_HEAD, _NUMBER, _CLOSED, _NEWEST = 0, 1, 2, 3
_CONSOLE, _CONSOLES_GONE = 8, 9
_HEARTBEAT = 16
_MILEAGE = 32  # of the run, by the loop
_FRAMES = 48  # on the bus, by the loop
_BEFORE = 40  # of the runs before it, by the recorder
_NOTES_LENGTH = 64
_NOTES_BYTE = 65 * 8
_HEAD_BYTES = 20_480
_PREFIX = struct.Struct("QQII")  # sequence, record (0 for a state), part, parts
_LEAST_BYTES = 128  # of a slot

_COUNTERS = struct.Struct(f"={len(Mileage._fields)}d")
_SINCE = struct.Struct(f"={len(Mileage._fields)}ddq")

RECORDER_FAILED = -1
CONSOLE_GONE = 1  # the console's last word, as old as any

Item = TypeVar("Item")

_SEAL_FUTURE_WRITE = 0x10  # what maps or opens the memory from now on can only read


class RecorderStatus(NamedTuple):
    """What the recorder says of itself."""

    heartbeat: int  # grows while it lives
    written: int  # records that the file has taken
    dropped: int  # records overwritten in the ring before they were read
    unwritten: int  # records read but not written, because the disk would not take them
    error: int  # errno of the last failure, RECORDER_FAILED for any other, 0 for none
    failing: int  # 1 as long as the disk takes nothing, or for good where the recorder failed
    finished: int  # 1 once the file is complete
    file_bytes: int
    config_changed: int = 0  # 1 where a file that the run began with is no longer as it was
    pid: int = 0  # its process id; 0 before it runs

    @property
    def lost(self) -> int:
        """Records that are not in the file."""
        return self.dropped + self.unwritten

    @property
    def error_text(self) -> str:
        """The last failure in words; empty if there was none."""
        if self.error == 0:
            return ""
        words = {RECORDER_FAILED: "the recorder failed", errno.ENOENT: "its file or folder was removed"}
        return words.get(self.error) or os.strerror(self.error)


class FrameTotals(NamedTuple):
    """Frames of an axis so far, as the summary of a run has them."""

    rx: int = 0
    tx: int = 0
    lost: int = 0
    crc: int = 0
    stale: int = 0
    late: int = 0


class Since(NamedTuple):
    """What an axis has done before a run."""

    before: Mileage
    since_s: float  # Unix time from which on it was counted; 0 as long as nobody has said so
    kept: int  # a `Kept`


class Kept(IntEnum):
    """Whether what an axis does outlives its run."""

    NO = 0  # there is no place for it, or nobody has looked yet
    KEPT = 1
    ELSEWHERE = 2  # another daemon keeps an axis of that name
    FAILING = 3  # the disk does not take it

    @property
    def label(self) -> str:
        """As a status has it."""
        return self.name.lower()


class Ring:
    """The loop's end; `create` it before forking."""

    def __init__(self, memory: mmap.mmap, slots: int, slot_bytes: int, pack: Pack | None = None) -> None:
        if slot_bytes < _LEAST_BYTES or slot_bytes % 8:
            raise ValueError(f"slot_bytes = {slot_bytes} is too small or no multiple of 8")
        self._memory = memory
        self._pack = pack
        self.descriptor = -1
        """Of the memory, where this process made it."""
        self._words = memoryview(memory).cast("Q")
        self._signed = memoryview(memory).cast("q")
        self.slots = slots
        self.slot_bytes = slot_bytes
        self._sequence = 0
        self._number = 0

    @classmethod
    def create(cls, slots: int = 8192, slot_bytes: int = 1024, pack: Pack | None = None) -> Ring:
        """A new ring with all its pages in memory.

        Args:
            slots: how many records of an ordinary tick it holds.
            slot_bytes: size of one; 1024 hold a tick with a dozen frames.
            pack: puts an ordinary record into its slot, as Python does without it.

        Raises:
            OSError: no memory for it.
        """
        size = _HEAD_BYTES + slots * slot_bytes
        descriptor = os.memfd_create("pneud-ring", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.posix_fallocate(descriptor, 0, size)
            memory = mmap.mmap(descriptor, size, mmap.MAP_SHARED | mmap.MAP_POPULATE)
            os.fchmod(descriptor, 0o400)
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
            with contextlib.suppress(OSError):  # Linux before 5.1 has but the mode to go by
                fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEAL_FUTURE_WRITE)
        except OSError as e:
            os.close(descriptor)
            raise OSError(e.errno, f"no memory for the ring to the recorder: {e.strerror}") from None
        for page in range(0, size, mmap.PAGESIZE):
            memory[page] = 0
        ring = cls(memory, slots, slot_bytes, pack)
        ring.descriptor = descriptor
        return ring

    @classmethod
    def attach(cls, descriptor: int, slots: int, slot_bytes: int) -> Ring:
        """The ring of another process, for reading only.

        Raises:
            OSError: not such memory.
            ValueError: it has another size.
        """
        try:
            size = _HEAD_BYTES + slots * slot_bytes
            return cls(mmap.mmap(descriptor, size, mmap.MAP_SHARED, mmap.PROT_READ), slots, slot_bytes)
        finally:
            os.close(descriptor)

    def open_for_reading(self) -> int:
        """A descriptor of the memory to give to a process that is to `attach`.

        Raises:
            OSError: no more descriptors.
        """
        return os.open(f"/proc/self/fd/{self.descriptor}", os.O_RDONLY | os.O_CLOEXEC)

    @staticmethod
    def layout() -> str:
        """A name of what lies where; only rings with the same one can read each other."""
        what = (
            _HEAD_BYTES,
            _PREFIX.format,
            NUMBERS,
            Tick._fields,
            Record._fields,
            Frame._fields,
            Mileage._fields,
            FrameTotals._fields,
        )
        return hashlib.sha256(f"{sys.implementation.cache_tag} {what}".encode()).hexdigest()[:16]

    def put(self, record: Record) -> None:
        """Hand one record over; never raises, never waits. The oldest goes where no reader keeps up."""
        self._number = number = self._number + 1
        first = self._sequence + 1
        try:
            if not 0 <= record.before <= len(record.frames):
                return  # counted by the readers, which miss its number
            if self._pack is None or not self._put_ordinary(self._pack, first, record):
                self._sequence = self._put_parts(number, packed(record))
        except (ValueError, TypeError):
            return  # likewise: the loop goes on
        finally:
            self._words[_NUMBER] = number
        self._words[_NEWEST] = first
        self._words[_HEAD] = self._sequence

    def _put_ordinary(self, pack: Pack, sequence: int, record: Record) -> bool:
        """Fill one slot; False where that is not enough, or the record has something special."""
        offset = _HEAD_BYTES + sequence % self.slots * self.slot_bytes
        end = offset + self.slot_bytes - 8
        _PREFIX.pack_into(self._memory, offset, sequence, self._number, 0, 1)
        try:
            pack(self._memory, offset + _PREFIX.size, end, record)
        except REFUSALS:
            return False
        self._words[end // 8] = self._sequence = sequence
        return True

    def _put_parts(self, number: int, data: bytes) -> int:
        """Fill the next slots; the last one's sequence comes back."""
        sequence = self._sequence
        room = self.slot_bytes - _PREFIX.size - 8
        parts = -(-len(data) // room)
        if parts > self.slots // 3:
            raise ValueError("it would overwrite too much")
        for part in range(parts):
            some = data[part * room : (part + 1) * room]
            sequence += 1
            offset = _HEAD_BYTES + sequence % self.slots * self.slot_bytes
            begin, end = offset + _PREFIX.size, offset + self.slot_bytes - 8
            _PREFIX.pack_into(self._memory, offset, sequence, number, part, parts)
            self._memory[begin : begin + len(some)] = some
            self._words[end // 8] = sequence
        return sequence

    def put_state(self, t_ns: int, state: Any) -> None:
        """Hand over the state of the axis after the record just put; never raises, never waits.

        One that is too long arrives as None.

        Args:
            t_ns: of the record just put.
            state: a tree of NamedTuples.
        """
        try:
            self._sequence = self._put_parts(0, pickle.dumps((t_ns, state), pickle.HIGHEST_PROTOCOL))
        except Exception:
            self._sequence = self._put_parts(0, pickle.dumps((t_ns, None)))
        self._words[_HEAD] = self._sequence

    @property
    def put_count(self) -> int:
        """Records put so far, lost ones included."""
        return self._words[_NUMBER]

    def set_closed(self) -> None:
        """Say that nothing more will be put."""
        self._words[_CLOSED] = 1

    @property
    def closed(self) -> bool:
        """Whether nothing more will be put."""
        return self._words[_CLOSED] != 0

    def set_console(self, beat_ns: int) -> None:
        """For the console: say that it lives.

        Args:
            beat_ns: now, CLOCK_MONOTONIC.
        """
        self._words[_CONSOLE] = beat_ns

    def set_console_gone(self) -> None:
        """For who watches the console: it does not live any longer, which the next one does not undo."""
        self._words[_CONSOLE] = CONSOLE_GONE
        self._words[_CONSOLES_GONE] += 1

    @property
    def consoles_gone(self) -> int:
        """Consoles that have died so far."""
        return self._words[_CONSOLES_GONE]

    @property
    def console_ns(self) -> int:
        """What the console said last; 0 before it has begun. A look costs no system call."""
        return self._words[_CONSOLE]

    def set_notes(self, notes: dict[str, str]) -> None:
        """Hand the recorder what is known only after the fork (the report of the real-time set-up).

        Call once, before the first `put`.

        Raises:
            ValueError: longer than 16,000 bytes.
        """
        text = json.dumps(notes).encode()
        if len(text) > _HEAD_BYTES - _NOTES_BYTE:
            raise ValueError(f"notes of {len(text)} bytes do not fit into the ring")
        self._memory[_NOTES_BYTE : _NOTES_BYTE + len(text)] = text
        self._words[_NOTES_LENGTH] = len(text)

    def notes(self) -> dict[str, str] | None:
        """What `set_notes` was given; None as long as it was not called."""
        length = self._words[_NOTES_LENGTH]
        if length == 0:
            return None
        notes: dict[str, str] = json.loads(self._memory[_NOTES_BYTE : _NOTES_BYTE + length])
        return notes

    def set_mileage(self, done: Mileage) -> None:
        """For the loop: say what the axis has done in this run. All of it grows, so none is ever torn."""
        _COUNTERS.pack_into(self._memory, _MILEAGE * 8, *done)

    def set_frames(self, so_far: FrameTotals) -> None:
        """For the loop: say how many frames came and went."""
        for index, value in enumerate(so_far):
            self._words[_FRAMES + index] = value

    @property
    def frames(self) -> FrameTotals:
        """How many frames came and went, as of half a second ago at most."""
        return FrameTotals._make(self._words[_FRAMES : _FRAMES + len(FrameTotals._fields)])

    def set_since(self, since: Since) -> None:
        """For the recorder: say what it had done before."""
        _SINCE.pack_into(self._memory, _BEFORE * 8, *since.before, since.since_s, since.kept)

    def since(self) -> Since:
        """What it had done before; nothing where that is not known, or not yet."""
        *before, since_s, kept = _SINCE.unpack_from(self._memory, _BEFORE * 8)
        return Since(_mileage(before), since_s, kept)

    @property
    def mileage(self) -> Mileage:
        """What it has done in this run, as of half a second ago at most."""
        return _mileage(_COUNTERS.unpack_from(self._memory, _MILEAGE * 8))

    def set_status(self, status: RecorderStatus) -> None:
        """For the recorder: say how it is."""
        for index, value in enumerate(status):
            self._signed[_HEARTBEAT + index] = value

    def status(self) -> RecorderStatus:
        """What the recorder last said; all zero before it runs."""
        return RecorderStatus._make(self._signed[_HEARTBEAT + i] for i in range(len(RecorderStatus._fields)))

    def reader(self) -> RingReader:
        """A reader of its own, beginning with the oldest record that is still there."""
        return RingReader(self)

    def _slot(self, sequence: int) -> tuple[int, int, int, bytes] | None:
        """Record, part, parts and content of a slot; None if it does not hold that sequence."""
        offset = _HEAD_BYTES + sequence % self.slots * self.slot_bytes
        first, end = offset // 8, offset + self.slot_bytes - 8
        if self._words[first] != sequence or self._words[end // 8] != sequence:
            return None
        _, number, part, parts = _PREFIX.unpack_from(self._memory, offset)
        data = self._memory[offset + _PREFIX.size : end]
        return (number, part, parts, data) if self._words[first] == sequence else None

    def _whole(self, sequence: int) -> tuple[int, int, bytes] | None:
        """Number, slots and bytes of what begins at a slot; None if it was overwritten."""
        slot = self._slot(sequence)
        if slot is None or slot[1]:
            return None
        number, _, parts, data = slot
        for more in range(1, parts):
            rest = self._slot(sequence + more)
            if rest is None:
                return None
            data += rest[3]
        return number, parts, data


def _mileage(numbers: Sequence[float]) -> Mileage:
    strokes, *rest = numbers
    return Mileage(int(strokes), *rest)


class RingReader:
    """One reader's place in the ring."""

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._next = 1
        self._seen = 0
        self._number = 0
        self._states: list[bytes] = []
        self.delivered = 0
        self.dropped = 0

    @property
    def place(self) -> tuple[int, int]:
        """Where it is, for another reader that is to go on from there."""
        return self._next, self._number

    @place.setter
    def place(self, place: tuple[int, int]) -> None:
        self._next, self._number = place

    def poll(self) -> list[Record]:
        """The records that were complete at the previous poll and have not been delivered yet.

        Those overwritten before they could be read are counted in `dropped`.
        """
        return self._advance(unpacked)

    def skim(self) -> list[Skimmed]:
        """As `poll`, for who wants but a few fields, at a fraction of the cost."""
        return self._advance(skimmed)

    def raw(self) -> list[bytes]:
        """As `poll`, with each record as it lies there, for `unpacked` and `drawn`."""
        return self._advance(bytes)

    def _advance(self, read: Callable[[bytes], Item]) -> list[Item]:
        ring = self._ring
        head = ring._words[_HEAD]
        until, self._seen = self._seen, head
        self._states = []
        records: list[Item] = []
        while self._next <= until:
            found = ring._whole(self._next)
            if found is None:
                # Overrun: leave the writer some room, or the next slots are gone too before they are read.
                self._next = max(self._next + 1, ring._words[_HEAD] - ring.slots + ring.slots // 16)
                continue
            number, slots, data = found
            self._next += slots
            if not number:
                self._states.append(data)
                continue
            self.dropped += number - self._number - 1
            self._number = number
            records.append(read(data))
        self.delivered += len(records)
        return records

    def states(self) -> dict[int, Any]:
        """States of the axis that the last poll came across, by the times of the records that they follow.

        The first one may follow a record of the poll before; one that was too long is None.
        """
        return dict(pickle.loads(data) for data in self._states)

    def drain(self) -> list[Record]:
        """Everything left, once nobody puts any more; `dropped` is final afterwards."""
        records, states = self.poll(), self._states
        time.sleep(0.002)
        records += self.poll()
        self._states = states + self._states
        missed = self._ring._words[_NUMBER] - self._number
        if missed > 0:
            self.dropped += missed
            self._number += missed
        return records

    def latest(self) -> Record | None:
        """The newest record, for display; None as long as there is none."""
        ring = self._ring
        for _ in range(3):
            newest = ring._words[_NEWEST]
            found = ring._whole(newest) if newest else None
            if found is not None:
                # no look lies between its writing and this one: it may be torn where stores are reordered
                with contextlib.suppress(ValueError, TypeError, EOFError):
                    return unpacked(found[2])
        return None
