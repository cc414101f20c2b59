"""Mend a log that was cut short."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pneud.log.files.recovery import recover as mend
from pneud.verbs import LogArgument, ProgressOption, require_suffix
from pneud.view.progress import progress


def recover(
    log: LogArgument,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="OUT", help="The mended log; default LOG-recovered.mcap."),
    ] = None,
    how: ProgressOption = "auto",
) -> int:
    """Write what can be read of a log into another one.

    Returns:
        Exit status: 0, or 1 where not a tick could be saved of a source that is not whole.
    """
    output = output or Path(f"{Path(log).stem}-recovered.mcap")
    require_suffix(output, ".mcap", "a log is an MCAP file")
    source = Path(log)
    size = source.stat().st_size if source.is_file() else 0
    with progress(how) as told:
        report = mend(source, output, lambda read: told(source.name, 1e-6 * read, 1e-6 * size, "MB"))
    chunks = f" from {report.chunks} chunks" if report.chunks else ""
    print(f"{output}: {report.messages} messages{chunks}")
    if report.damaged_chunks:
        print(f"left out: {report.damaged_chunks} damaged chunks")
    if report.parted:
        print(f"left out: {report.parted} messages of ticks that are not whole")
    if report.damage:
        print(f"the source: {report.damage}")
    return 1 if (report.damage or report.parted) and not report.ticks else 0
