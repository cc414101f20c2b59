"""Copies of functions that call something else."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any


def rebound(function: types.FunctionType, by: Mapping[Any, Callable[..., Any]]) -> types.FunctionType:
    """A copy of a function that calls `by[f]` wherever it, or a function of this package below it, calls f.

    Args:
        function: a function or method of a module; not changed.
        by: what to call in place of functions.
    """
    return _rebound(function, by, {})


def _rebound(
    function: types.FunctionType,
    by: Mapping[Any, Callable[..., Any]],
    done: dict[types.FunctionType, types.FunctionType],
) -> types.FunctionType:
    if function in done:
        return done[function]
    scope = dict(function.__globals__)
    copy = types.FunctionType(function.__code__, scope, function.__name__, function.__defaults__)
    copy.__kwdefaults__ = function.__kwdefaults__
    done[function] = copy
    for name in names_of(function.__code__):
        value = scope.get(name)
        if isinstance(value, types.FunctionType) and ours(value.__module__):
            scope[name] = by[value] if value in by else _rebound(value, by, done)
        elif isinstance(value, types.ModuleType) and ours(value.__name__):
            functions = {key: f for key, f in vars(value).items() if isinstance(f, types.FunctionType)}
            scope[name] = types.SimpleNamespace(
                **{**vars(value), **{key: by[f] for key, f in functions.items() if f in by}}
            )
    return copy


def ours(module: str) -> bool:
    """Whether a module belongs to this package."""
    return module == "pneud" or module.startswith("pneud.")


def names_of(code: types.CodeType) -> Iterator[str]:
    """All global names and attributes that code may use."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from names_of(constant)
