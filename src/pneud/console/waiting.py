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
UNDER_WAY, ARRIVED, PRESSING = "moving", "holding", "pressing"


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
    return _until(Arrival(order, x_mm, clock(), tolerance_mm, timeout_s), client, clock, pause)


def wait_for_force(
    client: Client,
    order: int,
    force_n: float,
    timeout_s: float | None = None,
    clock: Callable[[], float] = time.monotonic,
    pause: Callable[[float], None] = time.sleep,
) -> dict[str, Any]:
    """Wait until the piston's force is as asked for.

    Args:
        client: of the console that has taken the order.
        order: number in its reply.
        force_n: that was asked for.
        timeout_s: from now; None for that of the axis, which then stops.
        clock: seconds.
        pause: lets so many seconds go by.

    Returns:
        The status with which it is.

    Raises:
        RefusedError: as in `wait`.
    """
    return _until(Reaching(order, force_n, clock(), timeout_s), client, clock, pause)


def _until(
    arrival: Arrival, client: Client, clock: Callable[[], float], pause: Callable[[float], None]
) -> dict[str, Any]:
    while True:
        try:
            status = client.ask("status")
        except PlaceError as e:
            raise arrival.gone(e) from None
        if arrival.looks(status, now_s := clock()):
            return status
        pause(arrival.pause_s(now_s))


class Arrival:
    """An order under way, and whether it has come to its end; told how the axis is again and again."""

    def __init__(
        self,
        order: int,
        x_mm: float,
        now_s: float,
        tolerance_mm: float | None = None,
        timeout_s: float | None = None,
        words: str = "",
        under_way: tuple[str, ...] = (UNDER_WAY,),
    ) -> None:
        """As in `wait`.

        Args:
            order: number in the reply to the order.
            x_mm: where the load is to go.
            now_s: by the clock that `looks` has, too.
            tolerance_mm: of the error; None for the configured tolerances.
            timeout_s: from now; None for some seconds from the end of the reference.
            words: for messages; empty for those of a goto.
            under_way: states on the way.
        """
        self._order, self._x_mm, self._tolerance_mm = order, x_mm, tolerance_mm
        self._until_s = now_s + timeout_s if timeout_s is not None else math.inf
        self._within_s = math.inf
        self._words = words or f"goto {x_mm:g} mm"
        self._states = (*under_way, ARRIVED)

    def gone(self, e: PlaceError) -> RefusedError:
        """The daemon does not answer any more."""
        return RefusedError({"type": "gone", "message": f"{self._words}: {e}"})

    def looks(self, status: dict[str, Any], now_s: float) -> bool:
        """Whether the load is there.

        Raises:
            RefusedError: it does not come there, as in `wait`.
        """
        words, axis, tolerance_mm = self._words, str(status.get("axis", "")), self._tolerance_mm
        if (status["silent_s"] or 0.0) > SILENT_S:
            text = f"{words}: the loop has been silent for {status['silent_s']:.1f} s"
            raise RefusedError({"type": "gone", "message": text}, axis)
        if status["silent_s"] is not None:
            self._check(status)
            if status["state"] == ARRIVED and self._until_s == math.inf:
                self._until_s = now_s + SETTLE_S
            near = _is_near(status, tolerance_mm)
            self._within_s = min(self._within_s, now_s) if near else math.inf
            if near and (tolerance_mm is None or now_s - self._within_s >= STEADY_S):
                return True
        if now_s >= self._until_s:
            stands = "" if status["position_mm"] is None else f"; it is at {status['position_mm']:.3f} mm"
            text = f"{words}: not in position in time{stands}"
            raise RefusedError({"type": "timeout", "message": text}, axis)
        return False

    def pause_s(self, now_s: float) -> float:
        """Until the next look."""
        return min(LOOK_S, max(0.0, self._until_s - now_s))

    def _check(self, status: dict[str, Any]) -> None:
        """Raise the reason for which an order does not come to its end."""
        latched = [fault for fault in status["faults"] if fault["latched"]]
        last = status["order"]
        elsewhere = status["state"] == ARRIVED and abs(status["reference_mm"] - self._x_mm) > SAME_MM
        if latched:
            kind, text = "fault", f"fault {latched[0]['name']}: {latched[0]['cure']}"
        elif last is None or last["number"] != self._order:
            kind, text = "replaced", f"replaced by {last['words'] if last else 'another command'}"
        elif elsewhere:
            kind, text = "replaced", f"the axis holds at {status['reference_mm']:.3f} mm"
        elif status["state"] not in self._states:
            kind, text = "stopped", f"the axis is {status['state']}"
        else:
            return
        raise RefusedError({"type": kind, "message": f"{self._words}: {text}"}, str(status.get("axis", "")))


class Reaching(Arrival):
    """A force that was asked for, and whether it is there."""

    def __init__(self, order: int, force_n: float, now_s: float, timeout_s: float | None = None) -> None:
        """As in `wait_for_force`; `now_s` by the clock that `looks` has, too."""
        super().__init__(order, math.nan, now_s, None, timeout_s, f"force {force_n:g} N", (PRESSING,))

    def looks(self, status: dict[str, Any], now_s: float) -> bool:
        """As of an arrival; where the load holds, it has not begun to press."""
        return super().looks(status, now_s) and status["state"] == PRESSING


def _is_near(status: dict[str, Any], tolerance_mm: float | None) -> bool:
    if tolerance_mm is None:
        return bool(status["in_position"])
    return status["state"] == ARRIVED and abs(float(status["error_mm"])) <= tolerance_mm
