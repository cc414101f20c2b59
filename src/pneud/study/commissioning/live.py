"""The axis of a running daemon as the place of a commissioning: its console is asked for everything."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

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
UNDER_WAY = (State.STOPPING.label, State.MOVING.label, State.TRACKING.label, State.PROBING.label)
TO_DO = "the daemon goes on with what was being tried until {}pneud restart"
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
        self._order = _number(self._status)  # of motion, the last one that was given here

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
            RefusedError: the console lets nobody command, or somebody else has commanded meanwhile.
            PlaceError: the daemon has gone.
        """
        self._require_ours()
        if self._client.ask("status")["state"] == State.FAULT.label:  # what was tried before it has ended so
            self._client.ask("clear")
        fields, descriptor = self._client.attach()
        if fields["layout"] != Ring.layout():
            raise PlaceError("the daemon is of another version than this pneud; restart it")
        ring = Ring.attach(descriptor, fields["slots"], fields["slot_bytes"])
        try:
            played = _Played(self._client, ring, operator)
            ticks = played.play()
        except BaseException:
            with contextlib.suppress(RefusedError, PlaceError), self._connect() as other:
                other.ask("stop")
            raise
        self._order = played.order or self._order
        self.axis_s += ticks / self.loaded.config.loop.rate_hz

    def _require_ours(self) -> None:
        """Nobody else has stopped or moved the axis while nobody was looking.

        Raises:
            RefusedError: somebody has.
        """
        order = self._client.ask("status")["order"]
        if order is not None and order["number"] != self._order:
            words = f"ended: somebody else has commanded the axis meanwhile: {order['words']}"
            raise RefusedError({"type": "stopped", "message": words})

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
        keep(self.loaded.proof_file, _digest(self.loaded), told)
        if verdict.passed and any(f["name"] == "unproven" for f in self._status["faults"]):
            self._begin_anew()

    def adopt(self, text: str, keep: bool) -> None:
        """Write another configuration, and have the daemon begin anew with it; what is proven stays so.

        Where it does not begin, the file is as it was.
        """
        assert keep
        self._require_ours()
        before = self.loaded.text
        self._put(text)
        try:
            self._begin_anew()
        except BaseException:
            self._put(before)
            raise
        self._logs = self._logs[-1:]

    def put_back(self, text: str) -> str:
        """Have the file and its proof as they were, and the daemon run it, where the axis rests disarmed.

        What has come to be held, or shows a fault, is left as it is: to disarm it is a person's decision.
        """
        self._put(text)
        try:
            self._client.close()  # it may have been left amid a reply
            self._client = self._connect()
            state = self._come_to_rest()
            if state == State.DISARMED.label:
                self._begin_anew()
                return ""
        except (RefusedError, PlaceError):
            return TO_DO.format("")
        return TO_DO.format("pneud clear, " if state == State.FAULT.label else "pneud disarm, ")

    def _put(self, text: str) -> None:
        """Write another configuration of the same rig; what is proven stays so."""
        before = self.loaded
        whole = before.path.read_text(encoding="utf-8-sig")
        put_text(before.path, with_axis(whole, before.path, before.part, text))
        try:
            self.loaded = load(before.path, axis=before.config.name)
        except BaseException:
            put_text(before.path, whole)
            raise
        carry_over(before.proof_file, _digest(before), _digest(self.loaded))

    def _come_to_rest(self) -> str:
        """Wait until no stop is under way; the state that it has led to."""
        until_ns = time.monotonic_ns() + round(SESSION_S * 1e9)
        while True:
            self._status = self._client.ask("status")
            state = str(self._status["state"])
            if state not in UNDER_WAY or time.monotonic_ns() > until_ns:
                return state
            time.sleep(LOOK_S)

    def _begin_anew(self) -> None:
        """End the session in order; the next one has a log of its own."""
        before = str(self._status["log"])
        self._rest()
        self._client.ask("restart")
        self._client.close()
        self._client, self._status = next_session(
            self._connect, before, SESSION_S, lambda status: status["state"] not in BEGINNING
        )
        self._order = None
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
                self._order = self._client.ask("disarm", **whose).get("order", self._order)
            time.sleep(LOOK_S)
            self._status = self._client.ask("status")


class _Played:
    """An operator's requests on their way to the console, and the ticks on theirs to him."""

    def __init__(self, client: Client, ring: Ring, operator: Operator) -> None:
        self._client, self._ring, self._operator = client, ring, operator
        self._reader: RingReader = ring.reader()
        self._pieces: list[tuple[float, ...]] = []
        self.order: int | None = None  # the last one of motion
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
            self.order = self._send(kind, values).get("order", self.order)
        except RefusedError as e:
            if e.kind not in BY_THE_AXIS:
                raise

    def _send(self, kind: RequestKind, values: tuple[float, ...]) -> dict[str, Any]:
        if kind == RequestKind.PROBE:
            voltage_v, rate_v_s, travel_m, speed_m_s, force_n, _ = values
            bounds = {"travel_mm": 1e3 * travel_m, "speed_mm_s": 1e3 * speed_m_s, "force_n": force_n}
            how = {"voltage_v": voltage_v, "rate_v_s": rate_v_s, **bounds}
            return self._client.ask("probe", **how, lease_s=LEASE_S)
        if kind == RequestKind.GOTO:
            position_m, speed_m_s, *_ = (*values, 0.0)
            bounds = {"speed_mm_s": 1e3 * speed_m_s} if speed_m_s else {}
            return self._client.ask("goto", x_mm=1e3 * position_m, **bounds, attended=True)
        if kind == RequestKind.TRACK:
            self._upload()
            return self._client.ask("track", what="profile", attended=True)
        return self._client.ask(PLAIN[kind])

    def _upload(self) -> None:
        self._asked_ns = time.monotonic_ns()
        for at in range(0, len(self._pieces), MAX_PIECES):
            some = [list(piece) for piece in self._pieces[at : at + MAX_PIECES]]
            last = at + MAX_PIECES >= len(self._pieces)
            self._client.ask("upload", first=at == 0, last=last, pieces=some)


def _digest(loaded: Loaded) -> str:
    """What a proof of a configuration's rig holds for."""
    return digest(loaded.config, loaded.dbc.read_bytes())


def _number(status: dict[str, Any]) -> int | None:
    """Of the last order of motion."""
    return None if status["order"] is None else int(status["order"]["number"])
