"""The same axis and plant in simulated time, faster than real time, the same for a seed."""

from __future__ import annotations

import importlib.util
import json as json_
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.config.sections import ConfigError
from pneud.loading import Loaded, load
from pneud.log.files.naming import log_path, new_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import SNAPSHOT_S, LogHeader
from pneud.loop.summary import in_words, summarise
from pneud.loop.tally import Tally
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.moves import Course, moves_of
from pneud.replay.moves import in_words as moves_in_words
from pneud.safety.faults import FAULT_NAMES
from pneud.scenario import verdict
from pneud.scenario.files import load_axis, load_scenario
from pneud.scenario.format import Scenario
from pneud.signals import RequestKind, State
from pneud.study.comparison import as_json, compare
from pneud.study.comparison import in_words as compared
from pneud.verbs import JsonOption, ScenarioOption, SeedOption, VerbError

DURATION_S = 10.0
MOVE_S = 20.0  # at most, of each
MOST_REST_S = 600.0
NO_LOG = -1
GotoOption = Annotated[
    str | None,
    typer.Option("--goto", metavar="MM[@MM_S],…", help="Go to positions in turn, in place of tracking."),
]


def sim(
    config_file: Annotated[
        str | None, typer.Argument(metavar="FILE", help="Configuration; default virtual.toml.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="LOG", help="Write a log (.mcap).")
    ] = None,
    duration_s: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="Simulated time; default 10 s.")
    ] = None,
    goto: GotoOption = None,
    scenario_file: ScenarioOption = None,
    seed: SeedOption = 0,
    laws: Annotated[
        bool,
        typer.Option(
            "--compare", help="The law against its baselines, case by case; --duration is that of the rest."
        ),
    ] = False,
    json: JsonOption = False,
) -> int:
    """Simulate an axis, or compare its laws.

    Returns:
        Exit status: 0 where the axis tracks until the end, or has come to all positions; 1 where not.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LogError: the log cannot be written.
        BuildError: the compiled law is required and cannot be had.
        VerbError: an option does not go with another.
    """
    if laws:
        if output is not None or seed or scenario_file is not None or goto is not None:
            raise VerbError(
                "--compare writes no log and has its own seed; leave out -o, --seed, --scenario and --goto"
            )
        return _compare(config_file or "virtual.toml", DURATION_S if duration_s is None else duration_s, json)
    if scenario_file is not None and goto is not None:
        raise VerbError("--goto: a scenario's verdict is on tracking; leave out --scenario")
    scenario = _playable(scenario_file) if scenario_file is not None else None
    course = Course(moves_of(goto)) if goto is not None else None
    if duration_s is None:
        duration_s = _usual_s(scenario, course)
    if not 0.0 < duration_s <= 1e6:
        raise ConfigError(f"--duration {duration_s:g}: must lie between 0 and 1,000,000 s")
    loaded = load_axis(config_file, None, scenario)
    how = backend_of(loaded)
    operator = course.ask if course is not None else None
    run = Simulation(loaded, duration_s, seed, how, scenario=scenario, operator=operator)
    path = log_path(str(output), loaded.config.name) if output is not None else None
    with new_log(path) if path is not None else nullcontext(NO_LOG) as descriptor:
        writer = _writer(descriptor, loaded, seed, how.name) if path is not None else None
        tally, seen = _run(run, loaded.config.loop.rate_hz, writer, course)
        whole = writer is None or (writer.close() and not writer.unwritten)
    if writer is not None and not whole:
        why = os.strerror(writer.error) if writer.error > 0 else "some ticks fit into no log"
        print(f"pneud: {path}: could not be written whole: {why}", file=sys.stderr)
    summary = summarise(
        tally,
        bus="simulated",
        rate_hz=loaded.config.loop.rate_hz,
        counts=run.inbox.counts(),
        tx=run.tx,
        rx_dropped=0,
        log=str(path) if path is not None else None,
        log_dropped=writer.unwritten if writer is not None else 0,
    )
    if run.engine is not None and scenario is not None:
        run.engine.settle()
        summary["scenario"] = verdict.judge(scenario, loaded.config, seen, run.engine.effects.as_dict())
    if course is not None:
        summary["moves"] = course.results
    never = tally.never_armed() if course is None or not course.begun else None
    if never is not None:
        summary["never_armed"] = never
        print(f"pneud: never armed: {', '.join(never)}", file=sys.stderr)
    print(json_.dumps(summary) if json else _in_words(summary))
    good = course.good if course is not None else tally.state == State.TRACKING
    return 0 if good and not tally.ever_latched and whole else 1


def _playable(scenario_file: str) -> Scenario:
    scenario = load_scenario(scenario_file)
    if scenario.needs_machine:
        raise ConfigError(
            f"scenario {scenario.name}: takes a real machine; pneud --virtual --scenario plays it"
        )
    return scenario


def _usual_s(scenario: Scenario | None, course: Course | None) -> float:
    """How long a run is, unless `--duration` says otherwise [s]; moves end it before."""
    if course is not None:
        return DURATION_S + MOVE_S * len(course.results) + course.longest_s
    return scenario.duration_s if scenario is not None else DURATION_S


def _in_words(summary: dict[str, Any]) -> str:
    lines = [in_words(summary)]
    if "scenario" in summary:
        lines.append(verdict.in_words(summary["scenario"]))
    if "moves" in summary:
        lines.append(moves_in_words(summary["moves"]))
    return "\n".join(lines)


def _run(
    run: Simulation, rate_hz: float, writer: LogWriter | None, course: Course | None
) -> tuple[Tally, verdict.Observed]:
    """All ticks, counted and written down."""
    tally = Tally(truth=True, timed=False, sync=run.inbox.sync)
    seen = verdict.Observed()
    snapshot_ticks, written = max(1, round(SNAPSHOT_S * rate_hz)), 0
    for record in run.records():
        tally.add(record, ending=run.shut)
        if course is not None:
            course.see(record)
        request = record.tick.request
        if request is not None and request.kind == RequestKind.ARM:
            tally.asked_to_arm(record.tick)
        if not run.shut:
            seen = seen.then(record.tick)
        if writer is not None:
            writer.write(record)
            written += 1
            if written % snapshot_ticks == 0:
                writer.snapshot(run.turn.freeze())
    if run.axis.failure is not None:
        print(f"pneud: exception in the cycle: {run.axis.failure!r}", file=sys.stderr)
    return tally, seen


def _writer(descriptor: int, loaded: Loaded, seed: int, law: str) -> LogWriter:
    return LogWriter(
        descriptor,
        LogHeader(
            name=loaded.config.name,
            bus="simulated",
            rate_hz=loaded.config.loop.rate_hz,
            detail=loaded.config.log.detail,
            config_name=loaded.path.name,
            config_text=loaded.text,
            dbc_name=loaded.dbc.name,
            dbc=loaded.dbc.read_bytes(),
            fault_names=FAULT_NAMES,
            realtime_offset_ns=0,
            extra={"seed": str(seed), "law": law},
        ),
    )


def _compare(config_file: str, rest_s: float, json: bool) -> int:
    """Run every law through every case and print the tables."""
    if not 1.0 <= rest_s <= MOST_REST_S:
        raise ConfigError(f"--duration {rest_s:g}: with --compare, between 1 and {MOST_REST_S:g} s")
    compiled = importlib.util.find_spec("numba") is not None
    if not compiled:
        print("pneud: three cases only without numba; for all: pip install 'pneud[sim]'", file=sys.stderr)
    found = compare(load(config_file), rest_s, compiled)
    print(json_.dumps(as_json(found)) if json else compared(found))
    return 0
