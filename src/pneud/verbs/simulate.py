"""The axis and the plant in simulated time."""

from __future__ import annotations

import json as json_
import os
import sys
from pathlib import Path

from pneud.config.models import ConfigError
from pneud.loading import Loaded
from pneud.log.files.naming import create_log, log_path
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import SNAPSHOT_S, LogHeader
from pneud.loop.summary import in_words, summarise
from pneud.loop.tally import Tally
from pneud.replay.lockstep import Simulation, backend_of
from pneud.safety.faults import FAULT_NAMES
from pneud.scenario import verdict
from pneud.scenario.files import load_axis, load_scenario
from pneud.signals import State

DURATION_S = 10.0


def simulate(
    config_file: str | None,
    output: Path | None,
    duration_s: float | None,
    seed: int,
    scenario_file: str | None,
    json: bool,
) -> int:
    """Simulate an axis.

    Args:
        config_file: of the axis; None takes the scenario's, or virtual.toml.
        output: where to write a log.
        duration_s: simulated time; None takes the scenario's, or 10 s.
        seed: of all that is random.
        scenario_file: faults to inject.
        json: print the result as one JSON object.

    Returns:
        Exit status: 0 where the axis tracks until the end, 1 where it does not.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LogError: the log cannot be written.
        BuildError: the compiled law is required and cannot be had.
    """
    scenario = load_scenario(scenario_file) if scenario_file is not None else None
    if scenario is not None and scenario.needs_machine:
        raise ConfigError(
            f"scenario {scenario.name}: takes a real machine; pneud --virtual --scenario plays it"
        )
    if duration_s is None:
        duration_s = scenario.duration_s if scenario is not None else DURATION_S
    if not 0.0 < duration_s <= 1e6:
        raise ConfigError(f"--duration {duration_s:g}: must lie between 0 and 1,000,000 s")
    loaded = load_axis(config_file, None, scenario)
    how = backend_of(loaded)
    run = Simulation(loaded, duration_s, seed, how, scenario=scenario)
    writer, path = None, None
    if output is not None:
        path = log_path(str(output), loaded.config.name)
        writer = _writer(path, loaded, seed, how.name)
    tally = Tally(truth=True, timed=False)
    seen = verdict.Seen()
    snapshot_ticks, written = max(1, round(SNAPSHOT_S * loaded.config.loop.rate_hz)), 0
    for record in run.records():
        tally.add(record, run.axis.state.plan, ending=run.shut)
        if not run.shut:
            seen = seen.then(record.tick)
        if writer is not None:
            writer.write(record)
            written += 1
            if written % snapshot_ticks == 0:
                writer.snapshot(run.turn.freeze())
    lost = 0
    if writer is not None and not writer.close():
        lost = writer.unwritten
        print(f"pneud: {path}: could not be written whole: {os.strerror(writer.error)}", file=sys.stderr)
    if run.axis.failure is not None:
        print(f"pneud: exception in the cycle: {run.axis.failure!r}", file=sys.stderr)
    summary = summarise(
        tally,
        bus="simulated",
        rate_hz=loaded.config.loop.rate_hz,
        counts=run.inbox.counts(),
        tx=run.tx,
        rx_dropped=0,
        log=str(path) if path is not None else None,
        log_dropped=lost,
    )
    if run.engine is not None and scenario is not None:
        run.engine.settle()
        summary["scenario"] = verdict.judge(scenario, loaded.config, seen, run.engine.effects.as_dict())
    print(json_.dumps(summary) if json else in_words(summary))
    if scenario is not None and not json:
        print(verdict.in_words(summary["scenario"]))
    return 0 if tally.state == State.TRACKING and not tally.ever_latched and not lost else 1


def _writer(path: Path, loaded: Loaded, seed: int, law: str) -> LogWriter:
    return LogWriter(
        create_log(path),
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
