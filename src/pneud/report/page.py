"""The report: one page that holds everything it needs and opens by double-click."""

from __future__ import annotations

import base64
import html
import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from pneud import __version__
from pneud.bench.chart import svg
from pneud.log.format.schema import Level
from pneud.loop.tracking import over_in_words
from pneud.report.figures import COLOURS, FIGURES, STATE_COLOURS, line, offsets_s
from pneud.report.gather import LoggedRun
from pneud.report.readings import KINDS, SOURCES
from pneud.report.spans import Span
from pneud.report.spread import Spread
from pneud.signals import HUNTING_CURES, Timing, state_name

Reference = Mapping[str, Any]  # the object that `pneud bench --json` prints

_REFERENCE_COLOURS = {"cyclictest": "#000000", "empty": "#999999", "pneud": "#e69f00", "c": "#cc79a7"}
_TIMING_WORDS = {
    "lateness_ns": "wake-up lateness",
    "set_ns": "SYNC sent to set complete",
    "cycle_ns": "cycle",
    "send_ns": "command encoded and sent",
    "latency_ns": "newest sensor frame to command sent",
    "record_ns": "record handed over",
}
_SPANS_SHOWN = 4000


class Drawn(str):
    """A cell that is markup."""


def page(runs: Sequence[LoggedRun], reference: Reference | None = None) -> str:
    """The page.

    Args:
        runs: one, or several to compare; those of equal name are told apart by number.
        reference: a benchmark of the machine, to put the timing beside.
    """
    names = _names(runs)
    title = f"pneud report: {', '.join(names)}"
    data = json.dumps(_data(runs, names), separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title>",
        f"<style>{_asset('uPlot.min.css')}\n{_asset('report.css')}</style></head><body>",
        f"<header><h1>{html.escape(runs[0].config.name)}</h1>{_subtitle(runs, names)}</header>",
        "<main>",
        _warnings(runs, names),
        "<section><h2>Summary</h2>",
        _summary(runs, names),
        "</section>",
        '<section><h2>Run</h2><p class="hint">Drag across a plot to zoom all of them, double-click to see'
        " everything; the cursor is shared. Click a name in a legend to hide its line.</p>",
        '<div id="timeline" class="plot"></div><div id="plots"></div>',
        '<div id="phase" class="plot"></div></section>',
        "<section><h2>Timing</h2>",
        _timing(runs, names, reference),
        "</section><section><h2>Bus</h2>",
        *(_bus(run, name if len(runs) > 1 else "") for run, name in zip(runs, names, strict=True)),
        "</section><section><h2>Learnt</h2>",
        *(_learnt(run, name if len(runs) > 1 else "") for run, name in zip(runs, names, strict=True)),
        "</section><section><h2>Events</h2>",
        *(_events(run, name if len(runs) > 1 else "") for run, name in zip(runs, names, strict=True)),
        "</section><section><h2>Machine</h2>",
        _machine(runs, names),
        "</section><section><h2>Configuration</h2>",
        *(_configuration(run, name) for run, name in zip(runs, names, strict=True)),
        "</section></main>",
        f"<footer>pneud {__version__}. Plots: uPlot, © Leon Sorokin, MIT licence.</footer>",
        f"<!-- uPlot\n{_asset('uPlot.LICENSE').replace('--', '- -')}-->",
        f'<script type="application/json" id="data">{data}</script>',
        f"<script>{_asset('uPlot.iife.min.js')}</script>",
        f"<script>{_asset('report.js')}</script>",
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _asset(name: str) -> str:
    return (files("pneud.report") / "assets" / name).read_text(encoding="utf-8").strip()


def _names(runs: Sequence[LoggedRun]) -> list[str]:
    plain = [run.name.removesuffix(".mcap") for run in runs]
    return [
        f"{name} ({plain[: i + 1].count(name)})" if plain.count(name) > 1 else name
        for i, name in enumerate(plain)
    ]


# What the script draws


def _data(runs: Sequence[LoggedRun], names: Sequence[str]) -> dict[str, Any]:
    shifts = offsets_s(runs)
    return {
        "figures": [{**f._asdict(), "series": [s._asdict() for s in f.series]} for f in FIGURES],
        "aligned": any(shifts),
        "runs": [
            _run(run, name, shift, COLOURS[i % len(COLOURS)])
            for i, (run, name, shift) in enumerate(zip(runs, names, shifts, strict=True))
        ],
    }


def _run(run: LoggedRun, name: str, shift_s: float, colour: str) -> dict[str, Any]:
    columns = {}
    for figure in FIGURES:
        for series in figure.series:
            values = line(run, series.column)
            if values is not None:
                columns[series.column] = _packed(values, "<f4")
    return {
        "name": name,
        "colour": colour,
        "start": _utc(run),
        "t": _packed(run.series.t_s - shift_s, "<f8"),
        "columns": columns,
        "phase": {
            "t": _packed(run.phase.t_s - shift_s, "<f8"),
            "x": _packed(run.phase.values[:, 0], "<f4"),
            "y": _packed(run.phase.values[:, 1], "<f4"),
        },
        "states": [
            [*_seconds(span, shift_s), state_name(span.value - 1), _state_colour(span.value)]
            for span in run.states[:_SPANS_SHOWN]
        ],
        "faults": [
            {
                "name": run.fault_name(bit),
                "present": [_seconds(s, shift_s) for s in spans],
                "latched": [_seconds(s, shift_s) for s in run.latched.get(bit, ())],
            }
            for bit, spans in {**{b: [] for b in run.latched}, **run.present}.items()
        ],
        "saturated": [_seconds(s, shift_s) for s in run.saturated],
        "gaps": [[*_seconds(s, shift_s), s.value] for s in run.gaps],
        "marks": [[round(m.t_s - shift_s, 6), m.text] for m in run.marks],
    }


def _seconds(span: Span, shift_s: float) -> list[float]:
    return [round(span.begin_s - shift_s, 6), round(span.end_s - shift_s, 6)]


def _packed(values: Any, kind: str) -> str:
    with np.errstate(over="ignore"):  # what floats cannot hold becomes infinite
        return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def _state_colour(value: int) -> str:
    return {int(state): colour for state, colour in STATE_COLOURS.items()}.get(value - 1, "#000000")


# Words and tables


def _utc(run: LoggedRun) -> str:
    if run.simulated:
        return "simulated time"
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(run.start_unix_s))


