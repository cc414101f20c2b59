"""The axis of a running daemon as the place of a commissioning: its console is asked for everything."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from pneud.config.proof import carry_over, digest, keep
from pneud.config.writing import put_text, with_axis
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.protocol import MAX_PIECES
from pneud.console.restarting import next_session
from pneud.loading import Loaded, load
from pneud.log.files.reader import LogReader, read_log
from pneud.log.live.ring import Ring, RingReader
from pneud.safety.supervisor import is_engaged
from pneud.signals import Record, Request, RequestKind, State
from pneud.study.commissioning.bench import LONGEST_S, Operator
from pneud.study.commissioning.movement import Verdict
from pneud.study.commissioning.testing import LEASE_S

LOOK_S = 0.005
SESSION_S = 20.0  # for a daemon that begins anew, or comes to rest, or has to write its log
BEGINNING = (State.STARTING.label, State.WAITING.label)
BY_THE_AXIS = ("wrong_state", "blocked")  # answers that stand in a tick, too
PLAIN = {RequestKind.ARM: "arm", RequestKind.DISARM: "disarm", RequestKind.HOME: "home"}


class Live:
    """An axis that a daemon runs; its file is read and written here."""

    tries = False

    def __init__(self, connect: Callable[[], Client], loaded: Loaded) -> None:
        """Nothing is asked for yet.

        Args:
            connect: to the daemon, which may have begun anew since the last time.
            loaded: what it runs.

        Raises:
            PlaceError: there is none.
        """
        self._connect, self.loaded = connect, loaded
        self._client = connect()
        self._status = self._client.ask("status")
        self.axis_s = 0.0
        self._logs = [str(self._status["log"])]

    @property
    def log_name(self) -> str:
        """Of the log that is being written."""
        return self._logs[-1].rpartition("/")[2]

    def close(self) -> None:
        """Hang up."""
        self._client.close()

    def play(self, operator: Operator) -> None:
        """Let an operator do what he wants to; behind him the axis holds, or is disarmed.

        Raises:
            RefusedError: the console lets nobody command.
            PlaceError: the daemon has gone.
        """
        if self._client.ask("status")["state"] == State.FAULT.label:  # what was tried before it has ended so
            self._client.ask("clear")
        fields, descriptor = self._client.attach()
        if fields["layout"] != Ring.layout():
            raise PlaceError("the daemon is of another version than this pneud; restart it")
        ring = Ring.attach(descriptor, fields["slots"], fields["slot_bytes"])
        try:
            ticks = _Played(self._client, ring, operator).play()
        except BaseException:
            with contextlib.suppress(RefusedError, PlaceError), self._connect() as other:
                other.ask("stop")
            raise
        self.axis_s += ticks / self.loaded.config.loop.rate_hz

    def logs(self) -> list[LogReader]:
        """What has been recorded of this configuration, once it is in the files."""
        count = -1
        while count < self._status["log_written"]:
            count = self._status["log_written"]
            time.sleep(2.0 * LOOK_S)
            self._status = self._client.ask("status")
        return [read_log(log) for log in self._logs]

    def prove(self, verdict: Verdict, /) -> None:
        """Keep what the movement test has come to; where it is passed, the axis may be armed from now on."""
        told = {
            "passed": verdict.passed,
            "findings": [str(f) for f in verdict.findings],
            "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "bus": self._status["bus"],
            "log": self._status["log"],
        }
        keep(self.loaded.proof_file, digest(self.loaded.config, self.loaded.dbc.read_bytes()), told)
        if verdict.passed and any(f["name"] == "unproven" for f in self._status["faults"]):
            self._begin_anew()

    def adopt(self, text: str, keep: bool) -> None:
        """Write another configuration, and have the daemon begin anew with it; what is proven stays so.

        Where it does not begin, the file is as it was.
        """
        assert keep
        before = self.loaded
        of = digest(before.config, before.dbc.read_bytes())
        whole = before.path.read_text(encoding="utf-8-sig")
        put_text(before.path, with_axis(whole, before.path, before.part, text))
        try:
            self.loaded = load(before.path, axis=before.config.name)
            carry_over(before.proof_file, of, digest(self.loaded.config, self.loaded.dbc.read_bytes()))
            self._begin_anew()
        except BaseException:
            put_text(before.path, whole)
            raise
        self._logs = self._logs[-1:]

    def _begin_anew(self) -> None:
        """End the session in order; the next one has a log of its own."""
        before = str(self._status["log"])
        self._rest()
        self._client.ask("restart")
        self._client.close()
        self._client, self._status = next_session(
            self._connect, before, SESSION_S, lambda status: status["state"] not in BEGINNING
        )
        self._rest(all_of_them=True)
        self._logs.append(str(self._status["log"]))

    def _states(self, all_of_them: bool) -> list[str]:
        others = (self._status.get("others") or {}).values() if all_of_them else ()
        return [self._status["state"], *others]

    def _rest(self, *, all_of_them: bool = False) -> None:
        """Have the axis disarmed, also where it arms by itself at its start, and the others with it."""
        until_ns = time.monotonic_ns() + round(SESSION_S * 1e9)
        self._status = self._client.ask("status")
        whose = {"axis": None} if all_of_them else {}
        while any(is_engaged(State[state.upper()]) for state in self._states(all_of_them)):
            if time.monotonic_ns() > until_ns:
                raise PlaceError(f"the axis is {self._status['state']}, and does not come to rest")
            with contextlib.suppress(RefusedError):
                self._client.ask("disarm", **whose)
            time.sleep(LOOK_S)
            self._status = self._client.ask("status")


class _Played:
    """An operator's requests on their way to the console, and the ticks on theirs to him."""

    def __init__(self, client: Client, ring: Ring, operator: Operator) -> None:
        self._client, self._ring, self._operator = client, ring, operator
        self._reader: RingReader = ring.reader()
        self._pieces: list[tuple[float, ...]] = []
        self._awaited = 0  # kind of the request that has not come by in a tick yet
        self._asked_ns = 0

    def play(self) -> int:
        """Until the operator has his verdict, or the daemon ends; how many ticks that took."""
        self._reader.poll()
        begun_ns, ticks = time.monotonic_ns(), 0
        while not self._ring.closed and time.monotonic_ns() - begun_ns < LONGEST_S * 1e9:
            for record in self._reader.poll():
                if record.tick.t_ns < begun_ns:
                    continue
                ticks += 1
                if not self._follow(record):
                    return ticks
            time.sleep(LOOK_S)
        raise PlaceError("the daemon has ended" if self._ring.closed else "this takes far too long")

    def _follow(self, record: Record) -> bool:
        """A tick, and what is asked for next; whether there will be more."""
        tick = record.tick
        self._operator.see(record)
        if tick.request is not None and tick.request.kind == self._awaited and tick.t_ns >= self._asked_ns:
            self._awaited = 0
        if self._operator.verdict is not None:
            return False
        if not self._awaited:
            wanted = self._operator.ask(tick.state, tick.present)
            if wanted is not None and wanted.kind != RequestKind.SHUTDOWN:
                self._ask(wanted)
        return True

    def _ask(self, request: Request) -> None:
        kind, values = RequestKind(request.kind), request.values
        if kind == RequestKind.PIECE:
            self._pieces = [*self._pieces, values] if values else []
            return
        self._asked_ns, self._awaited = time.monotonic_ns(), kind
        try:
            self._send(kind, values)
        except RefusedError as e:
            if e.kind not in BY_THE_AXIS:
                raise

    def _send(self, kind: RequestKind, values: tuple[float, ...]) -> None:
        if kind == RequestKind.PROBE:
            voltage_v, rate_v_s, travel_m, speed_m_s, force_n, _ = values
            bounds = {"travel_mm": 1e3 * travel_m, "speed_mm_s": 1e3 * speed_m_s, "force_n": force_n}
            self._client.ask("probe", voltage_v=voltage_v, rate_v_s=rate_v_s, **bounds, lease_s=LEASE_S)
        elif kind == RequestKind.GOTO:
            position_m, speed_m_s, *_ = (*values, 0.0)
            bounds = {"speed_mm_s": 1e3 * speed_m_s} if speed_m_s else {}
            self._client.ask("goto", x_mm=1e3 * position_m, **bounds, attended=True)
        elif kind == RequestKind.TRACK:
            self._upload()
            self._client.ask("track", what="profile", attended=True)
        else:
            self._client.ask(PLAIN[kind])

    def _upload(self) -> None:
        self._asked_ns = time.monotonic_ns()
        for at in range(0, len(self._pieces), MAX_PIECES):
            some = [list(piece) for piece in self._pieces[at : at + MAX_PIECES]]
            last = at + MAX_PIECES >= len(self._pieces)
            self._client.ask("upload", first=at == 0, last=last, pieces=some)
