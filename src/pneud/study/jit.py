"""The project's own pure functions, compiled: the same code, so the same results to the last bit."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

from pneud.rt.extras import require

F = TypeVar("F", bound=Callable[..., Any])

_compiled: dict[types.FunctionType, Any] = {}


class JitError(Exception):
    """A function cannot be compiled; the text is one line for a person."""


def jitted(function: F) -> F:
    """The compiled version of a pure function and of every pneud function that it calls.

    The function is not changed: a copy gets globals in which the functions of this package are replaced by
    their compiled versions. Constants are frozen as they are now. Results are those of the interpreter
    (no fastmath). Compilation itself happens at the first call.

    Args:
        function: a function of a module, on numbers and NamedTuples.

    Raises:
        ExtraError: numba is missing.
        JitError: this is no plain function, or it calls itself.
    """
    require("to compile it", "sim")
    import numba  # noqa: PLC0415  (an extra, and half a second to import)

    return cast(F, _compile(function, numba.njit, ()))


def _compile(function: Any, njit: Callable[[Any], Any], callers: tuple[Any, ...]) -> Any:
    if not isinstance(function, types.FunctionType):
        raise JitError(f"{function!r} is no plain Python function")
    if function in _compiled:
        return _compiled[function]
    where = f"{function.__module__}.{function.__qualname__}"
    if function in callers:
        raise JitError(f"{where} calls itself, which compiled code may not")
    if function.__closure__:
        raise JitError(f"{where} is a closure; only functions of a module can be compiled")
    bound = dict(function.__globals__)
    for name in _names_of(function.__code__):
        value = bound.get(name)
        if isinstance(value, types.FunctionType) and _is_ours(value.__module__):
            bound[name] = _compile(value, njit, (*callers, function))
        elif isinstance(value, types.ModuleType) and _is_ours(value.__name__):
            raise JitError(f"{where} uses module {value.__name__}; import its functions by name instead")
    copy = types.FunctionType(function.__code__, bound, function.__name__, function.__defaults__)
    copy.__kwdefaults__ = function.__kwdefaults__
    copy.__module__ = function.__module__
    copy.__qualname__ = function.__qualname__
    _compiled[function] = njit(copy)
    return _compiled[function]


def _is_ours(module: str) -> bool:
    return module == "pneud" or module.startswith("pneud.")


def _names_of(code: types.CodeType) -> Iterator[str]:
    """All global names and attributes that code may use."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names_of(constant)
