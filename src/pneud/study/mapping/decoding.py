"""What the signals of a DBC say on a bus: range, changes, and whether they move with the rod."""

from __future__ import annotations

import re
from collections import deque
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneud.bus import database
from pneud.bus.codec import DatabaseError
from pneud.bus.database import MessageSpec, Signal
from pneud.bus.wire import CAN_EFF_FLAG
from pneud.log.files.columns import Floats
from pneud.rt.inputs import read_whole
from pneud.study.mapping.patterns import STEADY, Place
from pneud.study.mapping.watching import KEPT, Watch

MOVES = 3.0  # times as far as noise with the same steps would go
LEAST = 8  # different values of what moves
NOISE = 4.0  # so far noise goes, in times of its steps' RMS
NEW_S = 1.0  # what "now" means
_CONTROLLER = re.compile(r"controller|master|host|plc|pneud", re.I)  # as senders are called


class Course(NamedTuple):
    """What one signal has said."""

    message: str
    signal: Signal
    times_s: Floats
    values: Floats
    commanded: bool  # a controller sends it, says the DBC

    @property
    def name(self) -> str:
        """As a mapping names it."""
        return f"{self.message}.{self.signal.name}"

    @property
    def distinct_per_s(self) -> float:
        """How many values in a second differ from the one before."""
        span = self.times_s[-1] - self.times_s[0]
        return float((np.diff(self.values) != 0.0).sum() / span) if span > 0.0 else 0.0

    @property
    def moving(self) -> float:
        """How far it goes, over how far noise with its steps would: large where something is pushed."""
        return _moving(self.values)

    @property
    def moving_now(self) -> float:
        """Likewise, of the last second."""
        return _moving(self.values[self.times_s > self.times_s[-1] - NEW_S])

    def along(self, other: Course) -> float:
        """Correlation with another one; 0 where one of them stands still."""
        if len(self.values) < 3 or not np.ptp(self.values) or not np.ptp(other.values):
            return 0.0
        seen = np.interp(self.times_s, other.times_s, other.values)
        return float(np.corrcoef(self.values, seen)[0, 1]) if np.ptp(seen) else 0.0


def _moving(values: Floats) -> float:
    steps = np.diff(values)
    if len(steps) and steps[-1] > 0.0 and (np.isclose(steps, steps[-1])).mean() > STEADY:
        return 0.0  # it counts
    if len(np.unique(values)) < LEAST:
        return 0.0  # a state
    rms = float(np.sqrt((steps**2).mean())) if len(steps) else 0.0
    return float(np.ptp(values)) / (NOISE * rms) if rms > 0.0 else 0.0


class Decoder:
    """A DBC, for all of its messages."""

    def __init__(self, path: Path) -> None:
        """Read it.

        Raises:
            DatabaseError: it cannot be used.
        """
        import cantools  # noqa: PLC0415 - slow to import

        self.path = path
        self._said: dict[int, dict[str, tuple[deque[float], deque[float]]]] = {}  # times and values
        self._taken: dict[int, int] = {}  # frames
        self._watch: Watch | None = None  # of which
        try:
            raw = read_whole(path)
            self.messages = {_key(m): m for m in database.messages(raw, keep=True)}
            self._read: Any = cantools.database.load_string(_text(raw), "dbc", strict=False)
        except OSError as e:
            raise DatabaseError(f"{path}: cannot be read: {e.strerror or e}; see --dbc") from None
        except Exception as e:  # the parser lets more than its own errors through
            raise DatabaseError(f"{path}: not a usable DBC: {' '.join(str(e).split())}") from None

    def places(self, can_id: int) -> list[Place]:
        """Where a message has unsigned integers."""
        message = self.messages.get(can_id)
        return [
            Place(s.start, s.length, s.big_endian)
            for s in (message.signals if message is not None else ())
            if not s.signed and not s.floating and s.scale == 1 and s.offset == 0 and s.length > 1
        ]

    def signal_at(self, can_id: int, place: Place) -> str | None:
        """The name of the signal that is exactly there."""
        message = self.messages.get(can_id)
        for s in message.signals if message is not None else ():
            if Place(s.start, s.length, s.big_endian) == place:
                return s.name
            if s.length == place.length <= 8 and _low_bit(s) == _low_bit_of(place):
                return s.name  # within a byte both notations mean the same
        return None

    def courses(self, watch: Watch, can_id: int) -> list[Course]:
        """What each signal of a message has said."""
        message = self.messages.get(can_id)
        if message is None:
            return []
        if watch is not self._watch:
            self._watch, self._said, self._taken = watch, {}, {}
        coder = self._read.get_message_by_name(message.name)
        said = self._said.setdefault(
            can_id, {s.name: (deque(maxlen=KEPT), deque(maxlen=KEPT)) for s in message.signals}
        )
        frames = watch.frames[can_id]
        begin = max(0, len(frames) - watch.counts[can_id] + self._taken.get(can_id, 0))
        self._taken[can_id] = watch.counts[can_id]
        for frame in islice(frames, begin, None):
            try:
                found = coder.decode(frame.data, decode_choices=False, allow_truncated=True)
            except Exception:  # of another length, or a kind that the DBC does not know
                continue
            for name, value in found.items():
                times, values = said[name]
                times.append(1e-9 * (frame.stamp_ns - watch.first_ns))
                values.append(float(value))
        by_name = {s.name: s for s in message.signals}
        commanded = any(_CONTROLLER.search(name) for name in coder.senders)
        return [
            Course(message.name, by_name[name], np.array(times), np.array(values), commanded)
            for name, (times, values) in said.items()
            if times
        ]


def _key(message: MessageSpec) -> int:
    return message.can_id | (CAN_EFF_FLAG if message.extended else 0)


def _low_bit(s: Signal) -> int:
    return _low_bit_of(Place(s.start, s.length, s.big_endian))


def _low_bit_of(place: Place) -> int:
    """Of a place within one byte; −1 of others."""
    if place.big_endian:
        return place.start - place.length + 1 if place.start % 8 >= place.length - 1 else -1
    return place.start if place.start % 8 + place.length <= 8 else -1


def _text(raw: bytes) -> str:
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")
