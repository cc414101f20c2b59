"""What a run comes to: its summary on standard output, its complaints on standard error, its exit status."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.compiled import slow
from pneud.daemon.session import AxisRun, Session
from pneud.loop.lane import Lane
from pneud.loop.summary import in_words, summarise
from pneud.safety.faults import LOG_LOST, names
from pneud.scenario import verdict

if TYPE_CHECKING:
    from pneud.scenario.format import Scenario


def tell(session: Session, lanes: Sequence[Lane]) -> int:
    """Say what a run has come to.

    Returns:
        Exit status: 0, or 1 where a run that tracks by itself had a fault or never came to track, or the log
        is not whole. A fault does not end a rig's daemon: whoever tells it to stop gets what was asked for.
    """
    for report in session.reports:
        if report.asked and not report.ok:
            _complain(f"{report.name}: {report.reason}")
    as_object = session.ready.options.json
    told = [_axis(session, axis, lane) for axis, lane in zip(session.axes, lanes, strict=True)]
    if as_object:
        each = {axis.config.name: one.summary for axis, one in zip(session.axes, told, strict=True)}
        alone = told[0].summary
        found = alone if len(told) == 1 else {"schema": 1, "bus": alone["bus"], "axes": each}
        print(json.dumps(found | slow.field()))
    else:
        for axis, one in zip(session.axes, told, strict=True):
            words = in_words(one.summary)
            print(words if len(told) == 1 else f"axis {axis.config.name}: {words}")
    for one in told:
        for complaint in one.after:
            _complain(complaint)
    return 1 if any(one.failed for one in told) else 0


class _Told(NamedTuple):
    """What one axis has come to."""

    summary: dict[str, Any]
    after: list[str]  # complaints, to be said behind the summary
    failed: bool


def _axis(session: Session, axis: AxisRun, lane: Lane) -> _Told:
    o, link = session.ready.options, session.ready.link
    whose = f"{axis.config.name}: " if len(session.axes) > 1 else ""
    missing, lost = _records_missing(axis), _log_lost(axis)
    summary = summarise(
        lane.tally,
        bus=link.name,
        rate_hz=axis.config.loop.rate_hz,
        counts=lane.turn.inbox.counts(),
        tx=link.tx,
        rx_dropped=link.rx_dropped,
        log=str(axis.ready.log_file),
        log_dropped=missing,
    )
    failure = lane.turn.axis.failure
    if failure is not None:
        _complain(f"{whose}exception in the cycle: {failure!r}")
    if missing:
        why = lost or axis.ring.status().error_text or "the recorder could not keep up"
        _complain(f"{whose}the log lacks {missing} records: {why}")
    elif lost:
        _complain(f"{axis.ready.log_file} is not whole: {lost}")
    judged = _judged(session, axis, lane)
    if judged is not None:
        summary["scenario"] = judged
        _complain(verdict.in_words(judged))
    by_itself = o.virtual or o.arm
    never = lane.tally.never_armed() if by_itself and not lane.operated else None
    after = []
    if lane.tally.ever_latched and not o.json:
        happened = "stopped by" if by_itself else "there was a fault:"
        after.append(f"{whose}{happened} {', '.join(names(lane.tally.ever_latched))}")
    if never is not None:
        summary["never_armed"] = never
        after.append(f"{whose}never armed: {', '.join(never)}")
    lost = "" if _loss_is_played(session, axis) else lost
    faulted = by_itself and lane.tally.ever_latched != 0
    return _Told(summary, after, faulted or never is not None or bool(lost))


def _complain(words: str) -> None:
    print(f"pneud: {words}", file=sys.stderr)


def _records_missing(axis: AxisRun) -> int:
    """Records that the log lacks; what a recorder that is still at work holds is not lost."""
    status = axis.ring.status()
    return max(0, axis.ring.put_count - status.written) if axis.recorded else status.lost


def _log_lost(axis: AxisRun) -> str:
    """Why the log has no end; empty where it has one, whatever it may lack before."""
    status = axis.ring.status()
    if not axis.recorded:
        return "it is still being written"
    if not status.finished:
        begun = "the recorder was lost" if status.heartbeat else "the recorder never began"
        return status.error_text or begun
    path = axis.ready.log_file
    return "the file is empty" if path.exists() and path.stat().st_size == 0 else ""


def _struck(session: Session, axis: AxisRun) -> Scenario | None:
    """The scenario that happens to an axis, if one does."""
    return session.ready.scenario if axis is session.axes[session.ready.struck] else None


def _loss_is_played(session: Session, axis: AxisRun) -> bool:
    """Whether a scenario takes the log away, so that its verdict tells how the run went."""
    scenario = _struck(session, axis)
    return scenario is not None and not set(names(LOG_LOST)).isdisjoint(scenario.expect.faults)


def _judged(session: Session, axis: AxisRun, lane: Lane) -> dict[str, Any] | None:
    scenario, effects = _struck(session, axis), session.effects
    if scenario is None or effects is None:
        return None
    tally = lane.tally
    seen = verdict.Observed(tally.ever_present, tally.ever_latched, tally.state, effects["engaged"])
    return verdict.judge(scenario, axis.config, seen, effects, verdict.blind_spots(axis.ready.loaded))
