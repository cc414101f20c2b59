"""Reads a log as a stream, as far as it can be read, in bounded memory.

A log is one file, or the parts that a recorder has split it into.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, TypeVar

from google.protobuf.message import DecodeError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from pneud.log.files.naming import LogError
from pneud.log.files.part import CRC, check_intact
from pneud.log.format.frames import FrameBlock, tick_count
from pneud.log.format.framing import (
    CutShortError,
    DamageError,
    LoggedMessage,
    Piece,
    attachment,
    first_ns,
    items,
    items_by,
    message_count,
    metadata,
    one_by_one,
    open_mcap,
    pieces,
)
from pneud.log.format.meanings import READABLE, SCHEMA
from pneud.log.format.records import LoggedEvent, LoggedTick, TickMessage, unpack, unpack_event
from pneud.log.format.schema import EVENTS, FRAMES, METADATA, SETUP, STATE, TICK

if TYPE_CHECKING:
    from pneud.log.files.stretches import Stretch, TickRows

SEQUENCES = 1 << 32  # of MCAP's messages, after which they begin anew
_LATEST_NS = (1 << 63) - 1  # Unix; MCAP's times have a bit more
_LOOK_BACK = 2000  # places among which a snapshot is looked for
_OWN_TOPICS = {TICK, FRAMES, STATE, EVENTS}
_BEHIND_THE_HEAD = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END)


class RawBatch(NamedTuple):
    """The messages of some consecutive ticks, as they stand in the log."""

    ticks: list[TickMessage]
    frames: bytes


class RowBatch(NamedTuple):
    """The same, alike ones together."""

    ticks: list[TickRows]
    frames: bytes


class LoggedState(NamedTuple):
    """The state of the axis as read: it follows the record of its number and precedes the next one."""

    number: int
    log_time_ns: int  # Unix
    data: bytes  # JSON


Raw = RawBatch | LoggedState | LoggedEvent
Rows = RowBatch | LoggedState | LoggedEvent
Item = LoggedTick | LoggedState
Split: TypeAlias = "Callable[[bytes], Iterator[Schema | Channel | LoggedMessage | Stretch]]"


class _Definitions:
    """Channels by their number: topic and name of the schema, which may have none."""

    def __init__(self) -> None:
        self.channels: dict[int, tuple[str, str]] = {}
        self._schemas: dict[int, str] = {0: ""}

    def learn(self, item: Schema | Channel) -> None:
        if isinstance(item, Schema):
            self._schemas[item.id] = item.name
        elif item.schema_id in self._schemas:
            self.channels[item.id] = (item.topic, self._schemas[item.schema_id])

    def learn_all(self, found: list[Schema | Channel | LoggedMessage]) -> None:
        for item in found:
            if not isinstance(item, LoggedMessage):
                self.learn(item)

    @property
    def topics(self) -> set[str]:
        return {topic for topic, _ in self.channels.values()}


class _File:
    """One file of a log.

    Attributes as in `LogReader`, and `damage` after an iteration.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, str] = {}
        self.setup: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.damage = ""
        self.size = 0  # bytes
        self._read_head()
        self.run = self.metadata.get("run", "")
        self.part = int(self.metadata.get("part", "1"))
        self.records_before = int(self.metadata.get("records_before", "0"))

    def _read_head(self) -> None:
        with open_mcap(self.path) as file:
            self.size = os.fstat(file.fileno()).st_size
            try:
                for piece in pieces(file, skip_chunks=True):
                    # Another tool may have put parts of the head behind messages: look on until all is there.
                    if piece.opcode in _BEHIND_THE_HEAD and self._has_head():
                        break
                    self._head_piece(piece)
            except CutShortError as e:
                if not self.metadata:
                    raise LogError(f"{self.path}: {e}, before anything was logged") from None
            except DamageError as e:
                if not self.metadata:
                    raise LogError(f"{self.path}: {e}; try pneud recover") from None
        self._check_head()

    def _has_head(self) -> bool:
        m = self.metadata
        return bool(m) and m.get("config") in self.attachments and m.get("dbc") in self.attachments

    def _head_piece(self, piece: Piece) -> None:
        if piece.opcode == Opcode.ATTACHMENT:
            attached = attachment(piece)
            self.attachments[attached.name] = attached.data
        elif piece.opcode == Opcode.METADATA:
            found = metadata(piece)
            if found.name not in (METADATA, SETUP):
                return
            check_intact(found, piece.offset)
            if found.name == METADATA:
                self.metadata = found.metadata
            else:
                self.setup = {key: value for key, value in found.metadata.items() if key != CRC}

    def _check_head(self) -> None:
        m = self.metadata
        if not m:
            raise LogError(f"{self.path}: is an MCAP file, but no log of pneud")
        if m.get("schema") not in READABLE:
            raise LogError(
                f"{self.path}: has log schema {m.get('schema')}, this pneud reads {SCHEMA};"
                f" use the version that wrote it ({m.get('pneud', 'unknown')})"
            )
        try:
            self.attachments[m["config"]].decode(), self.attachments[m["dbc"]]
            float(m["rate_hz"]), m["faults"], int(m.get("part", "1")), int(m.get("records_before", "0"))
        except (KeyError, ValueError) as e:
            raise LogError(f"{self.path}: its head is incomplete: {e}; try pneud recover") from None

    def start_ns(self) -> int:
        """Time of the first message; 0 where there is none."""
        with open_mcap(self.path) as file:
            try:
                for piece in pieces(file, skip_chunks=True):
                    if (found_ns := first_ns(piece)) is not None:
                        return found_ns
            except DamageError:
                pass
        return 0

    def messages(
        self, from_ns: int, read: Callable[[int], None], split: Split = one_by_one
    ) -> Iterator[tuple[str, str, LoggedMessage | Stretch]]:
        """Topic, schema and message; ends at the first place that cannot be read.

        Args:
            from_ns: begin with the last snapshot not after this time, or at the start where there is none.
            read: told how many bytes have been read, now and then.
            split: takes apart what a chunk holds; ticks may come together, others come one by one.
        """
        self.damage = ""
        known = _Definitions()
        count = strangers = 0
        with open_mcap(self.path) as file:
            try:
                start = self._snapshot_before(from_ns) if from_ns else 0
                if start:
                    known = self._definitions()
                    file.seek(start)
                ended = False
                for piece in pieces(file):
                    read(piece.offset)
                    if piece.opcode == Opcode.STATISTICS and not start:
                        self._check_count(piece, count)
                    ended = ended or piece.opcode == Opcode.DATA_END
                    for item in () if ended else items_by(split, piece):
                        if isinstance(item, Schema | Channel):
                            known.learn(item)
                            continue
                        some = len(item.rows) if not isinstance(item, LoggedMessage) else 1
                        count += some
                        if (channel := known.channels.get(item.channel)) is None:
                            strangers += some
                        elif channel[0] == TICK or isinstance(item, LoggedMessage):
                            yield *channel, item
                        else:
                            yield from ((*channel, one) for one in item.singly())
                if strangers:
                    self.damage = f"{strangers} messages are of channels that are nowhere defined"
            except DamageError as e:
                self.damage = str(e)

    @staticmethod
    def _check_count(piece: Piece, count: int) -> None:
        """Compare with what the index says, since a record may have been damaged into one to be skipped."""
        there = message_count(piece)
        if count < there:
            raise DamageError(
                f"damaged at byte {piece.offset}: {there - count} of {there} messages are not there"
            )

    def _definitions(self) -> _Definitions:
        """What comes before the first messages and with them, and what the index repeats."""
        known = _Definitions()
        with open_mcap(self.path) as file, suppress(DamageError):
            for piece in pieces(file):
                found = items(piece)
                known.learn_all(found)
                if any(isinstance(item, LoggedMessage) for item in found):
                    break
            if not known.topics >= _OWN_TOPICS:
                for piece in pieces(file, skip_chunks=True):
                    if piece.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                        known.learn_all(items(piece))
        return known

    def _snapshot_before(self, time_ns: int) -> int:
        """Where the chunk with the last snapshot not after a time begins; 0 where there is none.

        A snapshot is the first message of its chunk, or stands by itself.
        """
        places: deque[int] = deque(maxlen=_LOOK_BACK)
        known = self._definitions()
        with open_mcap(self.path) as file:
            try:
                for piece in pieces(file, skip_chunks=True):
                    found_ns = first_ns(piece)
                    if found_ns is None:
                        continue
                    if found_ns > time_ns:
                        break
                    if piece.opcode == Opcode.CHUNK or _first_topic(piece, known) == STATE:
                        places.append(piece.offset)
            except DamageError:
                pass  # said by whoever reads that far
            for offset in reversed(places):
                file.seek(offset)
                with suppress(DamageError):
                    if _first_topic(next(pieces(file)), known) == STATE:
                        return offset
        return 0


