"""What an axis is put through to see what it is worth, and what that comes to: a sine, rest, steps.

The motions are data; an operator asks for one after another, in simulation and on the daemon. What they come
to is read from the recorded ticks alone. A push is left out: only the law opens the valve of an engaged axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from statistics import fmean
from typing import Any, NamedTuple

from pneud.axis.state import AxisParameters
from pneud.axis.stops import soft_limits
from pneud.console import profiles
from pneud.control.profile import extent
from pneud.control.reference import Septic
from pneud.loop.summary import finite
from pneud.loop.tracking import AFTER_S
from pneud.signals import Record, Request, RequestKind, State, Tick, true_error_m
from pneud.study.commissioning.playing import Player
from pneud.study.commissioning.steps import Act, Step, arm, sine
from pneud.study.judging import (
    ARRIVED_S,
    LONG_M,
    MOVING_V,
    RESTING_V,
    ROOM_M,
    SETTLING_S,
    STEPS_M,
    WITHIN_M,
    Figure,
    Tolerances,
)

FREQUENCY_HZ, AMPLITUDE = 0.5, 0.1  # of the sine; of the stroke at most
SINE_S = 15.0  # with a period in which it swells, and one in which it fades
PEAK_M = 2e-4
REST_S = 5.0  # judged, behind SETTLING_S
FAR_M, FAR_SHARE, FAR_ROUND_M = 0.1, 0.8, 0.01  # the longest steps; of the travel at most, in whole of these
DWELL_S = 1.0  # behind a step
HOLDING, TRACKING = int(State.HOLDING), int(State.TRACKING)


class Part(NamedTuple):
    """A motion from rest to rest; what it is called is how it is judged."""

    name: str  # sine, rest, "1 mm", …; empty for a way that is not judged
    pieces: tuple[Septic, ...] = ()  # to be followed, or
    to_m: float = 0.0  # where to go
    dwell_s: float = 0.0  # at rest behind it

    @property
    def act(self) -> Act:
        """What is asked for."""
        goto = Request(RequestKind.GOTO, (self.to_m,))
        requests = tuple(profiles.requests(self.pieces)) if self.pieces else (goto,)
        return Act(requests, State.HOLDING, self.dwell_s)

    @property
    def words(self) -> str:
        """What will move, and how far."""
        if not self.pieces:
            return f"{self.name or 'way'}: to {1e3 * self.to_m:.4g} mm, {self.dwell_s:g} s at rest"
        reach_m = [extent(piece) for piece in self.pieces]
        low_m, high_m = min(e.low_m for e in reach_m), max(e.high_m for e in reach_m)
        length_s = profiles.duration_s(self.pieces)
        return f"{self.name}: {1e3 * low_m:.4g} … {1e3 * high_m:.4g} mm for {length_s:.3g} s"


def course(p: AxisParameters, stroke_m: float) -> tuple[Part, ...]:
    """All motions, from the middle of the travel on, within travel and bounds."""
    low_m, high_m = soft_limits(p)
    centre_m, room_m = 0.5 * (low_m + high_m), 0.5 * (high_m - low_m)
    pieces, _ = sine(centre_m, min(AMPLITUDE * stroke_m, room_m), FREQUENCY_HZ, SINE_S, p.motion)
    parts = [
        Part("", to_m=centre_m, dwell_s=DWELL_S),
        Part("sine", pieces=tuple(pieces), to_m=centre_m),
        Part("rest", to_m=centre_m, dwell_s=SETTLING_S + REST_S),
    ]
    at_m = centre_m
    for by_m in STEPS_M:
        if abs(by_m) < LONG_M or room_m > ROOM_M:
            at_m += by_m
            parts.append(Part(f"{1e3 * abs(by_m):g} mm", to_m=at_m, dwell_s=DWELL_S))
    far_m = min(FAR_M, FAR_ROUND_M * math.floor(2.0 * FAR_SHARE * room_m / FAR_ROUND_M))
    if far_m > ROOM_M:
        rear_m = centre_m - 0.5 * far_m
        parts.append(Part("", to_m=rear_m, dwell_s=DWELL_S))
        for to_m in (rear_m + far_m, rear_m):
            parts.append(Part(f"{1e3 * far_m:.0f} mm", to_m=to_m, dwell_s=DWELL_S))
    return tuple(parts)


class Seen(NamedTuple):
    """A tick, and where the load really was; NaN where nobody knows."""

    tick: Tick
    truth_m: float

    def error_m(self, known: bool) -> float:
        """How far the load is from where it should be [m]: truly where that is known, else as estimated."""
        tick = self.tick
        if not known:
            return tick.error_m
        return float(true_error_m(tick.reference, tick.measurement.encoder_offset_ns, self.truth_m))


class Verified(NamedTuple):
    """What an axis is worth."""

    figures: tuple[Figure, ...]
    failure: str = ""  # why it has not come to its end
    faults: tuple[str, ...] = ()

    @property
    def missed(self) -> tuple[Figure, ...]:
        """What is beyond its limit."""
        return tuple(f for f in self.figures if f.ratio > 1.0)

    @property
    def holds(self) -> bool:
        """Everything was tried, and is within its limits."""
        return not self.failure and not self.missed

    def as_json(self) -> dict[str, Any]:
        """For scripts; what has no end is null."""
        figures = [finite({**f._asdict(), "holds": f.ratio <= 1.0}) for f in self.figures]
        return {"holds": self.holds, "failure": self.words or None, "figures": figures}

    @property
    def words(self) -> str:
        """What ended it, if anything did."""
        return ", ".join(self.faults) or self.failure


def came_to(part: Part, seen: Sequence[Seen], t: Tolerances) -> list[Figure]:
    """What a motion has come to.

    Args:
        part: which one.
        seen: its ticks, from the request to the end of the rest behind it.
        t: what counts as in position.
    """
    if part.name in ("sine", "rest"):
        return _followed(part, seen, t)
    return _stepped(part, seen, t) if part.name else []


def _followed(part: Part, seen: Sequence[Seen], t: Tolerances) -> list[Figure]:
    sine = part.name == "sine"
    begun = next((i for i, s in enumerate(seen) if s.tick.state == (TRACKING if sine else HOLDING)), 0)
    join_ns, known = seen[begun].tick.t_ns, _is_known(seen)
    from_ns = join_ns + (AFTER_S if sine else SETTLING_S) * 1e9
    until_ns = join_ns + (SINE_S - 1.0 / FREQUENCY_HZ if sine else part.dwell_s) * 1e9
    judged = [s for s in seen[begun:] if from_ns <= s.tick.t_ns < until_ns]
    errors_m = [e for e in (s.error_m(known) for s in judged) if math.isfinite(e)]
    steps_v = [abs(b.tick.command.voltage_v - a.tick.command.voltage_v) for a, b in pairwise(judged)]
    if not errors_m or not steps_v:
        return []
    most = Figure(part.name, "max_m", max(map(abs, errors_m)), PEAK_M if sine else t.still_m)
    step = Figure(part.name, "mean_step_v", fmean(steps_v), MOVING_V if sine else RESTING_V)
    rms = Figure("sine", "rms_m", math.sqrt(fmean(e * e for e in errors_m)), WITHIN_M)
    return [rms, most, step] if sine else [most, step]


def _stepped(part: Part, seen: Sequence[Seen], t: Tolerances) -> list[Figure]:
    known = _is_known(seen)
    places_m = [s.truth_m if known else s.tick.measurement.position_m for s in seen]
    way = math.copysign(1.0, part.to_m - places_m[0])
    end = next((i for i, s in enumerate(seen) if s.tick.state == HOLDING), len(seen))
    outside = max((i for i, at_m in enumerate(places_m) if abs(at_m - part.to_m) > t.position_m), default=0)
    h = 1e-9 * (seen[1].tick.t_ns - seen[0].tick.t_ns)
    after_s = math.inf if outside >= len(seen) - 1 else max(0, outside + 1 - end) * h
    over_m = max(way * (at_m - part.to_m) for at_m in places_m)
    return [
        Figure(part.name, "overshoot_m", max(0.0, over_m), t.over_m),
        Figure(part.name, "in_position_s", after_s, ARRIVED_S),
    ]


def _is_known(seen: Sequence[Seen]) -> bool:
    return math.isfinite(seen[0].truth_m)


def worst(figures: Iterable[Figure]) -> tuple[Figure, ...]:
    """Of figures of the same name, the one that takes most of its limit."""
    found: dict[tuple[str, str], Figure] = {}
    for f in figures:
        before = found.get((f.part, f.what))
        found[f.part, f.what] = f if before is None or f.ratio > before.ratio else before
    return tuple(found.values())


class Verification:
    """Has one motion after another played, and judges what they come to; an operator of the axis.

    Attributes:
        verdict: what came of it, once it is over.
    """

    def __init__(self, p: AxisParameters, parts: Sequence[Part], t: Tolerances) -> None:
        """Nothing has been asked for yet.

        Args:
            p: the axis.
            parts: from `course`.
            t: what its encoder allows for.
        """
        armed = Step("arm", "", 0.0, (arm(),))
        steps = [armed, *(Step(part.name, part.words, 0.0, (part.act,)) for part in parts)]
        self._player = Player(steps, p.controller.h, self._begun)
        self._todo = [Part(""), *parts]
        self._t = t
        self._part: Part | None = None  # that is under way or was the last
        self._seen: list[Seen] = []
        self._figures: list[Figure] = []
        self.verdict: Verified | None = None

    def _begun(self, _step: Step) -> None:
        """The next motion is to be asked for: the one before is over."""
        self._judge()
        self._part = self._todo.pop(0)

    def _judge(self) -> None:
        if self._part is not None:
            self._figures += came_to(self._part, self._seen, self._t)
        self._seen = []

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked of the axis in this tick; at the end that it shuts down."""
        wanted = self._player.ask(state, present)
        self._end()
        return wanted

    def see(self, record: Record) -> None:
        """What became of it."""
        self._player.see(record)
        self._end()
        if self.verdict is None and self._player.taken:
            self._seen.append(Seen(record.tick, record.truth_m))

    def _end(self) -> None:
        played = self._player.verdict
        if played is None or self.verdict is not None:
            return
        if played.whole:
            self._judge()
        self.verdict = Verified(worst(self._figures), played.failure, played.faults)
