"""A simulated run from its first tick to its last: counted, watched and written down."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from pneud.log.files.writer import LogWriter
from pneud.log.format.header import SNAPSHOT_S
from pneud.log.format.schema import Level
from pneud.log.live.notes import Note
from pneud.loop.tally import Tally
from pneud.replay.lockstep import Simulation
from pneud.scenario.verdict import Observed
from pneud.signals import Record, RequestKind


class Ran(NamedTuple):
    """What a run came to."""

    tally: Tally
    seen: Observed


def through(
    run: Simulation,
    rate_hz: float,
    writer: LogWriter | None = None,
    look: Callable[[int, Record], None] | None = None,
) -> Ran:
    """All ticks of a run.

    Args:
        run: one that has not begun.
        rate_hz: of its ticks.
        writer: gets the ticks, now and then the state of the axis, and when a scenario began.
        look: called with each tick's place, from 0, and record.
    """
    tally = Tally(truth=True, timed=False, sync=run.inbox.sync)
    seen = Observed()
    snapshot_ticks, told = max(1, round(SNAPSHOT_S * rate_hz)), run.engine is None
    for number, record in enumerate(run.records()):
        tally.add(record, ending=run.shut)
        if look is not None:
            look(number, record)
        request = record.tick.request
        if request is not None and request.kind == RequestKind.ARM:
            tally.asked_to_arm(record.tick)
        if not run.shut:
            seen = seen.then(record.tick)
        if writer is not None:
            if not told and run.engine is not None and run.engine.effects.onset_ns >= 0:
                begun_ns, told = run.engine.effects.onset_ns, True
                writer.say(Note(begun_ns, Level.INFO, "scenario", f"{run.engine.scenario.name} begins"))
            writer.write(record)
            if (number + 1) % snapshot_ticks == 0:
                writer.snapshot(run.turn.freeze())
    return Ran(tally, seen)
