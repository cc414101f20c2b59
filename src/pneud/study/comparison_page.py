"""The comparison of the laws as a page: who is best where, by how much, and what is not met."""

from __future__ import annotations

import math
from collections.abc import Callable

from pneud.report.frame import GOOD, LOOK, Drawn, Section, Verdict, document, strip, table
from pneud.study.comparison import LOAD, MOVE, REST, SHOWN, SINE, LawRow, LawTable
from pneud.study.tuned import EXTENDED

_STEPS = (1.05, 2.0, 5.0)  # times the best of a row: up to here, and here, and here
_FIGURES: tuple[tuple[str, tuple[str, ...] | None, Callable[[LawRow], float], str], ...] = (
    ("RMS error [mm]", None, lambda r: 1e3 * r.figures.rms_m, ".3g"),
    ("Greatest error [mm]", None, lambda r: 1e3 * r.figures.max_m, ".3g"),
    ("Settled to 0.1 mm after [s]", (MOVE, LOAD), lambda r: r.figures.settled_s, ".3f"),
    ("Mean step of the command [mV]", (SINE, REST), lambda r: 1e3 * r.figures.chatter_v, ".1f"),
    ("Air [normal litres a minute]", (SINE, REST), lambda r: 60.0 * r.figures.air_nl / r.judged_s, ".1f"),
)


def page(c: LawTable) -> str:
    """The page."""
    laws = list(dict.fromkeys(r.law for r in c.rows))
    return document(
        "pneud: laws compared",
        f"Laws compared on {c.config}",
        [
            *(Section(title, _figures(c, groups, value, form)) for title, groups, value, form in _FIGURES),
            Section("Ahead of the extended composite", _ahead(c)),
            Section("Requirements that are not met", _missed(c)),
        ],
        lead=strip(verdict(c), [("laws", str(len(laws))), ("cases", str(len({r.case for r in c.rows})))])
        + '<p class="hint">Shaded is what is the best of its row, and what is within twice and within five'
        " times of it; the deeper, the better.</p>",
    )


def verdict(c: LawTable) -> Verdict:
    """Whether the extended composite leads, and what it fails of its requirements."""
    found = Verdict()
    if c.behind:
        cases = len({(b.case, b.figure) for b in c.behind if b.over == EXTENDED})
        found = found.and_then(LOOK, f"a baseline is ahead of the extended composite in {cases} figures")
    else:
        found = found.and_then(GOOD, "the extended composite leads in every sine, move and load")
    misses = c.missed.get(EXTENDED, ())
    words = f"it misses {len(misses)} of its requirements" if misses else "it meets all of its requirements"
    found = found.and_then(LOOK if misses else GOOD, words)
    return found if c.compiled else found.and_then(LOOK, "three cases only: nothing is compiled here")


def _figures(c: LawTable, groups: tuple[str, ...] | None, value: Callable[[LawRow], float], form: str) -> str:
    chosen = [r for r in c.rows if groups is None or r.group in groups]
    laws, cases = (
        list(dict.fromkeys(names)) for names in ((r.law for r in chosen), (r.case for r in chosen))
    )
    found = {(r.case, r.law): value(r) for r in chosen}
    rows = []
    for case in cases:
        figures = [found[case, law] for law in laws]
        best = min(filter(math.isfinite, figures), default=math.inf)
        rows.append((case, *(_cell(figure, best, form) for figure in figures)))
    return table(("case", *laws), rows, label="figures of each law") if rows else ""


def _cell(figure: float, best: float, form: str) -> Drawn:
    if not math.isfinite(figure):
        return Drawn("never")
    ratio = figure / best if best > 0.0 else (1.0 if figure <= best else math.inf)
    grade = sum(ratio > step for step in _STEPS)
    return Drawn(f'<span class="grade g{grade}">{figure:{form}}</span>')


def _ahead(c: LawTable) -> str:
    rows = (
        (b.over, b.law, b.case, b.figure, f"{1e3 * b.value_m:.3g}", f"{1e3 * b.extended_m:.3g}")
        for b in c.behind
    )
    head = ("extended composite", "law ahead", "case", "figure", "its [mm]", "extended composite's [mm]")
    return table(head, rows, label="leads", words=4) if c.behind else "<p>None.</p>"


def _missed(c: LawTable) -> str:
    rows = (
        (law, str(len(misses)), "; ".join(misses[:SHOWN]) + (" …" if len(misses) > SHOWN else ""))
        for law, misses in c.missed.items()
    )
    return table(("law", "how many", "which"), rows, label="requirements", last=1)
