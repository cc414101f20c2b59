"""The nodes of a software rig's inputs and outputs, and the brake that hangs on them.

Inputs are what a scenario makes of them. Outputs fall to their safe state, all off, where nobody has sent
them for too long, as on a node with a time-out. Time comes with the calls.
"""

from __future__ import annotations

from pneud.bus.switching import Switching
from pneud.physics.plant import Board
from pneud.signals import Frame


class StationNode:
    """Inputs that are sent, outputs that are taken, and a brake.

    Attributes:
        inputs: bits that are on; whoever plays with the rig may change them.
        silent: the inputs' node sends nothing.
        stuck: how the brake stands whatever it is told: 1 released, 0 engaged; −1 where it does as told.
        outputs: bits that are on.
        speaker: who sends the inputs: another rig's node on the same bus, where they share a message.
    """

    def __init__(self, switching: Switching, board: Board) -> None:
        self.inputs = board.inputs
        self.silent = False
        self.stuck = -1
        self.outputs = 0
        self.speaker = self
        self._switching = switching
        self._board = board
        self._period_ns, self._timeout_ns = round(board.period_s * 1e9), round(board.timeout_s * 1e9)
        self._release_ns, self._engage_ns = round(board.release_s * 1e9), round(board.engage_s * 1e9)
        self._ids = {message.codec.can_id: message for message in switching.outputs}
        self._counters = [0] * len(switching.inputs)
        self._heard_ns: dict[int, int] = {}
        self.next_ns = 0
        """When inputs are sent next, whatever the controller does."""
        self._told_free, self._told_ns = not board.frees, 0  # without power
        self._free = self._told_free  # the brake has let go

    @property
    def ids(self) -> frozenset[int]:
        """Identifiers of what it takes."""
        return frozenset(self._ids)

    def join(self, other: StationNode) -> None:
        """Another rig is on the same bus, and was there before: what both would send, it sends."""
        theirs = {message.codec.can_id for message in other._switching.inputs}
        if any(message.codec.can_id in theirs for message in self._switching.inputs):
            self.speaker = other.speaker

    def bit_of(self, name: str) -> int:
        """The mask of an input.

        Raises:
            KeyError: there is none of this name.
        """
        return {one.name: 1 << one.bit for message in self._switching.inputs for one in message.switches}[
            name
        ]

    def hear(self, frame: Frame) -> None:
        """A message with outputs has come; one that is not valid changes nothing."""
        message = self._ids[frame.can_id]
        if message.codec.valid(frame.data):
            self.outputs = self.outputs & ~message.mask() | message.bits(frame.data)
            self._heard_ns[frame.can_id] = frame.stamp_ns
            self._tell(frame.stamp_ns)

    def _tell(self, t_ns: int) -> None:
        """The brake is told what the outputs say since an instant."""
        told_free = (self.outputs & self._board.brake != 0) == self._board.frees
        if told_free != self._told_free:
            self._told_free, self._told_ns = told_free, t_ns

    def is_clamped(self, t_ns: int) -> bool:
        """Whether the brake holds the load, at an instant no earlier than the last one."""
        for can_id, heard_ns in list(self._heard_ns.items()):
            if t_ns - heard_ns > self._timeout_ns:
                self.outputs &= ~self._ids[can_id].mask()
                del self._heard_ns[can_id]
                self._tell(heard_ns + self._timeout_ns)
        if not self._board.brake:
            return False
        if t_ns - self._told_ns >= (self._release_ns if self._told_free else self._engage_ns):
            self._free = self._told_free
        if self.stuck >= 0:
            self._free = self.stuck == 1
        return not self._free

    def due(self, t_ns: int) -> list[Frame]:
        """The messages with inputs that are to be sent now."""
        if t_ns < self.next_ns:
            return []
        self.next_ns = t_ns + self._period_ns
        if self.silent or self.speaker is not self:
            return []
        bits = self.inputs & ~self._board.feedback | (self._board.feedback if self._free else 0)
        found = []
        for i, message in enumerate(self._switching.inputs):
            found.append(Frame(t_ns, message.codec.can_id, message.encode(bits, self._counters[i])))
            self._counters[i] += 1
        return found
