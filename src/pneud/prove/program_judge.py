"""Oracles of programs: none begins but one that was handed over whole, and was asked or pressed for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pneud.console import programs
from pneud.loading import Loaded
from pneud.signals import Answer, RequestKind, Stage, Tick

if TYPE_CHECKING:
    from pneud.prove.judge import Judge

START = "start"
ASKED = ("program", "load", "record", "cycles")  # of an operator, what matters here
_TAKEN, _UNDER_WAY = int(Answer.TAKEN), int(Stage.UNDER_WAY)
LATEST_NS = 6_000_000_000  # from a press to a loop that has stood still
_RECORD, _RUN = int(RequestKind.RECORD), int(RequestKind.RUN)

Steps = tuple[tuple[float, ...], ...]
Whole = tuple[Steps, tuple[float, ...]]  # and the record that it begins with, and its rounds


class ProgramJudge:
    """Looks at what an axis with a start input goes through.

    Attributes:
        pressed: how often the input has come on.
        begun: how often it has begun a program.
    """

    def __init__(self, judge: Judge, loaded: Loaded) -> None:
        """Nobody has handed anything over.

        Args:
            judge: of everything.
            loaded: the axis.
        """
        self._judge, self._facts = judge, programs.facts_of(loaded.config)
        self._wanted: set[Whole] = set()
        self._loaded: set[Steps] = set()
        self._presses: list[int] = []
        self.pressed = self.begun = 0
        self.begins()

    def begins(self) -> None:
        """A loop is about to run: an axis has no program yet."""
        self._steps: list[tuple[float, ...]] = []
        self._stage = int(Stage.NONE)

    def asks(self, program: dict[str, Any], *, load: bool = False, record: int = 1, cycles: int = 1) -> None:
        """An operator is about to hand a program over, and to begin it or have the input do so."""
        found = programs.compiled(program, [self._facts]).steps[0]
        steps = tuple(tuple(map(float, step)) for step in found)
        if load:
            self._loaded.add(steps)
        else:
            self._wanted.add((steps, (float(record), float(cycles))))

    def press(self) -> None:
        """The input comes on."""
        self.pressed += 1
        self._presses.append(self._judge.world.now_ns)

    def decided(self, tick: Tick) -> bool:
        """The loop hands a tick over; whether a program has begun by its input in it."""
        request, stage = tick.request, tick.progress.stage
        taken = request if request is not None and tick.answer == _TAKEN else None
        if taken is not None and taken.kind == _RECORD:
            if len(taken.values) > 2:  # fewer announce steps, or take all away
                self._steps.append(taken.values)
            else:
                self._steps.clear()
        before, self._stage = self._stage, stage
        if not before < _UNDER_WAY <= stage:
            return False
        steps, says_no = tuple(self._steps), self._judge.says_no
        if taken is not None and taken.kind == _RUN:
            if (steps, taken.values[:2]) not in self._wanted:
                says_no("program", f"{len(steps)} steps begin, and nobody has asked for them, or otherwise")
            self._loaded.add(steps)  # what has been begun is loaded
            return False
        if steps not in self._loaded:
            says_no("program", f"{len(steps)} steps begin that nobody has handed over whole for an input")
        self.begun += 1
        since_ns = self._judge.world.now_ns - LATEST_NS
        self._presses = [at_ns for at_ns in self._presses if at_ns >= since_ns]
        if not self._presses:
            says_no("program", "it begins, and nobody has asked or pressed for it")
        del self._presses[:1]
        return True
