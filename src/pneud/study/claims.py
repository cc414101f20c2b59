"""What the paper claims, held against the figures: holds, holds only when …, does not hold."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from pneud.study.convergence import Convergence, Settling
from pneud.study.reproduction import COMPOSITE, ISMC, PaperRow, Setting

HOLDS, ONLY_WHEN, DOES_NOT = "holds", "holds only when", "does not hold"

BETTER = 0.99  # "faster" and "better" begin one percent below the other
EXPONENT_ERROR = 0.1  # relative, in a fitted exponent of settling
ROBUST_N, ROBUST_M = 1.0, 1e-3  # a law is robust where a force of 1 N does not cost a millimetre
WORKS_M = 1e-3  # steady RMS of a loop that tracks
FAILED_M = 0.1  # a loop has failed that is this far off on average


class Claim(NamedTuple):
    """A claim and what became of it."""

    claim: str
    where: str  # in the paper
    criterion: str
    verdict: str  # HOLDS, ONLY_WHEN or DOES_NOT
    when: str  # the conditions, where it holds only then
    detail: str  # the figures behind it


class Bound(NamedTuple):
    """A figure that this reproduction must reach."""

    what: str
    unit: str
    limit: float
    value: float
    at_least: bool

    @property
    def met(self) -> bool:
        """False for NaN."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


Condition = tuple[tuple[int, str], ...]  # place among the circumstances, and what must stand there


class Instance(NamedTuple):
    """One test of a claim: the circumstances, in words, and whether it held."""

    circumstances: tuple[str, ...]
    holds: bool


def conditions(instances: Sequence[Instance]) -> list[Condition]:
    """The circumstances under which a claim holds, as a union of conjunctions.

    Each conjunction holds for every instance that it matches; together they cover all that hold. Wide ones
    are taken first.
    """
    left = {i for i, x in enumerate(instances) if x.holds}
    if not left:
        return []
    places = range(len(instances[0].circumstances))
    candidates: dict[Condition, set[int]] = {}
    for size in range(len(places) + 1):
        for chosen in itertools.combinations(places, size):
            groups: dict[Condition, set[int]] = {}
            for i, x in enumerate(instances):
                groups.setdefault(tuple((c, x.circumstances[c]) for c in chosen), set()).add(i)
            candidates |= {c: g for c, g in groups.items() if all(instances[i].holds for i in g)}
    found: list[Condition] = []
    while left:
        best = max(candidates, key=lambda c: (len(candidates[c] & left), -len(c)))
        found.append(best)
        left -= candidates[best]
    return found


def in_words(found: Sequence[Condition]) -> str:
    """Conditions as a phrase; those that differ in one circumstance only are drawn together."""
    sets = [{place: [value] for place, value in c} for c in found]
    i = 0
    while i < len(sets):
        for j in range(i + 1, len(sets)):
            a, b = sets[i], sets[j]
            if a.keys() == b.keys():
                differing = [place for place in a if a[place] != b[place]]
                if len(differing) == 1:
                    a[differing[0]] += b[differing[0]]
                    del sets[j]
                    break
        else:
            i += 1
    return "; or ".join(", ".join(" or ".join(values) for values in c.values()) for c in sets)


def judged(claim: str, where: str, criterion: str, instances: Sequence[Instance], detail: str) -> Claim:
    """The claim with its verdict."""
    count = sum(x.holds for x in instances)
    if count == 0:
        return Claim(claim, where, criterion, DOES_NOT, "", detail)
    if count == len(instances):
        return Claim(claim, where, criterion, HOLDS, "", detail)
    when = in_words(conditions(instances))
    return Claim(claim, where, criterion, ONLY_WHEN, when, f"{count} of {len(instances)} runs; {detail}")


def circumstances(s: Setting) -> tuple[str, ...]:
    """A setting in words, but for its law."""
    return (
        f"{s.form} law",
        f"{s.observer} observer",
        f"h = {s.h_s * 1e3:g} ms",
        f"Case {s.case}",
        "with reverse flow" if s.reverse_flow else "without reverse flow",
    )


def of_rows(rows: Iterable[PaperRow], holds: Callable[[PaperRow], bool]) -> list[Instance]:
    """One instance a row."""
    return [Instance(circumstances(r.setting), holds(r)) for r in rows]


