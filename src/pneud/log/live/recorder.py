"""The recorder: a process that empties the ring into a file, and outlives the loop to finish it."""

from __future__ import annotations

import os
import socket
import sys
import time
import traceback
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pneud import crew
from pneud.log.format.header import MILEAGE_BEFORE, LogHeader, Rotation
from pneud.log.live.notes import Note, NotesListener
from pneud.log.live.ring import RECORDER_FAILED, Kept, RecorderStatus, Ring, RingReader
from pneud.rt.inputs import read_whole
from pneud.signals import Record

if TYPE_CHECKING:
    from pneud.log.files.writer import LogWriter
    from pneud.log.live.mileage import MileageFile

_POLL_S = 0.04  # with an open chunk of 100 ms, a kill costs less than 0.2 s
_LOOK_POLLS = 25  # how often the watched files are looked at
NICE = 0  # a recorder that is starved loses records
_WARNING, _ERROR = 3, 4  # `Level`s; their module is heavy to load


def start_recorder(
    ring: Ring,
    descriptor: int,
    header: LogHeader,
    files: tuple[Path, ...] = (),
    words: socket.socket | None = None,
    rotation: Rotation | None = None,
    nice: int = NICE,
    mileage: Path | None = None,
) -> int:
    """Fork the recorder.

    It finishes by itself when the ring is closed or this process dies, however it dies.

    Args:
        ring: what to read; nothing may have been put yet.
        descriptor: of the new file, open for writing; closed here.
        header: what the log says about its run.
        files: what the run began with; it is watched whether they stay as they are.
        words: the recorder's end of `notes.pair`; closed here.
        rotation: how the log is split and what is kept; None for one file.
        nice: its niceness.
        mileage: a file for what the axis has done in its life; None to keep none.

    Returns:
        The child's process id; wait for it after `ring.set_closed()`.

    Raises:
        OSError: no more processes.
    """
    parent = os.getpid()

    def main() -> int:
        try:
            os.nice(nice)
            # protobuf and MCAP are loaded here, behind the loop's own start, while the ring keeps what comes
            crew.at_low_priority(lambda: import_module("pneud.log.files.writer"))
            from pneud.log.files.writer import LogWriter  # noqa: PLC0415

            listener = NotesListener(words) if words is not None else None
            writer = LogWriter(descriptor, header, rotation)
            return _Recorder(ring, writer, parent, files, listener, mileage).run()
        except Exception:
            traceback.print_exc(file=sys.stderr)
            ring.set_status(ring.status()._replace(error=RECORDER_FAILED, failing=1))
            return 1

    keep = [descriptor] if words is None else [descriptor, words.fileno()]
    child = crew.fork(main, keep=keep, orphaned=None, name="recorder")
    os.close(descriptor)
    if words is not None:
        words.close()
    return child


class _Recorder:
    def __init__(
        self,
        ring: Ring,
        writer: LogWriter,
        parent: int,
        files: tuple[Path, ...],
        listener: NotesListener | None,
        mileage: Path | None,
    ) -> None:
        self._ring = ring
        self._reader: RingReader = ring.reader()
        self._writer = writer
        self._parent = parent
        self._listener = listener
        self._dropped = 0
        self._noted = False
        self._heartbeat = 0
        self._last_ns = -1  # t_ns of the record written last
        self._files = {path: _content(path) for path in files}
        self._changed = False
        self._mileage: MileageFile | None = None
        if mileage is not None:
            from pneud.log.live.mileage import MileageFile  # noqa: PLC0415 - behind the loop's own start

            self._mileage = MileageFile(mileage, writer.axis, self._warn)
            ring.set_since(self._mileage.since)

    def run(self) -> int:
        self._report()
        while not self._ring.closed and os.getppid() == self._parent:
            self._take(self._reader.poll())
            self._listen()
            if self._listener is not None and self._listener.gone:
                self._listener = None
                self._say_that_the_console_is_gone()
            self._writer.attend()
            self._count()
            self._report()
            time.sleep(_POLL_S)
        self._take(self._reader.drain())
        self._listen()
        self._count(ended=True)
        complete = self._writer.close()
        self._report(finished=complete)
        status = self._ring.status()
        return 0 if complete and not status.lost else 1

    def _take(self, records: list[Record]) -> None:
        if not self._noted:
            notes = self._ring.notes()
            if notes is not None:
                self._writer.note({**notes, **self._before()})
                self._noted = True
        # Where records were dropped, it was before the first of these, but for rare cases.
        missed = self._reader.dropped - self._dropped
        self._dropped = self._reader.dropped
        states = self._reader.states()
        if self._last_ns in states:
            self._writer.snapshot(states[self._last_ns])
        for record in records:
            self._writer.write(record, missed)
            missed = 0
            self._last_ns = record.tick.t_ns
            if self._last_ns in states:
                self._writer.snapshot(states[self._last_ns])

    def _count(self, *, ended: bool = False) -> None:
        """Keep what the axis has done, and tell the others what it had done before."""
        if self._mileage is None:
            return
        before = self._mileage.since
        if ended:
            self._mileage.close(self._ring.mileage)
        else:
            self._mileage.attend(self._ring.mileage)
        if self._mileage.since != before:
            self._ring.set_since(self._mileage.since)

    def _before(self) -> dict[str, str]:
        """What the axis had done before, for the log."""
        if self._mileage is None or self._mileage.since.kept != Kept.KEPT:
            return {}
        return {MILEAGE_BEFORE: self._mileage.in_json()}

    def _warn(self, words: str) -> None:
        self._writer.say(Note(time.monotonic_ns(), _WARNING, "mileage", words))
        print(f"pneud: {words}", file=sys.stderr, flush=True)

    def _listen(self) -> None:
        if self._listener is not None:
            for message in self._listener.poll():
                self._writer.say(message)

    def _say_that_the_console_is_gone(self) -> None:
        if self._ring.closed or os.getppid() != self._parent:
            return
        words = (
            "the console is gone for good, and what an operator had engaged comes to rest; restart pneud to"
            " operate the axis again"
        )
        self._writer.say(Note(time.monotonic_ns(), _ERROR, "console", words))
        print(f"pneud: {words}", file=sys.stderr, flush=True)

    def _report(self, *, finished: bool = False) -> None:
        if self._heartbeat % _LOOK_POLLS == 0:
            self._changed = any(_content(path) != content for path, content in self._files.items())
        self._heartbeat += 1
        w = self._writer
        self._ring.set_status(
            RecorderStatus(
                self._heartbeat,
                w.written,
                self._reader.dropped,
                w.unwritten,
                w.error,
                int(w.blocked),
                int(finished),
                w.file_bytes,
                int(self._changed),
                os.getpid(),
            )
        )


def _content(path: Path) -> bytes | None:
    try:
        return read_whole(path)
    except OSError:
        return None
