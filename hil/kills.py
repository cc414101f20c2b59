"""Kills the daemon again and again while the load moves; the plant's valve node has to centre by itself.

    .venv/bin/python hil/kills.py 200

After every kill: the valve node says that it timed out, the log is readable and lacks no more than 0.2 s
before the kill, and the next daemon comes up disarmed and centred. Exit status: 0 where all held, 1 else.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from pneud.log.reader import LogReader
from pneud.signals import State

PNEUD = [sys.executable, "-m", "pneud.cli"]
LOST_S = 0.2
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


def one(number: int, plant: Plant, bus: str, config: str, folder: Path, after_s: float) -> list[str]:
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
        return [f"never armed: {daemon.communicate()[1].strip()}"]
    time.sleep(after_s)
    others = children(daemon.pid)
    killed = time.monotonic()
    os.kill(daemon.pid, signal.SIGKILL)
    daemon.wait()
    if plant.said("valve node: timed_out", killed, 5.0) is None:
        problems.append("the valve node did not centre")
    deadline = time.monotonic() + PATIENCE_S
    while not gone(others) and time.monotonic() < deadline:
        time.sleep(0.01)
    reader = LogReader([log])
    last_ns = 0
    engaged = False
    for tick in reader:
        last_ns = tick.t_ns
        engaged = tick.state == State.TRACKING
    lost_s = killed - last_ns * 1e-9
    if lost_s > LOST_S or not engaged:
        problems.append(f"the log lacks {lost_s:.3f} s (state at its end engaged: {engaged})")
    log.unlink()

    again = folder / f"{number}-again.mcap"
    done = subprocess.run(
        [*command, str(again), "--duration", "0.2"], capture_output=True, text=True, timeout=60, check=False
    )
    if not done.stdout:
        return [*problems, f"did not come up again: {done.stderr.strip()}"]
    summary = json.loads(done.stdout)
    if done.returncode or summary["state"] not in ("disarmed", "waiting"):
        problems.append(f"came up {summary['state']}, {summary['faults']}")
    if any(tick.sent[1].data[:3] != bytes(3) for tick in LogReader([again])):
        problems.append("a command other than 0 V, disabled, after the restart")
    again.unlink()
    return problems


def main() -> int:
    """The command."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    chance = random.Random(seed)
    bus = f"unixcan:kills-{os.getpid()}"
    began, bad = time.monotonic(), 0
    with tempfile.TemporaryDirectory() as temporary:
        plant = Plant(bus, "virtual.toml")
        try:
            plant.said("plant", 0.0, PATIENCE_S)
            for number in range(count):
                problems = one(number, plant, bus, "virtual.toml", Path(temporary), chance.uniform(0.3, 2.3))
                bad += bool(problems)
                print(f"kill {number}: {'; '.join(problems) or 'as it should be'}", flush=True)
        finally:
            plant.process.terminate()
            plant.process.wait(10)
    print(f"{count} kills, {bad} bad, {time.monotonic() - began:.0f} s")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
