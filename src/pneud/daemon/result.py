"""What a run comes to: its summary on standard output, its complaints on standard error, its exit status."""

from __future__ import annotations

import json
import sys
from typing import Any

from pneud.daemon.session import Session
from pneud.loop.loop import Loop
from pneud.loop.summary import in_words, summarise
from pneud.safety.faults import BLOCKS_ARM, names
from pneud.scenario import verdict
from pneud.signals import State


def tell(session: Session, loop: Loop) -> int:
    """Say what a run has come to.

    Returns:
        Exit status: 0, or 1 where there was a fault or the axis never came to track.
    """
    o = session.ready.options
    missing = _records_missing(session)
    if not session.recorded:
        _complain(f"{session.ready.log_file} is still being written")
    summary = summarise(
        state=loop.state,
        bus=loop.link.name,
        rate_hz=session.ready.config.loop.rate_hz,
        ticks=loop.ticks,
        skipped=loop.skipped,
        lateness=loop.lateness,
        latency=loop.latency,
        tracking=loop.tracking,
        counts=loop.inbox.counts(),
        tx=loop.link.tx,
        rx_dropped=loop.link.rx_dropped,
        log=str(session.ready.log_file),
        log_dropped=missing,
        faults=loop.ever_latched,
    )
    for report in session.reports:
        if report.asked and not report.ok:
            _complain(f"{report.name}: {report.reason}")
    if loop.axis.failure is not None:
        _complain(f"exception in the cycle: {loop.axis.failure!r}")
    if missing:
        why = "the recorder was lost" if loop.recorder_lost else "it could not keep up"
        _complain(f"the log lacks {missing} records: {session.ring.status().error_text or why}")
    judged = _judged(session, loop)
    if judged is not None:
        summary["scenario"] = judged
        _complain(verdict.in_words(judged))
    print(json.dumps(summary) if o.json else in_words(summary))
    return _status(session, loop)


def _complain(words: str) -> None:
    print(f"pneud: {words}", file=sys.stderr)


def _records_missing(session: Session) -> int:
    """Records that the log lacks; what a recorder that is still at work holds is not lost."""
    status = session.ring.status()
    return max(0, session.ring.put_count - status.written) if session.recorded else status.lost


def _judged(session: Session, loop: Loop) -> dict[str, Any] | None:
    scenario, effects = session.ready.scenario, session.effects
    if scenario is None or effects is None:
        return None
    seen = verdict.Seen(loop.ever_present, loop.ever_latched, loop.state, effects["engaged"])
    return verdict.judge(scenario, session.ready.config, seen, effects)


def _status(session: Session, loop: Loop) -> int:
    o = session.ready.options
    if loop.ever_latched:
        if not o.json:
            _complain(f"stopped by {', '.join(names(loop.ever_latched))}")
        return 1
    wanted = o.virtual or o.arm
    if not wanted or loop.operated or loop.state == State.TRACKING:
        return 0
    reasons = names(loop.refused | (loop.present & BLOCKS_ARM))
    _complain(f"never armed: {', '.join(reasons) or 'the run was too short'}")
    return 1
