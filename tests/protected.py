"""A DBC whose encoder protects its frames by any rule, anywhere in the frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pneud.bus.codec import Codecs, codecs_from
from pneud.config.bus_tables import BusConfig

OTHERS = """
BO_ 128 SYNC: 1 CONTROLLER
 SG_ Counter : 0|8@1+ (1,0) [1|240] "" X

BO_ 386 PRESSURE: 8 X
 SG_ P1 : 0|16@1+ (20,0) [0|1310700] "Pa" CONTROLLER
 SG_ P2 : 16|16@1+ (20,0) [0|1310700] "Pa" CONTROLLER
 SG_ Supply : 32|16@1+ (20,0) [0|1310700] "Pa" CONTROLLER

BO_ 387 VALVE_STATUS: 8 X
 SG_ Applied : 0|16@1- (0.0005,0) [-5|5] "V" CONTROLLER
 SG_ State : 16|8@1+ (1,0) [0|4] "" CONTROLLER

BO_ 515 VALVE_COMMAND: 8 CONTROLLER
 SG_ Voltage : 0|16@1- (0.0005,0) [-5|5] "V" X
 SG_ Enable : 16|8@1+ (1,0) [0|1] "" X
 SG_ Sequence : 24|8@1+ (1,0) [1|240] "" X
"""
LAYOUTS = {  # where position, checksum, counter and the rest of a data identifier lie
    "in front": ("32|32@1-", "0|{bits}@1+", "16|{counter}@1+", "20|4@1+"),
    "behind": ("0|32@1-", "{last}|{bits}@1+", "32|{counter}@1+", "36|4@1+"),
    "big-endian": ("31|32@0-", "7|{bits}@0+", "{high}|{counter}@0+", "23|4@0+"),
    "in the middle of bytes": ("32|32@1-", "3|{bits}@1+", "20|{counter}@1+", "28|4@1+"),
}
IDS16 = tuple(range(1, 17))
RULES: dict[
    str, tuple[int, int, int, dict[str, Any]]
] = {  # bits of checksum and counter, last count, what else
    "pneud": (8, 4, 15, {}),
    "sae-j1850": (8, 8, 255, {}),
    "crc8-h2f": (8, 8, 255, {"counter_max": 254}),
    "crc16-ccitt": (16, 4, 15, {}),
    "xor8": (8, 4, 15, {"counter_max": 9}),
    "sum8": (8, 4, 15, {}),
    "e2e-p01": (8, 4, 14, {"data_id": 0x123}),
    "e2e-p01 alternating": (8, 4, 14, {"data_id": 0x123, "data_id_mode": "alternating"}),
    "e2e-p01 low": (8, 4, 14, {"data_id": 0x123, "data_id_mode": "low"}),
    "e2e-p01 nibble": (8, 4, 14, {"data_id": 0x123, "data_id_mode": "nibble", "data_id_nibble": "Nibble"}),
    "e2e-p02": (8, 4, 15, {"data_id": IDS16}),
    "e2e-p05": (16, 8, 255, {"data_id": 0x1234}),
}


def codecs_with(rule: str, layout: str = "in front", **changed: Any) -> Codecs:
    """An encoder that protects its frames so."""
    bits, counter, _, options = RULES[rule]
    filled = [
        place.format(bits=bits, counter=counter, last=64 - bits, high=16 + counter - 1)
        for place in LAYOUTS[layout]
    ]
    signals = [
        'Position : {} (1E-006,0) [0|0] "m" X',
        'Crc : {} (1,0) [0|0] "" X',
        'Counter : {} (1,0) [0|0] "" X',
    ]
    if "nibble" in rule:
        signals.append('Nibble : {} (1,0) [0|0] "" X')
    lines = (f" SG_ {text.format(place)}" for text, place in zip(signals, filled, strict=False))
    dbc = "\n".join(
        ('VERSION ""', "NS_ :", "BS_:", "BU_: CONTROLLER X", "BO_ 385 ENCODER: 8 X", *lines, OTHERS)
    )
    bare = {"counter": "", "crc": ""}
    encoder = {
        "signals": {"position_m": "Position"},
        "protection": rule.partition(" ")[0],
        **options,
        **changed,
    }
    bus = BusConfig.model_validate(
        {
            "frames": {
                "encoder": {"message": "ENCODER", **encoder},
                "pressure": {
                    "message": "PRESSURE",
                    "signals": {"p1_pa": "P1", "p2_pa": "P2", "supply_pa": "Supply"},
                    **bare,
                },
                "valve_status": {
                    "message": "VALVE_STATUS",
                    "signals": {"applied_v": "Applied", "state": "State"},
                    **bare,
                },
                "valve_command": {
                    "message": "VALVE_COMMAND",
                    "signals": {"voltage_v": "Voltage", "enable": "Enable", "sequence": "Sequence"},
                    **bare,
                },
            }
        }
    )
    return codecs_from(bus, Path("rules.dbc"), dbc.encode())
