"""What was put to use on the rig, one after another, and which of it is best."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

from pneud.study.commissioning.found import Found
from pneud.study.commissioning.verification import Verified

NO_WORSE = math.log(3.0)  # beyond the limits: by some of it do two verifications of one axis differ


class Attempt(NamedTuple):
    """A configuration, and what the axis was worth with it."""

    found: Found
    after: Verified

    @property
    def rank(self) -> tuple[bool, float]:
        """Less is better."""
        return bool(self.after.failure), excess(self.after)

    @property
    def bandwidth_rad_s(self) -> float | None:
        """That the gains are for; None: those that were there."""
        return None if self.found.chosen is None else self.found.chosen.bandwidth_rad_s

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        return {"bandwidth_rad_s": self.bandwidth_rad_s, **self.after.as_json()}


def excess(v: Verified, names: Collection[tuple[str, str]] | None = None) -> float:
    """How far what is missed is beyond its limits, the logarithms of the ratios together.

    Args:
        v: what an axis is worth.
        names: part and what of the figures that count; all, where they are not given.
    """
    return sum(math.log(f.ratio) for f in v.missed if names is None or (f.part, f.what) in names)


def is_worse(after: Verified, before: Verified | None) -> bool:
    """Whether an axis ends its verification early, or misses three times as much of what was seen before."""
    if after.failure or before is None or before.failure:
        return bool(after.failure)
    names = {(f.part, f.what) for f in before.figures}
    return excess(after, names) > excess(before, names) + NO_WORSE
