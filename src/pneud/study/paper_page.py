"""The reproduction as tables in words and as one HTML page that needs nothing beside it."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pneud.study.claims import DOES_NOT, HOLDS, Claim
from pneud.study.convergence import Convergence
from pneud.study.paper import Reproduction
from pneud.study.paper_figures import Picture
from pneud.study.reproduction import COMPOSITE, DURATION_S, NAMES, PLANT_STEP_S, STEADY_FROM_S, PaperRow

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1080px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ccc }
table { border-collapse: collapse; font-size: 12.5px; margin: .6em 0 }
th, td { padding: 2px 8px; text-align: right; border-bottom: 1px solid #e5e5e5; vertical-align: top }
th { background: #f3f3f3; font-weight: 600 } td.t, th.t { text-align: left }
img { max-width: 100%; display: block; margin: .8em 0 }
.holds { color: #1a7f37; font-weight: 600 } .part { color: #9a6700; font-weight: 600 }
.not { color: #b3261e; font-weight: 600 } p.note { color: #555; font-size: 13px }
"""


class Table(NamedTuple):
    """A table of texts; the first `words` columns are words, the rest numbers."""

    title: str
    note: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int


def tables(found: Reproduction) -> list[Table]:
    """All tables but the claims."""
    window = f"steady: {STEADY_FROM_S:g}–{DURATION_S:g} s, at every plant step of {PLANT_STEP_S * 1e3:g} ms"
    run_note = (
        f"{found.start}. Convergence: the band is entered in the first half of the run and never left;"
        f" {window}. Observer: |e3| ≤ 1 N, |e_d| ≤ 5 N/s. Effort: mean |u|; chatter: mean |Δu|, both steady."
    )
    return [
        _runs("The two cases", run_note, found.main),
        _runs(
            "With and without d̂",
            f"Each law's gains with d̂ in the law and without. No reverse flow. {run_note}",
            found.ablation,
        ),
        _runs(
            "The orifice in the plant and in the law",
            "Whether gas can flow from a chamber above supply pressure back into the supply, in the plant and"
            f" in the F1 the law believes in. Implicit composite law. {run_note}",
            found.orifice,
        ),
        _settling(found.convergence),
        _limit_cycles(found.convergence),
        _starts(found.convergence),
        _unmatched(found.convergence),
        _bounds(found),
    ]


def page(found: Reproduction, pictures: Sequence[Picture]) -> str:
    """The page, every image inside."""
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>The paper, reproduced</title>",
        f"<style>{_STYLE}</style></head><body>",
        "<h1>Finite-Time Composite Position Control for a Disturbed Pneumatic Servo System, reproduced</h1>",
        "<p>The paper's two cases on its own ideal plant: Table 1, its gains, exact states, a zero-order"
        " hold; the equations with their misprints corrected."
        f" Every run begins at {html.escape(found.start)}.</p>",
        "<h2>The claims</h2>",
        _html_claims(found.claims),
    ]
    for table in tables(found):
        parts.append(f"<h2>{html.escape(table.title)}</h2><p class='note'>{html.escape(table.note)}</p>")
        parts.append(_html_table(table))
    parts.append("<h2>Figures</h2>")
    for p in pictures:
        data = base64.b64encode(p.png).decode("ascii")
        parts.append(f"<img alt='{html.escape(p.title, quote=True)}' src='data:image/png;base64,{data}'>")
    parts.append("</body></html>")
    return "\n".join(parts)


def words(found: Reproduction) -> str:
    """The claims and tables for a terminal."""
    lines = [found.start, ""]
    for c in found.claims:
        lines += [f"{_verdict(c)}: {c.claim} ({c.where})", f"    {c.criterion}: {c.detail}"]
    for table in tables(found):
        lines += ["", table.title, *_columns(table)]
    return "\n".join(lines)


def _runs(title: str, note: str, rows: Sequence[PaperRow]) -> Table:
    return Table(
        title,
        note,
        (
            *("gains", "d̂", "law", "observer", "reverse flow"),
            *("case", "h [ms]", "0.1 mm [s]", "1 µm [s]", "RMS [µm]", "max [µm]", "observer [s]"),
            *("e_d RMS [N/s]", "effort [V]", "chatter [V]", "at ±5 V", "max P2 [bar]"),
        ),
        tuple(_run(r) for r in rows),
        5,
    )


def _run(r: PaperRow) -> tuple[str, ...]:
    s = r.setting
    flow = "yes" if s.reverse_flow else "no"
    if s.reverse_model != s.reverse_flow:
        flow += f", law: {'yes' if s.reverse_model else 'no'}"
    observed = s.law == COMPOSITE or s.compensated
    return (
        NAMES[s.law],
        "with" if s.compensated else "without",
        s.form,
        s.observer if observed else "–",
        flow,
        str(s.case),
        f"{s.h_s * 1e3:g}",
        _number(r.coarse_s, 3),
        _number(r.fine_s, 3),
        f"{r.rms_m * 1e6:.4g}",
        f"{r.max_m * 1e6:.4g}",
        _number(r.observer_s, 3) if observed else "–",
        f"{r.e_d_rms_n_s:.3g}" if observed else "–",
        f"{r.effort_v:.3f}",
        f"{r.chatter_v:.4f}",
        f"{r.saturated:.0%}",
        f"{r.p2_max_pa / 1e5:.2f}",
    )


