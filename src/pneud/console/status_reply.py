"""What the console knows of the loop: read from the ring, so that asking for it costs the loop nothing."""

from __future__ import annotations

import math
import pickle
import sys
import time
from bisect import bisect_left
from itertools import accumulate
from typing import Any

from pneud.axis.state import learnt_so_far
from pneud.console.memory import Memory
from pneud.control.adaptation import Learnt
from pneud.log.live.amiss import Amiss
from pneud.log.live.mileage import whole_life
from pneud.log.live.ring import Ring
from pneud.rt.histogram import Histogram
from pneud.safety.cause import first_cause
from pneud.safety.faults import LOG_LOST, TABLE
from pneud.signals import HUNTING_CURES, Hunting, Stage, State

_BOUNDS_US = (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 100_000)
_KEPT = ("learnt", "_amiss", "_place", "_skipped", "_saturated", "_lateness", "_latency", "_log_lost")
_STAGES = {int(stage): stage.label for stage in (Stage.STOPPED, Stage.ENDED)}  # all others are under way


class StatusWatch:
    """Follows the records of one run."""

    def __init__(self, ring: Ring, sync: bool = True, memory: Memory | None = None) -> None:
        """Begin with the oldest record that is still in the ring, or go on from a console that has died.

        Args:
            ring: where the records are.
            sync: as for `Amiss`.
            memory: for the console that is started in this one's place: what has been counted so far.
        """
        self.learnt: Learnt | None = None  # by the last snapshot
        self._ring = ring
        self._amiss = Amiss(sync)
        self._reader = ring.reader()
        self._place = self._reader.place
        self._skipped = self._saturated = 0
        self._lateness = Histogram()
        self._latency = Histogram()
        self._log_lost = 0
        self._memory = memory
        kept = memory.kept_bytes() if memory is not None else None
        if kept is not None:
            vars(self).update(pickle.loads(kept))
            self._reader.place = self._place

    def _keep(self) -> None:
        """Leave what has been counted, and until where."""
        self._place = self._reader.place
        if self._memory is not None:
            self._memory.keep_bytes(pickle.dumps({name: getattr(self, name) for name in _KEPT}))

    def poll(self) -> None:
        """Take what the loop has done since the last call; to be called a few times a second.

        Standard error, under systemd the journal, gets a line when the log is lost and when it goes on.
        """
        for m, lateness_ns, latency_ns, saturated in self._reader.skim():
            self._skipped += m.skipped
            self._saturated += saturated
            self._amiss.add(m)
            self._lateness.add(lateness_ns)
            if latency_ns >= 0:
                self._latency.add(latency_ns)
        for state in self._reader.states().values():
            if state is not None:
                self.learnt = learnt_so_far(state["axis"])
        last = self._reader.latest()
        if last is not None:
            self._say_of_the_log(last.tick.present & LOG_LOST)
            self._keep()

    def _mileage(self) -> dict[str, Any]:
        """What the axis has done in its life."""
        return whole_life(self._ring.mileage, self._ring.since())

    def _say_of_the_log(self, lost: int) -> None:
        """Tell the journal when the log is lost, and when it goes on: the recorder may be past telling."""
        came, went, self._log_lost = lost & ~self._log_lost, self._log_lost & ~lost, lost
        for fault in TABLE:
            if came >> fault.bit & 1:
                print(f"pneud: {fault.name}: {fault.when}; {fault.cure}", file=sys.stderr, flush=True)
            elif went >> fault.bit & 1:
                print(f"pneud: {fault.name} is over: the log goes on", file=sys.stderr, flush=True)

    def fields(self, rod_force_n: float = 0.0) -> dict[str, Any]:
        """The part of `status` that the records tell.

        Args:
            rod_force_n: of the atmosphere on the rod's side, which is no force of the piston.
        """
        fields: dict[str, Any] = {
            "state": State.STARTING.label,
            "faults": [],
            "cause": None,
            **dict.fromkeys(("position_mm", "velocity_mm_s", "reference_mm", "error_mm", "force_n")),
            "in_position": False,
            "hunting": None,
            "program": None,
            "station": None,
            "load_cell_n": None,
            "pressures_bar": None,
            "command_v": None,
            "silent_s": None,
            "ticks": self._ring.put_count,
            "skipped": self._skipped,
            "saturated": self._saturated,
            "amiss": self._amiss.all._asdict(),
            "amiss_last_minute": self._amiss.lately()._asdict(),
            "amiss_because": {"corrupt": self._amiss.corrupt, "frozen": self._amiss.frozen},
            "lateness_us": _percentiles_us(self._lateness),
            "sensor_to_command_us": _percentiles_us(self._latency),
            "histograms": {
                "lateness": _counts_us(self._lateness),
                "sensor_to_command": _counts_us(self._latency),
            },
            "frames": self._ring.frames._asdict(),
            "mileage": self._mileage(),
        }
        last = self._reader.latest()
        if last is None:
            return fields
        tick = last.tick
        m, position_m = tick.measurement, tick.estimate.position_m
        fields["state"] = State(tick.state).label
        fields["silent_s"] = round(max(0, time.monotonic_ns() - tick.t_ns) * 1e-9, 3)
        fields["faults"] = faults(tick.present, tick.latched)
        cause = first_cause([fault["name"] for fault in fields["faults"]])
        if cause is not None:
            fields["cause"] = {"words": cause.words, "cure": cause.cure, "faults": list(cause.faults)}
        fields["position_mm"] = _scaled(position_m if math.isfinite(position_m) else m.position_m, 1e3)
        fields["velocity_mm_s"] = _scaled(tick.estimate.velocity_m_s, 1e3)
        fields["reference_mm"] = _scaled(tick.reference.position_m, 1e3)
        fields["error_mm"] = _scaled(tick.error_m, 1e3)
        fields["force_n"] = _scaled(tick.estimate.x3_n - rod_force_n, 1.0)
        fields["in_position"] = bool(tick.in_position)
        if tick.hunting:
            fields["hunting"] = {"cause": Hunting(tick.hunting).label, "cure": HUNTING_CURES[tick.hunting]}
        if tick.progress.stage:
            stage = _STAGES.get(tick.progress.stage, Stage.UNDER_WAY.label)
            fields["program"] = {"stage": stage, "record": tick.progress.step, "cycle": tick.progress.lap}
        if tick.weighed is not None and math.isfinite(tick.weighed.force_n):
            fields["load_cell_n"] = round(tick.weighed.force_n, 2)
        if tick.station is not None:
            fields["station"] = tick.station._asdict()
        pressures = (("p1", m.p1_pa), ("p2", m.p2_pa), ("supply", m.supply_pa))
        fields["pressures_bar"] = {name: _scaled(pa, 1e-5) for name, pa in pressures}
        fields["command_v"] = _scaled(tick.command.voltage_v, 1.0)
        return fields


