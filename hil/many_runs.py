"""A campaign by one process, by two, and by two workers of Dask; and with all of them killed at random.

    .venv/bin/python -m hil.many_runs                  # 10,000 runs of 10 s, 20 kills: a quarter of an hour
    .venv/bin/python -m hil.many_runs --runs 200 --kills 5

All ways have to come to the same file to the last byte. Where worker, scheduler and client are killed
(SIGKILL) at random instants, and begun again, every run has to be there once, and the file has to be the same
again. Let the machine do nothing else meanwhile: the efficiency is how much of two cores two workers make of
the time of one.

Exit status: 0 where all held, 1 else.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import random
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from pneud.campaign.record import NAME, Span

PNEUD = [sys.executable, "-m", "pneud.cli"]
LEAST_EFFICIENCY = 0.9
PATIENCE_S = 120.0
ALONE = "1 process"
KINDS = ("client", "scheduler", "worker", "worker")
FILE = """\
schema = 1
config = "virtual.toml"
runs = {runs}
seed = {seed}

[[play]]
do = "sine"
seconds = 10.0
learn_s = 5.0

[parameters]
"plant.cylinder.moving_mass_kg" = {{loguniform = [0.5, 2.0], times = true}}
"plant.valve.dead_zone_v" = {{uniform = [0.0, 0.2]}}
"plant.polytropic_exponent" = {{uniform = [1.0, 1.4]}}

[parameters.friction]
keys = ["plant.friction.coulomb_n", "plant.friction.static_n", "plant.friction.viscous_n_s_m"]
loguniform = [0.5, 2.0]
times = true
"""


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class Cluster:
    """A scheduler and its workers as processes, each of which can be killed and begun again.

    Args:
        folder: for what they say.
        workers: how many.
    """

    def __init__(self, folder: Path, workers: int) -> None:
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self._said = (folder / "cluster.txt").open("ab")
        self._folder = folder
        self.scheduler = self._scheduler()
        self.workers = [self._worker() for _ in range(workers)]

    def _begin(self, module: str, *words: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *words],
            cwd=self._folder, stdin=subprocess.DEVNULL, stdout=self._said, stderr=self._said,
        )  # fmt: skip

    def _scheduler(self) -> subprocess.Popen[bytes]:
        host, port = self.address.removeprefix("tcp://").split(":")
        return self._begin("dask_scheduler", "--host", host, "--port", port, "--no-dashboard")

    def _worker(self) -> subprocess.Popen[bytes]:
        words = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60")
        return self._begin("dask_worker", self.address, *words)

    def kill_scheduler(self) -> None:
        """Kill it, and begin it again at the same address."""
        self.scheduler.kill()
        self.scheduler.wait()
        self.scheduler = self._scheduler()
        self.mend()

    def kill_worker(self, number: int) -> None:
        """Kill one, and begin another."""
        self.workers[number].kill()
        self.mend()

    def mend(self) -> None:
        """Begin workers in the place of those that have gone."""
        for number, worker in enumerate(self.workers):
            if worker.poll() is not None:
                self.workers[number] = self._worker()

    def close(self) -> None:
        """End all."""
        for process in (*self.workers, self.scheduler):
            process.kill()
        for process in (*self.workers, self.scheduler):
            process.wait()
        self._said.close()


@contextmanager
def cluster(folder: Path, workers: int = 2) -> Iterator[Cluster]:
    """One that is gone with the end of the block."""
    one = Cluster(folder, workers)
    try:
        yield one
    finally:
        one.close()


def spans(folder: Path) -> list[Span]:
    """What the record of a campaign has, without looking whether a line is whole; the last one may not be."""
    found = []
    for line in (folder / NAME).read_bytes().splitlines()[1:]:
        with suppress(ValueError):
            chunk = json.loads(line.partition(b" ")[2])
            found.append((chunk["begin"], chunk["end"]))
    return sorted(found)


def digest(folder: Path) -> str:
    """Of the rows of a campaign."""
    return hashlib.sha256((folder / "rows.parquet").read_bytes()).hexdigest()


def done(file: Path, folder: Path, *words: str) -> dict[str, Any]:
    """A campaign to its end.

    Raises:
        RuntimeError: it did not come there; what it said is told.
    """
    command = [*PNEUD, "campaign", str(file), "-o", str(folder), "--json", *words]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(command)}: {ended.returncode}\n{ended.stdout}{ended.stderr}")
    found: dict[str, Any] = json.loads(ended.stdout)
    return found


def ways(file: Path, folder: Path) -> dict[str, dict[str, Any]]:
    """The same campaign by one process, by two, and by two workers of Dask."""
    found = {}
    for way, name, jobs in ((ALONE, "one", "1"), ("2 processes", "two", "2")):
        before_s = used_s()
        one = done(file, folder / name, "--jobs", jobs)
        found[way] = one | {"used_s": used_s() - before_s}
    before_s = used_s()
    with cluster(folder) as dask:
        wait_for_workers(dask, 2)
        one = done(file, folder / "dask", "--scheduler", dask.address)
    found["2 workers of Dask"] = one | {"used_s": used_s() - before_s}
    return found


def used_s() -> float:
    """What all processes that have ended have used of the processors."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def wait_for_workers(dask: Cluster, count: int) -> None:
    """Until they are there: what is measured is work, not start."""
    from distributed import Client  # noqa: PLC0415 - an extra

    begin: Any = Client
    with begin(dask.address, timeout=PATIENCE_S, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=PATIENCE_S)


