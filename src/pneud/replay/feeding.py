"""What a replay needs of each tick of a log: what came in and what came of it, in the order of the log.

A `LoggedTick` says much more, and to make one takes longer than the axis does: it is made where it is asked
for.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import repeat
from typing import Any, NamedTuple, Protocol

from google.protobuf.message import DecodeError

from pneud.log.files.columns import usual_ticks
from pneud.log.files.reader import LoggedState, LogReader, RowBatch
from pneud.log.format.frames import FrameBlock
from pneud.log.format.records import LAYOUTS, LoggedTick, TickMessage, logged, unpack
from pneud.signals import Frame, Request, Tick, Told

_TAKEN = ("t_ns", "measurement.skipped", "measurement.host", "check")
_STATES = ("state", "present", "latched", "answer", "command.enable", "in_position", "hunting")


class Source(Protocol):
    """Where ticks have come from."""

    def whole(self, fed: Fed) -> LoggedTick:
        """All that is logged of one."""


class Fed(NamedTuple):
    """One tick."""

    number: int
    log_time_ns: int
    t_ns: int
    skipped: int
    host: int
    check: int
    states: tuple[int, ...]  # as from `states_of`
    frames: tuple[Frame, ...]
    before: int  # how many of them were drained before SYNC left
    sent: tuple[Frame, ...]
    request: Request | None
    told: Told | None
    place: int
    source: Source

    def whole(self) -> LoggedTick:
        """All that is logged of it."""
        return self.source.whole(self)


def states_of(t: Tick | LoggedTick) -> tuple[int, ...]:
    """What of a tick may not differ at all; the sixth and seventh say how the load stands at its target."""
    states = t.state, t.present, t.latched, t.answer, t.command.enable, t.in_position, t.hunting
    if t.program is None and t.station is None:
        return states
    return (*states, *(t.program or ()), *(t.station or ()))


def without_standing(states: tuple[int, ...]) -> tuple[int, ...]:
    """Those that a log has which does not say how the load stands at its target."""
    return (*states[:5], *states[7:])


def fed(log: LogReader, from_ns: int = 0) -> Iterator[Fed | LoggedState]:
    """Ticks and snapshots in their order; the log's `truncated` and so on are valid when it ends.

    Args:
        log: the log.
        from_ns: as for `LogReader.items`.
    """
    if from_ns:
        for item in log.items(from_ns):
            yield item if isinstance(item, LoggedState) else _single(item)
        return
    names, first_ns = log.fault_names, -1
    for raw in log.rows():
        if isinstance(raw, LoggedState):
            yield raw
        elif isinstance(raw, RowBatch):
            number = int(raw.ticks[0].number[0])
            try:
                if (table := usual_ticks(raw.ticks)) is not None:
                    first_ns = first_ns if first_ns >= 0 else int(table["t_ns"][0])
                    yield from _Batch(raw, table, names, first_ns)
                    continue
                for tick in _singles(raw, names, first_ns):
                    number = tick.number
                    first_ns = first_ns if first_ns >= 0 else tick.t_ns
                    yield tick
            except (DecodeError, KeyError, ValueError) as e:
                log.damaged_at(number, e)
                return


class _Batch:
    """Ticks of which none has anything that only some have."""

    def __init__(self, raw: RowBatch, table: Any, names: tuple[str, ...], first_ns: int) -> None:
        self._raw, self._table, self._names, self._first_ns = raw, table, names, first_ns

    def __iter__(self) -> Iterator[Fed]:
        table = self._table
        t_ns, *taken = (table[name].tolist() for name in _TAKEN)
        frames, before, sent = zip(*FrameBlock(self._raw.frames).ticks(t_ns), strict=True)
        runs = self._raw.ticks
        return map(
            Fed,
            (number for run in runs for number in run.number.tolist()),
            (time_ns for run in runs for time_ns in run.log_time_ns.tolist()),
            t_ns,
            *taken,
            zip(*(table[name].tolist() for name in _STATES), strict=True),
            frames,
            before,
            sent,
            repeat(None),
            repeat(None),
            range(len(t_ns)),
            repeat(self),
        )

    def whole(self, fed: Fed) -> LoggedTick:
        """All that is logged of one of them."""
        run = next(run for run in self._raw.ticks if run.number[0] <= fed.number <= run.number[-1])
        data = run.rows[fed.number - int(run.number[0])].tobytes()
        message = TickMessage(fed.number, fed.log_time_ns, run.schema, data)
        values = LAYOUTS[run.schema].unpack(data)
        return logged(message, values, (fed.frames, fed.before, fed.sent), self._first_ns, self._names)


class _Single:
    """A tick by itself."""

    def __init__(self, tick: LoggedTick) -> None:
        self._tick = tick

    def whole(self, _: Fed) -> LoggedTick:
        """It."""
        return self._tick


def _single(t: LoggedTick) -> Fed:
    m = t.measurement
    return Fed(
        *(t.number, t.log_time_ns, t.t_ns, m.skipped, m.host, t.check, states_of(t)),
        *(t.frames, t.before, t.sent, t.request, t.told, 0, _Single(t)),
    )


def _singles(raw: RowBatch, names: tuple[str, ...], first_ns: int) -> Iterator[Fed]:
    """Ticks of which some have a request, or something else that only some have."""
    messages = [
        TickMessage(number, time_ns, run.schema, row.tobytes())
        for run in raw.ticks
        for number, time_ns, row in zip(run.number.tolist(), run.log_time_ns.tolist(), run.rows, strict=True)
    ]
    ticks = unpack(messages, FrameBlock(raw.frames), None if first_ns < 0 else first_ns, names)
    return map(_single, ticks)