def _first_topic(piece: Piece, known: _Definitions) -> str:
    first = next((item for item in items(piece) if isinstance(item, LoggedMessage)), None)
    return "" if first is None else known.channels.get(first.channel, ("", ""))[0]


B_co = TypeVar("B_co", covariant=True)


class _Gathering(Protocol[B_co]):
    """Ticks that wait for their frames."""

    @staticmethod
    def split(data: bytes, /) -> Iterator[Schema | Channel | LoggedMessage | Stretch]:
        """Take apart what a chunk holds."""

    @staticmethod
    def latest_ns(message: LoggedMessage | Stretch, /) -> int:
        """Latest of the times of one message, or of several."""

    def __len__(self) -> int: ...

    def put(self, message: LoggedMessage | Stretch, schema: str, last: int, /) -> None:
        """Some more, behind the tick with this number."""

    def take(self, first: int, count: int, frames: bytes, /) -> B_co | None:
        """So many ticks from a number on, with their frames; None where one is not there."""


class _OneByOne:
    """One message after the other."""

    @staticmethod
    def split(data: bytes) -> Iterator[Schema | Channel | LoggedMessage]:
        """As it is said there."""
        return one_by_one(data)

    def __init__(self) -> None:
        self._ticks: dict[int, TickMessage] = {}

    def __len__(self) -> int:
        return len(self._ticks)

    @staticmethod
    def latest_ns(message: LoggedMessage | Stretch) -> int:
        """Its time."""
        return int(message.log_time_ns)

    def put(self, message: LoggedMessage | Stretch, schema: str, last: int) -> None:
        """One more."""
        assert isinstance(message, LoggedMessage)
        number = numbered(message.sequence, last)
        self._ticks[number] = TickMessage(number, message.log_time_ns, schema, message.data)

    def take(self, first: int, count: int, frames: bytes) -> RawBatch | None:
        """So many with consecutive numbers."""
        pop = self._ticks.pop
        ticks = [tick for i in range(count) if (tick := pop(first + i, None)) is not None]
        return RawBatch(ticks, frames) if len(ticks) == count > 0 else None


