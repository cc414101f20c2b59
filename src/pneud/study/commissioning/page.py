"""A commissioning as one page of HTML: parameters, pictures, what the axis was worth before and is now."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pneud.config.models import Config
from pneud.study.commissioning.gains import Chosen
from pneud.study.commissioning.trying import Attempt
from pneud.study.commissioning.verification import Verified
from pneud.study.identification import page as identification
from pneud.study.identification.comparing import Row
from pneud.study.identification.estimating import Identified
from pneud.study.judging import Figure
from pneud.study.judging_words import NAMES, number, told, unit

NONE = "–"
HEAD = ("", "at most", "before", "after")


def page(
    title: str,
    lines: Iterable[str],
    rows: Sequence[Row],
    found: Identified,
    c: Config,
    before: Verified | None,
    after: Verified | None,
) -> str:
    """The page.

    Args:
        title: of which axis.
        lines: verdict and notes.
        rows: parameters against the configuration.
        found: what they come from.
        c: the configuration.
        before: what the axis was worth with the configuration as it was; None where that was not tried.
        after: what it is worth now.
    """
    tables = [identification.parameters(rows, "Parameters")]
    if before is not None or after is not None:
        compared = [(line, line[-1].endswith("*")) for line in beside(before, after)]
        tables.append(identification.Table("Verification", HEAD, compared))
    return identification.page(title, lines, tables, identification.maps(found, c))


def beside(before: Verified | None, after: Verified | None) -> list[tuple[str, str, str, str]]:
    """Each figure with its limit, before and after; a star beside what does not hold."""
    one, other = _by_name(before), _by_name(after)
    rows = []
    for (part, what), f in {**one, **other}.items():
        name = f"{part}: {NAMES[what]} [{unit(part, what)}]"
        was, now = (_cell(of.get((part, what))) for of in (one, other))
        rows.append((name, number(part, what, f.limit), was, now))
    return rows


def verdict(v: Verified) -> str:
    """In a line: what does not hold, or that everything does."""
    if v.failure:
        return f"verification: ended by {v.words}"
    missed = "; ".join(told(f) for f in v.missed)
    return f"verification: {missed or 'everything holds'}"


def gains(chosen: Chosen) -> str:
    """In a line: what the gains are, and what they were judged by."""
    which = _which(chosen.bandwidth_rad_s)
    if not chosen.judged:
        return "; ".join([f"gains: {which}", *chosen.doubts])
    missed = sum(len(j.missed) for j in chosen.judged)
    count, rigs = sum(len(j.figures) for j in chosen.judged), len(chosen.judged)
    return f"gains: {which}; {missed} of {count} figures do not hold, on {rigs} rigs within the intervals"


def tried(attempts: Sequence[Attempt]) -> list[str]:
    """What became of each gains on the rig, a line each, where there was more than one."""
    lines = []
    for one in attempts if len(attempts) > 1 else ():
        count, missed = len(one.after.figures), len(one.after.missed)
        words = f"ended by {one.after.words}" if one.after.failure else f"{missed} of {count} figures missed"
        lines.append(f"tried on the rig: gains {_which(one.bandwidth_rad_s)}: {words}")
    return lines


def _which(bandwidth_rad_s: float | None) -> str:
    return "kept" if bandwidth_rad_s is None else f"for {bandwidth_rad_s:.4g} rad/s"


def _by_name(v: Verified | None) -> dict[tuple[str, str], Figure]:
    return {} if v is None else {(f.part, f.what): f for f in v.figures}


def _cell(f: Figure | None) -> str:
    return NONE if f is None else number(f.part, f.what, f.value) + "*" * (f.ratio > 1.0)
