"""Logs as one page of figures and tables that needs nothing beside it."""

from __future__ import annotations

import json
import sys
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.config.sections import ConfigError
from pneud.log.files.reader import read_log
from pneud.report import pictures
from pneud.report.gather import Window, gather
from pneud.report.page import is_reference, page
from pneud.rt.extras import require
from pneud.rt.inputs import read_whole
from pneud.rt.outputs import require_folder, write_whole
from pneud.verbs import LogsArgument, ProgressOption, require_suffix, watch, whole
from pneud.view.progress import progress

_BUCKETS = 8192  # of a page, shared by its logs
_FEWEST = 1024
_CLOSEUP = 1_900_000  # bytes of every tick in a page, shared likewise; a third more as text


def report(
    logs: LogsArgument,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="The page; default the log's name with .html."),
    ] = None,
    png: Annotated[
        bool, typer.Option("--png", help="Write the figures as PNG beside the page, too.")
    ] = False,
    reference: Annotated[
        Path | None,
        typer.Option("--reference", metavar="FILE", help="What 'pneud bench --json' printed here."),
    ] = None,
    begin: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Begin so long after the first tick.")
    ] = None,
    end: Annotated[
        float | None, typer.Option("--to", metavar="S", help="End so long after the first tick.")
    ] = None,
    show: Annotated[bool, typer.Option("--open", help="Show the page in a browser.")] = False,
    how: ProgressOption = "auto",
) -> int:
    """Write a report on one log, or a comparison of several.

    Returns:
        Exit status: 0, or 1 where a log could not be read to its end.
    """
    window = Window(begin or 0.0, float("inf") if end is None else end)
    if not window.begin_s < window.end_s:
        raise ConfigError(f"--from {window.begin_s:g} --to {window.end_s:g}: there is nothing between them")
    output = output or Path(f"{read_log(logs[0]).path.stem}.html")
    require_suffix(output, ".html", "a report is a page of HTML")
    require_folder(output)
    if png:
        require("report --png", "plots")
    setting = _reference(reference) if reference is not None else None
    buckets = max(_FEWEST, _BUCKETS // len(logs))
    readers = [read_log(log) for log in logs]
    with progress(how) as told:
        watch(told, *readers)
        runs = [gather(reader, window, buckets, _CLOSEUP // len(logs)) for reader in readers]
    write_whole(output, page(runs, setting))
    for path in (output, *(pictures.write(runs, output.with_suffix("")) if png else ())):
        print(path)
    if show and not webbrowser.open(output.absolute().as_uri()):
        print("pneud: no browser to show it in", file=sys.stderr)
    return 0 if whole(*readers) else 1


def _reference(path: Path) -> Any:
    try:
        found = json.loads(read_whole(path))
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read: {e.strerror}") from None
    except (ValueError, RecursionError):
        found = None
    if not is_reference(found):
        raise ConfigError(f"{path}: not what pneud bench --json prints")
    return found
