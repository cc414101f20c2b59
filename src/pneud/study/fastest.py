"""The fastest gains that hold over all plants; where none do, those that miss least."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from pneud.control.tunables import LEAST_MARGIN
from pneud.study.judging import BRIEF, WHOLE, Judged, Lengths
from pneud.study.proposing import Proposal

SLOWEST_RAD_S = 20.0
FASTEST_H_OMEGA = 0.4  # faster is left to those who ask for it
RATIO = 1.5  # from one bandwidth of the first look to the next
CUTS = 3  # of the interval in which the fastest lies, or of both beside the best
FINALISTS = 2  # judged in full where none holds


class Tried(NamedTuple):
    """A bandwidth and what came of it."""

    bandwidth_rad_s: float
    proposal: Proposal
    judged: tuple[Judged, ...]

    @property
    def missed(self) -> int:
        """Figures beyond their limit, of all sessions together."""
        return sum(len(j.missed) for j in self.judged)

    @property
    def returns(self) -> bool:
        """Whether the load comes back from a large error."""
        return not any(f.part == "return" for j in self.judged for f in j.missed)

    @property
    def rank(self) -> tuple[float, ...]:
        """Less is better: faster where all holds, else what misses least."""
        if self.missed == 0:
            return (0.0, -self.bandwidth_rad_s)
        return (1.0 if self.returns else 2.0, self.missed, sum(j.excess for j in self.judged))


class Found(NamedTuple):
    """Outcome of a search."""

    best: Tried
    faster: Tried | None  # the next one that was looked at, which does not hold, or is worse


Propose = Callable[[float], Proposal]
JudgeAll = Callable[[Proposal, Lengths], tuple[Judged, ...]]


def first_look(propose: Propose, h: float) -> dict[float, Proposal]:
    """The bandwidths to begin with: those whose margin bears the delay, or all."""
    count = max(1, math.floor(math.log(FASTEST_H_OMEGA / h / SLOWEST_RAD_S) / math.log(RATIO)) + 1)
    found = {omega: propose(omega) for omega in (rounded(SLOWEST_RAD_S * RATIO**i) for i in range(count))}
    sound = {omega: p for omega, p in found.items() if p.sound}
    return {omega: p for omega, p in sound.items() if bears_delay(p)} or sound or found


def bears_delay(p: Proposal) -> bool:
    """Whether gains leave a margin for what no session tries: a delay other than the model's."""
    share = LEAST_MARGIN if p.config.control.predict else 1.0
    return p.prediction.delay_margin_s >= share * p.prediction.delay_s


def fastest(propose: Propose, judge: JudgeAll, h: float) -> Found:
    """Look at bandwidths briefly, close in on the fastest that holds or the best, and judge the best in full.

    Args:
        propose: gains for a bandwidth.
        judge: runs all sessions, of these lengths.
        h: sample time [s].
    """
    tried = {w: Tried(w, p, judge(p, BRIEF)) for w, p in first_look(propose, h).items()}
    for _ in range(CUTS):
        best = min(tried.values(), key=lambda t: t.rank)
        omega = between(best, tried)
        proposal = propose(omega) if omega else None
        if omega is None or proposal is None or not proposal.sound:
            break
        tried[omega] = Tried(omega, proposal, judge(proposal, BRIEF))
    whole: list[Tried] = []
    for t in sorted(tried.values(), key=lambda t: t.rank):
        if len(whole) >= FINALISTS and t.missed > 0:
            break
        whole.append(t._replace(judged=judge(t.proposal, WHOLE)))
        if whole[-1].missed == 0:
            break
    best = min(whole, key=lambda t: t.rank)
    tried |= {t.bandwidth_rad_s: t for t in whole}
    faster = [t for t in tried.values() if t.bandwidth_rad_s > best.bandwidth_rad_s]
    return Found(best, min(faster, key=lambda t: t.bandwidth_rad_s, default=None))


def rounded(omega_rad_s: float) -> float:
    """To three significant digits: nobody feels a finer difference."""
    return float(f"{omega_rad_s:.3g}")


def between(best: Tried, tried: dict[float, Tried]) -> float | None:
    """The middle towards the next faster one, or, where the best does not hold, of the wider side."""
    here = best.bandwidth_rad_s
    above = min((w for w in tried if w > here), default=None)
    below = max((w for w in tried if w < here), default=None)
    if best.missed == 0 or below is None or (above is not None and above / here > here / below):
        return rounded(math.sqrt(here * above)) if above is not None else None
    return rounded(math.sqrt(here * below))
