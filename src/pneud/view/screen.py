"""One page about an axis: everything an operator looks at, made of a snapshot and a history.

Nothing here knows where the records come from, what the time is, or what a terminal is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.segment import Segment
from rich.style import Style

from pneud.rt.histogram import Histogram
from pneud.signals import HUNTING_CURES, Answer, Host, Hunting, Record, RequestKind, State, ValveState
from pneud.view.history import Column, Event, History, Trace, shape, span_s, sparkline
from pneud.view.info import ScreenInfo
from pneud.view.learnt import in_brief
from pneud.view.text import (
    DIM,
    HAT,
    LABEL_WIDTH,
    PLAIN,
    Rows,
    bit_names,
    clean,
    clock,
    duration,
    length,
    name_of,
    number,
)

SILENT_S = 0.5

_RANGE = 18  # width of what stands to the right of a curve
_WIDE = 100
_FIXED_ROWS = 20  # all rows but curves and further events
_MANY_EVENTS_ROWS, _MANY_EVENTS = 34, 5
_SHAPE_NS, _SHAPE_WIDTH, _SHAPE_LABEL = (1e3, 1e7), 22, " 1 µs … 10 ms, logarithmic"
# no curve is drawn on a finer scale than this, so that noise does not look like motion
_LEAST_ERROR_M = 1e-6
_LEAST_PRESSURE_PA = 5e3
_LEAST_COMMAND_V = 0.05

_BOLD = Style(bold=True)
_GOOD = Style(color="green", bold=True)
_WARN = Style(color="yellow", bold=True)
_BAD = Style(color="red", bold=True)
_ERROR = Style(color="cyan")
_P1 = Style(color="bright_blue")
_P2 = Style(color="magenta")
_COMMAND = Style(color="yellow")
_ENGAGED = Style(color="black", bgcolor="green", bold=True)
_HUNTING = Style(color="black", bgcolor="yellow", bold=True)
_BADGES = {
    State.STARTING: Style(color="black", bgcolor="yellow", bold=True),
    State.WAITING: Style(color="black", bgcolor="yellow", bold=True),
    State.DISARMED: Style(color="black", bgcolor="white", bold=True),
    State.STOPPING: Style(color="black", bgcolor="magenta", bold=True),
    State.FAULT: Style(color="white", bgcolor="red", bold=True),
}
_VALVES = {ValveState.ENABLED: _GOOD, ValveState.TIMED_OUT: _BAD, ValveState.FAULT: _BAD}


class ScreenState(NamedTuple):
    """What there is to show at one instant."""

    record: Record | None  # None before the first tick
    info: ScreenInfo


class Page:
    """The page for a terminal of a size, a rich renderable of exactly that.

    80 × 24 shows everything, more makes the curves larger. `ascii_only` None asks the console that shows it.
    """

    def __init__(
        self, snapshot: ScreenState, history: History, size: tuple[int, int], ascii_only: bool | None = None
    ) -> None:
        self._snapshot = snapshot
        self._history = history
        self._width, self._height = max(size[0], 1), max(size[1], 1)
        self._ascii_only = ascii_only

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the page's segments."""
        ascii_only = options.ascii_only if self._ascii_only is None else self._ascii_only
        rows = Rows(self._width, ascii_only)
        _fill(rows, self._snapshot, self._history, self._height)
        for i, row in enumerate(rows.done(self._height)):
            if i:
                yield Segment.line()
            yield from row


def _fill(rows: Rows, snapshot: ScreenState, history: History, height: int) -> None:
    info = snapshot.info
    record = snapshot.record
    curves = _curve_heights(height if height < _MANY_EVENTS_ROWS else height - _MANY_EVENTS + 1)
    rules = height >= _FIXED_ROWS
    _head(rows, snapshot, history)
    if record is None:
        rows.row()
        rows.put("waiting for the first tick", _WARN)
    else:
        if rules:
            rows.rule(f"motion, curves of {span_s(_curve_width(rows)):.0f} s")
        _motion(rows, record, info, history, curves[0])
        if rules:
            rows.rule("pneumatics, absolute pressures")
        _pneumatics(rows, record, info, history, curves[1:])
        if rules:
            rows.rule("loop")
        _loop(rows, history)
        _events(rows, history, info, 1 if height < _MANY_EVENTS_ROWS else _MANY_EVENTS)
    rows.row()
    rows.put(clean(info.keys), _BOLD)
    room = rows.width - len(info.keys) - 4
    path = clean(info.log_path)
    rows.right(path if len(path) <= room else "…" + path[len(path) - room + 1 :], DIM)


