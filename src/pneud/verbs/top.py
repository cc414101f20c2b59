"""The live screen of the running daemon; keys stop, arm, disarm, clear, hold and jog.

Two processes, as with the screen of the daemon itself: one draws and reads keys, the other one waits for it
and puts the terminal right, whatever becomes of the first. If the waiting one is killed, the drawing one does
so itself.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import termios
import time
import tty
from typing import Annotated, Any

import typer

from pneud import crew
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.log.live.ring import Ring
from pneud.verbs import SocketOption
from pneud.view.info import ScreenInfo
from pneud.view.processes import leave_screen
from pneud.view.terminal import run_child

_SPEEDS_MM_S = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
_JOG_LEASE_S = 0.3
_MESSAGE_S = 6.0
_ASK_S = 2.0  # as often as what is learnt is handed over
_VERBS = {b" ": "stop", b"d": "disarm", b"c": "clear", b"h": "hold", b"a": "arm"}
_ARROWS = {b"\x1b[D": -1.0, b"\x1bOD": -1.0, b"\x1b[C": 1.0, b"\x1bOC": 1.0}


def top(
    read_only: Annotated[bool, typer.Option("--read-only", help="Look only: no keys but q.")] = False,
    socket: SocketOption = None,
) -> int:
    """Show a running daemon until `q` or Ctrl-C, or until it ends.

    Returns:
        Exit status: 0, or 1 where the daemon cannot be looked at.
    """
    with Client(socket) as client:
        try:
            if read_only:
                client.ask("observe")
            fields, descriptor = client.attach()
        except RefusedError as e:
            print(f"pneud: {e}", file=sys.stderr)
            return 1
        if fields["layout"] != Ring.layout():
            os.close(descriptor)
            print("pneud: the daemon runs another version of pneud; restart it", file=sys.stderr)
            return 1
        ring = Ring.attach(descriptor, fields["slots"], fields["slot_bytes"])
        keys = None if read_only or not sys.stdin.isatty() else _Keys(client)
        return _show(ring, _info(fields), _Link(client, keys))


def _info(f: dict[str, Any]) -> ScreenInfo:
    return ScreenInfo(
        name=f["name"],
        bus=f["bus"],
        rate_hz=f["rate_hz"],
        travel_min_m=f["travel_min_mm"] * 1e-3,
        travel_max_m=f["travel_max_mm"] * 1e-3,
        u_max_v=f["u_max_v"],
        note=f["note"],
        fault_names=tuple(f["faults"]),
        log_path=f["log"],
        sync=f["sync"],
        cures=tuple(f["cures"]),
        keys="q leaves",
    )


def _show(ring: Ring, info: ScreenInfo, link: _Link) -> int:
    terminal = termios.tcgetattr(0) if sys.stdin.isatty() else None

    def main() -> None:
        try:
            if terminal is not None:
                tty.setcbreak(0)
            run_child(
                ring.reader().poll,
                info,
                lambda: ring.closed or link.over,
                log_counts=lambda: (ring.status().written, ring.status().lost),
                attend=link.attend,
            )
        finally:
            _restore(terminal)

    child = crew.fork(main, keep=(link.descriptor,), terminal=True, orphaned=signal.SIGTERM)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, lambda *_: os.kill(child, signal.SIGTERM))
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)
    _, ended = os.waitpid(child, 0)
    _restore(terminal)
    if os.waitstatus_to_exitcode(ended) != 0 and sys.stdout.isatty():
        leave_screen()
    if ring.closed:
        print("pneud: the daemon has ended", file=sys.stderr)
    return 0


def _restore(terminal: list[Any] | None) -> None:
    if terminal is not None:
        # a process in the background would be stopped for touching its terminal
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        with contextlib.suppress(termios.error):
            termios.tcsetattr(0, termios.TCSADRAIN, terminal)


class _Link:
    """What the screen has to do with the console: keys out, replies in."""

    def __init__(self, client: Client, keys: _Keys | None) -> None:
        self.over = False
        self._client = client
        self._keys = keys
        self._message = ""
        self._until_s = 0.0
        self._ask_s = 0.0
        self._learnt: dict[str, Any] | None = None
        self._lost = False

    @property
    def descriptor(self) -> int:
        """Of the connection."""
        return self._client.fileno()

    def attend(self, info: ScreenInfo) -> ScreenInfo:
        """Act on keys and replies; to be called many times a second."""
        now_s = time.monotonic()
        if self._keys is not None and not self._keys.act():
            self.over = True
        if not self._lost:
            try:
                if now_s >= self._ask_s:
                    self._ask_s = now_s + _ASK_S
                    self._client.send("status")
                for reply in self._client.replies():
                    self._learnt = reply.get("learnt", self._learnt)
                    if not reply.get("ok"):
                        self._say(str(reply["error"]["message"]), now_s)
            except PlaceError as e:
                self._lost = True
                self._say(f"{e}; this screen can only look", now_s + 1e9)
        if now_s > self._until_s:
            self._message = ""
        keys = self._keys.help if self._keys is not None and not self._lost else "q or Ctrl-C leaves"
        return info._replace(message=self._message, keys=keys, learnt=self._learnt)

    def _say(self, message: str, now_s: float) -> None:
        self._message, self._until_s = message, now_s + _MESSAGE_S


class _Keys:
    """Keys and what they ask for; a jog goes on for as long as its key repeats."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._speed = _SPEEDS_MM_S.index(20.0)

    @property
    def help(self) -> str:
        speed = _SPEEDS_MM_S[self._speed]
        return f"space stop  a arm  d disarm  c clear  h hold  ←→ jog {speed:g} mm/s  +- speed  q leaves"

    def act(self) -> bool:
        """Ask for what the keys pressed since the last call mean.

        Returns:
            Whether to go on.
        """
        pressed = b""
        while select.select([0], [], [], 0.0)[0]:
            more = os.read(0, 1024)
            if not more:
                return False  # the terminal is gone
            pressed += more
        jog = 0.0
        while pressed:
            size = 3 if pressed[:1] == b"\x1b" else 1
            key, pressed = pressed[:size], pressed[size:]
            if key in (b"q", b"Q", b"\x04"):
                return False
            if key in _ARROWS:
                jog = _ARROWS[key]
            elif key in (b"+", b"-"):
                step = 1 if key == b"+" else -1
                self._speed = min(max(self._speed + step, 0), len(_SPEEDS_MM_S) - 1)
            elif key in _VERBS:
                jog = 0.0
                self._client.send(_VERBS[key])
        if jog:
            velocity = jog * _SPEEDS_MM_S[self._speed]
            self._client.send("jog", velocity_mm_s=velocity, lease_s=_JOG_LEASE_S)
        return True
