"""What an inbox makes of a log's frames, a block of ticks at a time.

Most ticks are alike: every source answers once, in time, and counts on. Of a row of such ticks nothing is
left but how many they were, so that the inbox itself has to hear the others only, and a few of each row.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pneud.bus.codec import ROW, Codec, Codecs
from pneud.bus.many import raw, valid
from pneud.bus.mapped_inbox import inbox_of
from pneud.config.bus_tables import BusConfig
from pneud.log.files.columns import AFTER, BEFORE, SENT, Block, Ints
from pneud.signals import Frame

HEARD = 4  # ticks in a row that tell all that an inbox remembers but its counts
_NEAR_NS = 2  # so near to a bound the inbox decides, which computes in another order

Flags = NDArray[np.bool_]


def _are_plain(codecs: Codecs) -> bool:
    """Whether all answers are of messages that come in every tick, and can be judged by the thousand."""
    ages = [answer.codec.age_field for answer in codecs.answers]
    if any(answer.codec.length > 8 or answer.kind is not None for answer in codecs.answers):
        return False
    if any(age is not None and (age.floating or age.code is not None) for age in ages):
        return False
    return (
        codecs.row is None or not codecs.row.values[ROW.index("age_s")]
    )  # else all are older than they look


class Heard:
    """An inbox that takes a log block by block.

    Attributes:
        inbox: with its counts.
        sent: frames that left.
        fed: ticks that the inbox itself has heard.
    """

    def __init__(self, codecs: Codecs, bus: BusConfig) -> None:
        """Nothing has been heard."""
        self.inbox = inbox_of(codecs, bus)
        self.sent = self.fed = 0
        self._codecs = codecs
        self._passes = self.inbox.makes_sync and _are_plain(codecs)

    def add(self, block: Block) -> None:
        """Take the frames of a block."""
        frames, count = block.frames, len(block.number)
        self.sent += int(((frames.part == SENT) & (frames.stamp_ns >= 0)).sum())
        ends = self._rows(block) if self._passes else [0] * count
        starts = np.searchsorted(frames.tick, np.arange(count + 1)).tolist()
        t_ns, inbox, at = block.ticks["t_ns"].tolist(), self.inbox, 0
        while at < count:
            self._feed(block, starts[at], starts[at + 1], t_ns[at])
            at += 1
            left = ends[at - 1] - at - HEARD
            if left > 0 and inbox.at_ease:
                inbox.pass_over(left)
                at += left

    def _feed(self, block: Block, begin: int, end: int, t_ns: int) -> None:
        """One tick's frames, as they came."""
        inbox, command_id = self.inbox, self._codecs.valve_command.can_id
        commands: list[int] = []
        _, *columns = block.frames
        told = zip(*(column[begin:end].tolist() for column in columns), strict=True)
        begun = False
        for place, (stamp_ns, can_id, length, word, part) in enumerate(told, begin):
            if part != BEFORE and not begun:
                inbox.begin(t_ns)
                begun = True
            if part != SENT:
                data = block.long[place] if length > 8 else word.to_bytes(8, "little")[:length]
                inbox.feed(Frame(stamp_ns, can_id, data))
            elif can_id == command_id:
                commands.append(stamp_ns)
        if not begun:
            inbox.begin(t_ns)
        inbox.measurement(0, 0)
        inbox.commanded_ns = commands[0] if commands else -1
        self.fed += 1

    def _rows(self, block: Block) -> list[int]:
        """For each tick, where the row of ticks that are alike ends in which it stands."""
        frames, count = block.frames, len(block.number)
        received = np.bincount(frames.tick[frames.part != SENT], minlength=count)
        answers = {answer.codec.can_id: answer.codec for answer in self._codecs.answers}
        alike: Flags = received == len(answers)
        goes_on: Flags = np.ones(count, dtype=np.bool_)
        for codec in answers.values():
            once, counter = self._answered(codec, block)
            alike &= once
            if codec.counter_field is not None:
                goes_on[1:] &= (counter[1:] - counter[:-1]) % codec.counter_values == 1
        goes_on[1:] &= alike[1:] & alike[:-1]
        goes_on[:1] = False
        breaks = np.append(np.flatnonzero(~goes_on), count)
        ends: list[int] = breaks[np.searchsorted(breaks, np.arange(count), side="right")].tolist()
        return ends

    def _answered(self, codec: Codec, block: Block) -> tuple[Flags, Ints]:
        """In which ticks a source has answered, well and in time, and what its counter was."""
        frames, count = block.frames, len(block.number)
        mine = np.flatnonzero((frames.can_id == codec.can_id) & (frames.part == AFTER))
        tick, stamp_ns, data = frames.tick[mine], frames.stamp_ns[mine], frames.data[mine]
        good = valid(codec, frames.length[mine], data)
        if codec.age_field is not None:
            age_s = raw(codec.age_field, data, codec.length) * codec.age_field.scale + codec.age_field.offset
            good &= age_s * (1.0 + 1e-9) < self._codecs.older_s
            stamp_ns = stamp_ns - np.rint(age_s * 1e9).astype(np.int64)
        good &= stamp_ns >= block.ticks["t_ns"][tick] + _NEAR_NS
        answered = np.zeros(count, dtype=np.bool_)
        counter = np.zeros(count, dtype=np.int64)
        answered[tick] = good
        if codec.counter_field is not None:
            counter[tick] = raw(codec.counter_field, data, codec.length)
        return answered, counter
