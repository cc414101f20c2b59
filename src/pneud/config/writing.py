"""Changes of a configuration's file, as a person would make them: comments and order stay."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.rt.outputs import replacing


def rewrite(path: Path, change: Callable[[Any], None]) -> None:
    """Change a file at once or not at all; what could not be loaded is not written.

    Args:
        path: of the file.
        change: does it to the file's tables.

    Raises:
        ConfigError: the file, or what would become of it, cannot be used.
        OSError: it cannot be read or written.
    """
    try:
        document = tomlkit.parse(path.read_text(encoding="utf-8-sig"))
        change(document)
        text = tomlkit.dumps(document)
    except (TOMLKitError, UnicodeDecodeError) as e:
        raise ConfigError(f"{path}: {e}") from None
    except ValueError as e:  # tomlkit's own word for what an inline table cannot hold
        raise ConfigError(f"{path}: {e}; write its tables as [control.adaptation] and so on") from None
    parse(text, str(path))
    before = path.stat()
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")
        with contextlib.suppress(PermissionError):
            os.chown(beside, before.st_uid, before.st_gid)


def put(document: Any, key: tuple[str, ...], value: Any) -> None:
    """Set a key of a document, its tables made where they are missing."""
    table = document
    for step in key[:-1]:
        table = table.setdefault(step, tomlkit.table())
    table[key[-1]] = value
