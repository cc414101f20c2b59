"""An operator of a simulation who asks for one position or force after another, and what becomes of each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from pneud.axis.state import AxisParameters
from pneud.axis.stops import soft_limits
from pneud.safety.faults import BLOCKS_ARM
from pneud.signals import Answer, Record, Request, RequestKind, State

DWELL_S = 0.5  # in position before the next
PATIENCE_S = 5.0  # for a load that does not come, once the reference stands


class Move(NamedTuple):
    """A position to go to; at most so fast, 0 for the configured speed."""

    to_m: float
    speed_m_s: float = 0.0


class Push(NamedTuple):
    """A force of the piston to press with, by a ramp, 0 for the configured one."""

    to_n: float
    rate_n_s: float = 0.0


class MovesError(Exception):
    """A list of moves makes no sense; the text is one line for a person."""

    exit_code = 2


def moves_of(text: str) -> list[Move]:
    """The moves of a text such as "100,250@300,50": positions [mm], with `@` a speed [mm/s].

    Raises:
        MovesError: it is no such list.
    """
    return [Move(*_numbers(part, 1e-3, _MOVE)) for part in text.split(",")]


def steps_of(text: str) -> list[Move | Push]:
    """As `moves_of`, with forces among them: "450,200N,-100N@500", newtons and with `@` newtons a second.

    Raises:
        MovesError: it is no such list.
    """
    found: list[Move | Push] = []
    for part in text.split(","):
        force, n, ramp = part.partition("N")
        if n and (not ramp or ramp.startswith("@")):
            found.append(Push(*_numbers(force + ramp, 1.0, _PUSH)))
        else:
            found.append(Move(*_numbers(part, 1e-3, _MOVE)))
    return found


def check(steps: Sequence[Move | Push], p: AxisParameters) -> None:
    """See whether the axis would take the moves, wherever it stands.

    Raises:
        MovesError: which it would not, and why.
    """
    low_m, high_m = soft_limits(p)
    k, most_m_s = p.pressing, p.motion.speed_m_s
    for step in steps:
        if isinstance(step, Push):
            if not -k.in_n <= step.to_n <= k.out_n:
                raise MovesError(
                    f"{step.to_n:g} N: limits.force and the supply allow {-k.in_n:.4g} … {k.out_n:.4g} N"
                )
        elif not low_m <= step.to_m <= high_m:
            raise MovesError(
                f"{1e3 * step.to_m:g} mm lies outside the travel {1e3 * low_m:g} … {1e3 * high_m:g} mm"
            )
        elif step.speed_m_s > most_m_s:
            raise MovesError(
                f"{1e3 * step.speed_m_s:g} mm/s is faster than limits.motion.speed_m_s;"
                f" at most {1e3 * most_m_s:g} mm/s"
            )


_MOVE = "a move is MM or MM@MM_S, such as 100,250@300"
_PUSH = "a force is NN or NN@N_S, such as 200N@1000"


def _numbers(part: str, unit: float, form: str) -> list[float]:
    try:
        numbers = [float(number) * unit for number in part.split("@")]
    except ValueError:
        numbers = []
    sound = 1 <= len(numbers) <= 2 and all(map(math.isfinite, numbers))
    if not sound or min(numbers[1:], default=1.0) <= 0.0:
        raise MovesError(f"{part!r}: {form}")
    return numbers


class Course:
    """Arms, asks for the moves in turn, and measures them.

    Attributes:
        over: the last one has been held, one was refused, or a fault has ended it.
    """

    def __init__(self, moves: Sequence[Move | Push], rod_force_n: float = 0.0) -> None:
        self._moves = list(moves)
        self._rod_force_n = rod_force_n
        self._results: list[dict[str, Any]] = []
        self._armed = self._ended = self.over = False
        self._asked_ns = self._stood_ns = self._arrived_ns = -1
        self._from_m = self._overshoot_m = 0.0
        self._next = True  # may be asked for

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked of the axis in this tick; an `Operator`."""
        if self.over:
            ended, self._ended = self._ended, True
            return None if ended else Request(RequestKind.SHUTDOWN)
        if not self._armed:
            if state != State.DISARMED or present & BLOCKS_ARM:
                return None
            self._armed = True
            return Request(RequestKind.ARM)
        if state not in (State.HOLDING, State.PRESSING) or not self._next or not self._moves:
            return None
        self._next = False
        move = self._moves.pop(0)
        self._results.append(_open(move))
        if isinstance(move, Push):
            values = (move.to_n, move.rate_n_s, 0.0, 0.0, 0.0, 0.0)
            return Request(RequestKind.FORCE, values)
        return Request(RequestKind.GOTO, (move.to_m, move.speed_m_s))

    def see(self, record: Record) -> None:
        """What became of it in a tick."""
        tick = record.tick
        asked = 0 if tick.request is None else tick.request.kind
        if tick.state == State.FAULT or (asked == RequestKind.ARM and tick.answer != Answer.TAKEN):
            self.over = True
        elif asked in (RequestKind.GOTO, RequestKind.FORCE):
            self._begin(record)
        elif not self._next and not self.over:
            if "to_n" in self._results[-1]:
                self._press(record)
            else:
                self._follow(record)

    def _begin(self, record: Record) -> None:
        tick = record.tick
        self._asked_ns, self._stood_ns, self._arrived_ns = tick.t_ns, -1, -1
        self._from_m, self._overshoot_m = record.truth_m, 0.0
        if tick.answer != Answer.TAKEN:
            self._results[-1]["refused"] = Answer(tick.answer).name.lower()
            self.over = True

    def _follow(self, record: Record) -> None:
        tick, result = record.tick, self._results[-1]
        to_m = 1e-3 * result["to_mm"]
        beyond_m = record.truth_m - to_m
        self._overshoot_m = max(self._overshoot_m, math.copysign(1.0, to_m - self._from_m) * beyond_m)
        if tick.state != State.HOLDING:
            return
        if self._stood_ns < 0:
            self._stood_ns = tick.t_ns
        if not tick.in_position:
            self._arrived_ns = -1
        elif self._arrived_ns < 0:
            self._arrived_ns = tick.t_ns
        arrived = self._arrived_ns >= 0 and tick.t_ns - self._arrived_ns >= DWELL_S * 1e9
        if not arrived and tick.t_ns - self._stood_ns < PATIENCE_S * 1e9:
            return
        if arrived:
            result["in_position_s"] = round(1e-9 * (self._arrived_ns - self._asked_ns), 4)
        result["error_mm"] = _mm(-beyond_m)
        result["overshoot_mm"] = _mm(self._overshoot_m)
        self._next, self.over = True, not self._moves

    def _press(self, record: Record) -> None:
        tick, result = record.tick, self._results[-1]
        if tick.state != State.PRESSING or not tick.in_position:
            self._arrived_ns = -1
            return
        if self._arrived_ns < 0:
            self._arrived_ns = tick.t_ns
        if tick.t_ns - self._arrived_ns < DWELL_S * 1e9:
            return
        result["reached_s"] = round(1e-9 * (self._arrived_ns - self._asked_ns), 4)
        result["at_n"] = round(tick.estimate.x3_n - self._rod_force_n, 3)
        result["at_mm"] = _mm(record.truth_m)
        self._next, self.over = True, not self._moves

    @property
    def begun(self) -> bool:
        """A move has been asked for."""
        return bool(self._results)

    @property
    def longest_s(self) -> float:
        """That the moves whose speed is given may take on their ways, the first one all the way out [s]."""
        ways = pairwise([Move(0.0), *(m for m in self._moves if isinstance(m, Move))])
        return sum(abs(m.to_m - a.to_m) / m.speed_m_s for a, m in ways if m.speed_m_s > 0.0)

    @property
    def results(self) -> list[dict[str, Any]]:
        """Of each move, in mm and s, those that were not asked for included."""
        return self._results + [_open(m) for m in self._moves]

    @property
    def good(self) -> bool:
        """The load has come to every position, and every force."""
        return all(r["reached_s" if "to_n" in r else "in_position_s"] is not None for r in self.results)


