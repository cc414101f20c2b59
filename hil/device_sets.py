"""Rigs of other people's devices, made by a function: a DBC and a mapping each, every lack and oddity."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from pneud import resources
from pneud.config.toml import changed_text

EXTENDED = 0x80000000
FORMATS = 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","StandardCAN_FD";\n'
FORMATS += 'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";\n'
HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: CONTROLLER NODE\n\n'


class Message(NamedTuple):
    """A message of a DBC: `signals` are "NAME [MUX] start|length@order sign (factor,offset) unit"."""

    number: int
    length: int
    signals: tuple[str, ...]
    fd: bool = False  # its frames are of CAN FD

    def text(self, name: str) -> str:
        lines = [f"BO_ {self.number} {name}: {self.length} NODE"]
        for signal in self.signals:
            *names, place, factor, unit = signal.split(" ")
            lines.append(f' SG_ {" ".join(names)} : {place} {factor} [0|0] "{unit}" CONTROLLER')
        return "\n".join(lines) + "\n\n"


class DeviceSet(NamedTuple):
    """What is connected: messages, which signals fill which values, and what the messages have besides."""

    messages: dict[str, Message]
    signals: dict[str, Any]
    guards: Mapping[str, Any] = MappingProxyType({})
    more: Mapping[str, Any] = MappingProxyType({})  # of `[bus]`
    floats: tuple[str, ...] = ()  # "number NAME kind" for SIG_VALTYPE_

    def dbc(self) -> str:
        """The DBC."""
        types = (f"SIG_VALTYPE_ {one};\n" for one in self.floats)
        fd = [f'BA_ "VFrameFormat" BO_ {m.number} 1;\n' for m in self.messages.values() if m.fd]
        formats = FORMATS + "".join(fd) if fd else ""
        return HEAD + "".join(m.text(name) for name, m in self.messages.items()) + formats + "".join(types)

    def write(self, folder: Path, name: str, base: str = "virtual.toml", **change: Any) -> Path:
        """The configuration as a file, with its DBC beside it: another one's, with these devices."""
        (folder / f"{name}.dbc").write_text(self.dbc())
        bus = {"dbc": f"{name}.dbc", "signals": self.signals, "messages": dict(self.guards), **self.more}
        text = (resources.configs() / base).read_text()
        (folder / f"{name}.toml").write_text(changed_text(text, {"name": name, "bus": bus} | change))
        return folder / f"{name}.toml"


ENC = Message(0x1A0, 8, (
    "Pos 0|32@1- (0.001,0) mm", "Status 32|8@1+ (1,0) ", "Age 40|8@1+ (10,0) us", "Cnt 48|8@1+ (1,0) ",
    "Crc 56|8@1+ (1,0) ",
))  # fmt: skip
AIR = Message(0x1A1, 8, (
    "A 0|16@1+ (20,0) Pa", "B 16|16@1+ (20,0) Pa", "S 32|16@1+ (20,0) Pa", "Cnt 48|8@1+ (1,0) ",
    "Crc 56|8@1+ (1,0) ",
))  # fmt: skip
VALVE = Message(0x1A2, 8, (
    "Out 0|16@1- (0.5,0) mV", "State 16|8@1+ (1,0) ", "Cnt 48|8@1+ (1,0) ", "Crc 56|8@1+ (1,0) ",
))  # fmt: skip
CMD = Message(0x2A0, 8, (
    "Volt 0|16@1- (0.0005,0) V", "On 16|8@1+ (1,0) ", "Seq 24|8@1+ (1,0) ", "Cnt 48|8@1+ (1,0) ",
    "Crc 56|8@1+ (1,0) ",
))  # fmt: skip
MESSAGES = {"ENC": ENC, "AIR": AIR, "VALVE": VALVE, "CMD": CMD}
SIGNALS: dict[str, Any] = {
    "position_m": "ENC.Pos", "status": "ENC.Status", "age_s": "ENC.Age",
    "p1_pa": "AIR.A", "p2_pa": "AIR.B", "supply_pa": "AIR.S",
    "applied_v": "VALVE.Out", "state": "VALVE.State",
    "voltage_v": "CMD.Volt", "enable": "CMD.On", "sequence": "CMD.Seq",
}  # fmt: skip
GUARDS = {name: {"counter": "Cnt", "crc": "Crc"} for name in MESSAGES}

