"""Who may look at a run, and that whoever comes to the door disturbs nobody behind it."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from commands import background, pneud_here
from pneud.daemon.places import viewers_place
from pneud.log.files.reader import read_log
from pneud.view import relay
from pneud.view.admission import Admission, is_origin

pytestmark = pytest.mark.realtime

KEY = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
UPGRADE = f"Host: axis\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{KEY}"
ASKS = f"{UPGRADE}Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n"
PATIENCE_S = 20.0


def head(target: str = "/", more: str = "", fields: str = ASKS) -> bytes:
    """A viewer's first words."""
    return f"GET {target} HTTP/1.1\r\n{fields}{more}\r\n".encode("latin-1")


def status(request: bytes, admission: Admission) -> int:
    refusal = admission.refusal(request)
    return 101 if refusal is None else refusal[0]


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        *((None, 101), ("https://app.foxglove.dev", 101), ("https://studio.foxglove.dev", 101)),
        ("file://", 101),
        *(("http://localhost", 101), ("http://localhost:8080", 101), ("https://127.0.0.1:8443", 101)),
        *(("http://[::1]:8080", 101), ("http://viewer.localhost", 101), ("https://mine.example", 101)),
        *(("https://evil.example", 403), ("null", 403), ("", 403), ("http://app.foxglove.dev", 403)),
        *(("https://app.foxglove.dev.evil.example", 403), ("https://localhost.evil.example", 403)),
        *(("http://localhost@evil.example", 403), ("http://evil.example#localhost", 403)),
        *(("http://127.0.0.1.evil.example", 403), ("http://0.0.0.0", 403), ("http://[::1", 403)),
        *(("http://evil.example/\xff", 403), ("http://localhost/x", 403), ("ws://localhost", 403)),
    ],
)  # fmt: skip
def test_pages_of_other_places_may_not_look(origin: str | None, expected: int) -> None:
    admission = Admission(None, Admission().origins | {"https://mine.example"})
    assert status(head(more="" if origin is None else f"Origin: {origin}\r\n"), admission) == expected
    if origin is not None:
        assert status(head(more=f"oRiGiN:{origin}\r\n"), admission) == expected
        twice = f"Origin: https://app.foxglove.dev\r\nOrigin: {origin}\r\n"
        assert status(head(more=twice), admission) == expected


@pytest.mark.parametrize(
    ("target", "more", "expected"),
    [
        *(("/?token=secret", "", 101), ("/?x=1&token=secret", "", 101)),
        ("/?token=old&token=secret", "", 101),
        *(("/", "Authorization: Bearer secret\r\n", 101), ("/", "", 401), ("/?token=", "", 401)),
        *(("/?token=Secret", "", 401), ("/?token=%ff", "", 401), ("/?token=secret%00", "", 401)),
        *(("/", "Authorization: Basic secret\r\n", 401), ("/", "Authorization: Bearer s\xe9cret\r\n", 401)),
        *(("/secret", "", 401), ("/#?token=secret", "", 401), ("//[?", "", 401)),
        ("/?" + "a&" * 5000, "", 401),
        ("/?token=secret", "Origin: https://evil.example\r\n", 403),
    ],
)  # fmt: skip
def test_where_others_reach_it_a_token_is_asked_for(target: str, more: str, expected: int) -> None:
    assert status(head(target, more), Admission("secret")) == expected


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        *((b"\r\n\r\n", 400), (b"POST / HTTP/1.1\r\n\r\n", 400), (b"GET / HTTP/1.0\r\n\r\n", 400)),
        *((head(more="no field\r\n"), 400), (head(more=" folded\r\n"), 400), (head(more="a:\nb\r\n"), 400)),
        *((head(more="a: b\nOrigin: https://evil.example\r\n"), 400), (head(more="a:\0\r\n"), 400)),
        *((head(fields="Host: axis\r\n"), 426), (head(fields="Upgrade: h2c\r\n"), 426)),
    ],
)
def test_what_is_no_request_of_a_viewer(request_: bytes, expected: int) -> None:
    assert status(request_, Admission()) == expected


