"""What a log says about its bus: frames by identifier, what was wrong with them, and when they came.

It judges frames as the inbox does, a block at a time; a test holds the two together. Which SYNC a frame
answers only the inbox knows: late is what was sampled before its tick's SYNC, what a tick found late, and
what came before another one of its source.
"""

from __future__ import annotations

from collections import Counter
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.bus.codec import SOURCES, Answer, Codecs
from pneud.bus.dbc_layout import SignalField, shift
from pneud.bus.many import raw, valid
from pneud.bus.wire import CAN_ERR_FLAG
from pneud.log.files.columns import AFTER, BEFORE, SENT, Block, Floats, FrameColumns, Ints
from pneud.report.spread import Spread
from pneud.signals import Defect

_EMCY = range(0x081, 0x100)
_HEARTBEAT = range(0x701, 0x780)


class SourceHealth:
    """One of the messages that answer SYNC."""

    def __init__(self, answer: Answer, older_s: float) -> None:
        self.name, self.codec = answer.name, answer.codec
        self._multiplexed = answer.kind is not None
        role = next(name for name, keys in SOURCES.items() if not set(keys).isdisjoint(answer.filled))
        self._defects = f"measurement.{role}_defects"
        self.frames = self.lost = self.corrupt = self.frozen = self.late = 0
        self.answer = Spread()  # SYNC handed to the kernel → received
        self.age = Spread()  # received → command sent
        self._older_s = older_s
        self._counter = -1
        self._corrupt_since = 0

    def add(self, block: Block, sync_sent_ns: Ints, command_sent_ns: Ints, sync: bool) -> None:
        """Take the frames of a block."""
        codec, ticks, frames = self.codec, block.ticks, block.frames
        mine = (frames.can_id == codec.can_id) & (frames.part != SENT)
        kept = np.flatnonzero(mine)
        self.frames += len(kept)
        good = self._valid(block, kept)
        self.corrupt += int((~good).sum())
        # how many were corrupt since the last one that was taken
        corrupt = np.cumsum(~good) + self._corrupt_since
        kept, corrupt_before = kept[good], corrupt[good]
        if codec.counter_field is not None and len(kept):
            kept, corrupt_before = self._counted(block, kept, corrupt_before)
        self._corrupt_since = int(corrupt[-1]) if len(corrupt) else self._corrupt_since
        if len(kept):
            self._corrupt_since -= int(corrupt_before[-1])

        tick, stamp, part = frames.tick[kept], frames.stamp_ns[kept], frames.part[kept]
        age_s: Floats = np.zeros(len(tick))
        if codec.age_field is not None:
            age = self._raw(codec.age_field, block, kept)
            age_s = np.asarray(age * codec.age_field.scale + codec.age_field.offset, dtype=np.float64)
        late = age_s >= self._older_s
        if sync:
            sampled = stamp - np.rint(np.where(late, 0.0, age_s) * 1e9).astype(np.int64)
            late |= (part == BEFORE) | (sampled < ticks["t_ns"][tick])
            late |= (ticks[self._defects] & Defect.LATE != 0)[tick]
            if not self._multiplexed:  # of which several kinds may answer one SYNC
                late[:-1] |= tick[1:] == tick[:-1]
        self.late += int(late.sum())
        in_time = ~late & (part == AFTER)
        tick, stamp = tick[in_time], stamp[in_time]
        sent = sync_sent_ns[tick]
        # the answer's stamp may lie before that of a sender that was interrupted behind its send()
        self.answer.add(np.where(sent > 0, np.maximum(stamp - sent, 0), -1))
        sent = command_sent_ns[tick]
        self.age.add(np.where(sent > 0, np.maximum(sent - stamp, 0), -1))

    def _valid(self, block: Block, kept: Ints) -> NDArray[np.bool_]:
        if self.codec.length <= 8:
            return valid(self.codec, block.frames.length[kept], block.frames.data[kept])
        found = (self.codec.valid(block.long.get(i, b"")) for i in kept.tolist())
        return np.fromiter(found, dtype=np.bool_, count=len(kept))

    def _raw(self, field: SignalField, block: Block, kept: Ints) -> Ints:
        """Raw values of a field, of frames that are valid."""
        length = self.codec.length
        if length <= 8:
            return raw(field, block.frames.data[kept], length)
        order: Literal["big", "little"] = "big" if field.big_endian else "little"
        low, ones = shift(field, length), (1 << field.length) - 1
        words = [int.from_bytes(block.long[i], order) >> low & ones for i in kept.tolist()]
        sign = 1 << (field.length - 1) if field.signed else 0
        return np.array([(word ^ sign) - sign for word in words], dtype=np.int64)

    def _counted(self, block: Block, kept: Ints, corrupt_before: Ints) -> tuple[Ints, Ints]:
        """Those whose counter went on; counts the others, and what is missing between them."""
        assert self.codec.counter_field is not None
        counter = self._raw(self.codec.counter_field, block, kept)
        known = self._counter >= 0
        step = (
            np.diff(counter, prepend=self._counter if known else counter[0] - 1) % self.codec.counter_values
        )
        fresh = step != 0
        self.frozen += int((~fresh).sum())
        kept, corrupt_before, step = kept[fresh], corrupt_before[fresh], step[fresh]
        missing = np.maximum(0, step - 1 - np.diff(corrupt_before, prepend=0))
        self.lost += int(missing.sum())
        self._counter = int(counter[-1])
        return kept, corrupt_before


