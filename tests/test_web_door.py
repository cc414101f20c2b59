"""Who may look at the page, who may command, and where it may be."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from commands import pneud_forked
from pneud.web.admission import Door, Place, Session
from pneud.web.places import ListenError, listen, password_of

LOCAL = Place("127.0.0.1", 8770)
ELSEWHERE = Place("192.0.2.5", 8443, tls=True, names=("press.plant.example",))
SECRET = "correct horse"


def asked(host: str = "127.0.0.1:8770", **more: str) -> dict[str, list[str]]:
    return {"host": [host], **{name: [value] for name, value in more.items()}}


@pytest.mark.parametrize(
    ("place", "host", "here"),
    [
        *((LOCAL, name, True) for name in ("127.0.0.1:8770", "LOCALHOST:8770", "[::1]:8770")),
        *((LOCAL, name, False) for name in ("evil.example:8770", "127.0.0.1", "127.0.0.1:8771")),
        *((LOCAL, name, False) for name in ("", ":8770", "localhost.evil.example:8770", "[::1", "[]:8770")),
        *((LOCAL, name, False) for name in ("10.0.0.1:8770", "0.0.0.0:8770")),
        *((ELSEWHERE, name, True) for name in ("192.0.2.5:8443", "press.plant.example:8443")),
        *((ELSEWHERE, name, False) for name in ("localhost:8443", "other.example:8443")),
        (Place("192.0.2.5", 443, tls=True), "192.0.2.5", True),
        (Place("::1", 80), "[::1]", True),
    ],
)  # fmt: skip
def test_names_that_lead_here_by_a_trick_get_nothing(place: Place, host: str, here: bool) -> None:
    refusal = Door(place, None, False).refusal({"host": [host]})
    assert (refusal is None) is here


def test_one_host_is_said() -> None:
    door = Door(LOCAL, None, False)
    assert door.refusal({}) is not None
    assert door.refusal({"host": ["127.0.0.1:8770", "127.0.0.1:8770"]}) is not None


@pytest.mark.parametrize(
    ("origin", "passes"),
    [
        ("http://127.0.0.1:8770", True),
        *(
            (origin, False)
            for origin in ("http://localhost:8770", "https://127.0.0.1:8770", "http://127.0.0.1")
        ),
        *((origin, False) for origin in ("http://127.0.0.1:9000", "null", "", "http://evil.example:8770")),
    ],
)
def test_pages_of_other_origins_get_nothing(origin: str, passes: bool) -> None:
    assert (Door(LOCAL, None, False).refusal(asked(origin=origin)) is None) is passes


def test_on_this_machine_anybody_looks_and_nobody_commands() -> None:
    door = Door(LOCAL, None, operate=True)
    assert door.may_look(asked())
    assert not door.may_command("")
    assert not isinstance(door.enter("", "a", 0.0), Session)
    assert not door.may_command(None)


def test_who_knows_the_token_commands_and_no_cookie_does() -> None:
    door = Door(LOCAL, SECRET, operate=True)
    session = door.enter(SECRET, "a", 0.0)
    assert isinstance(session, Session)
    assert door.may_command(session.key)
    assert not any(
        door.may_command(word) for word in (session.cookie, SECRET, "", 3, None, ["x"], session.key[:-1])
    )


def test_without_operate_a_password_lets_one_look_alone() -> None:
    door = Door(ELSEWHERE, SECRET, operate=False)
    session = door.enter(SECRET, "a", 0.0)
    assert isinstance(session, Session)
    assert not door.may_command(session.key)
    host = "192.0.2.5:8443"
    assert not door.may_look(asked(host))
    assert door.may_look(asked(host, cookie=f"x=y; {door.cookie_name}={session.cookie}"))
    assert door.may_look(asked(host, authorization=f"Bearer {SECRET}"))
    for said in ("", session.key, SECRET, '"', "\x00"):
        assert not door.may_look(asked(host, cookie=f"{door.cookie_name}={said}"))
        assert not door.may_look(asked(host, authorization=f"Basic {said}"))
    assert door.cookie_name.startswith("__Host-"), "neither another path nor another name has set it"


def test_wrong_tries_wait_for_one_another() -> None:
    door = Door(LOCAL, SECRET, operate=True)
    assert door.enter("wrong", "a", 0.0) == (401, "that is not it")
    refused = door.enter(SECRET, "a", 0.5)
    assert not isinstance(refused, Session)
    assert refused[0] == 429
    assert isinstance(door.enter(SECRET, "b", 0.5), Session)
    assert isinstance(door.enter(SECRET, "a", 1.5), Session)
    for number in range(1000):
        door.enter("wrong", f"peer {number}", 2.0)
    assert len(door._wrong) < 300


def test_sessions_are_few() -> None:
    door = Door(LOCAL, SECRET, operate=True)
    found = [door.enter(SECRET, "a", 0.0) for _ in range(100)]
    keys = [session.key for session in found if isinstance(session, Session)]
    assert not door.may_command(keys[0])
    assert door.may_command(keys[-1])


# where it may be


@pytest.mark.parametrize(
    "where", ["8770", ":8770", "127.0.0.1", "127.0.0.1:x", "127.0.0.1:70000", "", "no.such.name.:1"]
)
def test_an_address_is_one(where: str) -> None:
    with pytest.raises(ListenError, match="--listen"):
        listen(where, False, ())


def test_others_reach_it_only_with_a_certificate() -> None:
    with pytest.raises(ListenError, match="--tls-cert"):
        listen("0.0.0.0:0", False, ())
    listener = listen("0.0.0.0:0", True, ("Press",))
    listener.socket.close()
    assert listener.place.names == ("press",)


def test_a_taken_port_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        with pytest.raises(ListenError) as e:
            listen(f"127.0.0.1:{taken.getsockname()[1]}", False, ())
        assert "cannot listen there: Address already in use; name another" in str(e.value)


def test_a_password_is_long_and_its_owner_s_alone(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("long enough indeed\nmore\n")
    file.chmod(0o644)
    with pytest.raises(ListenError, match="chmod 600"):
        password_of(file)
    file.chmod(0o600)
    assert password_of(file) == "long enough indeed"
    file.write_text("short")
    with pytest.raises(ListenError, match="12 letters"):
        password_of(file)


@pytest.mark.parametrize(
    ("words", "status", "says"),
    [
        (["--tls-cert", "x.pem"], 2, "belong together"),
        (["--metrics", "x.txt"], 2, ".prom"),
        (["--socket", "/nowhere.sock"], 3, "no daemon serves it"),
    ],
)
def test_a_mistake_is_one_line(words: list[str], status: int, says: str) -> None:
    done = pneud_forked("web", *words)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (status, "", 1), done.stderr
    assert says in done.stderr
