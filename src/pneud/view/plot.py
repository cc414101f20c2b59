"""Curves as dots of braille, two by four in a cell, or as letters where there are none; bars; scales."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rich.style import Style

from pneud.view.history import Column
from pneud.view.text import DIM

_BRAILLE = 0x2800
_LEFT, _RIGHT = (0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80)  # dots of a cell, from top to bottom
# dots a … b of one column of a cell: _SPANS[side][a][b]
_SPANS = tuple(
    tuple(tuple(sum(side[a : b + 1]) for b in range(4)) for a in range(4)) for side in (_LEFT, _RIGHT)
)
_SIGNS = "'-_"  # of a curve in a cell of letters, from top to bottom
_STEPS = (1.0, 2.0, 5.0, 10.0)
_EIGHTHS = " ▏▎▍▌▋▊▉"

Cells = list[tuple[str, Style]]
"""A row of a picture: pieces of text, each in one style."""


class Curve(NamedTuple):
    """One line of a plot."""

    columns: list[Column]  # of extremes, oldest first; `samples(width)` of them
    style: Style
    letter: str = ""  # where there are no dots; none for signs that tell its height in a cell


class Guide(NamedTuple):
    """A line across, where no curve is."""

    value: float
    sign: str
    style: Style = DIM


def samples(width: int, ascii_only: bool) -> int:
    """How many columns of values a plot of `width` cells shows."""
    return width if ascii_only else 2 * width


def plot(
    curves: Sequence[Curve],
    limits: tuple[float, float],
    size: tuple[int, int],
    guides: Iterable[Guide] = (),
    ascii_only: bool = False,
) -> list[Cells]:
    """Rows of a plot, top first; what lies beyond the limits is drawn at them.

    Args:
        curves: the last one in front.
        limits: the values at the lower and the upper edge.
        size: width and height in cells.
        guides: the first one in front.
        ascii_only: one letter a cell.
    """
    width, height = size
    each = len(_SIGNS) if ascii_only else 4
    last = height * each - 1
    low, high = limits
    scale = last / (high - low) if high > low else 0.0
    bits = [[0] * width for _ in range(height)]
    owner: list[list[Curve | None]] = [[None] * width for _ in range(height)]
    for curve in curves:
        before: tuple[int, int] | None = None
        for at, column in enumerate(curve.columns):
            if column is None:
                before = None
                continue
            # comparisons rather than calls: they would take most of a picture's time
            top, bottom = int((high - column[1]) * scale + 0.5), int((high - column[0]) * scale + 0.5)
            top = 0 if top < 0 else last if top > last else top
            bottom = 0 if bottom < 0 else last if bottom > last else bottom
            if ascii_only:  # of the two the one that is farther from the middle
                row = top if last - bottom >= top else bottom
                owner[row // each][at] = curve
                bits[row // each][at] = row % each
                continue
            now = top, bottom
            if before is not None:  # a steep line has no holes
                if before[1] + 1 < top:
                    top = before[1] + 1
                elif before[0] - 1 > bottom:
                    bottom = before[0] - 1
            before = now
            cell, spans = at >> 1, _SPANS[at & 1]
            row, end = top >> 2, bottom >> 2
            while row < end:
                owner[row][cell] = curve
                bits[row][cell] |= spans[top & 3][3]
                row, top = row + 1, 0
            owner[row][cell] = curve
            bits[row][cell] |= spans[top & 3][bottom & 3]
    lines: dict[int, Guide] = {}
    for guide in guides:
        if low <= guide.value <= high:
            lines.setdefault(int((high - guide.value) * scale + 0.5) // each, guide)
    return [
        _cells(row_bits, row_owner, lines.get(row), ascii_only)
        for row, (row_bits, row_owner) in enumerate(zip(bits, owner, strict=True))
    ]


def _cells(
    row_bits: list[int], row_owner: list[Curve | None], guide: Guide | None, ascii_only: bool
) -> Cells:
    """One row; neighbours of one style in one piece."""
    empty, empty_style = (" ", DIM) if guide is None else (guide.sign, guide.style)
    found: Cells = []
    text, style = "", empty_style
    for dots, curve in zip(row_bits, row_owner, strict=True):
        if curve is None:
            sign, own = empty, empty_style
        else:
            sign = curve.letter or _SIGNS[dots] if ascii_only else chr(_BRAILLE + dots)
            own = curve.style
        if own is not style and text:
            found.append((text, style))
            text = ""
        text, style = text + sign, own
    return [*found, (text, style)]


def row_at(value: float, limits: tuple[float, float], height: int) -> int:
    """The row of a plot, from its top, in which a value lies."""
    low, high = limits
    fraction = (high - value) / (high - low) if high > low and math.isfinite(value) else 0.0
    return min(height - 1, max(0, int(max(-1.0, min(2.0, fraction)) * height)))


def extremes(curves: Iterable[Curve]) -> tuple[float, float] | None:
    """The smallest and the largest value of all; None where there is none."""
    known = [column for curve in curves for column in curve.columns if column is not None]
    return (min(c[0] for c in known), max(c[1] for c in known)) if known else None


def rounded(value: float) -> float:
    """The next of 1, 2, 5, 10 … that is no less."""
    if not 0.0 < value < 1e30:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(value))
    return next((step * decade for step in _STEPS if value <= step * decade * (1.0 + 1e-9)), 10.0 * decade)


def signed_limits(found: tuple[float, float] | None, least: float) -> tuple[float, float]:
    """A round scale with zero in the middle, no finer than `least`: noise does not look like motion."""
    peak = max(least, -found[0], found[1]) if found else least
    return -rounded(peak), rounded(peak)


def range_limits(found: tuple[float, float] | None, least: float) -> tuple[float, float]:
    """A round scale around all values, no finer than `least`."""
    if found is None:
        return 0.0, least
    low, high = found
    step = rounded(max(high - low, least) / 8.0)
    low, high = step * math.floor(low / step), step * math.ceil(high / step)
    return low, max(high, low + least)


def bar(fraction: float, worst: float, n: int, ascii_only: bool) -> str:
    """A bar of n cells that is filled to a fraction, with a mark at the worst one lately."""
    fraction = max(0.0, min(1.0, fraction)) if math.isfinite(fraction) else 0.0
    eighths = round(fraction * 8 * n)
    if ascii_only:
        eighths = eighths // 8 * 8
    cells = ["█"] * (eighths // 8) + ([_EIGHTHS[eighths % 8]] if eighths % 8 else [])
    cells += ["·"] * (n - len(cells))
    if math.isfinite(worst):
        at = min(n - 1, int(max(0.0, min(1.0, worst)) * n))
        if at >= eighths / 8:
            cells[at] = "│"
    return "".join(cells[:n])
