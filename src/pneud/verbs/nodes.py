"""CANopen nodes: what is on the bus, what they are configured to, and their identifiers."""

from __future__ import annotations

import json as json_
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import tomlkit
import typer

from pneud.bus.link import open_link, refuse_if_driven
from pneud.canopen import lss, objects
from pneud.canopen.keeper import check_library
from pneud.canopen.master import Configured, Master, NodeError, network_on
from pneud.canopen.plan import Plan, Step
from pneud.config.sections import ConfigError
from pneud.config.writing import rewrite
from pneud.loading import Loaded, bus_name, load, plans_of_nodes
from pneud.verbs import BusOption, FileArgument, JsonOption, VerbError

_SYNC_S = 0.1  # in which a daemon that runs sends one
OnBus = Annotated[str, typer.Option("--bus", metavar="BUS", help="socketcan:IF or unixcan:NAME.")]
NewId = Annotated[int, typer.Argument(metavar="ID", help="Identifier from now on.", min=1, max=127)]
_WORDS = [o.what for o in objects.IDENTITY]


def list_(bus: OnBus, json: JsonOption = False) -> int:
    """The nodes that answer on a bus, and who they are."""
    with _network(bus) as network:
        master = Master(network)
        found = [_about(master, node) for node in master.present()]
    lines = [
        f"node {n['id']}: {n['name'] or 'no name'}, {n['device']}, {_shown(n['identity'])}" for n in found
    ]
    _show({"bus": bus, "nodes": found}, json, "\n".join(lines) or f"{bus}: no node answers")
    return 0


def explain(file: FileArgument, json: JsonOption = False) -> int:
    """What nodes are configured to, object by object; asks nobody."""
    plans = _plans(load(file))
    told = [{"id": plan.node.id, "profile": plan.node.profile, "steps": _steps(plan)} for plan in plans]
    _show({"nodes": told}, json, "\n".join(line for plan in plans for line in _explained(plan)))
    return 0


def configure(
    file: FileArgument,
    bus: BusOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Read only: say what would be written.")] = False,
    save: Annotated[bool, typer.Option("--save", help="Have the nodes store it (0x1010).")] = False,
    json: JsonOption = False,
) -> int:
    """Configure the nodes of an axis and read all of it back, as the daemon does by itself; starts none.

    Returns:
        Exit status: 0, or 1 where one is not as it should be.
    """
    loaded = load(file)
    plans, channel = _plans(loaded), _named(bus, loaded)
    try:
        with _network(channel) as network:
            master = Master(network)
            if dry_run:
                return _differ(master, plans, json)
            found = master.configure(plans, save=save, start=False)
    except NodeError as e:
        return _failed(e, json)
    nodes = [_done(one) for one in found]
    lines = [f"node {one.node} ({one.profile}): {one.written} values written and read back" for one in found]
    _show({"ok": True, "saved": save, "nodes": nodes}, json, "\n".join([*lines, *_notes(found)]))
    return 0


def keep(file: FileArgument, bus: BusOption = None, json: JsonOption = False) -> int:
    """Write which devices they are into the configuration; others are refused from then on.

    The movement test has to be made anew: its proof holds for the devices that it was made with.
    """
    loaded = load(file)
    plans, channel = _plans(loaded), _named(bus, loaded)
    with _network(channel) as network:
        master = Master(network)
        found = {plan.node.id: master.identity(plan.node.id) for plan in plans}
    if silent := [node for node, identity in found.items() if identity[0] is None]:
        raise VerbError(f"node {silent[0]} does not answer; pneud nodes list says which do", 1)
    rewrite(loaded.path, lambda document: _put(document, found))
    nodes = [{"id": node, "identity": _named_parts(identity)} for node, identity in found.items()]
    lines = [f"node {node}: {_shown(_named_parts(identity))}" for node, identity in found.items()]
    _show({"config": str(loaded.path), "nodes": nodes}, json, "\n".join(lines))
    return 0


def scan(bus: OnBus, json: JsonOption = False) -> int:
    """Find nodes that have no identifier yet (LSS fastscan); takes seconds for each."""

    def told(identity: lss.Identity) -> None:
        if not json:
            print(_shown(_named_parts(identity)), flush=True)

    with _network(bus) as network:
        found = lss.scan(network, told)
    if json:
        _show({"bus": bus, "nodes": [_named_parts(identity) for identity in found]}, json, "")
    elif not found:
        print(f"{bus}: no node without an identifier, or none that can be found by fastscan")
    return 0