class HealthRow(NamedTuple):
    """An identifier on the bus."""

    can_id: int
    name: str
    direction: str  # "received", "sent"
    frames: int


class Health:
    """All of a log's frames."""

    def __init__(self, codecs: Codecs, sync: bool, period_ns: int) -> None:
        self.sources = tuple(
            SourceHealth(a, codecs.older_s if a.codec.age_field is not None else float("inf"))
            for a in {answer.codec.can_id: answer for answer in reversed(codecs.answers)}.values()
        )[::-1]
        self.sync_jitter = Spread()  # |interval between two SYNCs − what the ticks between them take|
        self.emcy: dict[int, int] = {}  # node → last error code
        self.error_frames = 0
        self.foreign = 0
        self.unsent = 0
        self._codecs = codecs
        self._sync = sync
        self._period_ns = period_ns
        self._count: Counter[tuple[int, bool]] = Counter()
        self._last_sync: tuple[int, int] | None = None  # number of the record, time

    def add(self, block: Block) -> Ints:
        """Take a block.

        Returns:
            For each tick, how far its SYNC lies from the grid that the one before began [ns]; −1 if unknown.
        """
        frames, count = block.frames, len(block.number)
        sync_id, command_id = self._codecs.sync.can_id, self._codecs.valve_command.can_id
        sent = frames.part == SENT

        def sent_ns(can_id: int) -> Ints:
            of_it = sent & (frames.can_id == can_id)
            times = np.full(count, -1, dtype=np.int64)
            times[frames.tick[of_it]] = frames.stamp_ns[of_it]
            return times

        sync_ns, command_ns = sent_ns(sync_id), sent_ns(command_id)
        left = ~sent | (frames.stamp_ns >= 0)
        self.unsent += int((~left).sum())
        ids, counts = np.unique(frames.can_id[left] << 1 | sent[left], return_counts=True)
        for key, n in zip(ids.tolist(), counts.tolist(), strict=True):
            self._count[key >> 1, bool(key & 1)] += n
        received = frames.can_id[~sent]
        errors = received & CAN_ERR_FLAG != 0
        self.error_frames += int(errors.sum())
        own = (sync_id, command_id) if self._sync else (command_id,)
        self.foreign += int(np.isin(received[~errors], own).sum())
        for source in self.sources:
            source.add(block, sync_ns, command_ns, self._sync)
        self._emergencies(frames)
        return self._jitter(block, sync_ns)

    def _emergencies(self, frames: FrameColumns) -> None:
        emcy = (
            (frames.part != SENT)
            & (frames.can_id >= _EMCY[0])
            & (frames.can_id <= _EMCY[-1])
            & (frames.length >= 2)
        )
        for can_id, word in zip(frames.can_id[emcy].tolist(), frames.data[emcy].tolist(), strict=True):
            self.emcy[can_id - 0x080] = word & 0xFFFF

    def _jitter(self, block: Block, sync_sent_ns: Ints) -> Ints:
        found = np.full(len(block.number), -1, dtype=np.int64)
        known = np.flatnonzero(sync_sent_ns >= 0)
        if not len(known):
            return found
        number, times = block.number[known], sync_sent_ns[known]
        skipped = block.ticks["measurement.skipped"].astype(np.int64)[known]
        first = self._last_sync or (-1, 0)
        steps = np.diff(number, prepend=first[0])
        off = np.abs(np.diff(times, prepend=first[1]) - (1 + skipped) * self._period_ns)
        following = steps == 1  # across a gap nothing is known of the ticks that were skipped
        found[known] = np.where(following, off, -1)
        self.sync_jitter.add(found)
        self._last_sync = (int(number[-1]), int(times[-1]))
        return found

    def rows(self) -> list[HealthRow]:
        """Identifiers in order, the error frames left out."""
        return [
            HealthRow(can_id, self._name(can_id), "sent" if sent else "received", count)
            for (can_id, sent), count in sorted(self._count.items())
            if not can_id & CAN_ERR_FLAG
        ]

    def _name(self, can_id: int) -> str:
        c = self._codecs
        names = {
            c.sync.can_id: "SYNC",
            c.valve_command.can_id: "valve command",
            **{s.codec.can_id: s.name.replace("_", " ") for s in self.sources},
        }
        if can_id in names:
            return names[can_id]
        if can_id in _EMCY:
            return f"emergency of node {can_id - 0x080}"
        if can_id in _HEARTBEAT:
            return f"heartbeat of node {can_id - 0x700}"
        return ""
