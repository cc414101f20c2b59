"""What an axis has done in its life: kept in a file, from run to run, by the recorder.

Whoever keeps it holds a lock, so that of two daemons with an axis of the same name one counts on. It is
written beside the recorder's work every few seconds, whole or not at all; a file that cannot be believed is
put aside.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import threading
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pneud.log.live.ring import Kept, Since
from pneud.rt.outputs import write_whole
from pneud.signals import Mileage

SCHEMA = 1
WRITE_S = 10.0  # from one writing to the next; so much may be lost where recorder and loop are killed at once
_TRY_S = 1.0  # from one try to get the lock to the next

Say = Callable[[str], None]
"""Tells a person one line."""


class DamagedError(Exception):
    """A file is not one of counters; the text says why."""


def total(before: Mileage, done: Mileage) -> Mileage:
    """What two stretches come to, one after the other."""
    return Mileage(
        before.strokes + done.strokes,
        before.travel_m + done.travel_m,
        before.air_m3 + done.air_m3,
        before.engaged_s + done.engaged_s,
        max(before.hardest_stop_m_s2, done.hardest_stop_m_s2),
    )


def fields_of(m: Mileage) -> dict[str, Any]:
    """Counters in the units that people count them in."""
    return {
        "strokes": m.strokes,
        "travel_m": round(m.travel_m, 3),
        "air_normal_l": round(m.air_m3 * 1e3, 3),
        "engaged_h": round(m.engaged_s / 3600.0, 6),
        "hardest_stop_m_s2": round(m.hardest_stop_m_s2, 3),
    }


def whole_life(done: Mileage, since: Since) -> dict[str, Any]:
    """As a status has them, with those before this run.

    Args:
        done: by the axis in this run.
        since: what it had done before.
    """
    told = {"since": utc(since.since_s) or None, "kept": Kept(since.kept).label}
    return fields_of(total(since.before, done)) | told


def as_text(axis: str, m: Mileage, since_s: float) -> str:
    """The content of a file."""
    fields = {"schema": SCHEMA, "axis": axis, "since": utc(since_s), **m._asdict()}
    return json.dumps({**fields, "check": _check(fields)}, indent=1) + "\n"


def from_text(text: str) -> tuple[Mileage, float]:
    """The counters of a file, and since when they count [s, Unix time].

    Raises:
        DamagedError: it has none, or others than were written.
    """
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise DamagedError("it is no JSON") from None
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        raise DamagedError("it has another schema")
    check = found.pop("check", None)
    if check != _check(found):
        raise DamagedError("its checksum is another one")
    try:
        counted = Mileage._make(_number(found[name]) for name in Mileage._fields)
        since_s = datetime.fromisoformat(found["since"]).timestamp()
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DamagedError("it lacks a number") from None
    return counted._replace(strokes=int(counted.strokes)), since_s


def utc(unix_s: float) -> str:
    """A time as files and people have it; empty for 0."""
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ") if unix_s else ""


def _check(fields: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(fields, sort_keys=True).encode()):08x}"


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < math.inf:
        raise ValueError(value)
    return value


class MileageFile:
    """The file of one axis.

    Attributes:
        since: what the axis had done before this run.
    """

    def __init__(self, path: Path, axis: str, say: Say, clock: Callable[[], float] = time.monotonic) -> None:
        """Take it, if nobody else has it.

        Args:
            path: of the file; its folder is made.
            axis: whose it is.
            say: tells a person what is wrong.
            clock: for when to write [s].
        """
        self.since = Since(Mileage(), 0.0, Kept.NO)
        self._path = path
        self._axis = axis
        self._say = say
        self._clock = clock
        self._lock = -1
        self._written = Mileage()  # by this run
        self._writing: threading.Thread | None = None
        self._failed = ""
        self._next_s = 0.0
        self.attend(Mileage())

    def in_json(self) -> str:
        """What the axis had done before this run."""
        return json.dumps({"since": utc(self.since.since_s), **self.since.before._asdict()})

    def attend(self, done: Mileage) -> None:
        """Do what is due; to be called every now and then.

        Args:
            done: by the axis in this run.
        """
        now_s = self._clock()
        if now_s < self._next_s or (self._writing is not None and self._writing.is_alive()):
            return
        if self._lock < 0:
            self._next_s = now_s + _TRY_S
            self._take()
            return
        self._next_s = now_s + WRITE_S
        self._tell()
        if done != self._written or self._failed:
            self._writing = threading.Thread(target=self._write, args=(done,), daemon=True)
            self._writing.start()

    def close(self, done: Mileage) -> None:
        """Write for the last time, and leave the file to others."""
        if self._writing is not None:
            self._writing.join()
        if self._lock < 0:  # whoever held it may be gone by now
            self._take()
        if self._lock >= 0:
            if done != self._written or self._failed:
                self._write(done)
            self._tell()
            os.close(self._lock)
            self._lock = -1

    def _take(self) -> None:
        lock = -1
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            lock = os.open(
                self._path.with_name(f"{self._path.name}.lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644
            )
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            before, since_s = self._read()
        except BlockingIOError:
            os.close(lock)
            self._kept(Kept.ELSEWHERE)
            return
        except OSError as e:
            with suppress(OSError):
                os.close(lock)
            self._fail(e)
            self._tell()
            return
        self._lock, self._failed = lock, ""
        self.since = Since(before, since_s, Kept.KEPT)

    def _read(self) -> tuple[Mileage, float]:
        """What the file says; where it says nothing that can be believed, counting begins now."""
        begun = Mileage(), float(int(time.time()))
        try:
            text = self._path.read_bytes().decode(errors="replace")
        except FileNotFoundError:
            return begun
        try:
            return from_text(text)
        except DamagedError as e:
            aside = self._aside()
            self._path.replace(aside)
            self._say(f"{self._path}: {e}; it is kept as {aside.name}, and {self._axis} counts from 0")
            return begun

    def _aside(self) -> Path:
        """A name that is free."""
        number = 1
        while (found := self._path.with_name(f"{self._path.name}.damaged{number}")).exists():
            number += 1
        return found

    def _write(self, done: Mileage) -> None:
        try:
            write_whole(self._path, as_text(self._axis, total(self.since.before, done), self.since.since_s))
        except OSError as e:
            self._fail(e)
        else:
            self._written, self._failed = done, ""

    def _fail(self, e: OSError) -> None:
        self._failed = e.strerror or str(e)

    def _tell(self) -> None:
        """Say that the disk does not take it, and that it does again, when that has changed."""
        failing = self.since.kept == Kept.FAILING
        if bool(self._failed) == failing:
            return
        self._kept(Kept.FAILING if self._failed else Kept.KEPT)
        if self._failed:
            self._say(f"{self._path}: what {self._axis} has done is not kept: {self._failed}")
        else:
            self._say(f"{self._path}: what {self._axis} has done is kept again")

    def _kept(self, kept: Kept) -> None:
        self.since = self.since._replace(kept=kept)
