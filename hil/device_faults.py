"""The fault scenarios on rigs of other people's devices: what is noticed, and what is still safe.

    .venv/bin/python -m hil.device_faults -o out          # in simulated time, on every set
    .venv/bin/python -m hil.device_faults -o out --resume # go on with what was broken off; again what failed
    .venv/bin/python -m hil.device_faults --sample 1      # a tenth of it, drawn by a seed
    .venv/bin/python -m hil.device_faults --bus unixcan --sets words,bare --scenarios recorder-killed

A fault that the devices of a set cannot show is named by `pneud check` (`not noticed here`). Where a
scenario's fault is one of these and nothing shows, the run is judged by what is still safe: another fault
has taken the axis and it has come to rest, or it goes on where it should be; the load has met no end stop
harder than expected. All else is judged as on pneud's own devices.

Exit status: 0 where everything came as expected, 1 where something did not.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from hil.branching import Case, simulated
from hil.device_sets import BESIDE, DeviceSet, device_sets, with_beside

from pneud import resources
from pneud.bus.codec import DatabaseError
from pneud.config.sections import ConfigError
from pneud.config.toml import merged, toml_text
from pneud.loading import Loaded, load_axes
from pneud.scenario.files import load_scenario
from pneud.scenario.format import Babble, Scenario

_SENDERS = ("encoder", "pressure", "valve")
_OF_FRAMES = ("missing", "corrupt", "frozen", "late")  # faults of a frame, whoever's values are in it
_TAKEN = ("valve_rebooted", "valve_disagrees", "valve_active")  # of a valve that hears another controller
PNEUD = [sys.executable, "-m", "pneud.cli"]
PATIENCE_S = 90.0
OF_SET, OF_SCENARIO = 8, 3  # least number of scenarios on a set, and of sets for a scenario, in a sample
Otherwise = dict[str, tuple[str, ...]]
SYNC_ID, COMMAND_ID = 0x080, 0x203  # of pneud's own frames, which scenarios name
_OF_ROLE = {"encoder": "position_m", "pressure": "p1_pa", "valve_status": "state"}


FREE_MM = 1.0  # more where sensors run free: evidence comes between two ticks
TIMEOUT_MM = 25.0  # what the scenarios allow where a time-out has to pass
# where sensors run free: no tick waits for them, and none is asked for anything
_FREE: Otherwise = {
    "babble": ("pressure_missing",),  # which is noticed first
    "queue-full-for-long": ("send_failed", "send_blocked"),  # sensors go on without SYNC
}
# a quarter of a gauge pressure cannot be told by a number without a sign: the node has nothing to send
_GAUGE: Otherwise = {"pressure-wrong-scale": ("pressure_missing",)}
# longer frames leave gaps between those of the babbler, and the encoder's are the first in them
_LONG: Otherwise = {"babble": ("pressure_missing",)}
_BOX: Otherwise = {"babble": ("valve_missing",)}
# one of both encoders shows it
_TWO: Otherwise = dict.fromkeys(("encoder-drift", "encoder-slip", "encoder-wrong-scale"), ("encoder_error",))
OTHERWISE: dict[str, Otherwise] = {
    "free": _FREE, "bare": {**_FREE, **_GAUGE}, "gauge": _GAUGE, "extended": _LONG, "longest": _BOX,
    "two-encoders": _TWO,
}  # fmt: skip
"""Faults that a scenario leads to on a set, in the place of those that it expects."""
_SAYS_SO = ("babble", "daemon-stands", "queue-full-for-long", "send-blocked", "valve-timed-out")
BESIDES = {"canopen": dict.fromkeys(_SAYS_SO, ("emergency",))}
"""Faults that come along on a set: a CANopen valve that has waited for a command for too long says so."""
# a load that the brake stops between two samples is slower in the last one that moved; then the brake's
# switch tells, after brake.engage_s, brake.feedback_s and the 10 ms at which inputs are sent
_BRAKE = {"brake-drags": 110.0}
WITHIN_MS = {"free": _BRAKE, "bare": _BRAKE}
"""From the onset to 0 V, where a set takes longer to show it than others."""
DELAY_PERIODS = {"flexible": {"valve-late": 0.45}}
"""Of what a scenario delays, where frames come so early that a shorter delay leaves them in time."""
_FREELY = {"unsettled": "which frames are lost says nothing of ticks where sensors run free"}
_FULL = {"busy-bus": "its frames leave less of the bus free than this takes"}
_MUXED = _FULL | {"unsettled": "what has come of a multiplexed message waits for the rest of it"}
_ALONE = {"unsettled": "all is in one frame"}
LEFT_OUT: dict[str, dict[str, str]] = {
    "free": _FREELY, "bare": _FREELY, "extended": _FULL, "apart": _FULL, "multiplexed": _MUXED,
    "two-encoders": _FULL | {"bad-information": "what one encoder gets over, two do not agree about"},
    "longest": _FULL, "multiplexed-counted": _MUXED, "one-for-all": _ALONE, "flexible": _ALONE,
    "canopen": {"heartbeat-lost": "its nodes have heartbeats of their own, which go on"}, "two-axes": _FULL,
}  # fmt: skip
"""What says nothing on a set, and why."""
SHARED = {
    "one-for-all": ("pressure",),
    "longest": ("pressure",),
    "flexible": ("pressure", "valve_status", "valve"),
}
"""Whose values are in the encoder's frame."""
WHOLE: dict[str, tuple[str, dict[str, Any]]] = {
    "canopen": ("canopen.toml", {}),
    "two-axes": ("two-axes.toml", {"loop": {"rate_hz": 700.0}}),  # slower, a stuck encoder shows too late
}
"""Configurations that are rigs, changed; in simulated time. Of several axes it happens to the first."""


