"""What a seed comes to: how a run goes, what goes wrong in it and when, and what operators do."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from pneud.prove.canbus import ALL
from pneud.view.viewers import TOPICS

RATES_HZ = (100.0, 200.0)
PERIOD_S = 0.005  # that troubles are measured by
TROUBLES = ("drop", "twice", "late", "behind", "shuffle", "stamp", "corrupt")
VICTIMS = ("daemon", "recorder", "keeper", "console", "rig")
CANOPEN_KEEPER = "nodes"
NMT_COMMANDS = (1, 2, 128, 129, 130)
CONFIGURED_S = 1.5  # that it takes at least until nodes are
_RIG_BEGINS_S = 0.1  # the manager starts the daemon somewhat later
_GOOD, _BAD = "good", "bad"
TWO_AXES, SERVICE, SHOWN = 0.25, 0.4, 0.1  # of the seeds; of the rest, the last
VIEWED = 0.06  # of the seeds
NODES = 0.04  # of the seeds with one axis
PRESSED = 0.12  # likewise
TIED = 0.35  # of the seeds with two
IMPATIENT = 9  # the operator who waits for no reply for long
NAMES = ("x", "y")
TWO, LED, GANTRY, CANOPEN = "two-axes.toml", "led.toml", "gantry.toml", "canopen.toml"
AXES = {TWO: NAMES, LED: NAMES, GANTRY: ("x1", "x2")}
OTHERS = (
    (("stop", "stop"), ("stop", "stop")),
    (("centre", "stop"), ("go_on", "go_on")),
    (("go_on", "stop"), ("stop", "centre")),
)
_OF_ALL = ("arm", "disarm", "clear", "hold", "mark", "stop", "restart", "leave")


class Item(NamedTuple):
    """One thing that happens."""

    at_s: float
    kind: str
    what: dict[str, Any]

    def __str__(self) -> str:
        said = " ".join(f"{name}={_said(value)}" for name, value in self.what.items())
        return f"{self.at_s:.4f} s {self.kind} {said}".rstrip()


class Plan(NamedTuple):
    """A run."""

    seed: int
    length_s: float  # until all is well again, and it is told to end
    virtual: bool  # it arms by itself, and brings its rig along
    unproven: bool  # the movement test is to be passed
    detail: str  # of the log
    slowness: float  # factor of what steps take
    rate_hz: float  # of the loop
    items: tuple[Item, ...]
    service: bool = False  # of a manager that has a watchdog
    shown: bool = False  # on a screen
    viewed: bool = False  # by viewers, who have a server
    pressed: bool = False  # there is a start input, which begins programs
    others: tuple[tuple[str, str], ...] = ()  # of several axes: `[faults.others]` of each, centre and stop
    file: str = "virtual.toml"  # of the configuration

    @property
    def axes(self) -> int:
        """How many there are."""
        return max(1, len(self.others))

    def only(self, numbers: Collection[int]) -> Plan:
        """The run in which but some of it happens."""
        return self._replace(items=tuple(item for n, item in enumerate(self.items) if n in numbers))


def plan_of(seed: int) -> Plan:
    """What a seed comes to; nothing else decides."""
    rng = random.Random(f"plan {seed}")
    length_s = rng.uniform(2.0, 9.0)
    virtual = rng.random() < 0.25
    # of each seed some kinds of faults only, so that what one hides is found without it
    kinds = [kind for kind in _FAULTS if rng.random() < 0.35]
    items = []
    for kind in kinds:
        for _ in range(rng.choice((1, 1, 2, 3))):
            items.append(Item(rng.uniform(_RIG_BEGINS_S, length_s), kind, _FAULTS[kind](rng)))
    at_once = _at_once(rng, length_s) if rng.random() < 0.2 else []
    items += at_once
    for operator in range(rng.choice((0, 1, 1, 1, 2, 2, 3)) if virtual else rng.choice((1, 1, 1, 2, 2, 3))):
        items += _operations(rng, operator, length_s)
    if rng.random() < 0.3:
        items += _nuisance(rng, length_s)
    items += _asked_meanwhile(random.Random(f"asks {seed}"), items, at_once)
    plan = Plan(
        seed,
        length_s,
        virtual,
        not virtual and rng.random() < 0.3,
        rng.choice(("compact", "compact", "full")),
        rng.choice((0.5, 1.0, 1.0, 3.0, 10.0)),
        rng.choice(RATES_HZ),
        tuple(sorted(items, key=_at)),
    )
    more = random.Random(f"more {seed}")
    what = random.Random(f"rig {seed}")
    if more.random() < TWO_AXES:
        file = what.choice((LED, GANTRY)) if what.random() < TIED else TWO
        plan = _with_two_axes(more, plan, file)
    elif what.random() < NODES:
        plan = _with_nodes(what, plan)
    elif (presses := random.Random(f"presses {seed}")).random() < PRESSED:
        plan = plan._replace(pressed=True, items=_pressed(presses, plan))
    if (viewed := random.Random(f"viewed {seed}")).random() < VIEWED:
        plan = plan._replace(viewed=True, items=_viewed(viewed, plan))
    if more.random() < SERVICE:
        return plan._replace(service=True, items=_with(more, plan, "deaf", 0.5))
    if more.random() < SHOWN:
        return plan._replace(shown=True, items=_with(more, plan, "terminal", 0.5))
    return plan


def _with(rng: random.Random, plan: Plan, kind: str, share: float) -> tuple[Item, ...]:
    """What happens, perhaps with something of a kind."""
    more = []
    while rng.random() < share:
        at_s = rng.uniform(_RIG_BEGINS_S, plan.length_s)
        does = kind if kind == "deaf" else rng.choice((kind, "kill", "stop"))
        what: dict[str, Any] = {"for_s": rng.uniform(0.05, 0.9)}
        if does != kind:
            what |= {"who": "screen", "step": _at_step(rng)}
        more.append(Item(at_s, does, what))
    return tuple(sorted((*plan.items, *more), key=_at))


def _viewed(rng: random.Random, plan: Plan) -> tuple[Item, ...]:
    """What happens, with what somebody looks at, and what becomes of who serves it."""
    more, names = [], AXES.get(plan.file, ("",))
    for _ in range(rng.choice((2, 4, 8))):
        above = f"/{name}" if (name := rng.choice(names)) else ""
        what = {"who": rng.randrange(2), "topic": above + rng.choice(TOPICS), "on": rng.random() < 0.7}
        more.append(Item(rng.uniform(_RIG_BEGINS_S, plan.length_s), "look", what))
    while rng.random() < 0.4:
        what = {"who": "viewers", "step": _at_step(rng), "for_s": rng.uniform(0.05, 2.0)}
        more.append(Item(rng.uniform(_RIG_BEGINS_S, plan.length_s), rng.choice(("kill", "stop")), what))
    return tuple(sorted((*plan.items, *more), key=_at))


def _pressed(rng: random.Random, plan: Plan) -> tuple[Item, ...]:
    """What happens, with programs that are handed over, and somebody who presses start, mostly meanwhile.

    Much of all else is left out: it takes from programs, and keeps them from being taken.
    """
    found = [item for item in plan.items if rng.random() < (0.2 if item.kind == "operator" else 0.5)]
    who = IMPATIENT + 1
    for _ in range(rng.choice((1, 2, 4))):
        at_s, steps = rng.uniform(0.5, plan.length_s), rng.choice((1, 20, 60, 120))
        if rng.random() < 0.8:
            found.append(Item(at_s - 0.2, "operator", {"who": who, "verb": "arm", "unproven": True}))
        tree = {"schema": 1, "record": [_record(rng) for _ in range(steps)]}
        what = {"who": who, "verb": "run", "program": tree}
        if rng.random() < 0.6:
            what["load"] = True
        else:
            what |= {
                "record": rng.randint(1, steps),
                "cycles": rng.randint(1, 3),
                "attended": rng.random() < 0.5,
            }
        found.append(Item(at_s, "operator", what))
        if rng.random() < 0.3:
            found.append(Item(at_s + rng.uniform(0.0, 0.6), "operator", {"who": who, "verb": "leave"}))
        for _ in range(rng.choice((0, 1, 2, 3))):
            press_s = at_s + rng.uniform(-0.1, 0.1 + steps / plan.rate_hz)
            if rng.random() < 0.4:  # in the middle of what comes, none comes for a while
                halts = {"who": "console", "step": 0, "for_s": rng.uniform(0.1, 0.4)}
                found.append(Item(press_s - rng.uniform(0.0, 0.05), rng.choice(("stop", "kill")), halts))
            found.append(Item(press_s, "press", {"for_s": rng.uniform(0.02, 0.2)}))
    return tuple(sorted(found, key=_at))


def _record(rng: random.Random) -> dict[str, Any]:
    if rng.random() < 0.5:
        return {"do": "wait", "for_s": round(rng.uniform(0.0, 0.1), 3)}
    return {
        "do": "goto",
        "to_mm": round(rng.uniform(100.0, 800.0), 1),
        "class": rng.choice(("exact", "fast")),
    }


def _with_nodes(rng: random.Random, plan: Plan) -> Plan:
    """The plan, for an axis whose nodes have to be configured first; and what happens to these."""
    items = []
    for item in plan.items:
        what = item.what
        if what.get("trouble") == "corrupt":  # of what has no checksum but CAN's, nobody could tell
            what = what | {"trouble": "drop"}
        items.append(item._replace(what=what, at_s=item.at_s + CONFIGURED_S * (item.kind == "operator")))
    length_s = plan.length_s + CONFIGURED_S
    for _ in range(rng.choice((0, 1, 2, 4))):
        kind = rng.choice(("slave", "slave", "nmt", "kill", "stop"))
        what = {"who": CANOPEN_KEEPER, "step": _at_step(rng), "for_s": rng.choice((0.03, 0.4, 2.0))}
        if kind == "slave":
            what = {"node": rng.randrange(3), "boot_s": rng.choice((0.0, 0.03, 0.5)) * rng.random()}
        elif kind == "nmt":
            what = {"node": rng.randrange(4), "command": rng.choice(NMT_COMMANDS)}
        items.append(Item(rng.uniform(_RIG_BEGINS_S, length_s), kind, what))
    items.sort(key=_at)
    return plan._replace(length_s=length_s, items=tuple(items), file=CANOPEN)


def _with_two_axes(rng: random.Random, plan: Plan, file: str) -> Plan:
    """The plan, with each thing happening to one of two axes, or to both."""
    items, names = [], AXES[file]
    for item in plan.items:
        what = dict(item.what)
        if item.kind != "operator":
            what["axis"] = rng.choice((0, 1, 1, ALL))
        elif what["verb"] == "goto" and rng.random() < 0.3:
            x_mm = {name: rng.uniform(100.0, 800.0) for name in names}
            what = {"who": what["who"], "verb": "goto_all", "axes": x_mm}
        elif what["verb"] not in _OF_ALL or rng.random() < 0.3:
            what["axis"] = rng.choice(names)
        items.append(item._replace(what=what))
    if rng.random() < 0.6:  # what one of them cannot do without, for longer than it is borne
        what = {"trouble": "drop", "for_s": 0.2, "share": 1.0, "by_s": 0.0, "towards": ""}
        at_s = rng.uniform(0.3, plan.length_s)
        items.append(Item(at_s, "bus", {**what, "axis": rng.randrange(len(names))}))
    items.sort(key=_at)
    others = rng.choice(OTHERS)
    return plan._replace(items=tuple(items), others=others, rate_hz=RATES_HZ[0], file=file)


def _at(item: Item) -> float:
    return item.at_s


def _said(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


_PAIRS = (
    *(("daemon", "console"), ("daemon", "console"), ("daemon", "recorder"), ("recorder", "daemon")),
    *(("keeper", "console"), ("console", "keeper"), ("rig", "daemon")),
)


def _at_once(rng: random.Random, length_s: float) -> list[Item]:
    """One process stands while another one dies."""
    at_s = rng.uniform(_RIG_BEGINS_S, length_s)
    stands, dies = rng.choice(_PAIRS)
    stop = {"who": stands, "step": 0, "for_s": rng.choice((0.02, 0.045, 0.045, 1.0)) * rng.uniform(0.7, 1.0)}
    kill = {"who": dies, "step": 0}
    return [Item(at_s, "stop", stop), Item(at_s + rng.uniform(0.0, 0.01), "kill", kill)]


def _asked_meanwhile(rng: random.Random, items: list[Item], at_once: list[Item]) -> list[Item]:
    """Somebody asks for something while the loop stands and its console is about to die, or when it has."""
    found = []
    if at_once and (at_once[0].what["who"], at_once[1].what["who"]) == ("daemon", "console"):
        goes = {"x_mm": rng.uniform(100.0, 800.0), "attended": True}
        verb, fields = rng.choice((("arm", {}), ("goto", goes)))
        at_s = rng.uniform(at_once[0].at_s, at_once[1].at_s)
        found.append(Item(at_s, "operator", {"who": 0, "verb": verb, **fields}))
    for item in items:
        if item.kind in ("kill", "stop") and item.what["who"] == "console" and rng.random() < 0.3:
            asks = {"who": IMPATIENT, "verb": "arm", "patience_s": rng.uniform(0.05, 0.5)}
            found.append(Item(item.at_s + rng.uniform(0.0, 0.5), "operator", asks))
    return found


def _victim(rng: random.Random) -> str:
    return rng.choice(VICTIMS)


def _at_step(rng: random.Random) -> int:
    """How many of its steps a victim takes before it is hit; 0: at once, wherever it waits."""
    return rng.choice((0, rng.randrange(40), rng.randrange(2000)))


def _bus(rng: random.Random) -> dict[str, Any]:
    kind = rng.choice(TROUBLES)
    by_s = {
        "late": PERIOD_S * rng.randint(1, 5),
        "behind": PERIOD_S * rng.randint(1, 5),
        "shuffle": rng.uniform(0.0, 2.0 * PERIOD_S),
        "stamp": rng.choice((-6.0, 6.0)),
    }.get(kind, 0.0)
    return {
        "trouble": kind,
        "for_s": rng.choice((PERIOD_S, 0.03, 0.2, 1.0)) * rng.uniform(0.5, 1.5),
        "share": rng.choice((0.01, 0.1, 0.5, 1.0)),
        "by_s": by_s,
        "towards": rng.choice(("", "loop", "rig")),
    }


_FAULTS: dict[str, Callable[[random.Random], dict[str, Any]]] = {
    "bus": _bus,
    "interface": lambda rng: {"state": rng.choice(("down", "full")), "for_s": rng.uniform(0.002, 0.5)},
    "babble": lambda rng: {
        "id": rng.choice(("command", "sync", "answer", "emcy", "other")),
        "for_s": rng.uniform(0.01, 0.3),
        "every_s": rng.choice((0.0003, 0.002, 0.01)),
    },
    "echo": lambda rng: {"for_s": rng.uniform(0.01, 0.5), "by_s": rng.choice((0.0005, 0.002, 0.004))},
    "node": lambda rng: {"node": rng.randrange(3)},
    "kill": lambda rng: {"who": _victim(rng), "step": _at_step(rng)},
    "stop": lambda rng: {
        "who": _victim(rng),
        "step": _at_step(rng),
        "for_s": rng.choice((PERIOD_S, 0.02, 0.06, 0.3, 3.0)) * rng.uniform(0.5, 1.5),
    },
    "clock": lambda rng: {"by_s": rng.choice((-3600.0, -6.0, -0.001, 0.001, 6.0, 86400.0))},
    "disk": lambda rng: {
        "state": rng.choice(("full", "failing", "short", "forgets", "slow", "removed")),
        "for_s": rng.uniform(0.05, 3.0),
        "room": rng.choice((0, 1, rng.randrange(200_000))),
    },
    "power": lambda _: {},
    "hangup": lambda rng: {"file": rng.choice((_GOOD, _BAD, "other", "gone"))},
    "terminate": lambda rng: {"step": _at_step(rng)},
}


def _operations(rng: random.Random, operator: int, length_s: float) -> list[Item]:
    """What an operator does: most of the time something that makes sense."""
    found = []
    at_s = rng.uniform(0.2, 1.0)

    def does(verb: str, **fields: Any) -> None:
        found.append(Item(at_s, "operator", {"who": operator, "verb": verb, **fields}))

    if rng.random() < 0.7:
        does("arm", unproven=True)
        at_s += 0.05
    while at_s < length_s:
        draw = rng.random()
        if draw < 0.25:
            does("arm", **({"unproven": True} if rng.random() < 0.3 else {}))
        elif draw < 0.45:
            does("goto", x_mm=rng.uniform(100.0, 800.0), attended=rng.random() < 0.3)
            at_s = _perhaps_leaves(rng, found, at_s)
        elif draw < 0.52:
            does("jog", velocity_mm_s=rng.uniform(-200.0, 200.0), lease_s=rng.uniform(0.05, 0.9))
        elif draw < 0.60:
            does("track", what="reference", attended=rng.random() < 0.3)
            at_s = _perhaps_leaves(rng, found, at_s)
        elif draw < 0.90:
            does(rng.choice(("clear", "clear", "hold", "stop", "disarm", "status", "status", "tune_get")))
        elif draw < 0.93:
            does("mark", text="a remark")
        elif draw < 0.95:
            does("tune_set", gains={"k1": rng.uniform(80_000.0, 100_000.0)})
        elif draw < 0.96:
            does("force", force_n=rng.uniform(-80.0, 80.0))
        elif draw < 0.97:
            does("restart")
        elif draw < 0.98:
            does("tune_reload")
        else:
            does("leave")
        at_s += rng.expovariate(1.0 / rng.choice((0.02, 0.3, 0.8)))
    return found


def _perhaps_leaves(rng: random.Random, found: list[Item], at_s: float) -> float:
    """Who has begun an attended motion may go in the middle of it; when the next thing is done."""
    last = found[-1]
    if not last.what["attended"] or rng.random() < 0.6:
        return at_s
    at_s += rng.uniform(0.05, 0.5)
    found.append(Item(at_s, "operator", {"who": last.what["who"], "verb": "leave"}))
    return at_s + 0.7


def _nuisance(rng: random.Random, length_s: float) -> list[Item]:
    """Clients that are of no use."""
    return [
        Item(
            rng.uniform(0.3, length_s),
            "client",
            {"does": rng.choice(("garbage", "mute", "half", "crowd")), "size": rng.randrange(1, 40_000)},
        )
        for _ in range(rng.randint(1, 3))
    ]
