"""Readings that their tick had to go without: by source, how many, how often, and the worst second."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pneud.log.files.columns import Block
from pneud.log.live.amiss import NEVER_NS, Counts
from pneud.signals import Defect, Source

KINDS = (*Counts._fields, "corrupt", "frozen")
SOURCES = {"encoder": Source.ENCODER, "pressure": Source.PRESSURE, "valve": Source.VALVE}


class Readings:
    """Those of a log, counted as `Amiss` counts those of a run."""

    def __init__(self, sync: bool) -> None:
        self.by_second: dict[tuple[str, str], Counter[int]] = {
            (source, kind): Counter() for source in SOURCES for kind in KINDS
        }
        self._sync = sync

    def add(self, block: Block, t_s: NDArray[np.float64]) -> None:
        """Take the ticks of a block, at these times."""
        ticks, second = block.ticks, t_s.astype(np.int64)
        for source, bit in SOURCES.items():
            age_ns, defects = (ticks[f"measurement.{source}_{of}"] for of in ("age_ns", "defects"))
            without = (ticks["measurement.fresh"] & bit == 0) & (age_ns <= NEVER_NS)
            if self._sync:
                self._count(source, "missing", second[without & (defects == 0)])
            for kind, defect in (
                ("late", Defect.LATE),
                ("corrupt", Defect.CORRUPT),
                ("frozen", Defect.FROZEN),
            ):
                self._count(source, kind, second[without & (defects & defect != 0)])
            self._count(source, "odd", second[defects & Defect.ODD != 0])
            self._count(source, "odd", second[defects & Defect.CONFIRMED != 0], -1)

    def _count(self, source: str, kind: str, seconds: Any, step: int = 1) -> None:
        for second, count in zip(*np.unique(seconds, return_counts=True), strict=True):
            self.by_second[source, kind][int(second)] += step * int(count)

    def in_words(self, source: str, kind: str, length_s: float) -> tuple[str, str, str]:
        """How many there were in so long, how many a minute, and in the worst second."""
        found = self.by_second[source, kind]
        count = found.total()
        if not count:
            return "0", "", ""
        worst_s, most = found.most_common(1)[0]
        return f"{count:,}", f"{60.0 * count / max(length_s, 1e-9):.3g}", f"{most} at {worst_s} s"

    def total(self) -> int:
        """Those of all sources and kinds."""
        return sum(max(0, found.total()) for found in self.by_second.values())

    def total_in_words(self) -> str:
        """Those of all sources, as in the summary of the run."""
        counts = ((sum(self.by_second[source, kind].total() for source in SOURCES), kind) for kind in KINDS)
        return ", ".join(f"{max(0, count)} {kind}" for count, kind in counts)
