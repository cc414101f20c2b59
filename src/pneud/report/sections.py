"""Words and tables of a report, section by section."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pneud.bench.chart import svg
from pneud.canopen.objects import emergency_words
from pneud.config.conversions import controller_of
from pneud.config.writing import noted
from pneud.control.tunables import LAWS, names_of, tunables
from pneud.log.format.schema import Level
from pneud.log.live.mileage import fields_of, total
from pneud.loop.tracking import over_in_words
from pneud.replay.mileage import done_before
from pneud.replay.motions import Motion
from pneud.report.colours import colours_of
from pneud.report.differences import OF_EACH_RUN, differences
from pneud.report.frame import Drawn, Verdict, badge, facts_list, strip, table
from pneud.report.gather import LoggedRun
from pneud.report.readings import KINDS, SOURCES
from pneud.report.spans import Span
from pneud.report.spread import Spread
from pneud.report.stops import Seen
from pneud.safety.faults import TABLE
from pneud.signals import HUNTING_CURES, Timing, state_name
from pneud.view import mileage

Reference = Mapping[str, Any]  # the object that `pneud bench --json` prints

MOTIONS = 200  # of a log, in the table
CLOSEUPS = 12
_SIDE_BY_SIDE = 4  # logs: more than these are one below the other
_OPEN = 2  # logs whose details stand open
_REFERENCE_COLOURS = {"cyclictest": "#000000", "empty": "#999999", "pneud": "#e69f00", "c": "#cc79a7"}
_TIMING_WORDS = {
    "lateness_ns": "wake-up lateness",
    "set_ns": "SYNC sent to set complete",
    "cycle_ns": "cycle",
    "send_ns": "command encoded and sent",
    "latency_ns": "newest sensor frame to command sent",
    "record_ns": "record handed over",
}
_FAULTS = {fault.name: fault for fault in TABLE}


def each(names: Sequence[str], parts: Sequence[str]) -> str:
    """What there is of each log, below its name where there are several."""
    if len(parts) == 1:
        return parts[0]
    opened = " open" if len(parts) <= _OPEN else ""
    found = "".join(
        f"<details{opened}><summary>{html.escape(name)}</summary>{part}</details>"
        for name, part in zip(names, parts, strict=True)
        if part
    )
    return f'<div class="each">{found}</div>' if len(parts) > _OPEN and found else found


def compared(names: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]], label: str) -> str:
    """A row for each figure and a column for each log; the other way about where there are many."""
    found = list(rows)
    if len(names) <= _SIDE_BY_SIDE:
        return table(("", *names), ((words, *cells) for words, cells in found), label=label)
    equal = [(words, cells[0]) for words, cells in found if len(set(cells)) == 1]
    others = [(words, cells) for words, cells in found if len(set(cells)) > 1]
    if not others:
        return facts_list(equal)
    turned = table(
        ("log", *(words for words, _ in others)),
        zip(names, *(cells for _, cells in others), strict=True),
        label=label,
    )
    return turned + (f"<p>Of all logs:</p>{facts_list(equal)}" if equal else "")


# At the top


def lead(runs: Sequence[LoggedRun], names: Sequence[str], verdicts: Sequence[Verdict]) -> str:
    """Below the heading: the verdict on one log, or the logs with theirs."""
    if len(runs) == 1:
        return strip(verdicts[0], facts(runs[0], names[0]))
    rows = (
        (_keyed(name, colour), badge(verdict.level), _length(run), "; ".join(verdict.reasons))
        for run, name, colour, verdict in zip(runs, names, colours_of(len(runs)), verdicts, strict=True)
    )
    told = [facts(run, "")[1:] for run in runs]
    alike = [fact for fact in told[0] if all(fact in others for others in told)]
    return table(("log", "verdict", "length", "why"), rows, label="verdicts", words=4) + facts_list(alike)


def keys(names: Sequence[str]) -> str:
    """Buttons that show and hide each of several logs in all plots."""
    if len(names) < 2:
        return ""
    buttons = "".join(
        f'<button data-run="{i}" aria-pressed="true">{_keyed(name, colour)}</button>'
        for i, (name, colour) in enumerate(zip(names, colours_of(len(names)), strict=True))
    )
    return f'<div class="runs">{buttons}</div>'


def _keyed(name: str, colour: str) -> Drawn:
    return Drawn(f'<i class="key" style="background:var(--c-{colour[1:]},{colour})"></i>{html.escape(name)}')


def facts(run: LoggedRun, name: str) -> list[tuple[str, str]]:
    """What one wants to know of a run first."""
    log = run.log
    told = log.metadata.get
    machine = ", ".join(filter(None, (told("host"), told("system"), told("machine"))))
    found = [
        ("log", ", ".join(filter(None, (name, utc(run))))),
        ("length", f"{_length(run)} at {log.rate_hz:g} Hz"),
        ("bus", told("bus", "unknown")),
        ("law and gains", gains(run)),
        ("machine", "; ".join(filter(None, (machine, f"pneud {told('pneud', '?')}", _law(run))))),
        ("real time", _realtime(run)),
        ("configuration", log.config_name),
    ]
    scenario = told("scenario")
    return [*found, ("scenario", scenario)] if scenario else found


def _law(run: LoggedRun) -> str:
    law = run.log.metadata.get("law")
    return f"law {law}" if law else ""


def _realtime(run: LoggedRun) -> str:
    if run.simulated:
        return "simulated time"
    return run.log.setup.get("fifo", "unknown").removeprefix("yes: ")


def gains(run: LoggedRun) -> str:
    """The law and its gains as configured, in a line."""
    values = tunables(controller_of(run.config))
    law = LAWS[int(values[0])]
    named = zip(names_of(law)[1:], values[1:], strict=True)
    return f"{law}: " + ", ".join(f"{name.partition('.')[2] or name} {value:g}" for name, value in named)


def utc(run: LoggedRun) -> str:
    """When a run began."""
    if run.simulated:
        return "simulated time"
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(run.start_unix_s))


def _length(run: LoggedRun) -> str:
    first_s = float(run.series.t_s[0])
    return f"{run.last_s:.1f} s" if first_s == 0.0 else f"{first_s:.3f} to {run.last_s:.3f} s"


def unequal(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    """Where the configurations of logs differ, and what else does."""
    if len(runs) < 2:
        return ""
    found = differences(runs)
    if not found:
        return "<p>None: configuration, bus, machine and versions are the same.</p>"
    return compared(names, found, "differences between the logs")


# What happened


def summary(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    """The figures of the run's summary."""

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
        ("air [normal litres]", [f"{1e3 * sum(m.air_anr_m3 for m in run.motions):.2f}" for run in runs]),
        ("done in the run", [_done(run) for run in runs]),
        ("done in its life", [_done_ever(run) for run in runs]),
        ("wake-up lateness p50 / p99 / max [µs]", [_three(run, "lateness_ns") for run in runs]),
        ("sensor to command p50 / p99 / max [µs]", [_three(run, "latency_ns") for run in runs]),
    ]
    return compared(names, rows, "summary") if len(runs) > 1 else facts_list([(k, v) for k, (v,) in rows])