# of nodes that any set may have beside its devices
INPUTS = Message(0x184, 2, (
    "Start 0|1@1+ (1,0) ", "Enable 1|1@1+ (1,0) ", "BrakeReleased 3|1@1+ (1,0) ", "Counter 8|8@1+ (1,0) ",
))  # fmt: skip
OUTPUTS = Message(0x204, 2, ("Brake 3|1@1+ (1,0) ", "Counter 8|8@1+ (1,0) "))
LOAD_CELL = Message(0x185, 8, ("Force 0|32@1- (0.01,0) N", "Counter 48|8@1+ (1,0) ", "Crc 56|8@1+ (1,0) "))
BESIDE = {
    "station.dbc": {"INPUTS": INPUTS, "OUTPUTS": OUTPUTS},
    "load-cell.dbc": {"LOAD_CELL": LOAD_CELL},
}
"""What a scenario that names one of these databases takes besides the axis's own devices."""


def with_beside(one: DeviceSet, dbc: str) -> DeviceSet:
    """The set, and what else is on the bus of a scenario that names a database."""
    return one._replace(messages=one.messages | BESIDE[dbc])


def lacking(*keys: str, **more: Any) -> dict[str, Any]:
    """The signals without these, and with others."""
    return {key: signal for key, signal in SIGNALS.items() if key not in keys} | more


def without(*messages: str) -> dict[str, Any]:
    """What is left of the messages' guards."""
    return {name: guard for name, guard in GUARDS.items() if name not in messages}


def _bare() -> DeviceSet:
    messages = {
        "ENC": Message(0x2AA | EXTENDED, 4, ("Pos 7|32@0- (1,0) ",)),
        "PA": Message(0x18FF1001 | EXTENDED, 2, ("P 0|16@1+ (0.0005,0) bar",)),
        "PB": Message(0x18FF1002 | EXTENDED, 2, ("P 0|16@1+ (0.0005,0) bar",)),
        "CMD": Message(0x18FF1003 | EXTENDED, 2, ("Volt 0|16@1- (1,0) mV",)),
    }
    signals = {
        "position_m": {"signal": "ENC.Pos", "m_per_count": 1e-6}, "voltage_v": "CMD.Volt",
        "p1_pa": {"signal": "PA.P", "gauge": True}, "p2_pa": {"signal": "PB.P", "gauge": True},
    }  # fmt: skip
    return DeviceSet(messages, signals, more={"sync": False}, floats=())


def _muxed(counter: bool) -> DeviceSet:
    air = Message(0x1A1, 4, (
        "Which M 0|8@1+ (1,0) ", "A m0 8|16@1+ (20,0) Pa", "B m1 8|16@1+ (20,0) Pa", "S m7 8|16@1+ (20,0) Pa",
        "Cnt 24|8@1+ (1,0) ",
    ))  # fmt: skip
    guards = without("AIR") | ({"AIR": {"counter": "Cnt"}} if counter else {})
    return DeviceSet(MESSAGES | {"AIR": air}, SIGNALS, guards)