def adapted(scenario: Scenario, name: str, axis: Loaded) -> Scenario:
    """A scenario as it is on a set: who speaks in the controller's place uses the identifiers of the set."""
    codecs, faults = axis.codecs, list[Any]()
    own = {SYNC_ID: codecs.sync, COMMAND_ID: codecs.valve_command}
    spoken = [(f, own.get(f.can_id) if isinstance(f, Babble) else None) for f in scenario.fault]
    for fault, codec in spoken:
        if codec is None:
            faults.append(fault)
            continue
        of_sync = codec is codecs.sync
        # some valves take it for the controller's
        data = codec.encode(counter=1) if of_sync else codec.encode(0.0, 0, 1, counter=0)
        faults.append(fault.model_copy(update={"can_id": codec.can_id, "data": data.hex()}))
    if delay := DELAY_PERIODS.get(name, {}).get(scenario.name):
        faults = [fault.model_copy(update={"delay_periods": delay}) for fault in faults]
    faults = [_shared(fault, SHARED.get(name, ())) for fault in faults]
    expect, travel_mm = scenario.expect, scenario.expect.travel_mm
    if any(codec is not None for _, codec in spoken):
        expect = expect.model_copy(update={"also": (*expect.also, *_TAKEN)})
    senders = ("encoder", *SHARED.get(name, ()))
    ends = [end for one in expect.faults for sender, _, end in (one.partition("_"),) if sender in senders]
    if len(senders) > 1 and (ends := [end for end in ends if end in _OF_FRAMES]):
        also = [f"{sender}_{end}" for end in ends for sender in _SENDERS]
        others = [one for one in expect.faults if one not in also]
        shown = (*others, *(f"encoder_{end}" for end in ends))
        expect = expect.model_copy(update={"faults": shown, "also": (*expect.also, *also)})
    expect = expect.model_copy(update={"also": (*expect.also, *BESIDES.get(name, {}).get(scenario.name, ()))})
    if within_ms := WITHIN_MS.get(name, {}).get(scenario.name):
        expect = expect.model_copy(update={"within_ms": within_ms})
    if not axis.config.bus.sync:
        travel_mm += FREE_MM
    if found := OTHERWISE.get(name, {}).get(scenario.name):
        told = {"faults": found, "also": (*expect.also, *expect.faults, "send_blocked"), "evidence": None}
        expect = expect.model_copy(update=told | {"after": "sensor_timeout", "reaction": "centre"})
        travel_mm = max(travel_mm, TIMEOUT_MM)
    expect = expect.model_copy(update={"travel_mm": travel_mm, "reason": expect.reason or "see FREE_MM"})
    return scenario.model_copy(update={"fault": tuple(faults), "expect": expect, "change": {}})