def _done(run: LoggedRun) -> str:
    """What wears, counted up to the last snapshot."""
    return "–" if run.mileage is None else mileage.in_words(fields_of(run.mileage))


def _done_ever(run: LoggedRun) -> str:
    """The same with all runs before, where that is kept."""
    before = done_before(run.log)
    if before is None or run.mileage is None:
        return "–"
    return f"{mileage.in_words(fields_of(total(before[0], run.mileage)))}; since {before[1][:10]}"


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


_MOTION_HEAD = (
    *("motion", "from [s]", "took [s]", "from [mm]", "to [mm]", "RMS [mm]", "max [mm]", "overshoot [mm]"),
    *(
        "settled after [s]",
        "in position after [s]",
        "peak [mm/s]",
        "air [NL]",
        "its energy [J]",
        "work [J]",
        "",
    ),
)


def motions(runs: Sequence[LoggedRun], names: Sequence[str], shifts: Sequence[float]) -> str:
    """A row for each move, hold, jog and track."""
    rows = [
        (name, *_motion(m, shift))
        for run, name, shift in zip(runs, names, shifts, strict=True)
        for m in run.motions
    ]
    if not rows:
        return "<p>None: the axis was not engaged.</p>"
    more, first = len(rows) - MOTIONS, 1 if len(runs) == 1 else 0
    return (
        table(
            ("log", *_MOTION_HEAD)[first:],
            (row[first:] for row in rows[:MOTIONS]),
            label="motions",
            words=2 - first,
            name="motions",
        )
        + (f"<p>and {more:,} more</p>" if more > 0 else "")
        + '<p class="hint">Settled: until the load stays within the tolerance, from the end of the reference;'
        " in position: until the axis says so, from the request. Air: what the valve lets through from the"
        " supply, by its opening and the measured pressures, as volume of the reference atmosphere (ANR, ISO"
        " 8778: 100 kPa, 20 °C); what that air could do at most, expanding to the atmosphere at its"
        " temperature; work of the piston while it drives.</p>"
    )


