"""The histograms of lateness as one page of HTML that needs nothing else: SVG, both axes logarithmic."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

_COLOURS = {
    "pneud": "#0072b2",
    "cyclictest": "#000000",
    "empty": "#56b4e9",
    "notifier": "#d55e00",
    "c": "#009e73",
}
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 900, 460, 70, 20, 20, 50
_PER_DECADE = 24  # columns; finer ones would show the timers' rasters


def page(report: Mapping[str, Any], text: str) -> str:
    """The page."""
    histograms = report["wakeup_histograms_ns"]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>pneud bench</title>\n'
        "<style>body{font:15px sans-serif;max-width:920px;margin:2em auto;padding:0 1em}"
        "pre{overflow-x:auto;font-size:13px}text{font:13px sans-serif}</style></head><body>\n"
        "<h1>Wake-up lateness</h1>\n"
        f"{svg(histograms)}\n<pre>{html.escape(text)}</pre>\n</body></html>\n"
    )


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
