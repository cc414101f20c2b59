"""Oracles of programs: none begins but one that was handed over whole, and was asked or pressed for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pneud.console import programs
from pneud.loading import Loaded
from pneud.signals import Answer, RequestKind, Stage, Tick

if TYPE_CHECKING:
    from pneud.prove.judge import Judge

START = "start"
_TAKEN, _UNDER_WAY = int(Answer.TAKEN), int(Stage.UNDER_WAY)
_RECORD, _RUN = int(RequestKind.RECORD), int(RequestKind.RUN)


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
        self._whole: set[tuple[tuple[float, ...], ...]] = set()
        self.pressed = self.begun = 0
        self.begins()

    def begins(self) -> None:
        """A loop is about to run: an axis has no program yet."""
        self._steps: list[tuple[float, ...]] = []
        self._stage = int(Stage.NONE)

    def asks(self, tree: dict[str, Any]) -> None:
        """An operator is about to hand a program over."""
        steps = programs.compiled(tree, [self._facts]).steps[0]
        self._whole.add(tuple(tuple(map(float, step)) for step in steps))

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
        if tuple(self._steps) not in self._whole:
            self._judge.says_no(
                "program", f"{len(self._steps)} steps begin that nobody has handed over whole"
            )
        if taken is not None and taken.kind == _RUN:
            return False
        self.begun += 1
        if self.begun > self.pressed:
            self._judge.says_no("program", "it begins, and nobody has asked or pressed for it")
        return True
