"""A recording of a bus as a log that replay and report understand."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from pneud.config.models import ConfigError, load_with_text, parse
from pneud.loading import at_rate, codecs_of
from pneud.log.files.naming import create_log, log_path
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader
from pneud.replay import sidecar
from pneud.replay.importing import rebuild, start_ns
from pneud.replay.sidecar import Sidecar
from pneud.replay.traffic import FORMATS
from pneud.safety.faults import FAULT_NAMES

_LEAD_NS = 1_000_000_000  # the log's own times begin one second before the first frame


class Source(NamedTuple):
    """What is known of the axis, apart from the frames."""

    config_name: str
    config_text: str
    dbc_name: str
    dbc: bytes
    rate_hz: float
    offset_ns: int
    known: Sidecar | None


def import_(
    recording: Annotated[
        Path, typer.Argument(metavar="FILE", help="Recording: .log (candump -l), .asc or .blf.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOG", help="The log (.mcap).")],
    dbc: Annotated[
        Path | None, typer.Option("--dbc", metavar="FILE", help="Its messages; an exported log has them.")
    ] = None,
    config_file: Annotated[
        str | None,
        typer.Option("--config", metavar="FILE", help="Of the axis; default the exported, else rig.toml."),
    ] = None,
) -> int:
    """Write the log.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: an option or the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LogError: the recording cannot be read, or the log cannot be written.
    """
    if recording.suffix not in FORMATS:
        raise ConfigError(f"{recording}: no such format; its name must end in one of {', '.join(FORMATS)}")
    if output.suffix != ".mcap":
        raise ConfigError(f"{output}: a log's name ends in .mcap")
    source = _source(recording, dbc, config_file)
    config = parse(source.config_text, source.config_name)
    if config.loop.rate_hz != source.rate_hz:
        config = at_rate(config, source.rate_hz)
    codecs = codecs_of(config.bus, source.dbc_name, source.dbc)
    path = log_path(str(output), config.name)
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
        realtime_offset_ns=source.offset_ns,
        extra={"recording": recording.name},
    )
    writer = LogWriter(create_log(path), header)
    done = False
    try:
        found = rebuild(recording, writer, config, codecs, source.offset_ns, source.known)
        done = writer.close()
    finally:
        if not done:
            path.unlink(missing_ok=True)
    if not done:
        raise ConfigError(f"{path}: could not be written whole")
    print(f"{path}: {found.ticks} ticks from channel {found.channel}")
    if source.known is None:
        print(
            "requests were inferred from Enable: nothing tells what else was asked of the axis",
            file=sys.stderr,
        )
    if found.without_command:
        print(f"{found.without_command} ticks have no valid command", file=sys.stderr)
    if found.differing:
        print(f"{found.differing} commands are not what this configuration computes", file=sys.stderr)
    if found.elsewhere:
        print(f"{found.elsewhere} frames on other channels were left out", file=sys.stderr)
    return 0


def _source(recording: Path, dbc: Path | None, config_file: str | None) -> Source:
    known = sidecar.read(sidecar.beside(recording))
    try:
        dbc_bytes = None if dbc is None else dbc.read_bytes()
    except OSError as e:
        raise ConfigError(f"{dbc}: cannot be read: {e.strerror}; see --dbc") from None
    if known is not None:
        name, text, rate_hz = known.metadata["config"], known.config_text, float(known.metadata["rate_hz"])
        if config_file is not None:
            config, text, path = load_with_text(config_file)
            name, rate_hz = path.name, config.loop.rate_hz
        if dbc is None or dbc_bytes is None:
            return Source(name, text, known.metadata["dbc"], known.dbc, rate_hz, known.offset_ns, known)
        return Source(name, text, dbc.name, dbc_bytes, rate_hz, known.offset_ns, known)
    if dbc is None or dbc_bytes is None:
        raise ConfigError(f"{recording}: name its database with --dbc")
    config, text, path = load_with_text(config_file or "rig.toml")
    return Source(
        path.name, text, dbc.name, dbc_bytes, config.loop.rate_hz, start_ns(recording) - _LEAD_NS, None
    )
