"""A console with a loop's end that tests answer from."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from log_samples import tick_at
from pneud import crew, resources
from pneud.config.reading import load_config
from pneud.console import handoff
from pneud.console.beside import Beside
from pneud.console.commands import AxisDesk
from pneud.console.connected import BOUNDS, ClientBounds
from pneud.console.facts import RunFacts
from pneud.console.server import Server
from pneud.console.status_reply import StatusWatch
from pneud.log.live.ring import Ring
from pneud.signals import Answer, Request, State

CONFIG = resources.configs() / "virtual.toml"
PIECE = [0.5, *[0.0] * 8]
COMMANDS: dict[str, dict[str, Any]] = {  # fields of requests that have some
    "goto": {"x_mm": 100},
    "goto_all": {"axes": {"virtual": 100}},
    "jog": {"velocity_mm_s": 10},
    "force": {"force_n": 100},
    "track": {"what": "reference"},
    "upload": {"first": True, "pieces": [PIECE]},
    "probe": {"voltage_v": 1, "rate_v_s": 0.1, "travel_mm": 1, "speed_mm_s": 30, "force_n": 100},
    "mark": {"text": "x"},
    "tune_set": {"gains": {"k1": 1.0}},
}
LOOKS = ("status", "attach", "observe", "tune_get")


def at_once(work: Callable[[], None]) -> None:
    """Do what a console leaves to a thread."""
    work()


class Bench:
    """The console, its clients and its loop, all in one thread; time passes only where a test says so."""

    def __init__(
        self, folder: Path, bounds: ClientBounds = BOUNDS, config: Path = CONFIG, *, slow_files: bool = False
    ) -> None:
        self.now_s = 1000.0
        self.path = folder / "console.sock"
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(self.path))
        listener.listen(128)
        ours, loops = crew.pair()
        self.loop_socket = loops
        self.loop = handoff.LoopEnd(loops)
        self.ring = Ring.create(slots=64)
        self.watch = StatusWatch(self.ring)
        run = RunFacts(load_config(config), config, config.read_text(), "unixcan:x", "", "/tmp/x.mcap")
        self.said: list[str] = []
        desk = AxisDesk(run, self.ring, self.watch)
        self.server = Server(
            listener,
            ours,
            desk,
            lambda _, words: self.said.append(words),
            bounds,
            lambda: self.now_s,
            files=Beside(desk.read, lambda: self.now_s, *([] if slow_files else [at_once])),
        )
        self.requests: list[Request] = []  # that the loop has taken
        self.answer: Callable[[Request], int | None] = lambda _: Answer.TAKEN  # None: it does not answer
        self.state = State.HOLDING
        self.present = 0
        self.clients: list[socket.socket] = []

    def connect(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX)
        client.connect(str(self.path))
        client.settimeout(0.0)
        self.clients.append(client)
        return client

    def turn(self, turns: int = 6, timeout_s: float = 0.0) -> None:
        for _ in range(turns):
            self.server.step(timeout_s)
            request = self.loop.take()
            if request is not None:
                self.requests.append(request)
                answer = self.answer(request)
                if answer is not None:
                    tick = tick_at(1)._replace(answer=answer, state=int(self.state), present=self.present)
                    self.loop.answer(tick)

    def tell(self, client: socket.socket, *lines: bytes | dict[str, Any]) -> list[dict[str, Any]]:
        """Send lines, let the console work, and read its replies."""
        for line in lines:
            client.sendall(line if isinstance(line, bytes) else json.dumps(line).encode() + b"\n")
        self.turn()
        return self.replies(client)

    def tell_unheard(self, client: socket.socket, *lines: dict[str, Any]) -> None:
        """Send lines and let the console work, for a client that may go meanwhile."""
        client.sendall(b"".join(json.dumps(line).encode() + b"\n" for line in lines))
        self.turn()

    @staticmethod
    def replies(client: socket.socket) -> list[dict[str, Any]]:
        received = b""
        try:
            while data := client.recv(1 << 20):
                received += data
        except (BlockingIOError, ConnectionResetError):
            pass
        return [json.loads(line) for line in received.splitlines()]

    def ask(self, client: socket.socket, verb: str, **fields: Any) -> dict[str, Any]:
        """One request and its one reply."""
        (reply,) = self.tell(client, message(verb, **fields))
        return reply

    def error(self, client: socket.socket, verb: str, **fields: Any) -> str:
        """The type of the refusal."""
        reply = self.ask(client, verb, **fields)
        assert reply["ok"] is False
        kind: str = reply["error"]["type"]
        return kind


def message(verb: str, **fields: Any) -> dict[str, Any]:
    return {"v": 1, "id": 1, "verb": verb, **fields}


@contextmanager
def bench(
    folder: Path, bounds: ClientBounds = BOUNDS, config: Path = CONFIG, *, slow_files: bool = False
) -> Iterator[Bench]:
    b = Bench(folder, bounds, config, slow_files=slow_files)
    try:
        yield b
    finally:
        for client in b.clients:
            client.close()
        b.server.close()
        b.loop.close()


@contextmanager
def served(folder: Path, config: Path = CONFIG) -> Iterator[Bench]:
    """A console that works in the background and whose loop takes everything."""
    with bench(folder, config=config) as b:
        over = threading.Event()

        def work() -> None:
            while not over.is_set():
                b.turn(1, 0.001)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield b
        finally:
            over.set()
            thread.join()
