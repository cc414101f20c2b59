"""Tell a broker how a running daemon is: the facts of its metrics, as JSON; commands nothing."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from pneud.console.client import Client
from pneud.rt.extras import require
from pneud.verbs import AxisOption, SocketOption

_PASSWORD = "PNEUD_MQTT_PASSWORD"
_NICE = 5


def mqtt(
    broker: Annotated[
        str,
        typer.Option(
            "--broker",
            metavar="URL",
            envvar="PNEUD_MQTT_BROKER",
            help="mqtt://HOST[:PORT], or mqtts:// for TLS.",
        ),
    ] = "mqtt://localhost",
    topic: Annotated[
        str | None,
        typer.Option("--topic", metavar="TOPIC", help="What all stands under; default pneud/NAME."),
    ] = None,
    every: Annotated[
        float, typer.Option("--every", metavar="S", min=0.1, max=3600.0, help="How often to look.")
    ] = 1.0,
    user: Annotated[
        str | None,
        typer.Option(
            "--user", metavar="NAME", envvar="PNEUD_MQTT_USER", help="Who is to be let in by the broker."
        ),
    ] = None,
    password_file: Annotated[
        Path | None,
        typer.Option(
            "--password-file", metavar="FILE", help=f"Its first line is the password; else ${_PASSWORD}."
        ),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Send a password without TLS, for all on the way to read.")
    ] = False,
    tls_ca: Annotated[
        Path | None,
        typer.Option("--tls-ca", metavar="FILE", help="Who vouches for the broker; default the system's."),
    ] = None,
    tls_cert: Annotated[
        Path | None, typer.Option("--tls-cert", metavar="FILE", help="Certificate for the broker to see.")
    ] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", metavar="FILE", help="Its key.")] = None,
    axis: AxisOption = None,
    socket: SocketOption = None,
) -> int:
    """Publish until Ctrl-C.

    Returns:
        Exit status: 0.

    Raises:
        ExtraError: a library is missing.
        PlaceError: there is no daemon.
        BrokerError: there can be no such broker.
        TopicError: nor such a topic.
    """
    require("mqtt", "mqtt")

    from pneud.mqtt.broker import broker_of, password_of  # noqa: PLC0415 - who has made a mistake is told at once
    from pneud.mqtt.facts import checked, level  # noqa: PLC0415

    password = os.environ.get(_PASSWORD) if password_file is None else password_of(password_file)
    found = broker_of(broker, user, password, tls_ca, tls_cert, tls_key, plain=plain)
    if topic is not None:
        checked(topic)
    with Client(socket, axis) as client:
        client.ask("observe")
        name = str(client.ask("status")["name"])
    under = topic or f"pneud/{level(name)}"

    from pneud.mqtt.bridge import Bridge, Daemon  # noqa: PLC0415

    print(f"{found.url} {under}  (Ctrl-C ends it)", flush=True)
    os.nice(_NICE)
    daemon = Daemon(lambda: Client(socket, axis))
    try:
        asyncio.run(Bridge(daemon, found, under, every).run())
    finally:
        daemon.close()
    print("pneud: nothing is published any more", file=sys.stderr)
    return 0
