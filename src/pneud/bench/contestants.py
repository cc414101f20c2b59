"""The contestants: each takes a turn of a second or so in a process of its own and yields a `Sample`."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import NamedTuple

from pneud import crew, resources
from pneud.bench.disturbances import Disturb, DisturbedRun
from pneud.bench.law_cost import header
from pneud.bench.sample import QUANTITIES, ProcessState, Sample, from_object, process_state
from pneud.loading import Loaded
from pneud.log.files.reader import read_log
from pneud.rt import folders
from pneud.signals import ALL_SOURCES
from pure2c.build import EXACT

SETTLE_S = 0.6  # of a run of pneud, before its ticks count: first touches, joining the reference
PATIENCE_S = 30.0
DRAIN_NS = 60_000  # longest that the look for left-over frames before SYNC usually takes
CHILDREN = ("recorder", "console", "plant")
CYCLICTEST_MOST_US = 100_000
_PNEUD = (sys.executable, "-m", "pneud.cli")
_PIPE = subprocess.PIPE


class AbsentError(Exception):
    """A contestant cannot take part; the text is one line for a person."""


class TrackScript(NamedTuple):
    """Where the turns take place."""

    axis: Loaded
    config_file: Path  # for the processes
    bus: str | None  # a SocketCAN bus; None for a new unixcan channel in every turn
    priority: int  # of SCHED_FIFO as the machine grants it, 0 for none
    cpu: int | None
    scratch: Path


Turn = Callable[[TrackScript, float, float], Sample]
"""(track, rate [Hz], time [s]) → what it came to; raises AbsentError."""


def cyclictest(track: TrackScript, rate_hz: float, seconds: float) -> Sample:
    """The kernel's own measure at the same priority and interval, in whole microseconds."""
    program = shutil.which("cyclictest")
    if program is None:
        raise AbsentError("cyclictest is not installed: apt install rt-tests")
    found = track.scratch / f"cyclictest-{secrets.token_hex(3)}.json"
    scheduling = ["-p", str(track.priority)] if track.priority else ["--policy=other"]
    pinned = ["-a", str(track.cpu)] if track.cpu is not None else []
    loops, interval_us = max(1, round(rate_hz * seconds)), round(1e6 / rate_hz)
    _run(
        [
            *(program, "-q", "-m", "-t1", f"-i{interval_us}", f"-l{loops}", f"-h{CYCLICTEST_MOST_US}"),
            *(f"--json={found}", *scheduling, *pinned),
        ],
        seconds,
    )
    return cyclictest_sample(found.read_text(), interval_us)


