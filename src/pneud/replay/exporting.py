"""A log's frames as a recording of its bus, and its ticks as a table."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import DecodeError
from mcap.writer import Writer

from pneud.bus.codec import Codecs
from pneud.log.files.columns import blocks
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader, RawBatch
from pneud.log.files.table import TickTable, about
from pneud.log.format.derived import Deriver
from pneud.log.format.frames import FrameBlock
from pneud.log.format.records import LoggedEvent, pack_event, unpack
from pneud.log.format.schema import EVENTS, FRAMES, STATE, TICK, topics
from pneud.replay import sidecar, traffic
from pneud.rt.extras import require
from pneud.rt.outputs import replacing, replacing_all
from pneud.signals import Frame

TABLES = (".csv", ".parquet")
VIEWERS = ".mcap"


class Exported(NamedTuple):
    """What was written."""

    rows: int  # frames or ticks
    files: tuple[Path, ...]
    unsent_ticks: int  # whose SYNC, or command without, could not be sent: no recording can show them


def frames(log: LogReader, codecs: Codecs, path: Path, *, sync: bool | str = True) -> Exported:
    """Write the frames, and beside them what no bus carries: both, or neither.

    Frames stand in the order in which the axis took them, a SYNC at the instant at which its tick began, so
    that `pneud import` finds the same ticks. Where a frame came in while a command was on its way out, its
    stamp lies a little before that of the line above it.

    Args:
        log: the log.
        codecs: of its axis.
        path: of the recording.
        sync: `bus.sync`: ticks begin with a SYNC, perhaps another controller's; else they end with a command.

    Raises:
        OSError: a file cannot be written.
    """
    collector = sidecar.Collector(log)
    offset_ns = int(log.metadata["realtime_offset_ns"])
    sync_id = codecs.sync.can_id
    beat_id = sync_id if sync else codecs.valve_command.can_id
    unsent = 0

    def passing() -> Iterator[tuple[Frame, bool]]:
        nonlocal unsent
        tick = 0
        for logged in log:
            sent = [f for f in logged.sent if f.stamp_ns >= 0]
            for frame in logged.frames[: logged.before]:
                yield _unix(frame, offset_ns), False
            came = logged.frames[: logged.before] if sync == "follow" else ()
            beat = next((f for f in (*sent, *came) if f.can_id == beat_id), None)
            if beat is None:
                unsent += 1
            else:
                lasted_ns = None if sync else beat.stamp_ns - logged.t_ns
                collector.add(tick, logged.request, logged.skipped, logged.host, lasted_ns)
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
        count = traffic.write(recording, passing(), codecs.fd)
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


def _write_csv(log: LogReader, path: Path) -> int:
    rows, table = 0, TickTable(log)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for block in blocks(log):
            columns = table.columns(block)
            if not rows:
                writer.writerow(columns)
            writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
            rows += len(block.number)
    return rows


def _write_parquet(log: LogReader, path: Path) -> int:
    require("Parquet", "parquet")
    import pyarrow as pa  # noqa: PLC0415  (an extra)
    import pyarrow.parquet as pq  # noqa: PLC0415

    rows, table = 0, TickTable(log)
    writer = None
    try:
        for block in blocks(log):
            part = pa.table(table.columns(block))
            schema = pa.schema([field.with_metadata(about(field.name)) for field in part.schema])
            part = part.cast(schema)
            if writer is None:
                writer = pq.ParquetWriter(path, schema, compression="zstd")
            writer.write_table(part)
            rows += part.num_rows
    finally:
        if writer is not None:
            writer.close()
    return rows
