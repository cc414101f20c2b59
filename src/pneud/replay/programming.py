"""An operator of a simulation who has a program done, and what each of its records comes to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from pneud.control import program
from pneud.control.program import Program, Step
from pneud.replay.asking import ARM, Asking, is_armable
from pneud.safety.faults import FAULT_CURES, FAULT_NAMES
from pneud.signals import Answer, Record, Request, Stage, State, Tick

DUE, DONE, ENDED, STOPPED = int(Stage.DUE), int(Stage.DONE), int(Stage.ENDED), int(Stage.STOPPED)
WORKING = (int(Stage.UNDER_WAY), DONE, DUE, int(Stage.LATE))


class Passed(NamedTuple):
    """One record in one round; metres, seconds from the first tick of the run."""

    lap: int
    record: int  # from 1
    begin_s: float
    end_s: float
    off_m: float  # where it should be, less where it is, as it is done; NaN for what goes nowhere
    worst_m: float  # of the error on the way
    true: bool  # a load that was in position was so by the truth


class Passing:
    """Follows a program tick by tick.

    Attributes:
        passed: all records that are done, in their order.
        wrong: what should not be: records left out, or in position without being there.
    """

    def __init__(self, steps: Program, room_m: float) -> None:
        """A program that has not begun.

        Args:
            steps: of the axis.
            room_m: that an encoder's steps may make between estimate and truth.
        """
        self.passed: list[Passed] = []
        self.wrong: list[str] = []
        self._steps, self._room_m = steps, room_m
        self._first_ns = self._began_ns = -1
        self._record = self._lap = 0
        self._goal_m = math.nan
        self._worst_m = 0.0
        self._truth_m = math.nan  # as far as the record knows: a rig that stalls says nothing in a tick
        self._is_done = False  # and waits for others

    def see(self, record: Record) -> None:
        """One tick."""
        tick = record.tick
        if self._first_ns < 0:
            self._first_ns = tick.t_ns
        stage, step, lap = tick.progress.stage, tick.progress.step, tick.progress.lap
        if stage not in WORKING and stage != ENDED:
            self._record = 0
            return
        if stage == ENDED:
            self._leave(0, lap)
            self._record = 0
        elif (step, lap) != (self._record, self._lap) and step:
            self._leave(step, lap)
            self._begin(step, lap, tick.t_ns, tick.reference.position_m)
        if not self._record or self._is_done:
            return
        if math.isfinite(record.truth_m):
            self._truth_m = record.truth_m
        error_m = abs(record.true_error_m)
        self._worst_m = max(self._worst_m, error_m if math.isfinite(error_m) else 0.0)
        if tick.progress.stage in (DUE, DONE):
            self._end(record)

    def _leave(self, record: int, lap: int) -> None:
        """Another record begins, or, with 0, none any more: was the one before done, and is it its turn?"""
        before = self._record
        if not before:
            return
        step, last = self._steps[before - 1], before == len(self._steps)
        where = f"round {self._lap + 1}, record {before}"
        if not self._is_done and (not record or record != step.otherwise):
            self.wrong.append(f"{where}: left before it was done")
        if lap != self._lap:
            follows = last and lap == self._lap + 1 and record in (0, 1)
        else:
            follows = record > 0 and self._follows(step, before, record)
        if not follows:
            self.wrong.append(f"{where}: {f'record {record}' if record else 'the end'} came behind it")

    def _begin(self, record: int, lap: int, t_ns: int, stands_m: float) -> None:
        self._record, self._lap = record, lap
        step = self._steps[record - 1]
        if step.kind == program.GOTO:
            self._goal_m = step.target_m
        elif step.kind == program.MOVE:
            self._goal_m = (stands_m if math.isnan(self._goal_m) else self._goal_m) + step.target_m
        elif step.kind in (program.TRACK, program.FORCE):
            self._goal_m = math.nan
        self._began_ns, self._worst_m, self._truth_m, self._is_done = t_ns, 0.0, math.nan, False

    @staticmethod
    def _follows(step: Step, before: int, record: int) -> bool:
        goals = {step.to} if step.kind in (program.JUMP, program.REPEAT) else set()
        return record in goals | ({before + 1} if step.kind != program.JUMP else set()) | {step.otherwise}

    def _end(self, record: Record) -> None:
        tick, step, self._is_done = record.tick, self._steps[self._record - 1], True
        off_m, true = math.nan, True
        if step.kind in program.MOTIONS and step.ends != program.AT_ONCE:
            off_m = self._goal_m - self._truth_m
            if not abs(off_m) <= step.tolerance_m + self._room_m:
                true = False
                words = "in position, " + (
                    "and its truth is unknown" if math.isnan(off_m) else f"and {1e3 * off_m:+.4f} mm off"
                )
                self.wrong.append(f"round {self._lap + 1}, record {self._record}: {words}")
        begin_s, end_s = 1e-9 * (self._began_ns - self._first_ns), 1e-9 * (tick.t_ns - self._first_ns)
        self.passed.append(Passed(self._lap, self._record, begin_s, end_s, off_m, self._worst_m, true))

    def rounds_s(self) -> list[float]:
        """How long each whole round took, from the end of the one before."""
        ends: dict[int, float] = {}
        for one in self.passed:
            ends[one.lap] = one.end_s
        laps = sorted(ends)
        return [ends[b] - ends[a] for a, b in pairwise(laps)]


class Programming(Asking):
    """Arms, hands a program over, and sees it through.

    Attributes:
        passing: what has been done.
        over: the program has ended, was refused, or a fault has ended it.
        ended: it has come to its end.
        why: else why not.
    """

    def __init__(self, wanted: Iterable[Request], steps: Program, room_m: float) -> None:
        """Nothing has been asked for yet.

        Args:
            wanted: one request a tick, once the axis holds; the last one sets the program going.
            steps: of the program.
            room_m: as for `Passing`.
        """
        super().__init__(wanted)
        self.passing = Passing(steps, room_m)
        self.ended, self.why = False, ""

    def see(self, record: Record) -> None:
        """What became of it in a tick."""
        tick = record.tick
        if self.over:
            return
        self.passing.see(record)
        self.why = _why(tick)
        self.ended = tick.progress.stage == ENDED
        self.over = self.ended or bool(self.why)


class ProgrammingTogether:
    """The same for several axes: all are armed, handed their steps, and set going in one tick each.

    Attributes:
        passing: what has been done, of each axis.
        over: as of `Programming`, likewise the next two.
        ended: all have come to the end.
        why: else why not.
    """

    def __init__(self, wanted: Sequence[Sequence[Request]], steps: Sequence[Program], room_m: float) -> None:
        """Nothing has been asked for yet.

        Args:
            wanted: of each axis, one request a tick; all are as long.
            steps: of each axis.
            room_m: as for `Passing`.
        """
        self._wanted = [dict(enumerate(each)) for each in zip(*wanted, strict=True)]
        self._wanted.insert(0, dict.fromkeys(range(len(wanted)), ARM))
        self.passing = [Passing(one, room_m) for one in steps]
        self.over = self.ended = False
        self.why = ""
        self._armed = False

    def ask(self, last: Sequence[Tick]) -> Mapping[int, Request]:
        """What is asked of the axes in this tick."""
        if not self._wanted or self.over:
            return {}
        if self._armed:
            ready = all(tick.state == State.HOLDING for tick in last)
        else:
            ready = all(is_armable(tick.state, tick.present) for tick in last)
        if not ready:
            return {}
        self._armed = True
        return self._wanted.pop(0)

    def see(self, records: Sequence[Record]) -> None:
        """What became of it in a tick."""
        if self.over:
            return
        for passing, record in zip(self.passing, records, strict=True):
            passing.see(record)
        for record in records:
            why = _why(record.tick)
            if why and not self.why:
                self.over, self.why = True, why
        if all(record.tick.progress.stage == ENDED for record in records):
            self.over = self.ended = True


def _why(tick: Tick) -> str:
    """Why a program does not go on; empty where it does."""
    if tick.request is not None and tick.answer != Answer.TAKEN:
        return f"refused: {Answer(tick.answer).name.lower().replace('_', ' ')}"
    if tick.latched:
        bits = [bit for bit in range(len(FAULT_NAMES)) if tick.latched >> bit & 1]
        names = ", ".join(FAULT_NAMES[bit] for bit in bits)
        return f"fault {names} in record {tick.progress.step}: {FAULT_CURES[bits[0]]}"
    return f"stopped in record {tick.progress.step}" if tick.progress.stage == STOPPED else ""
