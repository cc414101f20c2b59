"""Who does the runs: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import cache
from typing import Any, Protocol

from pneud import __version__
from pneud.campaign.draws import drawn
from pneud.campaign.plan import RUN, Plan
from pneud.campaign.record import Chunk, Span
from pneud.campaign.unit import AXIS, ERROR, LAW, SEED, Row
from pneud.compiled import slow
from pneud.compiled.backend import lacking
from pneud.crew import die_with_parent
from pneud.log.format.fingerprint import numeric_fingerprint
from pneud.rt.extras import require
from pneud.study import trial

PATIENCE_S = 60.0  # with a scheduler that is gone, or has no workers
TRY_S = 5.0  # to reach it
LOOK_S = 0.5  # how old a count of workers may be
KILLED = "its process was killed, each time that it was tried"


class ClusterError(Exception):
    """A cluster cannot be had; one line for a person."""

    exit_code = 3


def work(plan: Plan, begin: int, end: int) -> Chunk:
    """Do runs one after the other: what a worker is asked for."""
    began_s = time.perf_counter()
    columns = plan.kept
    rows = []
    for number in range(begin, end):
        row = plan.run(number)
        rows.append([row[name] for name in columns])
    return Chunk(begin, end, rows, time.perf_counter() - began_s, fingerprint())


def given_up(plan: Plan, number: int) -> Chunk:
    """A run that no process survives, as a row like any other."""
    config, label = plan.config_of(number)
    seed = plan.seed_of(number)
    known: Row = {RUN: number, **label, SEED: seed, **drawn(config["spread"], seed), ERROR: KILLED}
    return Chunk(number, number + 1, [[known.get(name) for name in plan.kept]], 0.0, fingerprint())


def make_ready(plan: Plan) -> None:
    """Compile what runs take before there are processes, so that each has it; say once what cannot be."""
    hows = {base["how"] for base in plan.bases}
    if LAW in hows and (why := trial.compiled()[1]):
        slow.say("the law", why)
    if AXIS in hows and (why := lacking()):
        slow.say("the law", why)


@cache
def fingerprint() -> str:
    """How this machine's mathematics rounds, and what runs here."""
    return f"{numeric_fingerprint()} pneud {__version__}"


class Workers(Protocol):
    """Who takes spans of runs."""

    def submit(self, span: Span) -> Future[Chunk]:
        """Have runs done.

        Raises:
            Exception: as `lost` says.
        """

    def width(self) -> int:
        """How many spans are worked at at once."""

    def lost(self, error: BaseException) -> bool:
        """Whether an error says that a worker is gone, and nothing of its runs."""

    def there(self) -> bool:
        """Whether what was submitted can still come back."""

    def renew(self, report: Callable[[str], None]) -> None:
        """Begin anew after that.

        Raises:
            ClusterError: there is nobody any more.
        """

    def close(self) -> None:
        """Let them go, whatever they are at."""


