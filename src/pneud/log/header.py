"""What a log says about its run; apart from what writes it, so that it costs no imports."""

from __future__ import annotations

from typing import Literal, NamedTuple

Detail = Literal["compact", "full"]


class LogHeader(NamedTuple):
    """What a log says about its run before the first record."""

    name: str  # of the axis
    bus: str
    rate_hz: float
    detail: Detail
    config_name: str
    config_text: str
    dbc_name: str
    dbc: bytes
    fault_names: tuple[str, ...]  # by bit number
    realtime_offset_ns: int  # Unix time minus monotonic time, constant within a log; 0 for simulated time
    extra: dict[str, str]  # further metadata: the seed, the scenario, …