def _shared(fault: Any, others: tuple[str, ...]) -> Any:
    """A fault of frames or nodes, where the encoder's frame is that of others."""
    for key in ("frames", "nodes"):
        named = getattr(fault, key, ())
        if not set(others).isdisjoint(named):
            own = dict.fromkeys("encoder" if one in others else one for one in named)
            fault = fault.model_copy(update={key: tuple(own)})
    if {getattr(fault, "of", ""), getattr(fault, "node", "")} & set(others) and not hasattr(fault, "code"):
        key = "of" if hasattr(fault, "of") else "node"
        fault = fault.model_copy(update={key: "encoder"}) if others == ("pressure",) else fault
    return fault


def changed_for(scenario: Scenario, one: DeviceSet | None) -> dict[str, Any]:
    """What a scenario changes of the axis, said of the messages of a set where it says it of frames.

    Messages of CANopen nodes are as they have to be, heartbeats among them.

    Raises:
        KeyError: the set has no such message.
    """
    change = dict(scenario.change)
    bus = dict(change.get("bus", {}))
    frames = bus.pop("frames", {})
    if bus.get("dbc") in BESIDE:
        del bus["dbc"]  # the set has these messages in its own
    if not frames or one is None:
        return change | {"bus": bus} if "bus" in change else change
    messages = {name: dict(guards) for name, guards in one.guards.items()}
    for role, told in frames.items():
        told_by = one.signals[_OF_ROLE[role]]
        name = str(told_by["signal"] if isinstance(told_by, dict) else told_by).partition(".")[0]
        own = {key: told[key] for key in ("node", "heartbeat_timeout_ms") if key in told}
        messages[name] = messages.get(name, {}) | own
    return change | {"bus": bus | {"messages": messages}}


