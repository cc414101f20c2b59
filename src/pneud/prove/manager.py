"""The manager of services: is told how a daemon stands, and ends one that hangs."""

from __future__ import annotations

import signal

from pneud.prove.judge import Judge

WATCHDOG_S = 2.0
ENVIRON = {"NOTIFY_SOCKET": "/run/manager", "WATCHDOG_USEC": f"{1e6 * WATCHDOG_S:.0f}"}
READY_S = 1.5  # of punctual ticks, after which a daemon has said that it is ready


class Manager:
    """Is told something by a daemon, and looks from time to time at what it has not been told.

    Attributes:
        deaf_until_ns: its queue is full for so long.
    """

    def __init__(self, judge: Judge) -> None:
        self.deaf_until_ns = 0
        self._judge, self._world = judge, judge.world
        self.begins()

    def begins(self) -> None:
        """A daemon is about to start."""
        self.ready = self.stopping = self._anew = False
        self._judge.axes[0].punctual = 0
        self._alive_ns, self._watchdog_ns = 0, round(1e9 * WATCHDOG_S)

    def hear(self, message: bytes) -> None:
        """Something is said.

        Raises:
            BlockingIOError: there is no room for it.
        """
        words = message.decode().split("\n")
        self.stopping |= words[0] == "STOPPING=1"  # what is not told then is told by its end
        if self._world.now_ns < self.deaf_until_ns:
            raise BlockingIOError
        if words[0] in ("READY=1", "WATCHDOG=1") and not self._ticks():
            self._judge.says_no("service", f"{words[0]}, and the loop does not tick")
        if words[0] == "READY=1":
            self._world.note("is ready")
            self.ready = True
        self._anew |= words[0] == "STATUS=beginning anew"
        if "WATCHDOG=1" in words or words[0] == "READY=1":
            self._alive_ns = self._world.now_ns
        for word in words:
            name, _, value = word.partition("=")
            if name == "WATCHDOG_USEC":
                self._watchdog_ns = 1000 * int(value)

    def _ticks(self) -> bool:
        """Whether the loop does, as far as it is not held."""
        axis, now_ns = self._judge.axes[0], self._world.now_ns
        since_ns = now_ns - 3 * axis.period_ns
        return self._judge.held_since(since_ns) or (axis.last is not None and axis.last.t_ns > since_ns)

    def ended(self, *, again: bool) -> None:
        """A daemon has ended in order, or is about to begin anew."""
        if not again and self.ready and not (self.stopping or self._anew):
            self._judge.says_no("service", "it ends, and has not said that it is stopping")

    def look(self) -> None:
        """Find a daemon that says nothing."""
        judge, world = self._judge, self._world
        daemon = judge.daemon
        if daemon is None or not daemon.alive or self.stopping:
            return
        punctual_s = 1e-9 * judge.axes[0].period_ns * judge.axes[0].punctual
        if not self.ready and punctual_s > READY_S and not judge.held_since(0):
            judge.says_no("service", f"it ticks for {punctual_s:.1f} s, and has not said that it is ready")
        if self.ready and world.now_ns - self._alive_ns > self._watchdog_ns:
            if not (daemon.stopped or judge.held_since(self._alive_ns)):
                silent_s = 1e-9 * (world.now_ns - self._alive_ns)
                judge.says_no("service", f"it lives, and is ended for a silence of {silent_s:.2f} s")
            world.note("the daemon hangs, and is ended")
            world.send(daemon, signal.SIGABRT)
