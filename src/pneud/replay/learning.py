"""What a log holds of what has been learnt: it stands in every snapshot of the axis."""

from __future__ import annotations

import json
from typing import Any

from pneud.control.adaptation import Learnt
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LoggedState, LogReader
from pneud.log.format.header import SNAPSHOT_S
from pneud.log.format.snapshot import SnapshotError, from_json

_END_NS = 2**62


def learnt_in(state: LoggedState) -> Learnt | None:
    """What had been learnt at a snapshot; None where it is of a version that learns otherwise."""
    try:
        axis: dict[str, Any] = json.loads(state.data)["axis"]
        found: Learnt = from_json(Learnt, json.dumps((axis["controller"] or axis)["learnt"]))
    except (ValueError, KeyError, TypeError, SnapshotError):
        return None
    return found


def last_learnt(log: LogReader) -> tuple[Learnt, int]:
    """What had been learnt at the last snapshot, and when that was taken, Unix [ns].

    Raises:
        LogError: there is none.
    """
    for from_ns in (_END_NS, 0):
        found = None
        for raw in log.raw(from_ns):
            if isinstance(raw, LoggedState) and (learnt := learnt_in(raw)) is not None:
                found = learnt, raw.log_time_ns
        if found is not None:
            return found
    why = f"; {log.damage}" if log.truncated else f"; there is one every {SNAPSHOT_S:g} s"
    raise LogError(f"{log.path}: has no snapshot that tells what was learnt{why}")
