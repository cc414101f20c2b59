"""Types that values of translated functions may have."""

from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

Type = Any
"""float, int (bool is one), a NamedTuple, a tuple of types, `Maybe`, `Many`, or object for anything else."""


@dataclass(frozen=True)
class Maybe:
    """The type of a value that may be None."""

    of: Type


@dataclass(frozen=True)
class Many:
    """The type of a tuple of records, which stay where they are until one is looked at."""

    of: Type


PLAIN = {float: "double", int: "long", object: "struct _object *"}
"""What is no structure in C."""

MOST = (1 << 63) - 1
"""The greatest integer in C; all bits of those that are not negative."""


class BuildError(Exception):
    """There is no compiled version; the text is one line for a person."""

    exit_code = 3  # of a program that cannot do without


class TranslationError(BuildError):
    """Something has no counterpart in C."""


VALUE, PASSING, LASTING = 0, 1, 2
"""What an expression is in C: a value, the place of one that may change, or of one that stays as it is."""


class Typed(NamedTuple):
    """An expression in C."""

    code: str
    type: Type
    place: int = VALUE


def is_whole(value: int) -> bool:
    """Whether an integer can be written as one in C."""
    return -MOST <= value <= MOST


def are_rows(value: object) -> bool:
    """Whether it is a tuple of tuples of numbers."""
    rows = value if isinstance(value, tuple) else (value,)
    return all(isinstance(row, tuple) and all(type(number) in (int, float) for number in row) for row in rows)


def fields_of(t: Type) -> list[tuple[str, Type]]:
    """Names and types of what a NamedTuple class or a tuple of types holds."""
    if isinstance(t, Maybe):
        return [("some", int), ("value", t.of)]
    if isinstance(t, Many):
        raise TranslationError(f"{t!r} has no parts")
    if isinstance(t, tuple):
        return [(f"f{i}", inner) for i, inner in enumerate(t)]
    if not hasattr(t, "_fields"):
        raise TranslationError(f"{t!r} has no parts")
    hints = get_type_hints(t)
    return [(name, plain(hints[name])) for name in t._fields]


def is_flat(t: Type) -> bool:
    """Whether it is a record of numbers, and of records of numbers."""
    if t in (float, int):
        return True
    return isinstance(t, type) and hasattr(t, "_fields") and all(is_flat(of) for _, of in fields_of(t))


def are_numbers(t: Type) -> bool:
    """Whether it holds numbers alone: what else it holds is never looked at where it is not there."""
    if t in PLAIN or isinstance(t, Many):
        return t in (float, int)
    return all(are_numbers(of) for _, of in fields_of(t))


def columns(t: Type, before: str = "") -> list[tuple[str, str]]:
    """Names and formats of the numbers of a flat record as they lie in C, one after another, of 8 bytes each.

    Args:
        t: the record; numbers of records in it are named with a dot.
        before: what their names begin with.
    """
    found = []
    for name, of in fields_of(t):
        found += (
            [(before + name, "<f8" if of is float else "<i8")]
            if of in PLAIN
            else columns(of, f"{before}{name}.")
        )
    return found


def plain(hint: Any) -> Type:
    """The type that an annotation stands for."""
    if hint is float:
        return float
    if get_origin(hint) in (Union, UnionType):
        some = [inner for inner in get_args(hint) if inner is not NoneType]
        return Maybe(plain(some[0])) if len(some) == 1 else object
    if get_origin(hint) is tuple:
        inside = get_args(hint)
        if Ellipsis in inside:
            return Many(plain(inside[0])) if hasattr(inside[0], "_fields") else object
        return tuple(plain(inner) for inner in inside)
    if isinstance(hint, type) and issubclass(hint, int):
        return int
    if isinstance(hint, type) and hasattr(hint, "_fields"):
        return hint
    return object
