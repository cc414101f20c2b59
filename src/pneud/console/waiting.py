"""Waits until an axis has come to where it was sent, by asking how it is again and again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError

LOOK_S = 0.05
SETTLE_S = 5.0  # that a load has at most, once its reference has come to the end
SILENT_S = 5.0  # that a loop may be, before it counts as gone
STEADY_S = 0.1  # that an error has to stay within a tolerance of the caller's
SAME_MM = 1e-3  # a reference no further from a target stands there
UNDER_WAY, ARRIVED = "moving", "holding"


def wait(
    client: Client,
    order: int,
    x_mm: float,
    tolerance_mm: float | None = None,
    timeout_s: float | None = None,
    clock: Callable[[], float] = time.monotonic,
    pause: Callable[[float], None] = time.sleep,
) -> dict[str, Any]:
    """Wait until the load is in position.

    Args:
        client: of the console that has taken the order.
        order: number in its reply.
        x_mm: where the load is to go.
        tolerance_mm: of the error; None for the configured tolerances.
        timeout_s: from now; None for some seconds from the end of the reference.
        clock: seconds.
        pause: lets so many seconds go by.

    Returns:
        The status with which it is.

    Raises:
        RefusedError: it does not come there: `fault`, `replaced`, `stopped`, `gone` or `timeout`.
    """
    words = f"goto {x_mm:g} mm"
    until_s = clock() + timeout_s if timeout_s is not None else math.inf
    within_s = math.inf
    while True:
        try:
            status = client.ask("status")
        except PlaceError as e:
            raise RefusedError({"type": "gone", "message": f"{words}: {e}"}) from None
        now_s = clock()
        if (status["silent_s"] or 0.0) > SILENT_S:
            text = f"{words}: the loop has been silent for {status['silent_s']:.1f} s"
            raise RefusedError({"type": "gone", "message": text}, str(status.get("axis", "")))
        if status["silent_s"] is not None:
            _check(status, order, x_mm, words)
            if status["state"] == ARRIVED and until_s == math.inf:
                until_s = now_s + SETTLE_S
            near = _is_near(status, tolerance_mm)
            within_s = min(within_s, now_s) if near else math.inf
            if near and (tolerance_mm is None or now_s - within_s >= STEADY_S):
                return status
        if now_s >= until_s:
            stands = "" if status["position_mm"] is None else f"; it is at {status['position_mm']:.3f} mm"
            text = f"{words}: not in position in time{stands}"
            raise RefusedError({"type": "timeout", "message": text}, str(status.get("axis", "")))
        pause(min(LOOK_S, max(0.0, until_s - now_s)))


def _is_near(status: dict[str, Any], tolerance_mm: float | None) -> bool:
    if tolerance_mm is None:
        return bool(status["in_position"])
    return status["state"] == ARRIVED and abs(float(status["error_mm"])) <= tolerance_mm


def _check(status: dict[str, Any], order: int, x_mm: float, words: str) -> None:
    """Raise the reason for which an order does not come to its end."""
    latched = [fault for fault in status["faults"] if fault["latched"]]
    last = status["order"]
    elsewhere = status["state"] == ARRIVED and abs(status["reference_mm"] - x_mm) > SAME_MM
    if latched:
        kind, text = "fault", f"fault {latched[0]['name']}: {latched[0]['cure']}"
    elif last is None or last["number"] != order:
        kind, text = "replaced", f"replaced by {last['words'] if last else 'another command'}"
    elif elsewhere:
        kind, text = "replaced", f"the axis holds at {status['reference_mm']:.3f} mm"
    elif status["state"] not in (UNDER_WAY, ARRIVED):
        kind, text = "stopped", f"the axis is {status['state']}"
    else:
        return
    raise RefusedError({"type": kind, "message": f"{words}: {text}"}, str(status.get("axis", "")))