def _curve_heights(height: int) -> list[int]:
    """Rows of the curves of error, p1, p2 and command."""
    heights = [0, 0, 0, 0]
    spare = max(height - _FIXED_ROWS, 0)
    order = (0, 3, 1, 2, 0, 3) + (0, 3, 1, 2) * 6  # error and command are worth more than pressures
    for curve in order[:spare]:
        heights[curve] += 1
    return heights


def _head(rows: Rows, snapshot: ScreenState, history: History) -> None:
    info, record = snapshot.info, snapshot.record
    rows.row()
    badge = "" if record is None else f" {name_of(State, record.tick.state)}{_standing(record)} "
    rows.put(clean(f"pneud · {info.name}")[: max(rows.room - len(badge) - 1, 0)], _BOLD)
    rest = f" · {info.bus} · {info.rate_hz:g} Hz · {clock(history.elapsed_s)}"
    rows.put(clean(rest)[: max(rows.room - len(badge) - 1, 0)])
    if record is not None:
        style = _HUNTING if record.tick.hunting else _BADGES.get(record.tick.state, _ENGAGED)  # type: ignore[call-overload]
        rows.right(badge, style)
    rows.row()
    if history.silent_s > SILENT_S:
        rows.put(f"no ticks for {history.silent_s:.1f} s", _BAD)
    elif info.message:
        rows.put(clean(info.message), _WARN)
    else:
        cure = "" if record is None else _cure(record, info)
        rows.put(clean(cure or info.note), PLAIN if cure else DIM)
    rows.row("faults")
    if record is None:
        rows.put("-")
        return
    latched = bit_names(record.tick.latched, info.fault_names)
    present = bit_names(record.tick.present & ~record.tick.latched, info.fault_names)
    host = [h.name.lower().replace("_", " ") for h in Host if record.tick.measurement.host & h and h.name]
    for names, style in ((latched, _BAD), (present, _WARN), (host, _WARN)):
        for name in names:
            rows.put(name if len(name) < rows.room else "…", style)
            rows.put("  ")
    if not latched and not present:
        rows.put("none", _GOOD)


def _standing(record: Record) -> str:
    """How the load stands at its target."""
    return ", hunting" if record.tick.hunting else ", in position" if record.tick.in_position else ""


def _cure(record: Record, info: ScreenInfo) -> str:
    """What a person can do about the first fault that is latched, or else present, or about hunting."""
    tick = record.tick
    bits = tick.latched or tick.present
    first = (bits & -bits).bit_length() - 1
    if 0 <= first < len(info.cures):
        return f"{bit_names(bits, info.fault_names)[0]}: {info.cures[first]}"
    return f"hunting: check {HUNTING_CURES.get(tick.hunting)}" if tick.hunting else ""


def _motion(rows: Rows, record: Record, info: ScreenInfo, history: History, height: int) -> None:
    tick = record.tick
    position, reference = tick.estimate.position_m, tick.reference.position_m
    rows.row("travel")
    low, high = f"{info.travel_min_m * 1e3:.0f} ├", f"┤ {info.travel_max_m * 1e3:.0f} mm"
    n = max(rows.width - LABEL_WIDTH - len(low) - len(high), 1)
    bar = ["─"] * n
    span = info.travel_max_m - info.travel_min_m
    for value, mark in ((reference, "│"), (position, "●")):
        if math.isfinite(value):
            bar[_at((value - info.travel_min_m) / span, n)] = mark
    inside = not math.isfinite(position) or info.travel_min_m <= position <= info.travel_max_m
    rows.put(low, DIM)
    rows.put("".join(bar), _BOLD if inside else _BAD)
    rows.put(high, DIM)

    _cells(
        rows,
        ("position", number(position * 1e3, "9.3f", "mm"), _BOLD),
        ("reference", number(reference * 1e3, "9.3f", "mm"), PLAIN),
        ("error", length(tick.error_m), _ERROR),
    )
    truth = length(record.true_error_m) if math.isfinite(record.truth_m) else ""
    _cells(
        rows,
        ("velocity", number(tick.estimate.velocity_m_s * 1e3, "+9.1f", "mm/s"), PLAIN),
        ("rms error", length(history.error.rms(tick.t_ns), ""), PLAIN),
        ("true err" if truth else "", truth, PLAIN),
    )
    columns = [c and (max(-c[0], c[1]),) * 2 for c in _columns(rows, history.error, tick.t_ns)]
    peak = max(_extremes(columns)[1], _LEAST_ERROR_M)
    _curve(rows, "|error|", columns, (0.0, peak), (length(peak, ""), length(0.0, "")), height, _ERROR)


