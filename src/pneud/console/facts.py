"""What a console is told of the daemon that it belongs to."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from pneud.config.models import Config
from pneud.safety.faults import BLOCKS_ARM, FAULT_CURES, FAULT_NAMES


class RunFacts(NamedTuple):
    """What stays the same while a daemon runs."""

    config: Config
    path: Path  # of the configuration
    text: str  # of the configuration, as it was loaded
    bus: str
    note: str  # one line, for example how the bus was chosen
    log_path: str
    log_is_given: bool = False  # this very file, not a folder in which each run has its own
    hindrance: Callable[[], str] = str  # why no run could begin with what the files say now; "" for nothing
    own: Callable[[str], str] = str  # what a text of the file says of this axis: all of it, where it is alone

    def page(self) -> dict[str, Any]:
        """What a screen has to know beside the records, as JSON has it."""
        c = self.config
        limits, cylinder = c.limits, c.cylinder
        bitrate = c.bus.bitrate_bit_s
        return {
            "name": c.name,
            "bus": self.bus,
            "rate_hz": c.loop.rate_hz,
            "travel_min_mm": limits.travel_min_m / 1e-3,
            "travel_max_mm": limits.travel_max_m / 1e-3,
            "u_max_v": c.valve.u_max_v,
            "note": self.note,
            "faults": list(FAULT_NAMES),
            "cures": list(FAULT_CURES),
            "blocks_arm": BLOCKS_ARM,
            "log": self.log_path,
            "sync": bool(c.bus.sync),
            "inputs": list(c.bus.inputs),
            "outputs": list(c.bus.outputs),
            "limits": {
                "speed_m_s": limits.speed_m_s,
                "supply_min_pa": limits.supply_min_pa,
                "supply_max_pa": limits.supply_max_pa,
                "area_1_m2": cylinder.piston_area_1_m2,
                "area_2_m2": cylinder.piston_area_2_m2,
                "atmosphere_pa": c.gas.atmosphere_pa,
                "dead_zone_v": c.valve.dead_zone_v,
                "bitrate_bit_s": bitrate if math.isfinite(bitrate) else None,
                "quota_bytes": c.log.quota_mb * 1e6,
            },
        }
