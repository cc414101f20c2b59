"""The DBC of nodes as a file, for all that reads one: the log, other tools, who watches for changes."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from pneud.canopen.frames import dbc_of
from pneud.config.models import Config
from pneud.rt.folders import cache_folder, private_folder, runtime_folder
from pneud.rt.outputs import replacing


def kept_dbc(config: Config) -> Path:
    """Where the DBC of a configuration's nodes is; it is made where it is not, or is another.

    Raises:
        OSError: there is no place for it.
    """
    data = dbc_of(config).encode()
    name = f"nodes-{hashlib.sha256(data).hexdigest()[:12]}.dbc"
    with suppress(OSError):
        folder = cache_folder("nodes")
        folder.mkdir(parents=True, exist_ok=True)
        return _kept(folder / name, data)
    return _kept(private_folder(runtime_folder() / "nodes") / name, data)


def _kept(path: Path, data: bytes) -> Path:
    with suppress(FileNotFoundError):
        if path.read_bytes() == data:
            return path
    with replacing(path) as beside:
        beside.write_bytes(data)
    return path
