"""Random faults for a long time, and an operator who clears and arms again after each.

    .venv/bin/python hil/soak.py --sim 3600            # simulated time
    .venv/bin/python hil/soak.py --real 600            # the daemon and the plant, over unixcan
    .venv/bin/python hil/soak.py --sim 600 --seed 7

Every fault comes to an end, and every time the axis must get back to tracking; every fault must be in the
log, no number may be left that is not finite, and nothing may grow. Exit status: 0 where all held, 1 else.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pneud.config.toml import toml_text
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.loading import load
from pneud.log.files.reader import LogReader
from pneud.replay.lockstep import Simulation, backend_of
from pneud.safety.faults import BLOCKS_ARM, names
from pneud.scenario.format import Scenario
from pneud.signals import Request, RequestKind, State

PNEUD = [sys.executable, "-m", "pneud.cli"]
EVERY_S, LASTS_S = 10.0, 0.3  # a fault, and how long it is there
BACK_S = 8.0  # from a fault's onset the axis must track again within this time
SAMPLE_S = 60.0  # of simulated time
LOOK_S = 5.0  # of real time
MORE_KIB = 4096  # that a process may take beyond what it has settled at, apart from a tenth


def faults(duration_s: float, chance: random.Random) -> list[dict[str, Any]]:
    """A fault of any kind that passes, every ten seconds."""
    frame = [["encoder"], ["pressure"], ["valve_status"], ["encoder", "pressure", "valve_status"]]
    kinds: list[dict[str, Any]] = [
        *({"kind": kind, "frames": frames} for kind in ("drop", "corrupt", "freeze") for frames in frame),
        {"kind": "drop", "frames": ["valve_command"]},
        {"kind": "reorder", "frames": ["encoder"]},
        {"kind": "duplicate", "frames": ["pressure"]},
        {"kind": "delay", "frames": ["valve_status"], "delay_ms": 0.5},
        {"kind": "delay", "frames": frame[3], "delay_periods": 1.0, "after_sync": 0.1, "every": 7},
        {"kind": "skip", "nodes": ["encoder", "pressure", "valve"], "every": 20},
        {"kind": "babble", "can_id": 1, "load": 1.0},
        {"kind": "babble", "can_id": 1, "load": 0.3},
        {"kind": "bus_off", "of": "controller"},
        {"kind": "bus_off", "of": "encoder"},
        {"kind": "error_frames"},
        {"kind": "silence", "nodes": ["encoder", "pressure", "valve"]},
        {"kind": "reboot", "node": "encoder"},
        {"kind": "reboot", "node": "valve"},
        {"kind": "valve_failure"},
        {"kind": "set", "signal": "encoder_status", "value": 5.0},
        {"kind": "offset", "signal": "position_m", "value": 0.003},
        {"kind": "offset", "signal": "p1_pa", "value": 20_000.0},
        {"kind": "scale", "signal": "p2_pa", "value": 0.25},
        {"kind": "supply", "supply_pa": 300_000.0, "ramp_s": 0.1},
        {"kind": "leak", "chamber": 1, "size": 0.2},
        {"kind": "leak", "chamber": 2, "size": 4.0},
        {"kind": "valve_stuck", "opening_percent": 0.0},
        {"kind": "seized"},
        {"kind": "mass", "factor": 3.0},
        {"kind": "friction", "factor": 5.0},
        {"kind": "force", "force_n": 300.0},
    ]
    count = max(1, int(duration_s / EVERY_S) - 1)
    return [
        chance.choice(kinds) | {"at_s": EVERY_S * (i + 0.3 + 0.4 * chance.random()), "for_s": LASTS_S}
        for i in range(count)
    ]


def scenario_of(duration_s: float, seed: int) -> dict[str, Any]:
    """The scenario as it would stand in a file."""
    return {
        "schema": 1,
        "name": "soak",
        "description": "Random faults that pass.",
        "duration_s": duration_s,
        "fault": faults(duration_s, random.Random(seed)),
        "expect": {"reaction": "none"},
    }


class Findings:
    """What may not be."""

    def __init__(self) -> None:
        self.problems: list[str] = []
        self.latched: dict[str, int] = {}
        self.seen: set[str] = set()  # latched faults, as the operator was told
        self.recoveries = 0
        self.longest_s = 0.0

    def held(self, bits: int) -> None:
        """The axis was held by these faults."""
        for name in names(bits):
            self.latched[name] = self.latched.get(name, 0) + 1

    def back(self, after_s: float, at_s: float) -> None:
        """It tracks again, so long after it was held."""
        self.recoveries += 1
        self.longest_s = max(self.longest_s, after_s)
        if after_s > BACK_S:
            self.problems.append(f"at {at_s:.1f} s: back only after {after_s:.1f} s")


def simulated(duration_s: float, seed: int) -> Findings:
    """In simulated time, in this process."""
    found = Findings()
    loaded = load("virtual.toml")
    wait = 0

    def operator(state: int, present: int) -> Request | None:
        nonlocal wait
        wait += 1
        if wait < 500 or state not in (State.FAULT, State.DISARMED):
            return None
        if state == State.FAULT:
            wait = 250  # asks again in a quarter of a second
            return Request(RequestKind.CLEAR)
        if present & BLOCKS_ARM:
            return None
        wait = 0
        return Request(RequestKind.ARM, (1.0,))

    played = Scenario.model_validate(scenario_of(duration_s, seed))
    run = Simulation(loaded, duration_s, seed, backend_of(loaded), scenario=played, operator=operator)
    held_ns, latched, sizes = 0, 0, []
    rate = loaded.config.loop.rate_hz
    for count, record in enumerate(run.records()):
        tick = record.tick
        if tick.latched and tick.latched != latched:
            found.held(tick.latched & ~latched)
            held_ns = held_ns or tick.t_ns
            wait = 0
        latched = tick.latched
        if held_ns and tick.state == State.TRACKING:
            found.back((tick.t_ns - held_ns) * 1e-9, tick.t_ns * 1e-9)
            held_ns = 0
        if not all(map(math.isfinite, (*run.node.state[:8], tick.command.voltage_v))):
            found.problems.append(f"at {tick.t_ns * 1e-9:.3f} s: not finite")
            break
        if count % round(SAMPLE_S * rate) == 0:
            sizes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    if run.axis.failure is not None:
        found.problems.append(f"exception in the cycle: {run.axis.failure!r}")
    if held_ns:
        found.problems.append("never came back from the last fault")
    check_growth("the simulation", sizes, found)
    return found


def check_growth(name: str, sizes_kib: list[int], found: Findings) -> None:
    """Memory may settle in the first third, and must then stay."""
    if len(sizes_kib) >= 6:
        settled, last = sizes_kib[len(sizes_kib) // 3], sizes_kib[-1]
        print(f"memory of {name}: {settled} KiB after a third, {last} KiB at the end")
        if last > 1.1 * settled + MORE_KIB:
            found.problems.append(f"memory of {name} grew from {settled} to {last} KiB")


def children(pid: int) -> list[int]:
    """Process ids of a process's children, the oldest first."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def size_of(pid: int) -> tuple[int, int]:
    """Resident memory [KiB] and number of open files of a process."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 1024, len(list(Path(f"/proc/{pid}/fd").iterdir()))


def real(duration_s: float, seed: int) -> Findings:
    """Daemon and plant as processes, over unixcan, with an operator at the daemon's socket."""
    found = Findings()
    bus = f"unixcan:soak-{os.getpid()}"
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        data = scenario_of(duration_s, seed)
        many = "".join(f"\n[[fault]]\n{toml_text(fault)}" for fault in data.pop("fault"))
        expect = data.pop("expect")
        (folder / "soak.toml").write_text(toml_text(data) + many + "\n[expect]\n" + toml_text(expect))
        log, socket = folder / "soak.mcap", folder / "s"
        plant = subprocess.Popen(
            [*PNEUD, "plant", "--bus", bus, "--scenario", str(folder / "soak.toml")],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        where = ["--bus", bus, "--log", str(log), "--socket", str(socket)]
        daemon = subprocess.Popen(
            [*PNEUD, "--config", "virtual.toml", "--headless", "--json", *where],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            operate(daemon, plant, socket, duration_s, found)
        finally:
            daemon.send_signal(signal.SIGINT)
            out, err = daemon.communicate(timeout=60)
            plant.terminate()
            plant.communicate(timeout=60)
        read_back(log, out, err, found)
    return found


def operate(
    daemon: subprocess.Popen[str],
    plant: subprocess.Popen[str],
    socket: Path,
    duration_s: float,
    found: Findings,
) -> None:
    """Clear and arm whenever the axis does not track."""
    client = None
    deadline = time.monotonic() + 30.0
    while client is None and time.monotonic() < deadline:
        try:
            client = Client(str(socket))
        except PlaceError:
            time.sleep(0.1)
    if client is None:
        found.problems.append("no console")
        return
    end, next_sample, held = time.monotonic() + duration_s, 0.0, 0.0
    refusal, tracked = "none", False
    client.ask("status")  # once it answers, it is there
    recorder, keeper = children(daemon.pid)
    (console,) = children(keeper)
    processes = {"control": daemon.pid, "recorder": recorder, "console": console, "plant": plant.pid}
    sizes: dict[str, list[tuple[int, int]]] = {name: [] for name in processes}
    with client:
        while time.monotonic() < end and daemon.poll() is None and plant.poll() is None:
            time.sleep(0.2)
            status = client.ask("status")
            state = status["state"]
            found.seen |= {fault["name"] for fault in status["faults"] if fault["latched"]}
            now = time.monotonic()
            if state == "tracking":
                if held and tracked:
                    found.back(now - held, duration_s - (end - now))
                held, tracked = 0.0, True
            else:
                held = held or now
                try:
                    if state == "fault":
                        client.ask("clear")
                    elif state == "disarmed":
                        client.ask("arm")
                    elif state == "holding":
                        client.ask("track", what="reference")
                except RefusedError as e:
                    refusal = str(e)  # asked again as long as it holds
            if now > next_sample:
                next_sample = now + LOOK_S
                for name, pid in processes.items():
                    sizes[name].append(size_of(pid))
    if daemon.poll() is not None or plant.poll() is not None:
        found.problems.append("a process has ended")
    if held:
        found.problems.append(f"not tracking at the end; the last refusal: {refusal}")
    for name, looks in sizes.items():
        check_growth(name, [size for size, _ in looks], found)
        files = [number for _, number in looks[1:]]
        if len(set(files)) > 1:
            found.problems.append(f"open files of {name}: {files}")


def read_back(log: Path, out: str, err: str, found: Findings) -> None:
    """Every fault is in the log, and the log is whole."""
    summary = json.loads(out)
    reader = LogReader([log])
    latched = 0
    for tick in reader:
        if tick.latched & ~latched:
            found.held(tick.latched & ~latched)
        latched = tick.latched
    unlogged = (set(summary["faults"]) | found.seen) - set(found.latched)
    if unlogged:
        found.problems.append(f"not in the log: {', '.join(sorted(unlogged))}")
    if reader.truncated or reader.missing or summary["log_dropped"]:
        found.problems.append(f"the log lacks {reader.missing} records {reader.damage}")
    if "Traceback" in err:
        found.problems.append(err.strip()[-500:])
    print(f"{summary['ticks']} ticks, {summary['skipped']} skipped, frames {summary['frames']}")


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Random faults and an operator who arms again.")
    parser.add_argument("--sim", type=float, default=0.0, metavar="S", help="simulated seconds")
    parser.add_argument("--real", type=float, default=0.0, metavar="S", help="seconds of a real run")
    parser.add_argument("--seed", type=int, default=1)
    o = parser.parse_args()
    bad = 0
    for name, duration_s, run in (("simulated", o.sim, simulated), ("real", o.real, real)):
        if duration_s:
            began = time.monotonic()
            found = run(duration_s, o.seed)
            took_s = time.monotonic() - began
            for problem in found.problems:
                print(f"PROBLEM {problem}")
            held = ", ".join(f"{fault} {times}" for fault, times in sorted(found.latched.items()))
            injected = len(faults(duration_s, random.Random(o.seed)))
            print(
                f"{name}: {duration_s:g} s took {took_s:.0f} s; {injected} random faults,"
                f" {found.recoveries} recoveries, the longest {found.longest_s:.1f} s,"
                f" {len(found.problems)} problems; held by {held or 'nothing'}"
            )
            bad += len(found.problems)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
