"""A tree of NamedTuples as JSON, and back again to the bit.

It needs to know nothing of the records but their types, so that whoever gives them another field need not
think of the log. JSON has no number that is not finite: those are strings, "nan", "inf", "-inf".
"""

from __future__ import annotations

import json
import math
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints


class SnapshotError(Exception):
    """A tree is not one of the type that was asked for; the text says where it differs."""


def to_json(tree: Any) -> bytes:
    """A tree of NamedTuples, tuples, dicts, numbers, strings and None.

    Raises:
        TypeError: anything else in it.
    """
    return json.dumps(_plain(tree), separators=(",", ":"), allow_nan=False).encode()


def _plain(node: Any) -> Any:
    if isinstance(node, float):
        return node if math.isfinite(node) else repr(node)
    if isinstance(node, tuple):
        names = getattr(node, "_fields", None)
        if names is None:
            return [_plain(part) for part in node]
        return {name: _plain(part) for name, part in zip(names, node, strict=True)}
    if isinstance(node, dict):
        return {str(key): _plain(part) for key, part in node.items()}
    return node


def from_json(of: Any, data: bytes | str) -> Any:
    """A tree as it was; a field that is absent has its default.

    Args:
        of: type of the tree: numbers, strings, booleans, None, NamedTuples and tuples of such.
        data: JSON of it.

    Raises:
        SnapshotError: the JSON is none, or of another type.
    """
    try:
        found = json.loads(data)
    except ValueError as e:
        raise SnapshotError(f"not JSON: {e}") from None
    return _built(of, found, "")


@cache
def _hints(of: Any) -> dict[str, Any]:
    return get_type_hints(of)


def _built(of: Any, node: Any, where: str) -> Any:
    origin = get_origin(of)
    if origin in (Union, UnionType):
        return _one_of(get_args(of), node, where)
    if origin is tuple:
        return _tuple(get_args(of), node, where)
    if hasattr(of, "_fields"):
        return _record(of, node, where)
    if of is float:
        if isinstance(node, str) and node in ("nan", "inf", "-inf"):
            return float(node)
        if isinstance(node, float) or type(node) is int:  # as where an int was put into a float's place
            return node
    elif (of is NoneType and node is None) or (isinstance(of, type) and type(node) is of):
        return node
    elif isinstance(of, type) and issubclass(of, int) and type(node) is int:
        return of(node)
    raise SnapshotError(f"{where or 'it'}: {node!r} is no {getattr(of, '__name__', of)}")


def _record(of: Any, node: Any, where: str) -> Any:
    fields = set(of._fields)
    if not isinstance(node, dict) or not fields - set(of._field_defaults) <= set(node) <= fields:
        raise SnapshotError(f"{where or 'it'}: has not the fields of {of.__name__}")
    types = _hints(of)
    built = {name: _built(types[name], part, f"{where}.{name}".lstrip(".")) for name, part in node.items()}
    return of(**built)


def _tuple(of: tuple[Any, ...], node: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(node, list):
        raise SnapshotError(f"{where}: {node!r} is no list")
    if len(of) == 2 and of[1] is Ellipsis:
        of = of[:1] * len(node)
    if len(of) != len(node):
        raise SnapshotError(f"{where}: {len(node)} values in place of {len(of)}")
    return tuple(_built(t, part, f"{where}[{i}]") for i, (t, part) in enumerate(zip(of, node, strict=True)))


def _one_of(of: tuple[Any, ...], node: Any, where: str) -> Any:
    for alternative in of:
        try:
            return _built(alternative, node, where)
        except SnapshotError:
            continue
    raise SnapshotError(f"{where}: {node!r} is none of {', '.join(map(str, of))}")
