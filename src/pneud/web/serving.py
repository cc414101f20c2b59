"""The server's life: its socket, its certificate, those who come and say nothing, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import ssl
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame, Opcode
from websockets.protocol import State

from pneud.console.endpoint import find
from pneud.web.admission import Door
from pneud.web.app import LONGEST, Pages, Shown
from pneud.web.axis import Axis, statuses_of
from pneud.web.hand import Hand, Tell
from pneud.web.live import Gallery, Page
from pneud.web.metrics import text_of
from pneud.web.places import Listener
from pneud.web.programs import Programs
from pneud.web.reports import Reports

CONNECTIONS = 64
_HEAD_S = 5.0  # to say what one wants
_PIECES = 64  # of a message
_AT_ONCE = 64  # messages
_LINGER_S = 1.0  # for last words
_LONGEST_HEAD = 16_384
_END_S = 2
_FILE_S = 10.0  # between two writings of metrics
_NICE = 5


class Caller(H11Protocol):
    """Somebody who has connected, and has to say what for."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin; one too many ends at once."""
        if len(self.connections) >= CONNECTIONS:
            transport.abort()
            return
        super().connection_made(transport)
        self.loop.call_later(_HEAD_S, self._hurry)

    def _hurry(self) -> None:
        asked: Any = self.scope  # None until then, whatever its type says
        if asked is None:
            self.transport.abort()


class Line(WebSocketsSansIOProtocol):
    """A WebSocket, whose end waits for nobody, and on which nothing piles up, whatever comes."""

    _pieces = 0  # of the message that comes
    _framed: ClassVar[tuple[str, bytes]] = ("", b"")  # the text sent last, which others are sent as well

    def pause_writing(self) -> None:
        """What was sent is not read; uvicorn has this from 0.53 on."""
        self.writable.clear()

    def resume_writing(self) -> None:
        """It is, again."""
        self.writable.set()

    async def send(self, message: Any) -> None:
        """Send, or end; what all pages are sent is put into a frame once."""
        text = message.get("text")
        if text is None or not self.handshake_complete or self.conn.state is not State.OPEN:
            await super().send(message)
            return
        await self.writable.wait()
        if self.transport.is_closing() or self.close_sent:
            raise ClientDisconnected
        if Line._framed[0] is not text:
            frame = Frame(Opcode.TEXT, text.encode())
            Line._framed = text, frame.serialize(mask=False, extensions=[])
        self.transport.write(Line._framed[1])

    def handle_ping(self) -> None:
        """Answer, if the answers are read."""
        if self.writable.is_set():
            super().handle_ping()
        else:
            self.conn.data_to_send()

    def handle_cont(self, event: Frame) -> None:
        """One more piece of a message; pieces can be empty, and then no length bounds them."""
        self._pieces = 0 if event.fin else self._pieces + 1
        if self._pieces >= _PIECES:
            self.transport.abort()
        else:
            super().handle_cont(event)

    def send_receive_event_to_app(self) -> None:
        """A message is whole; of many at once none is for a page."""
        if self.queue.qsize() >= _AT_ONCE:
            self.transport.abort()
        else:
            super().send_receive_event_to_app()

    async def run_asgi(self) -> None:
        """Serve it."""
        await super().run_asgi()
        self.loop.call_later(_LINGER_S, self.transport.abort)


class Server(uvicorn.Server):
    """One that leaves signals to whoever runs it."""

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        """Take none."""
        yield


class Certificate(NamedTuple):
    """Of a place that others reach."""

    chain: Path
    key: Path


def checked(certificate: Certificate) -> Certificate:
    """A certificate that can be served with.

    Raises:
        OSError: a file cannot be read, or is none, or the two do not belong together.
    """
    for path in certificate:
        path.open("rb").close()
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
            certificate.chain, certificate.key, lambda: ""
        )
    except (ssl.SSLError, ValueError):
        why = "no certificate with its key beside it; a key with a passphrase cannot be used"
        raise OSError(None, why, str(certificate.chain), None, str(certificate.key)) from None
    return certificate


def serve(
    axes: Mapping[str, Axis],
    socket_path: str | None,
    door: Door,
    listener: Listener,
    certificate: Certificate | None,
    metrics: Path | None,
    programs: Path | None = None,
) -> None:
    """Serve until a signal says that it is enough.

    Args:
        axes: attached, by their names; the name of the only one may be empty.
        socket_path: of the daemon's console.
        door: who comes in.
        listener: where they come.
        certificate: for TLS.
        metrics: a file that is to have them, too.
        programs: a folder of those that pages may have gone through.
    """
    if not door.operate:  # a stop goes through here
        os.nice(_NICE)
    reports, listed, everybody = Reports(), Programs(programs), set[Page]()

    def hand_of(name: str) -> Callable[[Tell], Hand]:
        return lambda tell: Hand(lambda: find(socket_path), tell, name or None, listed)

    shown = {name: Shown(axis, Gallery(axis, everybody), hand_of(name)) for name, axis in axes.items()}
    app = Pages(shown, door, reports, listed).app()
    work: list[Callable[[], Coroutine[Any, Any, None]]] = []
    for one in shown.values():
        work += [one.axis.follow, one.gallery.paint]
    if metrics is not None:
        work.append(lambda: _write_metrics(axes, metrics))
    try:
        asyncio.run(_run(app, listener, certificate, work))
    finally:
        reports.close()
        for axis in axes.values():
            axis.close()
        if metrics is not None:
            metrics.unlink(missing_ok=True)


async def _run(
    app: ASGIApp,
    listener: Listener,
    certificate: Certificate | None,
    work: list[Callable[[], Coroutine[Any, Any, None]]],
) -> None:
    server = Server(
        uvicorn.Config(
            app,
            http=Caller,
            ws=Line,
            ws_max_size=LONGEST,
            ws_per_message_deflate=False,
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,  # a log of who asked for what would have keys in it, sooner or later
            proxy_headers=False,
            server_header=False,
            h11_max_incomplete_event_size=_LONGEST_HEAD,
            timeout_graceful_shutdown=_END_S,
            ssl_certfile=certificate.chain if certificate else None,
            ssl_keyfile=certificate.key if certificate else None,
        )
    )

    def leave() -> None:
        server.should_exit = True

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, leave)
    tasks = [asyncio.create_task(one()) for one in work]
    for task in tasks:
        task.add_done_callback(lambda _: leave())  # none of them ends by itself
    await server.serve(sockets=[listener.socket])
    ended = [task for task in tasks if task.done()]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    for task in ended:
        task.result()


async def _write_metrics(axes: Mapping[str, Axis], path: Path) -> None:
    """Keep a file of metrics, for ever."""
    while True:
        await asyncio.to_thread(write_metrics, path, text_of(statuses_of(axes.values())))
        await asyncio.sleep(_FILE_S)


def write_metrics(path: Path, text: str) -> None:
    """Put a file in its place whole; who reads all of a folder's .prom sees no other.

    Raises:
        OSError: it cannot be written.
    """
    beside = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        beside.write_text(text, encoding="utf-8")
        beside.chmod(0o644)
        beside.replace(path)
    except OSError:
        beside.unlink(missing_ok=True)
        raise
