"""Several axes on one bus in real time, beside one alone: tracking, frames, and the work of a tick.

    .venv/bin/python -m hil.axes                          # 2 axes at 700 Hz and 4 at 300 Hz, 60 s each
    .venv/bin/python -m hil.axes --seconds 10 --runs 2x700

First the bus's arithmetic, then, one after the other, one axis alone at each rate, those asked for, and two
at the last rate. An axis among several has to track within 1.2 times of one alone, no frame may be lost or
wrong, and the loop's own work a tick may grow no more than with the number of axes. Real time on a machine
that does something else as well is none: what came late, answers that never left (a node that stalls
leaves one out), and what was skipped stand beside.

A frame is lost where its sender's counter has gone on by more than what was heard.

Exit status: 0 where all held, 1 else.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneud import resources
from pneud.bus.load import load_of, most_hz
from pneud.config.axes import axes_of
from pneud.config.sections import ConfigError
from pneud.config.toml import merged, tables_of, toml_text
from pneud.loading import load_axes
from pneud.log.files.columns import blocks
from pneud.log.files.reader import read_log

PNEUD = [sys.executable, "-m", "pneud.cli"]
WORSE = 1.2  # times the error of one alone
ROOM = 1.1  # times as much work as the number of axes
ROLES = ("encoder", "pressure", "valve_status", "valve_command")
FOUR = 4  # axes that axes.dbc has frames for


class Ran(NamedTuple):
    """What a run came to."""

    axes: int
    rate_hz: float
    rms_mm: list[float]
    max_mm: list[float]
    heard: int  # frames
    lost: int  # frames that were sent, by their counters, and never heard
    late: int  # heard, but they answered an earlier SYNC
    wrong: int  # by their checksum, or with a counter that stood still
    unanswered: int  # readings that a tick went without, for which no frame came at all
    skipped: int
    late_us: float  # wake-ups, p99
    work_us: float  # of a tick, all axes: deciding, sending, recording; the median
    faults: list[str]


def file_of(folder: Path, axes: int, rate_hz: float) -> Path:
    """A configuration of so many axes that are all alike."""
    whole = tables_of((resources.configs() / "axes" / "two-axes.toml").read_text(encoding="utf-8"))
    del whole["axis"]
    whole = merged(whole, {"name": f"axes{axes}", "loop": {"rate_hz": rate_hz}})
    text = toml_text(whole)
    for n in range(axes):
        text += f'\n[[axis]]\nname = "a{n + 1}"\n'
        for k, role in enumerate(ROLES if n else ()):
            node = f", node = {3 * n + k + 1}" if role != "valve_command" else ""
            text += f'bus.frames.{role} = {{ message = "{role.upper()}_{n + 1}"{node} }}\n'
    file = folder / f"axes-{axes}-{rate_hz:g}.toml"
    file.write_text(text, encoding="utf-8")
    (folder / "axes.dbc").write_bytes((resources.configs() / "axes" / "axes.dbc").read_bytes())
    return file


def arithmetic(file: Path) -> str:
    """What the bus says: bit times a tick, and the rate that it carries."""
    axes = load_axes(file)
    config = axes[0].config
    load = load_of(config, *(axis.codecs for axis in axes))
    bits = load.tick_s * config.bus.bitrate_bit_s
    return (
        f"{len(axes)} axes: {bits:.0f} bit times a tick, up to {most_hz(config, load):.0f} Hz;"
        f" asked for {config.loop.rate_hz:g} Hz"
    )


def ran(file: Path, seconds: float, bus: str, seed: int) -> Ran:
    """A run of the daemon with its software rigs."""
    names = [part.config.name for part in axes_of(file)]
    logs = Path(tempfile.mkdtemp(prefix="logs-", dir=file.parent))
    command = [*PNEUD, "--virtual", "--config", str(file), "--bus", bus, "--duration", str(seconds)]
    command += ["--headless", "--json", "--log", str(logs), "--seed", str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds + 60.0)
    if not done.stdout:
        raise SystemExit(f"hil.axes: {done.stderr.strip()}")
    told = json.loads(done.stdout)
    each: dict[str, Any] = told["axes"] if "axes" in told else {names[0]: told}
    frames = [one["frames"] for one in each.values()]
    first = next(iter(each.values()))
    return Ran(
        len(names),
        first["rate_hz"],
        [one["tracking_mm"]["rms"] or float("nan") for one in each.values()],
        [one["tracking_mm"]["max"] or float("nan") for one in each.values()],
        sum(one["rx"] for one in frames),
        sum(one["lost"] for one in frames),
        sum(one["late"] for one in frames),
        sum(one["crc"] + one["stale"] for one in frames),
        sum(one["amiss"]["missing"] for one in each.values()),
        first["skipped"],
        first["lateness_us"]["p99"],
        sum(work_us(Path(one["log"])) for one in each.values()),
        sorted({fault for one in each.values() for fault in one["faults"]}),
    )


def work_us(log: Path) -> float:
    """What one axis takes of a tick, without waiting [µs]; the median."""
    parts = [
        sum(
            np.maximum(block.ticks[f"timing.{name}"].astype(np.int64), 0)
            for name in ("cycle_ns", "send_ns", "record_ns")
        )
        for block in blocks(read_log(log))
        if len(block.number)
    ]
    return float(np.median(np.concatenate(parts))) * 1e-3


def row(one: Ran, alone: Ran) -> str:
    """A line of the table."""
    worst = max(mm / alone.rms_mm[0] for mm in one.rms_mm)
    rms = ", ".join(f"{1e3 * mm:.1f}" for mm in one.rms_mm)
    return (
        f"{one.axes:4d} {one.rate_hz:6g} {rms:>26} {worst:7.2f} {1e3 * max(one.max_mm):7.0f}"
        f" {one.heard:8d} {one.lost:5d} {one.late:5d} {one.wrong:5d} {one.unanswered:6d} {one.skipped:7d}"
        f" {one.late_us:8.0f} {one.work_us:8.1f}"
        f" {one.work_us / one.axes:8.1f}  {' '.join(one.faults)}"
    )


def judged(runs: list[Ran]) -> list[str]:
    """What has not held."""
    found = []
    for one in runs:
        alone = next(r for r in runs if r.axes == 1 and r.rate_hz == one.rate_hz)
        name = f"{one.axes} at {one.rate_hz:g} Hz"
        if any(not mm <= WORSE * alone.rms_mm[0] for mm in one.rms_mm):
            found.append(f"{name}: an axis tracks worse than {WORSE} times one alone")
        if one.lost:
            found.append(f"{name}: {one.lost} frames lost of {one.heard}")
        if one.wrong:
            found.append(f"{name}: {one.wrong} frames wrong of {one.heard}")
        if one.faults:
            found.append(f"{name}: {', '.join(one.faults)}")
        if one.work_us > ROOM * one.axes * alone.work_us:
            found.append(f"{name}: {one.work_us:.0f} µs of work, {alone.work_us:.0f} µs for one alone")
    return found


def wanted(text: str) -> tuple[int, float]:
    """Axes and rate, as 2x700."""
    axes, _, rate = text.partition("x")
    if not axes.isdecimal() or not 1 <= int(axes) <= FOUR or not rate.isdecimal() or not int(rate):
        raise argparse.ArgumentTypeError(f"{text}: axes (1 to {FOUR}) and rate, as 2x700")
    return int(axes), float(rate)


def main() -> int:
    """Run."""
    parser = argparse.ArgumentParser(prog="hil.axes", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of every run (60)")
    parser.add_argument("--runs", type=wanted, nargs="+", default=[(2, 700.0), (4, 300.0)], metavar="AXESxHZ")
    parser.add_argument("--bus", help="unixcan:NAME or a vcan; else a unixcan of its own")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    plan = list(dict.fromkeys((n, hz) for _, hz in asked.runs for n in (1,)))
    for axes, hz in asked.runs:
        last = (axes, hz) == asked.runs[-1]
        plan += [(n, hz) for n in (range(2, axes + 1, 1 if axes < FOUR else 2) if last else (axes,))]
    plan = sorted(dict.fromkeys(plan), key=lambda run: (-run[1], run[0]))
    bus = asked.bus or f"unixcan:axes-{os.getpid()}"
    with tempfile.TemporaryDirectory(prefix="pneud-axes-") as folder:
        try:
            files = {run: file_of(Path(folder), *run) for run in plan}
            for file in files.values():
                print(arithmetic(file), flush=True)
        except ConfigError as e:
            raise SystemExit(f"hil.axes: {e}") from None
        print(
            "axes   rate                   rms [um]  /alone max[um]   frames  lost  late wrong silent skipped"
            " wake p99 work[us] per axis",
            flush=True,
        )
        runs: list[Ran] = []
        for run, file in files.items():
            runs.append(ran(file, asked.seconds, bus, asked.seed))
            alone = next(r for r in runs if r.axes == 1 and r.rate_hz == run[1])
            print(row(runs[-1], alone), flush=True)
    for why in judged(runs):
        print(why)
    return 1 if judged(runs) else 0


if __name__ == "__main__":
    sys.exit(main())