def played(axis: Loaded, scenario: Scenario, bus: str, folder: Path) -> Case:
    """One scenario in real time."""
    file = folder / f"{scenario.name}.toml"
    file.write_text(axis.text)
    channel = f"unixcan:faults-{os.getpid()}-{scenario.name[:24]}" if bus == "unixcan" else f"socketcan:{bus}"
    played = folder / f"{scenario.name}.scenario.toml"
    told = scenario.model_dump(mode="json", by_alias=True, exclude_unset=True, exclude={"change"})
    played.write_text(toml_text(told))
    words = ["--virtual", "--config", file, "--scenario", played, "--bus", channel]
    words += ["--duration", scenario.duration_s + 2.0, "--headless", "--json"]
    words += ["--log", folder / "log" / f"{scenario.name}.mcap", "--socket", folder / "s"]
    done = subprocess.run(
        [*PNEUD, *map(str, words)], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    try:
        found: Case = json.loads(done.stdout)["scenario"]
    except (ValueError, KeyError):
        return {"met": False, "problems": [f"exit {done.returncode}: {done.stderr.strip()[-200:]}"]}
    return found


class Ready(NamedTuple):
    """A scenario on a set, ready to be played."""

    told: Case  # what there is to say before
    axes: Sequence[Loaded]
    scenario: Scenario


def ready(
    name: str, one: DeviceSet | None, scenario: Scenario, folder: Path, known: dict[str, Sequence[Loaded]]
) -> Ready | Case:
    """A scenario as it is on a set; or why it is left out."""
    told: Case = {"set": name, "scenario": scenario.name, "expected": list(scenario.expect.faults)}
    left_out = told | {"met": True, "problems": [], "unnoticed": []}
    dbc = scenario.change.get("bus", {}).get("dbc")
    if dbc in BESIDE and one is None:
        return left_out | {"left_out": f"takes {' and '.join(BESIDE[dbc])}, and no node of it has any"}
    try:
        change = changed_for(scenario, one)
        axes = known.get(key := json.dumps((scenario.config, change), sort_keys=True))
        if axes is None:
            if one is None:
                base, own = WHOLE[name]
                file, change = resources.find(base), merged(own, change)
            elif dbc in BESIDE:
                file = with_beside(one, dbc).write(folder, f"{name}-beside-{dbc[:-4]}", scenario.config)
            else:
                file = one.write(folder, name, scenario.config)
            known[key] = axes = load_axes(file, change=change or None)
    except (ConfigError, DatabaseError, KeyError) as e:
        return left_out | {"left_out": f"does not go with it: {e}"}
    if why := LEFT_OUT.get(name, {}).get(scenario.name):
        return left_out | {"left_out": why}
    if len(axes) > 1 and scenario.orders:
        return left_out | {"left_out": "several axes are simulated without a machine"}
    return Ready(told, axes, adapted(scenario, name, axes[0]))


def of_set(work: tuple[str, list[str], str]) -> list[Case]:
    """All scenarios on a set."""
    name, scenarios, bus = work
    with tempfile.TemporaryDirectory() as folder:
        place, one, known = Path(folder), device_sets().get(name), dict[str, Sequence[Loaded]]()
        (place / "log").mkdir()
        found = [ready(name, one, load_scenario(s), place, known) for s in scenarios]
        cases = [each for each in found if not isinstance(each, Ready)]
        play = _all_simulated if bus == "sim" else partial(_all_played, bus=bus, folder=place)
        cases += play([each for each in found if isinstance(each, Ready)])
    return sorted(cases, key=lambda case: str(case["scenario"]))


def _all_simulated(work: Sequence[Ready]) -> list[Case]:
    """Those that begin alike are played together."""
    alike: dict[tuple[int, float], list[Ready]] = {}
    for each in work:
        alike.setdefault((id(each.axes), each.scenario.duration_s), []).append(each)
    return [
        each.told | found
        for some in alike.values()
        for each, found in zip(some, simulated(some[0].axes, [r.scenario for r in some]), strict=True)
    ]


def _all_played(work: Sequence[Ready], bus: str, folder: Path) -> list[Case]:
    """One after the other; what failed in real time is played once more."""
    cases = []
    for told, axes, scenario in work:
        found = played(axes[0], scenario, bus, folder)
        if not found["met"]:
            found = played(axes[0], scenario, bus, folder) | {"again": found["problems"]}
        cases.append(told | found)
    return cases


def dealt(sets: Sequence[str], scenarios: Sequence[str], seed: int) -> list[tuple[str, list[str]]]:
    """About a tenth of all pairs: scenarios for each set, dealt as cards from shuffled packs.

    Every set has `OF_SET` scenarios or more, and every scenario comes on `OF_SCENARIO` sets or more, as far
    as there are so many.
    """
    chance, pack = random.Random(seed), list[str]()
    many = max(OF_SET, math.ceil(OF_SCENARIO * len(scenarios) / len(sets)), math.ceil(len(scenarios) / 10))
    found = []
    for name in sets:
        hand = list[str]()
        while len(hand) < min(many, len(scenarios)):
            if all(card in hand for card in pack):
                pack += chance.sample(scenarios, len(scenarios))
            card = next(card for card in pack if card not in hand)
            pack.remove(card)
            hand.append(card)
        found.append((name, sorted(hand)))
    return found


def in_words(cases: Iterable[Case]) -> Iterator[str]:
    """What there is to say of the cases of a set: what fails, what is not noticed."""
    for found in cases:
        name = f"{found['set']:20} {found['scenario']:26}"
        if "left_out" in found:
            yield f"--   {name} {found['left_out']}"
        elif not found["met"]:
            yield f"FAIL {name} {'; '.join(found['problems'])}"
        elif found["unnoticed"]:
            instead = f"{', '.join(found['faults'])} instead" if found["faults"] else "goes on"
            off = f", {found['off_mm']:.2f} mm off" if "off_mm" in found else ""
            yield f"safe {name} {', '.join(found['unnoticed'])} not noticed: {instead}{off}"
        if found.get("again"):
            yield f"     {name} at the first try: {'; '.join(found['again'])}"


def asked() -> argparse.Namespace:
    """What is to be played: `sets` and `scenarios` are names."""
    parser = argparse.ArgumentParser(description="Plays fault scenarios on rigs of other people's devices.")
    parser.add_argument("--bus", default="sim", help="sim, unixcan, or an interface such as vcan0")
    parser.add_argument("--sets", default="", help="names, separated by commas")
    parser.add_argument("--scenarios", default="", help="names, separated by commas")
    parser.add_argument("--sample", type=int, metavar="SEED", help="a tenth of it, drawn by this seed")
    processors = len(os.sched_getaffinity(0))
    parser.add_argument(
        "--jobs",
        type=int,
        default=processors,
        help="processes; in simulated time only (one for each processor)",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=None,
        help="folder for device_faults.json, and cells.jsonl meanwhile",
    )
    parser.add_argument(
        "--resume", action="store_true", help="leave out what is in cells.jsonl and was as expected"
    )
    o = parser.parse_args()
    if o.resume and o.output is None:
        parser.error("--resume goes on with what is in the folder of -o")
    o.sets = chosen(parser.error, "set", o.sets, (*device_sets(), *(WHOLE if o.bus == "sim" else ())))
    there = {path.stem: load_scenario(path.stem) for path in sorted(resources.scenarios().glob("*.toml"))}
    scenarios = chosen(parser.error, "scenario", o.scenarios, there)
    if o.bus == "sim":
        scenarios = [name for name in scenarios if not there[name].needs_machine]
    elif o.bus == "unixcan":
        clock = [name for name, s in there.items() if any(f.kind == "clock_step" for f in s.fault)]
        scenarios = [n for n in scenarios if not there[n].needs_interface and n not in clock]
    o.scenarios = scenarios
    return o


def main() -> int:
    """The command."""
    o = asked()
    began, cases = time.monotonic(), list[Case]()
    kept = None if o.output is None else o.output / "cells.jsonl"
    if kept is not None:
        o.output.mkdir(parents=True, exist_ok=True)
        if o.resume and kept.exists():
            cells = (json.loads(line) for line in kept.read_text().splitlines())
            cases = [cell for cell in cells if cell["met"]]
        kept.write_text("".join(json.dumps(case) + "\n" for case in cases))
    done = {(case["set"], case["scenario"]) for case in cases}
    all_pairs = [(name, o.scenarios) for name in o.sets]
    pairs = all_pairs if o.sample is None else dealt(o.sets, o.scenarios, o.sample)
    work = [(name, [s for s in some if (name, s) not in done], o.bus) for name, some in pairs]
    with ProcessPoolExecutor(o.jobs if o.bus == "sim" else 1) as pool:
        for future in as_completed([pool.submit(of_set, each) for each in work if each[1]]):
            found = future.result()
            cases += found
            print("".join(f"{line}\n" for line in in_words(found)), end="", flush=True)
            if kept is not None:
                with kept.open("a") as file:
                    file.writelines(json.dumps(case) + "\n" for case in found)
    wanted = {(name, scenario) for name, some in pairs for scenario in some}
    cases = sorted(
        (case for case in cases if (case["set"], case["scenario"]) in wanted),
        key=lambda case: (o.sets.index(case["set"]), str(case["scenario"])),
    )
    seconds = time.monotonic() - began
    if o.output is not None:
        told = {"schema": 1, "bus": o.bus, "seconds": seconds, "cases": cases}
        (o.output / "device_faults.json").write_text(json.dumps(told, indent=1))
    bad = sum(not found["met"] for found in cases)
    blind = sum(bool(found["unnoticed"]) for found in cases if found["met"])
    out = sum("left_out" in found for found in cases)
    print(
        f"{o.bus}: {len(o.sets)} sets, {len(o.scenarios)} scenarios, {len(cases)} runs:"
        f" {len(cases) - bad - blind - out} as expected,"
        f" {blind} not noticed and safe, {bad} not as expected, {out} left out, {seconds:.0f} s"
    )
    return 0 if not bad else 1


def chosen(error: Callable[[str], Any], what: str, names: str, there: Iterable[str]) -> list[str]:
    """The names asked for, of those that are there; all where none is."""
    wanted = [name for name in names.split(",") if name]
    if unknown := sorted(set(wanted) - set(there)):
        error(f"no such {what}: {', '.join(unknown)}; there are {', '.join(there)}")
    return wanted or list(there)


if __name__ == "__main__":
    sys.exit(main())
