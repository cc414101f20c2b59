"""Let the daemon begin anew with what its file says; the axis has to be disarmed."""

import time

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.results import refused, show
from pneud.verbs import JsonOption, SocketOption, VerbError

PATIENCE_S, LOOK_S = 30.0, 0.1


def restart(socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it, and wait for the run that follows.

    Returns:
        Exit status: 0, or 1 where it was refused.

    Raises:
        PlaceError: no daemon to talk to.
        VerbError: it has ended, and does not answer again.
    """
    try:
        begun = begin_anew(socket)
    except RefusedError as e:
        return refused(e, json)
    show({key: begun[key] for key in ("state", "log")}, json, f"{begun['state']}; log {begun['log']}")
    return 0


def begin_anew(socket: str | None) -> dict[str, object]:
    """Ask for it, and wait for the run that follows.

    Returns:
        Its status.

    Raises:
        RefusedError: the answer is no.
        PlaceError: no daemon to talk to.
        VerbError: it has ended, and does not answer again.
    """
    with Client(socket) as client:
        old = client.ask("status")["log"]
        client.ask("restart")
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        time.sleep(LOOK_S)
        try:
            with Client(socket) as client:
                status = client.ask("status")
        except (PlaceError, RefusedError):
            continue
        if status["log"] != old:
            return status
    raise VerbError(
        f"restart: the daemon has ended, and not begun again within {PATIENCE_S:g} s: see its journal", 3
    )