def _length(run: LoggedRun) -> str:
    first_s = float(run.series.t_s[0])
    return f"{run.last_s:.1f} s" if first_s == 0.0 else f"{first_s:.3f} to {run.last_s:.3f} s"


def _subtitle(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    lines = []
    for run, name, colour in zip(runs, names, COLOURS * len(runs), strict=False):
        key = f'<i class="key" style="background:{colour}"></i>' if len(runs) > 1 else ""
        log = run.log
        lines.append(
            f"<p>{key}<b>{html.escape(name)}</b>: {_utc(run)}, {_length(run)} at {log.rate_hz:g} Hz on"
            f" {html.escape(log.metadata.get('bus', 'an unknown bus'))}, pneud"
            f" {html.escape(log.metadata.get('pneud', '?'))}</p>"
        )
    if any(offsets_s(runs)):
        lines.append("<p>Times begin where each log was first engaged.</p>")
    return "".join(lines)


def _warnings(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    found = []
    for run, name in zip(runs, names, strict=True):
        if run.log.truncated:
            found.append(f"{name}: {run.log.damage}; shown is what could be read")
        if run.missing:
            found.append(f"{name}: {run.missing} records are missing")
    return "".join(f'<p class="warning">{html.escape(text)}</p>' for text in found)


def _summary(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    def figure(found: dict[str, Any] | None, name: str, form: str) -> str:
        return "–" if found is None or found[name] is None else format(found[name], form)

    rows: list[tuple[str, list[str]]] = [
        ("state", [state_name(run.counted.state) if run.counted.ticks else "–" for run in runs]),
        ("faults latched", [", ".join(map(run.fault_name, run.latched)) or "none" for run in runs]),
        ("hunting", [_hunting(run) for run in runs]),
        ("in position [s]", [f"{_seconds_of(run.in_position):.1f}" for run in runs]),
        ("ticks", [f"{run.counted.ticks:,}" for run in runs]),
        ("skipped", [f"{run.counted.skipped:,}" for run in runs]),
        ("saturated", [f"{run.counted.saturated:,}" for run in runs]),
        ("readings amiss", [run.readings.total_in_words() for run in runs]),
        ("tracking error RMS [mm]", [figure(run.tracking_mm, "rms", ".4f") for run in runs]),
        ("tracking error max [mm]", [figure(run.tracking_mm, "max", ".4f") for run in runs]),
        ("tracking error over", [over_in_words(run.tracking_mm) for run in runs]),
        ("error against", [run.error_against for run in runs]),
        ("command max [V]", [figure(run.command_v, "max", ".3f") for run in runs]),
        ("command mean step [V]", [figure(run.command_v, "mean_step", ".4f") for run in runs]),
        ("wake-up lateness p50 / p99 / max [µs]", [_three(run, "lateness_ns") for run in runs]),
        ("sensor to command p50 / p99 / max [µs]", [_three(run, "latency_ns") for run in runs]),
    ]
    return _table(("", *names), ((words, *cells) for words, cells in rows))


def _seconds_of(spans: Sequence[Span]) -> float:
    return sum(span.end_s - span.begin_s for span in spans)


def _hunting(run: LoggedRun) -> str:
    """For how long the load hunted by which cause, and what to look at."""
    found = []
    for cause in sorted({span.value for span in run.hunting}):
        seconds = _seconds_of([span for span in run.hunting if span.value == cause])
        found.append(f"{seconds:.1f} s: check {HUNTING_CURES.get(cause)}")
    return "; ".join(found) or "none"


def _three(run: LoggedRun, name: str) -> str:
    return "–" if run.simulated else run.timing[name].in_words(" / ")


def _timing(runs: Sequence[LoggedRun], names: Sequence[str], reference: Reference | None) -> str:
    timed = [(name, run) for name, run in zip(names, runs, strict=True) if not run.simulated]
    late: dict[str, list[Any]] = {name: run.timing["lateness_ns"].buckets() for name, run in timed}
    colours = dict(zip(names, COLOURS * len(runs), strict=False))
    words = ""
    if reference is not None:
        machine = reference["machine"]
        for name, buckets in reference["wakeup_histograms_ns"].items():
            late[f"{name} (bench)"] = [tuple(bucket) for bucket in buckets]
            colours[f"{name} (bench)"] = _REFERENCE_COLOURS.get(name, "#56b4e9")
        words = (
            f'<p class="hint">Beside it pneud bench on {html.escape(str(machine["cpu_model"]))},'
            f" {html.escape(str(machine['kernel']))}.</p>"
        )
    parts = []
    if any(late.values()):
        parts += [
            "<h3>Wake-up lateness</h3>",
            svg({k: v for k, v in late.items() if v}, colours=colours),
            words,
        ]
    if not timed:
        parts.append("<p>Simulated time: nothing is late, and computing takes no time.</p>")
    latency = {name: run.timing["latency_ns"].buckets() for name, run in timed}
    if any(latency.values()):
        across = "µs from the newest sensor frame to the command sent"
        parts += ["<h3>Sensor to command</h3>", svg({k: v for k, v in latency.items() if v}, across, colours)]
    head = ("µs", "count", "p50", "p99", "p99.9", "max")
    for run, name in zip(runs, names, strict=True):
        spreads = {_TIMING_WORDS[field]: run.timing[field] for field in Timing._fields}
        spreads["jitter of SYNC on the bus"] = run.health.sync_jitter
        for source in run.health.sources:
            label = source.name.replace("_", " ")
            spreads[f"{label}: SYNC sent to answer received"] = source.answer
            spreads[f"{label}: age when the command is sent"] = source.age
        if len(runs) > 1:
            parts.append(f"<h3>{html.escape(name)}</h3>")
        parts.append(_table(head, ((words, *_percentiles(spread)) for words, spread in spreads.items())))
    return "".join(parts)


def _percentiles(spread: Spread) -> tuple[str, ...]:
    if not spread.count:
        return ("0", "–", "–", "–", "–")
    return (f"{spread.count:,}", *(f"{spread.percentile_ns(q) / 1e3:.1f}" for q in (50, 99, 99.9, 100)))


def _bus(run: LoggedRun, name: str) -> str:
    health = run.health
    seconds = max(run.last_s, 1e-9)
    sources = {s.codec.can_id: s for s in health.sources}
    rows = []
    for row in health.rows():
        source = sources.get(row.can_id) if row.direction == "received" else None
        wrong = (
            (f"{source.lost:,}", f"{source.corrupt:,}", f"{source.frozen:,}", f"{source.late:,}")
            if source is not None
            else ("", "", "", "")
        )
        rows.append(
            (
                f"0x{row.can_id & 0x1FFFFFFF:03X}",
                row.name,
                row.direction,
                f"{row.frames:,}",
                f"{row.frames / seconds:.1f}",
                *wrong,
            )
        )
    notes = [f"{health.error_frames:,} error frames", f"{health.unsent:,} frames could not be sent"]
    if health.foreign:
        notes.append(f"{health.foreign:,} SYNC or valve commands of another controller")
    notes += [f"emergency 0x{code:04X} of node {node}" for node, code in sorted(health.emcy.items())]
    heading = f"<h3>{html.escape(name)}</h3>" if name else ""
    head = ("id", "frame", "", "count", "per second", "lost", "corrupt", "frozen", "late")
    return f"{heading}{_table(head, rows, words=3)}<p>{', '.join(notes)}.</p>{_readings(run)}"


def _readings(run: LoggedRun) -> str:
    """Ticks without a reading in time that is believed."""
    length_s = run.counted.ticks / run.log.rate_hz
    head = (
        "ticks without",
        *(cell for kind in KINDS for cell in (kind, "a minute", "worst second")),
    )
    rows = (
        (source, *(cell for kind in KINDS for cell in run.readings.in_words(source, kind, length_s)))
        for source in SOURCES
    )
    return _table(head, rows)


def _learnt(run: LoggedRun, name: str) -> str:
    heading = f"<h3>{html.escape(name)}</h3>" if name else ""
    start = run.config.control.adaptation.start.log
    begun = f"<p>Begun with what was learnt in {html.escape(start)}.</p>" if start else ""
    if not run.learning.last:
        return f"{heading}{begun}<p>Nothing: adaptation was off, or no snapshot of the axis tells.</p>"
    t_s = run.learning.t_s
    head = ("", "configured", "learnt", "meanwhile", "", f"{t_s[0]:.0f} … {t_s[-1]:.0f} s")
    rows = ((*words, Drawn(picture)) for *words, picture in run.learning.rows())
    return f"{heading}{begun}{_table(head, rows, last=2)}"


def _events(run: LoggedRun, name: str) -> str:
    rows = []
    for event in run.events:
        try:
            level = Level(event.level).name.lower()
        except ValueError:
            level = str(event.level)
        t_s = 1e-9 * event.log_time_ns - run.start_unix_s
        rows.append((f"{t_s:.3f}", level, event.name, event.message))
    more = f"<p>and {run.more_events:,} more</p>" if run.more_events else ""
    heading = f"<h3>{html.escape(name)}</h3>" if name else ""
    return f"{heading}{_table(('s', 'level', 'from', ''), rows, words=0, last=3, kinds=1)}{more}"


def _machine(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    keys: dict[str, None] = {}
    for run in runs:
        keys |= dict.fromkeys(k for k in run.log.metadata if k != "faults")
    rows = [(key, *(run.log.metadata.get(key, "–") for run in runs)) for key in keys]
    setup: dict[str, None] = {}
    for run in runs:
        setup |= dict.fromkeys(run.log.setup)
    rows += [(key, *(run.log.setup.get(key, "–") for run in runs)) for key in setup]
    return _table(("", *names), rows, last=len(runs))


def _configuration(run: LoggedRun, name: str) -> str:
    title = f"{html.escape(run.log.config_name)} of {html.escape(name)}"
    return f"<details><summary>{title}</summary><pre>{html.escape(run.log.config_text)}</pre></details>"


def _table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, words: int = 1, last: int = 0, kinds: int = -1
) -> str:
    """A table: the first `words` columns and the `last` ones are words; column `kinds` is the row's class."""

    def cells(row: Sequence[str], tag: str) -> str:
        left = set(range(words)) | set(range(len(row) - last, len(row)))
        return "".join(
            f"<{tag}{' class=w' if i in left else ''}>"
            f"{cell if isinstance(cell, Drawn) else html.escape(cell)}</{tag}>"
            for i, cell in enumerate(row)
        )

    body = "".join(
        f"<tr{f' class={html.escape(row[kinds], quote=True)}' if kinds >= 0 else ''}>{cells(row, 'td')}</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><thead><tr>{cells(head, "th")}</tr></thead>{body}</table></div>'


def is_reference(value: Any) -> bool:
    """Whether this is what `pneud bench --json` prints."""
    return (
        isinstance(value, dict)
        and value.get("schema") == 1
        and isinstance(value.get("machine"), dict)
        and {"cpu_model", "kernel"} <= value["machine"].keys()
        and isinstance(value.get("wakeup_histograms_ns"), dict)
        and all(
            isinstance(bucket, list) and len(bucket) == 3 and all(_is_count(x) for x in bucket)
            for buckets in value["wakeup_histograms_ns"].values()
            for bucket in buckets
        )
    )


def _is_count(x: Any) -> bool:
    return isinstance(x, (int, float)) and math.isfinite(x) and x >= 0