def cyclictest_sample(text: str, interval_us: int) -> Sample:
    """A sample from what cyclictest writes with --json.

    Like ours, it goes on with the next grid point to come: whole periods that a wake-up was late are ticks
    skipped.
    """
    thread = json.loads(text)["thread"]["0"]
    counts = {int(us): n for us, n in thread["histogram"].items()}
    # the middle of its microsecond is the best guess
    lateness_ns = [us * 1000 + 500 for us, n in sorted(counts.items()) for _ in range(n)]
    beyond = thread["cycles"] - len(lateness_ns)
    lateness_ns += [thread["max"] * 1000] * max(0, beyond)
    skipped = sum(one // (interval_us * 1000) for one in lateness_ns)
    return Sample({"lateness": lateness_ns, "wakeup": lateness_ns}, thread["cycles"], skipped)


def empty(track: TrackScript, rate_hz: float, seconds: float) -> Sample:
    """An empty Python loop with absolute deadlines."""
    words = (str(rate_hz), str(seconds), *_scheduling(track))
    done = _run([sys.executable, "-m", "pneud.bench.empty", *words], seconds)
    return from_object(json.loads(done))


def notifier(track: TrackScript, rate_hz: float, seconds: float) -> Sample:
    """A Notifier of python-can and time.sleep, with the same law."""
    with _plant(track) as bus:
        words = (str(track.config_file), bus, str(rate_hz), str(seconds), *_scheduling(track))
        return from_object(json.loads(_run([sys.executable, "-m", "pneud.bench.notifier", *words], seconds)))


def c_program(track: TrackScript, rate_hz: float, seconds: float) -> Sample:
    """The same frames and the same law in C."""
    if track.axis.dbc.read_bytes() != (resources.configs() / "pneud.dbc").read_bytes():
        raise AbsentError(f"the C program speaks pneud.dbc only, not {track.axis.dbc.name}")
    place = track.scratch / f"c-{track.config_file.stem}"
    program = place / "loop"
    if not program.exists():
        place.mkdir(exist_ok=True)
        build(program, track.axis)
    with _plant(track) as bus:
        kind, _, name = bus.partition(":")
        where = f"can:{name}" if kind == "socketcan" else f"unix:{folders.runtime_folder() / 'can' / name}"
        words = (where, str(rate_hz), str(seconds), *_scheduling(track))
        deadline = str(track.axis.config.loop.set_deadline)
        return from_object(json.loads(_run([str(program), *words, deadline], seconds)))


def build(program: Path, axis: Loaded) -> None:
    """Build the C program for an axis with the system's compiler; its folder takes the law's C.

    Raises:
        AbsentError: there is no compiler, or it fails.
    """
    compiler = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)
    if compiler is None:
        raise AbsentError("there is no C compiler: apt install gcc libc6-dev")
    source = resources.bench() / "loop.c"
    (program.parent / "law.h").write_text(header(axis))
    command: list[str | Path] = [compiler, *EXACT, "-I", program.parent, "-o", program, source, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise AbsentError(f"{source} cannot be compiled: {(done.stderr.splitlines() or ['no reason'])[0]}")


def pneud(track: TrackScript, rate_hz: float, seconds: float, disturb: Disturb | None = None) -> Sample:
    """Our loop, as `pneud --virtual` runs it; durations come from its log.

    Raises:
        AbsentError: it could not run.
    """
    log = track.scratch / f"{secrets.token_hex(3)}.mcap"
    socket = log.with_suffix(".sock")
    words = ["--virtual", "--headless", "--json", "--config", str(track.config_file)]
    words += ["--bus", _bus_of(track), "--rate", f"{rate_hz:g}", "--duration", str(seconds + SETTLE_S + 0.2)]
    words += ["--log", str(log), "--socket", str(socket)]
    began_ns = time.monotonic_ns()
    try:
        with crew.program(*_PNEUD, *words, out=_PIPE, err=_PIPE) as process:
            members = _members(process)
            time.sleep(SETTLE_S)
            with nullcontext() if disturb is None else disturb(DisturbedRun(members, socket, track.scratch)):
                used = _usage(members, seconds)
            out, err = process.communicate(timeout=PATIENCE_S)
    except (OSError, subprocess.TimeoutExpired) as e:
        raise AbsentError(f"pneud ended early or never: {e}") from None
    if not out:
        raise AbsentError((err.splitlines() or ["pneud said nothing"])[-1])
    summary = json.loads(out)
    sample = sample_of_log(log, round(SETTLE_S * rate_hz), round(seconds * rate_hz), began_ns)
    log.unlink()
    note = f"faults: {', '.join(summary['faults'])}" if summary["faults"] else ""
    if summary["faults"] or summary["log_dropped"]:
        sample = sample._replace(note=note or f"{summary['log_dropped']} records lost")
    if used is None:
        return sample
    (before, after), elapsed_s = used, seconds
    loop = after["loop"]
    return sample._replace(
        elapsed_s=elapsed_s,
        cpu_s={name: after[name].cpu_s - before[name].cpu_s for name in members},
        page_faults=loop.page_faults - before["loop"].page_faults,
        switches=(loop.voluntary - before["loop"].voluntary, loop.involuntary - before["loop"].involuntary),
    )


def sample_of_log(log: Path, first: int, count: int, began_ns: int | None = None) -> Sample:
    """The durations of some ticks of a log, by their numbers.

    Raises:
        LogError: the log cannot be read.
    """
    found: dict[str, list[int]] = {name: [] for name in QUANTITIES}
    ticks = skipped = incomplete = 0
    ended_ns = 0  # the tick before
    last: tuple[int, int, int] | None = None  # read, cycle, write of the tick before, if it was complete
    start_ns = None
    for number, logged in enumerate(read_log(log)):
        if number == 0 and began_ns is not None:
            start_ns = logged.t_ns - began_ns
        if number < first:
            continue
        if number > first + count:
            break
        t = logged.timing
        if last is not None and t.record_ns >= 0:
            for name, value in zip(("read", "cycle", "write", "record"), (*last, t.record_ns), strict=True):
                found[name].append(value)
            found["own"].append(sum(last) + t.record_ns)
        last = None
        if number == first + count:
            break
        ticks += 1
        skipped += logged.measurement.skipped
        found["lateness"].append(t.lateness_ns)
        if ended_ns + max(0, t.record_ns) < logged.t_ns - t.lateness_ns - DRAIN_NS:
            found["wakeup"].append(t.lateness_ns)
        ended_ns = logged.t_ns + t.set_ns + t.cycle_ns + t.send_ns
        if logged.measurement.fresh != ALL_SOURCES:
            incomplete += 1
        elif t.latency_ns >= 0:
            found["latency"].append(t.latency_ns)
            newest_ns = logged.frames[-1].stamp_ns
            last = (logged.t_ns + t.set_ns - newest_ns, t.cycle_ns, t.send_ns)
    return Sample(found, ticks, skipped, incomplete, start_ns=start_ns)


def _members(process: subprocess.Popen[str]) -> dict[str, int]:
    """The processes of a run, as soon as it has all of them: they are forked in this order."""
    deadline = time.monotonic() + PATIENCE_S
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    while True:
        found = [int(word) for word in children.read_text().split()]
        if len(found) >= len(CHILDREN):
            return {"loop": process.pid, **dict(zip(CHILDREN, found, strict=False))}
        if process.poll() is not None or time.monotonic() > deadline:
            _, err = process.communicate(timeout=PATIENCE_S)
            raise AbsentError((err.splitlines() or ["pneud did not start"])[-1])
        time.sleep(0.01)


def _usage(
    members: dict[str, int], seconds: float
) -> tuple[dict[str, ProcessState], dict[str, ProcessState]] | None:
    """What each process has used before and after `seconds`; None where the run ends sooner."""
    try:
        before = {name: process_state(pid) for name, pid in members.items()}
        time.sleep(seconds)
        return before, {name: process_state(pid) for name, pid in members.items()}
    except (OSError, IndexError, KeyError):
        return None


def _scheduling(track: TrackScript) -> tuple[str, str]:
    return str(track.priority), str(-1 if track.cpu is None else track.cpu)


def _bus_of(track: TrackScript) -> str:
    return track.bus or f"unixcan:bench-{os.getpid()}-{secrets.token_hex(3)}"


@contextmanager
def _plant(track: TrackScript) -> Iterator[str]:
    """The software plant on a bus, for those who bring none; yields the bus."""
    bus = _bus_of(track)
    with crew.program(*_PNEUD, "plant", "--config", track.config_file, "--bus", bus, err=_PIPE) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        if not line.startswith("plant "):
            raise AbsentError(line.strip() or "the plant did not start")
        time.sleep(0.05)
        yield bus


def _run(command: list[str], seconds: float) -> str:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=seconds + PATIENCE_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as e:
        raise AbsentError(f"{Path(command[0]).name}: {e}") from None
    if done.returncode:
        said = done.stderr.strip().splitlines() or done.stdout.strip().splitlines() or ["no reason given"]
        raise AbsentError(f"{Path(command[0]).name} failed: {said[-1]}")
    return done.stdout
