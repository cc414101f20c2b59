"""The socket's server: many clients, one that commands, and one request at a time on its way to the loop.

Nothing a client does or leaves undone holds up another one, or the loop: what comes is bounded and paced, who
does not read is dropped, who comes when all places are taken gets that of the longest idle.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from pneud.console import handoff, protocol, together
from pneud.console.beside import Beside, Then
from pneud.console.connected import BOUNDS, LINES, ClientBounds, Connected, Job
from pneud.console.lease import Lease
from pneud.console.orders import MOTION, RENEWED, Desk, Orders
from pneud.console.peer import commanding_group, may_command, peer_of, why_read_only
from pneud.console.protocol import Error, ProtocolError
from pneud.console.setting_out import SettingOut
from pneud.signals import Answer, Request, RequestKind, State

INFO, WARNING = 2, 3  # levels of the log's events

_CHUNK = 16 * 1024
_GONE = "who asked had gone before; it has not been done"
_ACCEPTS = 16  # new clients in a turn
_LOOK_S = 0.01  # between two looks at axes that come to rest before they set out
_QUIET_S = 1.0  # between two words for the log about the same client's mistakes


class Server:
    """The console's server; `step` is one turn."""

    def __init__(
        self,
        listener: socket.socket,
        loop: socket.socket,
        desk: Desk | Sequence[Desk],
        say: Callable[[int, str], None],
        bounds: ClientBounds = BOUNDS,
        clock: Callable[[], float] = time.monotonic,
        first: int = 0,
        files: Beside | None = None,
        name: str = "",
        place: int = 0,
    ) -> None:
        """A server that is ready to take its turns.

        Args:
            listener: bound and listening; closed by `close`.
            loop: the console's end of the hand-off; closed by `close`.
            desk: knows the axis; or one for each of several.
            say: level and words for the log.
            bounds: what clients may use up.
            clock: seconds.
            first: its requests' numbers begin after it.
            files: has the desk read its files, in a thread unless it is given.
            name: of the daemon, where it has several axes.
            place: consoles that had died when this one began.
        """
        self.over = False  # the loop is gone
        self._listener = listener
        self._loop = loop
        self._desks: tuple[Desk, ...] = tuple(desk) if isinstance(desk, Sequence) else (desk,)
        self._name = name or self._desks[0].name
        self._place = place
        self._say = say
        self._bounds = bounds
        self._clock = clock
        self._group = commanding_group()
        self._clients: dict[Connected, None] = {}  # in the order in which they came
        self._lease: Lease[Connected] = Lease(bounds.lease_s)
        self._jobs: deque[Job] = deque()
        self._flight: tuple[int, Job, float] | None = None  # number, whose, given up at
        self._number = first
        self._attending: dict[int, Connected] = {}  # to a motion of an axis that ends with him
        self._files = files or Beside(self._read, clock)
        self._statuses: dict[int, dict[str, Any]] = {}  # of axes, for all who ask in a turn
        self._later = SettingOut(self._desks, self._refuse)
        self._unfinished: tuple[Connected | None, Orders] | None = None
        self._renewed: dict[int, str] = {}  # by axis
        self._order: dict[int, dict[str, Any]] = {}  # of motion of an axis, the last one that was taken
        self._selector = selectors.DefaultSelector()
        listener.setblocking(False)
        loop.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)
        self._selector.register(loop, selectors.EVENT_READ)
        self._selector.register(self._files.descriptor, selectors.EVENT_READ)
        for axis, one in enumerate(self._desks):
            left = one.left_half_done()
            if left is not None:
                self._undo(left._replace(axes=(axis,)), "the console")

    def _read(self) -> None:
        for desk in self._desks:
            desk.read()

    def step(self, timeout_s: float) -> None:
        """Wait for something to do, for so long at most, and do it."""
        if any(client.is_due for client in self._clients):
            timeout_s = 0.0
        for key, events in self._selector.select(min(timeout_s, _LOOK_S) if self._later else timeout_s):
            if key.fileobj is self._listener:
                self._accept()
            elif key.fileobj is self._loop:
                self._hear()
            elif key.data in self._clients:
                if events & selectors.EVENT_WRITE:
                    self._flush(key.data)
                if events & selectors.EVENT_READ:
                    self._receive(key.data)
        now_s = self._clock()
        if self._flight is not None and now_s > self._flight[2]:
            self._give_up(self._flight[1])
        for client in list(self._clients):
            self._serve(client, now_s)
        self._statuses.clear()
        self._files.go_on()
        for setting_out, message in self._later.due(now_s) if self._later else ():
            self._command(setting_out, message, True)
        self._hand_over()

    def ask(self, message: protocol.Request, label: str, refused: Callable[[ProtocolError], None]) -> None:
        """Do what no client asks for, without a lease.

        Args:
            message: what to do.
            label: who asks, for the log.
            refused: is told why it is not done, now or later.
        """
        self._read_first(message, lambda read: self._ask(message, label, refused, read))

    def _ask(
        self, message: protocol.Request, label: str, refused: Callable[[ProtocolError], None], read: bool
    ) -> None:
        try:
            plan = self._plan(message, read)
        except ProtocolError as e:
            self._say(WARNING, f"{label}: {message.verb} → {e.kind}: {e.message}")
            refused(e)
            return
        if plan.requests:
            self._jobs.append(Job(None, None, plan, label, refused))
            return
        self._say(INFO, f"{label}: {plan.words}")
        if plan.done is not None:
            plan.done()

    def close(self) -> None:
        """Leave all clients; whoever has been waiting for what the loop did last is told."""
        if not self.over:
            self._hear()
        for client in list(self._clients):
            self._drop(client)
        self._selector.close()
        self._files.close()
        self._listener.close()
        self._loop.close()

    # clients

    def _accept(self) -> None:
        for _ in range(_ACCEPTS):
            try:
                connection, _ = self._listener.accept()
            except OSError:  # none left, or no more descriptors
                return
            connection.setblocking(False)
            try:
                peer = peer_of(connection)
            except OSError:
                connection.close()
                continue
            if len(self._clients) >= self._bounds.clients:
                self._displace_one()
            now_s = self._clock()
            read_only = not may_command(peer, self._group)
            client = Connected(connection, peer, read_only, now_s, self._bounds.burst)
            self._clients[client] = None
            self._selector.register(connection, client.interest, client)

    def _displace_one(self) -> None:
        holder = self._lease.holder(self._clock())
        idle = min((c for c in self._clients if c is not holder), key=lambda c: c.active_s)
        self._send(idle, self._refusal(ProtocolError(Error.DISPLACED, "too many clients; yours was idle")))
        self._drop(idle)

    def _drop(self, client: Connected) -> None:
        if client not in self._clients:
            return
        del self._clients[client]
        if client.interest:
            self._selector.unregister(client.connection)
        client.connection.close()
        self._report_mistakes(client)
        self._lease.drop(client)
        self._later.drop(client)
        for job in [job for job in self._jobs if job.client is client]:
            job.client = None
            if not job.plan.urgent:  # what is still to come of a client that has gone is not done
                self._forget(job)
                if job.begun and (self._flight is None or self._flight[1] is not job):
                    self._undo(job.plan, job.label)
        if self._unfinished is not None and self._unfinished[0] is client:
            self._undo(self._unfinished[1], client.peer.label)
        for axis in [axis for axis, who in self._attending.items() if who is client]:
            self._unattended(axis, client.peer.label)

    def _receive(self, client: Connected) -> None:
        for _ in range(2):  # behind the last that a client says it is known whether it has gone
            try:
                data = client.connection.recv(_CHUNK)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            client.has_gone = not data
            if not client.ended:
                client.received += data
                client.active_s = self._clock()

    def _serve(self, client: Connected, now_s: float) -> None:
        """Take the lines that have come, at the pace that is due to a client."""
        b = self._bounds
        client.tokens = min(b.burst, client.tokens + (now_s - client.paced_s) * b.rate_hz)
        client.paced_s = now_s
        if client.mistakes and now_s >= client.quiet_until_s:
            self._report_mistakes(client)
        for _ in range(LINES):
            full = client.awaits >= LINES or client.tokens < 1.0
            if client.ended or client.unsent or full or not client.has_line:
                break
            try:
                line = client.next_line()
            except ProtocolError as e:
                self._refuse(client, e)
                client.ended = True
                break
            if line is not None and line.strip():
                client.tokens -= 1.0
                self._take(client, line)
                if client not in self._clients:
                    return
        if client.unsent and now_s - client.sent_s > b.unsent_s:
            self._say(WARNING, f"{client.peer.label}: dropped, does not read its replies")
            self._drop(client)
            return
        if (client.ended and not client.unsent) or (client.has_gone and not client.has_line):
            self._drop(client)
            return
        wanted = selectors.EVENT_WRITE if client.unsent else 0 if client.has_line else selectors.EVENT_READ
        if wanted != client.interest:
            if not client.interest:
                self._selector.register(client.connection, wanted, client)
            elif not wanted:
                self._selector.unregister(client.connection)
            else:
                self._selector.modify(client.connection, wanted, client)
            client.interest = wanted

    def _send(self, client: Connected | None, data: bytes) -> None:
        if client is None or client not in self._clients:
            return
        if not client.unsent:
            client.sent_s = self._clock()
        client.unsent += data
        self._flush(client)
        if len(client.unsent) > self._bounds.unsent_bytes:
            client.ended = True
            client.unsent.clear()

    def _flush(self, client: Connected) -> None:
        try:
            while client.unsent:
                sent = client.connection.send(client.unsent)
                del client.unsent[:sent]
                client.sent_s = self._clock()
        except BlockingIOError:
            return
        except OSError:
            client.ended = True
            client.unsent.clear()

    def _refuse(self, client: Connected, error: ProtocolError, words: str = "") -> None:
        """Tell a client, and the log: commands one by one, mere mistakes once a second."""
        if words:
            self._say(WARNING, f"{client.peer.label}: {words} → {error.kind}")
        else:
            client.mistakes += 1
            now_s = self._clock()
            if now_s >= client.quiet_until_s:
                client.quiet_until_s = now_s + _QUIET_S
                client.mistakes -= 1
                self._say(WARNING, f"{client.peer.label}: refused: {error.kind}: {error.message}")
        self._send(client, self._refusal(error))

    def _report_mistakes(self, client: Connected) -> None:
        if client.mistakes:
            self._say(WARNING, f"{client.peer.label}: refused {client.mistakes} more")
            client.mistakes = 0

    def _reply(self, number: int | None, whose: tuple[int, ...] = (), **fields: Any) -> bytes:
        if len(whose) > 1:
            fields["axes"] = [self._desks[axis].name for axis in whose]
        name = self._desks[whose[0]].name if len(whose) == 1 else self._name
        return protocol.reply(number, name, **fields)

    def _refusal(self, error: ProtocolError) -> bytes:
        return protocol.refusal(error, self._name)

    # requests

    def _take(self, client: Connected, line: bytes) -> None:
        try:
            message = protocol.parse(line)
        except ProtocolError as e:
            self._refuse(client, e)
            return
        number = message.id
        match message.verb:
            case "status":
                tell = client.awaiting(lambda _: self._tell_status(client, message))
                self._files.do(self._bounds.look_s, tell)
            case "tune_get":
                if (axis := self._one(client, message)) is not None:
                    self._send(client, self._reply(number, (axis,), **self._desks[axis].gains()))
            case "observe":
                client.read_only = True
                self._send(client, self._reply(number))
            case "attach":
                if (axis := self._one(client, message)) is not None:
                    self._attach(client, axis, number)
            case _:
                then = client.awaiting(lambda read: self._command(client, message, read))
                self._read_first(message, then)

    def _one(self, client: Connected, message: protocol.Request) -> int | None:
        """The one axis that is meant; None where none is, which the client has been told."""
        try:
            return together.meant(self._desks, message)[0]
        except ProtocolError as e:
            e.number = message.id
            self._refuse(client, e)
            return None

    def _tell_status(self, client: Connected, message: protocol.Request) -> None:
        lease = self._lease_fields()
        if message.axis is not None or len(self._desks) == 1:
            if (axis := self._one(client, message)) is not None:
                fields = {**self._status(axis), "lease": lease}
                if len(self._desks) > 1:
                    others = (n for n in range(len(self._desks)) if n != axis)
                    fields["others"] = {self._desks[n].name: self._status(n)["state"] for n in others}
                self._send(client, self._reply(message.id, (axis,), **fields))
            return
        each = {desk.name: self._status(axis) for axis, desk in enumerate(self._desks)}
        self._send(client, self._reply(message.id, schema=1, name=self._name, axes=each, lease=lease))

    def _status(self, axis: int) -> dict[str, Any]:
        if axis not in self._statuses:
            self._statuses[axis] = {**self._desks[axis].status(), "order": self._order.get(axis)}
        return self._statuses[axis]

    def _lease_fields(self) -> dict[str, Any] | None:
        now_s = self._clock()
        if (holder := self._lease.holder(now_s)) is None:
            return None
        left_s = self._lease.left_s(now_s)
        return {"uid": holder.peer.uid, "pid": holder.peer.pid, "left_s": round(left_s, 3)}

    def _attach(self, client: Connected, axis: int, number: int) -> None:
        """Reply with a descriptor, which goes with the first byte of the line."""
        try:
            fields, descriptor = self._desks[axis].attach()
        except OSError as e:
            error = ProtocolError(Error.FULL, f"no descriptor to give: {e.strerror}", number)
            self._refuse(client, error)
            return
        line = self._reply(number, (axis,), **fields)
        try:
            sent = socket.send_fds(client.connection, [line], [descriptor])
        except OSError:
            client.ended = True
            return
        finally:
            os.close(descriptor)
        if sent < len(line):
            self._send(client, line[sent:])

    def _read_first(self, message: protocol.Request, then: Then) -> None:
        """Go on when what a request depends on is read: at once, where that is nothing."""
        if isinstance(message, protocol.TuneReload):
            self._files.do(self._bounds.read_s, then)
        else:
            then(True)

    def _plan(self, message: protocol.Request, read: bool) -> Orders:
        if not read:
            raise ProtocolError(
                Error.CONFIGURATION,
                f"the file cannot be read within {self._bounds.read_s:g} s; nothing has been taken",
            )
        return together.plan(self._desks, message)

    def _command(self, client: Connected, message: protocol.Request, read: bool) -> None:
        if client not in self._clients:  # has gone meanwhile
            return
        number, words = message.id, str(message.verb)
        try:
            if client.read_only:
                raise ProtocolError(Error.READ_ONLY, why_read_only(client.peer))
            plan = self._plan(message, read)
            words = plan.words
            if client.has_gone and not plan.urgent:
                raise ProtocolError(Error.LATE, _GONE)
            now_s = self._clock()
            if not plan.free and not self._lease.take(client, now_s, by_force=plan.urgent):
                holder = self._lease.holder(now_s)
                assert holder is not None
                raise ProtocolError(
                    Error.BUSY,
                    f"{holder.peer.label} commands, for {self._lease.left_s(now_s):.1f} s more",
                    uid=holder.peer.uid,
                    pid=holder.peer.pid,
                )
            if plan.urgent:
                self._displace_jobs()
            if not plan.requests:  # nothing changes
                more = plan.done() if plan.done is not None else {}
                self._send(client, self._reply(number, plan.axes, **more))
                return
            if len(self._jobs) >= self._bounds.jobs:
                raise ProtocolError(Error.FULL, "too many requests wait for the loop")
        except ProtocolError as e:
            e.number = number
            self._refuse(client, e, words)
            return
        job = Job(client, number, plan, client.peer.label)
        if plan.urgent:
            self._jobs.appendleft(job)
        else:
            self._jobs.append(job)

    def _displace_jobs(self) -> None:
        """A stop goes first: what still waits, and the rest of what is under way, is not done."""
        under_way = self._flight[1] if self._flight is not None else None
        waiting, self._jobs = self._jobs, deque()
        for job in waiting:
            last = job is under_way and job.next + 1 == len(job.plan.requests)
            if job.plan.urgent or job.plan.free or last:
                self._jobs.append(job)
            else:
                self._end(job, ProtocolError(Error.DISPLACED, "a stop came first"))

    def _undo(self, plan: Orders, label: str) -> None:
        """What is not done whole is not done in part."""
        self._unfinished = None
        if plan.undo is None:
            return

        def undone() -> dict[str, Any]:
            together.half_done(self._desks, plan.axes, None)
            return {}

        def refused(error: ProtocolError) -> None:
            if error.kind == Error.LATE:
                self._undo(plan, label)
            else:
                undone()

        orders = Orders(f"undo {plan.words}", (plan.undo,), done=undone, axes=plan.axes)
        # before what the client has sent behind it
        self._jobs.appendleft(Job(None, None, orders, label, refused))

    def _unattended(self, axis: int, label: str) -> None:
        """Have an axis hold: whose motion it was has gone."""
        why = f"{label} has gone while {'jogging' if self._renewed.get(axis) else 'moving'}"
        self._attending.pop(axis, None)
        self._renewed.pop(axis, None)
        hold = Orders("hold", (Request(RequestKind.HOLD),), axes=(axis,))
        self._jobs.append(Job(None, None, hold, why))

    # the loop

    def _hand_over(self) -> None:
        """Send the next request, if none is under way."""
        while self._flight is None and self._jobs and not self.over:
            job = self._jobs[0]
            whose, coming = self._unfinished or (None, None)
            if (error := together.too_soon(job.plan, coming, own=whose is job.client)) is not None:
                self._forget(job)
                self._tell(job, error)
                continue
            if job.client is not None and not job.plan.urgent and job.client.hung_up():
                self._end(job, ProtocolError(Error.LATE, _GONE))
                continue
            self._number = (self._number + 1) & 0xFFFF_FFFF
            self._flight = (self._number, job, self._clock() + self._bounds.silent_s)
            if job.plan.undo is not None:
                together.half_done(self._desks, job.plan.axes, job.plan.undo)
            if not handoff.send_all(self._loop, self._number, job.plan.step(job.next), self._place):
                self._give_up(job)
            job.begun = True

    def _hear(self) -> None:
        try:
            found = handoff.receive_from(self._loop)
        except EOFError:
            self.over = True
            self._selector.unregister(self._loop)
            return
        if found is None or self._flight is None or self._flight[0] != found[1].number:
            return  # the answer to a request that was given up
        axis, outcome = found
        job = self._flight[1]
        self._flight = None
        if job.ended:
            return
        if outcome.answer == Answer.TAKEN:
            job.next += 1
            if job.next == len(job.plan.requests):
                self._forget(job)
                self._done(job, outcome)
            elif job not in self._jobs:  # its client has gone in the middle of it
                self._undo(job.plan, job.label)
            return
        job.begun = job.next > 0
        if not job.begun:
            together.took_nothing(self._desks, job.plan, self._unfinished[1] if self._unfinished else None)
        if outcome.answer == handoff.LATE:
            error = ProtocolError(Error.LATE, "the loop came to it too late; it has not been done")
        else:
            error = self._desks[axis].refused(outcome.answer, job.plan.words, outcome)
            error.axis = self._desks[axis].name if len(self._desks) > 1 else ""
        self._end(job, error)

    def _give_up(self, job: Job) -> None:
        self._flight = None
        self._end(job, ProtocolError(Error.SILENT, "the loop does not answer; it may have been done or not"))

    def _forget(self, job: Job) -> None:
        with contextlib.suppress(ValueError):
            self._jobs.remove(job)

    def _done(self, job: Job, outcome: handoff.RequestOutcome) -> None:
        more = job.plan.done() if job.plan.done is not None else {}
        kind = job.plan.requests[-1].kind
        moves = kind in MOTION or kind in RENEWED
        if moves:
            order = {"number": outcome.number, "words": job.plan.words}
            self._order |= dict.fromkeys(job.plan.axes, order)
            more["order"] = outcome.number
            self._later.displace(job.plan.axes)
        if job.plan.undo is not None:
            if self._unfinished is not None and self._unfinished[1].undo != job.plan.undo:
                self._undo(self._unfinished[1], job.label)  # left for something else in the middle
            self._unfinished = (job.client, job.plan) if job.plan.unfinished else None
            if not job.plan.unfinished:
                together.half_done(self._desks, job.plan.axes, None)
            if job.plan.unfinished and job.client is None:
                self._undo(job.plan, job.label)
        if kind not in RENEWED or job.plan.words != self._renewed.get(job.plan.axes[0]):
            self._say(INFO, f"{job.label}: {together.whose(self._desks, job.plan)}{job.plan.words} → taken")
        for axis in job.plan.axes if moves else ():
            self._attend(axis, job, renewed=job.plan.words if kind in RENEWED else "")
        if job.plan.then is not None:
            self._later.add(job.client, job.plan.then, self._clock())
            return
        state = State(outcome.state).label
        self._send(job.client, self._reply(job.number, job.plan.axes, **more, state=state))

    def _attend(self, axis: int, job: Job, renewed: str) -> None:
        """See whether the motion that an axis has begun ends with a client."""
        self._renewed[axis] = renewed
        self._attending.pop(axis, None)
        if job.plan.attended and job.client is not None:
            self._attending[axis] = job.client
        elif job.plan.attended:
            self._unattended(axis, job.label)

    def _end(self, job: Job, error: ProtocolError) -> None:
        self._forget(job)
        job.ended = True
        if job.begun or job.plan.follows:
            self._undo(job.plan, job.label)
        self._tell(job, error)

    def _tell(self, job: Job, error: ProtocolError) -> None:
        error.number = job.number
        words = f"{job.label}: {together.whose(self._desks, job.plan)}{job.plan.words}"
        self._say(WARNING, f"{words} → {error.kind}")
        self._send(job.client, self._refusal(error))
        if job.refused is not None:
            job.refused(error)