def set_id(
    new: NewId,
    bus: OnBus,
    of: Annotated[
        int | None,
        typer.Option(
            "--of", metavar="ID", help="Identifier that it has; none: the one without.", min=1, max=127
        ),
    ] = None,
    serial: Annotated[
        int | None,
        typer.Option("--serial", metavar="N", help="That stands on it, where several have one id."),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Give a node another identifier (LSS), and have it store that.

    Returns:
        Exit status: 0, or 1 where no node takes it.
    """
    with _network(bus) as network:
        identity = _meant(network, of, serial)
        lss.give(network, identity, new, before=of)
    _show(
        {"id": new, "identity": _named_parts(identity)}, json, f"node {new}: {_shown(_named_parts(identity))}"
    )
    return 0


VERBS = {
    "list": list_,
    "explain": explain,
    "configure": configure,
    "keep": keep,
    "scan": scan,
    "set-id": set_id,
}


def _meant(network: Any, of: int | None, serial: int | None) -> lss.Identity:
    """Which node is to have another identifier."""
    if of is None:
        found = lss.scan(network)
        if serial is not None:
            found = [identity for identity in found if identity[3] == serial]
        if len(found) != 1:
            several = f"{len(found)} nodes are without an identifier; name one by --serial"
            raise VerbError(several if found else "no node is without an identifier; name one by --of", 1)
        return found[0]
    parts = Master(network).identity(of)
    if None in parts[:3]:
        raise VerbError(f"node {of} does not say which device it is (0x1018); set its id at the device", 1)
    vendor, product, revision, own = (part or 0 for part in parts)
    return vendor, product, revision, own if serial is None else serial


@contextmanager
def _network(channel: str) -> Iterator[Any]:
    """The library's network on a bus that nobody drives."""
    check_library()
    with open_link(channel) as link:
        refuse_if_driven(
            link, (objects.SYNC_ID,), _SYNC_S, "a daemon runs there, which configures its nodes itself"
        )
    with network_on(channel) as network:
        yield network


def _plans(loaded: Loaded) -> tuple[Plan, ...]:
    if plans := plans_of_nodes(loaded):
        return plans
    raise ConfigError(f"{loaded.path}: has no [[bus.nodes]]; see docs/canopen.md")


def _named(bus: str | None, loaded: Loaded) -> str:
    channel = bus_name(bus, loaded.config)
    if channel == "auto":
        raise ConfigError(f"{loaded.path}: bus auto is for virtual runs; name the rig's bus with --bus")
    return channel


def _about(master: Master, node: int) -> dict[str, Any]:
    kind = master.read(node, objects.DEVICE_TYPE)
    profile = kind & 0xFFFF
    return {
        "id": node,
        "name": master.text(node, objects.DEVICE_NAME) or "no name",
        "device": f"CiA {profile}" if profile else "no profile",
        "identity": _named_parts(master.identity(node)),
    }


def _named_parts(identity: tuple[int | None, ...]) -> dict[str, int]:
    return {word: part for word, part in zip(_WORDS, identity, strict=True) if part is not None}


def _shown(identity: dict[str, int]) -> str:
    return "".join(
        f", {word} {part if word == 'serial' else f'0x{part:X}'}" for word, part in identity.items()
    )


def _steps(plan: Plan) -> list[dict[str, Any]]:
    return [
        {
            "object": step.object.address,
            "what": step.object.what,
            "value": step.value,
            "write": step.write,
            "why": step.why,
        }
        for step in plan.steps
    ]


def _explained(plan: Plan) -> Iterator[str]:
    yield f"{plan.name}: fills {', '.join(role for role in plan.node.filled if role != 'none')}"
    for message in plan.messages:
        carried = ", ".join(c.object.what for c in message.carried)
        way = "sends" if message.pdo.sent else "takes"
        yield f"  {way} 0x{message.can_id:03X} ({message.pdo.name}): {carried}"
    for step in plan.steps:
        value = f"0x{step.value:X}" if step.object.type.size == 4 else f"{step.value}"
        way, why = "=" if step.write else "has to be", f": {step.why}" if step.why else ""
        yield f"  {step.object} {way} {value}{why}"


def _differ(master: Master, plans: tuple[Plan, ...], json: bool) -> int:
    """Say what nodes have otherwise."""
    found = [(plan, step, has) for plan in plans for step, has in master.compare(plan)]
    told = []
    for plan, step, has in found:
        o = step.object
        told.append(
            {"id": plan.node.id, "object": o.address, "what": o.what, "has": has, "wanted": step.value}
        )
    _show(
        {"ok": True, "dry_run": True, "differs": told},
        json,
        "\n".join(map(_otherwise, found)) or "nothing to write",
    )
    return 0


def _otherwise(found: tuple[Plan, Step, int | None]) -> str:
    plan, step, value = found
    shape = "0x{:X}".format if step.object.type.size == 4 else str
    has = "it does not say" if value is None else f"has {shape(value)}"
    return f"{plan.name}, {step.object}: {has}; {'gets' if step.write else 'has to be'} {shape(step.value)}"


def _failed(e: NodeError, json: bool) -> int:
    if json:
        _show(
            {"ok": False, "node": e.node, "object": e.object, "problem": e.problem, "cure": e.cure}, json, ""
        )
    else:
        print(f"pneud: {e}", file=sys.stderr)
    return 1


def _done(one: Configured) -> dict[str, Any]:
    parts = _named_parts(one.identity)
    return {
        "id": one.node,
        "profile": one.profile,
        "identity": parts,
        "written": one.written,
        "notes": list(one.notes),
    }


def _notes(found: list[Configured]) -> list[str]:
    return [note for one in found for note in one.notes]


def _put(document: Any, found: dict[int, tuple[int | None, ...]]) -> None:
    """Write identities into the nodes' tables."""
    for table in document["bus"]["nodes"]:
        own = tomlkit.inline_table()
        for word, part in _named_parts(found[table["id"]]).items():
            own.append(word, part)
        table["identity"] = own


def _show(reply: dict[str, Any], as_object: bool, words: str) -> None:
    print(json_.dumps({"schema": 1, **reply}) if as_object else words)
