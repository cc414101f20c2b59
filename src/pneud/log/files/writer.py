"""Writes records into MCAP files that a kill leaves readable.

Every chunk holds whole ticks and is closed after 100 ms at most. A disk that will not take more holds nobody
up: the records meanwhile are counted and given up, and the file goes on where it stopped once there is room.
A log may be split into parts, each of which can be read alone; it goes from one to the next where a snapshot
of the axis is at hand, which then begins the new part.
"""

from __future__ import annotations

import os
import struct
import threading
import time
import uuid
from typing import TYPE_CHECKING, Any

from pneud.log.files.naming import LogError, create_log, next_part
from pneud.log.files.part import MESSAGE_BYTES, LogPart
from pneud.log.files.retention import Tidying
from pneud.log.format.events import EventSource
from pneud.log.format.frames import FramesPacker
from pneud.log.format.header import LogHeader, Rotation
from pneud.log.format.records import LoggedEvent, Packer, pack_event
from pneud.log.format.schema import EVENTS, FRAMES, KEPT, SETUP, STATE, TICK, Level
from pneud.log.format.snapshot import to_json
from pneud.log.live.notes import Note
from pneud.signals import Record

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pneud.log.format.rows import RowPacker, Rows

CHUNK_BYTES = 64 * 1024
FLUSH_NS = 100_000_000
_SYNC_NS = 3_000_000_000
_RETRY_NS = 1_000_000_000


