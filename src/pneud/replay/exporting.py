"""A log's frames as a recording of its bus, and its ticks as a table."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf.message import DecodeError
from mcap.writer import Writer

from pneud.bus.codec import Codecs
from pneud.log.files.columns import Block, blocks
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader, RawBatch
from pneud.log.format.derived import Deriver
from pneud.log.format.frames import FrameBlock
from pneud.log.format.meanings import meaning_of, unit_of
from pneud.log.format.records import LoggedEvent, names_of, pack_event, unpack
from pneud.log.format.schema import EVENTS, FRAMES, STATE, TICK, topics
from pneud.replay import sidecar, traffic
from pneud.rt.outputs import replacing, replacing_all
from pneud.signals import Frame, Reference, error_m, state_name, true_error_m

TABLES = (".csv", ".parquet")
VIEWERS = ".mcap"


class Exported(NamedTuple):
    """What was written."""

    rows: int  # frames or ticks
    files: tuple[Path, ...]
    unsent_ticks: int  # ticks whose SYNC could not be sent, and which no recording can therefore show


def frames(log: LogReader, codecs: Codecs, path: Path) -> Exported:
    """Write the frames, and beside them what no bus carries: both, or neither.

    Frames stand in the order in which the axis took them, a SYNC at the instant at which its tick began, so
    that `pneud import` finds the same ticks. Where a frame came in while a command was on its way out, its
    stamp lies a little before that of the line above it.

    Raises:
        OSError: a file cannot be written.
    """
    collector = sidecar.Collector(log)
    offset_ns = int(log.metadata["realtime_offset_ns"])
    sync_id = codecs.sync.can_id
    unsent = 0

    def passing() -> Iterator[tuple[Frame, bool]]:
        nonlocal unsent
        tick = 0
        for logged in log:
            sent = [f for f in logged.sent if f.stamp_ns >= 0]
            for frame in logged.frames[: logged.before]:
                yield _unix(frame, offset_ns), False
            if not any(f.can_id == sync_id for f in sent):
                unsent += 1
            else:
                collector.add(tick, logged.request, logged.skipped, logged.host)
                tick += 1
            for frame in sent:
                if frame.can_id == sync_id:
                    yield Frame(logged.t_ns + offset_ns, sync_id, frame.data), True
            for frame in logged.frames[logged.before :]:
                yield _unix(frame, offset_ns), False
            for frame in sent:
                if frame.can_id != sync_id:
                    yield _unix(frame, offset_ns), True

    files = path, sidecar.beside(path)
    with replacing_all(*files) as (recording, known):
        count = traffic.write(recording, passing())
        sidecar.write(known, collector.sidecar())
    return Exported(count, files, unsent)


def _unix(frame: Frame, offset_ns: int) -> Frame:
    return frame._replace(stamp_ns=frame.stamp_ns + offset_ns)


def table(log: LogReader, path: Path) -> Exported:
    """Write a row for each tick, all its numbers in SI units as their names say.

    Raises:
        LogError: pyarrow is missing.
        OSError: the file cannot be written.
    """
    with replacing(path) as beside:
        rows = _write_csv(log, beside) if path.suffix == ".csv" else _write_parquet(log, beside)
    return Exported(rows, (path,), 0)


def for_viewers(log: LogReader, path: Path) -> Exported:
    """Write the messages of ticks, frames and events, with what follows from the ticks' fields behind these.

    Raises:
        LogError: the file is one of the log's own.
        OSError: the file cannot be written.
    """
    if any(path.exists() and path.samefile(own) for own in log.paths):
        raise LogError(f"{path}: is the log itself; name another file")
    deriver, rows = Deriver(log.fault_names), 0
    with replacing(path) as beside, beside.open("wb") as file:
        writer = Writer(file)
        writer.start(library=f"pneud {log.metadata.get('pneud', '')}".strip())
        channels = {}
        for t in topics("full" if log.metadata.get("detail") == "full" else "compact", derived=True):
            if t.topic != STATE:
                schema = writer.register_schema(t.schema, t.schema_encoding, t.descriptors)
                channels[t.topic] = writer.register_channel(t.topic, t.encoding, schema)
        for raw in log.raw():
            if isinstance(raw, LoggedEvent):
                writer.add_message(channels[EVENTS], raw.log_time_ns, pack_event(raw), raw.log_time_ns)
            elif isinstance(raw, RawBatch):
                try:
                    ticks = list(unpack(raw.ticks, FrameBlock(raw.frames)))
                except (DecodeError, KeyError, ValueError) as e:
                    log.damaged_at(raw.ticks[0].number, e)
                    break
                for message, tick in zip(raw.ticks, ticks, strict=True):
                    data = message.data + deriver.behind(tick.record)
                    writer.add_message(channels[TICK], message.log_time_ns, data, message.log_time_ns)
                first_ns = raw.ticks[0].log_time_ns
                writer.add_message(channels[FRAMES], first_ns, raw.frames, first_ns)
                rows += len(ticks)
        writer.finish()  # type: ignore[no-untyped-call]
    return Exported(rows, (path,), 0)


class _Table:
    """Ticks as columns, and what each column means."""

    def __init__(self, log: LogReader) -> None:
        self._names = log.fault_names
        self._first_ns: int | None = None

    def columns(self, block: Block) -> dict[str, list[Any]]:
        ticks = block.ticks
        if self._first_ns is None:
            self._first_ns = int(ticks["t_ns"][0])
        kinds = dict(block.requests)
        reference = Reference._make(block.real(f"reference.{name}") for name in Reference._fields)
        offset_ns = ticks["measurement.encoder_offset_ns"]
        faults = (ticks["present"] | ticks["latched"]).tolist()
        words = {bits: " ".join(names_of(bits, self._names)) for bits in set(faults)}
        return {
            "number": block.number.tolist(),
            "log_time_ns": block.log_time_ns.tolist(),
            **{name: ticks[name].tolist() for name in ticks.dtype.names or ()},
            "request.kind": [kinds[i].kind if i in kinds else 0 for i in range(len(block.number))],
            "t_s": ((ticks["t_ns"] - self._first_ns) * 1e-9).tolist(),
            "error_m": error_m(reference, block.real("estimate.position_m")).tolist(),
            "true_error_m": true_error_m(reference, offset_ns, block.real("truth_m")).tolist(),
            "state_name": [state_name(state) for state in ticks["state"].tolist()],
            "fault_names": [words[bits] for bits in faults],
        }


_OWN_MEANINGS = {
    "number": "counts the records of the loop from 1; a gap is where records were dropped",
    "log_time_ns": "instant of the tick as Unix time",
    "request.kind": "what was asked for; 0 where nothing was",
}


def _write_csv(log: LogReader, path: Path) -> int:
    rows, table = 0, _Table(log)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for block in blocks(log):
            columns = table.columns(block)
            if not rows:
                writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
            rows += len(block.number)
    return rows


def _write_parquet(log: LogReader, path: Path) -> int:
    try:
        import pyarrow as pa  # noqa: PLC0415  (an extra)
        import pyarrow.parquet as pq  # noqa: PLC0415
    except ImportError:
        raise LogError("Parquet needs pyarrow; install it with: pip install 'pneud[parquet]'") from None
    rows, table = 0, _Table(log)
    writer = None
    try:
        for block in blocks(log):
            part = pa.table(table.columns(block))
            schema = pa.schema([field.with_metadata(_metadata(field.name)) for field in part.schema])
            part = part.cast(schema)
            if writer is None:
                writer = pq.ParquetWriter(path, schema, compression="zstd")
            writer.write_table(part)
            rows += part.num_rows
    finally:
        if writer is not None:
            writer.close()
    return rows


def _metadata(name: str) -> dict[str, str]:
    """Unit and meaning of a column."""
    return {"unit": unit_of(name), "description": _OWN_MEANINGS.get(name) or meaning_of(name)}
