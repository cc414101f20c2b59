"""What sessions came to, for a person: a table, worst first, and laws beside each other."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from pneud.study.judging import NOMINAL, SLACK, Figure, Judged, ordered

SHOWN = 8  # rigs in the table
WIDTH = 108
UNITS = {
    ("rest", "max_m"): (1e6, "µm", ".0f"),
    ("", "max_m"): (1e3, "mm", ".2g"),
    ("", "rms_m"): (1e3, "mm", ".2g"),
    ("", "overshoot_m"): (1e6, "µm", ".0f"),
    ("", "mean_step_v"): (1e3, "mV", ".0f"),
    ("", "in_position_s"): (1.0, "s", ".2f"),
}
NAMES = {
    "rms_m": "RMS",
    "max_m": "largest error",
    "overshoot_m": "overshoot",
    "mean_step_v": "mean |Δu|",
    "in_position_s": "in position after",
}
PARTS = {
    "sine": "sine\nRMS max mm, mV",
    "rest": "rest\nµm, mV",
    "1 mm": "1 mm\nover µm, s",
    "10 mm": "10 mm\nover µm, s",
    "push": "push\nmm, s",
}


def number(part: str, what: str, value: float) -> str:
    """A value in the unit of the table."""
    scale, _, form = UNITS.get((part, what)) or UNITS["", what]
    return format(scale * value, form) if math.isfinite(value) else "never"


def unit(part: str, what: str) -> str:
    """That unit."""
    return (UNITS.get((part, what)) or UNITS["", what])[1]


def told(f: Figure) -> str:
    """A figure in words."""
    value, limit = number(f.part, f.what, f.value), number(f.part, f.what, f.limit)
    of = unit(f.part, f.what)
    return f"{f.part}: {NAMES[f.what]} {value}{f' {of}' if value != 'never' else ''} (at most {limit} {of})"


def lines(judged: Sequence[Judged], coloured: bool) -> list[str]:
    """The table, a star behind what does not hold."""
    found = ordered(judged)
    count, missed = sum(len(j.figures) for j in found), sum(len(j.missed) for j in found)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("rig", no_wrap=True)
    shown = [part for part in PARTS if any(f.part == part for j in found for f in j.figures)]
    for part in shown:
        table.add_column(PARTS[part], justify="right")
    limits = {(f.part, f.what): f.limit for j in found if j.case == NOMINAL for f in j.figures}
    table.add_row("at most", *(_limits(part, limits) for part in shown), style="dim")
    for j in found[:SHOWN]:
        table.add_row(j.case, *(_cell(part, j) for part in shown))
    text = io.StringIO()
    Console(file=text, force_terminal=coloured, width=WIDTH, highlight=False).print(table)
    more = len(found) - SHOWN
    told_rest = [f"and {more} more, all of them better"] if more > 0 else []
    return [
        f"what people do, on {len(found)} rigs, worst first: {missed} of {count} figures do not hold"
        f" (where the model errs, limits times {SLACK:g}, but for the sine)",
        *(line.rstrip() for line in text.getvalue().splitlines()),
        *told_rest,
    ]


def _cell(part: str, j: Judged) -> Text:
    cell = Text()
    for f in (f for f in j.figures if f.part == part):
        bad = f.ratio > 1.0
        cell.append(" " if cell else "")
        cell.append(number(part, f.what, f.value) + "*" * bad, style="bold red" if bad else "")
    return cell


def _limits(part: str, limits: dict[tuple[str, str], float]) -> str:
    return " ".join(number(part, what, limit) for (p, what), limit in limits.items() if p == part)


def beside(by_law: dict[str, Sequence[Judged]]) -> list[str]:
    """All laws: each figure as configured, and its worst on any rig; then where the first one is behind."""
    laws = list(by_law)
    nominal = {law: _nominal(judged) for law, judged in by_law.items()}
    worst = {law: _worst(judged) for law, judged in by_law.items()}
    rows = [["as configured → worst", *laws]]
    for part, what in nominal[laws[0]]:
        cells = (
            f"{number(part, what, nominal[law][part, what])} →"
            f" {number(part, what, worst[law][part, what]) if (part, what) in worst[law] else '-'}"
            for law in laws
        )
        rows.append([f"{part}: {NAMES[what]} [{unit(part, what)}]", *cells])
    missed = (f"{sum(len(j.missed) for j in by_law[law])}" for law in laws)
    rows.append(["figures that do not hold", *missed])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    found = ["  ".join(f"{v:<{w}}" for v, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    own = laws[0]
    for law in laws[1:]:
        ahead = [
            f"{part} {NAMES[what]}"
            for (part, what), value in worst[law].items()
            if value < worst[own].get((part, what), value)
        ]
        found.append(f"{law} leads {own} at the worst in: {', '.join(ahead) or 'nothing'}")
    return found


def _nominal(judged: Sequence[Judged]) -> dict[tuple[str, str], float]:
    return {(f.part, f.what): f.value for j in judged if j.case == NOMINAL for f in j.figures}


def _worst(judged: Sequence[Judged]) -> dict[tuple[str, str], float]:
    found: dict[tuple[str, str], float] = {}
    for f in (f for j in judged for f in j.figures):
        found[f.part, f.what] = max(f.value, found.get((f.part, f.what), 0.0))
    return found
