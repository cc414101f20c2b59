"""What a recording is, found out before any of it becomes a log: where its SYNCs are, what its times mean.

Where sensors run free there is no SYNC, and commands are what is looked for in its place.

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
    by_sync: bool = True  # its ticks begin with a SYNC; else they end with a command


class _Beat(NamedTuple):
    """What ticks are counted by."""

    name: str
    codec: Codec


class _Heard:
    """The SYNCs, or commands, of one kind: sent, or any."""

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


def survey(path: Path, codecs: Codecs, rate_hz: float, *, sync: bool = True) -> Survey:
    """Look through a recording.

    Args:
        path: of it.
        codecs: of the axis.
        rate_hz: of its ticks.
        sync: they begin with a SYNC; else they end with a command.

    Raises:
        LogError: it cannot be read, there is no SYNC in it, or its times cannot be those of this axis.
    """
    beat = _Beat("SYNC", codecs.sync) if sync else _Beat("command", codecs.valve_command)
    remarks = Remarks()
    start_ns: int | None = None
    sent, all_ = _Heard(), _Heard()
    odd: dict[str, int] = {}  # frames with the number of SYNC that are none, by what they are
    for passing in traffic.read(path, remarks, fd=codecs.fd is not None):
        frame = passing.frame
        if start_ns is None:
            start_ns = frame.stamp_ns
        if frame.can_id & (EXTENDED | CAN_ERR_FLAG) != beat.codec.can_id & (EXTENDED | CAN_ERR_FLAG):
            continue
        if why := _unlike(beat.codec, frame):
            odd[why] = odd.get(why, 0) + 1
            continue
        all_.take(passing)
        if passing.sent:
            sent.take(passing)
    if start_ns is None:
        raise LogError(f"{path}: there is no frame in it{_because(remarks)}")
    if not all_.channel:
        raise LogError(f"{path}: {_no_beat(beat, odd)}{_because(remarks)}")
    own = sent if sent.channel else all_
    _check_times(path, beat.name, own.intervals_ns, 1e9 / rate_hz)
    return Survey(start_ns, own.channel, bool(sent.channel), sync)


def _because(remarks: Remarks) -> str:
    return "".join(f"; {line}" for line in remarks.lines()[:1])


def _unlike(codec: Codec, frame: Frame) -> str:
    """Why a frame with the number of what is looked for is none; empty where it is one."""
    if frame.can_id != codec.can_id:
        return other_kind(frame.can_id) or "with an 11-bit identifier"
    if len(frame.data) != codec.length:
        return f"with {len(frame.data)} bytes where the database has {codec.length}"
    return "" if codec.valid(frame.data) else "always with a wrong checksum"


def _no_beat(beat: _Beat, odd: dict[str, int]) -> str:
    name = f"{beat.name} (0x{beat.codec.can_id & EXTENDED:03X})"
    if not odd:
        return f"there is no {name} in it, so it has no ticks"
    why, count = max(odd.items(), key=lambda item: item[1])
    return f"{name} is there {count} times, but {why}, so it has no ticks"


def _check_times(path: Path, name: str, intervals_ns: list[int], period_ns: float) -> None:
    if len(intervals_ns) < _FEWEST_INTERVALS:
        return
    interval_ns = median_low(intervals_ns)
    ratio = interval_ns / period_ns
    if 1 / _UNLIKE <= ratio <= _UNLIKE:
        return
    if interval_ns < 0:
        raise LogError(
            f"{path}: its stamps go back from {name} to {name}; was it sorted the other way round?"
        )
    if interval_ns == 0:
        raise LogError(
            f"{path}: its stamps do not go on from {name} to {name}; without times it has no ticks"
        )
    unit = next((unit for factor, unit in _UNITS if factor / 2 <= ratio <= factor * 2), None)
    raise LogError(
        f"{path}: its {name}s are {interval_ns * 1e-9:g} s apart, where {1e9 / period_ns:g} Hz make"
        f" {period_ns * 1e-9:g} s; "
        + (f"are its stamps {unit}?" if unit else "is loop.rate_hz that of the recording?")
    )
