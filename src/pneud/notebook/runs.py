"""Runs in simulated time, kept as logs."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pneud.config.models import Config
from pneud.config.reading import load_with_text, parse
from pneud.config.sections import ConfigError
from pneud.config.toml import changed_text, toml_text
from pneud.console.tuning import NAMES, keys
from pneud.loading import Loaded, complete
from pneud.log.files.naming import LogError, create_log
from pneud.log.files.writer import LogWriter
from pneud.loop.summary import summarise
from pneud.notebook.logs import Log
from pneud.notebook.summary import SIMULATED, Summary
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.running import through
from pneud.scenario import verdict
from pneud.scenario.files import in_simulation, load_scenario
from pneud.scenario.format import Scenario

DURATION_S = 10.0
MOST_S = 1e6
Gains = Mapping[str, float | str]


class Run(Log):
    """A simulated run: a log in a temporary file, which goes with the object.

    Examples:
        >>> run = pneud.simulate(duration_s=0.3, seed=1)
        >>> len(run.columns("error_m")["error_m"]) > 300
        True
    """

    def __init__(self, folder: Path, file: Path) -> None:
        super().__init__([file])
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)

    def save(self, path: str | Path) -> Path:
        """Keep the log as a file, which must not exist; and where that is.

        Examples:
            >>> run.save(folder / "kept.mcap").name
            'kept.mcap'

        Raises:
            LogError: the file exists, or cannot be made.
        """
        path = Path(path).expanduser()
        with os.fdopen(create_log(path), "wb") as file:
            file.write(self.path.read_bytes())
        return path


def simulate(
    config: str | Path | Config | None = None,
    duration_s: float | None = None,
    seed: int = 0,
    *,
    scenario: str | Path | Scenario | None = None,
    gains: Gains | None = None,
) -> Run:
    """A run in simulated time, with what comes to rest after it; the same for a seed.

    Args:
        config: a file, the bare name of one that comes with pneud, or a configuration; None for the
            scenario's, else virtual.toml.
        duration_s: until the axis is told to shut down; None for the scenario's, else 10 s.
        seed: of the sensors' noise, and of what a scenario leaves to chance.
        scenario: faults to inject: a file, the name of one that comes with pneud, or a scenario.
        gains: other values than the configuration's, by the names of `pneud tune` or any of its keys.

    Examples:
        >>> run = pneud.simulate("virtual.toml", duration_s=0.6, gains={"k1": 90000.0})
        >>> run.config.control.k1
        90000.0
        >>> run.summary["faults"]
        []

    Raises:
        ConfigError: configuration, scenario or gains cannot be used.
        DatabaseError: the DBC cannot be used.
        BuildError: the compiled law is required and cannot be had.
    """
    if isinstance(scenario, str | Path):
        scenario = load_scenario(scenario)
    if scenario is not None:
        in_simulation(scenario)
    if duration_s is None:
        duration_s = DURATION_S if scenario is None else scenario.duration_s
    if not 0.0 < duration_s <= MOST_S:
        raise ConfigError(f"duration_s = {duration_s:g}: must lie between 0 and {MOST_S:,.0f} s")
    return _run(_loaded(config, scenario, gains or {}), duration_s, seed, scenario)


def tables(gains: Gains) -> dict[str, Any]:
    """Values by names of `pneud tune` or by keys, as tables like a configuration's."""
    found: dict[str, Any] = {}
    for name, value in gains.items():
        places = keys(name) if name in NAMES else (tuple(name.split(".")),)
        parts = value.split("-") if name == "law" and isinstance(value, str) else [value]
        for place, part in zip(places, parts, strict=False):
            table = found
            for step in place[:-1]:
                table = table.setdefault(step, {})
            table[place[-1]] = part
    return found


def _loaded(config: str | Path | Config | None, scenario: Scenario | None, gains: Gains) -> Loaded:
    if isinstance(config, Config):
        # what was not said stays unsaid: that there is none of what has a default, TOML cannot say
        said = config.model_dump(by_alias=True, exclude_unset=True)
        text, path = toml_text(said), Path(f"{config.name}.toml")
    else:
        default = "virtual.toml" if scenario is None else scenario.config
        _, text, path = load_with_text(default if config is None else config)
    changes = (scenario.change if scenario is not None else {}, tables(gains))
    for change in filter(None, changes):
        text = changed_text(text, change)
    return complete(parse(text, f"{path} as changed" if any(changes) else str(path)), text, path)


def _run(loaded: Loaded, duration_s: float, seed: int, scenario: Scenario | None) -> Run:
    how, c = backend_of(loaded), loaded.config
    simulation = Simulation(loaded, duration_s, seed, how, scenario=scenario)
    folder = Path(tempfile.mkdtemp(prefix="pneud-"))
    try:
        file = folder / f"{c.name}.mcap"
        header = header_of(loaded, seed=str(seed), law=how.name)._replace(detail="full")
        writer = LogWriter(create_log(file), header)
        tally, seen = through(simulation, c.loop.rate_hz, writer)
        if not writer.close() or writer.unwritten:
            raise LogError(f"{file}: cannot be written whole: {os.strerror(max(0, writer.error))}")
        run = Run(folder, file)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    run._summary = Summary(
        summarise(
            tally,
            bus=SIMULATED,
            rate_hz=c.loop.rate_hz,
            counts=simulation.inbox.counts(),
            tx=simulation.tx,
            rx_dropped=0,
            log=None,
            log_dropped=0,
        )
    )
    if simulation.engine is not None and scenario is not None:
        simulation.engine.settle()
        effects = simulation.engine.effects.as_dict()
        run.summary["scenario"] = verdict.judge(scenario, c, seen, effects, verdict.blind_spots(loaded))
    return run