class LocalWorkers:
    """Processes of this machine, which leave when this one does.

    Args:
        plan: the runs.
        jobs: how many processes; as many as there are cores for this one if 0.
    """

    def __init__(self, plan: Plan, jobs: int = 0) -> None:
        make_ready(plan)
        self._plan, self._jobs = plan, jobs or len(os.sched_getaffinity(0))
        self._pool = self._begun()

    def _begun(self) -> Executor:
        forked = multiprocessing.get_context("fork")
        return ProcessPoolExecutor(self._jobs, forked, _begin, (os.getpid(),))

    def submit(self, span: Span) -> Future[Chunk]:
        """Have runs done."""
        return self._pool.submit(work, self._plan, *span)

    def width(self) -> int:
        """How many processes there are."""
        return self._jobs

    def lost(self, error: BaseException) -> bool:
        """A process was killed: the pool gives all of its work back."""
        return isinstance(error, BrokenProcessPool | CancelledError)

    def there(self) -> bool:
        """The pool says so itself."""
        return True

    def renew(self, report: Callable[[str], None]) -> None:
        """Other processes."""
        report("a worker was killed; its runs are done again")
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = self._begun()

    def close(self) -> None:
        """Let them go."""
        processes = list((getattr(self._pool, "_processes", None) or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            with suppress(OSError, ValueError):
                process.terminate()
        for process in processes:
            with suppress(OSError, ValueError, AssertionError):
                process.join(TRY_S)


def _begin(parent: int) -> None:
    """A worker: Ctrl-C is for who has started it, and without that it leaves."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent(parent)
    slow.hush()


def _silence() -> None:
    """Have Dask say nothing of a scheduler that is gone: `renew` does, in one line and not in fifty."""
    for name, logger in logging.root.manager.loggerDict.items():
        if name.partition(".")[0] in ("distributed", "tornado") and isinstance(logger, logging.Logger):
            logger.setLevel(logging.CRITICAL)


class DaskWorkers:
    """The workers of a Dask cluster, wherever they are.

    Args:
        plan: the runs.
        address: of the scheduler, such as tcp://10.0.0.1:8786.
        say: told what a person should know, in one line.

    Raises:
        ClusterError: nobody answers.
        ExtraError: Dask is missing.
    """

    def __init__(self, plan: Plan, address: str, say: Callable[[str], None] = lambda _: None) -> None:
        require("--scheduler", "cluster")
        self._plan, self._address = plan, address
        self._client: Any = None
        self._width, self._counted_s = 0, -1.0
        self._connect(TRY_S)
        if self._threads() > 1:
            say(
                "there are workers with several threads, of which one works at a time;"
                " begin them with --nthreads 1 --nworkers N"
            )

    def _connect(self, patience_s: float) -> None:
        from distributed import Client  # noqa: PLC0415 - an extra, and slow to load

        _silence()
        try:
            begin: Any = Client  # which has no types
            self._client = begin(self._address, timeout=patience_s, set_as_default=False)
        except (OSError, ValueError) as e:  # TimeoutError is one of the first kind
            said = str(e).splitlines()[0] if str(e) else type(e).__name__
            raise ClusterError(f"--scheduler {self._address}: nobody answers there: {said}") from None
        self._pool = self._client.get_executor(pure=False)
        self._scheduler = self._identity()

    def _threads(self) -> int:
        """The most that a worker has."""
        return max(self._client.nthreads().values(), default=1)

    def _identity(self) -> object:
        """Of the scheduler that the client is connected to, as far as it knows."""
        return self._client.scheduler_info().get("id")

    def submit(self, span: Span) -> Future[Chunk]:
        """Have runs done."""
        found: Future[Chunk] = self._pool.submit(work, self._plan, *span)
        return found

    def width(self) -> int:
        """How many threads the cluster has, counted now and then; workers come and go."""
        now_s = time.monotonic()
        if now_s - self._counted_s > LOOK_S:
            with suppress(Exception):  # without a scheduler it stays what it was, until `lost` is said
                self._width = sum(self._client.nthreads().values())
            self._counted_s = now_s
        return self._width

    def lost(self, error: BaseException) -> bool:
        """The scheduler is gone, or a worker more often than Dask tries again."""
        from distributed import CancelledError as DaskCancelled  # noqa: PLC0415
        from distributed import KilledWorker  # noqa: PLC0415

        return isinstance(error, CancelledError | DaskCancelled | KilledWorker | OSError | RuntimeError)

    def there(self) -> bool:
        """The same scheduler; what another one had is lost, and Dask need not say so of each future."""
        return bool(self._client.status == "running" and self._identity() == self._scheduler)

    def renew(self, report: Callable[[str], None]) -> None:
        """Look for the scheduler again, for a minute."""
        report(f"the cluster has lost what it was at; looking for {self._address} again")
        self.close()
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                self._connect(TRY_S)
                return
            except ClusterError:
                if time.monotonic() > until_s:
                    raise
                time.sleep(LOOK_S)

    def close(self) -> None:
        """Leave; what was submitted is dropped."""
        with suppress(Exception):
            self._client.close(timeout=TRY_S)
