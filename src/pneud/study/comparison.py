"""The laws under one roof: every law through every case, as a table and as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from pneud.loading import Loaded, at_rate
from pneud.loop.summary import finite
from pneud.study import cases
from pneud.study.cases import Bench, Case, Figures, bench_of, figures
from pneud.study.tuned import (
    ADRC3,
    ADRC4,
    COMPOSITE,
    COMPOSITE_PAPER,
    EXTENDED,
    EXTENDED_TUNED,
    ISMC,
    ISMC_PAPER,
    PID_FF,
    setting,
)
from pneud.view.progress import Report, each, silent

LAWS = (PID_FF, ADRC4, ADRC3, ISMC, ISMC_PAPER, COMPOSITE, COMPOSITE_PAPER, EXTENDED_TUNED, EXTENDED)
OURS = (EXTENDED, EXTENDED_TUNED)
SEED = 1  # not the noise that gains are tuned with
SINE, MOVE, LOAD, REST, RECOVERY, SPREAD = "sine", "move", "load", "rest", "recovery", "spread"
CLAIMED = (SINE, MOVE, LOAD)  # groups in which the extended composite should lead
RATES_HZ = (200.0, 500.0, 2000.0)
BRIEFLY = ("sine 0.5 Hz", "move 100 mm", "50 N on")
# requirements [mm], [mV], by group
RMS_MM = {SINE: 0.05, RECOVERY: 0.05, SPREAD: 0.2}
MAX_MM = {SINE: 0.15, LOAD: 0.6, MOVE: 0.2, REST: 0.1}
CHATTER_MV = {SINE: 100.0, REST: 20.0}
SHOWN = 3
WIDEST = 10_000  # columns: nothing is folded
NO_LIMIT = ("sine 1 Hz", "sine 2 Hz")  # nothing is required of these


class LawRow(NamedTuple):
    """One law in one case."""

    group: str
    case: str
    law: str
    judged_s: float
    figures: Figures


class Lead(NamedTuple):
    """A figure in which a baseline is at least as good as the extended composite."""

    over: str  # the extended composite as configured, or tuned alike
    law: str
    case: str
    figure: str  # "RMS" or "max"
    value_m: float
    extended_m: float


class LawTable(NamedTuple):
    """Everything that was found."""

    config: str
    compiled: bool
    rows: tuple[LawRow, ...]
    behind: tuple[Lead, ...]
    missed: dict[str, tuple[str, ...]]  # by law: requirements of the extended composite that it does not meet


def every_case(bench: Bench, rest_s: float) -> dict[str, dict[str, Case]]:
    """All cases by group."""
    return {
        SINE: cases.sines(bench),
        MOVE: cases.moves(bench),
        LOAD: cases.loads(bench),
        REST: cases.rests(bench, rest_s),
        RECOVERY: cases.recoveries(bench),
        SPREAD: cases.spread(bench),
    }


def compare(
    loaded: Loaded, rest_s: float, compiled: bool, laws: tuple[str, ...] = LAWS, report: Report = silent
) -> LawTable:
    """Run all laws through all cases; through three of them where nothing is compiled.

    Args:
        loaded: the axis, whose control is the extended composite.
        rest_s: how long to rest in the case at rest.
        compiled: needs numba.
        laws: which laws.
        report: told how many runs are done.
    """
    bench = bench_of(loaded, compiled)
    runs = [
        (group, name, bench, c)
        for group, members in every_case(bench, rest_s).items()
        for name, c in members.items()
    ]
    for hz in RATES_HZ:
        other = bench_of(loaded._replace(config=at_rate(loaded.config, hz)), compiled)
        runs.append((SPREAD, f"rate {hz:g} Hz", other, cases.tracking(other)))
    chosen = [(law, *run) for law in laws for run in runs if compiled or run[1] in BRIEFLY]
    rows = [
        LawRow(group, name, law, c.judged[1] - c.judged[0], figures(b, setting(law, b.controller), c, SEED))
        for law, group, name, b, c in each(chosen, report, "comparing", len(chosen), "runs")
    ]
    return LawTable(loaded.path.name, compiled, tuple(rows), tuple(behind(rows)), missed(rows))


def behind(rows: list[LawRow]) -> list[Lead]:
    """Where the extended composite does not lead all baselines, among sines, moves and loads."""
    found = []
    mine = {(r.case, r.law): r.figures for r in rows if r.law in OURS}
    for over in OURS:
        for r in rows:
            own = mine.get((r.case, over))
            if r.law in OURS or r.group not in CLAIMED or own is None:
                continue
            if not own.rms_m < r.figures.rms_m:
                found.append(Lead(over, r.law, r.case, "RMS", r.figures.rms_m, own.rms_m))
            if not own.max_m < r.figures.max_m:
                found.append(Lead(over, r.law, r.case, "max", r.figures.max_m, own.max_m))
    return found


def missed(rows: list[LawRow]) -> dict[str, tuple[str, ...]]:
    """What each law fails of the requirements that the extended composite's gains are chosen for."""
    found: dict[str, list[str]] = {r.law: [] for r in rows}
    for r in rows:
        f = r.figures
        for name, value, limit, unit in (
            ("RMS", f.rms_m * 1e3, RMS_MM.get(r.group), "mm"),
            ("max", f.max_m * 1e3, MAX_MM.get(r.group), "mm"),
            ("mean step of u", f.chatter_v * 1e3, CHATTER_MV.get(r.group), "mV"),
        ):
            if limit is not None and r.case not in NO_LIMIT and not value <= limit:
                found[r.law].append(f"{r.case}: {name} {value:.3g} {unit} (at most {limit:g})")
    return {law: tuple(texts) for law, texts in found.items()}


