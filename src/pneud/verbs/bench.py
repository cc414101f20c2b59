"""Measure how punctual the loop is here, taking turns with cyclictest and other references."""

from __future__ import annotations

import json as json_
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from pneud.bench import contestants, rates
from pneud.bench.chart import page
from pneud.bench.contestants import AbsentError, TrackScript, Turn
from pneud.bench.disturbances import DISTURBANCES, Disturb
from pneud.bench.sample import Samples, ratio_of_turns
from pneud.bench.tables import KERNEL, OURS, as_object, disturbances_in_words, in_words
from pneud.bus.link import open_link
from pneud.config.sections import ConfigError
from pneud.loading import Loaded, bus_name, load
from pneud.loop.summary import finite
from pneud.rt.outputs import write_whole
from pneud.rt.setup import own_cpu
from pneud.service import machine
from pneud.verbs import BusOption, ConfigOption, JsonOption, ProgressOption, VerbError, require_suffix
from pneud.view.progress import Report, progress


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


def bench(
    config: ConfigOption = None,
    bus: BusOption = None,
    pairs: Annotated[int, typer.Option("--pairs", metavar="N", help="Turns for each.")] = 20,
    rate_s: Annotated[
        float,
        typer.Option("--rate-seconds", metavar="S", help="How long a rate must be held; 0 leaves that out."),
    ] = 3.0,
    rate_hz: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Another rate, on a bus whose frames take no time."),
    ] = None,
    turn_s: Annotated[float, typer.Option("--turn", metavar="S", help="Length of a turn.")] = 1.0,
    disturb: Annotated[
        bool, typer.Option("--disturb", help="Pneud with and without disturbances, instead of references.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write the report as HTML, too.")
    ] = None,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Measure and report.

    Returns:
        Exit status: 0, or 1 where pneud itself could not be measured.
    """
    if sys.platform != "linux":
        raise VerbError("the loop needs Linux, and so does its benchmark", 3)
    if pairs < 1:
        raise ConfigError(f"--pairs {pairs}: must be 1 or more")
    if not 0.0 <= rate_s <= 3600.0:
        raise ConfigError(f"--rate-seconds {rate_s:g}: must lie between 0 and 3600")
    if not 0.0 < turn_s <= 3600.0:
        raise ConfigError(f"--turn {turn_s:g}: must be positive, and at most 3600")
    if disturb and output is not None:
        raise ConfigError("--output shows the contestants, and --disturb has none")
    if output is not None:
        require_suffix(output, ".html", "the report is a page of HTML")
    if output is not None and not output.parent.is_dir():
        raise ConfigError(f"{output}: there is no folder {output.parent}; create it or name another file")
    axis = load(config or "virtual.toml")
    facts = machine.read(None, Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix="pneud-bench-") as scratch, progress(how) as told:
        track = _track(axis, bus, Path(scratch))
        if rate_hz is not None:
            track = rates.at(rates.without_bus_time(track), rate_hz)
        if disturb:
            found = _disturb(track, pairs, turn_s, told)
        else:
            series, missing = _take_turns(CONTESTANTS, track, pairs, turn_s, told)
            if rate_s > 0.0:
                _find_rates(series, CONTESTANTS, track, rate_s, told)
    if disturb:
        report = finite({"schema": 1, "machine": facts._asdict(), "disturbances": found})
        print(json_.dumps(report) if json else disturbances_in_words(report["disturbances"]))
        return 0
    setting = {
        "rate_hz": track.axis.config.loop.rate_hz,
        "priority": track.priority,
        "scheduling": f"SCHED_FIFO {track.priority}" if track.priority else "no real-time scheduling",
        "cpu": track.cpu,
        "bus": track.bus or "unixcan",
        "config": str(axis.path),
        "pairs": pairs,
        "turn_s": turn_s,
        "rate_s": rate_s,
    }
    report = as_object(series, missing, facts._asdict(), setting)
    words = in_words(report)
    if output is not None:
        write_whole(output, page(report, words))
    print(json_.dumps(report) if json else words)
    return 0 if OURS in series else 1


def _disturb(track: TrackScript, pairs: int, turn_s: float, report: Report) -> dict[str, Any]:
    rate_hz = track.axis.config.loop.rate_hz
    found: dict[str, Any] = {}
    for name, disturbance in DISTURBANCES.items():
        quiet, disturbed = Samples("quiet", ""), Samples("disturbed", "")
        for number in range(pairs):
            report(name, number, pairs, "pairs")
            both: list[tuple[Samples, Disturb | None]] = [(quiet, None), (disturbed, disturbance)]
            for series, what in both if number % 2 == 0 else reversed(both):
                try:
                    series.add(contestants.pneud(track, rate_hz, turn_s, what), number)
                except AbsentError as e:
                    raise VerbError(str(e), 1) from None
        found[name] = {
            "what": (disturbance.__doc__ or "").strip(),
            "own_over_quiet": ratio_of_turns(disturbed, quiet, "own"),
            "quiet": quiet.as_object(),
            "disturbed": disturbed.as_object(),
        }
    return found


def _track(axis: Loaded, bus: str | None, scratch: Path) -> TrackScript:
    wanted = axis.config.realtime
    cpu = own_cpu(wanted.cpu)
    granted = {report.name: report for report in machine.attempt(wanted.priority, cpu, wanted.lock_memory)}
    for report in granted.values():
        if report.asked and not report.ok:
            print(f"pneud: {report.name}: {report.reason}", file=sys.stderr)
    channel = bus_name(bus, axis.config)
    with open_link(channel, virtual=True) as link:
        name = link.name if link.name.startswith("socketcan:") else None
    fifo, pinned = granted.get("fifo"), granted.get("affinity")
    return TrackScript(
        axis,
        axis.path,
        name,
        wanted.priority if fifo is not None and fifo.ok else 0,
        cpu if pinned is not None and pinned.ok else None,
        scratch,
    )


def _take_turns(
    field: Mapping[str, Contestant], track: TrackScript, pairs: int, turn_s: float, report: Report
) -> tuple[dict[str, Samples], dict[str, str]]:
    series = {name: Samples(name, one.what) for name, one in field.items()}
    missing: dict[str, str] = {}
    rate_hz = track.axis.config.loop.rate_hz
    for number in range(pairs):
        # to and fro, so that nobody always has the same one before him
        for place, name in enumerate(field if number % 2 == 0 else reversed(list(field))):
            report("taking turns", number * len(field) + place, pairs * len(field), "turns")
            if name in missing:
                continue
            try:
                series[name].add(field[name].turn(track, rate_hz, turn_s), number)
            except AbsentError as e:
                missing[name] = str(e)
    return {name: one for name, one in series.items() if one.turn_numbers}, missing


def _find_rates(
    series: Mapping[str, Samples],
    field: Mapping[str, Contestant],
    track: TrackScript,
    rate_s: float,
    report: Report,
) -> None:
    quick = rates.without_bus_time(track)
    for number, (name, one) in enumerate(series.items()):
        if field[name].has_rate:
            report("highest rates", number, len(series), "programs")
            try:
                one.highest_rate_hz = rates.highest(field[name].turn, quick, rate_s)
            except AbsentError as e:
                one.notes.append(f"highest rate not found: {e}")
