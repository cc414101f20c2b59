"""One page about an axis: everything an operator looks at, made of a snapshot and a history.

Nothing here knows where the records come from, what the time is, or what a terminal is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from rich.console import Console, ConsoleOptions, RenderResult
from rich.segment import Segment

from pneud.rt.histogram import Histogram
from pneud.signals import Answer, Hunting, Record, RequestKind, State
from pneud.view import margins, mileage
from pneud.view.banner import Banner, Level, banner_of, faults_of
from pneud.view.curves import curve_width, curves_of, draw
from pneud.view.history import Event, History, shape
from pneud.view.info import ScreenInfo
from pneud.view.learnt import in_brief
from pneud.view.palette import Palette, palette
from pneud.view.plot import samples
from pneud.view.text import (
    BOLD,
    DIM,
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

_WIDE = 150  # from here on, two columns
_SHORT = 30  # up to here, what can be said in one row is
_TALL, _MANY_EVENTS = 34, 5
_SHAPE_NS, _SHAPE_WIDTH, _SHAPE_LABEL = (1e3, 1e7), 22, " 1 µs … 10 ms, logarithmic"
_GUTTER = "  "
_GOOD_LATE = 0.2  # of the period


_Part: TypeAlias = "Callable[[_Scene, Rows], None]"


class Typed(NamedTuple):
    """What an operator does at the screen."""

    prompt: str = ""  # what is asked
    message: str = ""  # what the console has said
    hints: tuple[tuple[str, str], ...] = ()  # keys that make sense now
    help: tuple[tuple[str, str], ...] = ()  # all keys, where they are asked for
    light: bool = False


class ScreenState(NamedTuple):
    """What there is to show at one instant."""

    record: Record | None  # None before the first tick
    info: ScreenInfo
    typed: Typed = Typed()
    disk: tuple[str, bool] = ("-", False)  # how long it lasts, and whether that is little


class _Scene(NamedTuple):
    """What all parts of a page are drawn from."""

    snapshot: ScreenState
    record: Record
    history: History
    look: Palette
    short: bool  # there are few rows


class Drawn:
    """Rows of a page as a rich renderable."""

    def __init__(self, rows: list[list[Segment]]) -> None:
        self._rows = rows

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the segments of the rows."""
        for i, row in enumerate(self._rows):
            if i:
                yield Segment.line()
            yield from row


class Page:
    """The page for a terminal of a size, a rich renderable of exactly that.

    80 × 24 shows everything, more makes the curves larger. `ascii_only` None asks the console that shows it.
    """

    def __init__(
        self, snapshot: ScreenState, history: History, size: tuple[int, int], ascii_only: bool | None = None
    ) -> None:
        self._snapshot = snapshot
        self._history = history
        self._size = max(size[0], 1), max(size[1], 1)
        self._ascii_only = ascii_only

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the page's segments."""
        ascii_only = options.ascii_only if self._ascii_only is None else self._ascii_only
        yield Drawn(rows_of(self._snapshot, self._history, self._size, ascii_only))


def rows_of(
    snapshot: ScreenState, history: History, size: tuple[int, int], ascii_only: bool
) -> list[list[Segment]]:
    """The page as rows of segments: exactly as many, each exactly as wide as asked for."""
    width, height = max(size[0], 1), max(size[1], 1)
    rows, look = Rows(width, ascii_only), palette(snapshot.typed.light)
    record = snapshot.record
    banner = banner_of(record, snapshot.info, history.silent_s)
    _head(rows, snapshot, history, banner, look)
    if snapshot.typed.help:
        _help(rows, snapshot)
    elif record is not None:
        events = _MANY_EVENTS if height >= _TALL else 1
        scene = _Scene(snapshot, record, history, look, height < _SHORT)
        _body(scene, rows, height - rows.count - events - 1)
        _events(rows, history, snapshot.info, look, events + max(0, height - rows.count - events - 1))
    _foot(rows, snapshot, look)
    return rows.done(height)


