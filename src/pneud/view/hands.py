"""Keys, and what they ask of the console. A stop never waits, whatever else is being asked.

Knows neither terminal nor clock: keys come by name, and time as a number.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

_SPEEDS_MM_S = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
_JOG_LEASE_S = 0.3
_JOG_EVERY_S = 0.05  # keys repeat faster than a lease has to be renewed
_ASKING_S = 6.0
_LONGEST = 9  # characters of a position

KEYS = {  # name: as shown, in a word, in a line
    " ": ("space", "stop", "controlled stop, whatever it does and whoever commands"),
    "a": ("a", "arm", "engage and hold where it is (asks first)"),
    "d": ("d", "disarm", "come to rest, then centre the valve"),
    "c": ("c", "clear", "clear latched faults whose causes are gone"),
    "h": ("h", "hold", "come to rest and hold"),
    "g": ("g", "go to", "go to a position: millimetres, then Enter"),
    "m": ("m", "middle", "the same, with the middle of the travel filled in"),
    "t": ("t", "track", "follow the configured reference"),
    "r": ("r", "home", "find the encoder's reference (asks first)"),
    "left": ("← →", "jog", "move while the key repeats, 0.3 s for a press; + - choose the speed"),
    "+": ("+ -", "speed", ""),
    "l": ("l", "light", "colours for a light terminal, or a dark one"),
    "?": ("?", "help", "this page"),
    "q": ("q", "leave", ""),
}
_AT_ONCE = {"d": "disarm", "c": "clear", "h": "hold"}
_ASKED = {
    "a": ("arm", "Arm? The load is held, and may move."),
    "r": ("home", "Home? The load moves to its stop."),
}


class Operator(Protocol):
    """An end of the console."""

    @property
    def look_only(self) -> bool:
        """Whether it never commands."""

    @property
    def message(self) -> str:
        """What there is to say at the moment; empty for nothing."""

    @property
    def status(self) -> Mapping[str, Any]:
        """As the console told it last."""

    def ask(self, verb: str, **fields: Any) -> None:
        """Ask without waiting."""

    def attend(self, now_s: float) -> None:
        """Read what has come; to be called many times a second."""


class Leaving(NamedTuple):
    """What `q` does."""

    words: str
    leave: Callable[[], None] = lambda: None
    ends_view: bool = True  # else the view ends when the run has ended
    asks: str = ""  # before it does


class Hands:
    """What has been typed, and what has come of it.

    Attributes:
        over: `q` has been pressed.
        help: the page of keys is shown.
        light: colours for a light terminal are wanted.
    """

    def __init__(
        self, operator: Operator | None, leaving: Leaving, middle_mm: float, light: bool = False
    ) -> None:
        self.over = self.help = False
        self.light = light
        self.look_only = operator is None or operator.look_only
        self._operator = operator
        self._leaving = leaving
        self._middle_mm = middle_mm
        self._speed = _SPEEDS_MM_S.index(20.0)
        self._typed: str | None = None  # of a position
        self._asking = ""  # the key that asks first
        self._asked_s = self._jogged_s = -1e9
        self._now_s = 0.0

    def attend(self, now_s: float) -> None:
        """Let time pass."""
        self._now_s = now_s
        if self._asking and now_s > self._asked_s + _ASKING_S:
            self._asking = ""
        if self._operator is not None:
            self._operator.attend(now_s)

    @property
    def learnt(self) -> Any:
        """As the status has it; None where nobody has told."""
        return self._operator.status.get("learnt") if self._operator is not None else None

    @property
    def mileage(self) -> Any:
        """Likewise."""
        return self._operator.status.get("mileage") if self._operator is not None else None

    @property
    def others(self) -> str:
        """The other axes of the daemon, as the status has them; empty for none."""
        found = self._operator.status.get("others") or {} if self._operator is not None else {}
        return "".join(f" | {name} {state}" for name, state in found.items())

    @property
    def message(self) -> str:
        """What the console has said lately."""
        return self._operator.message if self._operator is not None else ""

    @property
    def prompt(self) -> str:
        """What is asked of the person; empty for nothing."""
        if self._typed is not None:
            return f"Go to: {self._typed}▏mm   Enter goes, Esc does not, space stops"
        if self._asking:
            words = self._leaving.asks if self._asking == "q" else _ASKED[self._asking][1]
            return f"{words}  y or Enter does, other keys do not"
        return ""

    def hints(self, wanted: tuple[str, ...]) -> list[tuple[str, str]]:
        """Keys as shown, with their words."""
        return [
            (KEYS[key][0], self._word(key)) for key in wanted if key in ("?", "q", "l") or not self.look_only
        ]

    def _word(self, key: str) -> str:
        if key == "q":
            return self._leaving.words
        return f"jog {_SPEEDS_MM_S[self._speed]:g} mm/s" if key == "left" else KEYS[key][1]

    def lines(self) -> list[tuple[str, str]]:
        """All keys with what they do."""
        lines = [(shown, line) for shown, _, line in KEYS.values() if line]
        return [*lines, ("q", f"{self._leaving.words}; Ctrl-C too")]

    def press(self, key: str) -> None:
        """Act on a key: a character, or left, right, enter, escape, backspace."""
        if key == " ":
            self._typed, self._asking = None, ""
            self._ask("stop")
        elif self._typed is not None:
            self._type(key)
        elif self._asking:
            asked, self._asking = self._asking, ""
            if key in ("y", "enter"):
                self._do(asked)
        elif self.help:
            self.help = False
        else:
            self._command(key)

    def _command(self, key: str) -> None:
        if key in ("q", "Q", "ctrl+d"):
            self._begin("q") if self._leaving.asks else self._do("q")
        elif key == "?":
            self.help = True
        elif key == "l":
            self.light = not self.light
        elif self.look_only:
            pass
        elif key in _AT_ONCE:
            self._ask(_AT_ONCE[key])
        elif key in _ASKED:
            self._begin(key)
        elif key == "t":
            self._ask("track", what="reference")
        elif key in ("g", "m"):
            self._typed = f"{self._middle_mm:g}" if key == "m" else ""
        elif key in ("left", "right"):
            self._jog(-1.0 if key == "left" else 1.0)
        elif key in ("+", "=", "-"):
            step = -1 if key == "-" else 1
            self._speed = min(max(self._speed + step, 0), len(_SPEEDS_MM_S) - 1)

    def _begin(self, key: str) -> None:
        self._asking, self._asked_s = key, self._now_s

    def _do(self, key: str) -> None:
        if key == "q":
            self.over = self._leaving.ends_view
            self._leaving.leave()
        else:
            self._ask(_ASKED[key][0])

    def _type(self, key: str) -> None:
        typed = self._typed or ""
        if key == "enter":
            self._typed = None
            with contextlib.suppress(ValueError):  # nothing, or no number
                self._ask("goto", x_mm=float(typed))
        elif key == "escape":
            self._typed = None
        elif key == "backspace":
            self._typed = typed[:-1]
        elif key in "0123456789.-" and len(typed) < _LONGEST:
            self._typed = typed + key

    def _jog(self, direction: float) -> None:
        if self._now_s >= self._jogged_s + _JOG_EVERY_S:
            self._jogged_s = self._now_s
            velocity = direction * _SPEEDS_MM_S[self._speed]
            self._ask("jog", velocity_mm_s=velocity, lease_s=_JOG_LEASE_S)

    def _ask(self, verb: str, **fields: Any) -> None:
        if self._operator is not None and not self.look_only:
            self._operator.ask(verb, **fields)
