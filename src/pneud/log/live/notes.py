"""Words for the log from other processes, on their way to the recorder: one datagram each."""

import socket
import struct
import time
from typing import NamedTuple

_HEAD = struct.Struct("<qB")
_MOST_BYTES = 1024


class Note(NamedTuple):
    """One event in words."""

    t_ns: int  # CLOCK_MONOTONIC
    level: int  # a `Level`
    name: str
    words: str


class Teller:
    """One process that has something to say."""

    def __init__(self, end: socket.socket, name: str) -> None:
        """Speak through the teller's end of a `crew.pair`, as `name`."""
        self._end = end
        self._name = name
        self._lost = 0

    def say(self, level: int, words: str) -> None:
        """Say something; what the recorder has no room for is counted and told with the next words."""
        if self._lost:
            words = f"{words} ({self._lost} messages before this one are lost)"
        text = f"{self._name}\0{words}".encode(errors="replace")[:_MOST_BYTES]
        try:
            self._end.send(_HEAD.pack(time.monotonic_ns(), level) + text)
            self._lost = 0
        except OSError:
            self._lost += 1


class NotesListener:
    """The recorder's end."""

    def __init__(self, end: socket.socket) -> None:
        """Listen at the recorder's end of a `crew.pair`."""
        self._end = end
        self.gone = False
        """Whether the teller has left."""

    def poll(self) -> list[Note]:
        """What has been said since the last call."""
        heard: list[Note] = []
        while not self.gone:
            try:
                data = self._end.recv(_HEAD.size + _MOST_BYTES)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if len(data) < _HEAD.size:
                self.gone = True
                break
            t_ns, level = _HEAD.unpack_from(data)
            name, _, words = data[_HEAD.size :].decode(errors="replace").partition("\0")
            heard.append(Note(t_ns, level, name, words))
        return heard
