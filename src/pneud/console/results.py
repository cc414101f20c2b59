"""Results of requests, printed for a person or as one JSON object."""

from __future__ import annotations

import json as json_
import sys
from collections.abc import Callable
from typing import Any

from pneud.console.client import Client, RefusedError


def ask(
    socket: str | None,
    json: bool,
    verb: str,
    words: Callable[[dict[str, Any]], str] = lambda reply: str(reply.get("state", "done")),
    axis: str | None = None,
    **fields: Any,
) -> int:
    """Ask for one thing and print what came of it: for people `words`, as the state that the axis is in then.

    Returns:
        Exit status: 0, or 1 where it was refused.

    Raises:
        PlaceError: no daemon to talk to.
    """
    with Client(socket, axis) as client:
        try:
            reply = client.ask(verb, **fields)
        except RefusedError as e:
            return refused(e, json)
    show(reply, json, words(reply))
    return 0


def show(reply: dict[str, Any], json: bool, words: str) -> None:
    """Print a result, with the axis that it is of."""
    axis = (
        f"{', '.join(reply['axes'])}: "
        if "axes" in reply
        else f"{reply['axis']}: "
        if "axis" in reply
        else ""
    )
    print(json_.dumps({"schema": 1, "ok": True, **reply}) if json else f"{axis}{words}")


def refused(e: RefusedError, json: bool) -> int:
    """Print a refusal.

    Returns:
        Exit status: 1.
    """
    if json:
        axis = {"axis": e.axis} if e.axis else {}
        print(json_.dumps({"schema": 1, "ok": False, **axis, "error": e.error}))
    else:
        print(f"pneud: {e.axis}: {e}" if e.axis else f"pneud: {e}", file=sys.stderr)
    return 1
