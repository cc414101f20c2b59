"""A campaign as a page: how its figures are spread, the worst runs and how to see them, what matters."""

from __future__ import annotations

import html
import math
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pneud.campaign.plan import RUN, Plan
from pneud.campaign.rows import Floats, Rows
from pneud.campaign.sensitivities import MIDDLE, SHARES, spread, strongest
from pneud.campaign.unit import ERROR, SEED
from pneud.report.frame import BAD, GOOD, LOOK, Drawn, Section, Verdict, document, strip, table

NAME = "index.html"
WORST, FAILED, RANKS = 10, 20, 40  # rows shown at most
FAULTS = "faults"
_BINS, _WIDTH, _HEIGHT = 40, 220.0, 44.0
_UNITS = {"_m": (1e3, "mm"), "_v": (1.0, "V"), "_s": (1.0, "s"), "_nl": (1.0, "normal litres")}


class Told(NamedTuple):
    """What a page says of a campaign beside its rows."""

    name: str
    file: str  # as it was given, for the commands
    folder: Path  # where the page and the reports of runs lie
    worst: str  # column
    kinds: tuple[str, ...] = ()  # of workers


def page(plan: Plan, rows: Rows, told: Told) -> str:
    """The page."""
    facts = [
        ("runs", f"{len(rows)}"),
        ("combinations", f"{plan.combinations}, {plan.runs} draws of each"),
        ("seed", f"{plan.seed}"),
        ("drawn", ", ".join(plan.bases[0]["spread"]) or "nothing but noise"),
    ]
    return document(
        f"pneud campaign: {told.name}",
        f"Campaign {told.name}",
        [
            Section("Figures", _figures(plan, rows)),
            Section("Combinations", _combinations(plan, rows)),
            Section("Worst runs", _worst(plan, rows, told)),
            Section("What figures depend on", _sensitivities(plan, rows)),
            Section("Faults", _faults(rows)),
            Section("Runs that failed", _failed(rows, told)),
        ],
        lead=strip(verdict(rows, told), facts),
    )


def verdict(rows: Rows, told: Told) -> Verdict:
    """Whether all runs could be done, and went on without a fault."""
    failed, faulty = len(rows.where(ERROR)), len(rows.where(FAULTS))
    found = Verdict()
    if failed:
        found = found.and_then(BAD, f"{failed} of {len(rows)} runs failed")
    if faulty:
        found = found.and_then(LOOK, f"{faulty} of {len(rows)} runs ended in a fault, or had one")
    if not failed and not faulty:
        found = found.and_then(GOOD, f"all {len(rows)} runs were done")
    if len(told.kinds) > 1:
        found = found.and_then(LOOK, f"by {len(told.kinds)} kinds of machines, which round differently")
    return found


def scaled(column: str) -> tuple[str, float]:
    """A figure's name for people with its unit, and by what its numbers are multiplied."""
    for end, (factor, unit) in _UNITS.items():
        if column.endswith(end):
            return f"{column.removesuffix(end)} [{unit}]", factor
    return column, 1.0


def _figures(plan: Plan, rows: Rows) -> str:
    lines = []
    for column in plan.figures:
        values = rows.ordered(column)
        found = spread(values)
        name, factor = scaled(column)
        if found is None:
            lines.append((name, Drawn(""), *("–",) * (len(SHARES) + 2), str(len(rows))))
            continue
        told = (found.least, *found.shares, found.most)
        lines.append((name, _histogram(values), *(in_words(factor * x) for x in told), str(found.none)))
    head = ("figure", "", "least", *(f"{share:g} %" for share in SHARES), "greatest", "runs without")
    return table(head, lines, label="figures", words=2, name="figures")


def _histogram(values: Floats) -> Drawn:
    found = values[np.isfinite(values)]
    if not len(found):
        return Drawn("")
    counts, _ = np.histogram(found, _BINS)
    step, most = _WIDTH / _BINS, max(1, int(counts.max()))
    bars = "".join(
        f"M{i * step:.1f},{_HEIGHT:g}v{-(_HEIGHT - 2) * count / most:.1f}h{step - 0.5:.1f}V{_HEIGHT:g}z"
        for i, count in enumerate(counts.tolist())
        if count
    )
    return Drawn(
        f'<svg class="small" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="histogram">'
        f'<path d="{bars}" fill="#0072b2"/></svg>'
    )