def _pneumatics(rows: Rows, record: Record, info: ScreenInfo, history: History, heights: list[int]) -> None:
    tick = record.tick
    m, e, c = tick.measurement, tick.estimate, tick.command
    _cells(
        rows,
        ("p1", number(m.p1_pa * 1e-5, "7.3f", "bar"), _P1),
        ("p2", number(m.p2_pa * 1e-5, "7.3f", "bar"), _P2),
        ("supply", number(m.supply_pa * 1e-5, "7.3f", "bar"), PLAIN),
    )
    for label, series, style, height in (
        ("p1", history.p1, _P1, heights[0]),
        ("p2", history.p2, _P2, heights[1]),
    ):
        columns = _columns(rows, series, tick.t_ns)
        low, high = _extremes(columns)
        labels = (f"{high * 1e-5:7.3f} bar", f"{low * 1e-5:7.3f} bar")
        if height == 1:
            labels = (f"{low * 1e-5:.2f} … {high * 1e-5:.2f} bar", "")
        slack = max(0.5 * (_LEAST_PRESSURE_PA - (high - low)), 0.0)
        _curve(rows, label, columns, (low - slack, high + slack), labels, height, style)
    _cells(
        rows,
        (f"force F{HAT}", number(e.force_n, "+8.1f", "N"), PLAIN),
        (f"d{HAT}", number(e.d_hat_n_s, "+8.0f", "N/s"), PLAIN),
        ("valve", name_of(ValveState, m.valve_state), _VALVES.get(m.valve_state, _WARN)),  # type: ignore[call-overload]
    )
    _learnt(rows, info)
    rows.row("command")
    rows.put(number(c.voltage_v, "+7.3f", "V"), _BAD if c.saturated else _COMMAND, 10)
    left, right = f"{-info.u_max_v:g} ├", f"┤ {info.u_max_v:+g} V"
    applied = f"  applied {number(m.applied_v, '+7.3f', 'V')}"
    rows.put(left, DIM)
    n = max(rows.room - len(right) - len(applied), 3)
    rows.put(_centred_bar(c.voltage_v / info.u_max_v, n), _COMMAND)
    rows.put(right, DIM)
    rows.right(applied)
    columns = _columns(rows, history.command, tick.t_ns)
    low, high = _extremes(columns)
    peak = max(-low, high, _LEAST_COMMAND_V)
    labels = (f"{peak:+7.3f} V", f"{-peak:+7.3f} V")
    _curve(rows, "", columns, (-peak, peak), labels, heights[2], _COMMAND)


def _learnt(rows: Rows, info: ScreenInfo) -> None:
    """What has been learnt; what stands at its bound stands out."""
    rows.row("learnt")
    if info.learnt is None:
        rows.put("-")
        return
    for label, text, at_bound in in_brief(info.learnt):
        rows.put(f"{label} ", DIM)
        rows.put(text, _WARN if at_bound else PLAIN)
        rows.put("  " if rows.width < _WIDE else "     ")


def _loop(rows: Rows, history: History) -> None:
    for label, histogram in (("lateness", history.lateness), ("latency", history.latency)):
        _distribution(rows, label, histogram)
    h = history
    amiss = h.amiss.all
    _counts(
        rows,
        "ticks",
        ("run", h.ticks, False),
        ("skipped", h.skipped, True),
        ("saturated", h.saturated, True),
        ("frames in", h.received, False),
    )
    _counts(
        rows,
        "amiss",
        ("missing", amiss.missing, True),
        ("late", amiss.late, True),
        ("odd", amiss.odd, True),
        ("per min", sum(h.amiss.lately()), True),
        ("corrupt", h.amiss.corrupt, True),
        ("frozen", h.amiss.frozen, True),
    )
    if h.log_written is None or h.log_dropped is None:
        rows.row("log")
        rows.put("-")
    else:
        _counts(rows, "log", ("written", h.log_written, False), ("dropped", h.log_dropped, True))


def _events(rows: Rows, history: History, info: ScreenInfo, count: int) -> None:
    """The newest events, the newest first."""
    newest = list(history.events)[-count:][::-1]
    for i in range(count):
        rows.row("events" if i == 0 else "")
        if i < len(newest):
            event = newest[i]
            rows.put(f"{clock((event.t_ns - history.first_ns) * 1e-9)} ", DIM)
            rows.put(_in_words(event, info), _BAD if event.kind == "fault" else PLAIN)


