"""An operator of a simulation who uploads a profile and has it followed, and how well that goes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from pneud.replay.asking import Asking
from pneud.signals import Answer, Record, Request, State


class Following(Asking):
    """Arms, asks for what is wanted in turn, the last of it to follow a profile, and measures that.

    Attributes:
        lasts_s: of the profile.
        over: the profile has come to its end, something was refused, or a fault has ended it.
        good: it has been followed to its end.
    """

    def __init__(self, wanted: Iterable[Request], lasts_s: float) -> None:
        """Nothing has been asked for yet.

        Args:
            wanted: one request a tick, once the axis holds.
            lasts_s: of the profile.
        """
        super().__init__(wanted)
        self.lasts_s, self.good = lasts_s, False
        self._refused: str | None = None
        self._squares_mm = self._most_mm = 0.0
        self._ticks = 0

    def see(self, record: Record) -> None:
        """What became of it in a tick."""
        tick = record.tick
        if self.over:
            return
        if tick.request is not None and tick.answer != Answer.TAKEN:
            self._refused, self.over = Answer(tick.answer).name.lower(), True
        elif tick.state == State.FAULT:
            self.over = True
        elif tick.state == State.TRACKING:
            error_mm = 1e3 * abs(tick.reference.position_m - record.truth_m)
            self._squares_mm += error_mm * error_mm
            self._most_mm = max(self._most_mm, error_mm)
            self._ticks += 1
        elif self._ticks:
            self.over, self.good = True, tick.state == State.HOLDING

    @property
    def results(self) -> dict[str, Any]:
        """Of the way onto the profile and of the profile, in mm and s; None where there was none of it."""
        rms_mm = math.sqrt(self._squares_mm / self._ticks) if self._ticks else None
        found: dict[str, Any] = {"duration_s": self.lasts_s, "followed": self.good}
        found |= {"rms_mm": rms_mm, "max_mm": self._most_mm if self._ticks else None}
        return found | ({"refused": self._refused} if self._refused else {})


def in_words(results: dict[str, Any]) -> str:
    """A line."""
    if "refused" in results:
        return f"profile: refused: {results['refused'].replace('_', ' ')}"
    how = "followed to its end" if results["followed"] else "not followed to its end"
    words = f"profile of {results['duration_s']:.3f} s: {how}"
    if results["rms_mm"] is None:
        return words
    return f"{words}, error {results['rms_mm']:.3f} mm RMS, {results['max_mm']:.3f} mm max"
