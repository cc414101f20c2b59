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
    client: Client,
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


def _check(status: dict[str, Any], program: dict[str, Any] | None, order: int, words: str) -> None:
    """Raise the reason for which a program does not come to its end."""
    last, latched = status["order"], [fault for fault in status["faults"] if fault["latched"]]
    where = f"{words}: {in_words(program)}" if program is not None else words
    if latched:
        kind, text = "fault", f"{where}: fault {latched[0]['name']}: {latched[0]['cure']}"
        text += f"; when it is cleared and armed, {GO_ON}"
    elif last is None or last["number"] != order:
        kind, text = "replaced", f"{where}: replaced by {last['words'] if last else 'another command'}"
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
