"""A recording of a bus as a log that replay and report understand."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from pneud.config.reading import load_with_text, parse
from pneud.config.sections import ConfigError
from pneud.loading import at_rate, codecs_of
from pneud.log.files.naming import LogError, log_path, new_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader
from pneud.replay import sidecar, traffic
from pneud.replay.importing import Ticks, rebuild
from pneud.replay.remarks import Remarks
from pneud.replay.sidecar import Sidecar
from pneud.replay.surveying import survey
from pneud.replay.times import Times
from pneud.replay.traffic import FORMATS
from pneud.rt.inputs import read_whole
from pneud.safety.faults import FAULT_NAMES
from pneud.verbs import ProgressOption
from pneud.view.progress import each, progress

_LEAD_NS = 1_000_000_000  # the log's own times begin one second before the first frame
_NEVER_NS = 1 << 62  # the year 2116


class RecordingSource(NamedTuple):
    """What is known of the axis, apart from the frames."""

    config_name: str
    config_text: str
    dbc_name: str
    dbc: bytes
    rate_hz: float
    known: Sidecar | None


class Placed(NamedTuple):
    """Where a recording lies in time."""

    offset_ns: int  # its stamps minus the log's own times
    realtime_offset_ns: int  # Unix time minus the log's own times


def import_(
    recording: Annotated[
        Path, typer.Argument(metavar="FILE", help="Recording: .log (candump -l), .asc or .blf.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="LOG", help="The log; default FILE's name with .mcap."),
    ] = None,
    dbc: Annotated[
        Path | None, typer.Option("--dbc", metavar="FILE", help="Its messages; an exported log has them.")
    ] = None,
    config_file: Annotated[
        str | None,
        typer.Option("--config", metavar="FILE", help="Of the axis; default the exported, else rig.toml."),
    ] = None,
    how: ProgressOption = "auto",
) -> int:
    """Write the log.

    Returns:
        Exit status: 0, or 1 where something of the recording could not be read.
    """
    if recording.suffix.lower() not in FORMATS:
        raise ConfigError(f"{recording}: no such format; its name must end in one of {', '.join(FORMATS)}")
    output = output or Path(f"{recording.stem}.mcap")
    if output.suffix != ".mcap":
        raise ConfigError(f"{output}: a log's name ends in .mcap")
    source = _source(recording, dbc, config_file)
    config = at_rate(parse(source.config_text, source.config_name), source.rate_hz)
    codecs = codecs_of(config.bus, source.dbc_name, source.dbc, config.gas)
    path = log_path(str(output), config.name)
    surveyed = survey(recording, codecs, source.rate_hz, sync=bool(config.bus.sync))
    remarks = Remarks()
    placed = _placed(surveyed.start_ns, source.known, remarks)
    header = LogHeader(
        name=config.name,
        bus=f"recording {recording.name}",
        rate_hz=source.rate_hz,
        detail=config.log.detail,
        config_name=source.config_name,
        config_text=source.config_text,
        dbc_name=source.dbc_name,
        dbc=source.dbc,
        fault_names=FAULT_NAMES,
        realtime_offset_ns=placed.realtime_offset_ns,
        extra={"recording": recording.name},
    )
    times = Times(surveyed.start_ns, placed.offset_ns, 1e9 / source.rate_hz, remarks)
    with new_log(path) as descriptor, progress(how) as report:
        frames = each(traffic.read(recording, remarks, fd=config.bus.fd), report, recording.name, 0, "frames")
        ticks = Ticks(frames, codecs, surveyed, times, remarks)
        writer = LogWriter(descriptor, header)
        found = rebuild(ticks, writer, config, codecs, source.known)
        whole = writer.close()
        if not whole:
            raise OSError(writer.error, os.strerror(writer.error), str(path))
        if writer.unwritten:
            remarks.add("ticks that no log can hold, left out", path.name, count=writer.unwritten)
        if not writer.written:
            raise LogError(f"{recording}: made no tick; {'; '.join(remarks.lines())}")
    print(f"{path}: {writer.written} ticks from channel {surveyed.channel}")
    if source.known is None:
        print(
            "requests were inferred from Enable: nothing tells what else was asked of the axis",
            file=sys.stderr,
        )
    if found.without_command:
        print(f"{found.without_command} ticks have no valid command", file=sys.stderr)
    if found.differing:
        print(f"{found.differing} commands are not what this configuration computes", file=sys.stderr)
    if ticks.elsewhere:
        print(f"{ticks.elsewhere} frames on other channels were left out", file=sys.stderr)
    for line in remarks.lines():
        print(line, file=sys.stderr)
    return 1 if remarks.partial else 0


def _placed(start_ns: int, known: Sidecar | None, remarks: Remarks) -> Placed:
    """Where a recording that begins then lies in time."""
    began_ns = _LEAD_NS if known is None else start_ns - known.offset_ns
    if not 0 <= began_ns < _NEVER_NS:
        remarks.add("its times are not those of the log that was exported", "at its start", partial=False)
        began_ns = _LEAD_NS
    unix_ns = start_ns
    if not 0 <= start_ns < _NEVER_NS:
        remarks.add("its times are no Unix times; the log's begin in 1970", "at its start", partial=False)
        unix_ns = 0
    return Placed(start_ns - began_ns, unix_ns - began_ns)


def _source(recording: Path, dbc: Path | None, config_file: str | None) -> RecordingSource:
    known = sidecar.read(sidecar.beside(recording))
    try:
        dbc_bytes = None if dbc is None else read_whole(dbc)
    except OSError as e:
        raise ConfigError(f"{dbc}: cannot be read: {e.strerror}; see --dbc") from None
    if known is not None:
        name, text, rate_hz = known.metadata["config"], known.config_text, float(known.metadata["rate_hz"])
        if config_file is not None:
            config, text, path = load_with_text(config_file)
            name, rate_hz = path.name, config.loop.rate_hz
        if dbc is None or dbc_bytes is None:
            return RecordingSource(name, text, known.metadata["dbc"], known.dbc, rate_hz, known)
        return RecordingSource(name, text, dbc.name, dbc_bytes, rate_hz, known)
    if dbc is None or dbc_bytes is None:
        raise ConfigError(f"{recording}: name its database with --dbc")
    config, text, path = load_with_text(config_file or "rig.toml")
    return RecordingSource(path.name, text, dbc.name, dbc_bytes, config.loop.rate_hz, None)