def _head(rows: Rows, snapshot: ScreenState, history: History, banner: Banner, look: Palette) -> None:
    info, record = snapshot.info, snapshot.record
    rows.row()
    badge = "" if record is None else f" {name_of(State, record.tick.state)}{standing(record)} "
    rows.put(clean(f"pneud · {info.name}{info.others}")[: max(rows.room - len(badge) - 1, 0)], BOLD)
    rest = f" · {info.bus} · {info.rate_hz:g} Hz · {clock(history.elapsed_s)}"
    rows.put(clean(rest)[: max(rows.room - len(badge) - 1, 0)])
    if record is not None:
        rows.right(badge, look.hunting if record.tick.hunting else look.badge(record.tick.state))
    style = look.of(banner.level)
    most = 1 if rows.width >= _WIDE else 2
    rows.wrapped(clean(banner.words), style, most)
    _aside(rows, clean(info.note))
    if banner.then:
        rows.wrapped(clean(banner.then), BOLD, most)
        _aside(rows, clean(f"elsewhere: {info.elsewhere}") if info.elsewhere else "")
    faults = faults_of(record, info) if record is not None else []
    if faults:
        rows.row("faults")
        for i, (name, level) in enumerate(faults):
            fits = len(name) + (0 if i + 1 == len(faults) else 4) <= rows.room
            rows.put(name if fits else "…", look.of(level))
            rows.put("  ")
            if not fits:
                break


def _aside(rows: Rows, text: str) -> None:
    """What is good to know, at the right where there is room for all of it."""
    if text and len(text) + 3 <= rows.room:
        rows.right(text, DIM)


def standing(record: Record) -> str:
    """How the load stands at its target."""
    return ", hunting" if record.tick.hunting else ", in position" if record.tick.in_position else ""


def _body(scene: _Scene, rows: Rows, height: int) -> None:
    """Curves, margins and counts in so many rows: one column of them, or two."""
    if rows.width < _WIDE:
        _column(scene, rows, height, (0, 1, 2, 3), (_margins, _estimates, _loop))
        return
    width = (rows.width - len(_GUTTER)) // 2
    left, right = Rows(width, rows.ascii_only), Rows(rows.width - len(_GUTTER) - width, rows.ascii_only)
    _column(scene, left, height, (0, 1), (_margins, _estimates))
    _column(scene, right, height, (2, 3), (_loop,))
    rows.extend(left, right)


def _column(scene: _Scene, rows: Rows, height: int, which: tuple[int, ...], below: tuple[_Part, ...]) -> None:
    """Some of the groups of curves, and what stands below them."""
    rest = Rows(rows.width, rows.ascii_only)
    for part in below:
        part(scene, rest)
    columns = samples(curve_width(rows.width), rows.ascii_only)
    found = curves_of(scene.record, scene.history, scene.snapshot.info, scene.look, columns)
    spare = height - rest.count - len(which)
    for i, rows_each in zip(which, _heights(spare, which), strict=True):
        draw(rows, found[i], rows_each)
    rows.extend(rest)


