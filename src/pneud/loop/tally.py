"""What a run comes to, counted from tick to tick; no tick is kept."""

from __future__ import annotations

from pneud.log.live.amiss import Amiss
from pneud.loop.tracking import Tracking
from pneud.rt.histogram import Histogram
from pneud.safety.faults import BLOCKS_ARM, names
from pneud.safety.supervisor import is_engaged
from pneud.signals import Answer, Defect, Record, State, Tick

_TAKEN = int(Answer.TAKEN)
_ODD, _CONFIRMED = int(Defect.ODD), int(Defect.CONFIRMED)


class Tally:
    """Counts of one axis's run.

    Attributes:
        ticks: until the run was told to end; likewise the others, but for what has ever shown.
        skipped: ticks left out, to the tick in which it was told so: they were still the run's.
        state: the last one.
        present: bits of the faults that were present last.
        ever_present: bits of the faults that have ever been present, to the very end.
        ever_latched: bits of the faults that have ever been latched, to the very end.
        saturated: ticks in which the law asked for more than it got.
        amiss: readings that ticks had to go without, to the very end.
        odd: readings that were held back.
        confirmed: those among them that the next one confirmed.
        refused: bits of the faults that showed only when the axis was asked to arm.
        lateness: of the wake-ups [ns].
        latency: from the newest sensor frame to the command [ns].
        tracking: error and command while the axis is led.
    """

    __slots__ = (
        *(
            "_closed",
            "_timed",
            "amiss",
            "confirmed",
            "ever_latched",
            "ever_present",
            "lateness",
            "latency",
            "odd",
        ),
        *("present", "refused", "saturated", "skipped", "state", "ticks", "tracking"),
    )

    def __init__(self, *, truth: bool, timed: bool, sync: bool = True) -> None:
        """Nothing has happened.

        Args:
            truth: a software plant tells true positions.
            timed: by a clock; simulated time is never late.
            sync: as for `Amiss`.
        """
        self.ticks = 0
        self.saturated = 0
        self.amiss = Amiss(sync)
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
        self._closed = False

    def add(self, record: Record, *, ending: bool) -> None:
        """One tick more."""
        tick = record.tick
        self.ever_present |= tick.present
        self.ever_latched |= tick.latched
        self.amiss.add(tick.measurement)
        if ending:
            self.close(tick.measurement.skipped, record.timing.lateness_ns)
            return
        self.ticks += 1
        self.state = tick.state
        self.present = tick.present
        self.saturated += tick.command.saturated
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
        tracking = self.tracking
        tracking.add(
            tick.t_ns,
            tick.state,
            tick.request if tick.answer == _TAKEN else None,
            record.true_error_m if tracking.has_truth else tick.error_m,
            tick.reference,
            tick.command.voltage_v,
        )

    def close(self, skipped: int, lateness_ns: int) -> None:
        """What the first tick behind the end says of the time before: a stall that went on to it.

        Args:
            skipped: ticks left out before it; of those behind it none count.
            lateness_ns: of its wake-up.
        """
        if skipped and self._timed and not self._closed:
            self.skipped += skipped
            self.lateness.add(lateness_ns)
        self._closed = True

    def asked_to_arm(self, tick: Tick) -> None:
        """See what an axis makes of being asked to arm by the run; what shows only then shows again."""
        self.refused = 0 if is_engaged(tick.state) else tick.present & BLOCKS_ARM

    def never_armed(self) -> list[str] | None:
        """Why a run that should have tracked never did; None where it did, or a fault ended it."""
        if self.ever_latched or self.state == State.TRACKING:
            return None
        return names(self.refused | (self.present & BLOCKS_ARM)) or ["the run was too short"]