def as_json(c: LawTable) -> dict[str, Any]:
    """Everything as one object; a time that never comes is null."""
    return {
        "schema": 1,
        "config": c.config,
        "compiled": c.compiled,
        "rows": [finite(_row(r)) for r in c.rows],
        "behind": [b._asdict() for b in c.behind],
        "missed": c.missed,
    }


def _row(r: LawRow) -> dict[str, Any]:
    values = r._asdict()
    del values["figures"]
    return values | r.figures._asdict()


def in_words(c: LawTable, width: int = WIDEST) -> str:
    """The tables, for a person; laws that do not fit beside each other in so many columns come below."""
    found: tuple[tuple[str, tuple[str, ...] | None, Callable[[LawRow], str]], ...] = (
        ("RMS / max error [mm]", None, lambda r: f"{_mm(r.figures.rms_m)} / {_mm(r.figures.max_m)}"),
        ("settled to 0.1 mm after [s]", (MOVE, LOAD), lambda r: _seconds(r.figures.settled_s)),
        ("mean step of u [mV]", (SINE, REST), lambda r: f"{r.figures.chatter_v * 1e3:.1f}"),
        ("air [NL/min]", (SINE, REST), lambda r: f"{60.0 * r.figures.air_nl / r.judged_s:.1f}"),
    )
    out = [_table(c, title, groups, cell, width) for title, groups, cell in found]
    if not c.behind:
        out.append(
            "The extended composite leads all baselines in RMS and maximum in every sine, move and load."
        )
    else:
        out.append("Baselines ahead of the extended composite (theirs, its own; mm):")
    for over, law in dict.fromkeys((b.over, b.law) for b in c.behind):
        leads = [b for b in c.behind if (b.over, b.law) == (over, law)]
        texts = [f"{b.case} {b.figure} {_mm(b.value_m)}, {_mm(b.extended_m)}" for b in leads]
        out.append(f"  {law} ahead of {over}: " + "; ".join(texts))
    out.append("\nRequirements that a law does not meet:")
    for law, misses in c.missed.items():
        shown = f"{len(misses)}, first " + "; ".join(misses[:SHOWN])
        out.append(f"  {law}: " + (shown if misses else "none"))
    return "\n".join(out)


def _table(
    c: LawTable, title: str, groups: tuple[str, ...] | None, cell: Callable[[LawRow], str], width: int
) -> str:
    chosen = [r for r in c.rows if groups is None or r.group in groups]
    laws = list(dict.fromkeys(r.law for r in chosen))
    cells = {(r.case, r.law): cell(r) for r in chosen}
    lines = [[title, *laws]]
    lines += [[case, *(cells[case, law] for law in laws)] for case in dict.fromkeys(r.case for r in chosen)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(laws) + 1)]
    return "\n".join(_beside(lines, widths, chosen) for chosen in _folded(widths, width))


def _folded(widths: list[int], width: int) -> list[list[int]]:
    """Which columns stand beside each other, the first one always among them."""
    parts = [[0]]
    for i in range(1, len(widths)):
        if len(parts[-1]) > 1 and sum(widths[k] + 3 for k in (*parts[-1], i)) + 1 > width:
            parts.append([0])
        parts[-1].append(i)
    return parts


def _beside(lines: list[list[str]], widths: list[int], chosen: list[int]) -> str:
    text = [" | ".join(f"{line[i]:<{widths[i]}}" for i in chosen) for line in lines]
    text.insert(1, "-|-".join("-" * widths[i] for i in chosen))
    return "\n".join(f"| {line} |" for line in text) + "\n"


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.3g}" if math.isfinite(metres) else "lost"


def _seconds(s: float) -> str:
    return f"{s:.3f}" if math.isfinite(s) else "never"
