"""Libraries that only a part of pneud needs: what installs them, and what is said where one is missing."""

from importlib.util import find_spec
from typing import Final

# by extra: the modules that its part of pneud imports, and what they are called where they are installed from
EXTRAS: Final[dict[str, dict[str, str]]] = {
    "sim": {"numba": "numba"},
    "plots": {"matplotlib": "matplotlib"},
    "parquet": {"pyarrow": "pyarrow"},
    "live": {"foxglove": "foxglove-sdk"},
    "identify": {"scipy": "scipy"},
    "canopen": {"canopen": "canopen"},
    "screen": {"textual": "textual"},
    "frames": {"pandas": "pandas", "polars": "polars", "xarray": "xarray"},
    "mqtt": {"aiomqtt": "aiomqtt"},
    "tune": {"optuna": "optuna"},
    "cluster": {"distributed": "distributed"},
    "web": {"starlette": "starlette", "uvicorn": "uvicorn", "websockets": "websockets"},
    "prove": {"greenlet": "greenlet", "canopen": "canopen"},
}


class ExtraError(ImportError):
    """A library is missing that something needs; the text is one line that says what to install."""

    exit_code = 3


def cure(extra: str) -> str:
    """What installs an extra."""
    return f"pip install 'pneud[{extra}]'"


def extra_of(module: str) -> str:
    """The extra that a module comes with."""
    return next(extra for extra, modules in EXTRAS.items() if module in modules)


def missing(extra: str) -> list[str]:
    """Modules of an extra that are not installed."""
    return [module for module in EXTRAS[extra] if find_spec(module) is None]


def lack(what: str, extra: str, modules: list[str]) -> ExtraError:
    """That something needs modules of an extra, which are missing.

    Args:
        what: needs them.
        extra: has them.
        modules: of it.
    """
    packages = ", ".join(EXTRAS[extra][module] for module in modules)
    return ExtraError(f"{what} needs {packages}; install it with: {cure(extra)}", name=modules[0])


def require(what: str, extra: str) -> None:
    """Make sure, before anything takes time, that an extra is there; loads nothing of it.

    Args:
        what: needs it.
        extra: by its name.

    Raises:
        ExtraError: it is not, or not all of it.
    """
    if modules := missing(extra):
        raise lack(what, extra, modules)
