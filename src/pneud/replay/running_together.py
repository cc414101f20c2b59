"""A run of several axes in simulated time from its first tick to its last, counted and written down."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pneud.loading import Together as Axes
from pneud.log.files.naming import log_path, new_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import SNAPSHOT_S
from pneud.loop.summary import summarise
from pneud.loop.tally import Tally
from pneud.replay.lockstep import backend_of, header_of
from pneud.replay.together import Ask, Together
from pneud.signals import Record, RequestKind


def run_together(
    axes: Axes,
    duration_s: float,
    seed: int,
    folder: Path | None,
    look: Callable[[int], None],
    ask: Ask | None = None,
    see: Callable[[Sequence[Record]], bool] | None = None,
) -> dict[str, dict[str, Any]]:
    """All ticks of axes that track together.

    Args:
        axes: on one bus.
        duration_s: simulated time until they are told to shut down.
        seed: of the noise.
        folder: for a log of each; None for none.
        look: called with each tick's place, from 0.
        ask: what operators want; else all are armed and track.
        see: called with the records of each tick; whether it is enough.

    Returns:
        A summary of each by its name, as of one alone.

    Raises:
        LogError: a log cannot be written.
        BuildError: the compiled law is required and cannot be had.
    """
    rate_hz, hows = axes[0].config.loop.rate_hz, [backend_of(axis) for axis in axes]
    run = Together(axes, duration_s, seed, hows, ask=ask)
    tallies = [Tally(truth=True, timed=False, sync=bool(axis.config.bus.sync)) for axis in axes]
    snapshot_ticks = max(1, round(SNAPSHOT_S * rate_hz))
    paths: list[Path | None] = [None] * len(axes)
    writers: list[LogWriter] = []
    with ExitStack() as logs:
        for n, (axis, how) in enumerate(zip(axes, hows, strict=True) if folder is not None else ()):
            log = paths[n] = log_path(str(folder), axis.config.name)
            header = header_of(axis, seed=str(seed + n), law=how.name, daemon=axes.name)
            writers.append(LogWriter(logs.enter_context(new_log(log)), header))
        for number, records in enumerate(run.records()):
            look(number)
            if see is not None and see(records):
                run.end()
            for lane, tally, record in zip(run.lanes, tallies, records, strict=True):
                tally.add(record, ending=lane.shut)
                request = record.tick.request
                if request is not None and request.kind == RequestKind.ARM:
                    tally.asked_to_arm(record.tick)
            for lane, writer, record in zip(run.lanes, writers, records, strict=False):
                writer.write(record)
                if (number + 1) % snapshot_ticks == 0:
                    writer.snapshot(lane.turn.freeze())
        for writer in writers:
            writer.close()
    unwritten = [writer.unwritten for writer in writers] or [0] * len(axes)
    found = {}
    for axis, lane, tally, path, lost in zip(axes, run.lanes, tallies, paths, unwritten, strict=True):
        found[axis.config.name] = summary = summarise(
            tally,
            bus="simulated",
            rate_hz=rate_hz,
            counts=lane.turn.inbox.counts(),
            tx=2 * tally.ticks,
            rx_dropped=0,
            log=str(path) if path is not None else None,
            log_dropped=lost,
        )
        if (never := tally.never_armed()) is not None:
            summary["never_armed"] = never
    return found