def _apart(first: int) -> DeviceSet:
    """Every value in a message of its own."""
    small = {
        "POS": Message(first, 4, ("V 0|32@1- (1,0) um",)),
        "STATUS": Message(first + 1, 1, ("V 0|8@1+ (1,0) ",)),
        "PA": Message(first + 2, 3, ("V 0|16@1+ (20,0) Pa", "Cnt 16|4@1+ (1,0) ")),
        "PB": Message(first + 3, 2, ("V 0|16@1+ (20,0) Pa",)),
        "PS": Message(first + 4, 2, ("V 0|16@1+ (20,0) Pa",)),
        "OUT": Message(first + 5, 2, ("V 0|16@1- (0.5,0) mV",)),
        "STATE": Message(first + 6, 1, ("V 0|8@1+ (1,0) ",)),
        "CMD": CMD,
    }
    keys = ("position_m", "status", "p1_pa", "p2_pa", "supply_pa", "applied_v", "state")
    signals = {key: f"{name}.V" for key, name in zip(keys, small, strict=False)}
    own = {key: SIGNALS[key] for key in ("voltage_v", "enable", "sequence")}
    guards = {"CMD": GUARDS["CMD"], "PA": {"counter": "Cnt"}}
    return DeviceSet(small, signals | own, guards, {"bitrate_bit_s": float("inf")})


def _big_endian() -> DeviceSet:
    enc = ENC._replace(signals=("Pos 7|32@0- (0.001,0) mm", "Cnt 55|8@0+ (1,0) ", "Crc 63|8@0+ (1,0) "))
    air = AIR._replace(
        signals=("A 7|16@0+ (20,0) Pa", "B 23|16@0+ (20,0) Pa", "S 39|16@0+ (20,0) Pa", *AIR.signals[3:])
    )
    cmd = CMD._replace(signals=("Volt 7|16@0- (0.0005,0) V", *CMD.signals[1:]))
    return DeviceSet(MESSAGES | {"ENC": enc, "AIR": air, "CMD": cmd}, lacking("status", "age_s"), GUARDS)


def _floats() -> DeviceSet:
    messages = {
        "ENC": Message(0x1A0, 8, ("Pos 7|64@0- (1,0) m",)),
        "AIR": Message(0x1A1, 8, ("A 0|32@1- (1,0) bar", "B 32|32@1- (1,0) bar")),
        "CMD": Message(0x2A0, 5, ("Volt 0|32@1- (1,0) V", "On 32|8@1+ (1,0) ")),
    }
    keys = ("status", "age_s", "supply_pa", "applied_v", "state", "sequence")
    floats = ("416 Pos : 2", "417 A : 1", "417 B : 1", "672 Volt : 1")
    return DeviceSet(messages, lacking(*keys), floats=floats)


def _words() -> DeviceSet:
    """Control and status words, as of CiA 408."""
    valve = Message(0x1A2, 4, ("Word 0|16@1+ (1,0) ", "Out 16|16@1- (0.5,0) mV"))
    cmd = Message(0x2A0, 4, ("Control 0|16@1+ (1,0) ", "Volt 16|16@1- (0.0005,0) V"))
    state = {"signal": "VALVE.Word", "mask": 15, "values": {"8": 0, "11": 1, "15": 2, "1": 4}}
    enable = {"signal": "CMD.Control", "values": {"3": 0, "7": 1}}
    signals = lacking("sequence", state=state, enable=enable)
    return DeviceSet(MESSAGES | {"VALVE": valve, "CMD": cmd}, signals, without("VALVE", "CMD"))


def _one_for_all() -> DeviceSet:
    messages = {
        "ALL": Message(0x1A0, 8, (
            "Pos 0|24@1- (1,0) um", "A 24|14@1+ (80,0) Pa", "B 38|14@1+ (80,0) Pa", "Cnt 52|4@1+ (1,0) ",
            "Crc 56|8@1+ (1,0) ",
        )),
        "CMD": CMD,
    }  # fmt: skip
    signals = lacking(
        "status",
        "age_s",
        "supply_pa",
        "applied_v",
        "state",
        position_m="ALL.Pos",
        p1_pa="ALL.A",
        p2_pa="ALL.B",
    )
    return DeviceSet(messages, signals, {"ALL": GUARDS["ENC"], "CMD": GUARDS["CMD"]})