def of_pairs(
    rows: Sequence[PaperRow],
    first: Callable[[Setting], bool],
    other: Callable[[Setting], Setting],
    holds: Callable[[PaperRow, PaperRow], bool],
) -> list[Instance]:
    """One instance for each row of a kind that has its counterpart among the rows."""
    by_setting = {r.setting: r for r in rows}
    return [
        Instance(circumstances(r.setting), holds(r, by_setting[other(r.setting)]))
        for r in rows
        if first(r.setting) and other(r.setting) in by_setting
    ]


def sooner(a: PaperRow, b: PaperRow) -> bool:
    """Whether a converged to 0.1 mm, and clearly before b."""
    if a.coarse_s is None:
        return False
    return b.coarse_s is None or a.coarse_s < BETTER * b.coarse_s


def closer(a: PaperRow, b: PaperRow) -> bool:
    """Whether a tracks at all, and its steady error is clearly below b's."""
    return a.rms_m <= WORKS_M and a.rms_m < BETTER * b.rms_m


def settles_in_finite_time(s: Settling) -> bool:
    """Whether the settling time shrinks with the start as homogeneity predicts."""
    return (
        all(math.isfinite(t) for t in s.times_s)
        and s.predicted > 0.0
        and abs(s.exponent / s.predicted - 1.0) <= EXPONENT_ERROR
    )


def claims(main: Sequence[PaperRow], ablation: Sequence[PaperRow], c: Convergence) -> list[Claim]:
    """The paper's claims, in its order."""
    composite = [r for r in main if r.setting.law == COMPOSITE]
    return [*_of_convergence(composite, c), *_of_comparison(main, ablation), *_of_robustness(c)]


def _of_convergence(composite: Sequence[PaperRow], c: Convergence) -> list[Claim]:
    chain, loop = c.settling[0], c.settling[-1]
    ten_ms = [r for r in composite if r.setting.h_s == 0.01]
    printed = [r.rms_m for r in ten_ms if r.setting.form == "explicit"]
    implicit = [r.rms_m for r in ten_ms if r.setting.form == "implicit"]
    return [
        judged(
            "the observer's errors e3 and e_d converge to zero in finite time",
            "Section 4.1, Figures 4 and 7",
            "|e3| ≤ 1 N and |e_d| ≤ 5 N/s in the first half of the run and from then on",
            of_rows(composite, lambda r: r.observer_s is not None),
            f"steady RMS of e_d {_range([r.e_d_rms_n_s for r in composite])} N/s",
        ),
        judged(
            "u* stabilises the chain (13) in finite time",
            "Lemma 2",
            "time to 1/1000 of the initial error grows with it as |w1(0)|^((1−α)/(3−2α)), within 10 %",
            [Instance(("sampled and held, implicit",), settles_in_finite_time(chain))],
            f"exponent {chain.exponent:.4f}, predicted {chain.predicted:.4f}",
        ),
        judged(
            "the closed loop's settling time is that of a finite-time law",
            "Theorem 3",
            "as for the chain; Case 1, implicit, 1 ms, started on the reference but for w1",
            [Instance(("implicit",), settles_in_finite_time(loop))],
            f"exponent {loop.exponent:.4f}, predicted {loop.predicted:.4f}",
        ),
        judged(
            "the tracking errors converge to zero in finite time",
            "Theorem 3, Figures 3 and 6",
            "|error| ≤ 1 µm in the first half of the run and from then on",
            of_rows(composite, lambda r: r.fine_s is not None),
            f"steady RMS {_range([r.rms_m * 1e6 for r in composite])} µm",
        ),
        judged(
            "the law works at the sampling time of 0.01 s",
            "Section 5",
            "steady RMS ≤ 1 mm",
            of_rows(ten_ms, lambda r: r.rms_m <= WORKS_M),
            f"steady RMS of the explicit law {_range([x * 1e3 for x in printed])} mm,"
            f" of the implicit {_range([x * 1e3 for x in implicit])} mm",
        ),
    ]