class Killed(NamedTuple):
    """What came of the kills."""

    kills: dict[str, int]
    clients: int  # how often the client was begun
    folders: list[Path]  # of campaigns that came to their end

    @property
    def all(self) -> int:
        """All of them."""
        return sum(self.kills.values())


def killed(file: Path, folder: Path, kills: int, seed: int, every_s: float) -> Killed:
    """A campaign whose scheduler, workers and client are killed at random, until it is done.

    Where it is done too soon, another one is begun.
    """
    chance, found = random.Random(seed), Killed({}, 0, [])
    deck: list[str] = []
    with cluster(folder) as dask, (folder / "client.txt").open("ab") as said:
        while found.all < kills:
            target = folder / f"killed-{len(found.folders)}"
            command = [*PNEUD, "campaign", str(file), "-o", str(target), "--scheduler", dask.address]
            client = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
            found = found._replace(clients=found.clients + 1)
            due_s = math.inf
            while client.poll() is None:
                time.sleep(0.05)
                dask.mend()
                if due_s == math.inf and spans_there(target):
                    due_s = time.monotonic() + chance.uniform(0.0, 2.0) * every_s
                if found.all < kills and time.monotonic() > due_s:
                    due_s = math.inf
                    deck = deck or chance.sample(KINDS, len(KINDS))
                    what = deck.pop()
                    found.kills[what] = found.kills.get(what, 0) + 1
                    if what == "scheduler":
                        dask.kill_scheduler()
                    elif what == "worker":
                        dask.kill_worker(chance.randrange(2))
                    else:
                        client.kill()
            if client.wait() == 0:
                found.folders.append(target)
            elif client.returncode != -signal.SIGKILL:
                raise RuntimeError(f"the client ended with {client.returncode}; see {said.name}")
        while not found.folders or client.returncode:
            client = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
            found = found._replace(clients=found.clients + 1)
            while client.poll() is None:
                time.sleep(0.05)
                dask.mend()
            if client.returncode:
                raise RuntimeError(f"the client ended with {client.returncode}; see {said.name}")
            found.folders.append(target)
    return found


def spans_there(folder: Path) -> bool:
    """Whether a campaign has begun to keep what is done."""
    return (folder / NAME).exists() and bool(spans(folder))


def main() -> int:
    """Say what came of it.

    Returns:
        Exit status.
    """
    parser = argparse.ArgumentParser(
        prog="python -m hil.many_runs", description=__doc__.partition("\n")[0], allow_abbrev=False
    )
    parser.add_argument("--runs", type=int, default=10_000, help="of 10 s each")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--every", type=float, default=6.0, metavar="S", help="mean time between kills")
    parser.add_argument("--seed", type=int, default=1, help="of the kills, and of the campaign")
    o = parser.parse_args()
    wrong = []
    with tempfile.TemporaryDirectory(prefix="pneud-many-runs-") as place:
        folder = Path(place)
        file = folder / "campaign.toml"
        file.write_text(FILE.format(runs=o.runs, seed=o.seed), encoding="utf-8")
        found = ways(file, folder)
        alone_s = found[ALONE]["took_s"]
        for way, one in found.items():
            words = (
                f"{way}: {o.runs} runs in {one['took_s']:.1f} s, {1e3 * one['cost_s'] / o.runs:.2f} ms each"
            )
            words += f", {one['used_s']:.1f} s of processors"
            efficiency = 0.5 * alone_s / one["took_s"]
            print(words if way == ALONE else f"{words}, efficiency {efficiency:.3f}", flush=True)
            if way != ALONE and efficiency < LEAST_EFFICIENCY:
                wrong.append(f"{way}: efficiency {efficiency:.3f}, not {LEAST_EFFICIENCY:g}")
        digests = {digest(folder / name) for name in ("one", "two", "dask")}
        print(f"rows: {'identical' if len(digests) == 1 else 'different'}", flush=True)
        began_s = time.monotonic()
        ended = killed(file, folder, o.kills, o.seed, o.every)
        digests |= {digest(one) for one in ended.folders}
        missing = twice = 0
        for target in ended.folders:
            whole = spans(target)
            again = sum(max(0, end - begin) for (_, end), (begin, _) in pairwise(whole))
            twice += again
            missing += o.runs - sum(end - begin for begin, end in whole) + again
        words = ", ".join(f"{what} {count}" for what, count in sorted(ended.kills.items()))
        print(
            f"{ended.all} kills ({words}), the client begun {ended.clients} times,"
            f" {time.monotonic() - began_s:.0f} s: {missing} runs missing, {twice} twice;"
            f" rows: {'identical' if len(digests) == 1 else 'different'}"
        )
        wrong += ["rows differ"] * (len(digests) > 1)
        wrong += [f"{missing} missing, {twice} twice"] * bool(missing or twice)
    print("\n".join(f"not held: {one}" for one in wrong) or "all held")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
