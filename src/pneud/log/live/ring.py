"""The ring through which the loop hands its records over: never waits, never locks, makes no system call.

One process puts (the loop), any number of forked ones read. The mapping has no name and lives as long as one
of them does, so what the loop has put outlives the loop. A record fills one slot, or several where a tick
brought many frames. Each slot carries its sequence number at both ends, in native aligned 64-bit words, which
are not torn; a reader takes only what was already complete at its previous look, so that no memory barrier is
needed.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import mmap
import os
import pickle
import struct
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from pneud.log.live.packing import REFUSALS, Pack, layout, pack
from pneud.signals import (
    REQUEST_VALUES,
    Command,
    Estimate,
    Frame,
    Measurement,
    Record,
    Reference,
    Request,
    Tick,
    Timing,
)

# 64-bit words of the head of the mapping; the loop's and the recorder's lie in different cache lines.
_HEAD, _NUMBER, _CLOSED, _STATES = 0, 1, 2, 3
_HEARTBEAT = 16
_NOTES_LENGTH = 32
_NOTES_BYTE = 33 * 8
_HEAD_BYTES = 16_384
# Two places for states of the axis lie behind the slots, filled by turns: number, t_ns, length, bytes.
_STATE_BYTES = 1 << 17
_STATE = struct.Struct("=QqQ")

_FRAME = "qI9p3x"
_FRAME_BYTES = 24
_PREFIX = struct.Struct("QQ HHHH")  # sequence, record, part, parts, frames in this slot, frames of the record
_TICK = "q" + "qIddddd" + "I" + "I" + "qqq" + "III" + "qII" + "d" * 8 + "dddd" + "dIIddd" + "IQQ" + "III"
_REQUEST = f"{8 * REQUEST_VALUES}s"
_VALUES = [struct.Struct(f"{n}d") for n in range(REQUEST_VALUES + 1)]
# sent frames among them, before, tick with answer, kind and count of values, the values, timing, truth
_BODY = "II" + _TICK + _REQUEST + "qqqqqq" + "d"

# Where the few fields lie that `skim` reads.
_SKIPPED = 3 + Measurement._fields.index("skipped")
_SKIPPED_AT = struct.calcsize(f"{_PREFIX.format}{('II' + _TICK)[:_SKIPPED]}0I")
_TIMING_AT = struct.calcsize(f"{_PREFIX.format}II{_TICK}{_REQUEST}0q")
_LATENESS, _LATENCY = map(Timing._fields.index, ("lateness_ns", "latency_ns"))
_SKIPPED_FIELD, _TIMING_FIELDS = struct.Struct("I"), struct.Struct("q" * len(Timing._fields))

# Where the parts of an unpacked first slot begin.
_M = 9
_E = _M + len(Measurement._fields)
_R = _E + len(Estimate._fields)
_C = _R + len(Reference._fields)
_S = _C + len(Command._fields)
_T = _S + 7
_TRUTH = _T + len(Timing._fields)
_F = _TRUTH + 1

RECORDER_FAILED = -1

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

    @property
    def lost(self) -> int:
        """Records that are not in the file."""
        return self.dropped + self.unwritten

    @property
    def error_text(self) -> str:
        """The last failure in words; empty if there was none."""
        if self.error == 0:
            return ""
        return "the recorder failed" if self.error == RECORDER_FAILED else os.strerror(self.error)


class Ring:
    """The loop's end; `create` it before forking."""

    def __init__(self, memory: mmap.mmap, slots: int, slot_bytes: int, pack: Pack = pack) -> None:
        self._memory = memory
        self._pack = pack
        self.descriptor = -1
        """Of the memory, where this process made it."""
        self._words = memoryview(memory).cast("Q")
        self._signed = memoryview(memory).cast("q")
        self.slots = slots
        self.slot_bytes = slot_bytes
        first = struct.calcsize(_PREFIX.format + _BODY)
        self._first_frames = (slot_bytes - 8 - first) // _FRAME_BYTES
        self._more_frames = (slot_bytes - 8 - _PREFIX.size) // _FRAME_BYTES
        if self._first_frames < 1 or slot_bytes % 8:
            raise ValueError(f"slot_bytes = {slot_bytes} is too small or no multiple of 8")
        self._layouts = [layout(_PREFIX.format + _BODY + _FRAME * n) for n in range(self._first_frames + 1)]
        self._more_layouts = [layout(_PREFIX.format + _FRAME * n) for n in range(self._more_frames + 1)]
        self._longest = slots // 4
        self._sequence = 0
        self._number = 0

    @classmethod
    def create(cls, slots: int = 8192, slot_bytes: int = 1024, pack: Pack = pack) -> Ring:
        """A new ring with all its pages in memory.

        Args:
            slots: how many records of an ordinary tick it holds.
            slot_bytes: size of one; 1024 hold a tick with 20 frames.
            pack: `packing.pack` or its twin.

        Raises:
            OSError: no memory for it.
        """
        size = _HEAD_BYTES + slots * slot_bytes + 2 * _STATE_BYTES
        descriptor = os.memfd_create("pneud-ring", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.posix_fallocate(descriptor, 0, size)
            memory = mmap.mmap(descriptor, size, mmap.MAP_SHARED | mmap.MAP_POPULATE)
            os.fchmod(descriptor, 0o400)
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
            with contextlib.suppress(OSError):  # Linux before 5.1 has but the mode to go by
                fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _SEAL_FUTURE_WRITE)
        except OSError:
            os.close(descriptor)
            raise
        for page in range(0, size, mmap.PAGESIZE):
            memory[page] = 0
        ring = cls(memory, slots, slot_bytes, pack)
        ring.descriptor = descriptor
        return ring

    @classmethod
    def attach(cls, descriptor: int, slots: int, slot_bytes: int) -> Ring:
        """The ring of another process, for reading only.

        Args:
            descriptor: as the other's `open_for_reading` gave it; closed here.
            slots: as the other's.
            slot_bytes: as the other's.

        Raises:
            OSError: not such memory.
            ValueError: it has another size.
        """
        try:
            size = _HEAD_BYTES + slots * slot_bytes + 2 * _STATE_BYTES
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
        return hashlib.sha256(f"{_HEAD_BYTES} {_PREFIX.format} {_BODY} {_FRAME}".encode()).hexdigest()[:16]

    def put(self, record: Record) -> None:
        """Hand one record over; never raises, never waits. The oldest goes where no reader keeps up."""
        tick, timing, frames, before, sent, truth_m = record
        self._number += 1
        everything = (*frames, *sent)
        count = len(everything)
        first = min(count, self._first_frames)
        parts = 1 if count == first else 1 - (first - count) // self._more_frames
        request = tick.request
        kind, wanted = (0, ()) if request is None else request
        sequence = self._sequence + 1
        offset = _HEAD_BYTES + sequence % self.slots * self.slot_bytes
        try:
            if parts > self._longest:
                return  # counted by the readers, which miss its number
            wanted_bytes = _VALUES[len(wanted)].pack(*wanted)
            self._pack(
                self._memory,
                offset,
                *self._layouts[first],
                (
                    (sequence, self._number, 0, parts, first, 0, len(sent), before, tick.t_ns),
                    tick.measurement,
                    tick.estimate,
                    tick.reference,
                    tick.command,
                    (tick.state, tick.present, tick.latched, tick.answer, kind, len(wanted), wanted_bytes),
                    timing,
                    (truth_m,),
                    *everything[:first],
                ),
            )
            self._words[(offset + self.slot_bytes) // 8 - 1] = sequence
            if parts > 1:
                sequence = self._put_rest(everything[first:], sequence, parts)
        except (*REFUSALS, IndexError):
            return  # a value that no slot can hold: the record is missed, the loop goes on
        finally:
            self._words[_NUMBER] = self._number
        self._sequence = sequence
        self._words[_HEAD] = sequence

    def _put_rest(self, frames: tuple[Frame, ...], sequence: int, parts: int) -> int:
        for part in range(1, parts):
            some = frames[(part - 1) * self._more_frames : part * self._more_frames]
            sequence += 1
            offset = _HEAD_BYTES + sequence % self.slots * self.slot_bytes
            head = (sequence, self._number, part, parts, len(some), 0)
            self._pack(self._memory, offset, *self._more_layouts[len(some)], (head, *some))
            self._words[(offset + self.slot_bytes) // 8 - 1] = sequence
        return sequence

    def put_state(self, t_ns: int, state: Any) -> None:
        """Hand over the state of the axis after the record just put; never raises, never waits.

        Call it seconds apart: a reader sees the newest one only. One that is too long arrives as None.

        Args:
            t_ns: of the record just put.
            state: a tree of NamedTuples.
        """
        try:
            data = pickle.dumps(state, pickle.HIGHEST_PROTOCOL)
        except Exception:
            data = b""
        if len(data) > _STATE_BYTES - _STATE.size:
            data = b""
        number = self._words[_STATES] + 1
        offset = self._state_offset(number)
        self._words[offset // 8] = 0
        self._memory[offset + _STATE.size : offset + _STATE.size + len(data)] = data
        _STATE.pack_into(self._memory, offset, number, t_ns, len(data))
        self._words[_STATES] = number

    def _state_offset(self, number: int) -> int:
        return _HEAD_BYTES + self.slots * self.slot_bytes + number % 2 * _STATE_BYTES

    def _state(self, number: int) -> tuple[int, Any] | None:
        """A state and the time of its record; None if it was overwritten."""
        offset = self._state_offset(number)
        found, t_ns, length = _STATE.unpack_from(self._memory, offset)
        if found != number:
            return None
        data = self._memory[offset + _STATE.size : offset + _STATE.size + length]
        if self._words[offset // 8] != number:
            return None
        return t_ns, pickle.loads(data) if data else None

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

    def _slot(self, sequence: int) -> bytes | None:
        """A copy of a slot; None if it no longer (or not yet) holds that sequence number."""
        offset = _HEAD_BYTES + sequence % self.slots * self.slot_bytes
        first, last = offset // 8, (offset + self.slot_bytes) // 8 - 1
        if self._words[first] != sequence or self._words[last] != sequence:
            return None
        data = self._memory[offset : offset + self.slot_bytes]
        return data if self._words[first] == sequence else None

    def _skim(self, sequence: int) -> tuple[int, int, Skimmed] | None:
        """As `_read`, but for a few fields of the content."""
        offset = _HEAD_BYTES + sequence % self.slots * self.slot_bytes
        first, last = offset // 8, (offset + self.slot_bytes) // 8 - 1
        if self._words[last] != sequence:
            return None
        _, number, part, parts, _, _ = _PREFIX.unpack_from(self._memory, offset)
        (skipped,) = _SKIPPED_FIELD.unpack_from(self._memory, offset + _SKIPPED_AT)
        timing = _TIMING_FIELDS.unpack_from(self._memory, offset + _TIMING_AT)
        if part or self._words[first] != sequence:
            return None
        return number, parts, Skimmed(skipped, timing[_LATENESS], timing[_LATENCY])

    def _read(self, sequence: int) -> tuple[int, int, Record] | None:
        """Number, slots and content of the record that begins at a slot; None if it was overwritten."""
        slot = self._slot(sequence)
        if slot is None:
            return None
        _, number, part, parts, count, _ = _PREFIX.unpack_from(slot)
        if part:
            return None
        v = self._layouts[count].whole.unpack_from(slot)
        flat = v[_F:]
        for more in range(1, parts):
            rest = self._slot(sequence + more)
            if rest is None:
                return None
            n = _PREFIX.unpack_from(rest)[4]
            flat += self._more_layouts[n].whole.unpack_from(rest)[6:]
        new = tuple.__new__  # half the time of Frame(…)
        frames = tuple([new(Frame, flat[i : i + 3]) for i in range(0, len(flat), 3)])
        received = len(frames) - v[6]
        tick = Tick(
            v[8],
            Measurement._make(v[_M:_E]),
            Request(v[_S + 4], _VALUES[v[_S + 5]].unpack_from(v[_S + 6])) if v[_S + 4] else None,
            Estimate._make(v[_E:_R]),
            Reference._make(v[_R:_C]),
            Command._make(v[_C:_S]),
            v[_S],
            v[_S + 1],
            v[_S + 2],
            v[_S + 3],
        )
        timing = Timing._make(v[_T:_TRUTH])
        return number, parts, Record(tick, timing, frames[:received], v[7], frames[received:], v[_TRUTH])


class Skimmed(NamedTuple):
    """A few fields of a record."""

    skipped: int
    lateness_ns: int
    latency_ns: int


class RingReader:
    """One reader's place in the ring."""

    def __init__(self, ring: Ring) -> None:
        self._ring = ring
        self._next = 1
        self._seen = 0
        self._number = 0
        self._states_seen = 0
        self._state_until = 0
        self._state = 0
        self.delivered = 0
        self.dropped = 0

    def poll(self) -> list[Record]:
        """The records that were complete at the previous poll and have not been delivered yet.

        Those overwritten before they could be read are counted in `dropped`.
        """
        return self._advance(self._ring._read)

    def skim(self) -> list[Skimmed]:
        """As `poll`, for who wants but a few fields, at a fraction of the cost."""
        return self._advance(self._ring._skim)

    def _advance(self, read: Callable[[int], tuple[int, int, Item] | None]) -> list[Item]:
        ring = self._ring
        head = ring._words[_HEAD]
        until, self._seen = self._seen, head
        # read after the head, so that a state is seen no later than the first record behind it
        self._state_until, self._states_seen = self._states_seen, ring._words[_STATES]
        records: list[Item] = []
        while self._next <= until:
            found = read(self._next)
            if found is None:
                # Overrun: leave the writer some room, or the next slots are gone too before they are read.
                self._next = max(self._next + 1, ring._words[_HEAD] - ring.slots + ring.slots // 16)
                continue
            number, slots, record = found
            self._next += slots
            self.dropped += number - self._number - 1
            self._number = number
            records.append(record)
        self.delivered += len(records)
        return records

    def state(self) -> tuple[int, Any] | None:
        """The newest state of the axis that was complete at the previous poll, once.

        Ask after each poll: it comes with the record that it follows, or before that one.

        Returns:
            The time of that record, and the state (None if it was too long); None if there is no other.
        """
        if self._state == self._state_until:
            return None
        self._state = self._state_until
        return self._ring._state(self._state)

    def drain(self) -> list[Record]:
        """Everything left, once nobody puts any more; `dropped` is final afterwards."""
        records = self.poll()
        time.sleep(0.002)
        records += self.poll()
        missed = self._ring._words[_NUMBER] - self._number
        if missed > 0:
            self.dropped += missed
            self._number += missed
        return records

    def latest(self) -> Record | None:
        """The newest record, for display; None as long as there is none."""
        ring = self._ring
        for _ in range(3):
            head = ring._words[_HEAD]
            slot = ring._slot(head) if head else None
            found = ring._read(head - _PREFIX.unpack_from(slot)[2]) if slot else None
            if found is not None:
                return found[2]
        return None