class LogWriter:
    """Writes one log. Its methods raise nothing when the disk fails: see `error` and `unwritten`."""

    def __init__(self, descriptor: int, header: LogHeader, rotation: Rotation | None = None) -> None:
        """Write the head of the log.

        Args:
            descriptor: of the new file (see `create_log`); closed by `close`.
            header: what the log says about its run.
            rotation: how the log is split and what is kept; None for one file.
        """
        self.unwritten = 0
        self._accepted = 0
        self._header = header
        self._rotation = rotation
        self._run = uuid.uuid4().hex
        self._part_number = 0
        self._notes: dict[str, str] | None = None
        self._packer = Packer(header.detail)
        self._frames = FramesPacker()
        self._rows: RowPacker | None = None
        self._batch_ns = 0  # log time of its last record
        self._batch_number = 0  # of the record whose frames are the first in `_frames`
        self._events = EventSource(header.fault_names, header.realtime_offset_ns, *header.switches)
        self._number = 0
        self._flushed_ns = self._synced_ns = time.monotonic_ns()
        self._blocked_ns = 0
        self._given_up = 0
        self._unsettled = 0
        self._last_t_ns = 0
        self._latched = 0
        self._closed_bytes = 0
        self._closing: list[threading.Thread] = []
        self._last_error = 0
        self._path = rotation.path if rotation is not None else None
        self._tidying = Tidying(rotation) if rotation is not None and rotation.quota_bytes else None
        self._part = self._begin(descriptor)

    @property
    def axis(self) -> str:
        """Whose log it is."""
        return self._header.name

    @property
    def written(self) -> int:
        """Records that the file has taken."""
        return self._accepted - self._unsettled

    @property
    def error(self) -> int:
        """The errno of the last failure to write; 0 if there was none."""
        return self._part.output.error or self._last_error

    @property
    def blocked(self) -> bool:
        """The disk does not take what is written."""
        return self._blocked_ns != 0

    @property
    def file_bytes(self) -> int:
        """Bytes that the files have taken."""
        return self._closed_bytes + self._part.output.settled_bytes

    def _begin(self, descriptor: int) -> LogPart:
        self._part_number += 1
        self._part_began_ns = time.monotonic_ns()
        more = {"run": self._run, "part": str(self._part_number), "records_before": str(self._number)}
        part = LogPart(descriptor, self._header, more)
        if self._notes is not None:
            part.metadata(SETUP, self._notes)
        if self._tidying is not None and self._path is not None:
            self._tidying.start(self._path)
        return part

    def note(self, notes: dict[str, str]) -> None:
        """Add metadata that became known after the start; call it before the first record."""
        self._notes = notes
        self._part.metadata(SETUP, notes)

    def write(self, record: Record, missed: int = 0) -> None:
        """Add one record, before which so many were dropped."""
        self._number += 1 + missed
        tick = record.tick
        t_ns = self._last_t_ns = tick.t_ns
        if self._blocked_ns:
            self.unwritten += 1
            self._given_up += 1
            return
        if missed:
            self._message(t_ns, Level.ERROR, f"dropped {missed} records: the recorder did not keep up")
        number, frames = self._number, self._frames
        try:
            packed = self._packer.tick(record)
            if self._batch_number + len(frames) != number:
                self._end_batch()
                self._batch_number = number
            frames.add(record)
        except (struct.error, ValueError, OverflowError) as e:
            self.unwritten += 1
            self._message(t_ns, Level.ERROR, f"unfit record: {e}")
            return
        self._batch_ns = log_time_ns = self._log_time_ns(t_ns)
        self._part.message(TICK, number, log_time_ns, packed)
        self._accepted += 1
        self._unsettled += 1
        self._tell(record, log_time_ns)
        if self._part.chunk_bytes > CHUNK_BYTES:
            self.flush()

    def write_many(self, rows: Rows) -> None:
        """Add ticks that are all of one kind."""
        begin, end, packer = 0, len(rows.ticks), self._row_packer()
        times_ns = (rows.ticks["t_ns"] + self._header.realtime_offset_ns).clip(min=0).astype("u8")
        made = packer.messages(rows)  # of all of them at once: a chunk's alone take twice as long
        for place in rows.telling():
            self._events.pass_over(max(0, place - begin))
            while begin <= place:
                begin = self._write_rows(rows, times_ns, made, begin, place + 1)
            record = rows.record(place)
            self._tell(record, self._log_time_ns(record.tick.t_ns))
        self._events.pass_over(end - begin)
        while begin < end:
            begin = self._write_rows(rows, times_ns, made, begin, end)

    def _row_packer(self) -> RowPacker:
        if self._rows is None:
            from pneud.log.format.rows import RowPacker  # noqa: PLC0415 - for simulations alone

            self._rows = RowPacker(self._header.detail)
        return self._rows

    def _write_rows(
        self, rows: Rows, times_ns: NDArray[np.uint64], made: NDArray[np.uint8], begin: int, end: int
    ) -> int:
        """As many of these ticks as the open chunk has room for; where they end.

        Args:
            rows: ticks.
            times_ns: of each in the log.
            made: messages of each.
            begin: the first one.
            end: behind the last one.
        """
        room = (CHUNK_BYTES - self._part.chunk_bytes) // (made.shape[1] + MESSAGE_BYTES) + 1
        end = min(end, begin + room)
        count = end - begin
        number, self._number = self._number + 1, self._number + count
        self._last_t_ns = int(rows.ticks["t_ns"][end - 1])
        if self._blocked_ns:
            self.unwritten += count
            self._given_up += count
            return end
        if self._batch_number + len(self._frames) != number:
            self._end_batch()
            self._batch_number = number
        part = rows.part(begin, end)
        self._frames.add_alike(count, part.received, part.before, part.sent)
        self._batch_ns = int(times_ns[end - 1])
        self._part.messages(TICK, number, times_ns[begin:end], made[begin:end])
        self._accepted += count
        self._unsettled += count
        if self._part.chunk_bytes > CHUNK_BYTES:
            self.flush()
        return end

    def _log_time_ns(self, t_ns: int) -> int:
        return max(t_ns + self._header.realtime_offset_ns, 0)

    def _tell(self, record: Record, log_time_ns: int) -> None:
        """The events of a record that has been written, and what is to be kept for them."""
        for event in self._events.after(record):
            self._add_event(event)
        latched = record.tick.latched
        if latched != self._latched:
            if latched & ~self._latched:
                self._keep(log_time_ns, latched & ~self._latched)
            self._latched = latched

    def say(self, message: Note) -> None:
        """Add an event that another process tells of."""
        t_ns, level, name, words = message
        self._add_event(LoggedEvent(t_ns + self._header.realtime_offset_ns, Level(level), name, words))

    def _end_batch(self) -> None:
        if len(self._frames):
            self._part.message(FRAMES, self._batch_number, self._batch_ns, self._frames.take())

    def _keep(self, log_time_ns: int, latched: int) -> None:
        """Mark the time around a fault as one that retention spares."""
        if self._rotation is not None:
            names = self._header.fault_names
            why = ",".join(n for bit, n in enumerate(names) if latched >> bit & 1)
            self._part.metadata(
                KEPT,
                {
                    "from_ns": str(log_time_ns - self._rotation.keep_before_ns),
                    "until_ns": str(log_time_ns + self._rotation.keep_after_ns),
                    "why": why,
                },
            )

    def snapshot(self, state: Any) -> None:
        """Add the state of the axis after the record written last, and go on to the next part if that is due.

        Args:
            state: a tree of NamedTuples; None for no more than the opportunity to go on.
        """
        if self._blocked_ns:
            return
        self.flush()
        if self._due() and not self._blocked_ns:
            self._next_part()
        if state is not None and self._number:
            self._part.message(STATE, self._number, self._batch_ns, to_json(state))

    def _due(self) -> bool:
        r = self._rotation
        if r is None:
            return False
        age_ns = time.monotonic_ns() - self._part_began_ns
        return 0 < r.part_bytes <= self._part.output.tell() or 0 < r.part_ns <= age_ns

    def _next_part(self) -> None:
        assert self._path is not None
        try:
            path = next_part(self._path, self._part_number + 1)
            descriptor = create_log(path)
        except LogError as e:
            self._message(self._last_t_ns, Level.ERROR, f"no next part: {e}")
            return
        before, self._path = self._part, path
        before.finish()
        before.output.settle()
        self._last_error = self.error
        self._closed_bytes += before.output.settled_bytes
        self._part = self._begin(descriptor)
        # waits for the disk, which must not hold up the reading of the ring
        self._closing = [thread for thread in self._closing if thread.is_alive()]
        self._closing.append(threading.Thread(target=before.output.close))
        self._closing[-1].start()

    def _message(self, t_ns: int, level: Level, words: str) -> None:
        for event in self._events.message(t_ns, level, "log", words):
            self._add_event(event)

    def _add_event(self, event: LoggedEvent) -> None:
        log_time_ns = max(event.log_time_ns, 0)
        data = pack_event(event._replace(log_time_ns=log_time_ns))
        self._part.message(EVENTS, 0, log_time_ns, data)

    def attend(self) -> None:
        """Close the chunk, sync, try again, whatever is due; to be called every few milliseconds."""
        now_ns = time.monotonic_ns()
        if self._blocked_ns:
            if now_ns - self._blocked_ns >= _RETRY_NS:
                self._retry(now_ns)
            return
        if now_ns - self._flushed_ns >= FLUSH_NS:
            self.flush()
        if now_ns - self._synced_ns >= _SYNC_NS:
            self._synced_ns = now_ns
            self._part.output.start_sync()
        if self._tidying is not None:
            for words in self._tidying.done():
                self.say(Note(self._last_t_ns, int(Level.INFO), "log", words))

    def flush(self) -> None:
        """Close the chunk and hand it to the operating system."""
        now_ns = time.monotonic_ns()
        self._end_batch()
        self._part.close_chunk()
        self._flushed_ns = now_ns
        if self._part.output.settle():
            self._unsettled = 0
        else:
            self._blocked_ns = now_ns

    def _retry(self, now_ns: int) -> None:
        if not self._part.output.settle():
            self._blocked_ns = now_ns
            return
        self._blocked_ns = 0
        self._unsettled = 0
        if self._given_up:
            why = os.strerror(self.error) if self.error > 0 else "the disk failed"
            words = f"gave up {self._given_up} records: {why}"
            self._given_up = 0
            self._message(self._last_t_ns, Level.ERROR, words)

    def close(self) -> bool:
        """Write the index and close the file; False if the disk has not all of it, or it was removed."""
        if self._blocked_ns:
            self._retry(time.monotonic_ns())
        self._end_batch()
        self._part.finish()
        complete = self._part.output.settle()
        if not complete:
            self._accepted -= self._unsettled
            self.unwritten += self._unsettled
        self._unsettled = 0
        for thread in self._closing:
            thread.join()
        if self._tidying is not None:
            self._tidying.join()
        return self._part.output.close() and complete
