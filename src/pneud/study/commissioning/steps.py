"""What a commissioning moves, as data: steps, each with what moves in it, how far, how fast and for how long.

Slow ones come first. All ways lie within the travel, and within what `limits.motion` allows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

from pneud.axis.state import AxisParameters
from pneud.axis.stops import soft_limits
from pneud.console import profiles
from pneud.control.probe import Probe
from pneud.control.reference import Bounds, Septic
from pneud.signals import Request, RequestKind, State
from pneud.study.commissioning.movement import moves as loosening
from pneud.study.commissioning.testing import LEASE_S, request_of
from pneud.study.identification.motions import MOTIONS, Motion

DWELL_S, SETTLED_S, AIRLESS_S = 0.3, 0.2, 0.5  # at rest behind a way; once armed; with the valve centred
APPROACH, APPROACH_SHARE_S = 0.4, 0.1  # ways between: of limits.motion, of the travel in a second
WIDEST = 0.1  # of the greatest command: no edge is further from 0 V, centre included
RAMP_M, RAMP_M_S = 2e-3, 0.03  # a ramp ends where the load has moved so far, or so fast
FIRST_V_S = 0.5  # of the first ramps: what leaks through a valve that is shut has no time to push by itself
SMALLER = 0.8  # amplitudes from one to the next, until limits.motion allows one


class Act(NamedTuple):
    """Something that is asked for, and where it ends."""

    requests: tuple[Request, ...]  # one in a tick
    until: int  # the state in which it has ended
    dwell_s: float = 0.0  # in that state behind it
    lease: int = 0  # ticks after which a probe has to be renewed
    settled: bool = False  # it waits for load and air to come to rest, for a while


class Step(NamedTuple):
    """Acts in a row that are announced together."""

    name: str
    words: str  # what moves, how far, how fast
    seconds: float
    acts: tuple[Act, ...]


class Ground(NamedTuple):
    """Where an axis may move, and how."""

    low_m: float
    high_m: float
    motion: Bounds
    approach_m_s: float
    u_max_v: float
    shut: bool  # the valve is, at 0 V
    probe: Probe

    def at(self, share: float) -> float:
        """A place in the travel [m]."""
        return self.low_m + share * (self.high_m - self.low_m)


def ground_of(p: AxisParameters) -> Ground:
    """Of an axis."""
    low_m, high_m = soft_limits(p)
    lease = max(1, round(LEASE_S / p.controller.h))
    approach = min(APPROACH * p.motion.speed_m_s, APPROACH_SHARE_S * (high_m - low_m))
    shut = abs(p.controller.valve.centre_v) <= p.controller.valve.dead_zone_v
    return Ground(low_m, high_m, p.motion, approach, p.output.u_max_v, shut, loosening(p, lease)[0])


def first(p: AxisParameters) -> list[Step]:
    """The valve opened slowly both ways where the load is: its edges, before a loop is closed with them."""
    g = ground_of(p)
    return [_here(m._replace(rate_v_s=FIRST_V_S), g) for m in MOTIONS if m.kind == "ramp"]


def static(p: AxisParameters) -> list[Step]:
    """Slow ways, and at each place the valve opened slowly both ways while the axis is disarmed.

    A load whose valve is open at 0 V would drift away then; it is not disarmed.
    """
    g = ground_of(p)
    return _joined(g, [m for m in MOTIONS if m.kind == "rest" or (m.kind == "ramp" and g.shut)])


def dynamic(p: AxisParameters) -> list[Step]:
    """Ways and sines, from the slowest to the fastest."""
    g = ground_of(p)
    moving = [m for m in MOTIONS if m.kind in ("moves", "sine", "step")]
    return _joined(g, sorted(moving, key=lambda m: _speed(m, g)))


def gentler(bounds: Bounds, share: float) -> Bounds:
    """Motion that takes longer: so much of its speed, and of what brings it there."""
    return Bounds(*(share * value for value in bounds))


def length_s(steps: Iterable[Step]) -> float:
    """How long they take, about [s]."""
    return sum(step.seconds for step in steps)


def reach_m(steps: Iterable[Step]) -> list[float]:
    """All places that are asked for [m]."""
    found = []
    for request in (r for step in steps for act in step.acts for r in act.requests):
        if request.kind == RequestKind.GOTO:
            found.append(request.values[0])
        elif request.kind == RequestKind.PIECE and request.values:
            found.append(request.values[1])
    return found


def _speed(m: Motion, g: Ground) -> float:
    if m.kind == "sine":
        return 2.0 * math.pi * m.frequency_hz * m.amplitude * (g.high_m - g.low_m)
    return m.speed_m_s or math.inf


def _joined(g: Ground, motions: Sequence[Motion]) -> list[Step]:
    """The steps of motions, in which the load is where the one before has left it."""
    made, at_m = [], math.nan
    for m in motions:
        step, at_m = _MAKERS[m.kind](m, g, at_m)
        made.append(step)
    return made


def arm() -> Act:
    """Engage and hold, where that is not done already."""
    return Act((Request(RequestKind.ARM),), State.HOLDING, SETTLED_S)


def _disarm(dwell_s: float) -> Act:
    return Act((Request(RequestKind.DISARM),), State.DISARMED, dwell_s)


def _goto(to_m: float, speed_m_s: float, dwell_s: float = DWELL_S) -> Act:
    return Act((Request(RequestKind.GOTO, (to_m, speed_m_s)),), State.HOLDING, dwell_s)


def _way_s(from_m: float, to_m: float, speed_m_s: float, g: Ground) -> float:
    """How long a way takes, about [s]."""
    if not math.isfinite(from_m):
        from_m = g.at(0.5)
    return abs(to_m - from_m) / speed_m_s + speed_m_s / g.motion.acceleration_m_s2 + 0.1


def _still(m: Motion, g: Ground, from_m: float) -> tuple[Step, float]:
    to_m = g.at(m.places[0])
    acts = [arm(), _goto(to_m, g.approach_m_s, m.seconds)]
    words = f"slowly to {_mm(to_m)} mm at {_mm(g.approach_m_s)} mm/s, and rest there, held"
    seconds = _way_s(from_m, to_m, g.approach_m_s, g) + m.seconds + SETTLED_S
    if g.shut:
        acts.append(_disarm(m.seconds))
        words, seconds = f"{words} and centred", seconds + m.seconds
    return Step("rest", words, seconds, tuple(acts)), to_m


def _here(m: Motion, g: Ground) -> Step:
    (out, back), seconds = _both_ways(m, g)
    # a chamber that is full, or empty, shows nothing until the other way has been open
    acts = (out._replace(settled=True), back, out)
    words = (
        "where the load is, disarmed, the valve opens slowly both ways, for at most"
        f" {_mm(RAMP_M)} mm at {_mm(RAMP_M_S)} mm/s"
    )
    return Step("edges", words, 1.5 * seconds, acts)


def _ramps(m: Motion, g: Ground, from_m: float) -> tuple[Step, float]:
    acts: list[Act] = []
    seconds = 0.0
    openings, opening_s = _both_ways(m, g)
    for place in m.places:
        to_m = g.at(place)
        acts += [arm(), _goto(to_m, g.approach_m_s), _disarm(AIRLESS_S), *openings]
        seconds += _way_s(from_m, to_m, g.approach_m_s, g) + opening_s + SETTLED_S + DWELL_S + AIRLESS_S
        from_m = to_m
    places = ", ".join(f"{100.0 * place:g}" for place in m.places)
    words = (
        f"slowly to {places} % of the travel at {_mm(g.approach_m_s)} mm/s; there, disarmed, the valve opens"
        f" slowly both ways, for at most {_mm(RAMP_M)} mm at {_mm(RAMP_M_S)} mm/s"
    )
    return Step("edges", words, seconds, tuple(acts)), from_m


def _both_ways(m: Motion, g: Ground) -> tuple[list[Act], float]:
    """A ramp each way, and how long they take at most [s]."""
    goal_v = min(WIDEST * g.u_max_v + m.opening_v, g.u_max_v)
    bounds = g.probe._replace(rate_v_s=m.rate_v_s, travel_m=RAMP_M, speed_m_s=RAMP_M_S)
    acts = [_opening(bounds._replace(goal_v=way * goal_v)) for way in (1.0, -1.0)]
    return acts, 2.0 * (goal_v / m.rate_v_s + AIRLESS_S)


def _opening(p: Probe) -> Act:
    return Act((request_of(p),), State.DISARMED, AIRLESS_S, p.lease)


def _moves(m: Motion, g: Ground, from_m: float) -> tuple[Step, float]:
    speed_m_s = min(m.speed_m_s or g.motion.speed_m_s, g.motion.speed_m_s)
    first, *others = (g.at(place) for place in m.places)
    acts = [arm(), _goto(first, max(speed_m_s, g.approach_m_s))]
    acts += [_goto(place, speed_m_s) for place in others]
    seconds = _way_s(from_m, first, max(speed_m_s, g.approach_m_s), g) + len(acts) * DWELL_S
    seconds += sum(_way_s(a, b, speed_m_s, g) for a, b in pairwise((first, *others)))
    places = ", ".join(_mm(place) for place in (first, *others))
    return Step("moves", f"to {places} mm at {_mm(speed_m_s)} mm/s", seconds, tuple(acts)), others[-1]


def _sine(m: Motion, g: Ground, from_m: float) -> tuple[Step, float]:
    centre_m = g.at(m.places[0])
    pieces, amplitude_m = sine(
        centre_m, m.amplitude * (g.high_m - g.low_m), m.frequency_hz, m.seconds, g.motion
    )
    acts = (
        arm(),
        _goto(centre_m, g.approach_m_s),
        Act(tuple(profiles.requests(pieces)), State.HOLDING, DWELL_S),
    )
    seconds = _way_s(from_m, centre_m, g.approach_m_s, g) + m.seconds + SETTLED_S + 2.0 * DWELL_S
    words = f"±{_mm(amplitude_m)} mm about {_mm(centre_m)} mm at {m.frequency_hz:g} Hz for {m.seconds:g} s"
    return Step("sine", words, seconds, acts), centre_m


def sine(
    centre_m: float, amplitude_m: float, frequency_hz: float, seconds: float, bounds: Bounds
) -> tuple[list[Septic], float]:
    """A sine that swells and fades, as wide as bounds allow, and its amplitude [m]."""
    while True:
        pieces = profiles.chirp(centre_m, amplitude_m, frequency_hz, frequency_hz, seconds)
        try:
            profiles.check(pieces, bounds, -math.inf, math.inf)
        except profiles.ProfileError:
            amplitude_m *= SMALLER
        else:
            return pieces, amplitude_m


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.4g}"


_MAKERS = {"rest": _still, "ramp": _ramps, "moves": _moves, "sine": _sine}
