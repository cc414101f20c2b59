"""A page in the browser that shows a running daemon and, where asked to, commands it; metrics."""

from __future__ import annotations

import secrets
import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pneud.console.client import Client
from pneud.rt.extras import require
from pneud.verbs import AxisOption, SocketOption, VerbError


def web(
    listen: Annotated[
        str, typer.Option("--listen", metavar="ADDRESS:PORT", help="Where.")
    ] = "127.0.0.1:8770",
    operate: Annotated[
        bool, typer.Option("--operate", help="Let whoever has the printed link, or the password, command.")
    ] = False,
    tls_cert: Annotated[
        Path | None,
        typer.Option("--tls-cert", metavar="FILE", help="Certificate, for any address but loopback."),
    ] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", metavar="FILE", help="Its key.")] = None,
    password_file: Annotated[
        Path | None, typer.Option("--password-file", metavar="FILE", help="Its first line is the password.")
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option("--name", metavar="NAME", help="A name by which browsers know this place."),
    ] = None,
    metrics: Annotated[
        Path | None, typer.Option("--metrics", metavar="FILE.prom", help="Keep metrics in a file, too.")
    ] = None,
    programs: Annotated[
        Path | None,
        typer.Option("--programs", metavar="FOLDER", help="Programs that the page may have gone through."),
    ] = None,
    axis: AxisOption = None,
    socket: SocketOption = None,
) -> int:
    """Serve until Ctrl-C.

    Returns:
        Exit status: 0.

    Raises:
        VerbError: what was given does not go together.
        ExtraError: a library is missing.
        PlaceError: there is no daemon.
        ListenError: the page cannot be there.
    """
    require("web", "web")
    if (tls_cert is None) != (tls_key is None):
        raise VerbError("--tls-cert and --tls-key belong together")
    if metrics is not None and metrics.suffix != ".prom":
        raise VerbError(f"{metrics}: node exporter reads files whose names end in .prom")

    if programs is not None and not programs.is_dir():
        raise VerbError(f"--programs {programs}: is no folder")

    names, choice = _axes(socket, axis)
    # what serves is loaded where it is needed: whoever has made a mistake is told at once
    from pneud.web.admission import Door  # noqa: PLC0415
    from pneud.web.axis import Axis  # noqa: PLC0415
    from pneud.web.places import listen as taken  # noqa: PLC0415
    from pneud.web.places import password_of  # noqa: PLC0415

    seen = {name: Axis(partial(Client, socket, name or None), choice) for name in names}
    for one in seen.values():
        one.attach()
    password = None if password_file is None else password_of(password_file)
    listener = taken(listen, tls_cert is not None, tuple(name or ()))
    place = listener.place
    if not place.local and password is None:
        raise VerbError(f"--listen {listen}: others reach it: give --password-file")
    token = secrets.token_urlsafe(24) if operate and password is None else None

    from pneud.web import serving  # noqa: PLC0415

    certificate = None
    if tls_cert is not None and tls_key is not None:
        certificate = serving.checked(serving.Certificate(tls_cert, tls_key))
    if metrics is not None:
        serving.write_metrics(metrics, "")
    who = (
        "who has this link commands" if token else "who has the password commands" if operate else "look only"
    )
    print(f"{place.url}{f'#{token}' if token else ''}  ({who}; Ctrl-C ends it)", flush=True)
    door = Door(place, password or token, operate)
    serving.serve(seen, socket, door, listener, certificate, metrics, programs)
    print("pneud: the page has ended", file=sys.stderr)
    return 0


def _axes(socket: str | None, axis: str | None) -> tuple[list[str], list[str]]:
    """The axes that are to be shown, and those of them that a page has the choice of.

    Raises:
        PlaceError: there is no daemon.
    """
    if axis is not None:
        return [axis], []
    with Client(socket) as client:
        names = list(client.ask("status").get("axes", ()))
    return (names, names) if names else ([""], [])
