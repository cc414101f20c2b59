"""CANopen nodes as a configuration has them, and the frames that follow from them."""

from typing import Annotated, Any, Literal, Self

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
    guard: bool = False  # it is asked so often instead: node guarding, for devices without a heartbeat
    heartbeat_timeout_ms: Annotated[float, Field(ge=1, le=60_000)] | None = None  # none: three of them
    watches: tuple[WatchConfig, ...] = ()  # other nodes whose heartbeat it watches
    identity: IdentityConfig = IdentityConfig()
    write: tuple[WriteConfig, ...] = ()  # more that it is to have
    step_m: Annotated[Resolution, Field(gt=0)] = 1e-6  # of an encoder
    bits: Literal[16, 32] = 16  # of each input of analog404: 0x7130 or 0x9130
    unit: Unit = "mbar"  # of analog404
    digits: Annotated[int, Field(ge=0, le=6)] = 0  # of analog404, behind the unit's point
    range_pa: tuple[float, float] = (0.0, 1.0e6)  # of analog401: pressures at 0 and 32767
    full_scale: Annotated[int, Field(ge=100, le=32767)] = 16384  # of a valve: setpoint at valve.u_max_v
    control_mode: Annotated[int, Field(ge=-128, le=127)] = 1  # of a valve
    dead_band: Literal["off", "valve"] = "off"  # who makes up for it, if not pneud
    deadline: bool = True  # a valve watches that commands come; false: it cannot

    @model_validator(mode="after")
    def _roles_of_profile(self) -> Self:
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
    def wide(self) -> bool:
        """Its channels have 32 bits each."""
        return self.profile == "encoder406" or (self.profile == "analog404" and self.bits == 32)

    def sent(self) -> dict[str, tuple[Role, ...]]:
        """What it sends in every tick: messages by their names, with the roles of the channels in each."""
        most = 2 if self.wide else 4
        parts = (self.filled[at : at + most] for at in range(0, len(self.filled), most))
        return {f"NODE{self.id}_TPDO{number}": part for number, part in enumerate(parts, self.carrier)}

    @property
    def command(self) -> str:
        """The name of what a valve is sent in every tick."""
        return f"NODE{self.id}_RPDO1"


# status word of a CiA 408 valve, bits 0 … 4, as the axis has its state; what does not stand here is a fault:
# DISABLED, which is no centre, and local control
STATES = {8: 0, 0: 0, 11: 1, 15: 2, 3: 3, 1: 4}
HOLD_WORD, ACTIVE_WORD = 3, 7  # control words
ENABLES = {HOLD_WORD: 0, ACTIVE_WORD: 1}
SIGNALS = {"position": "Position", "p1": "P1", "p2": "P2", "supply": "Supply"}
_KEYS = {"position": "position_m", "p1": "p1_pa", "p2": "p2_pa", "supply": "supply_pa"}
_OPTIONAL = ("supply",)


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
        if len(found) > 1 or (not found and role not in _OPTIONAL):
            how = f"{len(found)} times, by nodes {', '.join(map(str, found))}" if found else "by no node"
            raise ValueError(f"the role {role} is filled {how}; look at roles")


def signals_of(nodes: tuple[NodeConfig, ...]) -> dict[str, Any]:
    """`[bus.signals]` as it follows from the nodes; to be checked by `check_nodes` first."""
    found: dict[str, Any] = {}
    for node in nodes:
        for message, roles in node.sent().items():
            if node.profile == "valve408":
                found["applied_v"] = f"{message}.Applied"
                found["state"] = {"signal": f"{message}.State", "values": STATES}
                found["voltage_v"] = f"{node.command}.Voltage"
                found["enable"] = {"signal": f"{node.command}.Enable", "values": ENABLES}
            else:
                found |= {_KEYS[role]: f"{message}.{SIGNALS[role]}" for role in roles if role != "none"}
    return found


def messages_of(nodes: tuple[NodeConfig, ...]) -> dict[str, Any]:
    """`[bus.messages]` as it follows from the nodes: whose heartbeat is awaited."""
    return {
        message: {"node": node.id, "heartbeat_timeout_ms": None if node.guard else node.patience_ms}
        for node in nodes
        for message, roles in node.sent().items()
        if any(role != "none" for role in roles)
    }
