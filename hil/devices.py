"""Rigs of other people's devices, one after another: does the axis track on each?

    .venv/bin/python -m hil.devices                       # in simulated time
    .venv/bin/python -m hil.devices --bus unixcan         # in real time
    hil/vm/run -t 900 -- .venv/bin/python -m hil.devices --bus vcan0

A row for each: RMS and greatest error over the last whole period of the reference, what its devices leave
unnoticed, and what the machine held up: ticks that were skipped, frames that were late or lost, wake-ups late
by half a period. What misses and was held up, or never came to its end, is run again, and the row says so;
what misses undisturbed has missed.

Exit status: 0 where every one tracks within the bound, 1 where one does not.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hil.device_sets import DeviceSet, device_sets

from pneud import resources
from pneud.config.toml import changed_text, tables_of
from pneud.loading import load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.running import through
from pneud.safety.faults import names
from pneud.scenario.verdict import blind_spots
from pneud.signals import State

PNEUD = [sys.executable, "-m", "pneud.cli"]
MOST_MM = 0.02  # RMS
DURATION_S = 5.0  # arming, the way to the reference, and a whole period of it
TRIES = 3
LATE_PERIODS = 0.5  # a wake-up that is later has held up the run
PATIENCE_S = 120.0
PATIENT = {f"{who}_timeout_ms": 250.0 for who in ("sensor", "valve", "deadline")}  # a shared machine stalls


class Way(NamedTuple):
    """How a set is run on a kind of bus."""

    base: str  # configuration that gets the devices
    change: Mapping[str, Any]  # what it says differently
    most_mm: float
    duration_s: float


REAL = Way("virtual.toml", {}, MOST_MM, DURATION_S)
# what a virtual machine with one processor carries; its reference is as much slower as that takes
SLOW = Way("virtual.toml", {"loop": {"rate_hz": 200.0}, "reference": {"frequency_hz": 0.25}}, MOST_MM, 8.0)


def written(name: str, one: DeviceSet, way: Way, folder: Path) -> Path:
    """The configuration of a set, with its DBC, in a folder."""
    patient = one._replace(more={**one.more, **PATIENT})
    if one.more.get("sync") is False:
        # as their data sheets have it: the rig's devices sample at the rate of the loop
        own = {"period_us": 1e6 / tables_of(sheet_of(way))["loop"]["rate_hz"]}
        theirs = (message for message in one.messages if message != "CMD")
        patient = patient._replace(
            guards=dict(one.guards) | {m: {**one.guards.get(m, {}), **own} for m in theirs}
        )
    return patient.write(folder, name, way.base, **way.change)


def sheet_of(way: Way) -> str:
    """The configuration that gets the devices, before it does."""
    return changed_text((resources.configs() / way.base).read_text(encoding="utf-8"), dict(way.change))


def simulated(file: Path, way: Way) -> dict[str, Any]:
    """A run in simulated time: state, faults and error, as in the summary of a real one."""
    loaded = load(file)
    run = Simulation(loaded, way.duration_s, how=backend_of(loaded))
    ran = through(run, loaded.config.loop.rate_hz)
    return {
        "state": State(ran.seen.state).label,
        "faults": names(ran.seen.latched),
        "tracking_mm": ran.tally.tracking.tracking_mm(),
        "frames": run.inbox.counts()._asdict(),
        "skipped": 0,
        "lateness_us": None,
    }


def played(file: Path, bus: str, way: Way) -> dict[str, Any]:
    """A run in real time; what it printed as its summary.

    Raises:
        ValueError: it printed none; the text says what it did.
    """
    channel = f"unixcan:{file.stem}-{os.getpid()}" if bus == "unixcan" else f"socketcan:{bus}"
    words = ["--virtual", "--config", file, "--bus", channel, "--duration", way.duration_s]
    with tempfile.TemporaryDirectory(dir=file.parent) as folder:
        words += ["--headless", "--json", "--log", f"{folder}/run.mcap", "--socket", f"{folder}/s"]
        done = subprocess.run(
            [*PNEUD, *map(str, words)], capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
    if not done.stdout.startswith("{"):
        raise ValueError(f"exit {done.returncode}: {done.stderr.strip()[-200:]}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def trouble(summary: dict[str, Any], most_mm: float) -> str:
    """What is wrong with a run; empty where nothing is."""
    tracking, frames = summary["tracking_mm"], summary["frames"]
    if summary["faults"] or summary["state"] != State.TRACKING.label:
        return f"{summary['state']}: {', '.join(summary['faults']) or 'no fault'}"
    if spoilt := [kind for kind in ("crc", "stale") if frames[kind]]:
        return f"frames with {' and '.join(spoilt)}"
    if tracking["rms"] is None:
        return str(tracking["reason"])
    return "" if tracking["rms"] <= most_mm else f"{tracking['rms']:.4f} mm RMS, not {most_mm:g}"


def held_up(summary: dict[str, Any]) -> list[str]:
    """What a machine that had something else to do has made of a run, in words."""
    frames = summary["frames"]
    counts = {"ticks skipped": summary["skipped"], "frames late": frames["late"], "lost": frames["lost"]}
    found = [f"{count} {what}" for what, count in counts.items() if count]
    lateness_us = summary["lateness_us"]
    if lateness_us is not None and lateness_us["max"] > LATE_PERIODS * 1e6 / summary["rate_hz"]:
        found.append(f"a wake-up {1e-3 * lateness_us['max']:.1f} ms late")
    return found


def row(name: str, one: DeviceSet, bus: str, way: Way, folder: Path) -> dict[str, Any]:
    """A set on a bus: how it tracks, what it leaves unnoticed."""
    file = written(name, one, way, folder)
    found: dict[str, Any] = {"set": name, "bus": bus, "again": [], "held_up": []}
    while True:
        try:
            summary = simulated(file, way) if bus == "sim" else played(file, bus, way)
        except (ValueError, subprocess.TimeoutExpired) as e:
            found |= {"trouble": str(e), "held_up": ["no summary"]}
        else:
            found |= {"trouble": trouble(summary, way.most_mm), "held_up": held_up(summary)}
            found |= {key: summary["tracking_mm"][key] for key in ("rms", "max", "periods", "against")}
        undisturbed = bus == "sim" or not found["held_up"]
        if not found["trouble"] or undisturbed or len(found["again"]) == TRIES - 1:
            break
        found["again"].append(f"{found['trouble']} ({', '.join(found['held_up'])})")
    blind = blind_spots(load(file))
    found["unnoticed"] = [one.name for one in blind if one.wholly]
    found["partly"] = [one.name for one in blind if not one.wholly]
    return found


def line(found: dict[str, Any]) -> str:
    """A row in words."""
    word = "FAIL" if found["trouble"] else "ok  "
    error = "" if found.get("rms") is None else f"{found['rms']:.4f} {found['max']:.4f} mm"
    tries = f" (run {len(found['again']) + 1}, before: {'; '.join(found['again'])})" if found["again"] else ""
    told = found["trouble"] or f"not noticed: {', '.join(found['unnoticed']) or 'nothing'}"
    if found["partly"]:
        told += f"; hardly: {', '.join(found['partly'])}"
    if found["held_up"]:
        told += f"; {', '.join(found['held_up'])}"
    return f"{word} {found['set']:20} {error:18} {found.get('against') or '':8} {told}{tries}"


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Has the axis track on rigs of other people's devices.")
    parser.add_argument("--bus", default="sim", help="sim, unixcan, or an interface such as vcan0")
    parser.add_argument("--only", default="", help="names of sets, separated by commas")
    parser.add_argument("-o", "--output", type=Path, default=None, help="folder for devices.json")
    o = parser.parse_args()
    sets = device_sets()
    if unknown := sorted(set(filter(None, o.only.split(","))) - sets.keys()):
        parser.error(f"no such set: {', '.join(unknown)}; there are {', '.join(sets)}")
    chosen = [name for name in sets if not o.only or name in o.only.split(",")]
    way = REAL if o.bus in ("sim", "unixcan") else SLOW
    began, rows = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen:
            rows.append(row(name, sets[name], o.bus, way, Path(folder)))
            print(line(rows[-1]), flush=True)
    seconds = time.monotonic() - began
    if o.output is not None:
        o.output.mkdir(parents=True, exist_ok=True)
        told = {"schema": 1, "bus": o.bus, "most_mm": way.most_mm, "seconds": seconds, "sets": rows}
        (o.output / "devices.json").write_text(json.dumps(told, indent=1))
    good = sum(not found["trouble"] for found in rows)
    twice = sum(bool(found["again"]) for found in rows)
    within = f"{good} of {len(rows)} within {way.most_mm:g} mm"
    print(f"{o.bus}: {within}, {twice} run more than once, {seconds:.0f} s")
    return 0 if good == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
