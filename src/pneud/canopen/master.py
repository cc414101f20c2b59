"""The master of the network: configures nodes by the `canopen` library, before anything is armed.

What is written is read back and compared, and nothing is started before all of it is as it should be. SYNC is
to be off meanwhile: there are nodes, and libraries, that lose an answer right behind it.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import methodcaller
from typing import Any, NamedTuple

from pneud.canopen import objects
from pneud.canopen.objects import Command, Nmt, Object
from pneud.canopen.plan import Plan, Step
from pneud.canopen.words import LOCAL_BIT, READY_BIT, RESET_WORD
from pneud.config.nodes import HOLD_WORD
from pneud.rt.extras import require

NEEDER = "[[bus.nodes]]"  # of the library
_SAVE_S = 2.0  # that it may take a device to store its parameters
_LOOKS = 4  # for a second node of the same identifier
_SETTLE_S = 0.02  # in which a second node of the same identifier would have answered, too
_TRANSIENT = frozenset((0x05030000, 0x05040000, 0x05040001))
_WIRING = "check its power, its wiring, its bit rate, and its id (pneud nodes list)"


class Patience(NamedTuple):
    """How long is waited, and how often something is tried."""

    answer_s: float = 0.5  # for the answer to a request
    tries: int = 5
    boot_s: float = 10.0  # for a node to be there at all
    start_s: float = 3.0  # for a started node to say that it is
    rounds: int = 3  # that a node which reboots meanwhile is configured


class NodeError(Exception):
    """A node cannot be configured; the text is one line that names node, object and cure."""

    exit_code = 1

    def __init__(self, plan: Plan, o: Object | str, problem: str, cure: str) -> None:
        super().__init__(f"{plan.name}, {o}: {problem}; {cure}")
        self.node, self.object, self.problem, self.cure = plan.node.id, str(o), problem, cure


class BusError(Exception):
    """The bus takes or gives nothing; the text is one line for a person."""

    exit_code = 3


class Configured(NamedTuple):
    """What a node came to."""

    node: int
    profile: str
    identity: tuple[int | None, ...]  # vendor, product, revision, serial, as far as it has them
    written: int  # values
    notes: tuple[str, ...]


class _RebootedError(Exception):
    """A node has begun anew while it was being configured."""


@contextmanager
def network_on(channel: str) -> Iterator[Any]:
    """The library's network on a bus.

    Args:
        channel: `socketcan:IF` or `unixcan:NAME`.

    Raises:
        ExtraError: it is not installed.
        BusError: the bus cannot be used, now or later.
    """
    require(NEEDER, "canopen")
    import can  # noqa: PLC0415 - for whoever configures only
    import canopen  # noqa: PLC0415

    kind, _, name = channel.partition(":")
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.1
    try:
        network.connect(interface=kind, channel=name)
        try:
            yield network
        finally:
            network.disconnect()
    except (can.CanError, OSError) as e:
        raise BusError(f"{channel}: {' '.join(str(e).split())}; check the interface: ip link show") from None


class Master:
    """Configures nodes.

    Attributes:
        boots: how often each node has said that it begins.
        states: what each node's heartbeat has said last.
        answers: SDO answers of each node.
    """

    def __init__(
        self,
        network: Any,
        patience: Patience = Patience(),  # noqa: B008 - it never changes
        *,
        pause: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """On a network of the library.

        Args:
            network: connected.
            patience: with the nodes.
            pause: waits so many seconds.
            clock: in which patience is measured [s].
        """
        self.boots: Counter[int] = Counter()
        self.answers: Counter[int] = Counter()
        self.states: dict[int, int] = {}
        self._asked: Counter[int] = Counter()
        # what it warns of is tried again, or said by the error
        logging.getLogger("canopen").setLevel(logging.CRITICAL)
        self._network = network
        self._patience = patience
        self._pause, self._clock = pause, clock
        self._clients: dict[int, Any] = {}
        self._configured_at: dict[int, int] = {}  # boots of each node, when it was

    def configure(self, plans: Sequence[Plan], *, save: bool = False, start: bool = True) -> list[Configured]:
        """Configure all nodes, and start them in this order.

        Args:
            plans: of the nodes.
            save: have them store what they are configured to.
            start: make them operational, when all are configured.

        Returns:
            What each came to.

        Raises:
            NodeError: one is not as it should be; none has been started then.
        """
        for plan in plans:
            self._watch(plan.node.id)
        for plan in plans:
            self.command(plan.node.id, Command.PRE_OPERATIONAL)
        found = {}
        for plan in plans:
            found[plan.node.id] = self._one(plan, save=save)
        for plan in plans:
            if plan.node.profile == "valve408":
                self._check_valve(plan)
        if start:
            self._start(plans, found)
        return [found[plan.node.id] for plan in plans]

    def compare(self, plan: Plan) -> list[tuple[Step, int | None]]:
        """What a node has otherwise: each value that it would be given, and what it has; writes nothing.

        Raises:
            NodeError: it does not answer.
        """
        self._watch(plan.node.id)
        self._find(plan)
        last = {step.object: step for step in plan.steps}  # some are written twice
        found: list[tuple[Step, int | None]] = []
        for step in last.values():
            try:
                value: int | None = self.read(plan.node.id, step.object)
            except _sdo_error():
                value = None
            if value is None or (value ^ step.value) & step.mask:
                found.append((step, value))
        return found

    def present(self, seconds: float = 0.5) -> list[int]:
        """Identifiers of all nodes that answer."""
        for node in range(1, 128):
            self._watch(node)
        ask = bytes((0x40, 0x00, 0x10, 0x00)) + bytes(4)
        for node in range(1, 128):
            self._network.send_message(objects.SDO_REQUEST_ID + node, ask)
            self._pause(0.002)
        self._pause(seconds)
        return sorted(node for node in range(1, 128) if self.answers[node] or node in self.states)

    def command(self, node: int, command: Command) -> None:
        """Tell a node's state machine; 0 tells all."""
        self._network.send_message(objects.NMT_ID, bytes((command, node)))

    def read(self, node: int, o: Object) -> int:
        """A value of a node.

        Raises:
            canopen.SdoError: it does not answer, or refuses.
        """
        data = self._transfer(node, methodcaller("upload", o.index, o.sub))
        return o.type.decode(data[: o.type.size])

    def text(self, node: int, index: int) -> str:
        """A text of a node; empty where it has none."""
        try:
            data: bytes = self._transfer(node, methodcaller("upload", index, 0))
        except _sdo_error():
            return ""
        return data.decode("latin-1").rstrip("\0 ")

    def identity(self, node: int) -> tuple[int | None, ...]:
        """Vendor, product, revision and serial number, as far as it has them."""
        found: list[int | None] = []
        for o in objects.IDENTITY:
            try:
                found.append(self.read(node, o))
            except _sdo_error():
                found.append(None)
        return tuple(found)

    def _watch(self, node: int) -> None:
        if node in self._clients:
            return

        def heard(_: int, data: bytearray, __: float) -> None:
            if data:
                state = data[0] & 0x7F
                self.boots[node] += state == Nmt.BOOT
                self.states[node] = state

        def answered(_: int, __: bytearray, ___: float) -> None:
            self.answers[node] += 1

        from canopen.objectdictionary import ObjectDictionary  # noqa: PLC0415
        from canopen.sdo.client import SdoClient  # noqa: PLC0415

        answers_at = objects.SDO_ANSWER_ID + node
        client: Any = SdoClient(objects.SDO_REQUEST_ID + node, answers_at, ObjectDictionary())  # type: ignore[no-untyped-call]
        client.network, client.RESPONSE_TIMEOUT = self._network, self._patience.answer_s
        self._clients[node] = client
        self._network.subscribe(answers_at, answered)
        self._network.subscribe(answers_at, client.on_response)
        self._network.subscribe(objects.HEARTBEAT_ID + node, heard)

    def _transfer(self, node: int, what: Callable[[Any], Any]) -> Any:
        """A transfer, tried again where nothing came, or something else than was asked for."""
        self._watch(node)
        for left in reversed(range(self._patience.tries)):
            self._asked[node] += 1
            try:
                return what(self._clients[node])
            except _sdo_error() as e:
                code = getattr(e, "code", None)
                if not left or (code is not None and code not in _TRANSIENT):
                    raise
                self._pause(_SETTLE_S)
        raise AssertionError

    def _one(self, plan: Plan, *, save: bool) -> Configured:
        """Configure one node, however often it reboots meanwhile, within bounds."""
        for _ in range(self._patience.rounds):
            self._find(plan)
            boots = self.boots[plan.node.id]
            self.command(plan.node.id, Command.PRE_OPERATIONAL)
            self._configured_at[plan.node.id] = boots
            try:
                return self._configured(plan, boots, save=save)
            except _RebootedError:
                continue
        raise self._restless(plan)

    @staticmethod
    def _restless(plan: Plan) -> NodeError:
        what = "it reboots again and again while it is configured"
        return NodeError(plan, "boot-up", what, "check its supply voltage, and whether its watchdog barks")

    def _find(self, plan: Plan) -> None:
        """Wait until the node answers."""
        end = self._clock() + self._patience.boot_s
        while True:
            try:
                self.read(plan.node.id, objects.DEVICE_TYPE)
            except _sdo_error() as e:
                if getattr(e, "code", None) is not None:
                    raise self._refused(plan, objects.DEVICE_TYPE, e) from None
                if self._clock() >= end:
                    waited = f"no answer in {self._patience.boot_s:g} s"
                    raise NodeError(plan, objects.DEVICE_TYPE, waited, _WIRING) from None
                self._pause(0.1)
            else:
                return

    def _configured(self, plan: Plan, boots: int, *, save: bool) -> Configured:
        node, notes, written = plan.node.id, list[str](), 0
        self._alone(plan)
        for step in plan.steps:
            if note := self._take(plan, step, boots):
                notes.append(note)
            written += step.write and not note
        identity = self.identity(node)
        if save:
            self._save(plan)
        if self.boots[node] != boots:
            raise _RebootedError
        return Configured(node, plan.node.profile, identity, written, tuple(notes))

    def _alone(self, plan: Plan) -> None:
        """Make sure that no other node answers in this one's name."""
        node = plan.node.id
        late = max(0, self._asked[node] - self.answers[node])  # answers that may still come
        asked, answers = self._asked[node], self.answers[node]
        for _ in range(_LOOKS):
            try:
                self.read(node, objects.DEVICE_TYPE)
            except _sdo_error():
                return  # which the next step says
            self._pause(_SETTLE_S)
        if self.answers[node] - answers - (self._asked[node] - asked) - late > _LOOKS // 2:
            cure = "switch one off and give the other an id of its own: pneud nodes set-id"
            raise NodeError(plan, objects.DEVICE_TYPE, "two nodes answer by this id", cure)

    def _take(self, plan: Plan, step: Step, boots: int) -> str:
        """Write a value and read it back; what there is to note."""
        node, o = plan.node.id, step.object
        try:
            if step.write:
                data = o.type.encode(step.value)
                self._transfer(node, methodcaller("download", o.index, o.sub, data))
            found = self.read(node, o)
        except _sdo_error() as e:
            if self.boots[node] != boots:
                raise _RebootedError from None
            if step.may_lack and getattr(e, "code", None) in objects.MISSING:
                return f"{plan.name} has no {o}: see its manual for it"
            raise self._refused(plan, o, e) from None
        if self.boots[node] != boots:
            raise _RebootedError
        if (found ^ step.value) & step.mask:
            shown = f"0x{found:X}" if o.type.size == 4 else f"{found}"
            wanted = f"0x{step.value:X}" if o.type.size == 4 else f"{step.value}"
            if step.write:
                problem = f"reads {shown} after {wanted} was written"
                cure = step.cure or "the device does not keep it: see its manual, or power-cycle it"
            else:
                problem, cure = f"is {shown} and not {wanted}", step.cure
            raise NodeError(plan, o, problem, cure)
        return ""

    @staticmethod
    def _refused(plan: Plan, o: Object, e: Exception) -> NodeError:
        code = getattr(e, "code", None)
        if code is None:
            words = " ".join(str(e).split())
            what = "does not answer" if words == "No SDO response received" else f"answers wrongly: {words}"
            return NodeError(plan, o, what, _WIRING)
        return NodeError(plan, o, objects.abort_text(code), objects.abort_cure(code))

    def _save(self, plan: Plan) -> None:
        o, data = objects.SAVE, objects.SAVE.type.encode(objects.SAVE_WORD)
        client = self._clients[plan.node.id]
        client.RESPONSE_TIMEOUT = max(_SAVE_S, self._patience.answer_s)
        try:
            client.download(o.index, o.sub, data)
        except _sdo_error() as e:
            raise self._refused(plan, o, e) from None
        finally:
            client.RESPONSE_TIMEOUT = self._patience.answer_s

    def _start(self, plans: Sequence[Plan], found: dict[int, Configured]) -> None:
        """Start all nodes in order, or none; one that has rebooted since it was configured is that again."""
        rounds, running = Counter[int](), dict[int, int]()  # boots with which each runs
        try:
            while left := [plan for plan in plans if running.get(plan.node.id) != self.boots[plan.node.id]]:
                for plan in left:
                    node = plan.node.id
                    if rounds[node] == self._patience.rounds:
                        raise self._restless(plan)
                    rounds[node] += 1
                    if self.boots[node] != self._configured_at[node]:
                        found[node] = self._one(plan, save=False)
                    boots = self._configured_at[node]
                    self.command(node, Command.START)
                    if self._is_started(plan, boots):
                        running[node] = boots
        except NodeError:
            for plan in plans:
                self.command(plan.node.id, Command.PRE_OPERATIONAL)
            raise

    def _is_started(self, plan: Plan, boots: int) -> bool:
        """Wait until a started node says so; whether it has not begun anew instead."""
        node = plan.node.id
        self.states.pop(node, None)
        end = self._clock() + max(self._patience.start_s, plan.node.patience_ms * 1e-3)
        while self.states.get(node) != Nmt.OPERATIONAL:
            if plan.node.guard:
                self._network.send_message(objects.HEARTBEAT_ID + node, b"", remote=True)
            if self.boots[node] != boots:
                return False
            if self._clock() >= end:
                said = self.states.get(node)
                names = {int(state): state.name.lower().replace("_", "-") for state in Nmt}
                heard = "no heartbeat" if said is None else f"its heartbeat says {names.get(said, said)}"
                problem = f"{heard} {self._patience.start_s:g} s after NMT start"
                raise NodeError(plan, objects.HEARTBEAT, problem, "look for its EMCY, and power-cycle it")
            self._pause(0.01)
        return True

    def _check_valve(self, plan: Plan) -> None:
        """A valve under local control, or that never gets ready, cannot be armed."""
        o, end = objects.STATUS_WORD, self._clock() + self._patience.start_s
        while True:
            try:
                status = self.read(plan.node.id, o)
                if not status & (READY_BIT | LOCAL_BIT):
                    self._end_fault(plan.node.id)
                    status = self.read(plan.node.id, o)
            except _sdo_error() as e:
                raise self._refused(plan, o, e) from None
            if status & LOCAL_BIT:
                raise NodeError(plan, o, "the valve is under local control", "end local control at the valve")
            if status & READY_BIT:
                return
            if self._clock() >= end:
                problem = f"is 0x{status:04X}: the valve does not get ready"
                raise NodeError(plan, o, problem, "check its enable pin and its supply; look for its EMCY")
            self._pause(0.05)

    def _end_fault(self, node: int) -> None:
        """Ask a valve for the end of a fault, such as one for want of commands: by a rising edge."""
        o = objects.CONTROL_WORD
        for word in (HOLD_WORD, RESET_WORD, HOLD_WORD):
            data = o.type.encode(word)
            self._transfer(node, methodcaller("download", o.index, o.sub, data))


def _sdo_error() -> type[Exception]:
    """What the library raises of a transfer."""
    from canopen.sdo.exceptions import SdoError  # noqa: PLC0415

    found: type[Exception] = SdoError
    return found
