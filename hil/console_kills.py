"""Takes the console away again and again at random instants, while an operator has engaged the axis.

    .venv/bin/python hil/console_kills.py 100

In turn it tracks, jogs, moves and homes, and in turn the console is killed (SIGKILL) or stands still
(SIGSTOP). After every one: the axis is at rest within 1 s, `console_lost` is named, the next console answers,
and takes `clear`; in the end the whole log is replayed, and has to be identical.

Exit status: 0 where all held, 1 else.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from pneud import resources
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.log.files.reader import read_log
from pneud.log.format.records import LoggedTick
from pneud.safety.faults import F
from pneud.safety.supervisor import is_engaged

PNEUD = [sys.executable, "-m", "pneud.cli"]
ACTIVITIES = ("tracking", "jogging", "moving", "homing")
REST_S = 1.0
PATIENCE_S = 60.0
LOST = 1 << F.CONSOLE_LOST


class Lost(NamedTuple):
    """One that was taken away."""

    activity: str
    number: int
    at_s: float


def children(pid: int) -> list[int]:
    """Process ids of a process's children, the oldest first."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def console_of(daemon: int) -> int:
    """The console's process id: its keeper is the daemon's second child."""
    return children(children(daemon)[1])[0]


def until(holds: Callable[[], Any], what: str) -> None:
    """Wait until something holds.

    Raises:
        TimeoutError: it never did; why is told.
    """
    deadline, why = time.monotonic() + PATIENCE_S, ""
    while time.monotonic() < deadline:
        try:
            if holds():
                return
        except (PlaceError, RefusedError) as e:
            why = f"; {e}"
        time.sleep(0.05)
    raise TimeoutError(what + why)


def ask(socket: str, verb: str, **fields: Any) -> dict[str, Any]:
    """One request of one client."""
    with Client(socket) as client:
        return client.ask(verb, **fields)


def begin(client: Client, activity: str) -> None:
    """Let a disarmed axis do something."""
    if activity == "homing":
        client.ask("home")
        return
    client.ask("arm")
    if activity == "tracking":
        client.ask("track", what="reference")
        return
    x_mm, limits = client.ask("status")["position_mm"], client.ask("status")["limits"]
    forward = x_mm < 0.5 * (limits["min_mm"] + limits["max_mm"])
    if activity == "jogging":
        client.ask("jog", velocity_mm_s=60.0 if forward else -60.0, lease_s=1.0)
    else:
        client.ask("goto", x_mm=limits["max_mm"] if forward else limits["min_mm"], speed_mm_s=100.0)


def home(socket: str) -> None:
    """Give a disarmed axis its reference where it has none: a homing that was cut short leaves none."""
    until(lambda: ask(socket, "status")["state"] == "disarmed", "disarmed")
    if "encoder_unreferenced" not in [fault["name"] for fault in ask(socket, "status")["faults"]]:
        return
    until(lambda: ask(socket, "home"), "homes")
    until(lambda: ask(socket, "status")["state"] == "holding", "homed")
    ask(socket, "disarm")


def recover(client: Client, refusal: RefusedError) -> None:
    """Get the axis back to where it can be asked again; a fault of a machine that is too busy is told."""
    status = client.ask("status")
    latched = [fault["name"] for fault in status["faults"] if fault["latched"]]
    if latched:
        print(f"{refusal}; held by {', '.join(latched)}", flush=True)
    for verb in ("clear",) if status["state"] == "fault" else ("disarm",):
        with contextlib.suppress(RefusedError):
            client.ask(verb)
    time.sleep(0.2)


def one(daemon: int, socket: str, activity: str, number: int, after_s: float) -> Lost:
    """Take the console away, `after_s` after something has begun, and get the axis back."""
    until(lambda: ask(socket, "status")["state"] == "disarmed", "disarmed")
    with Client(socket) as client:
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                begin(client, activity)
                break
            except RefusedError as e:  # the load still swings on the trapped air
                if time.monotonic() > deadline:
                    raise
                recover(client, e)
        time.sleep(after_s)
        console, at_s = console_of(daemon), time.monotonic()
        os.kill(console, number)
    until(lambda: ask(socket, "status")["state"] == "fault", "fault")
    until(lambda: ask(socket, "clear"), "cleared")
    return Lost(activity, number, at_s)


