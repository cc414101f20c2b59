"""What must not disturb the loop: a recorder that stands still, a busy disk, curious clients, busy CPUs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from pneud import crew

DISK_BYTES_S = 100_000_000
CLIENTS = 10
CLIENT_HZ = 20

_WRITER = f"""
import os, sys, time
block, n = os.urandom(1_000_000), 0
with open(sys.argv[1], "wb", buffering=0) as f:
    begin = time.monotonic()
    while True:
        f.write(block)
        n += 1
        if n % 500 == 0:
            f.seek(0)
        time.sleep(max(0.0, begin + n * len(block) / {DISK_BYTES_S} - time.monotonic()))
"""
_POLLER = f"""
import sys, time
from pneud.console.client import Client
clients = [Client(sys.argv[1]) for _ in range({CLIENTS})]
print("connected", flush=True)
while True:
    for client in clients:
        client.ask("status")
    time.sleep({1 / CLIENT_HZ})
"""
_HOG = "while True: pass"


class DisturbedRun(NamedTuple):
    """A run of pneud to be disturbed."""

    members: Mapping[str, int]  # process ids by name
    socket: Path  # of its console
    scratch: Path


Disturb = Callable[[DisturbedRun], AbstractContextManager[None]]


@contextmanager
def recorder_stopped(run: DisturbedRun) -> Iterator[None]:
    """The recorder does not run."""
    os.kill(run.members["recorder"], signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(run.members["recorder"], signal.SIGCONT)


@contextmanager
def disk_written(run: DisturbedRun) -> Iterator[None]:
    """Somebody writes 100 MB/s to the disk that the log is on."""
    file = run.scratch / "written"
    try:
        with _processes([_WRITER, str(file)]):
            yield
    finally:
        file.unlink(missing_ok=True)


@contextmanager
def console_polled(run: DisturbedRun) -> Iterator[None]:
    """Ten clients of the console ask for the status twenty times a second each."""
    with _processes([_POLLER, str(run.socket)]) as (poller,):
        assert poller.stdout is not None
        poller.stdout.readline()
        yield


@contextmanager
def cpus_busy(run: DisturbedRun) -> Iterator[None]:  # noqa: ARG001 - the others need it
    """On every CPU a process of normal priority never rests."""
    with _processes(*([_HOG] for _ in range(os.cpu_count() or 1))):
        yield


DISTURBANCES: Mapping[str, Disturb] = {
    "recorder": recorder_stopped,
    "disk": disk_written,
    "console": console_polled,
    "cpu": cpus_busy,
}


@contextmanager
def _processes(*programs: list[str]) -> Iterator[list[subprocess.Popen[str]]]:
    with ExitStack() as begun:
        yield [
            begun.enter_context(
                crew.program(sys.executable, "-c", *program, out=subprocess.PIPE, err=subprocess.DEVNULL)
            )
            for program in programs
        ]
