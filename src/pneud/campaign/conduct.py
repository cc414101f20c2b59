"""Hands out the runs that are missing, in chunks by what they have cost so far, and keeps what comes.

A worker that is killed takes nothing with it but time. Chunks that were out then are done again; one that has
been out too often when workers died is done alone, and halved until the run that kills is found.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import NamedTuple

from pneud import __version__
from pneud.campaign.plan import Plan
from pneud.campaign.record import Chunk, Record, Span, missing
from pneud.campaign.workers import PATIENCE_S, ClusterError, Workers, given_up
from pneud.view.progress import Report

CHUNK_S = 2.0  # that a chunk should take: handing one out costs thousandths of that
AHEAD = 2  # chunks a worker, so that none waits for the next one
SUSPECT = 3  # times that a chunk may be out when a worker dies, before it is done alone
GIVE_UP = 2  # times that a run may end its process when it is alone
LOOK_S = 1.0


class Conducted(NamedTuple):
    """What came of it."""

    runs: int  # done this time
    cost_s: float  # of these, by the workers' clocks
    took_s: float
    kinds: tuple[str, ...]  # of workers: how their mathematics rounds


class _Out(NamedTuple):
    """A chunk that somebody is at."""

    span: Span
    tries: int


class Conductor:
    """Sees a campaign through.

    Args:
        plan: the runs.
        record: what is done, and where more of it is kept.
        workers: who does them.
        report: told how many runs are done.
        say: told what a person should know, in one line.
    """

    def __init__(
        self,
        plan: Plan,
        record: Record,
        workers: Workers,
        report: Report,
        say: Callable[[str], None],
    ) -> None:
        self._plan, self._record, self._workers, self._say = plan, record, workers, say
        self._report = report
        self._todo: deque[Span] = deque(missing([(c.begin, c.end) for c in record.chunks()], plan.total))
        self._left = sum(end - begin for begin, end in self._todo)
        self._again: deque[_Out] = deque()  # were lost
        self._out: dict[Future[Chunk], _Out] = {}
        self._runs, self._cost_s = 0, 0.0
        self._kinds: dict[str, None] = {}
        self._idle_s = -1.0

    def go(self) -> Conducted:
        """Until nothing is missing.

        Raises:
            ClusterError: there is nobody to do it.
            OSError: what is done cannot be kept.
        """
        began_s = time.monotonic()
        self._tell()
        while self._left:
            lost = not self._fill()
            if self._out:
                done, _ = wait(self._out, LOOK_S, FIRST_COMPLETED)
                taken = [self._take(future) for future in done]
                lost = lost or not all(taken) or not self._workers.there()
            if lost:
                self._recover()
            self._tell()
        took_s = time.monotonic() - began_s
        return Conducted(self._runs, self._cost_s, took_s, tuple(self._kinds))

    def _tell(self) -> None:
        total = self._plan.total
        self._report("campaign", total - self._left, total, "runs")

    def _fill(self) -> bool:
        """Hand out as much as keeps everybody busy; False where a worker is gone."""
        width = self._workers.width()
        self._mind_idle(width)
        while len(self._out) < AHEAD * width:
            one = self._next(width)
            if one is None:
                break
            try:
                self._out[self._workers.submit(one.span)] = one
            except Exception as e:
                self._again.append(one)
                if not self._workers.lost(e):
                    raise
                return False
        return True

    def _mind_idle(self, width: int) -> None:
        now_s = time.monotonic()
        if width or self._out:
            self._idle_s = -1.0
            return
        if self._idle_s < 0.0:
            self._idle_s = now_s
            self._say("there are no workers; waiting for some")
        if now_s - self._idle_s > PATIENCE_S:
            raise ClusterError("the scheduler has no workers; start some, and give the same command again")
        time.sleep(0.1 * LOOK_S)

    def _next(self, width: int) -> _Out | None:
        """The next chunk; None where it has to wait, or nothing is left."""
        if any(one.tries >= SUSPECT for one in self._out.values()):
            return None
        if self._again:
            if self._again[0].tries < SUSPECT:
                return self._again.popleft()
            return None if self._out else self._again.popleft()
        if not self._todo:
            return None
        begin, end = self._todo[0]
        cut = min(end, begin + self._size(width))
        if cut == end:
            self._todo.popleft()
        else:
            self._todo[0] = (cut, end)
        return _Out((begin, cut), 0)

    def _size(self, width: int) -> int:
        """As many runs as take long enough, and at the end fewer, so that all workers end together."""
        if not self._runs:
            return 1
        enough = CHUNK_S * self._runs / max(self._cost_s, 1e-9)
        fair = sum(end - begin for begin, end in self._todo) / (AHEAD * width)
        return max(1, min(math.ceil(enough), math.ceil(fair)))

    def _take(self, future: Future[Chunk]) -> bool:
        """Keep what a chunk came to; False where a worker is gone."""
        one = self._out.pop(future)
        try:
            chunk = Chunk(*future.result())
        except BaseException as e:
            self._again.append(one._replace(tries=one.tries + 1))
            if not self._workers.lost(e):
                raise
            return False
        version = chunk.fingerprint.rpartition(" ")[2]
        if version != __version__:
            raise ClusterError(f"a worker has pneud {version}, and this is {__version__}; they must be alike")
        self._keep(chunk)
        return True

    def _keep(self, chunk: Chunk) -> None:
        self._record.add(chunk)
        count = chunk.end - chunk.begin
        self._left -= count
        self._runs += count
        self._cost_s += chunk.cost_s
        self._kinds[chunk.fingerprint] = None

    def _recover(self) -> None:
        """Take back what was out, and begin anew with other workers."""
        for future, one in list(self._out.items()):
            # what was done before the others died is not done again
            if future.done() and not future.cancelled() and future.exception() is None:
                self._take(future)
            else:
                self._again.append(one._replace(tries=one.tries + 1))
        self._out.clear()
        for _ in range(len(self._again)):
            self._again += self._parted(self._again.popleft())
        self._again = deque(sorted(self._again, key=lambda one: one.tries))
        self._workers.renew(self._say)

    def _parted(self, one: _Out) -> list[_Out]:
        """A chunk that has ended its process alone, in halves; a run that has done so too often is over."""
        begin, end = one.span
        if one.tries <= SUSPECT:
            return [one]
        if end - begin > 1:
            middle = (begin + end) // 2
            return [_Out((begin, middle), SUSPECT), _Out((middle, end), SUSPECT)]
        if one.tries < SUSPECT + GIVE_UP:
            return [one]
        self._say(f"run {begin} is given up: its process was killed again and again")
        self._keep(given_up(self._plan, begin))
        return []
