"""A log's frames as a recording of the bus, or its ticks as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.loading import codecs_of
from pneud.log.files.naming import LogError
from pneud.log.files.reader import read_log
from pneud.replay import exporting as to
from pneud.replay.traffic import FORMATS
from pneud.rt.outputs import require_folder
from pneud.verbs import LogArgument, ProgressOption, watch, whole
from pneud.view.progress import progress


def export(
    log: LogArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Frames as .log (candump), .asc or .blf; ticks as .csv or .parquet, or .mcap for viewers;"
            " default .csv.",
        ),
    ] = None,
    how: ProgressOption = "auto",
) -> int:
    """Write a log in another format, which the suffix names.

    Returns:
        Exit status: 0, or 1 where the log could not be read to its end, or no frame is in its ticks.
    """
    output = output or Path(f"{read_log(log).path.stem}.csv")
    suffix = output.suffix
    if suffix not in (formats := (*to.TABLES, *FORMATS, to.VIEWERS)):
        known = ", ".join(formats)
        raise ConfigError(f"{output}: no such format; its name must end in one of {known}")
    require_folder(output)
    reader = read_log(log)
    if next(iter(reader), None) is None:
        raise LogError(f"{reader.path}: no tick in it{f'; {reader.damage}' if reader.truncated else ''}")
    with progress(how) as report:
        watch(report, reader)
        if suffix in to.TABLES:
            done, what = to.table(reader, output), "ticks"
        elif suffix == to.VIEWERS:
            done, what = to.for_viewers(reader, output), "ticks"
        else:
            config = parse(reader.config_text, f"{reader.path}:{reader.config_name}")
            codecs = codecs_of(config.bus, reader.dbc_name, reader.dbc, config.gas)
            done, what = to.frames(reader, codecs, output, sync=config.bus.sync), "frames"
    print(f"{', '.join(map(str, done.files))}: {done.rows} {what}")
    if done.unsent_ticks:
        print(f"left out: {done.unsent_ticks} ticks whose SYNC, or command without one, could not be sent")
    if reader.missing:
        print(f"the log lacks {reader.missing} ticks")
    return 0 if whole(reader) and done.rows else 1
