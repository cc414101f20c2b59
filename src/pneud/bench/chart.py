"""A benchmark as a page: the histograms of lateness as SVG, both axes logarithmic, and the figures."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

from pneud.bench.tables import OURS
from pneud.report.frame import BAD, GOOD, LOOK, Section, Verdict, document, strip, table

_COLOURS = {
    "pneud": "#0072b2",
    "cyclictest": "#000000",
    "empty": "#56b4e9",
    "notifier": "#d55e00",
    "c": "#009e73",
}
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 900, 460, 70, 20, 20, 50
_QUANTITIES = {"wakeup_us": "wake-up", "latency_us": "sensor to command", "own_us": "own work"}
_LATE = 0.2  # part of a period
_PER_DECADE = 24  # columns; finer ones would show the timers' rasters


def page(report: Mapping[str, Any], text: str) -> str:
    """The page."""
    machine, setting = report["machine"], report["setting"]
    told = [
        ("machine", f"{machine['cpu_model']}, {len(machine['cpus'])} CPUs"),
        ("kernel", str(machine["kernel"])),
        ("loop", f"{setting['rate_hz']:g} Hz, {setting['scheduling']}"),
        ("bus", str(setting["bus"])),
        ("turns", f"{setting['pairs']} of {setting['turn_s']:g} s for each"),
    ]
    words = f'<pre tabindex="0">{html.escape(text)}</pre>'
    return document(
        "pneud bench",
        "How punctual the loop is here",
        [
            Section("Wake-up lateness", svg(report["wakeup_histograms_ns"])),
            Section("Figures", _figures(report["contestants"]) + words),
        ],
        lead=strip(verdict(report), told),
    )


def verdict(report: Mapping[str, Any]) -> Verdict:
    """What the benchmark comes to."""
    ours = report["contestants"].get(OURS)
    if ours is None:
        return Verdict(BAD, (f"pneud could not be measured: {report['missing'].get(OURS, 'no turn of it')}",))
    found = Verdict()
    if ours["wakeup_us"] is not None:
        late = ours["wakeup_us"]
        level = LOOK if late["p99"] > _LATE * 1e6 / report["setting"]["rate_hz"] else GOOD
        found = found.and_then(level, f"wake-up {late['p99']:.0f} µs late at p99, {late['max']:.0f} at most")
    for name, ratios in report["pneud_over"].items():
        if "wakeup" in ratios:
            found = found.and_then(
                GOOD, f"{ratios['wakeup']['p99']['median']:.2f} of {name}'s p99 at waking up"
            )
    if ours["skipped"]:
        found = found.and_then(LOOK, f"{ours['skipped']} of {ours['ticks']} ticks were skipped")
    if report["setting"]["scheduling"].startswith("no "):
        found = found.and_then(LOOK, report["setting"]["scheduling"])
    return found


def _figures(contestants: Mapping[str, Any]) -> str:
    """Percentiles of each contestant."""
    head = ["µs", *(f"{words} {q}" for words in _QUANTITIES.values() for q in ("p50", "p99", "max"))]
    rows = []
    for name, one in contestants.items():
        figures = [one[key] or {} for key in _QUANTITIES]
        cells = [found.get(q) for found in figures for q in ("p50", "p99", "max")]
        rows.append([name, *("–" if cell is None else f"{cell:.0f}" for cell in cells)])
    return table(head, rows, label="figures of each contestant")


def columns(buckets: Sequence[Sequence[int]]) -> dict[int, float]:
    """Shares of all values by column, a column being `_PER_DECADE`-th of a decade of microseconds."""
    total = sum(count for _, _, count in buckets)
    found: dict[int, float] = {}
    for low, high, count in buckets:
        us = max(0.1, (low + high) / 2e3)
        column = math.floor(_PER_DECADE * math.log10(us))
        found[column] = found.get(column, 0.0) + count / total
    return found


def svg(
    histograms: Mapping[str, Sequence[Sequence[int]]],
    across: str = "µs after the ideal grid",
    colours: Mapping[str, str] = _COLOURS,
) -> str:
    """The picture: durations [µs] across, share of all of them in a column up.

    Args:
        histograms: buckets (least, greatest [ns], count) by name.
        across: what the durations are.
        colours: by name.
    """
    shares = {name: columns(buckets) for name, buckets in histograms.items() if buckets}
    if not shares:
        return "<p>nothing was measured</p>"
    first = math.floor(min(min(s) for s in shares.values()) / _PER_DECADE)
    last = math.ceil((max(max(s) for s in shares.values()) + 1) / _PER_DECADE)
    lowest = math.floor(math.log10(min(min(s.values()) for s in shares.values())))
    bottom = _HEIGHT - _BOTTOM

    def x(column: float) -> float:
        return _LEFT + (column / _PER_DECADE - first) / (last - first) * (_WIDTH - _LEFT - _RIGHT)

    def y(share: float) -> float:
        return _TOP + (bottom - _TOP) * math.log10(share) / lowest if lowest else _TOP

    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="histograms, {across}">']
    for decade in range(first, last + 1):
        at = x(decade * _PER_DECADE)
        parts.append(f'<path d="M{at:.1f} {_TOP}V{bottom}" stroke="#ddd"/>')
        parts.append(f'<text x="{at:.1f}" y="{bottom + 18}" text-anchor="middle">{10.0**decade:g}</text>')
    for power in range(lowest, 1):
        at = y(10.0**power)
        parts.append(f'<path d="M{_LEFT} {at:.1f}H{_WIDTH - _RIGHT}" stroke="#ddd"/>')
        parts.append(
            f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{100 * 10.0**power:g} %</text>'
        )
    for row, (name, found) in enumerate(shares.items()):
        colour = colours.get(name, "#cc79a7")
        parts.append(
            f'<path d="{_steps(found, x, y, bottom)}" fill="none" stroke="{colour}" stroke-width="1.8"/>'
        )
        at = _TOP + 16 + 18 * row
        parts.append(
            f'<text x="{_WIDTH - _RIGHT - 8}" y="{at}" text-anchor="end" fill="{colour}">'
            f"{html.escape(name)}</text>"
        )
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">{across}</text>')
    return "\n".join([*parts, "</svg>"])


def _steps(found: Mapping[int, float], x: Any, y: Any, bottom: float) -> str:
    """One histogram as a line; it comes down to the bottom where there is nothing."""
    path = ""
    before = None
    for column in sorted(found):
        if column - 1 != before:
            if before is not None:
                path += f"V{bottom}"
            path += f"M{x(column):.1f} {bottom}"
        path += f"V{y(found[column]):.1f}H{x(column + 1):.1f}"
        before = column
    return path + f"V{bottom}"
