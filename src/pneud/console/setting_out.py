"""Motions of several axes that wait until all stand: they come to rest first, and set out together then."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from pneud.console.connected import Connected
from pneud.console.orders import Desk
from pneud.console.protocol import Error, GotoAll, ProtocolError

PATIENCE_S = 4.0  # for axes that come to rest; a client waits a little longer for its reply


class _Later(NamedTuple):
    client: Connected
    message: GotoAll
    axes: tuple[int, ...]
    until_s: float


class SettingOut:
    """What waits for axes to stand."""

    def __init__(self, desks: Sequence[Desk], refuse: Callable[[Connected, ProtocolError], None]) -> None:
        """Nothing waits.

        Args:
            desks: of all axes.
            refuse: tells a client why a motion does not begin.
        """
        self._desks = desks
        self._refuse = refuse
        self._later: list[_Later] = []

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return bool(self._later)

    def add(self, client: Connected | None, message: GotoAll, now_s: float) -> None:
        """One more, whose axes come to rest; nothing of a client that has gone."""
        if client is not None:
            axes = tuple(n for n, desk in enumerate(self._desks) if desk.name in message.axes)
            self._later.append(_Later(client, message, axes, now_s + PATIENCE_S))

    def displace(self, axes: Sequence[int]) -> None:
        """Something else has been asked of these axes."""
        for one in [one for one in self._later if set(one.axes) & set(axes)]:
            self._later.remove(one)
            self._tell(one, ProtocolError(Error.DISPLACED, "goto: another command came first"))

    def drop(self, client: Connected) -> None:
        """A client has gone: nothing sets out for him."""
        self._later = [one for one in self._later if one.client is not client]

    def due(self, now_s: float) -> list[tuple[Connected, GotoAll]]:
        """What may begin now; whoever does not come to rest is told to those who wait for it."""
        found = []
        for one in list(self._later):
            moving = [axis for axis in one.axes if self._desks[axis].moves()]
            if not moving:
                self._later.remove(one)
                found.append((one.client, one.message))
            elif now_s > one.until_s:
                self._later.remove(one)
                name = self._desks[moving[0]].name
                text = f"goto: {name} has not come to rest within {PATIENCE_S:g} s"
                self._tell(one, ProtocolError(Error.LATE, text))
        return found

    def _tell(self, one: _Later, error: ProtocolError) -> None:
        error.number = one.message.id
        self._refuse(one.client, error)
