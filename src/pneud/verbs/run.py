"""The daemon, on a rig or with the software plant on a virtual bus."""

from __future__ import annotations

import os
import signal
import sys

from pneud.daemon.preparation import RunOptions, prepared
from pneud.daemon.result import tell
from pneud.daemon.session import Session
from pneud.rt import setup

__all__ = ["RunOptions", "run"]


def run(o: RunOptions) -> int:
    """Run until told to stop; where an operator has asked for it, all begins anew in this process.

    Returns:
        Exit status: 0, or 1 where there was a fault or the axis never came to track.

    Raises:
        Exception: as for `prepared`, which refuses what cannot be run.
    """
    allowed = os.sched_getaffinity(0)
    with prepared(o) as ready:
        session = Session(ready)
        lanes = session.run()
        status = tell(session, lanes)
    if any(lane.again for lane in lanes):
        sys.stdout.flush()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT):
            signal.signal(number, signal.SIG_DFL)  # from here on it ends at once
        if session.told_to_end:
            return status
        setup.leave(allowed)
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    return status
