"""Frames as they come, and what each identifier does: how often, how evenly, as an answer or not."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG
from pneud.log.files.columns import Ints
from pneud.signals import Frame
from pneud.study.mapping.patterns import Check, Counter, Place, check_in, counter_in, plain_places

KEPT = 20_000  # frames of one identifier that are looked at, the newest
COMPARED = 1000  # of them, where bits are compared
FEW = 8  # frames that say nothing of times
ANSWERED, EVENLY = 0.8, 0.3  # part of the SYNCs; spread of the intervals over their mean
ALIGNED = 0.15  # spread of the delay behind SYNC, over SYNC's period

Timing = Literal["SYNC", "answers SYNC", "periodic", "irregular", "rare"]


class Seen(NamedTuple):
    """What one identifier does."""

    can_id: int  # with its flag where it has 29 bits
    lengths: tuple[int, ...]  # bytes
    frames: int
    rate_hz: float
    jitter_s: float  # spread of the intervals
    timing: Timing
    delay_s: float  # behind SYNC; NaN where it answers none
    changing: tuple[int, ...]  # bytes
    counter: Counter | None
    check: Check | None

    @property
    def shown(self) -> str:
        """The identifier, as many digits as it has."""
        return shown(self.can_id)


def shown(can_id: int) -> str:
    """An identifier, as many digits as it has."""
    return f"{can_id & ~CAN_EFF_FLAG:0{8 if can_id & CAN_EFF_FLAG else 3}X}"


class Watch:
    """All that has been heard."""

    def __init__(self, sync_id: int = 0x080) -> None:
        self.sync_id = sync_id
        self.frames: dict[int, deque[Frame]] = {}
        self.counts: dict[int, int] = {}
        self.errors = 0  # error frames
        self.first_ns = self.last_ns = 0

    def add(self, frames: Iterable[Frame]) -> None:
        """Take frames in order of their stamps."""
        for frame in frames:
            if frame.can_id & CAN_ERR_FLAG:
                self.errors += 1
                continue
            if frame.can_id & CAN_RTR_FLAG:
                continue
            if not self.counts:
                self.first_ns = frame.stamp_ns
            self.last_ns = max(self.last_ns, frame.stamp_ns)
            self.counts[frame.can_id] = self.counts.get(frame.can_id, 0) + 1
            self.frames.setdefault(frame.can_id, deque(maxlen=KEPT)).append(frame)

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return 1e-9 * (self.last_ns - self.first_ns)

    def stamps(self, can_id: int) -> Ints:
        """When the kept frames came [ns]."""
        return np.array([f.stamp_ns for f in self.frames.get(can_id, ())], dtype=np.int64)

    def seen(self, can_id: int, places: Sequence[Place] = ()) -> Seen:
        """What an identifier does; counter and checksum are looked for at usual places and at these."""
        kept, stamps = self.frames[can_id], self.stamps(can_id)
        gaps = np.diff(stamps) * 1e-9
        mean = float(gaps.mean()) if len(gaps) else 0.0
        jitter = float(gaps.std()) if len(gaps) else 0.0
        timing, delay = self._timing(can_id, stamps, mean, jitter)
        lengths = sorted({len(f.data) for f in kept})
        data = [f.data for f in kept if len(f.data) == lengths[-1]][-COMPARED:]
        where = list(dict.fromkeys((*places, *plain_places(lengths[-1]))))
        counter = counter_in(data, [p for p in where if p.length <= 8 or p in places])
        return Seen(
            can_id,
            tuple(lengths),
            self.counts[can_id],
            1.0 / mean if mean > 0.0 else 0.0,
            jitter,
            timing,
            delay,
            tuple(i for i in range(lengths[-1]) if len({d[i] for d in data}) > 1),
            counter,
            check_in(can_id, data, where, counter),
        )

    def _timing(self, can_id: int, stamps: Ints, mean_s: float, jitter_s: float) -> tuple[Timing, float]:
        if can_id == self.sync_id:
            return "SYNC", float("nan")
        if len(stamps) < FEW:
            return "rare", float("nan")
        syncs = self.stamps(self.sync_id)
        before = np.searchsorted(syncs, stamps, side="right") - 1
        after = stamps[before >= 0] - syncs[before[before >= 0]] if len(syncs) else stamps[:0]
        if len(syncs) >= FEW and len(after) >= FEW:
            period = float(np.median(np.diff(syncs)))
            answered = len(set(before[before >= 0].tolist()))
            since = max(1, int((syncs >= stamps[0]).sum()))
            once = answered > ANSWERED * len(after) and answered > ANSWERED * min(len(syncs), since)
            middle = float(np.median(after))
            near = float(np.median(np.abs(after - middle)))
            if once and near < ALIGNED * period:
                return "answers SYNC", 1e-9 * middle
        return ("periodic" if jitter_s < EVENLY * mean_s else "irregular"), float("nan")