def _motion(m: Motion, shift_s: float) -> tuple[str, ...]:
    def figure(value: float, form: str, factor: float = 1.0) -> str:
        return "–" if math.isnan(value) else format(factor * value, form)

    begin, end = m.begin_s - shift_s, max(m.end_s, 0.0 if math.isnan(m.settled_s) else m.settled_s) - shift_s
    room = 0.05 * (end - begin) + 0.02
    look = Drawn(
        f'<button data-from="{begin - room:.4f}" data-to="{end + room:.4f}"'
        f' aria-label="zoom to {html.escape(m.kind)} at {begin:.3f} s">zoom</button>'
    )
    kind = m.kind if math.isnan(m.to_n) else f"force {m.to_n:g} N: {m.at_n:.1f} N"
    return (
        kind,
        figure(begin, ".3f"),
        figure(m.duration_s, ".3f"),
        figure(m.from_m, ".3f", 1e3),
        figure(m.to_m, ".3f", 1e3),
        figure(m.rms_error_m, ".4f", 1e3),
        figure(m.max_error_m, ".4f", 1e3),
        figure(m.overshoot_m, ".4f", 1e3),
        figure(m.settling_s, ".3f"),
        figure(m.in_position_s, ".3f"),
        figure(m.peak_speed_m_s, ".1f", 1e3),
        figure(m.air_anr_m3, ".3f", 1e3),
        figure(m.air_energy_j, ".1f"),
        figure(m.work_j, ".2f"),
        look,
    )


def faults(run: LoggedRun, number: int, shift_s: float) -> str:
    """The faults that were latched: moments, the stop, what to do; a place for the pictures of each."""
    if not run.faults:
        return ""
    parts = [f"<p>{html.escape(line)}</p>" for line in injected(run, shift_s)]
    for place, fault in enumerate(run.faults):
        name = run.fault_name(fault.bit)
        known = _FAULTS.get(name)
        what = f"{known.when}; {known.reaction.value}. Cure: {known.cure}." if known is not None else ""
        parts.append(f"<h3>{html.escape(name)}<small> – {html.escape(what)}</small></h3>")
        parts.append(f"<p>{html.escape(_moments(fault, shift_s))}</p>")
        if fault.stop is not None and place < CLOSEUPS:
            parts.append(f'<div class="closeup" data-run="{number}" data-fault="{place}"></div>')
    return "".join(parts)


def injections(run: LoggedRun) -> list[tuple[float, str]]:
    """When a scenario did something, by the events."""
    return [
        (1e-9 * event.log_time_ns - run.start_unix_s, event.message)
        for event in run.events
        if event.name == "scenario"
    ]


def injected(run: LoggedRun, shift_s: float) -> list[str]:
    """What a scenario did, by the events; by its name alone where they do not tell."""
    found = [f"Injected at {t_s - shift_s:.3f} s: {words}" for t_s, words in injections(run)]
    scenario = run.log.metadata.get("scenario")
    return found or ([f"Injected by the scenario {scenario}"] if scenario else [])


def _moments(fault: Seen, shift_s: float) -> str:
    words = []
    if not math.isnan(fault.seen_s):
        words.append(f"seen at {fault.seen_s - shift_s:.3f} s")
    words.append(f"latched at {fault.latched_s - shift_s:.3f} s")
    if not math.isnan(fault.cleared_s):
        words.append(f"cleared at {fault.cleared_s - shift_s:.3f} s")
    stop = fault.stop
    if stop is None:
        words.append("the axis was already stopping, or not engaged")
    elif math.isnan(stop.time_s):
        words.append(
            f"at {1e3 * stop.speed_m_s:.0f} mm/s; it had not come to rest 3 s later, or at the end of the log"
        )
    else:
        words.append(
            f"at {1e3 * stop.speed_m_s:.0f} mm/s; stood {stop.time_s:.3f} s and {1e3 * stop.distance_m:.2f}"
            f" mm later, {1e3 * stop.farthest_m:.2f} mm off at most"
        )
    return ", ".join(words) + "."


# Timing, bus, machine


