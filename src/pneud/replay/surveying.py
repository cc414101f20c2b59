"""What a recording is, found out before any of it becomes a log: where its SYNCs are, what its times mean.

Direction says who recorded, not who sent: a recorder that listens marks every frame as received. Only where
SYNCs are marked as sent was it the controller itself; then direction tells its frames from those of another.
"""

from __future__ import annotations

from pathlib import Path
from statistics import median_low
from typing import NamedTuple

from pneud.bus.codec import Codec, Codecs
from pneud.bus.wire import CAN_ERR_FLAG
from pneud.log.files.naming import LogError
from pneud.replay import traffic
from pneud.replay.passing import EXTENDED, other_kind
from pneud.replay.remarks import Remarks
from pneud.signals import Frame

_MOST_INTERVALS, _FEWEST_INTERVALS = 10_000, 3
_UNLIKE = 30.0  # times the period, or the period times it: not the same unit, or not the same bus
_UNITS = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))


class Survey(NamedTuple):
    """What a recording is."""

    start_ns: int  # of its first frame
    channel: str  # of the first SYNC
    directed: bool  # direction tells the controller's own frames from those of another


class _Heard:
    """The SYNCs of one kind: sent, or any."""

    def __init__(self) -> None:
        self.channel = ""
        self.intervals_ns: list[int] = []
        self._last_ns: int | None = None

    def take(self, passing: traffic.Passing) -> None:
        stamp_ns = passing.frame.stamp_ns
        self.channel = self.channel or passing.channel
        if passing.channel == self.channel and len(self.intervals_ns) < _MOST_INTERVALS:
            if self._last_ns is not None:
                self.intervals_ns.append(stamp_ns - self._last_ns)
            self._last_ns = stamp_ns


def survey(path: Path, codecs: Codecs, rate_hz: float) -> Survey:
    """Look through a recording.

    Raises:
        LogError: it cannot be read, there is no SYNC in it, or its times cannot be those of this axis.
    """
    remarks = Remarks()
    start_ns: int | None = None
    sent, all_ = _Heard(), _Heard()
    odd: dict[str, int] = {}  # frames with the number of SYNC that are none, by what they are
    for passing in traffic.read(path, remarks):
        frame = passing.frame
        if start_ns is None:
            start_ns = frame.stamp_ns
        if frame.can_id & (EXTENDED | CAN_ERR_FLAG) != codecs.sync.can_id:
            continue
        if why := _unlike(codecs.sync, frame):
            odd[why] = odd.get(why, 0) + 1
            continue
        all_.take(passing)
        if passing.sent:
            sent.take(passing)
    if start_ns is None:
        raise LogError(f"{path}: there is no frame in it{_because(remarks)}")
    if not all_.channel:
        raise LogError(f"{path}: {_no_sync(codecs.sync, odd)}{_because(remarks)}")
    own = sent if sent.channel else all_
    _check_times(path, own.intervals_ns, 1e9 / rate_hz)
    return Survey(start_ns, own.channel, bool(sent.channel))


def _because(remarks: Remarks) -> str:
    return "".join(f"; {line}" for line in remarks.lines()[:1])


def _unlike(sync: Codec, frame: Frame) -> str:
    """Why a frame with the number of SYNC is none; empty where it is one."""
    if why := other_kind(frame.can_id):
        return why
    if len(frame.data) != sync.length:
        return f"with {len(frame.data)} bytes where the database has {sync.length}"
    return "" if sync.valid(frame.data) else "always with a wrong checksum"


def _no_sync(sync: Codec, odd: dict[str, int]) -> str:
    name = f"SYNC (0x{sync.can_id:03X})"
    if not odd:
        return f"there is no {name} in it, so it has no ticks"
    why, count = max(odd.items(), key=lambda item: item[1])
    return f"{name} is there {count} times, but {why}, so it has no ticks"


def _check_times(path: Path, intervals_ns: list[int], period_ns: float) -> None:
    if len(intervals_ns) < _FEWEST_INTERVALS:
        return
    interval_ns = median_low(intervals_ns)
    ratio = interval_ns / period_ns
    if 1 / _UNLIKE <= ratio <= _UNLIKE:
        return
    if interval_ns < 0:
        raise LogError(f"{path}: its stamps go back from SYNC to SYNC; was it sorted the other way round?")
    if interval_ns == 0:
        raise LogError(f"{path}: its stamps do not go on from SYNC to SYNC; without times it has no ticks")
    unit = next((unit for factor, unit in _UNITS if factor / 2 <= ratio <= factor * 2), None)
    raise LogError(
        f"{path}: its SYNCs are {interval_ns * 1e-9:g} s apart, where {1e9 / period_ns:g} Hz make"
        f" {period_ns * 1e-9:g} s; "
        + (f"are its stamps {unit}?" if unit else "is loop.rate_hz that of the recording?")
    )
