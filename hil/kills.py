"""Kills the daemon again and again while the load moves; the plant's valve node has to centre by itself.

    .venv/bin/python hil/kills.py 200

Every other time recorder and console are killed with it, as the end of a control group does. After every
kill: the valve node says that it timed out, the log is readable and lacks no more than 0.2 s before the kill
(0.5 s without its recorder), and the next daemon comes up disarmed and centred.

Exit status: 0 where all held, 1 else.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from pathlib import Path
from typing import NamedTuple

from pneud.log.files.reader import LogReader
from pneud.safety.supervisor import is_engaged
from pneud.signals import State

PNEUD = [sys.executable, "-m", "pneud.cli"]
LOST_S = 0.2
LOST_WITH_RECORDER_S = 0.5  # three looks of 40 ms and an open chunk of 100 ms, on a machine that may stall
PATIENCE_S = 30.0


class Plant:
    """The plant in a process of its own; `states` is what its valve node has said, and when."""

    def __init__(self, bus: str, config: str) -> None:
        self.process = subprocess.Popen(
            [*PNEUD, "plant", "--config", config, "--bus", bus], stderr=subprocess.PIPE, text=True
        )
        self.states: list[tuple[float, str]] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.states.append((time.monotonic(), line.strip()))

    def said(self, words: str, since: float, patience_s: float) -> float | None:
        """When it said something, or None where it did not."""
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            for at, line in self.states:
                if at >= since and words in line:
                    return at
            time.sleep(0.005)
        return None


def gone(pids: list[int]) -> bool:
    """Whether all processes have ended."""
    return not any(Path(f"/proc/{pid}").exists() for pid in pids)


def children(pid: int) -> list[int]:
    """Process ids of a process's children."""
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


class Kill(NamedTuple):
    """What came of one."""

    problems: list[str]
    centred_s: float = 0.0  # so long after the kill
    lost_s: float = 0.0  # of the log, before the kill
    speed_m_s: float = 0.0  # of the load, when the log ends


def one(number: int, plant: Plant, bus: str, config: str, folder: Path, after_s: float) -> Kill:
    """One kill, `after_s` after the valve was enabled."""
    problems: list[str] = []
    log = folder / f"{number}.mcap"
    began = time.monotonic()
    command = [*PNEUD, "--config", config, "--bus", bus, "--headless", "--json"]
    command += ["--socket", str(folder / "s"), "--log"]
    daemon = subprocess.Popen(
        [*command, str(log), "--arm"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    if plant.said("valve node: enabled", began, PATIENCE_S) is None:
        daemon.kill()
        return Kill([f"never armed: {daemon.communicate()[1].strip()}"])
    time.sleep(after_s)
    others, all_of_them = children(daemon.pid), number % 2 == 1
    killed = time.monotonic()
    for pid in (daemon.pid, *(others if all_of_them else ())):
        os.kill(pid, signal.SIGKILL)
    daemon.wait()
    centred = plant.said("valve node: timed_out", killed, 5.0)
    if centred is None:
        problems.append("the valve node did not centre")
    deadline = time.monotonic() + PATIENCE_S
    while not gone(others) and time.monotonic() < deadline:
        time.sleep(0.01)
    ended = deque(LogReader([log]), maxlen=1)
    if not ended:
        return Kill([*problems, "the log is empty"])
    last = ended[0]
    lost_s = killed - last.t_ns * 1e-9
    engaged = last.state == State.TRACKING
    if lost_s > (LOST_WITH_RECORDER_S if all_of_them else LOST_S) or not engaged:
        problems.append(f"the log lacks {lost_s:.3f} s (state at its end engaged: {engaged})")
    log.unlink()

    again = folder / f"{number}-again.mcap"
    done = subprocess.run(
        [*command, str(again), "--duration", "0.2"], capture_output=True, text=True, timeout=60, check=False
    )
    if not done.stdout:
        return Kill([*problems, f"did not come up again: {done.stderr.strip()}"])
    summary = json.loads(done.stdout)
    if done.returncode or summary["state"] not in ("disarmed", "waiting"):
        problems.append(f"came up {summary['state']}, {summary['faults']}")
    ticks = list(LogReader([again]))
    if any(is_engaged(tick.state) or tick.sent[1].data[:3] != bytes(3) for tick in ticks) or not ticks:
        problems.append("a command other than 0 V, disabled, after the restart")
    again.unlink()
    return Kill(problems, (centred or math.inf) - killed, lost_s, abs(last.estimate.velocity_m_s))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Kills the daemon at random instants in motion.")
    parser.add_argument("count", nargs="?", type=int, default=200, help="how often")
    parser.add_argument("--seed", type=int, default=1, help="of the instants")
    given = parser.parse_args()
    count, chance = given.count, random.Random(given.seed)
    bus = f"unixcan:kills-{os.getpid()}"
    began, kills = time.monotonic(), list[Kill]()
    with tempfile.TemporaryDirectory() as temporary:
        plant = Plant(bus, "virtual.toml")
        try:
            plant.said("plant", 0.0, PATIENCE_S)
            for number in range(count):
                kills.append(
                    one(number, plant, bus, "virtual.toml", Path(temporary), chance.uniform(0.3, 2.3))
                )
                print(f"kill {number}: {'; '.join(kills[-1].problems) or 'as it should be'}", flush=True)
        finally:
            plant.process.terminate()
            plant.process.wait(10)
    bad = sum(bool(kill.problems) for kill in kills)
    speeds = [kill.speed_m_s for kill in kills]
    print(
        f"{count} kills at {1e3 * min(speeds):.0f} to {1e3 * max(speeds):.0f} mm/s, {bad} bad:"
        f" centred {1e3 * max(kill.centred_s for kill in kills):.0f} ms after the kill at the latest,"
        f" log lost {1e3 * max(kill.lost_s for kill in kills[::2]):.0f} ms at most,"
        f" with the recorder {1e3 * max((kill.lost_s for kill in kills[1::2]), default=0.0):.0f} ms;"
        f" {time.monotonic() - began:.0f} s"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
