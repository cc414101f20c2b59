"""What a rig was like, week after week: a file with a line for each identification, and what it tells."""

from __future__ import annotations

import fcntl
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from pneud.config.sections import ConfigError
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader, read_log
from pneud.rt.inputs import read_whole
from pneud.rt.outputs import write_whole
from pneud.study.identification import comparing
from pneud.study.identification import parameters as key
from pneud.study.identification.parameters import Estimate

ENOUGH_S, WORTH_S = 1800.0, 10.0  # of logs together; shorter ones tell next to nothing
WEARS = (
    *(key.COULOMB, key.STATIC, key.VISCOUS, key.SEEP, key.SEEP_OUT),
    *(key.PLUS, key.MINUS, key.PLAY, key.CONDUCTANCE, key.AREA, key.BANDWIDTH),
)  # friction, leakage, edges, flow: what is drawn


class Entry(NamedTuple):
    """An identification."""

    date: str  # of the last log, as 2026-11-29T17:12
    logs: tuple[str, ...]  # names
    parameters: Mapping[str, Estimate]
    axis: str = ""  # empty where it does not say


class Point(NamedTuple):
    """A parameter at a date."""

    date: str
    estimate: Estimate


def history(path: Path) -> list[Entry]:
    """The identifications in a file, the first one first; none where there is no such file.

    Raises:
        ConfigError: it cannot be read, or is nothing of the kind.
    """
    try:
        lines = read_whole(path).splitlines()
    except FileNotFoundError:
        return []
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read: {e.strerror}") from None
    found = []
    for number, line in enumerate(lines, 1):
        try:
            whole = json.loads(line)
            told, axis = comparing.estimates(whole), str(whole.get("axis", ""))
            found.append(Entry(str(whole["date"]), tuple(whole["logs"]), told, axis))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            raise ConfigError(f"{path}:{number}: not what pneud identify --wear writes") from None
    return found


def write(path: Path, entries: Iterable[Entry]) -> None:
    """Write all of them.

    Raises:
        OSError: the file cannot be written.
    """
    write_whole(path, "".join(f"{_line(e)}\n" for e in entries))


def _line(e: Entry) -> str:
    parameters = {name: comparing.as_json(one) for name, one in e.parameters.items()}
    whole = {"schema": comparing.SCHEMA, "axis": e.axis, "date": e.date, "logs": e.logs}
    return json.dumps({**whole, "parameters": parameters})


def entry(logs: Sequence[LogReader], found: Mapping[str, Estimate], axis: str) -> Entry:
    """What has been found in logs of an axis."""
    last_s = 1e-9 * max(log.start_ns() for log in logs)
    date = time.strftime("%Y-%m-%dT%H:%M", time.gmtime(last_s))
    return Entry(date, tuple(path.name for log in logs for path in log.paths), found, axis)


def at_first(entries: Iterable[Entry]) -> dict[str, Estimate]:
    """Each parameter as it was told first."""
    found: dict[str, Estimate] = {}
    for one in entries:
        found |= {name: e for name, e in one.parameters.items() if e.told and name not in found}
    return found


def course(entries: Iterable[Entry], name: str) -> list[Point]:
    """A parameter over the dates at which it was told."""
    told = ((one.date, one.parameters[name]) for one in entries if name in one.parameters)
    return [Point(date, e) for date, e in told if e.told]


def newest(folder: Path) -> list[LogReader]:
    """The newest logs in a folder, half an hour or so together; those that are being written are left out.

    Raises:
        LogError: there is none that is finished.
    """
    found: list[LogReader] = []
    lasts_s = 0.0
    by_age = sorted(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in by_age:
        if lasts_s >= ENOUGH_S:
            break
        if not _is_finished(path):
            continue
        log = read_log(path)
        own_s = path.stat().st_mtime - 1e-9 * log.start_ns()
        if own_s >= WORTH_S and (not found or log.rate_hz == found[0].rate_hz):
            found.append(log)
            lasts_s += own_s
    if not found:
        raise LogError(f"{folder}: holds no finished log of {WORTH_S:g} s and more")
    return found[::-1]


def _is_finished(path: Path) -> bool:
    """Whether nobody writes it: who does has locked it."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