def numbered(sequence: Any, last: int) -> Any:
    """The number whose sequence this is and that lies nearest to the last one; of one, or of an array."""
    return last + (sequence - last + SEQUENCES // 2) % SEQUENCES - SEQUENCES // 2


class LogReader:
    """One log; every iteration begins anew at its start.

    Attributes:
        path: the file, or the first one of several.
        paths: all of them.
        parts: of which run each is, and which part of it.
        metadata: what the log says about its run: schema, bus, rate_hz, versions, fingerprint, …
        setup: the report of the real-time set-up; empty if there was none.
        config_name: name of the attached configuration.
        config_text: its text.
        dbc_name: name of the attached DBC.
        dbc: its bytes.
        records_before: records of the loop before the first one in these files, in parts that are gone.
        truncated: after an iteration: a file ends too early or goes on damaged.
        damage: after an iteration: where and why; empty if the files are whole.
        missing: after an iteration: records of the loop that are not in the files, before their last one.
        watch: told of an iteration, now and then, how many bytes of how many have been read.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read the heads.

        Raises:
            LogError: one is no log of pneud or of another schema, or they are not of one run.
        """
        self._files = sorted(map(_File, paths), key=lambda f: f.part)
        first = self._files[0]
        for before, after in zip(self._files, self._files[1:], strict=False):
            if before.run != after.run:
                raise LogError(
                    f"{before.path} and {after.path}: are of two runs; give the files of one, such as"
                    f" {before.path.with_name(before.path.name.split('.')[0])}*.mcap"
                )
            if before.part == after.part:
                raise LogError(f"{before.path} and {after.path}: are the same part of one run")
        self.paths = [file.path for file in self._files]
        self.parts = [(file.run or str(file.path.resolve()), file.part) for file in self._files]
        self.path = first.path
        self.metadata = first.metadata
        self.setup = first.setup
        self.config_name, self.dbc_name = self.metadata["config"], self.metadata["dbc"]
        self.config_text = first.attachments[self.config_name].decode()
        self.dbc = first.attachments[self.dbc_name]
        self.records_before = first.records_before
        self.truncated = False
        self.damage = ""
        self.missing = 0
        self.watch: Callable[[int, int], None] = lambda _read, _all: None

    @property
    def rate_hz(self) -> float:
        """Ticks per second."""
        return float(self.metadata["rate_hz"])

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Names of the faults by bit number."""
        return tuple(name for name in self.metadata["faults"].split(",") if name)

    def start_ns(self) -> int:
        """Unix time of the first message; 0 where there is none."""
        return self._files[0].start_ns()

    def __iter__(self) -> Iterator[LoggedTick]:
        """The ticks in their order. `truncated`, `damage` and `missing` are valid when it ends."""
        return (item for item in self.items() if isinstance(item, LoggedTick))

    def items(self, from_ns: int = 0) -> Iterator[Item]:
        """Ticks and snapshots of the axis in their order; otherwise as an iteration over the ticks.

        Args:
            from_ns: Unix time; begin with the last snapshot not after it, at the start where there is none.
        """
        first = next(iter(self), None) if from_ns else None
        first_ns, names = None if first is None else first.t_ns, self.fault_names
        for raw in self.raw(from_ns):
            if isinstance(raw, LoggedState):
                yield raw
            elif isinstance(raw, RawBatch):
                number = raw.ticks[0].number
                try:
                    for tick in unpack(raw.ticks, FrameBlock(raw.frames), first_ns, names):
                        number = tick.number
                        first_ns = tick.t_ns if first_ns is None else first_ns
                        yield tick
                except (DecodeError, KeyError, ValueError) as e:
                    self.damaged_at(number, e)
                    return

    def raw(self, from_ns: int = 0) -> Iterator[Raw]:
        """Ticks as bytes, snapshots and events in the order of the files; otherwise as `items`."""
        return self._by(_OneByOne, from_ns)

    def rows(self) -> Iterator[Rows]:
        """As `raw`, from the start, with ticks that are alike together: a tenth of the time."""
        from pneud.log.files.stretches import Together  # noqa: PLC0415 - for who looks at many ticks

        return self._by(Together, 0)

    def _by(
        self, gather: Callable[[], _Gathering[B_co]], from_ns: int
    ) -> Iterator[B_co | LoggedState | LoggedEvent]:
        self.truncated, self.damage, self.missing = False, "", 0
        files = self._files
        if from_ns:
            later = (i for i, file in enumerate(files) if i and file.start_ns() > from_ns)
            files = files[next(later, len(files)) - 1 :]
        last = files[0].records_before
        for file in files:
            last = yield from self._of(file, gather(), last, from_ns if file is files[0] else 0)

    def _of(
        self, file: _File, waiting: _Gathering[B_co], last: int, from_ns: int
    ) -> Generator[B_co | LoggedState | LoggedEvent, None, int]:
        began = not from_ns  # from the middle, what came before is not missing
        before, whole = (
            sum(f.size for f in self._files if f.part < file.part),
            sum(f.size for f in self._files),
        )
        told: Callable[[int], None] = lambda read: self.watch(before + read, whole)  # noqa: E731
        for topic, schema, message in file.messages(from_ns, told, waiting.split):
            if waiting.latest_ns(message) > _LATEST_NS:
                self._damaged(f"damaged in a message of {topic}: its time lies behind the year 2262")
                return last
            if topic == TICK or not isinstance(message, LoggedMessage):
                waiting.put(message, schema, last)
                continue
            number = numbered(message.sequence, last)
            if topic == FRAMES:
                # more may wait than these are of, where another program has sorted the log
                try:
                    count = tick_count(message.data)
                    batch = waiting.take(number, count, message.data)
                except DecodeError:
                    batch = None
                if batch is None:
                    self.damaged_at(number, ValueError("frames without their ticks"))
                    return last
                if began:
                    self.missing += max(0, number - last - 1)
                began, last = True, number + count - 1
                yield batch
            elif topic == STATE:
                if began and number < last:  # sorted behind its time by another program: it says nothing here
                    continue
                if not began:
                    began, last = True, number
                yield LoggedState(number, message.log_time_ns, message.data)
            elif topic == EVENTS:
                try:
                    yield unpack_event(message.log_time_ns, message.data)
                except (DecodeError, ValueError) as e:
                    self._damaged(f"damaged in an event: {e}")
                    return last
        if len(waiting) and not file.damage:
            file.damage = f"damaged at its end: {len(waiting)} ticks without their frames"
        if file.damage:
            self._damaged(file.damage if len(self._files) == 1 else f"{file.path.name}: {file.damage}")
        return last

    def damaged_at(self, number: int, why: Exception) -> None:
        """Note that a record cannot be decoded."""
        self._damaged(f"damaged in record {number}: {why}")

    def events(self) -> Iterator[LoggedEvent]:
        """What happened, in words."""
        for raw in self.raw():
            if isinstance(raw, LoggedEvent):
                yield raw

    def _damaged(self, words: str) -> None:
        self.truncated = True
        self.damage = self.damage or words


def read_log(path: str | Path, *more: str | Path) -> LogReader:
    """Open a log: a file, a folder with the parts of one, or the parts themselves in any order.

    Raises:
        LogError: no such file, not a log of pneud, of another schema, or of several runs.
    """
    return LogReader(paths_of(path, *more))


def paths_of(path: str | Path, *more: str | Path) -> list[Path]:
    """The files of a log, as given to `read_log`.

    Raises:
        LogError: a folder holds none.
    """
    paths: list[Path] = []
    for given in map(Path, (path, *more)):
        paths += _parts_in(given) if given.is_dir() else [given]
    return paths


def _parts_in(folder: Path) -> list[Path]:
    found = sorted(folder.glob("*.mcap"))
    if not found:
        raise LogError(f"{folder}: holds no log; give a folder with .mcap files, or a file")
    return found
