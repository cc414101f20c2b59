"""Where the files that come with pneud are: configurations, the DBC, scenarios, units.

In a checkout (or an editable installation) they are the checkout's own; in an installed wheel they lie
inside the package. A file beside the one that names it, or in the
working directory, wins over them.
"""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_CHECKOUT = _PACKAGE.parent.parent
AXES = "axes"  # the folder of those with several axes


def _folder(packaged: str, checkout: str) -> Path:
    inside = _PACKAGE / "_data" / packaged
    return inside if inside.is_dir() else _CHECKOUT / checkout


def configs() -> Path:
    """The folder with the configurations and the DBC that come with pneud."""
    return _folder("configs", "configs")


def scenarios() -> Path:
    """The folder with the scenarios that come with pneud."""
    return _folder("scenarios", "hil/scenarios")


def bench() -> Path:
    """The folder with the C program that `pneud bench` compares the loop with."""
    return _folder("bench", "hil/bench")


def systemd() -> Path:
    """The folder with the units and what belongs to them."""
    return _folder("systemd", "systemd")


def find(name: str | Path, beside: Path | None = None) -> Path:
    """The file `name`: as given, beside another file, or among those that come with pneud.

    Args:
        name: path or bare file name.
        beside: folder to look in after the working directory (that of the file which names this one).

    Raises:
        FileNotFoundError: nowhere; the message lists where it was looked for.
    """
    try:
        path = Path(name).expanduser()
    except RuntimeError:
        raise FileNotFoundError(f"{name}: no such user, or one without a home") from None
    tried = [path]
    if beside is not None:
        tried.insert(0, beside / path)
    if not path.is_absolute() and len(path.parts) == 1:
        tried += [configs() / path, configs() / AXES / path, scenarios() / path]
    for candidate in tried:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(f"{name}: no such file (looked in {', '.join(str(t.parent) for t in tried)})")