def _profiles() -> DeviceSet:
    enc = ENC._replace(
        signals=(
            "Crc 0|8@1+ (1,0) ",
            "Cnt 8|4@1+ (1,0) ",
            "Status 12|4@1+ (1,0) ",
            "Pos 16|32@1- (0.001,0) mm",
        )
    )
    guards = GUARDS | {
        "ENC": GUARDS["ENC"] | {"protection": "e2e-p01", "data_id": 0x1234},
        "AIR": GUARDS["AIR"] | {"protection": "xor8"},
        "VALVE": GUARDS["VALVE"] | {"protection": "sum8", "counter_max": 200},
        "CMD": GUARDS["CMD"] | {"protection": "crc8-h2f"},
    }
    return DeviceSet(MESSAGES | {"ENC": enc}, lacking("age_s"), guards)


def _unipolar() -> DeviceSet:
    cmd = CMD._replace(signals=("Volt 0|16@1+ (0.0005,0) V", *CMD.signals[1:]))
    valve = VALVE._replace(signals=("Out 0|16@1+ (0.5,0) mV", *VALVE.signals[1:]))
    signals = lacking(
        voltage_v={"signal": "CMD.Volt", "offset": -5.0}, applied_v={"signal": "VALVE.Out", "offset": -5.0}
    )
    return DeviceSet(MESSAGES | {"CMD": cmd, "VALVE": valve}, signals, GUARDS)


def _two_encoders() -> DeviceSet:
    other = Message(0x1A3, 8, ("Pos 7|40@0- (0.1,0) um",))
    second = {"second_position_m": "ENC2.Pos"}
    return DeviceSet(MESSAGES | {"ENC2": other}, SIGNALS | second, GUARDS, {"encoders_apart_m": 0.0005})


def _wide() -> DeviceSet:
    enc = Message(0x1A0, 8, ("Pos 0|64@1- (-1E-9,0) m",))
    return DeviceSet(MESSAGES | {"ENC": enc}, lacking("status", "age_s"), without("ENC"))


def _extended() -> DeviceSet:
    sync = Message(0x18000080 | EXTENDED, 1, ("Cnt 0|8@1+ (1,0) ",))
    messages = {name: m._replace(number=m.number << 16 | EXTENDED) for name, m in MESSAGES.items()}
    return DeviceSet({"SYNC": sync, **messages}, SIGNALS | {"sync": "SYNC.Cnt"}, GUARDS)


def _flexible() -> DeviceSet:
    """All in one frame of CAN FD, and the command in a short one."""
    messages = {
        "ALL": Message(0x1A0, 32, (
            "Pos 0|64@1- (1E-9,0) m", "A 64|32@1- (1,0) Pa", "B 96|32@1- (1,0) Pa", "S 128|32@1- (1,0) Pa",
            "Out 160|16@1- (0.5,0) mV", "Status 176|8@1+ (1,0) ", "State 184|8@1+ (1,0) ",
            "Age 192|16@1+ (1,0) us", "Cnt 240|8@1+ (1,0) ", "Crc 248|8@1+ (1,0) ",
        ), fd=True),
        "CMD": CMD._replace(fd=True),
    }  # fmt: skip
    signals = {key: signal.replace("ENC.", "ALL.").replace("AIR.", "ALL.").replace("VALVE.", "ALL.")
               for key, signal in SIGNALS.items()}  # fmt: skip
    floats = ("416 A : 1", "416 B : 1", "416 S : 1")
    guards = {"ALL": GUARDS["ENC"], "CMD": GUARDS["CMD"]}
    return DeviceSet(messages, signals, guards, {"fd": True, "data_bitrate_bit_s": 4e6}, floats)


