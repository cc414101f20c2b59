"""A run's tally from its log, a block of ticks at a time: to the figures that it has tick by tick."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pneud.log.files.columns import Block
from pneud.log.format.record_layout import WORD_BITS
from pneud.loop.tally import Tally
from pneud.loop.tracking import Led
from pneud.replay.ending import Ending
from pneud.signals import (
    ALL_SOURCES,
    Answer,
    Defect,
    Measurement,
    Reference,
    error_m,
    true_error_m,
)

_MARKED = int(Defect.ODD | Defect.CONFIRMED)
_DEFECTS = ("measurement.encoder_defects", "measurement.pressure_defects")


class Tallied:
    """Counts what a log's run came to.

    Attributes:
        tally: the counts.
    """

    def __init__(self, *, timed: bool, sync: bool, truth: bool = False) -> None:
        """Nothing has happened; as for `Tally`."""
        self.tally = Tally(truth=truth, timed=timed, sync=sync)
        self._timed = timed
        self._ending = Ending()

    def add(self, block: Block) -> None:
        """Take the ticks of a block."""
        tally, count = self.tally, len(block.number)
        if not count:
            return
        for first, words in block.faults("present"):
            tally.ever_present |= int(np.bitwise_or.reduce(words)) << first
        for first, words in block.faults("latched"):
            tally.ever_latched |= int(np.bitwise_or.reduce(words)) << first
        self._count_amiss(block)
        end, stalled = self._ending.look(block)
        if end:
            self._count(block if end == count else block.part(0, end))
        if stalled is not None:
            ticks = block.ticks
            skipped, lateness_ns = ticks["measurement.skipped"], ticks["timing.lateness_ns"]
            self.tally.close(int(skipped[stalled]), int(lateness_ns[stalled]))

    def _count_amiss(self, block: Block) -> None:
        ticks = block.ticks
        marked: NDArray[np.bool_] = ((ticks[_DEFECTS[0]] | ticks[_DEFECTS[1]]) & _MARKED) != 0
        told = marked | (ticks["measurement.fresh"] != ALL_SOURCES)
        told[-1] = True  # by it the time goes on
        kept = np.flatnonzero(told)
        columns = (ticks[f"measurement.{name}"][kept].tolist() for name in Measurement._fields)
        for numbers in zip(*columns, strict=True):
            self.tally.amiss.add(Measurement._make(numbers))

    def _count(self, block: Block) -> None:
        tally, ticks = self.tally, block.ticks
        tally.ticks += len(ticks)
        tally.state = int(ticks["state"][-1])
        (_, low), (_, high) = block.faults("present")
        tally.present = int(low[-1]) | int(high[-1]) << WORD_BITS
        tally.saturated += int(ticks["command.saturated"].sum())
        for name in _DEFECTS:
            tally.odd += int((ticks[name] & Defect.ODD != 0).sum())
            tally.confirmed += int((ticks[name] & Defect.CONFIRMED != 0).sum())
        if self._timed:
            tally.skipped += int(ticks["measurement.skipped"].sum())
            tally.lateness.add_many(ticks["timing.lateness_ns"])
            latency_ns = ticks["timing.latency_ns"]
            tally.latency.add_many(latency_ns[latency_ns >= 0])
        self._follow(block)

    def _follow(self, block: Block) -> None:
        ticks, tracking, real = block.ticks, self.tally.tracking, block.real
        reference = Reference._make(real(f"reference.{name}") for name in Reference._fields)
        error: Any = error_m(reference, real("estimate.position_m"))
        truth = real("truth_m")
        known = np.flatnonzero(np.isfinite(truth))
        if tracking.has_truth or len(known):
            from_ = 0 if tracking.has_truth else int(known[0])
            true = true_error_m(reference, ticks["measurement.encoder_offset_ns"], truth)
            error = np.where(np.arange(len(truth)) < from_, error, true)
        tracking.has_truth |= len(known) > 0
        answers = ticks["answer"]
        tracking.add_many(
            Led(
                ticks["t_ns"],
                ticks["state"].astype(np.int64),
                {i: request for i, request in block.requests if answers[i] == Answer.TAKEN},
                error,
                reference,
                real("command.voltage_v"),
            )
        )
