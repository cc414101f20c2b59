"""The report: one page that holds everything it needs and opens by double-click."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pneud.report import sections
from pneud.report.closeup import TIME_S, Closeup, step_of
from pneud.report.colours import STATE_COLOURS, colours_of
from pneud.report.figures import FIGURES, line, offsets_s
from pneud.report.frame import Section, asset, document
from pneud.report.gather import COLUMNS, LoggedRun
from pneud.report.planes import Plane, together
from pneud.report.sections import Reference
from pneud.report.spans import Span
from pneud.report.stops import Seen
from pneud.report.verdict import judge
from pneud.signals import state_name

_SPANS_SHOWN = 4000
_HINT = (
    '<p class="hint">Drag across a plot to zoom all of them, double-click to see everything; the cursor is'
    " shared. Click a name in a legend to hide its line. Shaded: from the end of a move's reference until the"
    ' load has settled. <span id="resolution"></span></p>'
)


def page(runs: Sequence[LoggedRun], reference: Reference | None = None) -> str:
    """The page.

    Args:
        runs: one, or several to compare; those of equal name are told apart by number.
        reference: a benchmark of the machine, to put the timing beside.
    """
    names, shifts = _names(runs), offsets_s(runs)
    found = json.dumps(_data(runs, names, shifts), separators=(",", ":"), allow_nan=False)
    shifted = list(zip(runs, shifts, strict=True))

    def each(content: Callable[[LoggedRun], str]) -> str:
        return sections.each(names, [content(run) for run in runs])

    parts = [
        Section("Differences", sections.unequal(runs, names)),
        Section("Motions", sections.motions(runs, names, shifts)),
        Section(
            "Faults",
            sections.each(names, [sections.faults(run, i, shift) for i, (run, shift) in enumerate(shifted)]),
        ),
        Section(
            "Run",
            f'{_HINT}{sections.keys(names)}<div id="timeline" class="plot"></div><div id="plots"></div>'
            '<div id="phase" class="plot"></div>',
        ),
        Section("Maps", '<div id="planes" class="planes"></div>'),
        Section("Summary", sections.summary(runs, names)),
        Section("Timing", sections.timing(runs, names, reference)),
        Section("Bus", each(sections.bus)),
        Section("Learnt", each(sections.learnt)),
        Section("Events", each(sections.events)),
        Section("Machine", sections.machine(runs, names)),
        Section("Configuration", sections.configurations(runs, names)),
    ]
    verdicts = [judge(run, shift) for run, shift in shifted]
    return document(
        f"pneud report: {', '.join(names)}",
        runs[0].config.name if len(runs) == 1 else f"{runs[0].config.name}: {len(runs)} logs",
        parts,
        lead=sections.lead(runs, names, verdicts)
        + ("<p>Times begin where each log was first engaged.</p>" if any(shifts) else ""),
        styles=(asset("uPlot.min.css"),),
        ends=(
            f"<!-- uPlot, © Leon Sorokin\n{asset('uPlot.LICENSE').replace('--', '- -')}-->",
            '<script type="application/json" id="data">' + found.replace("</", "<\\/") + "</script>",
            f"<script>{asset('uPlot.iife.min.js')}</script>",
            f"<script>{asset('report.js')}</script>",
        ),
    )


def _names(runs: Sequence[LoggedRun]) -> list[str]:
    """Names of the files, told apart by number where they are equal, without what all begin with."""
    plain = [run.name.removesuffix(".mcap") for run in runs]
    if len(set(plain)) > 4:
        common = next((i for i, letters in enumerate(zip(*plain, strict=False)) if len(set(letters)) > 1), 0)
        common = max((plain[0].rfind(mark, 0, common) + 1 for mark in "-_. "), default=0)
        plain = [name[common:] or name for name in plain]
    return [
        f"{name} ({plain[: i + 1].count(name)})" if plain.count(name) > 1 else name
        for i, name in enumerate(plain)
    ]


# What the script draws


def _data(runs: Sequence[LoggedRun], names: Sequence[str], shifts: Sequence[float]) -> dict[str, Any]:
    colours = colours_of(len(runs))
    return {
        "figures": [{**f._asdict(), "series": [s._asdict() for s in f.series]} for f in FIGURES],
        "planes": [_plane(*found, names, colours) for found in together([run.planes for run in runs])],
        "aligned": any(shifts),
        "columns": list(COLUMNS),
        "steps": [TIME_S, *map(step_of, COLUMNS)],
        "runs": [
            _run(run, name, shift, colour)
            for run, name, shift, colour in zip(runs, names, shifts, colours, strict=True)
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
        "start": sections.utc(run),
        "period": 1.0 / run.log.rate_hz,
        "t": _packed(run.series.t_s - shift_s, "<f8"),
        "columns": columns,
        "closeup": [] if len(run.series.t_s) >= run.ticks else _closeup(run.closeup, shift_s),
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
        "stops": [_stop(run, fault, shift_s) for fault in run.faults],
        "settled": [
            [round(m.end_s - shift_s, 6), round(m.settled_s - shift_s, 6)]
            for m in run.motions[:_SPANS_SHOWN]
            if not math.isnan(m.settled_s)
        ],
        "saturated": [_seconds(s, shift_s) for s in run.saturated],
        "gaps": [[*_seconds(s, shift_s), s.value] for s in run.gaps],
        "marks": [[round(m.t_s - shift_s, 6), m.text] for m in run.marks],
    }


def _closeup(closeup: Closeup, shift_s: float) -> list[list[Any]]:
    return [
        [s.begin_s - shift_s, s.end_s - shift_s, s.ticks, base64.b64encode(s.data).decode("ascii")]
        for s in sorted(closeup.stretches)
    ]


def _stop(run: LoggedRun, fault: Seen, shift_s: float) -> list[list[Any]]:
    """Moments of a fault, with their words."""
    moments = [(t_s, "injected") for t_s, _ in sections.injections(run) if t_s <= fault.latched_s][-1:]
    if fault.seen_s < fault.latched_s:
        moments.append((fault.seen_s, "seen"))
    moments.append((fault.latched_s, "latched" if fault.seen_s != fault.latched_s else "seen, latched"))
    if fault.stop is not None and not math.isnan(fault.stop.time_s):
        moments.append((fault.latched_s + fault.stop.time_s, "stood"))
    return [[round(t_s - shift_s, 6), word] for t_s, word in moments]


def _plane(
    plane: Plane, each: Sequence[Plane | None], names: Sequence[str], colours: Sequence[str]
) -> dict[str, Any]:
    traces = [(t, t.label, t.colour) for t in plane.traces]
    if len(names) > 1:
        traces = [
            (p.traces[0], name, colour)
            for p, name, colour in zip(each, names, colours, strict=True)
            if p is not None
        ]
    return {
        **plane._asdict(),
        "note": plane.note if len(names) == 1 else "",
        "traces": [
            {
                "label": label,
                "colour": colour,
                "kind": "line" if t.kind == "bars" and len(names) > 1 else t.kind,
                "x": _packed(t.x, "<f4"),
                "y": _packed(t.y, "<f4"),
            }
            for t, label, colour in traces
        ],
    }


def _seconds(span: Span, shift_s: float) -> list[float]:
    return [round(span.begin_s - shift_s, 6), round(span.end_s - shift_s, 6)]


def _packed(values: Any, kind: str) -> str:
    with np.errstate(over="ignore"):  # what floats cannot hold becomes infinite
        return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def _state_colour(value: int) -> str:
    return {int(state): colour for state, colour in STATE_COLOURS.items()}.get(value - 1, "#000000")


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
