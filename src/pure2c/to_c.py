"""Pure functions as C that computes the same to the last bit.

It takes what the law is written in: functions on floats, ints, bools and NamedTuples of them or of None, with
`math`, `if`, `for`, `while` and tuples. Signatures have types; those of local names follow from their first
value. Objects of other types may be passed on, and that is all.

Where Python would raise (a division by zero, a power that overflows), the C goes on with some number and sets
`failed_`: what it then returns is void. So it does where it comes to a statement that has no counterpart: the
rest of that block is left out. Hence a function may do in some rare branch what only Python can.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_type_hints

from pure2c.arithmetic import number
from pure2c.expressions import LOCAL
from pure2c.statements import Function
from pure2c.types import LASTING, PLAIN, Many, Maybe, TranslationError, Type, Typed, fields_of, plain

_HELPERS = Path(__file__).with_name("helpers.h")


class Translator:
    """Collects structures and functions; `text` is all of them in order."""

    def __init__(self) -> None:
        self._structs: dict[Any, str] = {}
        self._functions: dict[Any, str] = {}
        self._kept: dict[tuple[str, str], str] = {}
        self.lending: set[Any] = set()  # functions that may return a place that they have been given
        self._parts: list[str] = []

    def text(self) -> str:
        """The C source."""
        return "\n".join([_HELPERS.read_text(), *self._parts])

    def function(self, f: Callable[..., Any], name: str = "") -> str:
        """Translate a function and all that it calls.

        Args:
            f: the function.
            name: what to call it in C, for a caller in C who gives and gets records as they are; else it is
                called by its own name with its module's before it, gets them by reference, and a place for
                the one that it returns before them.

        Raises:
            TranslationError: it does something that is not provided for.
        """
        if f not in self._functions:
            if not isinstance(f, types.FunctionType):
                raise TranslationError(f"{f!r} is no plain function")
            own = f"{f.__module__.rpartition('.')[2]}_{f.__name__}"
            taken = self._functions.values()
            self._functions[f] = own if own not in taken else f"{own}_{len(taken)}"
            try:
                self._parts.append(Function(self, f).text(self._functions[f]))
            except TranslationError:
                del self._functions[f]
                raise
        if name:
            self._parts.append(self._by_value(f, name))
        return name or self._functions[f]

    def _by_value(self, f: Callable[..., Any], name: str) -> str:
        """A function that takes and gives records as they are."""
        hints = {n: plain(hint) for n, hint in get_type_hints(f).items()}
        result = hints.pop("return")
        given = ", ".join(f"{self.type(t)} {LOCAL}{n}" for n, t in hints.items())
        passed = [f"{'' if t in PLAIN else '&'}{LOCAL}{n}" for n, t in hints.items()]
        head, own = f"static {self.type(result)} {name}({given}) {{\n", self._functions[f]
        if result in PLAIN:
            return f"{head}  return {own}({', '.join(passed)});\n}}\n"
        return f"{head}  {self.type(result)} made_;\n  return *{own}({', '.join(('&made_', *passed))});\n}}\n"

    def result(self, f: Callable[..., Any]) -> Type:
        """What a function returns."""
        return plain(get_type_hints(f)["return"])

    def kept(self, value: Any, t: Type) -> Typed:
        """A constant: a number, or the place of one that is kept.

        Raises:
            TranslationError: it is none of numbers, or not of that type.
        """
        literal = self.literal(value, t)
        if t in PLAIN:
            return Typed(literal, t)
        c = self.type(t)
        if (c, literal) not in self._kept:
            name = self._kept[c, literal] = f"kept_{len(self._kept)}"
            self._parts.append(f"static const {c} {name} = {literal};\n")
        return Typed(self._kept[c, literal], t, LASTING)

    def nothing(self, t: Type) -> str:
        """A record of zeros, for a name that has not been given anything."""
        return f"nothing_{self.type(t)}"

    def constant(self, name: str, value: Any) -> None:
        """Define a constant NamedTuple."""
        self._parts.append(f"static const {self.type(type(value))} {name} = {self.literal(value)};\n")

    def type(self, t: Type) -> str:
        """The C type for a type; defines structures at their first use."""
        if t in PLAIN:
            return PLAIN[t]
        if t not in self._structs:
            if isinstance(t, Many):  # Python's tuple, or a constant of C's own
                members = [("long", "count"), (PLAIN[object], "tuple"), (f"const {self.type(t.of)}", "*at")]
            else:
                members = [(self.type(inner), field) for field, inner in fields_of(t)]
            name = t.__name__ if isinstance(t, type) else type(t).__name__
            if name in ("tuple", *self._structs.values()) or not isinstance(t, type):
                name = f"{name}_{len(self._structs)}"
            self._structs[t] = name
            inside = " ".join(f"{member} {field};" for member, field in members)
            self._parts.append(
                f"typedef struct {{ {inside} }} {name};\nstatic const {name} nothing_{name};\n"
            )
            if isinstance(t, Many):
                self._parts.append(f"static {self.type(t.of)} {self.item(t)}({name} x, long i);\n")
        return self._structs[t]

    def item(self, t: Many) -> str:
        """The C function that gets one of many; whoever knows where they are has to define it."""
        return f"item_{self.type(t)}"

    def many(self) -> list[Many]:
        """All types of tuples of records that have occurred."""
        return [t for t in self._structs if isinstance(t, Many)]

    def literal(self, value: Any, t: Type = None) -> str:
        """A value in C, exact to the last bit; a tuple that is no record needs its type.

        Raises:
            TranslationError: it is none of numbers, or not of that type.
        """
        if isinstance(t, Maybe):
            return "{0}" if value is None else f"{{1, {self.literal(value, t.of)}}}"
        if isinstance(t, Many) and isinstance(value, tuple):
            if not value:
                return "{0}"
            c, listed = self.type(t.of), ", ".join(self.literal(v, t.of) for v in value)
            name = f"many_{len(self._parts)}"
            self._parts.append(f"static const {c} {name}[] = {{{listed}}};\n")
            return f"{{{len(value)}, 0, {name}}}"
        if isinstance(value, tuple):
            members = fields_of(type(value) if hasattr(value, "_fields") else t)
            if len(members) != len(value):
                raise TranslationError(f"{value!r} is not of the type {t!r}")
            return (
                "{" + ", ".join(self.literal(v, of) for (_, of), v in zip(members, value, strict=True)) + "}"
            )
        if t is float and isinstance(value, int):
            value = float(value)  # a float's place may hold an integer
        return number(value)
