"""What a log tells of an axis's life: of its run the snapshots do, of the runs before the set-up."""

from __future__ import annotations

import json
from typing import Any

from pneud.log.files.reader import LoggedState, LogReader
from pneud.log.format.header import MILEAGE_BEFORE
from pneud.log.format.snapshot import SnapshotError, from_json
from pneud.signals import Mileage


def done_by(state: LoggedState) -> Mileage | None:
    """What the axis had done in its run at a snapshot; None where it is of a version that does not count."""
    try:
        axis: dict[str, Any] = json.loads(state.data)["axis"]
        found: Mileage = from_json(Mileage, json.dumps(axis["odometer"]["done"]))
    except (ValueError, KeyError, TypeError, SnapshotError):
        return None
    return found


def done_before(log: LogReader) -> tuple[Mileage, str] | None:
    """What the axis had done before the run, and since when; None where nobody has kept it."""
    try:
        found: dict[str, Any] = json.loads(log.setup[MILEAGE_BEFORE])
        since = str(found.pop("since"))
        before: Mileage = from_json(Mileage, json.dumps(found))
    except (ValueError, KeyError, TypeError, AttributeError, SnapshotError):
        return None
    return before, since
