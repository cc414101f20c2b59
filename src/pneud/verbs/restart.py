"""Let the daemon begin anew with what its file says; the axis has to be disarmed."""

from pneud.console.client import Client, RefusedError
from pneud.console.restarting import next_session
from pneud.console.results import refused, show
from pneud.verbs import JsonOption, SocketOption

PATIENCE_S = 30.0


def restart(socket: SocketOption = None, json: JsonOption = False) -> int:
    """Ask for it, and wait for the run that follows.

    Returns:
        Exit status: 0, or 1 where it was refused.

    Raises:
        PlaceError: no daemon to talk to, or it has ended and does not answer again.
    """
    with Client(socket) as client:
        status = client.ask("status")
        one = next(iter(status["axes"])) if "axes" in status else None
        before = (status if one is None else status["axes"][one])["log"]
        try:
            client.ask("restart")
        except RefusedError as e:
            return refused(e, json)
    client, status = next_session(lambda: Client(socket, one), before, PATIENCE_S)
    client.close()
    show({key: status[key] for key in ("state", "log")}, json, f"{status['state']}; log {status['log']}")
    return 0
