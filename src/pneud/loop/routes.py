"""Frames on their way to the axes: to the one whose identifier they have, all others to every one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

from pneud.loop.turn import Turn
from pneud.signals import Frame


class Hearer(Protocol):
    """An axis that hears frames."""

    @property
    def turn(self) -> Turn:
        """The exchange."""

    @property
    def identifiers(self) -> Collection[int]:
        """Of frames that are this axis's alone."""


class Routes:
    """Who hears what; an axis alone hears everything."""

    __slots__ = ("_alone", "_known", "_turns")

    def __init__(self, lanes: Sequence[Hearer]) -> None:
        self._turns = tuple(lane.turn for lane in lanes)
        self._alone = self._turns[0] if len(lanes) == 1 else None
        self._known: dict[int, tuple[Turn, ...]] = {}
        for lane in lanes:
            for can_id in lane.identifiers:
                self._known[can_id] = (*self._known.get(can_id, ()), lane.turn)

    def open(self, came: list[Frame]) -> None:
        """A tick begins, with what has come since the last one's; takes it out of the list."""
        if self._alone is not None:
            self._alone.open(came)
            came.clear()
            return
        heard: dict[Turn, list[Frame]] = {turn: [] for turn in self._turns}
        for frame in came:
            for turn in self._known.get(frame.can_id, self._turns):
                heard[turn].append(frame)
        for turn, frames in heard.items():
            turn.open(frames)
        came.clear()

    def feed(self, came: list[Frame]) -> None:
        """Hand on what has come, in order; takes it out of the list."""
        if self._alone is not None:
            self._alone.feed(came)
        else:
            known, turns = self._known, self._turns
            for frame in came:
                for turn in known.get(frame.can_id, turns):
                    turn.feed((frame,))
        came.clear()
