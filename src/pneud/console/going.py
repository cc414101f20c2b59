"""Waits until a program has come to its end, by asking how it is again and again."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.waiting import LOOK_S, SILENT_S

ENDED, STOPPED = "ended", "stopped"
GO_ON = "pneud run --resume goes on"


def go_through(
    client: Client | Sharing,
    order: int,
    words: str,
    tell: Callable[[dict[str, Any]], None],
    pause: Callable[[float], None] = time.sleep,
) -> dict[str, Any]:
    """Wait for the end.

    Args:
        client: of the console that has taken the order.
        order: number in its reply.
        words: for messages.
        tell: is told how far it is.
        pause: lets so many seconds go by.

    Returns:
        The status with which it has ended.

    Raises:
        RefusedError: it does not come to its end: `fault`, `replaced`, `stopped` or `gone`.
    """
    while True:
        try:
            status = client.ask("status")
        except PlaceError as e:
            raise RefusedError({"type": "gone", "message": f"{words}: {e}"}) from None
        if (status["silent_s"] or 0.0) > SILENT_S:
            text = f"{words}: the loop has been silent for {status['silent_s']:.1f} s"
            raise RefusedError({"type": "gone", "message": text}, str(status.get("axis", "")))
        program = status["program"]
        _check(status, program, order, words)
        if program["stage"] == ENDED:
            return status
        tell(program)
        pause(LOOK_S)


class Sharing:
    """Asks for the status of several axes that go through one program: that of the one that matters."""

    def __init__(self, client: Client, axes: list[str]) -> None:
        self._client = client
        self._axes = axes

    def ask(self, verb: str) -> dict[str, Any]:
        """The status of the first one with a fault, else of one whose program does not go on."""
        told = self._client.ask(verb)
        each = [{**told["axes"][name], "axis": name} for name in self._axes]

        def matters(status: dict[str, Any]) -> int:
            latched = any(fault["latched"] for fault in status["faults"])
            stage = (status["program"] or {}).get("stage")
            return 2 * latched + (stage == STOPPED)

        return max(each, key=matters)


def _check(status: dict[str, Any], program: dict[str, Any] | None, order: int, words: str) -> None:
    """Raise the reason for which a program does not come to its end."""
    last, latched = status["order"], [fault for fault in status["faults"] if fault["latched"]]
    where = f"{words}: {in_words(program)}" if program is not None else words
    if latched:
        kind, text = "fault", f"{where}: fault {latched[0]['name']}: {latched[0]['cure']}"
        text += f"; when it is cleared and armed, {GO_ON}"
    elif last is None or last["number"] != order:
        kind, text = "replaced", f"{where}: replaced by {last['words'] if last else 'another command'}"
        if program is not None and program["stage"] == STOPPED:
            text += f"; {GO_ON}"
    elif program is None or program["stage"] == STOPPED:
        kind, text = "stopped", f"{where}: stopped; the axis is {status['state']}; {GO_ON}"
    else:
        return
    raise RefusedError({"type": kind, "message": text}, str(status.get("axis", "")))


def in_words(program: dict[str, Any]) -> str:
    """Where a program is."""
    of = f" of {program['of']}" if program["of"] else ""
    label = f", {program['label']!r}" if program["label"] else ""
    does = f" ({program['words']}{label})" if program["words"] else ""
    return f"record {program['record']}{of}{does}"
