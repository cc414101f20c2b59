"""The error while the axis is led: over whole periods of a reference that repeats, and of each motion.

What lies outside of whole periods says nothing: an error over one and a half of them depends on which half.
The record alone tells, so that a run and its log come to the same figures.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.signals import Request, RequestKind, State

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

AFTER_S = 5.0  # of tracking before periods are judged; where a run is too short, the last one before it is
MOTIONS = 100  # kept, the newest ones
AGAINST = {"plant": "true position", "encoder": "encoder"}  # in words

_TRACKING, _MOVING = int(State.TRACKING), int(State.MOVING)
_GOTO, _JOG, _TRACK = int(RequestKind.GOTO), int(RequestKind.JOG), int(RequestKind.TRACK)
_PLACE, _SPEED = 0.02, 0.05  # how far a period may end from where it began, and how much faster


class Led(NamedTuple):
    """Ticks in a row, as `Tracking.add` takes each."""

    t_ns: NDArray[np.int64]
    state: NDArray[np.int64]
    taken: Mapping[int, Request]  # by place
    error_m: Floats
    reference: Sequence[Any]  # the columns of a `Reference`
    voltage_v: Floats


class _Sums:
    """Of error and command over some ticks."""

    __slots__ = ("count", "max_m", "max_v", "square", "step_v", "steps")

    def __init__(self) -> None:
        self.count = self.steps = 0
        self.square = self.max_m = self.max_v = self.step_v = 0.0

    def add(self, error_m: float, voltage_v: float, before_v: float) -> None:
        if math.isfinite(error_m):
            self.count += 1
            self.square += error_m * error_m
            self.max_m = max(self.max_m, abs(error_m))
        self.max_v = max(self.max_v, abs(voltage_v))
        if math.isfinite(before_v):
            self.steps += 1
            self.step_v += abs(voltage_v - before_v)

    def add_many(self, error_m: Floats, voltage_v: Floats, before_v: float) -> None:
        """As `add`, one after another and so in the same order."""
        import numpy as np  # noqa: PLC0415 - the loop does without

        finite = error_m[np.isfinite(error_m)]
        if len(finite):
            self.count += len(finite)
            self.square = float(np.cumsum(np.concatenate(([self.square], finite * finite)))[-1])
            self.max_m = max(self.max_m, float(np.abs(finite).max()))
        self.max_v = float(np.fmax.reduce(np.abs(voltage_v), initial=self.max_v))
        before = np.concatenate(([before_v], voltage_v[:-1]))
        steps = np.abs(voltage_v - before)[np.isfinite(before)]
        self.steps += len(steps)
        self.step_v = float(np.cumsum(np.concatenate(([self.step_v], steps)))[-1])

    def take(self, other: _Sums) -> None:
        self.count += other.count
        self.steps += other.steps
        self.square += other.square
        self.step_v += other.step_v
        self.max_m = max(self.max_m, other.max_m)
        self.max_v = max(self.max_v, other.max_v)

    def error_mm(self) -> dict[str, float | None]:
        if not self.count:
            return {"rms": None, "max": None}
        return {"rms": 1e3 * math.sqrt(self.square / self.count), "max": 1e3 * self.max_m}


class _Period:
    """From a turn of the acceleration to the next one of its kind."""

    __slots__ = ("after_s", "high_m", "low_m", "rising", "sums", "tick_s", "v", "x")

    def __init__(self, after_s: float, rising: bool, x: float, v: float, tick_s: float) -> None:
        self.after_s, self.rising, self.x, self.v, self.tick_s = after_s, rising, x, v, tick_s
        self.low_m = self.high_m = x
        self.sums = _Sums()

    def repeats(self, x: float, v: float, tick_s: float) -> bool:
        """Whether it ends as it began, as far as ticks can tell."""
        room_m = _PLACE * (self.high_m - self.low_m) + 1.5 * abs(v) * max(tick_s, self.tick_s)
        return abs(x - self.x) <= room_m and abs(v - self.v) <= _SPEED * abs(v)


class Tracking:
    """Takes one tick after the other and keeps none.

    Attributes:
        has_truth: the error is taken against a software plant's true position, else against the encoder.
    """

    def __init__(self, has_truth: bool) -> None:
        """Nothing has been followed."""
        self.has_truth = has_truth
        self._whole = 0
        self._early: _Period | None = None  # the last one that began too early
        self._led = False
        self._of_periods, self._of_motions = _Sums(), _Sums()
        self._motions: deque[dict[str, Any]] = deque(maxlen=MOTIONS)
        self._state = -1
        self._since_ns = self._last_ns = 0
        self._last_v = math.nan
        self._motion: tuple[dict[str, Any], _Sums] | None = None
        self._period: _Period | None = None
        self._rising: bool | None = None

    def add(
        self,
        t_ns: int,
        state: int,
        taken: Request | None,
        error_m: float,
        reference: tuple[float, ...],
        voltage_v: float,
    ) -> None:
        """One tick.

        Args:
            t_ns: its SYNC.
            state: of the axis.
            taken: what was asked for, where the axis took it.
            error_m: by `signals.true_error_m` where there is a truth, else by `signals.error_m`.
            reference: a `Reference`, or its numbers in their order.
            voltage_v: the command.
        """
        if state != self._state or (taken is not None and taken.kind in (_GOTO, _TRACK)):
            self._end()
            self._begin(t_ns, state, taken)
        if self._motion is not None:
            self._motion[1].add(error_m, voltage_v, self._last_v)
        elif state != _TRACKING:
            return
        else:
            self._follow(t_ns, reference)
            if self._period is not None:
                self._period.sums.add(error_m, voltage_v, self._last_v)
        self._last_ns, self._last_v = t_ns, voltage_v

    def add_many(self, led: Led) -> None:
        """As `add` of each, to the same figures."""
        import numpy as np  # noqa: PLC0415 - the loop does without

        count = len(led.t_ns)
        if not count:
            return
        turns = np.diff(led.reference[2] > 0.0) & (led.state[1:] == _TRACKING)
        apart = np.flatnonzero(turns | (np.diff(led.state) != 0)) + 1
        asked = (i for i, request in led.taken.items() if request.kind in (_GOTO, _TRACK))
        for at, end in pairwise((*sorted({0, *apart.tolist(), *asked}), count)):
            reference = tuple(float(column[at]) for column in led.reference)
            error_m, voltage_v = float(led.error_m[at]), float(led.voltage_v[at])
            self.add(int(led.t_ns[at]), int(led.state[at]), led.taken.get(at), error_m, reference, voltage_v)
            if end > at + 1:
                self._go_on(led, at + 1, end)

    def _go_on(self, led: Led, begin: int, end: int) -> None:
        """Ticks in which nothing ends, nothing begins and the acceleration keeps its sign."""
        import numpy as np  # noqa: PLC0415 - the loop does without

        error_m, voltage_v = led.error_m[begin:end], led.voltage_v[begin:end]
        if self._motion is not None:
            self._motion[1].add_many(error_m, voltage_v, self._last_v)
        elif self._state != _TRACKING:
            return
        elif (period := self._period) is not None:
            x = led.reference[0][begin:end]
            period.low_m = float(np.fmin.reduce(x, initial=period.low_m))
            period.high_m = float(np.fmax.reduce(x, initial=period.high_m))
            period.sums.add_many(error_m, voltage_v, self._last_v)
        self._last_ns, self._last_v = int(led.t_ns[end - 1]), float(voltage_v[-1])

    def _end(self) -> None:
        """What was going on is over."""
        if self._motion is not None:
            found, sums = self._motion
            self._motions.append(found | sums.error_mm())
            self._of_motions.take(sums)
        self._motion = self._period = self._rising = None

    def _begin(self, t_ns: int, state: int, taken: Request | None) -> None:
        self._state, self._since_ns, self._last_v = state, t_ns, math.nan
        self._led = self._led or state in (_TRACKING, _MOVING)
        kind, values = taken or (0, ())
        if state == _MOVING:
            to_mm = round(1e3 * values[0], 6) if kind == _GOTO and values else None
            self._motion = {"kind": "jog" if kind == _JOG else "goto", "to_mm": to_mm}, _Sums()
        elif state == _TRACKING and kind == _TRACK and values and values[0] == 1.0:
            self._motion = {"kind": "track", "to_mm": None}, _Sums()  # an uploaded profile, which ends

    def _follow(self, t_ns: int, reference: tuple[float, ...]) -> None:
        """See whether a period begins or ends: with the acceleration's turn, wherever the reference turns."""
        x, v, a, _ = reference
        period, rising = self._period, a > 0.0
        if period is not None:
            period.low_m, period.high_m = min(period.low_m, x), max(period.high_m, x)
        turns = self._rising is not None and rising is not self._rising
        self._rising = rising
        if not turns or (period is not None and rising is not period.rising):
            return
        tick_s = (t_ns - self._last_ns) * 1e-9
        if period is not None and period.repeats(x, v, tick_s):
            if period.after_s >= AFTER_S:
                self._whole += 1
                self._of_periods.take(period.sums)
            else:
                self._early = period
        self._period = _Period((t_ns - self._since_ns) * 1e-9, rising, x, v, tick_s)

    @property
    def periods(self) -> int:
        """Whole ones of a reference that repeats, over which the figures are."""
        return self._whole or int(self._early is not None)

    @property
    def _judged(self) -> _Sums:
        if self._whole or self._early is None:
            return self._of_periods if self._whole else self._of_motions
        return self._early.sums

    def tracking_mm(self) -> dict[str, Any]:
        """RMS and greatest error over the whole periods, else over the motions; `reason` where both are None.

        `motions` are the newest ones that have come to their end, with their own.
        """
        early = None if self._whole else self._early
        found: dict[str, Any] = {
            **self._judged.error_mm(),
            "periods": self.periods,
            "motions": list(self._motions),
            "after_s": AFTER_S if early is None else round(early.after_s, 3),
            "against": "plant" if self.has_truth else "encoder",
        }
        return found if found["rms"] is not None else found | {"reason": self._reason()}

    def _reason(self) -> str:
        if not self._led:
            return "the axis neither tracked nor moved"
        if self.periods or self._motions:
            return "no position was told"
        return "no whole period of the reference, and no motion to its end"

    def command_v(self) -> dict[str, float] | None:
        """Greatest command and mean step from tick to tick over the same ticks; None where there are none."""
        sums = self._judged
        return {"max": sums.max_v, "mean_step": sums.step_v / sums.steps} if sums.steps else None


def over_in_words(found: dict[str, Any]) -> str:
    """What the figures of `tracking_mm` are over, or why there are none."""
    n, m = found["periods"], len(found["motions"])
    if found["rms"] is None:
        return str(found["reason"])
    if n:
        return f"{n} whole period{'' if n == 1 else 's'} from {found['after_s']:g} s on"
    return f"{m} motion{'' if m == 1 else 's'}"


def in_words(found: dict[str, Any]) -> str:
    """`tracking_mm` for people."""
    over = over_in_words(found)
    if found["rms"] is None:
        return f"no tracking error: {over}"
    error = f"{found['rms']:.3f} mm RMS, {found['max']:.3f} mm max"
    return f"tracking error {error} (over {over}, against the {AGAINST[found['against']]})"
