"""CANopen nodes as a configuration has them, and the frames that follow from them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from pneud.config.sections import Resolution, Section

GENERATED = "nodes"  # as bus.dbc: made of the nodes
Unsigned = Annotated[int, Field(ge=0, le=0xFFFF_FFFF)]
Index = Annotated[int, Field(ge=0x1000, le=0xFFFF)]
Byte = Annotated[int, Field(ge=0, le=255)]
NodeId = Annotated[int, Field(ge=1, le=127)]
Number = Literal["bool", "i8", "i16", "i32", "u8", "u16", "u32", "i64", "u64"]
Profile = Literal["encoder406", "analog404", "analog401", "valve408"]
Role = Literal["position", "p1", "p2", "supply", "valve", "none"]
Unit = Literal["Pa", "hPa", "kPa", "mbar", "bar"]

_ROLES: dict[str, tuple[Role, ...]] = {
    "encoder406": ("position",),
    "analog404": ("p1", "p2", "supply"),
    "analog401": ("p1", "p2", "supply"),
    "valve408": ("valve",),
}
_PDO = {"encoder406": 2, "analog404": 1, "analog401": 2, "valve408": 1}
ANALOG = ("analog404", "analog401")


class IdentityConfig(Section):
    """Which device it is (0x1018); what is given has to be so."""

    vendor: Unsigned | None = None
    product: Unsigned | None = None
    revision: Unsigned | None = None
    serial: Unsigned | None = None


class WriteConfig(Section):
    """One more value to be written before the node is started, and read back."""

    index: Index  # of the object
    sub: Byte = 0  # its sub-index
    value: int  # what it is to be
    type: Number | None = None  # none: as the EDS has it


class WatchConfig(Section):
    """Another node whose heartbeat this one watches."""

    node: NodeId  # whose
    timeout_ms: Annotated[int, Field(ge=1, le=0xFFFF)]  # after which it is lost


class NodeConfig(Section):
    """One CANopen node of the axis; what it is configured to before anything is armed."""

    id: NodeId  # its CANopen identifier
    profile: Profile  # what it is, by CiA's device profiles
    eds: str = ""  # beside this file, or one of pneud's; "": the profile's
    roles: tuple[Role, ...] = ()  # of its channels, in order; []: position; p1, p2, supply; valve
    pdo: Annotated[int, Field(ge=1, le=4)] | None = None  # that carries them; none: as the profile has it
    heartbeat_ms: Annotated[int, Field(ge=1, le=20_000)] = 100  # that it sends
    heartbeat_timeout_ms: Annotated[float, Field(ge=1, le=60_000)] | None = None  # none: three of them
    watches: tuple[WatchConfig, ...] = ()  # other nodes whose heartbeat it watches
    identity: IdentityConfig = IdentityConfig()
    write: tuple[WriteConfig, ...] = ()  # more that it is to have
    step_m: Annotated[Resolution, Field(gt=0)] = 1e-6  # of an encoder
    unit: Unit = "mbar"  # of analog404
    digits: Annotated[int, Field(ge=0, le=6)] = 0  # of analog404, behind the unit's point
    range_pa: tuple[float, float] = (0.0, 1.0e6)  # of analog401: pressures at 0 and 32767
    full_scale: Annotated[int, Field(ge=100, le=32767)] = 16384  # of a valve: setpoint at valve.u_max_v
    control_mode: Annotated[int, Field(ge=-128, le=127)] = 1  # of a valve
    dead_band: Literal["off", "valve"] = "off"  # who makes up for it, if not pneud
    deadline: bool = True  # a valve watches that commands come; false: it cannot

    @model_validator(mode="after")
    def _roles_of_profile(self) -> NodeConfig:
        possible = {*_ROLES[self.profile], "none"}
        if wrong := [role for role in self.roles if role not in possible]:
            raise ValueError(
                f"{self.profile} has no {', '.join(wrong)}; it has {', '.join(_ROLES[self.profile])}"
            )
        if self.range_pa[0] >= self.range_pa[1]:
            raise ValueError("range_pa must rise")
        if self.pdo == 1 and self.profile == "encoder406":
            raise ValueError("pdo 1 of an encoder is that of its events; use 2")
        return self

    @property
    def filled(self) -> tuple[Role, ...]:
        """The roles of its channels, in order."""
        return self.roles or _ROLES[self.profile]

    @property
    def carrier(self) -> int:
        """Number of the PDO that carries them."""
        return self.pdo or _PDO[self.profile]

    @property
    def patience_ms(self) -> float:
        """For how long its heartbeat may be missing."""
        return self.heartbeat_timeout_ms or 3.0 * self.heartbeat_ms

    @property
    def message(self) -> str:
        """The name of what it sends in every tick."""
        return f"NODE{self.id}_TPDO{self.carrier}"

    @property
    def command(self) -> str:
        """The name of what a valve is sent in every tick."""
        return f"NODE{self.id}_RPDO1"


SIGNALS: dict[str, dict[str, str]] = {
    "encoder": {"position_m": "Position"},
    "pressure": {"p1_pa": "P1", "p2_pa": "P2", "supply_pa": "Supply"},
    "valve_status": {"applied_v": "Applied", "state": "State"},
    "valve_command": {"voltage_v": "Voltage", "enable": "Enable"},
}


def check_nodes(nodes: tuple[NodeConfig, ...]) -> None:
    """Make sure that each role is filled once.

    Raises:
        ValueError: it is not, or two nodes have the same identifier.
    """
    ids = [node.id for node in nodes]
    if twice := sorted({i for i in ids if ids.count(i) > 1}):
        raise ValueError(f"node {twice[0]} is there twice; give one another id: pneud nodes set-id")
    for role in ("position", "p1", "p2", "supply", "valve"):
        found = [node.id for node in nodes for r in node.filled if r == role]
        if len(found) != 1:
            how = f"{len(found)} times, by nodes {', '.join(map(str, found))}" if found else "by no node"
            raise ValueError(f"the role {role} is filled {how}; look at roles")
    if len({node.id for node in nodes for r in node.filled if r in ("p1", "p2", "supply")}) > 1:
        raise ValueError("p1, p2 and supply have to come from one node")


def frames_of(nodes: tuple[NodeConfig, ...]) -> dict[str, Any]:
    """`[bus.frames]` as it follows from the nodes; to be checked by `check_nodes` first."""

    def by(role: Role) -> NodeConfig:
        return next(node for node in nodes if role in node.filled)

    def frame(node: NodeConfig, signals: str, message: str, *, heard: bool = True) -> dict[str, Any]:
        found: dict[str, Any] = {
            "message": message,
            "signals": SIGNALS[signals],
            "counter": None,
            "crc": None,
        }
        if heard:
            found |= {"node": node.id, "heartbeat_timeout_ms": node.patience_ms}
        return found

    encoder, pressure, valve = by("position"), by("p1"), by("valve")
    return {
        "sync": {"message": "SYNC", "counter": None, "crc": None},
        "encoder": frame(encoder, "encoder", encoder.message),
        "pressure": frame(pressure, "pressure", pressure.message),
        "valve_status": frame(valve, "valve_status", valve.message),
        "valve_command": frame(valve, "valve_command", valve.command, heard=False),
    }
