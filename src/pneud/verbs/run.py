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
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used.
        LogError: the log cannot be written.
        BuildError: the compiled law is required and cannot be had.
        PlaceError: the console's socket cannot be made.
    """
    with prepared(o) as ready:
        session = Session(ready)
        return tell(session, session.run())
