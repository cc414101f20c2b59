"""Keys of the screen: what they ask of the console, what asks first, and that a stop never waits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.console.client import Client
from pneud.console.endpoint import PlaceError
from pneud.console.operator import Operator
from pneud.view.hands import KEYS, Hands, Leaving
from pneud.view.terminal import keys_in


class Asked:
    """An operator who notes what is asked."""

    def __init__(self, look_only: bool = False) -> None:
        self.look_only = look_only
        self.message = ""
        self.status: dict[str, Any] = {}
        self.verbs: list[tuple[str, dict[str, Any]]] = []

    def ask(self, verb: str, **fields: Any) -> None:
        self.verbs.append((verb, fields))

    def attend(self, now_s: float) -> None:
        pass


def hands(operator: Asked | None, leaving: Leaving | None = None) -> Hands:
    return Hands(operator, leaving or Leaving("leave"), 500.0)


def pressed(keys: str | list[str], operator: Asked | None = None) -> list[tuple[str, dict[str, Any]]]:
    operator = operator or Asked()
    found = hands(operator)
    for key in keys:
        found.press(key)
    return operator.verbs


@pytest.mark.parametrize(
    ("keys", "asked"),
    [
        (" ", [("stop", {})]),
        ("d", [("disarm", {})]),
        ("c", [("clear", {})]),
        ("h", [("hold", {})]),
        ("t", [("track", {"what": "reference"})]),
        ("a", []),
        ("ay", [("arm", {})]),
        (["a", "enter"], [("arm", {})]),
        ("aa", []),  # as a key repeats that is held too long
        ("ah", []),
        ("ry", [("home", {})]),
        (["g", *"120.5", "enter"], [("goto", {"x_mm": 120.5})]),
        (["g", *"12", "backspace", "5", "enter"], [("goto", {"x_mm": 15.0})]),
        (["g", "enter"], []),
        (["g", "1", "escape", "enter"], []),
        (["g", *"ada", "enter"], []),  # letters are no numbers, and no commands meanwhile
        (["m", "enter"], [("goto", {"x_mm": 500.0})]),
        (["left"], [("jog", {"velocity_mm_s": -20.0, "lease_s": 0.3})]),
        (["+", "right"], [("jog", {"velocity_mm_s": 50.0, "lease_s": 0.3})]),
        (["-", "-", "right"], [("jog", {"velocity_mm_s": 5.0, "lease_s": 0.3})]),
        ("?d", []),  # the first key only leaves the help
        ("?dd", [("disarm", {})]),
        ("xyz%", []),
    ],
)
def test_what_a_key_asks(keys: str | list[str], asked: list[tuple[str, dict[str, Any]]]) -> None:
    assert pressed(keys) == asked


@settings(deadline=None)
@given(st.lists(st.sampled_from([*KEYS, "y", "1", "enter", "escape", "backspace", "right", "%"]), max_size=9))
def test_space_stops_whatever_has_been_pressed_before(before: list[str]) -> None:
    found = pressed([*before, " "])
    assert found[-1] == ("stop", {})
    assert found.count(("stop", {})) == before.count(" ") + 1


def test_a_stop_takes_back_what_was_being_asked() -> None:
    assert pressed(["a", " ", "y"]) == [("stop", {})]
    assert pressed(["g", "1", " ", "enter"]) == [("stop", {})]


def test_a_question_is_forgotten_after_a_while() -> None:
    operator = Asked()
    found = hands(operator)
    found.attend(100.0)
    found.press("a")
    assert found.prompt.startswith("Arm?")
    found.attend(107.0)
    assert found.prompt == ""
    found.press("y")
    assert operator.verbs == []


def test_a_jog_is_renewed_no_more_often_than_it_has_to_be() -> None:
    operator = Asked()
    found = hands(operator)
    for tick in range(100):  # a second of a key that repeats
        found.attend(10.0 + tick * 0.01)
        found.press("right")
    assert 15 <= len(operator.verbs) <= 21


def test_who_only_looks_commands_nothing() -> None:
    keys = [*KEYS, "y", "right", *"12", "enter"]
    operator = Asked(look_only=True)
    assert pressed(keys, operator) == []
    found = hands(None)
    for key in [*keys, "q"]:
        found.press(key)
    assert found.over
    assert found.hints((" ", "a", "?", "q")) == [("?", "help"), ("q", "leave")]


def test_leaving_may_ask_first_and_may_wait_for_the_run_to_end() -> None:
    ended: list[int] = []
    found = hands(Asked(), Leaving("end", lambda: ended.append(1), ends_view=False, asks="End?"))
    found.press("q")
    assert (found.prompt[:4], ended) == ("End?", [])
    found.press("x")
    found.press("q")
    found.press("y")
    assert (ended, found.over) == ([1], False)


def test_every_key_is_explained() -> None:
    found = hands(Asked())
    shown = {key for key, _ in found.lines()}
    assert shown >= {KEYS[key][0] for key in KEYS if key != "+"}
    assert all(len(f"  {line}") + 10 <= 80 for _, line in found.lines())


def test_what_a_terminal_sends_is_cut_into_keys() -> None:
    assert keys_in(b"a \x1b[D\x1bOC\r\x7f") == ["a", " ", "left", "right", "enter", "backspace"]
    assert keys_in(b"\x1b") == ["escape"]
    # an answer of the terminal, and keys that mean nothing here, are no commands
    assert keys_in(b"\x1b[?62;22c\x1b[200~\x1b[1;5D\x1bOP") == []
    assert keys_in("µä".encode()) == []


class Gone(Client):
    """A connection that has been hung up."""

    def __init__(self) -> None:
        pass

    def send(self, verb: str, **fields: Any) -> int:
        return 0

    def replies(self) -> list[dict[str, Any]]:
        raise PlaceError("the daemon's console has hung up")

    def close(self) -> None:
        pass


class Line(Gone):
    """One with an answer."""

    def __init__(self, *answers: dict[str, Any]) -> None:
        self.answers = list(answers)
        self.sent: list[str] = []

    def send(self, verb: str, **fields: Any) -> int:
        self.sent.append(verb)
        return len(self.sent)

    def replies(self) -> list[dict[str, Any]]:
        found, self.answers = self.answers, []
        return found


def in_turn(*clients: Client | None) -> Callable[[], Client]:
    """Connects to one after the other; None is nobody."""
    left = list(clients)

    def connect() -> Client:
        found = left.pop(0)
        if found is None:
            raise PlaceError("no running daemon found")
        return found

    return connect


def test_a_lost_console_is_looked_for_and_named_only_where_it_stays_away() -> None:
    line = Line()
    operator = Operator(in_turn(None, None, line), Gone())
    for now_s, message in ((10.0, False), (11.5, False), (12.6, True), (13.7, False)):
        operator.attend(now_s)
        assert bool(operator.message) == message, now_s
    operator.ask("stop")
    assert line.sent == ["status", "stop"]


def test_a_key_that_nobody_hears_says_so_at_once() -> None:
    operator = Operator(in_turn(None, None))
    operator.attend(5.0)
    operator.ask("stop")
    assert operator.message == "nobody hears keys: no running daemon found"


def test_refusals_are_told_for_a_few_seconds() -> None:
    line = Line({"ok": False, "error": {"type": "busy", "message": "another client commands"}})
    operator = Operator(in_turn(), line)
    operator.attend(5.0)
    assert operator.message == "another client commands"
    operator.attend(10.0)
    assert operator.message == "another client commands"
    operator.attend(12.0)
    assert operator.message == ""
