"""Where the shipped modules find doors in the place of the system, and how functions are replaced."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from types import FunctionType, ModuleType
from typing import Any

SEAMS: dict[str, tuple[str, ...]] = {
    "pneud.crew": ("os", "signal", "socket", "threading", "time"),
    "pneud.daemon.result": ("sys",),
    "pneud.daemon.session": ("os", "sys"),
    "pneud.loop.lane": ("time",),
    "pneud.loop.loop": ("time",),
    "pneud.loop.pacer": (),
    "pneud.loop.stopping": ("os", "signal"),
    "pneud.rt.notify": ("socket",),
    "pneud.bus.link": ("select", "time"),
    "pneud.bus.wire": ("time",),
    "pneud.rig.answering": ("time",),
    "pneud.rig.plant_process": ("signal",),
    "pneud.log.live.mileage": ("threading", "time"),
    "pneud.log.live.notes": ("time",),
    "pneud.log.live.recorder": ("os", "sys", "time", "traceback"),
    "pneud.log.live.ring": ("time",),
    "pneud.log.files.naming": ("os",),
    "pneud.log.files.part": ("os", "time"),
    "pneud.log.files.retention": ("threading",),
    "pneud.log.files.saving": ("os", "threading"),
    "pneud.log.files.writer": ("threading", "time", "uuid"),
    "pneud.console.beside": ("os", "threading", "time"),
    "pneud.console.client": ("select",),
    "pneud.console.connected": ("select",),
    "pneud.console.handoff": ("select", "time"),
    "pneud.console.keeper": ("os", "signal", "time"),
    "pneud.console.processes": ("time",),
    "pneud.console.server": ("os", "selectors", "socket", "time"),
    "pneud.console.status_reply": ("sys", "time"),
    "pneud.console.operator": (),
    "pneud.console.worker": ("signal", "sys", "time"),
    "pneud.view.processes": ("os", "signal", "sys", "time"),
    "pneud.view.show": ("time",),
    "pneud.view.terminal": ("os", "signal", "sys", "time"),
}
"""Modules whose functions are actors' or run in them, and what they find a door for.

Where a function has a clock or a sleep as a default, given when it was made, that is a door, too.
"""


@contextmanager
def opened(
    doors: Mapping[str, Any],
    adapters: Mapping[str, Any],
    environ: Mapping[str, str],
    seams: Mapping[str, tuple[str, ...]] = SEAMS,
) -> Iterator[None]:
    """Have the modules find doors for as long as a block lasts.

    Args:
        doors: by the names of the modules that they stand for.
        adapters: what takes the place of functions, by module and name.
        environ: in the place of the environment, for functions that have it as a default.
        seams: the modules, and what they find doors for.
    """
    clock = doors["time"]
    bound: dict[Any, Any] = {
        time.monotonic: clock.monotonic,
        time.monotonic_ns: clock.monotonic_ns,
        time.sleep: clock.sleep,
    }
    undo: list[Callable[[], None]] = []
    try:
        for name, named in seams.items():
            module = import_module(name)
            for seam in named:
                _put(module, seam, doors[seam], undo)
            for function in _functions(module):
                _bind(function, bound, environ, undo)
        for place, adapter in adapters.items():
            name, _, attribute = place.rpartition(".")
            _put(import_module(name), attribute, adapter, undo)
        yield
    finally:
        for back in reversed(undo):
            back()


_MISSING = object()


def _put(module: ModuleType, name: str, what: Any, undo: list[Callable[[], None]]) -> None:
    before = module.__dict__.get(name, _MISSING)
    setattr(module, name, what)
    undo.append(lambda: delattr(module, name) if before is _MISSING else setattr(module, name, before))


def _functions(module: ModuleType) -> Iterator[FunctionType]:
    """Those that a module defines, with those of its classes."""
    for found in list(vars(module).values()):
        if getattr(found, "__module__", None) != module.__name__:
            continue
        if isinstance(found, FunctionType):
            yield found
        elif isinstance(found, type):
            yield from (one for one in vars(found).values() if isinstance(one, FunctionType))


def _bind(
    function: FunctionType,
    bound: Mapping[Any, Any],
    environ: Mapping[str, str],
    undo: list[Callable[[], None]],
) -> None:
    def door(value: Any) -> Any:
        if value is os.environ:
            return environ
        return bound.get(value, value) if callable(value) else value

    if before := function.__defaults__:
        function.__defaults__ = tuple(door(value) for value in before)
        undo.append(lambda: setattr(function, "__defaults__", before))
    if named := function.__kwdefaults__:
        function.__kwdefaults__ = {name: door(value) for name, value in named.items()}
        undo.append(lambda: setattr(function, "__kwdefaults__", named))
