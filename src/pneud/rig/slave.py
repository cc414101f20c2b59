"""A CANopen node of the software rig: its objects, and what it answers to the master of the network.

Frames in, frames out, no clock and no I/O: time is that of the frames, and of whoever polls. It is written
from the standard and not from the library that configures it, so that the two can disagree.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from pneud.canopen import objects
from pneud.canopen.eds import Eds
from pneud.canopen.objects import INVALID, Command, Nmt, Pdo
from pneud.signals import Frame

_MUX = struct.Struct("<HB")
_NEVER_NS = 1 << 62
_ANSWER_NS = 200_000  # from a request to its answer
_UNCONFIGURED = 255  # node id of a device that LSS has to give one
_EXISTS, _READ_ONLY, _LENGTH_OBJECT, _RANGE = 0x06020000, 0x06010002, 0x06070010, 0x06090030
_NO_SUB, _COMMAND, _TOGGLE, _STATE = 0x06090011, 0x05040001, 0x05030000, 0x08000022


class Oddity(NamedTuple):
    """How a node misbehaves; each by itself or with others."""

    boot_ms: float = 0.0  # from power-up, or a reset, to its first message
    deaf_after_sync_us: float = 0.0  # answers due so soon behind a SYNC are lost
    lose_answers: float = 0.0  # part of SDO answers that are lost
    abort: tuple[int, int, int] | None = None  # (index, sub, code): it refuses to have this written
    lacks: tuple[int, int] | None = None  # (index, sub) of its EDS that it has not
    keeps: tuple[int, int] | None = None  # (index, sub) that it takes and does not change
    bootloader: bool = False  # it is not more than that
    reboot_after: int = 0  # it reboots after so many SDO answers, once; 0: not
    reboots: int = 1  # how often it does so
    never_starts: bool = False  # it stays pre-operational
    silent: bool = False  # it is not there
    slow_ms: float = 0.0  # more to its answers


HEALTHY = Oddity()
KINDS = (
    *("slow boot", "answers lost", "abort", "wrong EDS", "stubborn", "bootloader", "reboot", "never ready"),
    *("silent", "duplicate", "slow", "behind SYNC", "healthy"),
)


def drawn(seed: int, writable: list[tuple[int, int]]) -> tuple[str, Oddity]:
    """An oddity by chance: its kind, one of `KINDS`, and what it is; a duplicate has to be made elsewhere."""
    r = random.Random(f"oddity {seed}")
    kind = KINDS[seed % len(KINDS)]
    index, sub = r.choice(writable)
    refusal = r.choice((0x06010002, 0x06090030, 0x06090031, 0x08000000, 0x08000021, 0x08000022, 0x06070010))
    found = {
        "slow boot": Oddity(boot_ms=r.uniform(50.0, 1500.0)),
        "answers lost": Oddity(lose_answers=r.uniform(0.02, 0.3)),
        "abort": Oddity(abort=(index, sub, refusal)),
        "wrong EDS": Oddity(lacks=(index, sub)),
        "stubborn": Oddity(keeps=(index, sub)),
        "bootloader": Oddity(bootloader=True),
        "reboot": Oddity(reboot_after=r.randint(1, 60), reboots=r.choice((1, 1, 2, 1000))),
        "never ready": Oddity(never_starts=True),
        "silent": Oddity(silent=True),
        "slow": Oddity(slow_ms=r.uniform(1.0, 400.0)),
        "behind SYNC": Oddity(deaf_after_sync_us=r.uniform(100.0, 2000.0)),
    }
    return kind, found.get(kind, HEALTHY)


@dataclass(frozen=True, slots=True)
class _Transfer:
    """A segmented transfer under way."""

    index: int
    sub: int
    data: bytes
    upload: bool
    toggle: int = 0


class Slave:
    """One node.

    Attributes:
        id: its identifier; 255 where LSS has yet to give it one.
        state: as its heartbeat says.
        values: its object dictionary: bytes by (index, sub).
        stored: what it has after a reset, where it was told to keep that.
        written: told of each value that is written, (index, sub).
    """

    def __init__(self, eds: Eds, node: int, serial: int, *, seed: int = 0, odd: Oddity = HEALTHY) -> None:
        self.id = node
        self.eds = eds
        self.odd = odd
        self._identity = {4: serial}
        self.state = Nmt.BOOT
        self.stored: dict[tuple[int, int], bytes] = {}
        self.written: Callable[[int, int], None] | None = None
        self._random = random.Random(f"slave {seed} {node} {serial}")
        self._out: list[Frame] = []
        self._transfer: _Transfer | None = None
        self._up_ns = _NEVER_NS  # when it has booted; never before power-up
        self._beat_ns = _NEVER_NS  # when its next heartbeat is due
        self._sync_ns = -_NEVER_NS
        self._answers, self._reboots = 0, odd.reboots
        self._lss_configuring = False
        self._lss_next = 0  # part of its identity that fastscan has come to
        self._lss_selected: dict[int, int] = {}
        self._lss_id = node
        self.values: dict[tuple[int, int], bytes] = {}
        self._load()

    def power_up(self, t_ns: int) -> None:
        """Begin, or begin anew: what was not stored is gone."""
        self._load()
        self.state = Nmt.BOOT
        self._out, self._transfer, self._beat_ns = [], None, _NEVER_NS
        self._up_ns = t_ns + round(self.odd.boot_ms * 1e6)

    def identify(self, sub: int, value: int) -> None:
        """Have another identity (0x1018) than its EDS says."""
        self._identity[sub] = value
        self._load()

    def configure(self, values: dict[tuple[int, int], int], t_ns: int) -> None:
        """Be configured and started, without anybody who does it."""
        self._boot(t_ns)
        for (index, sub), value in values.items():
            if (index, sub) in self.values:
                self.set(index, sub, value)
        self.state = Nmt.OPERATIONAL
        self._out.append(Frame(t_ns, objects.HEARTBEAT_ID + self.id, bytes((self.state,))))
        self._beat(t_ns)

    def set(self, index: int, sub: int, value: int) -> None:
        """Set a value from inside, such as one that is measured."""
        entry = self.eds.entries[index, sub]
        size = entry.object.type.size
        self.values[index, sub] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")

    def get(self, index: int, sub: int) -> int:
        """A value; 0 for what it has not."""
        entry = self.eds.entries.get((index, sub))
        return 0 if entry is None else entry.object.type.decode(self.values.get((index, sub), b""))

    def due(self) -> int | None:
        """When `poll` may have something."""
        times = [frame.stamp_ns for frame in self._out]
        times += [t for t in (self._up_ns, self._beat_ns) if t != _NEVER_NS]
        return min(times) if times else None

    def poll(self, t_ns: int) -> list[Frame]:
        """What it has sent until now."""
        if self._up_ns <= t_ns:
            self._boot(self._up_ns)
        while self._beat_ns <= t_ns:
            self._out.append(Frame(self._beat_ns, objects.HEARTBEAT_ID + self.id, bytes((self.state,))))
            period_ns = self.get(0x1017, 0) * 1_000_000
            self._beat_ns = max(self._beat_ns + period_ns, t_ns - period_ns) if period_ns else _NEVER_NS
        ready = sorted((f for f in self._out if f.stamp_ns <= t_ns), key=lambda f: f.stamp_ns)
        self._out = [f for f in self._out if f.stamp_ns > t_ns]
        return ready

    def on_frame(self, frame: Frame) -> None:
        """Hear a frame."""
        if self.odd.silent:
            return
        if frame.can_id == objects.SYNC_ID:
            self._sync_ns = frame.stamp_ns
        if self.state == Nmt.BOOT:
            return
        t_ns, data = frame.stamp_ns, frame.data
        if frame.can_id == objects.NMT_ID and len(data) >= 2 and data[1] in (0, self.id):
            self._command(t_ns, data[0])
        elif frame.can_id == objects.SDO_REQUEST_ID + self.id and self.state != Nmt.STOPPED:
            if len(data) == 8:
                self._sdo(t_ns, data)
        elif frame.can_id == objects.LSS_REQUEST_ID and len(data) == 8:
            self._lss(t_ns, data)

    def emergency(self, t_ns: int, code: int) -> None:
        """Report an emergency, or with 0 that there is none any more."""
        if self.state in (Nmt.OPERATIONAL, Nmt.PRE_OPERATIONAL):
            data = struct.pack("<HB5x", code, 1 if code else 0)
            self._out.append(Frame(t_ns, objects.EMCY_ID + self.id, data))

    def uses(self, pdo: Pdo, can_id: int) -> bool:
        """Whether it sends, or takes, a PDO by this identifier."""
        word = self.get(pdo.parameters, 1)
        return self.state == Nmt.OPERATIONAL and not word & INVALID and word & 0x7FF == can_id

    def mapping(self, pdo: Pdo) -> list[int]:
        """What a PDO carries, as mappings name it."""
        return [self.get(pdo.mapping, place) for place in range(1, self.get(pdo.mapping, 0) + 1)]

    def _load(self) -> None:
        self.values = {
            key: entry.initial(self.id) for key, entry in self.eds.entries.items() if key != self.odd.lacks
        }
        self.values.update(self.stored)
        for sub, value in self._identity.items():
            if (0x1018, sub) in self.values:
                self.set(0x1018, sub, value)
        if self.odd.bootloader:
            self.values[0x1000, 0] = bytes(4)
            self.set(0x1018, 2, 0xB007)

    def _boot(self, t_ns: int) -> None:
        self._up_ns = _NEVER_NS
        if self.odd.silent:
            return
        self.state = Nmt.PRE_OPERATIONAL
        if self.id != _UNCONFIGURED:
            self._out.append(Frame(t_ns, objects.HEARTBEAT_ID + self.id, b"\0"))
        self._beat(t_ns)

    def _beat(self, t_ns: int) -> None:
        period_ms = self.get(0x1017, 0)
        self._beat_ns = t_ns + period_ms * 1_000_000 if period_ms else _NEVER_NS

    def _command(self, t_ns: int, command: int) -> None:
        if command == Command.START:
            if not self.odd.never_starts and not self.odd.bootloader:
                self.state = Nmt.OPERATIONAL
        elif command == Command.STOP:
            self.state = Nmt.STOPPED
        elif command == Command.PRE_OPERATIONAL:
            self.state = Nmt.PRE_OPERATIONAL
        elif command in (Command.RESET, Command.RESET_COMMUNICATION):
            self.power_up(t_ns)

    def _answer(self, t_ns: int, data: bytes) -> None:
        self._answers += 1
        if self.odd.reboot_after and self._answers == self.odd.reboot_after and self._reboots:
            self._reboots -= 1
            self._answers = 0
            self.power_up(t_ns)
            return
        due_ns = t_ns + _ANSWER_NS + round(self.odd.slow_ms * 1e6)
        deaf_ns = self.odd.deaf_after_sync_us * 1e3
        if 0 <= t_ns - self._sync_ns < deaf_ns or self._random.random() < self.odd.lose_answers:
            return
        self._out.append(Frame(due_ns, objects.SDO_ANSWER_ID + self.id, data.ljust(8, b"\0")))

    def _abort(self, t_ns: int, index: int, sub: int, code: int) -> None:
        self._transfer = None
        self._answer(t_ns, struct.pack("<BHBI", 0x80, index, sub, code))

    def _sdo(self, t_ns: int, data: bytes) -> None:
        command = data[0]
        index, sub = _MUX.unpack_from(data, 1)
        match command >> 5:
            case 1:
                self._download(t_ns, command, index, sub, data[4:])
            case 2:
                self._upload(t_ns, index, sub)
            case 0 if self._transfer is not None and not self._transfer.upload:
                self._download_segment(t_ns, command, data[1:])
            case 3 if self._transfer is not None and self._transfer.upload:
                self._upload_segment(t_ns, command)
            case 4:
                self._transfer = None
            case _:
                self._abort(t_ns, index, sub, _COMMAND)

    def _upload(self, t_ns: int, index: int, sub: int) -> None:
        value = self.values.get((index, sub))
        if value is None:
            known = any(i == index for i, _ in self.values)
            self._abort(t_ns, index, sub, _NO_SUB if known else _EXISTS)
        elif 1 <= len(value) <= 4:
            command = 0x43 | (4 - len(value)) << 2
            self._answer(t_ns, bytes((command,)) + _MUX.pack(index, sub) + value)
        else:
            self._transfer = _Transfer(index, sub, value, True)
            self._answer(t_ns, struct.pack("<BHBI", 0x41, index, sub, len(value)))

    def _upload_segment(self, t_ns: int, command: int) -> None:
        t = self._transfer
        assert t is not None
        if command >> 4 & 1 != t.toggle:
            self._abort(t_ns, t.index, t.sub, _TOGGLE)
            return
        piece, rest = t.data[:7], t.data[7:]
        self._transfer = replace(t, data=rest, toggle=t.toggle ^ 1) if rest else None
        head = t.toggle << 4 | (7 - len(piece)) << 1 | (not rest)
        self._answer(t_ns, bytes((head,)) + piece)

    def _download(self, t_ns: int, command: int, index: int, sub: int, data: bytes) -> None:
        if command & 2:
            size = 4 - (command >> 2 & 3) if command & 1 else 4
            self._write(t_ns, index, sub, data[:size])
        else:
            self._transfer = _Transfer(index, sub, b"", False)
            self._answer(t_ns, struct.pack("<BHB", 0x60, index, sub))

    def _download_segment(self, t_ns: int, command: int, data: bytes) -> None:
        t = self._transfer
        assert t is not None
        if command >> 4 & 1 != t.toggle:
            self._abort(t_ns, t.index, t.sub, _TOGGLE)
            return
        whole = t.data + data[: 7 - (command >> 1 & 7)]
        if command & 1:
            self._transfer = None
            self._write(t_ns, t.index, t.sub, whole, bytes((0x20 | t.toggle << 4,)))
        else:
            self._transfer = replace(t, data=whole, toggle=t.toggle ^ 1)
            self._answer(t_ns, bytes((0x20 | t.toggle << 4,)))

    def _write(self, t_ns: int, index: int, sub: int, data: bytes, answer: bytes = b"") -> None:
        code = self._refusal(index, sub, data)
        if code:
            self._abort(t_ns, index, sub, code)
            return
        if (index, sub) == (objects.SAVE.index, objects.SAVE.sub):
            self.stored = {key: v for key, v in self.values.items() if self.eds.entries[key].access == "rw"}
        elif (index, sub) != self.odd.keeps:
            self.values[index, sub] = data
        if index == 0x1017:
            self._beat(t_ns)
        if self.written is not None:
            self.written(index, sub)
        self._answer(t_ns, answer or struct.pack("<BHB", 0x60, index, sub))

    def _refusal(self, index: int, sub: int, data: bytes) -> int:
        """Why a value is not taken; 0 where it is."""
        entry = self.eds.entries.get((index, sub))
        if entry is None or (index, sub) not in self.values:
            return _NO_SUB if any(i == index for i, _ in self.values) else _EXISTS
        if self.odd.abort is not None and self.odd.abort[:2] == (index, sub):
            return self.odd.abort[2]
        if entry.access in ("ro", "const"):
            return _READ_ONLY
        if entry.object.type.size and len(data) != entry.object.type.size:
            return _LENGTH_OBJECT
        if (index, sub) == (objects.SAVE.index, objects.SAVE.sub) and data != b"save":
            return 0x08000020
        return self._refusal_of_pdo(index, sub, data)

    def _refusal_of_pdo(self, index: int, sub: int, data: bytes) -> int:
        """What may be changed of a PDO depends on whether it is in use."""
        sent = index >= 0x1800
        if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00:
            pdo = Pdo((index & 0x1FF) + 1, sent)
            if not self.get(pdo.parameters, 1) & INVALID or (sub and self.get(index, 0)):
                return _STATE
            if sub:
                return self._refusal_of_mapping(int.from_bytes(data, "little"), sent=sent)
            bits = sum(self.get(index, place) & 0xFF for place in range(1, data[0] + 1))
            return 0x06040042 if bits > 64 else 0
        if (0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00) and sub == 2:
            return _RANGE if 240 < data[0] < 252 else 0
        return 0

    def _refusal_of_mapping(self, word: int, *, sent: bool) -> int:
        entry = self.eds.entries.get((word >> 16, word >> 8 & 0xFF))
        if word and entry is None:
            return _EXISTS
        wrong = entry is not None and (entry.access == "ro") != sent
        return 0x06040041 if wrong else 0

    def _lss(self, t_ns: int, data: bytes) -> None:
        """Layer setting services: who are you, and take this identifier."""
        command, word = data[0], int.from_bytes(data[1:5], "little")
        identity = [self.get(0x1018, sub) for sub in range(1, 5)]
        answer = b""
        if command == 0x04:
            self._lss_configuring = bool(data[1])
            if not self._lss_configuring and self.id != self._lss_id:
                self.id = self._lss_id
                self.power_up(t_ns)
        elif 0x40 <= command <= 0x43:
            self._lss_selected[command - 0x40] = word
            if command == 0x43 and [self._lss_selected.get(i) for i in range(4)] == identity:
                self._lss_configuring, answer = True, b"\x44"
        elif command == 0x51:
            answer = self._fastscan(word, data[5], data[6], data[7], identity)
        elif self._lss_configuring:
            answer = self._lss_inquired(command, data, identity)
        if answer:
            self._out.append(Frame(t_ns + _ANSWER_NS, objects.LSS_ANSWER_ID, answer.ljust(8, b"\0")))

    def _lss_inquired(self, command: int, data: bytes, identity: list[int]) -> bytes:
        if command == 0x11:
            good = 1 <= data[1] <= 127 or data[1] == _UNCONFIGURED
            if good:
                self._lss_id = data[1]
            return bytes((command, 0 if good else 1))
        if command == 0x17:
            return bytes((command, 0))
        if 0x5A <= command <= 0x5D:
            return bytes((command,)) + identity[command - 0x5A].to_bytes(4, "little")
        return bytes((command, self.id)) if command == 0x5E else b""

    def _fastscan(self, number: int, bit: int, sub: int, following: int, identity: list[int]) -> bytes:
        if self.id != _UNCONFIGURED or self._lss_configuring:
            return b""
        if bit == 128:
            self._lss_next = 0
            return b"\x4f"
        if sub != self._lss_next or sub > 3 or bit > 31 or (number ^ identity[sub]) >> bit:
            return b""
        self._lss_next = following
        if bit == 0 and following < sub:
            self._lss_configuring = True
        return b"\x4f"
