"""What a run comes to: its summary on standard output, its complaints on standard error, its exit status."""

from __future__ import annotations

import json
import sys
from typing import Any

from pneud.daemon.session import Session
from pneud.loop.lane import Lane
from pneud.loop.summary import in_words, summarise
from pneud.safety.faults import LOG_LOST, names
from pneud.scenario import verdict


def tell(session: Session, lane: Lane) -> int:
    """Say what a run has come to.

    Returns:
        Exit status: 0, or 1 where a run that tracks by itself had a fault or never came to track, or the log
        is not whole. A fault does not end a rig's daemon: whoever tells it to stop gets what was asked for.
    """
    o = session.ready.options
    missing, lost = _records_missing(session), _log_lost(session)
    link = session.ready.link
    summary = summarise(
        lane.tally,
        bus=link.name,
        rate_hz=session.ready.config.loop.rate_hz,
        counts=lane.turn.inbox.counts(),
        tx=link.tx,
        rx_dropped=link.rx_dropped,
        log=str(session.ready.log_file),
        log_dropped=missing,
    )
    for report in session.reports:
        if report.asked and not report.ok:
            _complain(f"{report.name}: {report.reason}")
    failure = lane.turn.axis.failure
    if failure is not None:
        _complain(f"exception in the cycle: {failure!r}")
    if missing:
        why = lost or session.ring.status().error_text or "the recorder could not keep up"
        _complain(f"the log lacks {missing} records: {why}")
    elif lost:
        _complain(f"{session.ready.log_file} is not whole: {lost}")
    judged = _judged(session, lane)
    if judged is not None:
        summary["scenario"] = judged
        _complain(verdict.in_words(judged))
    by_itself = o.virtual or o.arm
    never = lane.tally.never_armed() if by_itself and not lane.operated else None
    if never is not None:
        summary["never_armed"] = never
    print(json.dumps(summary) if o.json else in_words(summary))
    if lane.tally.ever_latched and not o.json:
        happened = "stopped by" if by_itself else "there was a fault:"
        _complain(f"{happened} {', '.join(names(lane.tally.ever_latched))}")
    if never is not None:
        _complain(f"never armed: {', '.join(never)}")
    lost = "" if _loss_is_played(session) else lost
    faulted = by_itself and lane.tally.ever_latched != 0
    return 1 if faulted or never is not None or lost else 0


def _complain(words: str) -> None:
    print(f"pneud: {words}", file=sys.stderr)


def _records_missing(session: Session) -> int:
    """Records that the log lacks; what a recorder that is still at work holds is not lost."""
    status = session.ring.status()
    return max(0, session.ring.put_count - status.written) if session.recorded else status.lost


def _log_lost(session: Session) -> str:
    """Why the log has no end; empty where it has one, whatever it may lack before."""
    status = session.ring.status()
    if not session.recorded:
        return "it is still being written"
    if not status.finished:
        begun = "the recorder was lost" if status.heartbeat else "the recorder never began"
        return status.error_text or begun
    path = session.ready.log_file
    return "the file is empty" if path.exists() and path.stat().st_size == 0 else ""


def _loss_is_played(session: Session) -> bool:
    """Whether a scenario takes the log away, so that its verdict tells how the run went."""
    scenario = session.ready.scenario
    return scenario is not None and not set(names(LOG_LOST)).isdisjoint(scenario.expect.faults)


def _judged(session: Session, lane: Lane) -> dict[str, Any] | None:
    scenario, effects = session.ready.scenario, session.effects
    if scenario is None or effects is None:
        return None
    tally = lane.tally
    seen = verdict.Observed(tally.ever_present, tally.ever_latched, tally.state, effects["engaged"])
    return verdict.judge(scenario, session.ready.config, seen, effects)
