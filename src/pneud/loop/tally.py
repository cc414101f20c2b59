"""What a run comes to, counted from tick to tick; no tick is kept."""

from __future__ import annotations

import math
from typing import Any

from pneud.control.plan import FOLLOWING, Plan
from pneud.rt.histogram import Histogram
from pneud.safety.faults import BLOCKS_ARM, names
from pneud.safety.supervisor import is_engaged
from pneud.signals import Defect, Record, State, Tick

AFTER_S = 5.0
_ODD, _CONFIRMED = int(Defect.ODD), int(Defect.CONFIRMED)


class Tally:
    """Counts of one axis's run.

    Attributes:
        ticks: until the run was told to end; likewise the others, but for what has ever shown.
        skipped: ticks left out.
        state: the last one.
        present: bits of the faults that were present last.
        ever_present: bits of the faults that have ever been present, to the very end.
        ever_latched: bits of the faults that have ever been latched, to the very end.
        odd: readings that were held back.
        confirmed: those among them that the next one confirmed.
        refused: bits of the faults that showed only when the axis was asked to arm.
        lateness: of the wake-ups [ns].
        latency: from the newest sensor frame to the command [ns].
        tracking: error and command while the reference is followed.
    """

    __slots__ = (
        *("_timed", "confirmed", "ever_latched", "ever_present", "lateness", "latency", "odd", "present"),
        *("refused", "skipped", "state", "ticks", "tracking"),
    )

    def __init__(self, *, truth: bool, timed: bool) -> None:
        """Nothing has happened.

        Args:
            truth: a software plant tells true positions.
            timed: by a clock; simulated time is never late.
        """
        self.ticks = 0
        self.skipped = 0
        self.state = int(State.STARTING)
        self.present = 0
        self.ever_present = 0
        self.ever_latched = 0
        self.refused = 0
        self.odd = 0
        self.confirmed = 0
        self.lateness = Histogram()
        self.latency = Histogram()
        self.tracking = Tracking(truth)
        self._timed = timed

    def add(self, record: Record, plan: Plan, *, ending: bool) -> None:
        """One tick more."""
        tick = record.tick
        self.ever_present |= tick.present
        self.ever_latched |= tick.latched
        if ending:
            return
        self.ticks += 1
        self.state = tick.state
        self.present = tick.present
        for defects in (tick.measurement.encoder_defects, tick.measurement.pressure_defects):
            if defects:
                self.odd += defects & _ODD != 0
                self.confirmed += defects & _CONFIRMED != 0
        if self._timed:
            timing = record.timing
            self.skipped += tick.measurement.skipped
            self.lateness.add(timing.lateness_ns)
            if timing.latency_ns >= 0:
                self.latency.add(timing.latency_ns)
        if plan.phase == FOLLOWING:
            self.tracking.add(tick, plan.since_ns, record.truth_m)

    def asked_to_arm(self, tick: Tick) -> None:
        """See what an axis makes of being asked to arm by the run; what shows only then shows again."""
        self.refused = 0 if is_engaged(tick.state) else tick.present & BLOCKS_ARM

    def never_armed(self) -> list[str] | None:
        """Why a run that should have tracked never did; None where it did, or a fault ended it."""
        if self.ever_latched or self.state == State.TRACKING:
            return None
        return names(self.refused | (self.present & BLOCKS_ARM)) or ["the run was too short"]


def deviation_m(tick: Tick, truth_m: float | None) -> float:
    """Reference less position [m]: the true one at SYNC, or where nobody knows it that of the encoder."""
    r, m = tick.reference, tick.measurement
    if truth_m is None:
        return r.position_m - m.position_m
    # the reference of the sampling instant, taken back to the instant of SYNC
    return r.position_m - r.velocity_m_s * m.encoder_offset_ns * 1e-9 - truth_m


class Tracking:
    """Sums over the ticks from a while past the join on; keeps no tick."""

    def __init__(self, has_truth: bool, after_s: float = AFTER_S) -> None:
        """Sums of nothing.

        Args:
            has_truth: the error is taken against a software plant's true position, else against the encoder.
            after_s: how long a while.
        """
        self.has_truth = has_truth
        self._after_s = after_s
        self.count = 0
        self.saturated = 0
        self._square = 0.0
        self._max_m = 0.0
        self._max_v = 0.0
        self._step_v = 0.0
        self._steps = 0
        self._last_v = math.nan

    def add(self, tick: Tick, join_ns: int, truth_m: float) -> None:
        """One tick that follows the reference, whose t = 0 is at `join_ns`; no true position is NaN."""
        if tick.t_ns - join_ns < self._after_s * 1e9:
            return
        error = deviation_m(tick, truth_m if self.has_truth else None)
        if math.isfinite(error):
            self.count += 1
            self._square += error * error
            self._max_m = max(self._max_m, abs(error))
        v = tick.command.voltage_v
        self.saturated += tick.command.saturated
        self._max_v = max(self._max_v, abs(v))
        if math.isfinite(self._last_v):
            self._step_v += abs(v - self._last_v)
            self._steps += 1
        self._last_v = v

    def tracking_mm(self) -> dict[str, Any] | None:
        """RMS and greatest error; None if the run was too short."""
        if self.count == 0:
            return None
        return {
            "rms": 1e3 * math.sqrt(self._square / self.count),
            "max": 1e3 * self._max_m,
            "after_s": self._after_s,
            "against": "plant" if self.has_truth else "encoder",
        }

    def command_v(self) -> dict[str, Any] | None:
        """Greatest command and mean step from tick to tick; None if the run was too short."""
        if self._steps == 0:
            return None
        return {"max": self._max_v, "mean_step": self._step_v / self._steps}