def _settling(c: Convergence) -> Table:
    return Table(
        "Settling time against initial error",
        "From w = (w1, 0, 0) until |w1| stays below 1/1000 of its start; times grow as w1^p."
        " To zero: until the homogeneous norm is 1/100 of its start; the rest takes 1/100 of that time.",
        ("of", "α", "w1(0) [mm]", "settled [s]", "to zero [s]", "p fitted", "p predicted"),
        tuple(
            (
                s.what,
                f"{s.alpha:g}",
                f"{start * 1e3:g}",
                _number(time, 3),
                _number(s.to_zero_s[i], 3) if s.to_zero_s else "–",
                f"{s.exponent:.4f}",
                f"{s.predicted:.4f}",
            )
            for s in c.settling
            for i, (start, time) in enumerate(zip(s.starts_m, s.times_s, strict=True))
        ),
        1,
    )


def _limit_cycles(c: Convergence) -> Table:
    return Table(
        "Limit cycle of explicit u* on the chain (13)",
        "Greatest |w3| in the second half of a minute, from w = (50 mm, 0.157 m/s, 0).",
        ("k3", "α", "h [ms]", "explicit [m/s²]", "predicted [m/s²]", "implicit [m/s²]"),
        tuple(
            (
                f"{x.k3:g}",
                f"{x.alpha:g}",
                f"{x.h_s * 1e3:g}",
                f"{x.amplitude_m_s2:.4g}",
                f"{x.predicted_m_s2:.4g}",
                f"{x.implicit_m_s2:.1g}",
            )
            for x in c.limit_cycles
        ),
        0,
    )


def _starts(c: Convergence) -> Table:
    return Table(
        "Case 1 from anywhere in the cylinder",
        "Implicit composite law, 1 ms, at rest, P2(0) and P1(0) as above.",
        ("x1(0) [m]", "1 µm [s]"),
        tuple((f"{x.x1_m:g}", _number(x.fine_s, 3)) for x in c.starts),
        0,
    )


def _unmatched(c: Convergence) -> Table:
    return Table(
        "A force that (7) leaves out",
        "Error at rest under a constant force on the load; standing reference, no d(t), implicit. The"
        " last force is the atmosphere's on the rod side, Patm (A1 − A2).",
        ("force [N]", "h [ms]", "error [mm]", "predicted [mm]", ""),
        tuple(
            (
                f"{x.force_n:.3g}",
                f"{x.h_s * 1e3:g}",
                f"{x.error_m * 1e3:.4g}",
                f"{x.predicted_m * 1e3:.4g}",
                "at the end stop" if x.at_stop else "",
            )
            for x in c.unmatched
        ),
        0,
    )


def _bounds(found: Reproduction) -> Table:
    return Table(
        "What this reproduction must reach",
        "",
        ("figure", "bound", "found", ""),
        tuple(
            (
                b.what,
                f"{'≥' if b.at_least else '≤'} {b.limit:g} {b.unit}",
                f"{b.value:.3g} {b.unit}",
                "met" if b.met else "NOT MET",
            )
            for b in found.bounds
        ),
        1,
    )


def _number(value: float | None, digits: int) -> str:
    return "never" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _verdict(c: Claim) -> str:
    return f"{c.verdict} {c.when}".strip()


def _html_claims(claims: Iterable[Claim]) -> str:
    rows = []
    for c in claims:
        kind = {HOLDS: "holds", DOES_NOT: "not"}.get(c.verdict, "part")
        cells = (c.claim, c.where, c.criterion)
        rows.append(
            "<tr>"
            + "".join(f"<td class='t'>{html.escape(cell)}</td>" for cell in cells)
            + f"<td class='t'><span class='{kind}'>{c.verdict}</span> {html.escape(c.when)}</td>"
            + f"<td class='t'>{html.escape(c.detail)}</td></tr>"
        )
    head = "".join(
        f"<th class='t'>{x}</th>" for x in ("claim", "in the paper", "held against", "verdict", "figures")
    )
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _html_table(table: Table) -> str:
    def line(cells: tuple[str, ...], tag: str) -> str:
        return "".join(
            f"<{tag} class='t'>{html.escape(c)}</{tag}>"
            if i < table.words
            else f"<{tag}>{html.escape(c)}</{tag}>"
            for i, c in enumerate(cells)
        )

    body = "".join(f"<tr>{line(row, 'td')}</tr>" for row in table.rows)
    return f"<table><tr>{line(table.head, 'th')}</tr>{body}</table>"


def _columns(table: Table) -> list[str]:
    lines = (table.head, *table.rows)
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.head))]
    return [
        "  ".join(
            cell.ljust(width) if i < table.words else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
