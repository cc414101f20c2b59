"""What logs there are, the newest first, or what was done in all of them as one table."""

from __future__ import annotations

import json as json_
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from pneud.log.files.listing import ListedLog, listed
from pneud.log.files.naming import log_folder
from pneud.rt.outputs import require_folder
from pneud.verbs import JsonOption, ProgressOption, VerbError
from pneud.view.progress import progress

_NAMED = 20  # damaged logs that are named; the table has all


def logs(
    places: Annotated[
        list[str] | None,
        typer.Argument(metavar="[FOLDER…]", help="Where; default the one that the daemon logs to."),
    ] = None,
    summary: Annotated[
        Path | None,
        typer.Option(
            "--summary",
            metavar="FILE",
            help="A table (.parquet, .csv) with a row for each motion in all logs below.",
        ),
    ] = None,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """List logs: when, how long, of what axis, on what bus, how large, in how many parts. Or sum them up.

    Returns:
        Exit status: 0, or 1 where a log that was read for a summary is damaged.

    Raises:
        LogError: there is no default folder; or the table's file is none.
        VerbError: there is no such folder.
    """
    where = [log_folder(place) for place in places] if places else [log_folder(None)]
    for place in where:
        if not place.is_dir() and (summary is None or not place.is_file()):
            raise VerbError(f"{place}: there is no such folder")
    if summary is not None:
        return _summarised(where, summary, json, how)
    found = {place: listed(place) for place in where}
    if json:
        all_ = [_as_object(log) for some in found.values() for log in some]
        folders = {"folder": str(where[0])} if len(where) == 1 else {"folders": [*map(str, where)]}
        print(json_.dumps({"schema": 1, **folders, "logs": all_}))
        return 0
    for place, some in found.items():
        print(f"{place}: {len(some)} logs")
        for log in some:
            print(_in_words(log))
    return 0


def _summarised(where: list[Path], table: Path, json: bool, how: str) -> int:
    from pneud.farm.gathering import readers, summarise  # noqa: PLC0415 - a list needs none of it
    from pneud.farm.store import SUFFIXES, store_of  # noqa: PLC0415

    if table.suffix not in SUFFIXES:
        raise VerbError(f"{table}: no such format; its name must end in {' or '.join(SUFFIXES)}")
    require_folder(table)
    with readers() as read:
        store, instead = store_of(table)
        if instead:
            print(f"pneud: {instead}", file=sys.stderr)
        with progress(how) as report:
            done = summarise(where, store, read, report)
    for path, why in done.damaged[:_NAMED]:
        print(f"pneud: {path}: {why}", file=sys.stderr)
    if len(done.damaged) > _NAMED:
        print(f"pneud: and {len(done.damaged) - _NAMED} more: see the column damage", file=sys.stderr)
    for path, of in done.copies:
        print(f"pneud: {path}: a copy of {of}, whose motions count once", file=sys.stderr)
    if json:
        pairs = {"damaged": ("path", "why"), "copies": ("path", "of")}
        lists = {
            name: [dict(zip(keys, pair, strict=True)) for pair in getattr(done, name)]
            for name, keys in pairs.items()
        }
        print(json_.dumps({"schema": 1, "summary": str(store.path), **done._asdict(), **lists}))
    else:
        print(
            f"{store.path}: {done.motions} motions of {done.logs} logs, {done.read} of them read now"
            f" ({_hours(done.recorded_s)} in {done.took_s:.1f} s)"
        )
        if done.gone:
            print(f"{done.gone} logs are no longer there, their motions are")
    return 1 if done.damaged else 0


def _hours(seconds: float) -> str:
    return f"{seconds / 3600.0:.1f} h" if seconds >= 3600.0 else f"{seconds:.1f} s"


def _as_object(log: ListedLog) -> dict[str, object]:
    return {**log._asdict(), "path": str(log.path)}


def _in_words(log: ListedLog) -> str:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(log.start_unix_s)) if log.start_unix_s else "–"
    parts = f", {log.parts} parts" if log.parts > 1 else ""
    end = "" if log.closed else ", goes on, or was cut short"
    size = f"{1e-6 * log.bytes:.1f} MB"
    rate = f"{log.rate_hz:g} Hz"
    return f"{log.path.name:44} {when:19} {log.length_s:8.1f} s {size:>9}  {rate}, {log.bus}{parts}{end}"
