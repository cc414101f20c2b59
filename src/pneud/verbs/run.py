"""The daemon, on a rig or with the software plant on a virtual bus."""

from __future__ import annotations

from pneud.daemon.preparation import RunOptions, prepared
from pneud.daemon.result import tell
from pneud.daemon.session import Session

__all__ = ["RunOptions", "run"]


def run(o: RunOptions) -> int:
    """Run until told to stop.

    Returns:
        Exit status: 0, or 1 where there was a fault or the axis never came to track.

    Raises:
        Exception: as for `prepared`, which refuses what cannot be run.
    """
    with prepared(o) as ready:
        session = Session(ready)
        return tell(session, session.run())
