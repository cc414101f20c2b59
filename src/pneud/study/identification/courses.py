"""How a rig has worn, as pictures: parameters over the dates, with intervals and what they may differ by."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from datetime import datetime

from pneud.report.frame import Section
from pneud.study.identification.comparing import tolerance
from pneud.study.identification.wear import WEARS, Entry, Point, course

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 420, 190, 62, 14, 12, 28
SPARE = 0.08  # of the height, above and below
FEWEST = 2  # dates


def section(entries: Sequence[Entry]) -> Section:
    """Those of friction, leakage, edges and flow that have been told at several dates."""
    courses = ((name, course(entries, name)) for name in WEARS)
    drawn = "".join(_figure(name, points) for name, points in courses if len(points) >= FEWEST)
    if not drawn:
        return Section("Wear", "")
    said = "points with their intervals of 95 %; the band is what a value may differ by from the first one"
    return Section("Wear", f'<p class="hint">{said}</p><div class="planes">{drawn}</div>')


def _figure(name: str, points: Sequence[Point]) -> str:
    first = points[0].estimate.value
    may = tolerance(name, first)
    days = [datetime.fromisoformat(p.date).timestamp() for p in points]
    ends = [y for p in points for y in (p.estimate.low, p.estimate.high)]
    low, high = min(*ends, first - may), max(*ends, first + may)
    low, high = low - SPARE * (high - low), high + SPARE * (high - low)

    def x(day: float) -> float:
        return LEFT + (day - days[0]) / ((days[-1] - days[0]) or 1.0) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return HEIGHT - BOTTOM - (value - low) / ((high - low) or 1.0) * (HEIGHT - TOP - BOTTOM)

    wide, tall = WIDTH - LEFT - RIGHT, y(first - may) - y(first + may)
    parts = [f'<rect x="{LEFT}" y="{y(first + may):.1f}" width="{wide}" height="{tall:.1f}" fill="#8883"/>']
    parts.append(f'<path d="M{LEFT} {y(first):.1f}h{wide}" stroke="#999" stroke-dasharray="4 4"/>')
    for level in _levels(low, high):
        parts.append(f'<text x="{LEFT - 6}" y="{y(level) + 4:.1f}" text-anchor="end">{level:.4g}</text>')
    for i, anchor in ((0, "start"), (-1, "end")):
        at = f'x="{x(days[i]):.1f}" y="{HEIGHT - 8}" text-anchor="{anchor}"'
        parts.append(f"<text {at}>{points[i].date[:10]}</text>")
    for day, point in zip(days, points, strict=True):
        e = point.estimate
        off = abs(e.value - first) > may
        colour = "#d55e00" if off else "#0072b2"
        bar = f"M{x(day):.1f} {y(e.low):.1f}V{y(e.high):.1f}"
        parts.append(f'<path d="{bar}" stroke="{colour}" stroke-width="1.5"/>')
        parts.append(f'<circle cx="{x(day):.1f}" cy="{y(e.value):.1f}" r="3.5" fill="{colour}"/>')
    last = points[-1].estimate.value
    said = f"{name}: {first:.4g} at first, {last:.4g} now"
    return (
        f'<figure><figcaption>{html.escape(said)}</figcaption><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img"'
        f' aria-label="{html.escape(said)}">{"".join(parts)}</svg></figure>'
    )


def _levels(low: float, high: float) -> list[float]:
    """Some round values between."""
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-12)))
    step *= next(part for part in (0.2, 0.25, 0.5, 1.0, 2.0) if (high - low) / (step * part) <= 5.0)
    return [step * n for n in range(math.ceil(low / step), math.floor(high / step) + 1)]
