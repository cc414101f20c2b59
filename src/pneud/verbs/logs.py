"""What logs there are, the newest first."""

from __future__ import annotations

import json as json_
import time
from typing import Annotated

import typer

from pneud.log.files.listing import ListedLog, listed
from pneud.log.files.naming import log_folder
from pneud.verbs import JsonOption, VerbError


def logs(
    folder: Annotated[
        str | None, typer.Argument(metavar="FOLDER", help="Where; default the one that the daemon logs to.")
    ] = None,
    json: JsonOption = False,
) -> int:
    """List logs: when, how long, of what axis, on what bus, how large, in how many parts.

    Returns:
        Exit status: 0.

    Raises:
        LogError: there is no default folder.
        VerbError: there is no such folder.
    """
    place = log_folder(folder)
    if not place.is_dir():
        raise VerbError(f"{place}: there is no such folder")
    found = listed(place)
    if json:
        print(json_.dumps({"schema": 1, "folder": str(place), "logs": [_as_object(log) for log in found]}))
        return 0
    print(f"{place}: {len(found)} logs")
    for log in found:
        print(_in_words(log))
    return 0


def _as_object(log: ListedLog) -> dict[str, object]:
    return {**log._asdict(), "path": str(log.path)}


def _in_words(log: ListedLog) -> str:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(log.start_unix_s)) if log.start_unix_s else "–"
    parts = f", {log.parts} parts" if log.parts > 1 else ""
    end = "" if log.closed else ", without its end"
    size = f"{1e-6 * log.bytes:.1f} MB"
    rate = f"{log.rate_hz:g} Hz"
    return f"{log.path.name:44} {when:19} {log.length_s:8.1f} s {size:>9}  {rate}, {log.bus}{parts}{end}"
