"""Writes the golden logs anew: python tests/golden/refresh.py [NAME…]. README.md says when."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from pneud.loading import load
from pneud.log.files.naming import create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.replay.lockstep import Simulation, header_of
from pneud.replay.replaying import replay
from pneud.safety.faults import names
from pneud.scenario.files import load_scenario
from pneud.signals import Request, RequestKind

FOLDER = Path(__file__).parent
SNAPSHOT_TICKS = 200
ARM = Request(RequestKind.ARM)


class Golden(NamedTuple):
    """A simulated run that is kept."""

    duration_s: float
    config: str = "virtual.toml"
    change: dict[str, Any] | None = None
    scenario: str | None = None
    requests: dict[int, Request] | None = None  # by tick
    seed: int = 1


SLOW = {"loop": {"rate_hz": 500.0}}  # half the size

LOGS = {
    "composite": Golden(0.8),
    "ismc": Golden(0.8, change={"control": {"law": "ismc"}}),
    "paper-case1": Golden(2.0, "paper-case1.toml"),
    "requests": Golden(
        1.5,
        change=SLOW,
        requests={
            60: ARM,
            100: Request(RequestKind.GOTO, (0.25, 0.0, 0.0, 0.0)),
            300: Request(RequestKind.JOG, (0.05, 50.0)),
            400: Request(RequestKind.STOP),
            450: Request(RequestKind.HOLD),
            500: Request(RequestKind.GOTO, (9.0, 0.0, 0.0, 0.0)),
            550: Request(RequestKind.TRACK, (0.0,)),
        },
    ),
    "encoder-missing": Golden(2.5, scenario="encoder-missing"),
    "valve-stuck-open": Golden(2.5, scenario="valve-stuck-open"),
    "supply-lost": Golden(2.5, scenario="supply-lost"),
    "frames-lost": Golden(1.5, scenario="frames-lost-now-and-then"),
}
VIRTUAL = "virtual"  # a run in real time, with the machine's own lateness


def simulated(name: str, path: Path) -> None:
    """Write one of `LOGS`, with a snapshot now and then."""
    golden = LOGS[name]
    scenario = load_scenario(golden.scenario) if golden.scenario is not None else None
    change = {**(scenario.change or {}), **SLOW} if scenario is not None else golden.change
    loaded = load(scenario.config if scenario is not None else golden.config, None, change)
    run = Simulation(loaded, golden.duration_s, golden.seed, scenario=scenario, requests=golden.requests)
    header = header_of(loaded, host="golden")._replace(detail="full")
    writer = LogWriter(create_log(path), header)
    for number, record in enumerate(run.records(), start=1):
        writer.write(record)
        if number % SNAPSHOT_TICKS == 0:
            writer.snapshot({"axis": run.axis.freeze(), "inbox": run.inbox.freeze()})
    writer.close()


def virtual(path: Path) -> None:
    """Run the daemon with the software plant."""
    text = load("virtual.toml").text.replace('detail = "compact"', 'detail = "full"')
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "virtual.toml"
        config.write_text(text)
        command = [sys.executable, "-m", "pneud.cli", "--virtual", "--config", str(config), "--headless"]
        subprocess.run(
            [*command, "--duration", "1", "--log", str(path)], check=True, stdout=subprocess.DEVNULL
        )


def main(chosen: list[str]) -> None:
    """Write the logs and say what is in them."""
    for name in chosen or [*LOGS, VIRTUAL]:
        path = FOLDER / f"{name}.mcap"
        path.unlink(missing_ok=True)
        if name == VIRTUAL:
            virtual(path)
        else:
            simulated(name, path)
        outcome = replay(read_log(path))
        latched, tracked = 0, 0
        for tick in read_log(path):
            latched |= tick.latched
            tracked += tick.state == 3
        print(
            f"{name:20} {path.stat().st_size // 1000:5} kB {outcome.ticks:6} ticks,"
            f" {outcome.engaged_ticks} engaged, {tracked} tracking, {outcome.first or 'identical'},"
            f" {','.join(names(latched)) or 'no fault'}"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
