"""The way from the address that viewers know to the server that packs for them, with a door in it.

The server knows neither origins nor tokens: it listens where as few as possible can reach it, and whoever is
let through is passed on both ways as it is. Whoever does not read is waited for alone: a few buffers of its
data are held here, and the server drops the oldest of the messages that it keeps for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import fcntl
import os
import socket
import struct
import threading
from http import HTTPStatus
from typing import Any

from pneud import crew
from pneud.view.admission import Admission, Refusal

MOST_HEAD_BYTES = 16_384
HEAD_S = 5.0
MOST_CLIENTS = 32  # those at the door among them
_CHUNK = 65_536
_LINGER_S = 2.0  # for last words to somebody who has said all that he wants
_NEW_USER, _NEW_NET = 0x1000_0000, 0x4000_0000  # of unshare(2)
_SIOCSIFFLAGS, _IFF_UP = 0x8914, 1


def be_alone() -> bool:
    """Give this process a loopback network that no other process reaches; its sockets stay as they are.

    Returns:
        Whether the machine allows it; if not, nothing has changed.
    """
    trial = crew.fork(lambda: int(not _leave_the_network()))  # some machines allow the first step only
    return os.waitpid(trial, 0)[1] == 0 and _leave_the_network()


def _leave_the_network() -> bool:
    libc = ctypes.CDLL(None)
    if libc.unshare(_NEW_NET) and libc.unshare(_NEW_USER | _NEW_NET):
        return False
    try:
        with socket.socket() as any_socket:
            fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", _IFF_UP))
    except OSError:
        return False
    return True


def start_relay(listener: socket.socket, admission: Admission, port: int) -> None:
    """Let viewers in, from a thread that ends with the process."""
    relay = _Relay(listener, admission, port)
    threading.Thread(target=lambda: asyncio.run(relay.run()), daemon=True).start()


class _Relay:
    def __init__(self, listener: socket.socket, admission: Admission, port: int) -> None:
        self._listener = listener
        self._admission = admission
        self._port = port
        self._clients = 0

    async def run(self) -> None:
        asyncio.get_running_loop().set_exception_handler(_say)
        server = await asyncio.start_server(self._meet, sock=self._listener, limit=MOST_HEAD_BYTES)
        await server.serve_forever()

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients += 1
        try:
            with contextlib.suppress(OSError):  # whoever goes is no event
                asked = await self._asked(reader)
                if isinstance(asked, bytes):
                    await self._pass_on(asked, reader, writer)
                elif asked is not None:
                    await _refuse(reader, writer, *asked)
        finally:
            writer.close()
            with contextlib.suppress(OSError, TimeoutError):
                await asyncio.wait_for(writer.wait_closed(), _LINGER_S)
            writer.transport.abort()
            self._clients -= 1

    async def _asked(self, reader: asyncio.StreamReader) -> bytes | Refusal | None:
        """What somebody asks for, if it is let in; else why not, None for who has gone."""
        if self._clients > MOST_CLIENTS:
            return HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_CLIENTS} are looking"
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
        except asyncio.IncompleteReadError:
            return None
        except asyncio.LimitOverrunError:
            return HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "say less"
        except TimeoutError:
            return HTTPStatus.REQUEST_TIMEOUT, f"said too little in {HEAD_S:g} s"
        return self._admission.refusal(head) or head

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._port, limit=_CHUNK)
        try:
            inner_writer.write(head)
            ways = [
                asyncio.create_task(_pour(reader, inner_writer)),
                asyncio.create_task(_pour(inner_reader, writer)),
            ]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            await asyncio.wait(ways, timeout=_LINGER_S)
            for way in ways:
                way.cancel()
        finally:
            inner_writer.transport.abort()


async def _pour(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    """Pass on until the end of one, never faster than it is taken."""
    with contextlib.suppress(OSError):
        while data := await source.read(_CHUNK):
            sink.write(data)
            await sink.drain()
        sink.write_eof()
        await sink.drain()


async def _refuse(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, status: HTTPStatus, why: str
) -> None:
    body = f"pneud: {why}\n".encode()
    head = f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: text/plain; charset=utf-8\r\n"
    writer.write(f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
    writer.write_eof()
    with contextlib.suppress(
        TimeoutError
    ):  # what is closed with something unread may take the answer with it
        async with asyncio.timeout(_LINGER_S):
            while await reader.read(_CHUNK):
                pass


def _say(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Tell of mistakes; a machine without descriptors is none, and the loop goes on later."""
    if not isinstance(context.get("exception"), OSError):
        loop.default_exception_handler(context)
