"""What a client says to a daemon, step by step: the same for one that blocks and one that awaits.

A dialogue is a generator: it yields what to ask, and gets the reply; or how long to wait, and gets nothing.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pneud.config.sections import ConfigError
from pneud.console import profiles
from pneud.console.client import RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.profiles import ProfileError
from pneud.console.tuning import name_of
from pneud.console.waiting import Arrival, Reaching
from pneud.control.reference import Septic
from pneud.study.running import doubts_running

LEASE_S = 0.3
RENEWED_S = 0.1
MOVING, TRACKING = "moving", "tracking"

Samples = tuple[Sequence[float], Sequence[float]]
"""Times [s] and positions [mm]."""


class Ask(NamedTuple):
    """A request to the daemon."""

    verb: str
    fields: dict[str, Any]


class Pause(NamedTuple):
    """Time to let go by."""

    s: float


T = TypeVar("T")
Step = Ask | Pause
Dialogue = Generator[Step, Any, T]


def asked(verb: str, **fields: Any) -> Dialogue[dict[str, Any]]:
    """One request; what is None is left out."""
    reply: dict[str, Any] = yield Ask(verb, {k: v for k, v in fields.items() if v is not None})
    return reply


def arrived(arrival: Arrival | Reaching) -> Dialogue[dict[str, Any]]:
    """Wait until the load is where an order leads, or presses as it says, and how it is then."""
    while True:
        try:
            status: dict[str, Any] = yield Ask("status", {})
        except PlaceError as e:
            raise arrival.gone(e) from None
        if arrival.looks(status, now_s := time.monotonic()):
            return status
        yield Pause(arrival.pause_s(now_s))


def goto(
    x_mm: float, wait: bool, tolerance_mm: float | None, timeout_s: float | None, **bounds: float | None
) -> Dialogue[dict[str, Any]]:
    """Go to a position, and wait there."""
    begun_s = time.monotonic()
    reply = yield from asked("goto", x_mm=x_mm, **bounds)
    if not wait:
        return reply
    return (yield from arrived(Arrival(reply["order"], x_mm, begun_s, tolerance_mm, timeout_s)))


def force(
    force_n: float, wait: bool, between_mm: tuple[float, float] | None, **bounds: float | None
) -> Dialogue[dict[str, Any]]:
    """Press, and wait until the force is there."""
    low_mm, high_mm = (None, None) if between_mm is None else between_mm
    begun_s = time.monotonic()
    reply = yield from asked("force", force_n=force_n, low_mm=low_mm, high_mm=high_mm, **bounds)
    if not wait:
        return reply
    return (yield from arrived(Reaching(reply["order"], force_n, begun_s)))


def jog(velocity_mm_s: float, for_s: float) -> Dialogue[dict[str, Any]]:
    """Move for a time, then hold."""
    end_s = time.monotonic() + for_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        yield from asked("jog", velocity_mm_s=velocity_mm_s, lease_s=LEASE_S)
        yield Pause(min(RENEWED_S, left_s))
    return (yield from asked("hold"))


def track(what: str | Path | Samples | None, wait: bool) -> Dialogue[dict[str, Any]]:
    """Follow the configured reference, or a profile to its end."""
    if what is None:
        return (yield from asked("track", what="reference"))
    limits = (yield from asked("status"))["limits"]
    pieces = _pieces(what)
    bounds = profiles.bounds_in(limits)
    try:
        profiles.check(pieces, bounds, limits["min_mm"] * 1e-3, limits["max_mm"] * 1e-3)
    except ProfileError as e:
        raise RefusedError({"type": "beyond_limits", "message": f"track: {e}"}) from None
    for fields in profiles.uploads(pieces):
        yield from asked("upload", **fields)
    reply = yield from asked("track", what="profile")
    if not wait:
        return reply
    ends = Arrival(
        reply["order"],
        1e3 * profiles.end_m(pieces),
        time.monotonic(),
        words="track profile",
        under_way=(TRACKING, MOVING),
    )
    return (yield from arrived(ends))


def _pieces(what: str | Path | Samples) -> list[Septic]:
    try:
        if isinstance(what, str | Path):
            return profiles.from_file(Path(what))
        times_s, positions_mm = what
        return profiles.from_samples([*map(float, times_s)], [1e-3 * float(x) for x in positions_mm])
    except ProfileError as e:
        raise ConfigError(str(e)) from None


def tune(values: dict[str, float | str]) -> Dialogue[tuple[dict[str, Any], list[str]]]:
    """Change gains; those that run then, and what `pneud check` would say of them."""
    if values:
        yield from asked("tune_set", gains={name_of(key): value for key, value in values.items()})
    reply = yield from asked("tune_get")
    gains = reply["gains"]
    return gains, doubts_running(gains, Path(reply["config"])) if values else []