def judged(lost: list[Lost], ticks: list[LoggedTick]) -> tuple[list[str], list[float]]:
    """What was not as it should be, and how long each took to come to rest [s]."""
    problems, rests = [], []
    for n, (activity, number, at_s) in enumerate(lost):
        name = f"{n} ({activity}, signal {number})"
        until_s = lost[n + 1].at_s if n + 1 < len(lost) else float("inf")
        later = [t for t in ticks if at_s <= t.t_ns * 1e-9 < until_s]
        rest = next((t for t in later if not is_engaged(t.state)), None)
        if not later or not is_engaged(later[0].state):
            problems.append(f"{name}: was not engaged")
        elif rest is None:
            problems.append(f"{name}: never at rest")
        else:
            rests.append(rest.t_ns * 1e-9 - at_s)
            if rest.latched != LOST:
                problems.append(f"{name}: latched {rest.latched:#x}")
            if rests[-1] > REST_S:
                problems.append(f"{name}: at rest after {rests[-1]:.3f} s")
    return problems, rests


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Takes the console away at random instants.")
    parser.add_argument("count", nargs="?", type=int, default=100, help="how often")
    parser.add_argument("--seed", type=int, default=1, help="of the instants")
    given = parser.parse_args()
    count, chance = given.count, random.Random(given.seed)
    began, lost = time.monotonic(), list[Lost]()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        axis, log, socket = folder / "axis.toml", folder / "run.mcap", str(folder / "s")
        text = (resources.configs() / "virtual.toml").read_text()
        text = text.replace("_timeout_ms = 50.0", "_timeout_ms = 250.0")  # as a shared machine needs it
        text = text.replace('kind = "absolute"', 'kind = "incremental"')
        axis.write_text(text.replace("\nspeed_m_s = 0.02\n", "\nspeed_m_s = 0.1\n"))  # of homing
        bus = ["--config", str(axis), "--bus", f"unixcan:console-kills-{os.getpid()}"]
        plant = subprocess.Popen([*PNEUD, "plant", *bus], stderr=subprocess.DEVNULL)
        daemon = subprocess.Popen(
            [*PNEUD, *bus, "--headless", "--json", "--socket", socket, "--log", str(log)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        try:
            until(lambda: ask(socket, "status")["state"] == "disarmed", "began")
            for n in range(count):
                home(socket)
                activity = ACTIVITIES[n // 2 % len(ACTIVITIES)]
                number = (signal.SIGKILL, signal.SIGSTOP)[n % 2]
                longest_s = 0.7 if activity == "jogging" else 2.0  # a jog is not renewed here
                lost.append(one(daemon.pid, socket, activity, number, chance.uniform(0.0, longest_s)))
                print(f"{n}: {activity}, signal {number}", flush=True)
        finally:
            daemon.terminate()
            daemon.communicate(timeout=PATIENCE_S)
            plant.terminate()
            plant.wait(PATIENCE_S)
        problems, rests = judged(lost, list(read_log(log)))
        done = subprocess.run([*PNEUD, "replay", str(log), "--json"], capture_output=True, check=False)
        again = json.loads(done.stdout)
        if not again["identical"]:
            problems.append(f"the replay is not identical: {again}")
        if problems:
            kept = Path(tempfile.gettempdir(), f"console-kills-{os.getpid()}.mcap")
            print(f"the log is kept: {shutil.copy(log, kept)}")
    for problem in problems:
        print(f"PROBLEM {problem}")
    replayed = "identical" if again["identical"] else "differs"
    print(
        f"{count} consoles taken away, {len(problems)} problems; at rest after"
        f" {statistics.median(rests or [0.0]):.3f} s in the middle,"
        f" {max(rests, default=0.0):.3f} s at the latest; replay of {again['ticks']} ticks {replayed};"
        f" {time.monotonic() - began:.0f} s"
    )
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