def faults(present: int, latched: int) -> list[dict[str, Any]]:
    """Faults by name, what they do, and what a person can do."""
    return [
        {
            "name": fault.name,
            "latched": bool(latched >> fault.bit & 1),
            "present": bool(present >> fault.bit & 1),
            "effect": fault.reaction.value,
            "cure": fault.cure,
        }
        for fault in TABLE
        if (present | latched) >> fault.bit & 1
    ]


def _scaled(value: float, factor: float) -> float | None:
    return round(value * factor, 6) if math.isfinite(value) else None


def _counts_us(h: Histogram) -> dict[str, Any]:
    """How many values are no larger than each bound, and the sum of all."""
    counts = dict.fromkeys(_BOUNDS_US, 0)
    for low, high, count in h.counts():
        at = bisect_left(_BOUNDS_US, 0.5e-3 * (low + high))
        if at < len(_BOUNDS_US):
            counts[_BOUNDS_US[at]] += count
    at_most = list(accumulate(counts.values()))
    sum_us = round(h.mean * h.count * 1e-3, 3) if h.count else 0.0
    return {"le_us": list(_BOUNDS_US), "count": at_most, "all": h.count, "sum_us": sum_us}


def _percentiles_us(h: Histogram) -> dict[str, float] | None:
    if not h.count:
        return None
    names = ("p50", "p99", "p999", "max")
    return dict(zip(names, (ns / 1e3 for ns in h.percentiles((50.0, 99.0, 99.9, 100.0))), strict=True))
