"""A real-time controller for pneumatic servo axes on a CAN bus.

As a library:

* `load_config(file)`: a validated configuration,
* `simulate(config, duration_s, seed, scenario=…, gains=…)`: a run in simulated time, as a log,
* `read_log(file)`: a log: its ticks, columns for pandas, polars, Arrow and xarray, motions, summary,
* `Client()`, `AsyncClient()`: talk to a running daemon,
* `Axis`: the cycle itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = [
    "AsyncClient",
    "Axis",
    "Client",
    "ConfigError",
    "ExtraError",
    "Log",
    "LogError",
    "PlaceError",
    "RefusedError",
    "__version__",
    "load_config",
    "read_log",
    "simulate",
]

if TYPE_CHECKING:
    from pneud.axis.cycle import Axis
    from pneud.config.reading import load_config
    from pneud.config.sections import ConfigError
    from pneud.console.client import RefusedError
    from pneud.console.endpoint import PlaceError
    from pneud.log.files.naming import LogError
    from pneud.notebook.client import AsyncClient, Client
    from pneud.notebook.logs import Log, read_log
    from pneud.notebook.runs import simulate
    from pneud.rt.extras import ExtraError

_WHERE = {
    "AsyncClient": "pneud.notebook.client",
    "Axis": "pneud.axis.cycle",
    "Client": "pneud.notebook.client",
    "ConfigError": "pneud.config.sections",
    "ExtraError": "pneud.rt.extras",
    "Log": "pneud.notebook.logs",
    "LogError": "pneud.log.files.naming",
    "PlaceError": "pneud.console.endpoint",
    "RefusedError": "pneud.console.client",
    "load_config": "pneud.config.reading",
    "read_log": "pneud.notebook.logs",
    "simulate": "pneud.notebook.runs",
}


def __getattr__(name: str) -> Any:
    # on first use: the command line must not pay for all of them
    if name in _WHERE:
        from importlib import import_module  # noqa: PLC0415

        return getattr(import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'pneud' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