def _open(move: Move | Push) -> dict[str, Any]:
    """What is to become of a move."""
    if isinstance(move, Push):
        return {"to_n": move.to_n, "reached_s": None, "at_n": None}
    return {"to_mm": _mm(move.to_m), "in_position_s": None, "error_mm": None}


def _mm(metres: float) -> float:
    return round(1e3 * metres, 6)


def in_words(results: list[dict[str, Any]]) -> str:
    """A line for each move."""
    lines = []
    for r in results:
        if "to_n" in r:
            lines.append(_pressed(r))
            continue
        if r["in_position_s"] is not None:
            words = f"in position after {r['in_position_s']:.3f} s, error {r['error_mm']:.3f} mm"
            words += f", overshoot {r['overshoot_mm']:.3f} mm"
        elif "refused" in r:
            words = f"refused: {r['refused'].replace('_', ' ')}"
        else:
            words = "not reached" + (f", error {r['error_mm']:.3f} mm" if r["error_mm"] is not None else "")
        lines.append(f"goto {r['to_mm']:g} mm: {words}")
    return "\n".join(lines)


def _pressed(r: dict[str, Any]) -> str:
    """A line for a force."""
    if r["reached_s"] is not None:
        words = f"reached after {r['reached_s']:.3f} s, {r['at_n']:.1f} N at {r['at_mm']:.3f} mm"
    else:
        words = f"refused: {r['refused'].replace('_', ' ')}" if "refused" in r else "not reached"
    return f"force {r['to_n']:g} N: {words}"
