"""The reproduction as tables in words and as one HTML page that needs nothing beside it."""

from __future__ import annotations

import base64
import html
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from pneud.report import frame
from pneud.report.frame import BAD, GOOD, LOOK, Drawn, Section, Verdict, document, strip
from pneud.study.claims import DOES_NOT, HOLDS, Claim
from pneud.study.convergence import Convergence
from pneud.study.paper import Reproduction
from pneud.study.paper_figures import Picture
from pneud.study.reproduction import COMPOSITE, DURATION_S, NAMES, PLANT_STEP_S, STEADY_FROM_S, PaperRow


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
    intro = (
        "<p>The paper's two cases on its own ideal plant: Table 1, its gains, exact states, a zero-order"
        " hold; the equations with their misprints corrected."
        f" Every run begins at {html.escape(found.start)}.</p>"
    )
    images = "".join(
        f'<img alt="{html.escape(p.title, quote=True)}"'
        f' src="data:image/png;base64,{base64.b64encode(p.png).decode("ascii")}">'
        for p in pictures
    )
    sections = [
        Section("Claims", _claims(found.claims)),
        *(
            Section(one.title, f'<p class="hint">{html.escape(one.note)}</p>' + _cells(one))
            for one in tables(found)
        ),
        Section("Figures", images),
    ]
    return document(
        "The paper, reproduced",
        "Finite-Time Composite Position Control for a Disturbed Pneumatic Servo System, reproduced",
        sections,
        lead=strip(verdict(found)) + intro,
    )


def verdict(found: Reproduction) -> Verdict:
    """Whether the figures are within their bounds, and how many claims hold."""
    counts = Counter(c.verdict for c in found.claims)
    told = ", ".join(f"{count} {word}" for word, count in counts.items())
    level, reason = (
        (GOOD, "every figure is within its bound") if found.good else (BAD, "a figure is out of its bound")
    )
    return Verdict(level, (reason, f"of {len(found.claims)} claims: {told}"))


def words(found: Reproduction) -> str:
    """The claims and tables for a terminal."""
    lines = [found.start, ""]
    for c in found.claims:
        lines += [f"{_verdict(c)}: {c.claim} ({c.where})", f"    {c.criterion}: {c.detail}"]
    for table in tables(found):
        lines += ["", table.title, *_columns(table)]
    return "\n".join(lines)


Column = Callable[[Any], str]


def _table(title: str, note: str, rows: Sequence[Any], words: int, columns: Mapping[str, Column]) -> Table:
    """A table of things, a column for each head."""
    cells = tuple(tuple(cell(row) for cell in columns.values()) for row in rows)
    return Table(title, note, tuple(columns), cells, words)


def _runs(title: str, note: str, rows: Sequence[PaperRow]) -> Table:
    return _table(
        title,
        note,
        rows,
        5,
        {
            "gains": lambda r: NAMES[r.setting.law],
            "d̂": lambda r: "with" if r.setting.compensated else "without",
            "law": lambda r: r.setting.form,
            "observer": lambda r: r.setting.observer if _observed(r) else "–",
            "reverse flow": _flow,
            "case": lambda r: str(r.setting.case),
            "h [ms]": lambda r: f"{r.setting.h_s * 1e3:g}",
            "0.1 mm [s]": lambda r: _number(r.coarse_s, 3),
            "1 µm [s]": lambda r: _number(r.fine_s, 3),
            "RMS [µm]": lambda r: f"{r.rms_m * 1e6:.4g}",
            "max [µm]": lambda r: f"{r.max_m * 1e6:.4g}",
            "observer [s]": lambda r: _number(r.observer_s, 3) if _observed(r) else "–",
            "e_d RMS [N/s]": lambda r: f"{r.e_d_rms_n_s:.3g}" if _observed(r) else "–",
            "effort [V]": lambda r: f"{r.effort_v:.3f}",
            "chatter [V]": lambda r: f"{r.chatter_v:.4f}",
            "at ±5 V": lambda r: f"{r.saturated:.0%}",
            "max P2 [bar]": lambda r: f"{r.p2_max_pa / 1e5:.2f}",
        },
    )


def _observed(r: PaperRow) -> bool:
    return r.setting.law == COMPOSITE or r.setting.compensated


