"""What a screen says of an axis beside its records; apart from the screen, so that it costs no imports."""

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple, Protocol


class Cause(Protocol):
    """What is wrong first."""

    @property
    def words(self) -> str:
        """One sentence."""

    @property
    def cure(self) -> str:
        """What a person can do."""


def _no_cause(_: Collection[str]) -> Cause | None:
    return None


class ScreenInfo(NamedTuple):
    """What stays the same while an axis runs; what is not known is NaN."""

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
    learnt: Mapping[str, Mapping[str, Any]] | None = None  # as in the status, values by name
    mileage: Mapping[str, Any] | None = None  # as in the status
    blocks_arm: int = 0  # bits of the faults that keep an axis from being armed
    first_cause: Callable[[Collection[str]], Cause | None] = _no_cause  # of faults by their names
    speed_m_s: float = math.nan  # the most that is allowed
    supply_min_pa: float = math.nan
    supply_max_pa: float = math.nan
    area_1_m2: float = math.nan  # of the piston
    area_2_m2: float = math.nan
    atmosphere_pa: float = math.nan
    dead_zone_v: float = 0.0  # of the valve
    bitrate_bit_s: float = math.inf
    quota_bytes: float = 0.0  # of the logs; 0 for no bound
    elsewhere: str = ""  # the command that shows the same in another terminal
    others: str = ""  # the other axes of the daemon, and how they are
    inputs: tuple[str, ...] = ()  # names, by bits
    outputs: tuple[str, ...] = ()


def info_of(
    fields: Mapping[str, Any], first_cause: Callable[[Collection[str]], Cause | None], elsewhere: str = ""
) -> ScreenInfo:
    """What a daemon tells of itself to those who `attach`; an older one tells less."""
    f, mm = fields, 1e-3
    more = f.get("limits") or {}

    def known(name: str, otherwise: float = math.nan) -> float:
        value = more.get(name)
        return otherwise if value is None else float(value)

    return ScreenInfo(
        name=f["name"],
        bus=f["bus"],
        rate_hz=f["rate_hz"],
        travel_min_m=f["travel_min_mm"] * mm,
        travel_max_m=f["travel_max_mm"] * mm,
        u_max_v=f["u_max_v"],
        note=f["note"],
        fault_names=tuple(f["faults"]),
        log_path=f["log"],
        sync=f["sync"],
        inputs=tuple(f.get("inputs", ())),
        outputs=tuple(f.get("outputs", ())),
        blocks_arm=int(f.get("blocks_arm", 0)),
        first_cause=first_cause,
        speed_m_s=known("speed_m_s"),
        supply_min_pa=known("supply_min_pa"),
        supply_max_pa=known("supply_max_pa"),
        area_1_m2=known("area_1_m2"),
        area_2_m2=known("area_2_m2"),
        atmosphere_pa=known("atmosphere_pa"),
        dead_zone_v=known("dead_zone_v", 0.0),
        bitrate_bit_s=known("bitrate_bit_s", math.inf),
        quota_bytes=known("quota_bytes", 0.0),
        elsewhere=elsewhere,
    )
