"""An identification as one page of HTML that needs nothing else: parameters, friction map, flow map."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pneud.config.models import Config
from pneud.report.frame import Section, document, table
from pneud.study.identification.comparing import OFF, Row
from pneud.study.identification.estimating import Identified
from pneud.study.identification.explaining import Bin, flow_map, friction_map
from pneud.study.identification.words import HEAD, cells

WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 640, 320, 70, 45, 15, 30
TICKS = 4  # of a scale, about
EDGE_SPANS = tuple((0.05 * i, 0.05 * (i + 1)) for i in range(-16, 16))  # of the spool [V]


class Picture(NamedTuple):
    """A map with what is across and what is up."""

    title: str
    across: str
    up: str
    bins: Sequence[Bin]


class Table(NamedTuple):
    """Rows of text under a heading; True beside those that stand out."""

    title: str
    head: Sequence[str]
    rows: Sequence[tuple[Sequence[str], bool]]


def page(
    title: str,
    lines: Iterable[str],
    tables: Iterable[Table],
    pictures: Iterable[Picture],
    more: Iterable[Section] = (),
) -> str:
    """The page.

    Args:
        title: what was identified.
        lines: verdict and notes.
        tables: of the parameters, and others.
        pictures: maps.
        more: before them.
    """
    said = "".join(f"<p>{html.escape(line)}</p>" for line in lines)
    sections = [Section(one.title or "Parameters", _cells(one)) for one in tables]
    sections += [*more, *(Section(one.title, _figure(one)) for one in pictures)]
    return document(title, title, sections, lead=said)


def parameters(rows: Iterable[Row], title: str = "") -> Table:
    """The parameters as a table."""
    told = [(cells(row), row.verdict == OFF or row.worn) for row in rows]
    return Table(title, (*HEAD, "before"), told)


def maps(found: Identified, c: Config) -> list[Picture]:
    """Friction, the valve's flow, and its edges, as far as they have been fitted."""
    drawn = []
    if found.moved is not None:
        drawn.append(Picture("Friction", "speed [m/s]", "friction [N]", friction_map(found.moved)))
    if found.valved is not None:
        for name, spans in (("Flow", ()), ("Edges", EDGE_SPANS)):
            bins = flow_map(found.valved, c, spans)
            drawn.append(Picture(name, "spool [V]", "opening, relative", bins))
    return drawn


def _cells(one: Table) -> str:
    kinds = ["off" if stands_out else "" for _, stands_out in one.rows]
    return table(one.head, [cells for cells, _ in one.rows], classes=kinds, label=one.title or "Parameters")


def _figure(picture: Picture) -> str:
    title, across, up, bins = picture
    if len(bins) < 2:
        return "<p>The logs have too little for this picture.</p>"
    xs = [b.at for b in bins]
    ys = [y for b in bins for y in (b.measured, b.model)]
    x0, x1, y0, y1 = min(xs), max(xs), min(*ys, 0.0), max(*ys, 0.0)

    def x(value: float) -> float:
        return LEFT + (value - x0) / (x1 - x0 or 1.0) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return HEIGHT - BOTTOM - (value - y0) / (y1 - y0 or 1.0) * (HEIGHT - TOP - BOTTOM)

    parts = [f'<path d="M{LEFT} {y(0.0):.1f}H{WIDTH - RIGHT}" stroke="#999"/>']
    for i in range(TICKS + 1):
        at, level = x0 + (x1 - x0) * i / TICKS, y0 + (y1 - y0) * i / TICKS
        parts.append(f'<text x="{x(at):.1f}" y="{HEIGHT - 22}" text-anchor="middle">{at:.3g}</text>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(level) + 4:.1f}" text-anchor="end">{level:.3g}</text>')
    line = " ".join(f"{x(b.at):.1f},{y(b.model):.1f}" for b in bins)
    parts.append(f'<polyline points="{line}" fill="none" stroke="#0072b2" stroke-width="1.6"/>')
    parts += [f'<circle cx="{x(b.at):.1f}" cy="{y(b.measured):.1f}" r="3.5" fill="#d55e00"/>' for b in bins]
    name = html.escape(title)
    return (
        f'<figure><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{name}">'
        + "".join(parts)
        + f"</svg><figcaption>{html.escape(up)} over {html.escape(across)}: points as measured, the line as"
        " the model has it</figcaption></figure>"
    )
