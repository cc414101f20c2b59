"""One pass over a log: everything that a report shows of it, in bounded memory."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.bus.inbox import NEVER_NS
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.loading import at_rate, codecs_of
from pneud.log.files.columns import Block, blocks
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader
from pneud.log.format.record_layout import WORD_BITS
from pneud.log.format.records import LoggedEvent
from pneud.loop.tracking import AGAINST, Led, Tracking
from pneud.replay.ending import Ending
from pneud.replay.mileage import done_by
from pneud.replay.motions import Motion, Motions
from pneud.report.closeup import Closeup
from pneud.report.decimate import Envelope, Path, Points
from pneud.report.health import Health
from pneud.report.learning import Learning
from pneud.report.planes import Plane, Planes, sample
from pneud.report.readings import Readings
from pneud.report.spans import Span, Spans
from pneud.report.spread import Spread
from pneud.report.stops import Seen, Stops, seen
from pneud.safety.supervisor import is_engaged
from pneud.signals import (
    Answer,
    Mileage,
    Reference,
    Request,
    RequestKind,
    State,
    Timing,
    error_m,
    true_error_m,
)

EVENTS = 1000  # kept of the first ones, the rest is counted
MARKS = 400

_REMARK = re.compile(r": mark (.*) → taken")
_MM, _UM, _BAR = 1e3, 1e6, 1e-5
_ENGAGED = np.array([is_engaged(state) for state in range(max(State) + 1)])


class RunMark(NamedTuple):
    """Something an operator asked for."""

    t_s: float
    text: str


class Window(NamedTuple):
    """Which part of a log to look at, in seconds from its first tick."""

    begin_s: float = 0.0
    end_s: float = math.inf


class Counted(NamedTuple):
    """What the summary of the run counts, too: until it was told to end."""

    state: int  # the last one; −1 where there was none
    ticks: int
    skipped: int
    saturated: int


class LoggedRun(NamedTuple):
    """A log as a report shows it."""

    name: str  # of the file
    log: LogReader
    config: Config
    start_unix_s: float  # of the first tick, where times begin
    first_engaged_s: float  # NaN if never
    last_s: float
    ticks: int
    missing: int
    counted: Counted
    columns: dict[str, int]  # name → index in `series.values`
    series: Points
    phase: Points  # position error [mm], velocity error [mm/s]
    closeup: Closeup  # every tick, as far as there is room
    planes: list[Plane]
    motions: list[Motion]
    faults: list[Seen]
    states: list[Span]
    present: dict[int, list[Span]]  # by bit
    latched: dict[int, list[Span]]
    saturated: list[Span]
    gaps: list[Span]  # ticks skipped, or records missing
    in_position: list[Span]
    hunting: list[Span]  # with the `Hunting` as value
    marks: list[RunMark]
    more_marks: int
    events: list[LoggedEvent]
    more_events: int
    timing: dict[str, Spread]
    health: Health
    readings: Readings
    learning: Learning
    mileage: Mileage | None  # of the run, up to its last snapshot
    error_against: str
    tracking_mm: dict[str, Any]  # as in the summary of the run, like the next one
    command_v: dict[str, float] | None

    @property
    def simulated(self) -> bool:
        """Whether the run was in simulated time, which has no lateness."""
        return self.log.metadata.get("bus") == "simulated"

    def fault_name(self, bit: int) -> str:
        """The name of a fault in this log."""
        names = self.log.fault_names
        return names[bit] if bit < len(names) else f"fault {bit}"


COLUMNS = (
    *("reference_mm", "position_mm", "truth_mm", "error_mm", "reference_mm_s", "velocity_mm_s"),
    *("p1_bar", "p2_bar", "supply_bar", "voltage_v", "applied_v", "law_v"),
    *("force_n", "d_hat_n_s", "innovation_um", "x3_innovation_n"),
    *("lateness_us", "latency_us", "sync_jitter_us", "encoder_age_ms", "pressure_age_ms", "valve_age_ms"),
)


EVERYTHING = Window()


def gather(log: LogReader, window: Window = EVERYTHING, buckets: int = 8192, closeup: int = 0) -> LoggedRun:
    """Read a log, or a part of it.

    Args:
        log: the log.
        window: which part of it.
        buckets: into so many at most its series are drawn together.
        closeup: bytes that every tick may take, as far as there are ticks.

    Raises:
        ConfigError: the configuration in the log cannot be used by this version.
        DatabaseError: nor its DBC.
        LogError: there is no tick in the window.
    """
    return _Gatherer(log, buckets, closeup).run(window)


class _Gatherer:
    def __init__(self, log: LogReader, buckets: int, closeup: int) -> None:
        self.log = log
        self.config = at_rate(parse(log.config_text, f"{log.path}:{log.config_name}"), log.rate_hz)
        self.period_ns = round(1e9 / log.rate_hz)
        codecs = codecs_of(self.config.bus, log.dbc_name, log.dbc, self.config.gas)
        self.health = Health(codecs, self.config.bus.sync is True, self.period_ns)
        self.readings, self.learning = Readings(bool(self.config.bus.sync)), Learning(self.config)
        self.series = Envelope(len(COLUMNS), buckets)
        self.phase = Path(max(1, buckets // 4))
        self.closeup = Closeup(COLUMNS, closeup)
        self.planes, self.motions = Planes(self.config, buckets), Motions(self.config)
        self.stops = Stops(self.config)
        self.states, self.saturated, self.gaps = Spans(), Spans(), Spans()
        self.in_position, self.hunting = Spans(), Spans()
        self.present: dict[int, Spans] = {}
        self.latched: dict[int, Spans] = {}
        self.timing = {name: Spread() for name in Timing._fields}
        self.tracking = Tracking(False)
        self.counted = Counted(-1, 0, 0, 0)
        self.mileage: Mileage | None = None
        self.marks: list[RunMark] = []
        self.events: list[LoggedEvent] = []
        self.more_marks = self.more_events = 0
        self.ticks = 0
        self._ending = Ending()
        self.t0_ns: int | None = None
        self.start_unix_s = math.nan
        self.first_engaged_s = math.nan
        self.last_s = 0.0
        self.number = 0

    def run(self, window: Window) -> LoggedRun:
        for block, t_s in self._windowed(window):
            self._take(block, t_s)
        if not self.ticks:
            why = f"; {self.log.damage}" if self.log.truncated else ""
            raise LogError(f"{self.log.path}: no tick in it{why}")
        self._name_marks()
        end_s = self.last_s + 1e-9 * self.period_ns
        found = {name: value for name, value in vars(self).items() if name in LoggedRun._fields}
        found |= {name: spans.finish(end_s) for name, spans in found.items() if isinstance(spans, Spans)}
        for name in ("present", "latched"):
            found[name] = {bit: spans.finish(end_s) for bit, spans in sorted(found[name].items())}
        return LoggedRun(
            **found
            | {
                "name": self.log.path.name,
                "missing": self.log.missing,
                "columns": {name: i for i, name in enumerate(COLUMNS)},
                "series": self.series.points(),
                "phase": self.phase.points(),
                "planes": self.planes.planes(),
                "motions": self.motions.finish(),
                "faults": seen(found["present"], found["latched"], self.stops.finish(), end_s),
                "error_against": AGAINST["plant" if self.tracking.has_truth else "encoder"],
                "tracking_mm": self.tracking.tracking_mm(),
                "command_v": self.tracking.command_v(),
            }
        )

    def _windowed(self, window: Window) -> Iterator[tuple[Block, NDArray[np.float64]]]:
        for block in blocks(self.log):
            if not len(block.number):
                self._keep_events(block, window)
                continue
            t_ns = block.ticks["t_ns"]
            if self.t0_ns is None:
                self.t0_ns = int(t_ns[0])
                self.start_unix_s = 1e-9 * int(block.log_time_ns[0])
            self._keep_events(block, window)
            self._keep_states(block, window)
            t_s = (t_ns - self.t0_ns) * 1e-9
            begin, end = np.searchsorted(t_s, (window.begin_s, window.end_s)).tolist()
            if begin < end:
                yield (block if end - begin == len(t_s) else block.part(begin, end)), t_s[begin:end]
            if end < len(t_s):
                return

    def _keep_events(self, block: Block, window: Window) -> None:
        for event in block.events:
            t_s = 1e-9 * event.log_time_ns - self.start_unix_s
            if math.isnan(t_s) or window.begin_s <= t_s < window.end_s:
                if len(self.events) < EVENTS:
                    self.events.append(event)
                else:
                    self.more_events += 1

    def _keep_states(self, block: Block, window: Window) -> None:
        for state in block.states:
            t_s = 1e-9 * state.log_time_ns - self.start_unix_s
            if window.begin_s <= t_s < window.end_s:
                self.learning.add(t_s, state)
                self.mileage = done_by(state) or self.mileage

    def _take(self, block: Block, t_s: NDArray[np.float64]) -> None:
        ticks = block.ticks
        jitter_ns = self.health.add(block)
        self.readings.add(block, t_s)
        columns = self._columns(block, jitter_ns)
        values = np.stack([columns[name] for name in COLUMNS], axis=1)
        self.series.add(t_s, values)
        velocity_error = columns["reference_mm_s"] - columns["velocity_mm_s"]
        self.phase.add(t_s, columns["error_mm"], velocity_error)

        state = ticks["state"].astype(np.int64)
        self.states.add(t_s, state + 1)
        self.saturated.add(t_s, ticks["command.saturated"].astype(np.int64))
        self.in_position.add(t_s, ticks["in_position"].astype(np.int64))
        self.hunting.add(t_s, ticks["hunting"].astype(np.int64))
        for name, kept in (("present", self.present), ("latched", self.latched)):
            for first, words in block.faults(name):
                _bits(t_s, words, first, kept)
        dropped = np.diff(block.number, prepend=self.number if self.number else block.number[0] - 1) > 1
        skipped = ticks["measurement.skipped"].astype(np.int64)
        self._gaps(t_s, dropped, skipped)
        self.number = int(block.number[-1])

        for name, spread in self.timing.items():
            spread.add(ticks[f"timing.{name}"])
        self._count(block, columns["error_mm"] * 1e-3)
        for index, request in block.requests:
            self._mark(float(t_s[index]), request)
        engaged = np.flatnonzero(_ENGAGED[np.minimum(state, len(_ENGAGED) - 1)])
        if math.isnan(self.first_engaged_s) and len(engaged):
            self.first_engaged_s = float(t_s[engaged[0]])
        self.motions.add(block, t_s)
        self.planes.add(sample(block, t_s, state, columns["error_mm"]))
        position = (
            columns["truth_mm"] * 1e-3 if self.tracking.has_truth else block.real("estimate.position_m")
        )
        self.stops.add(block, t_s, position)
        self.closeup.add(t_s, values, self._happens(block, state), _most(columns["error_mm"]))
        self.ticks += len(t_s)
        self.last_s = float(t_s[-1])

    def _happens(self, block: Block, state: NDArray[np.int64]) -> bool:
        latched = [words for _, words in block.faults("latched")]
        return bool(
            self.ticks == 0
            or (state[1:] != state[:-1]).any()
            or any((words[1:] != words[:-1]).any() for words in latched)
            or any(request.kind != RequestKind.JOG for _, request in block.requests)
        )

    def _count(self, block: Block, error_m: NDArray[np.float64]) -> None:
        """What the summary of the run counts, too."""
        end, stalled = self._ending.look(block)
        if stalled is not None:
            skipped = int(block.ticks["measurement.skipped"][stalled])
            self.counted = self.counted._replace(skipped=self.counted.skipped + skipped)
        if not end:
            return
        if end < len(error_m):
            block, error_m = block.part(0, end), error_m[:end]
        self._track(block, error_m)
        ticks, was = block.ticks, self.counted
        self.counted = Counted(
            int(ticks["state"][-1]),
            was.ticks + len(ticks),
            was.skipped + int(ticks["measurement.skipped"].sum()),
            was.saturated + int(ticks["command.saturated"].sum()),
        )

    def _track(self, block: Block, error_m: NDArray[np.float64]) -> None:
        ticks, real = block.ticks, block.real
        self.tracking.add_many(
            Led(
                ticks["t_ns"],
                ticks["state"].astype(np.int64),
                {i: request for i, request in block.requests if ticks["answer"][i] == Answer.TAKEN},
                error_m,
                tuple(real(f"reference.{name}") for name in Reference._fields),
                real("command.voltage_v"),
            )
        )

    def _gaps(self, t_s: NDArray[np.float64], dropped: Any, skipped: Any) -> None:
        """Stretches without a tick: 1 where ticks were skipped, 2 where records are missing."""
        for index in np.flatnonzero(dropped | (skipped > 0)).tolist():
            before = float(t_s[index - 1]) if index else self.last_s
            kind = 2 if dropped[index] else 1
            self.gaps.add(np.array([before, float(t_s[index])]), np.array([kind, 0]))

    def _name_marks(self) -> None:
        """Give the operator's remarks, which stand in the events, to their marks."""
        for event in self.events:
            words = _REMARK.search(event.message)
            if event.name != "console" or words is None:
                continue
            t_s = 1e-9 * event.log_time_ns - self.start_unix_s
            plain = [i for i, mark in enumerate(self.marks) if mark.text == "mark"]
            nearest = min(plain, key=lambda i: abs(self.marks[i].t_s - t_s), default=None)
            if nearest is not None and abs(self.marks[nearest].t_s - t_s) < 1.0:
                self.marks[nearest] = self.marks[nearest]._replace(text=words[1])

    def _mark(self, t_s: float, request: Request) -> None:
        if len(self.marks) >= MARKS:
            self.more_marks += 1
            return
        try:
            label = RequestKind(request.kind).name.lower()
        except ValueError:
            label = f"request {request.kind}"
        self.marks.append(RunMark(t_s, " ".join([label, *(f"{value:g}" for value in request.values)])))

    def _columns(self, block: Block, jitter_ns: Any) -> dict[str, NDArray[np.float64]]:
        real = block.real
        reference = Reference._make(real(f"reference.{name}") for name in Reference._fields)
        truth = real("truth_m")
        tracking = self.tracking
        tracking.has_truth = tracking.has_truth or bool(np.isfinite(truth).any())
        if tracking.has_truth:
            error = true_error_m(reference, block.ticks["measurement.encoder_offset_ns"], truth)
        else:
            error = error_m(reference, real("estimate.position_m"))
        return {
            "reference_mm": reference.position_m * _MM,
            "position_mm": real("measurement.position_m") * _MM,
            "truth_mm": truth * _MM,
            "error_mm": error * _MM,
            "reference_mm_s": reference.velocity_m_s * _MM,
            "velocity_mm_s": real("estimate.velocity_m_s") * _MM,
            "p1_bar": real("measurement.p1_pa") * _BAR,
            "p2_bar": real("measurement.p2_pa") * _BAR,
            "supply_bar": real("measurement.supply_pa") * _BAR,
            "voltage_v": real("command.voltage_v"),
            "applied_v": real("measurement.applied_v"),
            "law_v": real("command.law_v"),
            "force_n": real("estimate.force_n"),
            "d_hat_n_s": real("estimate.d_hat_n_s"),
            "innovation_um": real("estimate.innovation_m") * _UM,
            "x3_innovation_n": real("estimate.x3_n") - real("estimate.x3_hat_n"),
            "lateness_us": _duration(block.ticks["timing.lateness_ns"], 1e-3),
            "latency_us": _duration(block.ticks["timing.latency_ns"], 1e-3),
            "sync_jitter_us": _duration(jitter_ns, 1e-3),
            "encoder_age_ms": _duration(block.ticks["measurement.encoder_age_ns"], 1e-6),
            "pressure_age_ms": _duration(block.ticks["measurement.pressure_age_ns"], 1e-6),
            "valve_age_ms": _duration(block.ticks["measurement.valve_age_ns"], 1e-6),
        }


def _most(error_mm: NDArray[np.float64]) -> float:
    return float(np.fmax.reduce(np.abs(error_mm), initial=0.0))


def _duration(ns: Any, factor: float) -> NDArray[np.float64]:
    return np.where((ns >= 0) & (ns < NEVER_NS), ns * factor, np.nan)


def _bits(t_s: NDArray[np.float64], masks: NDArray[np.uint64], first: int, kept: dict[int, Spans]) -> None:
    everything = int(np.bitwise_or.reduce(masks))
    for place in range(WORD_BITS):
        bit, shown = first + place, everything >> place & 1
        if shown and bit not in kept:
            kept[bit] = Spans()
        if bit in kept and (shown or kept[bit].open):
            kept[bit].add(t_s, (masks >> np.uint64(place) & np.uint64(1)).astype(np.int64))
