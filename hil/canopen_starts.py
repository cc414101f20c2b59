"""Starts of a CANopen rig whose nodes misbehave, in real time over unixcan: ready, or one line.

    .venv/bin/python -m hil.canopen_starts                 # 60 starts, each kind of misbehaviour
    .venv/bin/python -m hil.canopen_starts --starts 13 --jobs 1

In each start a rig of three nodes and a daemon are processes of their own, as on a machine that is switched
on; one node misbehaves, differently for each seed (`plant.odd_nodes`). The daemon has to say that its nodes
are configured and started and could then be armed, or in one line which node, which object and what to do;
while it says so, nothing arms.

Exit status: 0 where every start ended so, 1 where one did not.
"""

from __future__ import annotations

import argparse
import os
import queue
import re
import secrets
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from pneud import resources
from pneud.config.reading import load_config
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.rig.slave import KINDS

PNEUD = [sys.executable, "-m", "pneud.cli"]
RATE_HZ = 100  # many run beside one another
PATIENCE_S = 60.0
READY_S = 10.0  # from "configured and started" until nothing is in the way of arming
HEAD = "pneud: nodes: "
STARTED = "configured and started"
LINE = re.compile(r"node \d+ \(\w+\), (0x[0-9A-F]{4}:[0-9A-F]{2} \S.*|boot-up): .+; .+")
ALWAYS_READY, NEVER_READY = {"healthy", "slow boot"}, {"silent", "bootloader", "never ready", "duplicate"}


class Start(NamedTuple):
    """What a start has come to."""

    seed: int
    kind: str
    ready: bool
    line: str  # that it ended with, where it is not ready
    seconds: float
    trouble: str  # what is wrong with that; empty where nothing is


@contextmanager
def process(words: list[str], folder: Path) -> Iterator[IO[str]]:
    """A command that runs meanwhile: what it says."""
    environment = os.environ | {"XDG_STATE_HOME": str(folder)}
    with subprocess.Popen(
        [*PNEUD, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment
    ) as child:
        assert child.stderr is not None
        try:
            yield child.stderr
        finally:
            child.kill()


def lines_of(said: IO[str]) -> queue.Queue[str]:
    """The lines as they come, taken by a thread; an empty one at the end."""
    found: queue.Queue[str] = queue.Queue()

    def take() -> None:
        for line in said:
            found.put(line.rstrip("\n"))
        found.put("")

    threading.Thread(target=take, daemon=True).start()
    return found


def axis_file(folder: Path, seed: int | None) -> Path:
    """The CANopen axis, with one node that misbehaves."""
    text = (resources.configs() / "canopen.toml").read_text()
    if seed is not None:
        text = text.replace("[plant]\n", f"[plant]\nodd_nodes = {seed}\n", 1)
    file = folder / f"axis-{seed}.toml"
    file.write_text(re.sub(r"_timeout_ms = 50\.0", "_timeout_ms = 250.0", text))
    return file


def start(seed: int) -> Start:
    """One start."""
    nodes = len(load_config("canopen.toml").bus.nodes)
    kind = KINDS[seed // nodes % len(KINDS)]
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        file, bus = axis_file(folder, seed), f"unixcan:starts-{os.getpid()}-{secrets.token_hex(3)}"
        rig = ["plant", "--bus", bus, "--config"]
        socket = folder / "s"
        daemon = ["--config", str(file), "--bus", bus, "--rate", str(RATE_HZ), "--headless"]
        with process([*rig, str(file)], folder) as said:
            said.readline()  # it is on the bus
            second = axis_file(folder, None) if kind == "duplicate" else None
            with process([*rig, str(second)] if second else ["--version"], folder) as also:
                also.readline()
                with process([*daemon, "--socket", str(socket)], folder) as told:
                    line, trouble = outcome(lines_of(told), socket)
    ready = not line and not trouble
    if not trouble:
        trouble = judged(kind, ready)
    return Start(seed, kind, ready, line, time.monotonic() - began, trouble)


def outcome(lines: queue.Queue[str], socket: Path) -> tuple[str, str]:
    """The line that a start ends with, if it is not ready; and what is wrong with how it ended."""
    end, notes = time.monotonic() + PATIENCE_S, list[str]()
    while time.monotonic() < end:
        try:
            line = lines.get(timeout=1.0)
        except queue.Empty:
            continue
        if not line:
            return "", "the daemon has ended"
        if not line.startswith(HEAD):
            continue
        if line.endswith(STARTED):
            return "", armable(socket)
        line = line.removeprefix(HEAD)
        if LINE.fullmatch(line):
            return line, "" if not arms(socket) else "it could be armed"
        notes.append(line)  # such as that a node has rebooted: not the end yet
    return "", f"neither ready nor a line after {PATIENCE_S:g} s: {'; '.join(notes)}"


def armable(socket: Path) -> str:
    """Why an axis whose nodes are ready cannot be armed; empty where it can."""
    end, why = time.monotonic() + READY_S, "no answer"
    while time.monotonic() < end:
        try:
            with Client(str(socket)) as client:
                found = client.ask("status")
        except PlaceError:
            time.sleep(0.1)
            continue
        why = ", ".join(fault["name"] for fault in found["faults"])
        if found["state"] == "disarmed" and not why:
            return ""
        time.sleep(0.05)
    return f"configured and started, and cannot be armed: {why}"


def arms(socket: Path) -> bool:
    """Whether an axis can be armed, which it must not."""
    try:
        with Client(str(socket)) as client:
            client.ask("arm")
    except (RefusedError, PlaceError):
        return False
    return True


def judged(kind: str, ready: bool) -> str:
    """What is wrong with how a start of a kind has ended."""
    if kind in ALWAYS_READY and not ready:
        return f"{kind}, and not ready"
    return f"{kind}, and ready" if kind in NEVER_READY and ready else ""


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Starts CANopen rigs whose nodes misbehave, in real time.")
    parser.add_argument("--starts", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--jobs", type=int, default=4, help="at a time: they wait for most of it")
    o = parser.parse_args()
    began, found = time.monotonic(), list[Start]()
    with ThreadPoolExecutor(o.jobs) as pool:
        for one in pool.map(start, range(o.first, o.first + o.starts)):
            found.append(one)
            word = "FAIL" if one.trouble else "ok  "
            told = one.trouble or one.line or "ready"
            print(f"{word} {one.seed:4} {one.kind:12} {one.seconds:5.1f} s  {told}", flush=True)
    kinds = Counter((one.kind, one.ready) for one in found)
    for kind in KINDS:
        print(f"{kind:12} {kinds[kind, True]:3} ready, {kinds[kind, False]:3} with a line")
    bad = sum(bool(one.trouble) for one in found)
    ready = sum(one.ready for one in found)
    print(
        f"{len(found)} starts: {ready} ready, {len(found) - ready - bad} with one line, {bad} otherwise;"
        f" {time.monotonic() - began:.0f} s"
    )
    return 0 if not bad else 1


if __name__ == "__main__":
    sys.exit(main())
