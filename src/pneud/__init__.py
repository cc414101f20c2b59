"""A real-time controller for pneumatic servo axes on a CAN bus.

As a library:

* `load_config(file)`: a validated configuration,
* `simulate(file, duration_s, seed)`: the ticks of a run in simulated time,
* `read_log(file)`: the ticks of a log,
* `Axis`: the cycle itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["Axis", "__version__", "load_config", "read_log", "simulate"]

if TYPE_CHECKING:
    from pneud.axis.cycle import Axis
    from pneud.config.reading import load_config
    from pneud.log.files.reader import read_log
    from pneud.replay.lockstep import simulate

_WHERE = {
    "Axis": "pneud.axis.cycle",
    "load_config": "pneud.config.reading",
    "read_log": "pneud.log.files.reader",
    "simulate": "pneud.replay.lockstep",
}


def __getattr__(name: str) -> Any:
    # on first use: the command line must not pay for all of them
    if name in _WHERE:
        from importlib import import_module  # noqa: PLC0415

        return getattr(import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'pneud' has no attribute {name!r}")