def _of_comparison(main: Sequence[PaperRow], ablation: Sequence[PaperRow]) -> list[Claim]:
    def is_composite(s: Setting) -> bool:
        return s.law == COMPOSITE and s.compensated

    def as_ismc(s: Setting) -> Setting:
        return s._replace(law=ISMC, compensated=False)

    def without(s: Setting) -> Setting:
        return s._replace(compensated=False)

    return [
        judged(
            "the composite law converges faster than ISMC",
            "Section 5, Figures 3 and 6",
            "composite reaches 0.1 mm for good at least 1 % sooner",
            of_pairs(main, is_composite, as_ismc, sooner),
            "gains and α of the two differ, see the next line",
        ),
        judged(
            "it does so because of the disturbance observer",
            "Section 5",
            "the composite's gains with d̂ reach 0.1 mm for good at least 1 % sooner than without",
            of_pairs(ablation, is_composite, without, sooner),
            "table “with and without d̂”",
        ),
        judged(
            "the composite law rejects disturbances better than ISMC",
            "Section 5",
            "steady RMS ≤ 1 mm and at least 1 % lower",
            of_pairs(main, is_composite, as_ismc, closer),
            "gains and α of the two differ, see the next line",
        ),
        judged(
            "it does so because of the disturbance observer",
            "Remark 4",
            "the composite's gains with d̂ have a steady RMS ≤ 1 mm, at least 1 % lower than without",
            of_pairs(ablation, is_composite, without, closer),
            "table “with and without d̂”",
        ),
    ]


def _of_robustness(c: Convergence) -> list[Claim]:
    one_newton = [u for u in c.unmatched if u.force_n == ROBUST_N]
    return [
        judged(
            "the closed loop is globally finite-time stable",
            "Theorem 3",
            "Case 1, implicit, 1 ms, at rest anywhere in the cylinder: 1 µm in the first half of the run and"
            " from then on",
            [Instance((f"x1(0) = {s.x1_m:g} m",), s.fine_s is not None) for s in c.starts],
            f"{len(c.starts)} starts from {c.starts[0].x1_m:g} to {c.starts[-1].x1_m:g} m,"
            f" {_range([s.fine_s for s in c.starts if s.fine_s is not None])} s",
        ),
        judged(
            "nice robustness against external disturbances, of any kind",
            "Remark 4",
            "a constant force of 1 N on the load, which (7) leaves out, costs no more than 1 mm at rest",
            [Instance((f"h = {u.h_s * 1e3:g} ms",), u.error_m <= ROBUST_M) for u in one_newton],
            f"{_range([u.error_m * 1e3 for u in one_newton])} mm",
        ),
    ]


def bounds(main: Sequence[PaperRow], c: Convergence) -> list[Bound]:
    """The figures that this reproduction must reach."""
    found = []
    for reverse, h, limit_m in (
        (False, 0.01, 0.06e-3),
        (False, 0.001, 0.5e-6),
        (True, 0.01, 0.15e-3),
        (True, 0.001, 10e-6),
    ):
        worst = max(
            r.rms_m
            for r in main
            if r.setting.law == COMPOSITE
            and (r.setting.form, r.setting.observer) == ("implicit", "implicit")
            and (r.setting.h_s, r.setting.reverse_flow) == (h, reverse)
        )
        flow = "with" if reverse else "without"
        what = f"steady RMS of the implicit composite law, both cases, {h * 1e3:g} ms, {flow} reverse flow"
        found.append(Bound(what, "µm", limit_m * 1e6, worst * 1e6, False))
    least = min(
        r.rms_m
        for r in main
        if r.setting.law == COMPOSITE and r.setting.form == "explicit" and r.setting.h_s == 0.01
    )
    what = "steady RMS of the explicit composite law at 10 ms: it fails"
    found.append(Bound(what, "mm", FAILED_M * 1e3, least * 1e3, True))
    error = max(abs(x.amplitude_m_s2 / x.predicted_m_s2 - 1.0) for x in c.limit_cycles)
    what = "limit cycle of explicit u* on the chain against (h k3/2)^(1/(1−α3))"
    found.append(Bound(what, "%", 1.0, error * 100.0, False))
    return found


def _range(values: Sequence[float]) -> str:
    if not values:
        return "–"
    low, high = min(values), max(values)
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
