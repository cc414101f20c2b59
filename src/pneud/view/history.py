"""What the live screen remembers of the ticks it has seen: counts, histograms, and short bounded curves."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from itertools import takewhile
from typing import NamedTuple

from pneud.log.live.amiss import Amiss
from pneud.rt.histogram import Histogram
from pneud.signals import Record, RequestKind, State, Tick

BUCKET_NS = 20_000_000
SPAN_S = 10.0
_SPAN_BUCKETS = round(SPAN_S * 1e9 / BUCKET_NS)
_LARGEST = 1e30  # squares of smaller values and their sums stay finite
_EVENTS = 16
_BLOCKS = " ▁▂▃▄▅▆▇█"
_SECOND_NS = 1_000_000_000
PRESSING = int(State.PRESSING)
_FRAME_BITS, _STUFFING = 47, 1.1  # of a frame without data, interframe space included; as bits are stuffed

Column = tuple[float, float] | None
"""Smallest and largest value in one column of a curve; None in a gap."""


def _group(width: int) -> int:
    """Buckets in a column, so that all columns but the newest, still growing one show `SPAN_S` seconds."""
    return -(-_SPAN_BUCKETS // max(width - 1, 1))


def span_s(width: int) -> float:
    """Time [s] that `width` columns show."""
    return _group(width) * width * BUCKET_NS * 1e-9


class Trace:
    """The last seconds of one signal: of every 20 ms the smallest and largest value.

    Extremes survive any further decimation, so a spike of one tick stays visible at every width.
    """

    __slots__ = ("_buckets", "_columns", "_group", "_index", "_merged")

    def __init__(self) -> None:
        # index, smallest, largest, count and sum of squares of each
        self._buckets: deque[list[float]] = deque(maxlen=2 * _SPAN_BUCKETS)
        self._index = -1
        self._columns: dict[int, tuple[float, float]] = {}  # by time, for the width of the last call
        self._group = 0
        self._merged = -1

    def add(self, t_ns: int, value: float) -> None:
        """Take one value; NaN, infinity and what is beyond all measure leave a gap."""
        if not -_LARGEST < value < _LARGEST:
            return
        index = t_ns // BUCKET_NS
        if index == self._index:
            bucket = self._buckets[-1]
            if value < bucket[1]:
                bucket[1] = value
            elif value > bucket[2]:
                bucket[2] = value
            bucket[3] += 1.0
            bucket[4] += value * value
        elif index > self._index:
            self._index = index
            self._buckets.append([index, value, value, 1.0, value * value])

    def rms(self, t_ns: int) -> float:
        """Root mean square of the last `SPAN_S` seconds before t_ns; NaN when there is no value."""
        squares = count = 0.0
        for bucket in self._recent(t_ns):
            squares += bucket[4]
            count += bucket[3]
        return math.sqrt(squares / count) if count else math.nan

    def _recent(self, t_ns: int) -> list[list[float]]:
        oldest = t_ns // BUCKET_NS - _SPAN_BUCKETS
        return list(takewhile(lambda b: b[0] > oldest, reversed(self._buckets)))

    def lately(self, t_ns: int) -> tuple[float, float]:
        """Smallest and largest value of the last `SPAN_S` seconds before t_ns; NaN when there is none."""
        recent = self._recent(t_ns)
        return (min(b[1] for b in recent), max(b[2] for b in recent)) if recent else (math.nan, math.nan)

    def columns(self, t_ns: int, width: int) -> list[Column]:
        """The last `span_s(width)` seconds in `width` columns of extremes, oldest first; None in gaps.

        Columns hold whole buckets on a grid fixed in time, so that a curve moves without changing its shape.
        """
        group = _group(width)
        known = self._columns
        if group != self._group or len(known) > 3 * width:
            self._group, self._merged = group, -1
            known.clear()
        for index, low, high, _, _ in reversed(self._buckets):
            if index < self._merged:
                break  # nothing older can have changed since the last call
            at = int(index) // group
            was = known.get(at)
            known[at] = (min(was[0], low), max(was[1], high)) if was else (low, high)
        self._merged = self._index
        first = t_ns // BUCKET_NS // group - width + 1
        return [known.get(at) for at in range(first, first + width)]


def shape(h: Histogram, low_ns: float, high_ns: float, width: int) -> str:
    """A histogram as block characters over a logarithmic axis; what lies beyond its ends counts at them.

    Heights are logarithmic, too, so that one tick among millions is still to be seen.
    """
    counts = [0] * width
    scale = width / math.log(high_ns / low_ns)
    for low, high, count in h.counts():
        at = int(scale * math.log(max(0.5 * (low + high), low_ns) / low_ns))
        counts[min(at, width - 1)] += count
    top = math.log1p(max(counts, default=0)) or 1.0
    return "".join(_BLOCKS[math.ceil(8 * math.log1p(n) / top)] for n in counts)


class Event(NamedTuple):
    """Something that happened in a tick."""

    t_ns: int
    kind: str  # request, fault, state or hunting
    what: int  # a RequestKind, bits of faults, the state before, or a Hunting
    then: int  # the Answer, nothing, or the state after


class History:
    """Everything the screen shows that one record alone does not tell.

    Args:
        sync: whether every source owes a frame in every tick; free-running ones are never `lost`.
    """

    def __init__(self, sync: bool = True) -> None:
        self.last: Record | None = None
        self.ticks = 0
        self.skipped = 0
        self.saturated = 0
        self.received = 0
        self.amiss = Amiss(sync)
        self.log_written: int | None = None
        self.log_dropped: int | None = None
        self.silent_s = 0.0  # since the newest record came
        self.lateness = Histogram()
        self.latency = Histogram()
        self.error = Trace()
        self.position = Trace()
        self.reference = Trace()
        self.velocity = Trace()
        self.command = Trace()
        self.p1 = Trace()
        self.p2 = Trace()
        self.supply = Trace()
        self.force = Trace()
        self.wanted = Trace()  # force, where one is
        self.bus_bit_s = math.nan  # on the wire, in the last whole second
        self._limited = Trace()  # 1 where the command was
        self._skips: deque[tuple[int, int]] = deque(maxlen=4096)  # time, ticks skipped before it
        self._bits, self._bits_ns = 0, 0  # since then
        self.events: deque[Event] = deque(maxlen=_EVENTS)
        self.first_ns = 0

    @property
    def elapsed_s(self) -> float:
        """Time between the first and the newest tick."""
        return (self.last.tick.t_ns - self.first_ns) * 1e-9 if self.last else 0.0

    def skipped_lately(self, t_ns: int) -> int:
        """Ticks skipped in the last `SPAN_S` seconds before t_ns."""
        return sum(n for at_ns, n in self._skips if at_ns > t_ns - SPAN_S * 1e9)

    def saturated_lately(self, t_ns: int) -> float:
        """Share of the last `SPAN_S` seconds before t_ns in which the command was limited; or NaN."""
        return self._limited.rms(t_ns) ** 2

    def add(self, records: Iterable[Record]) -> None:
        """Take records in their order."""
        for record in records:
            self._add(record)

    def _add(self, record: Record) -> None:
        tick, timing = record.tick, record.timing
        m = tick.measurement
        t_ns = tick.t_ns
        if self.last is None:
            self.first_ns = self._bits_ns = t_ns
        else:
            if m.skipped:
                self.skipped += m.skipped
                self._skips.append((t_ns, m.skipped))
            self._note_events(self.last.tick, tick)
        self.last = record
        self.ticks += 1
        self.received += len(record.frames)
        self.saturated += tick.command.saturated
        if timing.lateness_ns >= 0:
            self.lateness.add(timing.lateness_ns)
        if timing.latency_ns >= 0:
            self.latency.add(timing.latency_ns)
        self.amiss.add(m)
        self.error.add(t_ns, tick.error_m)
        self.position.add(t_ns, tick.estimate.position_m)
        self.reference.add(t_ns, tick.reference.position_m)
        self.velocity.add(t_ns, tick.estimate.velocity_m_s)
        self.command.add(t_ns, tick.command.voltage_v)
        self.p1.add(t_ns, m.p1_pa)
        self.p2.add(t_ns, m.p2_pa)
        self.supply.add(t_ns, m.supply_pa)
        self.force.add(t_ns, tick.estimate.x3_n)
        if tick.state == PRESSING:
            self.wanted.add(t_ns, tick.command.ustar)
        self._limited.add(t_ns, float(tick.command.saturated))
        self._count_bits(record, t_ns)

    def _count_bits(self, record: Record, t_ns: int) -> None:
        """What the frames of a tick keep the wire busy with; those of others are heard of, or not."""
        for frames in (record.frames, record.sent):
            for frame in frames:
                self._bits += _FRAME_BITS + 8 * len(frame.data)
        if t_ns - self._bits_ns >= _SECOND_NS:
            self.bus_bit_s = _STUFFING * self._bits / ((t_ns - self._bits_ns) * 1e-9)
            self._bits, self._bits_ns = 0, t_ns

    def _note_events(self, before: Tick, now: Tick) -> None:
        if now.request is not None and not self._repeats(now):
            self.events.append(Event(now.t_ns, "request", now.request.kind, now.answer))
        if now.latched & ~before.latched:
            self.events.append(Event(now.t_ns, "fault", now.latched & ~before.latched, 0))
        if now.state != before.state:
            self.events.append(Event(now.t_ns, "state", before.state, now.state))
        if now.hunting != before.hunting:
            self.events.append(Event(now.t_ns, "hunting", now.hunting, 0))

    def _repeats(self, now: Tick) -> bool:
        """Whether a request is one of many alike, as those of a jog and an upload are."""
        last = next((e for e in reversed(self.events) if e.kind == "request"), None)
        return (
            last is not None
            and now.request is not None
            and now.request.kind in (RequestKind.JOG, RequestKind.PIECE)
            and (last.what, last.then) == (now.request.kind, now.answer)
        )