def timing(runs: Sequence[LoggedRun], names: Sequence[str], reference: Reference | None) -> str:
    """Histograms and percentiles."""
    timed = [(name, run) for name, run in zip(names, runs, strict=True) if not run.simulated]
    late: dict[str, list[Any]] = {name: run.timing["lateness_ns"].buckets() for name, run in timed}
    colours = dict(zip(names, colours_of(len(names)), strict=True))
    words = ""
    if reference is not None:
        machine = reference["machine"]
        for name, buckets in reference["wakeup_histograms_ns"].items():
            late[f"{name} (bench)"] = [tuple(bucket) for bucket in buckets]
            colours[f"{name} (bench)"] = _REFERENCE_COLOURS.get(name, "#56b4e9")
        words = (
            f"<p>Benchmark beside it: {html.escape(str(machine['cpu_model']))},"
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
    return "".join(parts) + each(names, [_percentile_table(run) for run in runs])


def _percentile_table(run: LoggedRun) -> str:
    spreads = {_TIMING_WORDS[field]: run.timing[field] for field in Timing._fields}
    spreads["jitter of SYNC on the bus"] = run.health.sync_jitter
    for source in run.health.sources:
        label = source.name.replace("_", " ")
        spreads[f"{label}: SYNC sent to answer received"] = source.answer
        spreads[f"{label}: age when the command is sent"] = source.age
    head = ("µs", "count", "p50", "p99", "p99.9", "max")
    return table(head, ((words, *_percentiles(spread)) for words, spread in spreads.items()), label="timing")


def _percentiles(spread: Spread) -> tuple[str, ...]:
    if not spread.count:
        return ("0", "–", "–", "–", "–")
    return (f"{spread.count:,}", *(f"{spread.percentile_ns(q) / 1e3:.1f}" for q in (50, 99, 99.9, 100)))


def bus(run: LoggedRun) -> str:
    """Frames by identifier, and readings that were missed."""
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
    notes += [
        f"emergency 0x{code:04X} of node {node} ({emergency_words(code)})"
        for node, code in sorted(health.emcy.items())
    ]
    head = ("id", "frame", "way", "count", "per second", "lost", "corrupt", "frozen", "late")
    return f"{table(head, rows, words=3, label='frames')}<p>{', '.join(notes)}.</p>{_readings(run)}"


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
    return table(head, rows, label="readings")


def learnt(run: LoggedRun) -> str:
    """What adaptation has learnt, if any was on, behind what had been identified before."""
    start = run.config.control.adaptation.start.log
    begun = _identified(run.log.config_text)
    begun += f"<p>Begun with what was learnt in {html.escape(start)}.</p>" if start else ""
    if not run.learning.last:
        return f"{begun}<p>Nothing: adaptation was off, or no snapshot of the axis tells.</p>"
    t_s = run.learning.t_s
    head = ("", "configured", "learnt", "meanwhile", "check", f"{t_s[0]:.0f} … {t_s[-1]:.0f} s")
    rows = ((*words, Drawn(picture)) for *words, picture in run.learning.rows())
    return f"{begun}{table(head, rows, last=2, label='learnt')}"


def _identified(text: str) -> str:
    """The values that the configuration has from logs."""
    found = noted(text)
    if not found:
        return ""
    rows = table(("", "value", "interval of 95 %, by which log, when"), found, words=3, label="identified")
    what = "1 value" if len(found) == 1 else f"{len(found)} values"
    return f"<details><summary>{what} identified from logs</summary>{rows}</details>"


def events(run: LoggedRun) -> str:
    """What happened in words."""
    rows = []
    for event in run.events:
        try:
            level = Level(event.level).name.lower()
        except ValueError:
            level = str(event.level)
        t_s = 1e-9 * event.log_time_ns - run.start_unix_s
        rows.append((f"{t_s:.3f}", level, event.name, event.message))
    more = f"<p>and {run.more_events:,} more</p>" if run.more_events else ""
    head, levels = ("s", "level", "from", "what"), [level for _, level, *_ in rows]
    return table(head, rows, words=0, last=3, classes=levels, label="events") + more


def machine(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    """What the logs say of host, versions and set-up."""
    keys: dict[str, None] = {}
    for run in runs:
        keys |= dict.fromkeys(k for k in run.log.metadata if k != "faults")
    rows = [(key, *(run.log.metadata.get(key, "–") for run in runs)) for key in keys]
    setup: dict[str, None] = {}
    for run in runs:
        setup |= dict.fromkeys(run.log.setup)
    rows += [(key, *(run.log.setup.get(key, "–") for run in runs)) for key in setup]
    if len(runs) > _SIDE_BY_SIDE:
        return compared(names, [(key, cells) for key, *cells in rows if key not in OF_EACH_RUN], "machine")
    return table(("", *names), rows, last=len(runs), label="machine")


def configurations(runs: Sequence[LoggedRun], names: Sequence[str]) -> str:
    """The files as they stand in the logs; those that are the same but once."""
    whose: dict[tuple[str, str], list[str]] = {}
    for run, name in zip(runs, names, strict=True):
        whose.setdefault((run.log.config_name, run.log.config_text), []).append(name)
    return "".join(
        f"<details><summary>{html.escape(file)} of {html.escape(', '.join(those))}</summary>"
        f"<pre tabindex=0>{html.escape(text)}</pre></details>"
        for (file, text), those in whose.items()
    )
