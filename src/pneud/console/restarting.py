"""Waiting for the session that follows another one in the same daemon."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError

LOOK_S = 0.1


def next_session(
    connect: Callable[[], Client],
    before: str,
    patience_s: float,
    ready: Callable[[dict[str, Any]], bool] = lambda _: True,
) -> tuple[Client, dict[str, Any]]:
    """Wait for it.

    Args:
        connect: to the daemon.
        before: log of the session that has been asked to end.
        patience_s: how long.
        ready: whether its status is what is waited for.

    Returns:
        A connection to it, and its status.

    Raises:
        PlaceError: it has not come.
    """
    deadline_s = time.monotonic() + patience_s
    while time.monotonic() < deadline_s:
        time.sleep(LOOK_S)
        with contextlib.suppress(PlaceError, RefusedError), contextlib.ExitStack() as given_up:
            client = given_up.enter_context(connect())
            status = client.ask("status")
            if status["log"] != before and ready(status):
                given_up.pop_all()
                return client, status
    raise PlaceError(f"the daemon has ended, and not begun anew within {patience_s:g} s: see its journal")
