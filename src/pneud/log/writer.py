"""Writes records into an MCAP file that a kill leaves readable.

Every chunk holds whole ticks and is closed after 100 ms at most. A disk that will not take more holds nobody
up: the records meanwhile are counted and given up, and the file goes on where it stopped once there is room.
"""

from __future__ import annotations

import errno
import os
import struct
import threading
import time

from mcap.writer import CompressionType, IndexType, Writer

from pneud.log.events import EventSource
from pneud.log.fingerprint import numeric_fingerprint, versions
from pneud.log.header import LogHeader
from pneud.log.messages import Message
from pneud.log.records import LoggedEvent, Packer, pack_event
from pneud.log.schema import EVENTS, FRAMES, METADATA, SCHEMA, SETUP, TICK, TIMING, Level, topics
from pneud.signals import Record

CHUNK_BYTES = 64 * 1024
FLUSH_NS = 100_000_000
_SYNC_NS = 3_000_000_000
_RETRY_NS = 1_000_000_000
_OVERHEAD_BYTES = 3 * 31  # MCAP's own head of a message

FAILED = -1


def realtime_offset_ns() -> int:
    """Unix time minus monotonic time at this moment [ns]."""
    before = time.monotonic_ns()
    now = time.time_ns()
    return now - (before + time.monotonic_ns()) // 2


class _Output:
    """What the MCAP writer writes into: kept until the disk has taken it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pending = bytearray()
        self._size = 0
        self._sync: threading.Thread | None = None
        self.error = 0

    def write(self, data: bytes) -> int:
        self._pending += data
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing: `settle` writes, at a moment of our own choosing."""

    @property
    def settled_bytes(self) -> int:
        return self._size - len(self._pending)

    def settle(self) -> bool:
        """Try to write everything; False if the disk will not take it."""
        try:
            while self._pending:
                written = os.write(self._descriptor, self._pending)
                del self._pending[:written]
        except OSError as e:
            self.error = e.errno or FAILED
            return False
        return True

    def start_sync(self) -> None:
        """Have the disk keep what was written; a slow one must not hold up the reading of the ring."""
        if self._sync is None or not self._sync.is_alive():
            self._sync = threading.Thread(target=self.sync, daemon=True)
            self._sync.start()

    def sync(self) -> None:
        try:
            os.fdatasync(self._descriptor)
        except OSError as e:
            if e.errno != errno.EINVAL:  # a pipe or a device has nothing to sync
                self.error = e.errno or FAILED

    def close(self) -> None:
        if self._sync is not None:
            self._sync.join()
        self.sync()
        os.close(self._descriptor)


