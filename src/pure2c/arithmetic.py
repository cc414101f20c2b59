"""Arithmetic in C that gives Python's numbers, and sets `failed_` where Python would raise."""

from __future__ import annotations

import ast
import builtins
import math
from collections.abc import Sequence
from typing import Any

from pure2c.types import TranslationError, Typed, is_whole

_BINARY = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.BitOr: "|", ast.BitAnd: "&"}
_WHOLE = {ast.Add: "plus_", ast.Sub: "minus_", ast.Mult: "times_"}  # of integers, which Python lets grow
_MATH = frozenset(
    ("atan", "atan2", "copysign", "cos", "exp", "expm1", "log", "log1p", "pow", "sin", "sqrt", "tanh")
)


def number(value: Any) -> str:
    """A number in C, exact to the last bit.

    Raises:
        TranslationError: it is none, or an integer that C does not have.
    """
    if isinstance(value, int) and is_whole(value):
        return f"{int(value)}L"
    if not isinstance(value, float):
        raise TranslationError(f"{value!r} has no counterpart in C")
    if math.isnan(value):
        return "NAN"
    return value.hex() if math.isfinite(value) else ("INFINITY" if value > 0 else "-INFINITY")


def binary(a: Typed, op: ast.operator, b: Typed) -> Typed | None:
    """Two numbers put together; None for an operator that has no counterpart."""
    if isinstance(op, ast.Div):
        return Typed(f"over_({a.code}, {b.code})", float)
    if isinstance(op, ast.Pow) and float in (a.type, b.type):
        return Typed(f"finite_(pow({a.code}, {b.code}))", float)
    if isinstance(op, ast.LShift) and a.type is int and b.type is int:
        return Typed(f"shifted_({a.code}, {b.code})", int)
    sign = _BINARY.get(type(op))
    if sign is None or {a.type, b.type} - {int, float}:
        return None
    if a.type is int and b.type is int and type(op) in _WHOLE:
        return Typed(f"{_WHOLE[type(op)]}({a.code}, {b.code})", int)
    if a.type == b.type:
        return Typed(f"({a.code} {sign} {b.code})", a.type)
    return Typed(f"((double){a.code} {sign} (double){b.code})", float)


def builtin(called: Any, args: Sequence[Typed]) -> Typed | None:
    """What a function of `math` or of Python's own makes of numbers; None for one that has no counterpart."""
    codes = [a.code for a in args]
    name = str(called.__name__)
    if called in (builtins.max, builtins.min):
        whole = all(a.type is int for a in args)
        code = codes[0]
        for other in codes[1:]:
            code = f"{name}_{'int_' if whole else ''}({code}, {other})"
        return Typed(code, int if whole else float)
    if called is builtins.abs:
        return Typed(f"fabs({codes[0]})" if args[0].type is float else f"labs({codes[0]})", args[0].type)
    if called is builtins.round and len(codes) == 1:
        return Typed(f"whole_(rint({codes[0]}))", int)
    if called in (math.ceil, math.floor):
        return Typed(f"whole_({name}({codes[0]}))", int)
    if called is bool:
        return Typed(f"({codes[0]} != 0)", int)
    if called is float:
        return Typed(f"((double){codes[0]})", float)
    if called is math.isfinite:
        return Typed(f"(isfinite({codes[0]}) != 0)", int)
    if name in _MATH and getattr(math, name) is called:
        return Typed(f"finite_({name}({', '.join(codes)}))", float)
    return None
