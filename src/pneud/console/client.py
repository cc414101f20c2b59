"""A client of the console: one request at a time, each with its reply."""

from __future__ import annotations

import array
import contextlib
import json
import os
import select
import socket
from typing import Any

from pneud.console.endpoint import PlaceError, find
from pneud.console.line_stream import VERSION, line

_PATIENCE_S = 5.0


class RefusedError(Exception):
    """The answer is no; the text is one line for a person, `error` what the console of `axis` said."""

    exit_code = 1

    def __init__(self, error: dict[str, Any], axis: str = "") -> None:
        super().__init__(str(error.get("message", error)))
        self.axis = axis
        self.error = error
        self.kind = str(error.get("type"))


class Reply(dict[str, Any]):
    """The fields of a reply; one that is missing says why."""

    def __missing__(self, field: str) -> Any:
        raise PlaceError(
            f"the daemon's answer has no {field!r}: it is of another version than this pneud; restart it"
        )


class Client:
    """A connection to a running daemon."""

    def __init__(self, socket_path: str | None = None, axis: str | None = None) -> None:
        """Connect to a socket, or to that of the daemon that runs.

        Args:
            socket_path: of the daemon.
            axis: that all requests are for, where it has several.

        Raises:
            PlaceError: there is no daemon, or several, or it may not be talked to.
        """
        self._axis = {"axis": axis} if axis is not None else {}
        self._connection = find(socket_path)
        self._connection.settimeout(_PATIENCE_S)
        self._received = b""
        self._number = 0
        self._descriptors: list[int] = []

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Hang up, which gives a lease back."""
        self._connection.close()
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._descriptors.clear()

    def fileno(self) -> int:
        """The descriptor of the connection."""
        return self._connection.fileno()

    def ask(self, verb: str, **fields: Any) -> dict[str, Any]:
        """Ask, and wait for the reply.

        Returns:
            The reply's fields.

        Raises:
            RefusedError: it is not done.
            PlaceError: the daemon has gone, or does not answer.
        """
        number = self.send(verb, **fields)
        while True:
            reply: dict[str, Any] = json.loads(self._line())
            if reply.get("ok"):
                if reply.pop("id") != number:
                    continue
                for key in ("v", "ok"):
                    del reply[key]
                return Reply(reply)
            if reply.get("id") in (number, None):
                raise RefusedError(reply["error"], str(reply.get("axis", "")))

    def send(self, verb: str, **fields: Any) -> int:
        """Ask without waiting.

        Returns:
            The number that the reply will have.
        """
        self._number += 1
        fields = {"v": VERSION, "id": self._number, "verb": verb, **self._axis, **fields}
        with contextlib.suppress(OSError):  # a refusal may lie there to be read
            self._connection.sendall(line(fields))
        return self._number

    def replies(self) -> list[dict[str, Any]]:
        """The replies to what was sent that have come by now.

        Raises:
            PlaceError: the daemon has gone.
        """
        found = []
        while b"\n" in self._received or select.select([self._connection], [], [], 0.0)[0]:
            found.append(json.loads(self._line()))
        return found

    def attach(self) -> tuple[dict[str, Any], int]:
        """The fields of `attach`, and the descriptor, which is the caller's to close.

        Raises:
            RefusedError: the daemon gives none.
            PlaceError: the daemon has gone, or does not answer.
        """
        fields = self.ask("attach")
        return fields, self._descriptors.pop()

    def _line(self) -> bytes:
        while b"\n" not in self._received:
            try:
                data, ancillary, _, _ = self._connection.recvmsg(65_536, socket.CMSG_SPACE(4))
            except TimeoutError:
                raise PlaceError("the daemon's console does not answer") from None
            except OSError:
                data, ancillary = b"", []
            if not data:
                raise PlaceError("the daemon's console has hung up")
            for level, kind, content in ancillary:
                if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
                    numbers = array.array("i")
                    numbers.frombytes(content[: len(content) - len(content) % numbers.itemsize])
                    self._descriptors.extend(numbers)
            self._received += data
        found, _, self._received = self._received.partition(b"\n")
        return found