class LogWriter:
    """Writes one log. Its methods raise nothing when the disk fails: see `error` and `unwritten`."""

    def __init__(self, descriptor: int, header: LogHeader) -> None:
        """Write the head of the log.

        Args:
            descriptor: of the new file (see `create_log`); closed by `close`.
            header: what the log says about its run.
        """
        self.unwritten = 0
        self._accepted = 0
        self._header = header
        self._output = _Output(descriptor)
        self._writer = Writer(
            self._output,  # type: ignore[arg-type]  # only write, tell and flush are used
            chunk_size=1 << 30,  # closed by us, between two ticks
            compression=CompressionType.ZSTD,
            index_types=IndexType.ALL,
        )
        self._packer = Packer(header.detail)
        self._events = EventSource(header.fault_names, header.realtime_offset_ns)
        self._number = 0
        self._chunk_bytes = 0
        self._flushed_ns = self._synced_ns = time.monotonic_ns()
        self._blocked_ns = 0
        self._given_up = 0
        self._unsettled = 0
        self._last_t_ns = 0
        self._start()

    @property
    def written(self) -> int:
        """Records that the file has taken."""
        return self._accepted - self._unsettled

    @property
    def error(self) -> int:
        """The errno of the last failure to write; 0 if there was none."""
        return self._output.error

    @property
    def file_bytes(self) -> int:
        """Bytes that the file has taken."""
        return self._output.settled_bytes

    def _start(self) -> None:
        h, w = self._header, self._writer
        w.start(profile="", library=f"pneud {versions().get('pneud', '')}".strip())
        now_ns = time.time_ns()
        w.add_attachment(now_ns, now_ns, h.config_name, "application/toml", h.config_text.encode())
        w.add_attachment(now_ns, now_ns, h.dbc_name, "application/vnd.can-dbc", h.dbc)
        w.add_metadata(
            METADATA,
            {
                "schema": str(SCHEMA),
                "name": h.name,
                "bus": h.bus,
                "rate_hz": repr(h.rate_hz),
                "detail": h.detail,
                "config": h.config_name,
                "dbc": h.dbc_name,
                "faults": ",".join(h.fault_names),
                "realtime_offset_ns": str(h.realtime_offset_ns),
                "host": os.uname().nodename,
                "fingerprint": numeric_fingerprint(),
                **versions(),
                **h.extra,
            },
        )
        self._channels = {
            topic: w.register_channel(topic, "protobuf", w.register_schema(schema, "protobuf", descriptors))
            for topic, schema, descriptors in topics(h.detail)
        }
        self._output.settle()

    def note(self, notes: dict[str, str]) -> None:
        """Add metadata that became known after the start; call it before the first record."""
        self._writer.add_metadata(SETUP, notes)

    def write(self, record: Record, missed: int = 0) -> None:
        """Add one record.

        Args:
            record: the next one.
            missed: records dropped just before it.
        """
        self._number += 1 + missed
        t_ns = self._last_t_ns = record.tick.t_ns
        if self._blocked_ns:
            self.unwritten += 1
            self._given_up += 1
            return
        if missed:
            self._message(t_ns, Level.ERROR, f"dropped {missed} records: the recorder did not keep up")
        try:
            messages = (
                (TICK, self._packer.tick(record)),
                (FRAMES, self._packer.frames(record)),
                (TIMING, self._packer.timing(record)),
            )
        except (struct.error, ValueError, IndexError, OverflowError) as e:
            self.unwritten += 1
            self._message(t_ns, Level.ERROR, f"unfit record: {e}")
            return
        offset_ns = self._header.realtime_offset_ns
        log_time = max(t_ns + offset_ns, 0)
        frames = record.frames
        publish_time = max(frames[-1].stamp_ns + offset_ns, 0) if frames else log_time
        number = self._number & 0xFFFF_FFFF
        for topic, data in messages:
            self._writer.add_message(self._channels[topic], log_time, data, publish_time, number)
            self._chunk_bytes += len(data)
        self._chunk_bytes += _OVERHEAD_BYTES
        self._accepted += 1
        self._unsettled += 1
        for event in self._events.after(record):
            self._add_event(event)
        if self._chunk_bytes > CHUNK_BYTES:
            self.flush()

    def say(self, message: Message) -> None:
        """Add an event that another process tells of."""
        t_ns, level, name, words = message
        self._add_event(LoggedEvent(t_ns + self._header.realtime_offset_ns, Level(level), name, words))

    def _message(self, t_ns: int, level: Level, words: str) -> None:
        for event in self._events.message(t_ns, level, "log", words):
            self._add_event(event)

    def _add_event(self, event: LoggedEvent) -> None:
        log_time_ns = max(event.log_time_ns, 0)
        data = pack_event(event._replace(log_time_ns=log_time_ns))
        self._writer.add_message(self._channels[EVENTS], log_time_ns, data, log_time_ns, 0)

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
            self._output.start_sync()

    def flush(self) -> None:
        """Close the chunk and hand it to the operating system."""
        now_ns = time.monotonic_ns()
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._chunk_bytes = 0
        self._flushed_ns = now_ns
        if self._output.settle():
            self._unsettled = 0
        else:
            self._blocked_ns = now_ns

    def _retry(self, now_ns: int) -> None:
        if not self._output.settle():
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
        """Write the index and close the file; False if the disk would not take all of it."""
        if self._blocked_ns:
            self._retry(time.monotonic_ns())
        self._writer.finish()  # type: ignore[no-untyped-call]
        complete = self._output.settle()
        if complete:
            self._unsettled = 0
        else:
            self._accepted -= self._unsettled
            self.unwritten += self._unsettled
            self._unsettled = 0
        self._output.close()
        return complete
