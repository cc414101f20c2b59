"""How punctual the loop is on this machine, beside references that take turns with it."""

from __future__ import annotations

import json as json_
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from pneud.benchmark import contestants, rates
from pneud.benchmark.contestants import AbsentError, Track, Turn
from pneud.benchmark.picture import page
from pneud.benchmark.report import KERNEL, OURS, as_object, in_words
from pneud.benchmark.sample import Series
from pneud.bus.link import open_link
from pneud.config import ConfigError
from pneud.loading import Loaded, bus_name, load
from pneud.rt import machine

TURN_S = 1.0


class Contestant(NamedTuple):
    """Who takes turns."""

    what: str
    turn: Turn
    has_rate: bool  # its highest rate is worth knowing


CONTESTANTS: Mapping[str, Contestant] = {
    KERNEL: Contestant(
        "what the kernel itself can do, cut to whole microseconds", contestants.cyclictest, False
    ),
    OURS: Contestant(
        "pneud --virtual with plant and recorder; figures from its log", contestants.pneud, True
    ),
    "empty": Contestant("an empty Python loop with absolute deadlines", contestants.empty, True),
    "notifier": Contestant(
        "python-can's Notifier and time.sleep: same bus, plant, codecs and law; no supervisor, no record",
        contestants.notifier,
        True,
    ),
    "c": Contestant(
        "hil/bench/loop.c: same bus, plant, frames and law, a record copied each tick; no supervisor",
        contestants.c_program,
        True,
    ),
}


class BenchOptions(NamedTuple):
    """What was asked for on the command line."""

    config: str
    bus: str | None
    pairs: int
    rate_s: float  # how long a rate is to be held; 0 leaves the rates out
    output: Path | None
    json: bool


def bench(o: BenchOptions, field: Mapping[str, Contestant] = CONTESTANTS, turn_s: float = TURN_S) -> int:
    """Measure and report.

    Args:
        o: what was asked for.
        field: who takes part.
        turn_s: length of a turn [s].

    Returns:
        Exit status: 0, or 1 where pneud itself could not be measured.

    Raises:
        ConfigError: the configuration or an option cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used.
    """
    if o.pairs < 1:
        raise ConfigError(f"--pairs {o.pairs}: must be 1 or more")
    if not 0.0 <= o.rate_s <= 3600.0:
        raise ConfigError(f"--rate-seconds {o.rate_s:g}: must lie between 0 and 3600")
    if o.output is not None and not o.output.parent.is_dir():
        raise ConfigError(f"{o.output}: there is no folder {o.output.parent}; create it or name another file")
    axis = load(o.config)
    facts = machine.read(None, Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix="pneud-bench-") as scratch:
        track = _track(axis, o.bus, Path(scratch))
        series, missing = _take_turns(field, track, o.pairs, turn_s)
        if o.rate_s > 0.0:
            _find_rates(series, field, track, o.rate_s)
    setting = {
        "rate_hz": axis.config.loop.rate_hz,
        "priority": track.priority,
        "scheduling": f"SCHED_FIFO {track.priority}" if track.priority else "no real-time scheduling",
        "cpu": track.cpu,
        "bus": track.bus or "unixcan",
        "config": str(axis.path),
        "pairs": o.pairs,
        "turn_s": turn_s,
        "rate_s": o.rate_s,
    }
    report = as_object(series, missing, facts._asdict(), setting)
    words = in_words(report)
    if o.output is not None:
        o.output.write_text(page(report, words))
    print(json_.dumps(report) if o.json else words)
    return 0 if OURS in series else 1


def _track(axis: Loaded, bus: str | None, scratch: Path) -> Track:
    wanted = axis.config.realtime
    granted = {
        report.name: report for report in machine.attempt(wanted.priority, wanted.cpu, wanted.lock_memory)
    }
    for report in granted.values():
        if report.asked and not report.ok:
            print(f"pneud: {report.name}: {report.reason}", file=sys.stderr)
    channel = bus_name(bus, axis.config)
    with open_link(channel, virtual=True) as link:
        name = link.name if link.name.startswith("socketcan:") else None
    fifo, pinned = granted.get("fifo"), granted.get("affinity")
    return Track(
        axis,
        axis.path,
        name,
        wanted.priority if fifo is not None and fifo.ok else 0,
        wanted.cpu if pinned is not None and pinned.ok else None,
        scratch,
    )


def _take_turns(
    field: Mapping[str, Contestant], track: Track, pairs: int, turn_s: float
) -> tuple[dict[str, Series], dict[str, str]]:
    series = {name: Series(name, one.what) for name, one in field.items()}
    missing: dict[str, str] = {}
    rate_hz = track.axis.config.loop.rate_hz
    for number in range(pairs):
        # to and fro, so that nobody always has the same one before him
        for name in list(field) if number % 2 == 0 else reversed(list(field)):
            if name in missing:
                continue
            _progress(f"turn {number + 1} of {pairs}: {name}")
            try:
                series[name].add(field[name].turn(track, rate_hz, turn_s), number)
            except AbsentError as e:
                missing[name] = str(e)
    _progress("")
    return {name: one for name, one in series.items() if one.turn_numbers}, missing


def _find_rates(
    series: Mapping[str, Series], field: Mapping[str, Contestant], track: Track, rate_s: float
) -> None:
    quick = rates.without_bus_time(track)
    for name, one in series.items():
        if field[name].has_rate:
            _progress(f"highest rate: {name}")
            try:
                one.highest_rate_hz = rates.highest(field[name].turn, quick, rate_s)
            except AbsentError as e:
                one.notes.append(f"highest rate not found: {e}")
    _progress("")


def _progress(text: str) -> None:
    if os.isatty(2):
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
