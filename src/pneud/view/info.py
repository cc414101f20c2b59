"""What a screen says of an axis beside its records; apart from the screen, so that it costs no imports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class ScreenInfo(NamedTuple):
    """What stays the same while an axis runs."""

    name: str
    bus: str
    rate_hz: float
    travel_min_m: float
    travel_max_m: float
    u_max_v: float
    note: str  # one line, for example how the bus was chosen
    fault_names: tuple[str, ...]  # by bit
    log_path: str
    sync: bool = True  # every source answers every SYNC
    cures: tuple[str, ...] = ()  # by bit
    message: str = ""  # for the moment, in place of the note
    keys: str = "Ctrl-C stops"
    learnt: Mapping[str, Mapping[str, Any]] | None = None  # as in the status, values by name
