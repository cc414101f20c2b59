"""What the C of some functions depends on: all that their code reaches."""

from __future__ import annotations

import hashlib
import marshal
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

_WORD = re.compile(r"\w+")
_CONSTANTS: frozenset[type] = frozenset((bool, int, float, str, types.NoneType))
_NUMBERS = frozenset(("bool", "int", "float", "str", "None"))  # as hints
_HAS_NO_PARTS: tuple[type, ...] = (types.FunctionType, *_CONSTANTS, tuple, dict)


class Reach:
    """A digest over what functions depend on, and the NamedTuples among it.

    That is: the sources of the modules of all functions and NamedTuples that they reach, the code of these
    functions as it was loaded, for sources may have changed since, and the values of the constants that they
    use, wherever those come from.
    """

    def __init__(self, functions: Iterable[Callable[..., Any]]) -> None:
        """Follow the functions to whatever they use.

        Raises:
            OSError: a source cannot be read.
        """
        self.classes: dict[str, type] = {}  # by name, as `name_of` has it
        self._parts: list[bytes] = []  # in the order in which they were come by
        self._seen: set[Any] = set()
        for function in functions:
            self._note("one of them")
            self._add(function)

    def digest(self) -> bytes:
        """Another one where anything is different."""
        return hashlib.sha256(b"".join(self._parts)).digest()

    def _add(self, value: Any) -> None:
        kind = type(value)
        if kind in _CONSTANTS:
            self._note(repr(value))
        elif kind is types.FunctionType:
            self._add_function(value)
        elif isinstance(value, type):
            self._add_class(value)
        elif isinstance(value, (int, float, str)):  # of a class of its own, as of an enumeration
            self._note(repr(value))
        elif isinstance(value, tuple):
            self._add(kind)
            for part in value:
                self._add(part)
        elif kind is dict:
            for item in value.items():
                self._add(item)
        elif kind is not types.ModuleType:
            for inner in get_args(value):  # an alias of a type
                self._add(inner)

    def _add_function(self, f: types.FunctionType) -> None:
        self._note(f"{f.__module__}:{f.__qualname__}")
        if self._is_known(f):
            return
        self._add_module(f.__module__)
        self._parts += doings(f.__code__)
        self._add_named(f.__code__.co_names, f.__globals__)
        self._add(f.__defaults__)
        self._add(f.__kwdefaults__)
        self._add_hints(f.__annotations__, f.__globals__)

    def _add_class(self, class_: type) -> None:
        if not hasattr(class_, "_fields") or self._is_known(class_):
            return
        self.classes[name_of(class_)] = class_
        self._add_module(class_.__module__)
        self._add(getattr(class_, "_field_defaults", None))
        self._add_hints(class_.__annotations__, vars(sys.modules[class_.__module__]))

    def _add_named(self, names: Sequence[str], scope: Mapping[str, Any]) -> None:
        for name in names:
            value = scope.get(name)
            if value is None:  # most of them are attributes
                continue
            self._add(value)
            if not isinstance(value, _HAS_NO_PARTS) and not hasattr(value, "_fields"):
                for inner in names:
                    part = getattr(value, inner, None)
                    if part is not None:
                        self._add(part)

    def _add_hints(self, hints: Mapping[str, Any], scope: Mapping[str, Any]) -> None:
        for hint in hints.values():
            text = hint if type(hint) is str else getattr(hint, "__forward_arg__", None)
            if text is None:
                self._add(hint)
            elif text not in _NUMBERS and not self._is_known((text, id(scope))):
                self._add_named(_WORD.findall(text), scope)  # to evaluate it would take much longer

    def _add_module(self, name: str) -> None:
        if self._is_known(name):
            return
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is not None and file.endswith(".py"):
            self._parts.append(Path(file).read_bytes())

    def _is_known(self, what: Any) -> bool:
        known = what in self._seen
        self._seen.add(what)
        return known

    def _note(self, text: str) -> None:
        self._parts.append(f"{text}\n".encode())


def doings(code: types.CodeType) -> tuple[bytes, bytes]:
    """What code does, apart from where it stands; the same in every process."""
    constants: Any = code.co_consts
    if not _CONSTANTS.issuperset(map(type, constants)):
        constants = tuple(map(_constant, constants))
    # of the first version: it knows no references, which differ from process to process
    return code.co_code, marshal.dumps((code.co_names, code.co_varnames, constants), 0)


def _constant(value: Any) -> Any:
    if isinstance(value, types.CodeType):
        return doings(value)
    if isinstance(value, tuple):
        return tuple(map(_constant, value))
    return sorted(map(repr, value)) if isinstance(value, frozenset) else value  # which has no order


def name_of(class_: type) -> str:
    """What a class is called across modules."""
    return f"{class_.__module__}:{class_.__qualname__}"