def _flow(r: PaperRow) -> str:
    s = r.setting
    of_law = f", law: {'yes' if s.reverse_model else 'no'}" if s.reverse_model != s.reverse_flow else ""
    return ("yes" if s.reverse_flow else "no") + of_law


def _settling(c: Convergence) -> Table:
    return _table(
        "Settling time against initial error",
        "From w = (w1, 0, 0) until |w1| stays below 1/1000 of its start; times grow as w1^p."
        " To zero: until the homogeneous norm is 1/100 of its start; the rest takes 1/100 of that time.",
        [(s, i) for s in c.settling for i in range(len(s.times_s))],
        1,
        {
            "of": lambda r: str(r[0].what),
            "α": lambda r: f"{r[0].alpha:g}",
            "w1(0) [mm]": lambda r: f"{r[0].starts_m[r[1]] * 1e3:g}",
            "settled [s]": lambda r: _number(r[0].times_s[r[1]], 3),
            "to zero [s]": lambda r: _number(r[0].to_zero_s[r[1]], 3) if r[0].to_zero_s else "–",
            "p fitted": lambda r: f"{r[0].exponent:.4f}",
            "p predicted": lambda r: f"{r[0].predicted:.4f}",
        },
    )


def _limit_cycles(c: Convergence) -> Table:
    return _table(
        "Limit cycle of explicit u* on the chain (13)",
        "Greatest |w3| in the second half of a minute, from w = (50 mm, 0.157 m/s, 0).",
        c.limit_cycles,
        0,
        {
            "k3": lambda x: f"{x.k3:g}",
            "α": lambda x: f"{x.alpha:g}",
            "h [ms]": lambda x: f"{x.h_s * 1e3:g}",
            "explicit [m/s²]": lambda x: f"{x.amplitude_m_s2:.4g}",
            "predicted [m/s²]": lambda x: f"{x.predicted_m_s2:.4g}",
            "implicit [m/s²]": lambda x: f"{x.implicit_m_s2:.1g}",
        },
    )


def _starts(c: Convergence) -> Table:
    return _table(
        "Case 1 from anywhere in the cylinder",
        "Implicit composite law, 1 ms, at rest, P2(0) and P1(0) as above.",
        c.starts,
        0,
        {"x1(0) [m]": lambda x: f"{x.x1_m:g}", "1 µm [s]": lambda x: _number(x.fine_s, 3)},
    )


def _unmatched(c: Convergence) -> Table:
    return _table(
        "A force that (7) leaves out",
        "Error at rest under a constant force on the load; standing reference, no d(t), implicit. The"
        " last force is the atmosphere's on the rod side, Patm (A1 − A2).",
        c.unmatched,
        0,
        {
            "force [N]": lambda x: f"{x.force_n:.3g}",
            "h [ms]": lambda x: f"{x.h_s * 1e3:g}",
            "error [mm]": lambda x: f"{x.error_m * 1e3:.4g}",
            "predicted [mm]": lambda x: f"{x.predicted_m * 1e3:.4g}",
            "": lambda x: "at the end stop" if x.at_stop else "",
        },
    )


def _bounds(found: Reproduction) -> Table:
    return _table(
        "What this reproduction must reach",
        "",
        found.bounds,
        1,
        {
            "figure": lambda b: str(b.what),
            "bound": lambda b: f"{'≥' if b.at_least else '≤'} {b.limit:g} {b.unit}",
            "found": lambda b: f"{b.value:.3g} {b.unit}",
            "": lambda b: "met" if b.met else "NOT MET",
        },
    )


def _number(value: float | None, digits: int) -> str:
    return "never" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _verdict(c: Claim) -> str:
    return f"{c.verdict} {c.when}".strip()


def _claims(claims: Iterable[Claim]) -> str:
    levels = {HOLDS: GOOD, DOES_NOT: BAD}
    rows = []
    for c in claims:
        judged = frame.badge(levels.get(c.verdict, LOOK), c.verdict)
        rows.append((c.claim, c.where, c.criterion, Drawn(f"{judged} {html.escape(c.when)}"), c.detail))
    return frame.table(
        ("claim", "in the paper", "held against", "verdict", "figures"), rows, label="claims", words=5
    )


def _cells(one: Table) -> str:
    return frame.table(one.head, one.rows, label=one.title, words=one.words)


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
