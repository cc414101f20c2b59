"""The console's keeper: forks the console, and another one when it has died or stands still.

It holds all that outlives a console, so that clients who call meanwhile wait for the next one, and the loop
does not take the console for gone for good.
"""

from __future__ import annotations

import os
import signal
import socket
import time
from contextlib import suppress

from pneud import crew
from pneud.console.facts import RunFacts
from pneud.console.worker import Post, Seat, load, serve
from pneud.log.live.ring import Ring

_LOOK_S = 0.25  # how often a console that may stand still is looked at; an end is told by a signal
_STANDS_NS = 2_000_000_000  # a console that has been silent for longer is killed
_LOADING_NS = 20_000_000_000  # one that has not begun, after so long
_APART_S = 1.0  # from one start to the next; twice as long after each that died at once
_FARTHEST_S = 8.0
_AT_ONCE_NS = 2_000_000_000  # one that has lived for less has died at once
_LEAVE_S = 0.8
_SOON_S = 0.02  # for what is about to happen: a console's beginning, the run's end that it has seen earlier
_PARENT_DIED = signal.SIGUSR1
_WAKE = (signal.SIGCHLD, signal.SIGHUP, _PARENT_DIED)
_WARNING, _ERROR = 3, 4  # levels of the log's events; their module is heavy to load


def fork_console(
    listener: socket.socket, loop: socket.socket, words: socket.socket, run: RunFacts, ring: Ring
) -> int:
    """As `fork_shared`, for one axis alone; its socket for words is the console's, too."""
    return fork_shared(listener, loop, run.config.name, (Seat(words, run, ring),))


def fork_shared(listener: socket.socket, loop: socket.socket, name: str, seats: tuple[Seat, ...]) -> int:
    """Fork the console's keeper, which forks the console; the sockets are theirs from here on.

    They finish by themselves when the ring is closed or this process dies, however it dies.

    Args:
        listener: bound and listening.
        loop: the console's end of the hand-off.
        name: of the daemon.
        seats: one for each axis.

    Returns:
        The keeper's process id; a SIGHUP reaches the console through it.

    Raises:
        OSError: no more processes.
    """
    daemon, post = os.getpid(), Post(listener, loop, name, seats)
    main = _Keeper(post, daemon).run
    child = crew.fork(main, keep=post.descriptors, orphaned=None, name="keeper")
    for end in (listener, loop, *(seat.words for seat in seats)):
        end.close()
    return child


class _Keeper:
    def __init__(self, post: Post, daemon: int) -> None:
        self._post = post
        self._daemon = daemon
        self._console = 0
        self._begun_ns = 0
        self._before = 0  # consoles that have been started
        self._at_once = 0  # of them the last ones that died at once
        self._hung_up = False  # a SIGHUP has come that no console has had yet

    @property
    def _begun(self) -> bool:
        """Whether there is a console that has begun, and hears signals."""
        return self._console != 0 and self._post.ring.console_ns > self._begun_ns

    def _over(self) -> bool:
        return self._post.ring.closed or os.getppid() != self._daemon

    def run(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, _WAKE)
        crew.die_with_parent(self._daemon, _PARENT_DIED)
        crew.at_low_priority(load)  # so that each console begins at once
        while not self._over():
            self._begun_ns = time.monotonic_ns()
            try:
                self._start()
                why = self._watch()
            except OSError as e:
                why = f"cannot be started: {e.strerror}"
            lived_ns = self._post.ring.console_ns - self._begun_ns
            self._post.set_console_gone()
            time.sleep(_SOON_S)
            if not self._over():
                self._mourn(why, lived_ns)
            apart_s = min(_APART_S * 2 ** max(0, self._at_once - 1), _FARTHEST_S)
            while not self._over() and time.monotonic_ns() < self._begun_ns + apart_s * 1e9:
                self._sleep(_LOOK_S)
        if self._console and not crew.wait(self._console, _LEAVE_S):
            crew.kill(self._console)

    def _sleep(self, longest_s: float) -> None:
        """Until something happens, or for so long; a SIGHUP is passed on, to the next console if need be."""
        happened = signal.sigtimedwait(_WAKE, longest_s)
        self._hung_up |= happened is not None and happened.si_signo == signal.SIGHUP
        if self._hung_up and self._begun:
            self._hung_up = False
            with suppress(ProcessLookupError):
                os.kill(self._console, signal.SIGHUP)

    def _start(self) -> None:
        keeper, daemon, post, place = os.getpid(), self._daemon, self._post, self._before

        def console() -> None:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _WAKE)
            serve(post, daemon, keeper, place)

        self._console = crew.fork(console, keep=post.descriptors, orphaned=None, name="console")
        self._before += 1

    def _watch(self) -> str:
        """Wait for the console's end.

        Returns:
            What has become of it.
        """
        ring, begins = self._post.ring, True
        while not self._over():
            ended, status = os.waitpid(self._console, os.WNOHANG)
            if ended:
                self._console = 0
                code = os.waitstatus_to_exitcode(status)
                return f"was killed (signal {-code})" if code < 0 else f"has ended ({code})"
            beat_ns, now_ns = ring.console_ns, time.monotonic_ns()
            if begins and beat_ns > self._begun_ns:
                begins = False
                if self._before > 1 and self._at_once < 2:
                    self._say(_WARNING, "the console was started again")
            if now_ns > (self._begun_ns + _LOADING_NS if begins else beat_ns + _STANDS_NS):
                crew.kill(self._console)
                self._console = 0
                return (
                    "did not begin" if begins else f"stood still for {_STANDS_NS * 1e-9:g} s and was killed"
                )
            self._sleep(_SOON_S if begins else _LOOK_S)
        return "is gone"

    def _mourn(self, why: str, lived_ns: int) -> None:
        """Say what has become of a console; of those that die at once in a row, twice."""
        self._at_once = self._at_once + 1 if lived_ns < _AT_ONCE_NS else 0
        if self._at_once <= 2:
            often = f"; it dies at once again and again, and is started every {_FARTHEST_S:g} s at most"
            words = f"the console {why}; what an operator had engaged comes to rest"
            self._say(_ERROR, words + (often if self._at_once == 2 else ""))

    def _say(self, level: int, words: str) -> None:
        self._post.say(level, words)
        with suppress(OSError):  # standard error may be closed or full; what is not written must not stay
            os.write(2, f"pneud: {words}\n".encode())
