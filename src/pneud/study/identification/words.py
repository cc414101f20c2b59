"""An identification as lines of text."""

from __future__ import annotations

from collections.abc import Iterable

from pneud.study.identification.comparing import OFF, UNTOLD, Row
from pneud.study.identification.parameters import Estimate

HEAD = ("", "estimate", "95 % interval", "configured", "")


def cells(row: Row) -> tuple[str, ...]:
    """A row of the table: key, value, interval, configured value, verdict, and what it was before."""
    e = row.estimate
    configured = "–" if e.configured is None else f"{e.configured:.5g}"
    before = "" if row.before is None else f"{row.before.value:.5g}{' worn' if row.worn else ''}"
    return row.key, f"{e.value:.5g}", interval(e), configured, row.verdict, before


def interval(e: Estimate) -> str:
    """Both ends."""
    return f"{e.low:.5g} … {e.high:.5g}"


def table(rows: Iterable[Row]) -> list[str]:
    """The rows as lines; what stands before them is named where an earlier identification is there."""
    body = [cells(row) for row in rows]
    head = (*HEAD, "before" if any(row[-1] for row in body) else "")
    whole = [head, *body]
    wide = [max(len(row[i]) for row in whole) for i in range(len(head))]
    return [
        "  ".join(
            (text.ljust(width) if i in (0, 4) else text.rjust(width))
            for i, (text, width) in enumerate(zip(row, wide, strict=True))
        ).rstrip()
        for row in whole
    ]


def verdict(rows: Iterable[Row], unexplained: list[str]) -> str:
    """In a word: unexplained, worn, differs or agrees."""
    rows = list(rows)
    if any(row.worn for row in rows):
        return "worn"
    if unexplained:
        return "unexplained"
    if any(row.verdict == OFF for row in rows):
        return "differs"
    return "agrees" if any(row.verdict != UNTOLD for row in rows) else "unknown"
