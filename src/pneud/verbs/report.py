"""Logs as one page with figures and tables."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pneud.config.models import ConfigError
from pneud.log.files.naming import LogError
from pneud.log.files.reader import read_log
from pneud.report import pictures
from pneud.report.gather import EmptyError, Window, gather
from pneud.report.page import is_reference, page
from pneud.report.pictures import PicturesError
from pneud.rt.outputs import write_whole

_BUCKETS = 8192  # of a page, shared by its logs
_FEWEST = 1024


class ReportOptions(NamedTuple):
    """What was asked for on the command line."""

    logs: Sequence[str]
    output: Path
    png: bool
    reference: Path | None
    begin_s: float | None
    end_s: float | None


def report(o: ReportOptions) -> int:
    """Write a report on one log, or a comparison of several.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: an option, or the configuration in a log, cannot be used.
        DatabaseError: nor its DBC.
        LogError: not a log that this version reads, or nothing in it.
    """
    window = Window(o.begin_s or 0.0, float("inf") if o.end_s is None else o.end_s)
    if not window.begin_s < window.end_s:
        raise ConfigError(f"--from {window.begin_s:g} --to {window.end_s:g}: there is nothing between them")
    if not o.output.parent.is_dir():
        raise ConfigError(f"{o.output}: there is no folder {o.output.parent}; create it or name another file")
    if o.png:
        try:
            pictures.require()
        except PicturesError as e:
            raise ConfigError(str(e)) from None
    reference = _reference(o.reference) if o.reference is not None else None
    buckets = max(_FEWEST, _BUCKETS // len(o.logs))
    try:
        runs = [gather(read_log(log), window, buckets) for log in o.logs]
    except EmptyError as e:
        raise LogError(str(e)) from None
    try:
        write_whole(o.output, page(runs, reference))
        written = [o.output]
        if o.png:
            written += pictures.write(runs, o.output.with_suffix(""))
    except OSError as e:
        raise ConfigError(f"{e.filename or o.output}: cannot be written: {e.strerror}") from None
    for path in written:
        print(path)
    return 0


def _reference(path: Path) -> Any:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read: {e.strerror}") from None
    except ValueError:
        found = None
    if not is_reference(found):
        raise ConfigError(f"{path}: not what pneud bench --json prints")
    return found
