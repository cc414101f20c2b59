"""What has to be left of a log, however its run has ended: whole up to the cut, and replayed identical."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from pneud.log.files.naming import LogError
from pneud.log.files.reader import read_log
from pneud.log.format.records import LoggedTick
from pneud.prove.axis_judge import Session
from pneud.replay.replaying import replay


def wrong_with(session: Session) -> str:
    """What is wrong with the log of a session; empty where it is as it has to be."""
    status = session.ring.status()
    least = session.durable if session.cut else status.written
    if session.removed:
        return ""
    if not session.log.exists():
        return f"{least} records were said to be kept, and the file is gone" if least else ""
    try:
        log = read_log(session.log)
        ticks: list[LoggedTick] = []
        replayed = replay(log, look=lambda logged, _: ticks.append(logged))
        if replayed.truncated or len(ticks) < least:  # behind a gap it does not look
            ticks = list(log)
    except LogError as e:
        return f"{least} records were said to be kept: {e}" if least else ""
    if len(ticks) < least:
        return f"{least} records were said to be kept, and {len(ticks)} are there ({log.damage or 'whole'})"
    if status.finished and not session.cut and log.truncated:
        return f"finished, and not whole: {log.damage}"
    if wrong := _unlike(ticks, session):
        return wrong
    return "" if replayed.identical else f"its replay differs: {replayed.first}"


def _unlike(ticks: Sequence[LoggedTick], session: Session) -> str:
    if any(after.number <= before.number for before, after in pairwise(ticks)):
        return "its records do not follow each other"
    for tick in ticks:
        if tick.number > len(session.ticks):
            return f"it has a record {tick.number}, and {len(session.ticks)} were made"
        made = session.ticks[tick.number - 1]
        logged = tick.t_ns, tick.state, tick.answer
        if (
            logged != (made.t_ns, made.state, made.answer)
            or abs(tick.command.voltage_v - made.voltage_v) > 1e-6
        ):
            return f"record {tick.number} is another one than was made: {logged}, {made}"
    return ""