def _in_words(event: Event, info: ScreenInfo) -> str:
    if event.kind == "fault":
        return "fault " + ", ".join(bit_names(event.what, info.fault_names))
    if event.kind == "state":
        return f"{name_of(State, event.what)} > {name_of(State, event.then)}"
    if event.kind == "hunting":
        return f"hunting: {name_of(Hunting, event.what)}" if event.what else "hunting over"
    return f"{name_of(RequestKind, event.what)}: {name_of(Answer, event.then)}"


def _cells(rows: Rows, *cells: tuple[str, str, Style]) -> None:
    """A row of three labels and values."""
    rows.row()
    width = max((rows.width + 2) // 3, 20)
    for label, text, style in cells:
        rows.put(label, DIM, LABEL_WIDTH)
        rows.put(text, style, width - LABEL_WIDTH)


def _counts(rows: Rows, label: str, *counts: tuple[str, int, bool]) -> None:
    """A row of counters; those that should be zero stand out when they are not."""
    rows.row(label)
    for name, count, unwanted in counts:
        rows.put(f"{name} ", DIM)
        rows.put(f"{count:,}", _WARN if unwanted and count else PLAIN)
        rows.put("  ")


def _distribution(rows: Rows, label: str, histogram: Histogram) -> None:
    rows.row(label)
    for name, ns in zip(("p50", "p99", "max"), histogram.percentiles((50, 99, 100)), strict=True):
        rows.put(f"{name} ", DIM)
        rows.put(duration(ns), PLAIN, 12)
    rows.put(shape(histogram, *_SHAPE_NS, _SHAPE_WIDTH), _COMMAND)
    if rows.room > len(_SHAPE_LABEL):
        rows.put(_SHAPE_LABEL, DIM)


def _curve_width(rows: Rows) -> int:
    return max(rows.width - LABEL_WIDTH - _RANGE, 1)


def _columns(rows: Rows, series: Trace, t_ns: int) -> list[Column]:
    return series.columns(t_ns, _curve_width(rows))


def _extremes(columns: list[Column]) -> tuple[float, float]:
    known = [c for c in columns if c is not None]
    return min((c[0] for c in known), default=0.0), max((c[1] for c in known), default=0.0)


def _curve(
    rows: Rows,
    label: str,
    columns: list[Column],
    limits: tuple[float, float],
    labels: tuple[str, str],
    height: int,
    style: Style,
) -> None:
    if height < 1:
        return
    for i, line in enumerate(sparkline(columns, *limits, height)):
        rows.row()
        rows.put(label if i == 0 else "", DIM, LABEL_WIDTH)
        rows.put(line, style)
        rows.put(" " + (labels[0] if i == 0 else labels[1] if i == height - 1 else ""), DIM)


def _at(fraction: float, n: int) -> int:
    """Cell of a bar of n cells; clamped before int(), which refuses infinity."""
    return min(n - 1, int(max(0.0, min(1.0, fraction)) * n))


def _centred_bar(fraction: float, n: int) -> str:
    middle = n // 2
    bar = ["─"] * n
    if math.isfinite(fraction):
        tip = min(n - 1, middle + round(max(-1.0, min(1.0, fraction)) * middle))
        for i in range(min(tip, middle), max(tip, middle) + 1):
            bar[i] = "█"
    bar[middle] = "│"
    return "".join(bar)


def status_line(snapshot: ScreenState, history: History) -> str:
    """The same in one line, for a terminal that cannot move its cursor."""
    record, info = snapshot.record, snapshot.info
    if record is None:
        return clean(f"{info.name}: waiting for the first tick")
    tick = record.tick
    faults = bit_names(tick.latched | tick.present, info.fault_names)
    late = history.lateness.percentiles((99, 100))
    return "  ".join(
        (
            f"{clean(info.name)} {clock(history.elapsed_s)} {name_of(State, tick.state)}{_standing(record)}",
            f"x {number(tick.estimate.position_m * 1e3, '.3f', 'mm')}",
            f"error {length(tick.error_m).strip()}",
            f"command {number(tick.command.voltage_v, '+.3f', 'V')}",
            f"late p99 {duration(late[0])} max {duration(late[1])}",
            f"skipped {history.skipped}",
            f"faults {', '.join(faults) or 'none'}",
        )
    )