def _heights(spare: int, which: tuple[int, ...]) -> list[int]:
    """Rows of each group of curves; error and valve are worth a little more."""
    spare = max(spare, 0)
    order = sorted(range(len(which)), key=lambda i: (0, 2, 1, 3)[which[i]])
    heights = [spare // len(which)] * len(which)
    for i in order[: spare % len(which)]:
        heights[i] += 1
    return heights


def _margins(scene: _Scene, rows: Rows) -> None:
    if not scene.short:
        rows.title("margins", ("what is left", DIM))
    margins.draw(rows, scene.record, scene.history, scene.snapshot.info, scene.look)


def _estimates(scene: _Scene, rows: Rows) -> None:
    """The forces, and what has been learnt; what stands at its bound stands out."""
    e, learnt = scene.record.tick.estimate, scene.snapshot.info.learnt
    rows.row("estimated")
    gap = _GUTTER if rows.width < 120 else "     "
    for label, text in (
        ("load force", number(e.force_n, "+.1f", "N")),
        ("disturbance", number(e.d_hat_n_s, "+.0f", "N/s")),
    ):
        rows.put(f"{label} ", DIM)
        rows.put(text + gap)
    if (done := scene.snapshot.info.mileage) is not None and scene.short:
        (_, strokes), (_, travel), *_ = mileage.in_brief(done)
        whole = f"{strokes} strokes, {travel}"
        _aside(rows, whole if len(whole) + 3 <= rows.room else travel)
    if learnt is None:
        return
    rows.row("learnt")
    for label, text, at_bound in in_brief(learnt):
        rows.put(f"{label} ", DIM)
        rows.put(text, scene.look.warn if at_bound else PLAIN)
        rows.put(gap)


def _loop(scene: _Scene, rows: Rows) -> None:
    """Timing with its verdict, readings, counts, the log."""
    h, info, look, t_ns = scene.history, scene.snapshot.info, scene.look, scene.record.tick.t_ns
    level, words = timing_verdict(h, info.rate_hz, t_ns)
    rows.title("loop", (words, look.of(level)))
    if scene.short:
        rows.row("timing")
        for label, histogram in (("lateness", h.lateness), ("latency", h.latency)):
            _percentiles(rows, label, histogram)
    else:
        for label, histogram in (("lateness", h.lateness), ("latency", h.latency)):
            _distribution(rows, label, histogram)
    amiss = h.amiss.all
    _counts(
        rows,
        look,
        "readings",
        *(("missing", f"{amiss.missing:,}", amiss.missing > 0), ("late", f"{amiss.late:,}", amiss.late > 0)),
        *(("odd", f"{amiss.odd:,}", amiss.odd > 0), _lately(h)),
        ("corrupt", f"{h.amiss.corrupt:,}", h.amiss.corrupt > 0),
        ("frozen", f"{h.amiss.frozen:,}", h.amiss.frozen > 0),
    )
    share, load = 100.0 * h.saturated_lately(t_ns), h.bus_bit_s / info.bitrate_bit_s
    known = math.isfinite(load) and math.isfinite(info.bitrate_bit_s)
    _counts(
        rows,
        look,
        "ticks",
        *(("run", f"{h.ticks:,}", False), ("skipped", f"{h.skipped:,}", h.skipped > 0)),
        ("saturated", f"{share:.1f} % of 10 s" if math.isfinite(share) else "-", share > 1.0),
        ("bus", f"{100.0 * load:.0f} % busy" if known else "-", known and load > 0.7),
    )
    written, dropped = h.log_written, h.log_dropped
    disk, little = scene.snapshot.disk
    _counts(
        rows,
        look,
        "log",
        ("written", "-" if written is None else f"{written:,}", False),
        ("dropped", "-" if dropped is None else f"{dropped:,}", bool(dropped)),
        *(("disk", disk, little), ("frames in", f"{h.received:,}", False)),
    )
    if info.mileage is not None and not scene.short:
        done = mileage.in_brief(info.mileage)
        _counts(rows, look, "done", *((label, text, False) for label, text in done))


def _lately(h: History) -> tuple[str, str, bool]:
    count = sum(h.amiss.lately())
    return "per min", f"{count:,}", count > 0


def timing_verdict(history: History, rate_hz: float, t_ns: int) -> tuple[Level, str]:
    """Whether the loop is on time, first in words."""
    period_ns = 1e9 / rate_hz
    skipped = history.skipped_lately(t_ns)
    (late_ns,) = history.lateness.percentiles((99,))
    if skipped * 1000 > rate_hz * min(10.0, max(history.elapsed_s, 1.0)):
        return Level.BAD, f"too late: {skipped:,} ticks skipped in 10 s; pneud doctor says why"
    if skipped:
        return Level.LOOK, f"late now and then: {skipped:,} ticks skipped in 10 s"
    if math.isfinite(late_ns) and late_ns > _GOOD_LATE * period_ns:
        return Level.LOOK, f"no tick skipped, but one in a hundred is later than {duration(late_ns)}"
    return Level.GOOD, "on time: no tick skipped in 10 s"


def _events(rows: Rows, history: History, info: ScreenInfo, look: Palette, count: int) -> None:
    """The newest events, the newest first."""
    newest = list(history.events)[-count:][::-1]
    for i in range(count):
        rows.row("events" if i == 0 else " ")
        if i < len(newest):
            event = newest[i]
            rows.put(f"{clock((event.t_ns - history.first_ns) * 1e-9)} ", DIM)
            rows.put(_in_words(event, info), look.bad if event.kind == "fault" else PLAIN)


def _in_words(event: Event, info: ScreenInfo) -> str:
    if event.kind == "fault":
        return "fault " + ", ".join(bit_names(event.what, info.fault_names))
    if event.kind == "state":
        return f"{name_of(State, event.what)} > {name_of(State, event.then)}"
    if event.kind == "hunting":
        return f"hunting: {name_of(Hunting, event.what)}" if event.what else "hunting over"
    return f"{name_of(RequestKind, event.what)}: {name_of(Answer, event.then)}"


def _help(rows: Rows, snapshot: ScreenState) -> None:
    """All keys, and what is to be seen."""
    info = snapshot.info
    rows.title("keys")
    for shown, line in snapshot.typed.help:
        rows.row()
        rows.put(f"  {shown}", BOLD, LABEL_WIDTH)
        rows.put(line)
    rows.title("also")
    for label, text in (
        ("attach", f"{info.elsewhere} shows this in another terminal" if info.elsewhere else ""),
        ("note", info.note),
        ("log", info.log_path),
        ("curves", "each column from the smallest to the largest value; ┄ dead zone"),
        ("bars", "how much is used of what is allowed; │ the worst of the last 10 s"),
    ):
        if text:
            rows.row(f"  {label}")
            rows.put(clean(text))


def _foot(rows: Rows, snapshot: ScreenState, look: Palette) -> None:
    """What is asked of the person, or else what the console has said, or else the keys."""
    typed = snapshot.typed
    rows.row()
    if typed.prompt:
        rows.put(clean(typed.prompt), look.prompt, rows.width)
        return
    if typed.message:
        rows.put(clean(typed.message), look.warn)
        rows.right("? help", DIM)
        return
    hints = list(typed.hints)
    while len(hints) > 3 and sum(len(shown) + len(word) + 4 for shown, word in hints) > rows.width:
        del hints[-3]  # help and the way out stay, and so does the stop
    for shown, word in hints:
        rows.put(f" {shown} ", look.key)
        rows.put(f" {word} ")
    path = clean(snapshot.info.log_path)
    if rows.room > 24:
        room = rows.room - 2
        rows.right(path if len(path) <= room else "…" + path[len(path) - room + 1 :], DIM)


def _counts(rows: Rows, look: Palette, label: str, *counts: tuple[str, str, bool]) -> None:
    """A row of counters; those that should not be so stand out."""
    rows.row(label)
    for name, text, unwanted in counts:
        rows.put(f"{name} ", DIM)
        rows.put(text, look.warn if unwanted else PLAIN)
        rows.put("  ")


def _percentiles(rows: Rows, label: str, histogram: Histogram) -> None:
    rows.put(f"{label} p99 ", DIM)
    for name, ns in zip((" max ", "   "), histogram.percentiles((99, 100)), strict=True):
        rows.put(duration(ns))
        rows.put(name, DIM)


def _distribution(rows: Rows, label: str, histogram: Histogram) -> None:
    rows.row(label)
    for name, ns in zip(("p50", "p99", "max"), histogram.percentiles((50, 99, 100)), strict=True):
        rows.put(f"{name} ", DIM)
        rows.put(duration(ns), PLAIN, 12)
    rows.put(shape(histogram, *_SHAPE_NS, _SHAPE_WIDTH))
    if rows.room > len(_SHAPE_LABEL):
        rows.put(_SHAPE_LABEL, DIM)


def status_line(snapshot: ScreenState, history: History) -> str:
    """The same in one line, for a terminal that cannot move its cursor."""
    record, info = snapshot.record, snapshot.info
    if record is None:
        return clean(f"{info.name}: waiting for the first tick")
    tick = record.tick
    faults = bit_names(tick.latched | tick.present, info.fault_names)
    late = history.lateness.percentiles((99, 100))
    banner = banner_of(record, info, history.silent_s)
    return "  ".join(
        (
            f"{clean(info.name)} {clock(history.elapsed_s)} {name_of(State, tick.state)}{standing(record)}",
            f"x {number(tick.estimate.position_m * 1e3, '.3f', 'mm')}",
            f"error {length(tick.error_m).strip()}",
            f"command {number(tick.command.voltage_v, '+.3f', 'V')}",
            f"late p99 {duration(late[0])} max {duration(late[1])}",
            f"skipped {history.skipped}",
            f"faults {', '.join(faults) or 'none'}",
            *([] if banner.level == Level.GOOD else [clean(banner.words)]),
        )
    )
