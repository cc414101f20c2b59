"""How far two courses of the same axis are apart, in bounded memory."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from pneud.log.files.reader import LogReader
from pneud.log.format.records import LoggedTick
from pneud.replay.replaying import differ, pairs
from pneud.safety.supervisor import is_engaged
from pneud.signals import Tick

POINTS = 4096  # of a picture
NAN = float("nan")


class CommandSpread(NamedTuple):
    """How one variable differs."""

    ticks: int  # in which it does
    first_tick: int
    max: float  # greatest difference; NaN for what is no number
    max_tick: int
    rms: float  # over all ticks compared in which it is a number; NaN for what is no number


class Point(NamedTuple):
    """One tick of a picture: the first course, then the second."""

    t_s: float
    error_m: tuple[float, float]
    velocity_m_s: tuple[float, float]
    force_n: tuple[float, float]
    voltage_v: tuple[float, float]


class _Tally:
    __slots__ = ("count", "first", "most", "most_tick", "numbers", "squares")

    def __init__(self, tick: int) -> None:
        self.count = self.numbers = 0
        self.first = self.most_tick = tick
        self.most = NAN
        self.squares = 0.0


class Differences:
    """Collects; `add` each pair of ticks.

    Attributes:
        ticks: pairs so far.
        differing: those in which anything but measurements differs.
        points: some of them, evenly spread, for a picture.
    """

    def __init__(self, *, exact: bool) -> None:
        """Nothing yet.

        Args:
            exact: both are given to the bit, or rounded alike; else one is rounded as in a compact log.
        """
        self._exact = exact
        self.ticks = 0
        self.differing = 0
        self.points: list[Point] = []
        self._stride = 1
        self._start_ns = 0
        self._tallies: dict[str, _Tally] = {}

    def add(self, one: LoggedTick, other: Tick | LoggedTick) -> None:
        """One more pair of ticks."""
        if self.ticks == 0:
            self._start_ns = one.t_ns
        number, found = one.number - 1, False
        for name, was, now in pairs(one, other):
            if name.startswith("measurement.") or not differ(name, was, now, exact=self._exact):
                continue
            found = True
            tally = self._tallies.get(name)
            if tally is None:
                tally = self._tallies[name] = _Tally(number)
            tally.count += 1
            if isinstance(was, float) and isinstance(now, float) and math.isfinite(apart := abs(now - was)):
                tally.squares += apart * apart
                if not apart <= tally.most:
                    tally.most, tally.most_tick = apart, number
        self.differing += found
        if self.ticks % self._stride == 0:
            self._add_point(one, other)
        self.ticks += 1

    def _add_point(self, one: LoggedTick, other: Tick | LoggedTick) -> None:
        self.points.append(
            Point(
                (one.t_ns - self._start_ns) * 1e-9,
                (one.error_m, other.error_m),
                (one.estimate.velocity_m_s, other.estimate.velocity_m_s),
                (one.estimate.force_n, other.estimate.force_n),
                (one.command.voltage_v, other.command.voltage_v),
            )
        )
        if len(self.points) == POINTS:
            self.points, self._stride = self.points[::2], 2 * self._stride

    def spreads(self) -> dict[str, CommandSpread]:
        """The variables that differ, those that do so first at the top."""
        found = {
            name: CommandSpread(
                t.count,
                t.first,
                t.most,
                t.most_tick,
                math.sqrt(t.squares / self.ticks) if math.isfinite(t.most) else NAN,
            )
            for name, t in self._tallies.items()
        }
        return dict(sorted(found.items(), key=lambda item: item[1].first_tick))


class LogComparison(NamedTuple):
    """Two logs side by side."""

    differences: Differences
    shift_ticks: int  # of the second log, so that both are engaged in the same tick
    engaged_ticks: int  # of those compared


def compare(one: LogReader, other: LogReader) -> LogComparison:
    """Two logs tick by tick, from the first tick in which each is engaged, if it ever is.

    Ticks are paired by their numbers; where one log lacks records, the other's are passed over.
    """
    shift = _engaged_from(other) - _engaged_from(one)
    alike = one.metadata.get("detail") == other.metadata.get("detail")
    found, engaged = Differences(exact=alike), 0
    firsts, seconds = iter(one), iter(other)
    second = next(seconds, None)
    for first in firsts:
        while second is not None and second.number < first.number + shift:
            second = next(seconds, None)
        if second is None:
            break
        if second.number == first.number + shift:
            found.add(first, second)
            engaged += is_engaged(first.state) or is_engaged(second.state)
    for rest in (firsts, seconds):
        deque(rest, maxlen=0)  # damage behind the last pair is damage
    return LogComparison(found, shift, engaged)


def _engaged_from(log: LogReader) -> int:
    return next((tick.number for tick in log if is_engaged(tick.state)), 0)