def _combinations(plan: Plan, rows: Rows) -> str:
    """The median of each figure for each value of what is not drawn."""
    names = [*plan.labels[0], *(name for name, _, values, _ in plan.lists if len(values) > 1)]
    shown = plan.figures[:8]
    parts = []
    for name in names:
        groups: dict[str, list[int]] = {}
        for number, value in enumerate(rows.column(name)):
            groups.setdefault(_shown(value), []).append(number)
        lines = [(value, str(len(group)), *_medians(rows, group, shown)) for value, group in groups.items()]
        head = (name, "runs", *(scaled(column)[0] for column in shown))
        parts.append(table(head, lines, label=f"medians by {name}", name=f"by-{name}"))
    hint = '<p class="hint">Medians. Runs with the same draw have the same rig in every combination.</p>'
    return "".join(parts) + hint if parts else ""


def _medians(rows: Rows, group: list[int], columns: Sequence[str]) -> Iterator[str]:
    for column in columns:
        found = spread(rows.ordered(column)[group])
        yield in_words(scaled(column)[1] * found.shares[MIDDLE]) if found is not None else "–"


def command(told: Told, number: object) -> str:
    """What shows a run again."""
    return f"pneud campaign {shlex.quote(told.file)} --run {number}"


def _code(text: str) -> Drawn:
    return Drawn(f'<code style="white-space:nowrap">{html.escape(text)}</code>')


def report_name(number: object) -> str:
    """The report of a run, beside the page."""
    return f"run-{number}.html"


def _worst(plan: Plan, rows: Rows, told: Told) -> str:
    if not told.worst:
        return ""
    name, factor = scaled(told.worst)
    lines, values = [], rows.ordered(told.worst)
    for row in map(rows.row, rows.greatest(told.worst, WORST)):
        beside = told.folder / report_name(row[RUN])
        number = str(row[RUN])
        link = Drawn(f'<a href="{beside.name}">{number}</a>') if beside.is_file() else number
        given = (_shown(row[column]) for column in plan.inputs)
        code = _code(command(told, number))
        lines.append((link, in_words(factor * values[int(number)]), *given, code))
    head = ("run", name, *plan.inputs, "to see it")
    return table(head, lines, label="worst runs", last=1, name="worst") if lines else ""


def _sensitivities(plan: Plan, rows: Rows) -> str:
    found = strongest(rows, plan.figures, plan.inputs)
    # what lies within twice the deviation that ranks of unrelated numbers have says nothing
    found = [r for r in found if abs(r.correlation) > 2.0 / max(1.0, r.runs - 1.0) ** 0.5][:RANKS]
    if not found:
        return ""
    lines = [(scaled(r.figure)[0], r.given, f"{r.correlation:+.2f}", _bar(r.correlation)) for r in found]
    hint = (
        '<p class="hint">Rank correlations: 1 where a figure rises with what is given, −1 where it falls.'
        " Those that chance alone could make are left out.</p>"
    )
    return table(("figure", "goes with", "by", ""), lines, label="sensitivities", words=2, last=1) + hint


def _bar(value: float) -> Drawn:
    length = 0.5 * _WIDTH * abs(value)
    begin = 0.5 * _WIDTH - (length if value < 0.0 else 0.0)
    colour = "#0072b2" if value > 0.0 else "#d55e00"
    return Drawn(
        f'<svg class="small" viewBox="0 0 {_WIDTH:g} 12" role="img" aria-label="{value:+.2f}">'
        f'<path d="M{begin:.1f},2h{length:.1f}v8h{-length:.1f}z" fill="{colour}"/></svg>'
    )


def _faults(rows: Rows) -> str:
    counts = Counter(rows.column(FAULTS)[number] for number in rows.where(FAULTS))
    lines = [(names, str(count)) for names, count in counts.most_common(FAILED)]
    return table(("faults", "runs"), lines, label="faults") if lines else ""


def _failed(rows: Rows, told: Told) -> str:
    failed = rows.where(ERROR)
    if not failed:
        return ""
    lines = [
        (
            str(row[RUN]), str(row[SEED]), str(row[ERROR]),
            _code(command(told, row[RUN])),
        )
        for row in map(rows.row, failed[:FAILED])
    ]  # fmt: skip
    more = f"<p>and {len(failed) - FAILED} more</p>" if len(failed) > FAILED else ""
    return table(("run", "seed", "why", "to see it"), lines, label="runs that failed", last=2) + more


def in_words(value: float) -> str:
    """A figure; a time may never come."""
    return f"{value:.4g}" if math.isfinite(value) else "never"


def _shown(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "–" if value is None else str(value)