def _longest() -> DeviceSet:
    """A sensor box with the longest frames there are, big-endian, beside a classic valve."""
    messages = {
        "BOX": Message(0x1A0 << 16 | EXTENDED, 64, (
            "Pos 7|64@0- (1,0) m", "A 71|64@0- (1,0) bar", "B 391|64@0- (1,0) bar", "Cnt 483|12@0+ (1,0) ",
            "Crc 503|16@0+ (1,0) ",
        ), fd=True),
        "VALVE": VALVE, "CMD": CMD,
    }  # fmt: skip
    places = {"position_m": "BOX.Pos", "p1_pa": "BOX.A", "p2_pa": "BOX.B"}
    box = {"counter": "Cnt", "crc": "Crc", "protection": "crc16-ccitt"}
    guards = {"BOX": box, "VALVE": GUARDS["VALVE"], "CMD": GUARDS["CMD"]}
    number = messages["BOX"].number
    floats = tuple(f"{number} {name} : 2" for name in ("Pos", "A", "B"))
    rates = {"fd": True, "data_bitrate_bit_s": 2e6}
    return DeviceSet(messages, lacking("status", "age_s", "supply_pa", **places), guards, rates, floats)


def device_sets() -> dict[str, DeviceSet]:
    """All of them, by name."""
    counts = {"signal": "ENC.Pos", "counts_per_m": -1e6, "offset": 0.75}
    dp = AIR._replace(signals=("A 0|16@1+ (20,0) Pa", "D 16|16@1- (40,0) Pa", *AIR.signals[2:]))
    gauge = {
        key: {"signal": f"AIR.{s}", "gauge": True} for key, s in zip(("p1_pa", "p2_pa"), "AB", strict=True)
    }
    raw = ENC._replace(signals=("Pos 0|32@1- (1,0) ", *ENC.signals[1:]))
    states = {"signal": "VALVE.State", "values": {"0": 1, "1": 2}}
    return {
        "all-there": DeviceSet(MESSAGES, SIGNALS, GUARDS),
        "no-counter": DeviceSet(MESSAGES, SIGNALS, {name: {"crc": "Crc"} for name in MESSAGES}),
        "no-checksum": DeviceSet(MESSAGES, SIGNALS, {name: {"counter": "Cnt"} for name in MESSAGES}),
        "neither": DeviceSet(MESSAGES, SIGNALS),
        "no-age-no-status": DeviceSet(MESSAGES, lacking("age_s", "status"), GUARDS),
        "no-supply": DeviceSet(MESSAGES, lacking("supply_pa"), GUARDS),
        "no-valve-status": DeviceSet(
            {k: v for k, v in MESSAGES.items() if k != "VALVE"},
            lacking("applied_v", "state"),
            without("VALVE"),
        ),
        "valve-on-or-off": DeviceSet(MESSAGES, lacking("applied_v", state=states), GUARDS),
        "valve-voltage-only": DeviceSet(MESSAGES, lacking("state"), GUARDS),
        "gauge": DeviceSet(MESSAGES, SIGNALS | gauge, GUARDS),
        "difference": DeviceSet(MESSAGES | {"AIR": dp}, lacking("p2_pa", difference_pa="AIR.D"), GUARDS),
        "counts": DeviceSet(MESSAGES | {"ENC": raw}, SIGNALS | {"position_m": counts}, GUARDS),
        "extended": _extended(),
        "big-endian": _big_endian(),
        "floats": _floats(),
        "multiplexed": _muxed(counter=False),
        "multiplexed-counted": _muxed(counter=True),
        "apart": _apart(0x190),
        "words": _words(),
        "unipolar": _unipolar(),
        "wide": _wide(),
        "one-for-all": _one_for_all(),
        "profiles": _profiles(),
        "two-encoders": _two_encoders(),
        "free": DeviceSet(MESSAGES, SIGNALS, GUARDS, {"sync": False}),
        "bare": _bare(),
        "flexible": _flexible(),
        "longest": _longest(),
    }