def test_an_origin_is_what_a_browser_says() -> None:
    assert all(
        map(is_origin, ("https://example.org", "http://axis.local:8080", "app://", "http://[fe80::1]"))
    )
    assert not any(map(is_origin, ("example.org", "https://example.org/", "https://x y", "", "null")))


@contextlib.contextmanager
def behind(family: int = socket.AF_INET, admission: Admission | None = None) -> Iterator[tuple[str, int]]:
    """A relay before a server that says every byte again; yields its address."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def say(client: socket.socket) -> None:
            with client, contextlib.suppress(OSError):
                while data := client.recv(65536):
                    client.sendall(data)

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threading.Thread(target=say, args=(server.accept()[0],), daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        at = "127.0.0.1" if family == socket.AF_INET else "::1"
        listener = socket.create_server((at, 0), family=family)
        relay.start_relay(listener, admission or Admission(), server.getsockname()[1])
        try:
            yield listener.getsockname()[:2]
        finally:
            server.shutdown(socket.SHUT_RDWR)


def come(place: tuple[str, int], words: bytes) -> socket.socket:
    client = socket.create_connection(place, PATIENCE_S)
    client.sendall(words)
    return client


def everything(client: socket.socket) -> bytes:
    """What comes until the end."""
    with client:
        return b"".join(iter(lambda: client.recv(65536), b""))


def exactly(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := client.recv(size - len(data))):
        data += more
    return data


def refused(client: socket.socket) -> int:
    """The status of a refusal, which has one line."""
    answer, _, line = everything(client).partition(b"\r\n\r\n")
    assert line.startswith(b"pneud: ")
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert f"Content-Length: {len(line)}\r\n".encode() in answer
    return int(answer.split(b" ")[1])


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_who_is_let_in_is_passed_on_byte_by_byte(family: int) -> None:
    with behind(family, Admission("secret")) as place:
        words = head("/?token=secret") + bytes(range(256)) * 1000
        client = come(place, words)
        assert exactly(client, len(words)) == words
        client.sendall(b"more")
        client.shutdown(socket.SHUT_WR)  # and still hears what is said to it
        assert everything(client) == b"more"
        assert refused(come(place, head("/?token=wrong"))) == 401
        assert refused(come(place, head())) == 401
        assert refused(come(place, head("/?token=secret", "Origin: https://evil.example\r\n"))) == 403


def test_heads_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay, "HEAD_S", 0.3)
    with behind() as place:
        assert refused(come(place, head(more="X: " + "x" * 300_000))) == 431
        assert refused(come(place, b"x" * 300_000)) == 431
        slow = come(place, b"GET / HT")
        assert refused(slow) == 408
        gone = come(place, b"GET /")
        gone.shutdown(socket.SHUT_WR)
        assert everything(gone) == b""
        come(place, b"").close()
        client = come(place, head())
        assert exactly(client, len(head())) == head()
        client.close()


def test_there_is_room_for_so_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay, "MOST_CLIENTS", 2)
    monkeypatch.setattr(relay, "_LINGER_S", 0.2)
    with behind() as place:
        inside = [come(place, head()) for _ in range(2)]
        for client in inside:
            assert exactly(client, len(head())) == head()
        assert refused(come(place, head())) == 503
        for client in inside:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            client.close()  # with a reset
        deadline = time.monotonic() + PATIENCE_S
        while True:
            client = come(place, head())
            if exactly(client, 4) == b"GET ":
                break
            assert time.monotonic() < deadline
        client.close()


def test_who_does_not_read_holds_nobody_up() -> None:
    with behind() as place:
        deaf = come(place, head())
        deaf.setblocking(False)
        taken, quiet = 0, time.monotonic()
        while time.monotonic() - quiet < 0.5:
            with contextlib.suppress(BlockingIOError):
                taken += deaf.send(bytes(1 << 20))
                quiet = time.monotonic()
            time.sleep(0.001)
        assert taken < 64 << 20  # which the kernel's buffers hold, and a few of the relay's
        client = come(place, head())
        assert exactly(client, len(head())) == head()
        client.close()
        deaf.close()


def test_a_server_that_is_gone_closes_the_way() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    listener = socket.create_server(("127.0.0.1", 0))
    relay.start_relay(listener, Admission(), port)
    assert everything(come(listener.getsockname(), head())) == b""


def free_port(at: str = "127.0.0.1") -> int:
    family = socket.AF_INET6 if ":" in at else socket.AF_INET
    with socket.create_server((at, 0), family=family) as listener:
        port: int = listener.getsockname()[1]
        return port


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.10", "localhost", "[::1]"])
def test_this_machine_alone_needs_no_token(host: str) -> None:
    port = free_port()
    place = viewers_place(f"{host}:{port}", ("https://mine.example",))
    with place.listener:
        url = f"ws://{'127.0.0.1' if host == 'localhost' else host}:{port}"
        assert (place.admission.token, place.note) == (None, f"viewers look at {url}")
        assert parse_qs(urlsplit(place.link).query)["ds.url"] == [url]
        assert "https://mine.example" in place.admission.origins


@pytest.mark.parametrize(
    ("host", "named"), [("0.0.0.0", socket.gethostname()), ("[::]", socket.gethostname())]
)
def test_other_machines_are_told_the_url_with_its_token(host: str, named: str) -> None:
    port = free_port()
    tokens = set()
    for _ in range(2):
        place = viewers_place(f"{host}:{port}", ())
        with place.listener:
            assert place.note == f"viewers look at ws://{named}:{port}/?token={place.admission.token}"
            assert place.link == "", "the token is nobody else's business"
            tokens.add(place.admission.token)
    assert len(tokens) == 2


@pytest.mark.parametrize("origin", ["example.org", "https://example.org/", "two words", "*"])
def test_an_origin_that_is_none(origin: str) -> None:
    done = pneud_here("--virtual", "--live-at", f"127.0.0.1:{free_port()}", "--live-origin", origin)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "--live-origin" in line


@pytest.mark.slow
@pytest.mark.parametrize("host", ["0.0.0.0", "[::]"])
def test_a_run_is_watched_by_who_may(host: str, tmp_path: Path) -> None:
    port = free_port()
    log = tmp_path / "x.mcap"
    options = ("--virtual", "--headless", "--duration", 6, "--log", log, "--live-at", f"{host}:{port}")
    with background(*options) as process:
        assert process.stderr is not None
        note = next(line for line in process.stderr if "token=" in line)
        target = "/" + note.strip().rpartition("/")[2]
        place = ("127.0.0.1" if host == "0.0.0.0" else "::1", port)
        statuses = [refused(come(place, head())), refused(come(place, head("/?token=x")))]
        statuses += [refused(come(place, head(target, "Origin: https://evil.example\r\n")))]
        assert statuses == [401, 401, 403]
        clients = [come(place, head(target)) for _ in range(4)]  # none of which reads what it asks for
        for client in clients:
            assert exactly(client, 12) == b"HTTP/1.1 101"
        late = [come(place, b"GET / HT") for _ in range(20)]
        assert process.wait(PATIENCE_S * 2) == 0
        for client in (*clients, *late):
            client.close()
    ticks = list(read_log(log))
    assert len(ticks) > 5000
    assert sum(t.skipped for t in ticks) < 100


def test_the_server_is_on_a_network_of_its_own() -> None:
    """In a child, since there is no way back."""
    if os.geteuid():
        pytest.skip("root may; others may on some machines")
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        with contextlib.suppress(Exception):
            assert relay.be_alone()
            server = socket.create_server(("127.0.0.1", 0))
            come(server.getsockname(), b"x").close()
            os.write(writing, f"{server.getsockname()[1]}\n".encode())
            time.sleep(PATIENCE_S)
        os._exit(1)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        port = int(pipe.readline())
    try:
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.1", port), 1.0)
    finally:
        os.kill(child, 9)
        os.waitpid(child, 0)
