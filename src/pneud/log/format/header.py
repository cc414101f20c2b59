"""What a log says about its run; apart from what writes it, so that it costs no imports."""

from pathlib import Path
from typing import Literal, NamedTuple

SNAPSHOT_S = 2.0  # how often a log gets the state of the axis, so that a replay can begin there

MILEAGE_BEFORE = "mileage_before"  # key of the set-up for what the axis had done before the run

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

    @property
    def switches(self) -> tuple[list[str], list[str]]:
        """Names of inputs and outputs, by their bits."""
        return self.extra.get("inputs", "").split(), self.extra.get("outputs", "").split()


class Rotation(NamedTuple):
    """How a log is split into parts, and what is kept of them."""

    path: Path  # of the first part
    part_bytes: int  # go on to the next part after so much; 0 for never
    part_ns: int  # or after so long; 0 for never
    quota_bytes: int  # all logs together; 0 for no bound
    folder: bool  # the quota is that of the axis' logs in the folder, else that of this run
    keep_before_ns: int  # what is kept around a fault
    keep_after_ns: int
