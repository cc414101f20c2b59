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

TOLD_TICKS = 100  # between two that are told of
WORTH_TICKS = 5000  # of a run for which it is worth to load what does many at once


class Ran(NamedTuple):
    """What a run came to."""

    tally: Tally
    seen: Observed


def through(
    run: Simulation,
    rate_hz: float,
    writer: LogWriter | None = None,
    look: Callable[[int, Record], None] | None = None,
    told: Callable[[int], None] | None = None,
) -> Ran:
    """All ticks of a run; many at once, where it is long, nobody looks at each of them, and C can be had.

    Args:
        run: one that has not begun.
        rate_hz: of its ticks.
        writer: gets the ticks, now and then the state of the axis, and when a scenario began.
        look: called with each tick's place, from 0, and record.
        told: now and then, how many ticks are done.
    """
    if look is None and run.alone and run.compiled and run.total >= WORTH_TICKS:
        from pneud.replay.striding import by_strides  # noqa: PLC0415 - for long runs alone

        tally = by_strides(run, rate_hz, writer, told)
        if tally is not None:
            return Ran(tally, Observed())
    tally = Tally(truth=True, timed=False, sync=run.inbox.sync)
    seen = Observed()
    snapshot_ticks, began = max(1, round(SNAPSHOT_S * rate_hz)), run.engine is None
    for number, record in enumerate(run.records()):
        tally.add(record, ending=run.shut)
        if look is not None:
            look(number, record)
        if told is not None and number % TOLD_TICKS == 0:
            told(number)
        request = record.tick.request
        if request is not None and request.kind == RequestKind.ARM:
            tally.asked_to_arm(record.tick)
        if not run.shut:
            seen = seen.then(record.tick)
        if writer is not None:
            if not began and run.engine is not None and run.engine.effects.onset_ns >= 0:
                begun_ns, began = run.engine.effects.onset_ns, True
                writer.say(Note(begun_ns, Level.INFO, "scenario", f"{run.engine.scenario.name} begins"))
            writer.write(record)
            if (number + 1) % snapshot_ticks == 0:
                writer.snapshot(run.turn.freeze())
    return Ran(tally, seen)
