"""All logs below some folders into one table; those that are in it as they are stay as they are."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from pneud.farm.rows import SUMMARY, Found, Row, bare, rows_of
from pneud.farm.store import CsvStore, Known, ParquetStore

SAVED_S = 60.0  # so often what has been read is written
SUFFIX = ".mcap"


class Outcome(NamedTuple):
    """What a summary has come to."""

    logs: int  # that are there
    read: int  # among them, now
    gone: int  # that have rows and are no longer there
    motions: int  # in the table
    recorded_s: float  # of those read
    took_s: float
    damaged: tuple[tuple[str, str], ...]  # path and reason, of those read
    copies: tuple[tuple[str, str], ...]  # path, and of which


def logs_below(places: Iterable[Path]) -> list[Found]:
    """The logs in some folders and all folders in them, or those named, by their paths."""
    found = {}
    for place in places:
        paths = _below(place) if place.is_dir() else (place,)
        for path in paths:
            try:
                there = path.stat()
            except OSError:  # gone meanwhile
                continue
            found[path] = Found(path, there.st_size, there.st_mtime_ns)
    return [found[path] for path in sorted(found)]


def _below(folder: Path) -> Iterator[Path]:
    for where, folders, names in os.walk(folder.resolve()):
        folders.sort()
        yield from (Path(where, name) for name in names if name.endswith(SUFFIX) and name[0] != ".")


Read = Callable[[Sequence[Found]], Iterator[list[Row]]]


@contextmanager
def readers(processes: int | None = None) -> Iterator[Read]:
    """Logs on all cores, in whatever order they end; to be begun before pyarrow has threads.

    Args:
        processes: how many at once; by default as many as there are cores for this process.
    """
    count = processes or len(os.sched_getaffinity(0))
    if count == 1:
        yield lambda many: map(rows_of, many)
        return
    forked = multiprocessing.get_context("fork")
    with forked.Pool(count, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
        yield lambda many: pool.imap_unordered(rows_of, many)


def summarise(
    places: Iterable[Path],
    store: ParquetStore | CsvStore,
    read: Read,
    report: Callable[[str, float, float, str], None] = lambda *_: None,
) -> Outcome:
    """Bring a table up to date.

    What has been read is in it whatever ends this: an interruption, or a kill up to a minute later.

    Args:
        places: folders, and logs.
        store: the table.
        read: from `readers`.
        report: is told how far it is.

    Raises:
        OSError: the table cannot be written.
        LogError: it is none.
    """
    began_s = saved_s = time.monotonic()
    there, known = logs_below(places), store.known()
    due = [log for log in there if _is_due(log, known.get(str(log.path)))]
    gone = sum(not Path(path).exists() for path in known)
    # the long ones first, so that none is left for the end; together they are read in any order
    due.sort(key=lambda log: (-log.bytes, log.path))
    ledger, whole = _Ledger(store, known), 1e-6 * sum(log.bytes for log in due)
    done, motions = 0.0, -1
    try:
        for rows in read(due):
            ledger.take(rows)
            done += 1e-6 * rows[0].bytes
            report("logs", done, whole, "MB")
            if time.monotonic() - saved_s > SAVED_S:
                ledger.settle()
                store.save()
                saved_s = time.monotonic()
    finally:
        if ledger.settle() or not store.path.exists():
            motions = store.save()
    return Outcome(
        logs=len(there),
        read=len(due),
        gone=gone,
        motions=motions if motions >= 0 else store.motions(),
        recorded_s=ledger.recorded_s,
        took_s=time.monotonic() - began_s,
        damaged=tuple(sorted(ledger.damaged)),
        copies=tuple(sorted(ledger.copies)),
    )


def _is_due(log: Found, known: Known | None) -> bool:
    return known is None or (known.bytes, known.changed_ns, known.summary) != (
        log.bytes,
        log.changed_ns,
        SUMMARY,
    )


class _Ledger:
    """What has been read and is not in the table yet."""

    def __init__(self, store: ParquetStore | CsvStore, known: dict[str, Known]) -> None:
        self._store = store
        self._known = known
        self._logs: list[list[Row]] = []
        self.recorded_s = 0.0
        self.damaged: list[tuple[str, str]] = []
        self.copies: list[tuple[str, str]] = []

    def take(self, rows: list[Row]) -> None:
        """All rows of a log."""
        first = rows[0]
        self._logs.append(rows)
        self.recorded_s += first.length_s or 0.0
        if first.damage:
            self.damaged.append((first.log, first.damage))

    def settle(self) -> bool:
        """Put it into the table, in an order that does not hang on who was first.

        Returns:
            Whether there was anything.
        """
        logs, self._logs = sorted(self._logs, key=lambda rows: rows[0].log), []
        without, new = set[str](), dict[str, list[Row]]()
        owners = {(k.run, k.part): path for path, k in self._known.items() if k.run and k.ticks}
        for rows in logs:
            first = rows[0]
            without.add(first.log)
            owner = owners.get((first.run, first.part)) if first.run else None
            if owner is not None and owner != first.log:
                if not Path(owner).exists():  # it has been moved
                    without.add(owner)
                    self._known.pop(owner, None)
                elif self._known[owner].ticks >= first.ticks:
                    rows = [self._copy(first, owner)]  # noqa: PLW2901
                else:
                    kept = self._known[owner]
                    of = Found(Path(owner), kept.bytes, kept.changed_ns)
                    without.add(owner)
                    new[owner] = [self._copy(bare(of, ""), first.log)]
                    self._known[owner] = kept._replace(ticks=0)
            new[first.log] = rows
            first = rows[0]
            self._known[first.log] = Known(
                first.bytes, first.changed_ns, first.summary, first.run, first.part, first.ticks
            )
            if first.run and first.ticks:
                owners[first.run, first.part] = first.log
        if not logs:
            return False
        self._store.change(without, [row for path in sorted(new) for row in new[path]])
        return True

    def _copy(self, row: Row, of: str) -> Row:
        """A log whose motions are another one's rows."""
        self.copies.append((row.log, of))
        return bare(Found(Path(row.log), row.bytes, row.changed_ns), f"a copy of {of}")
