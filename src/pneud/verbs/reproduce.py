"""The paper's two cases, composite against ISMC."""

from __future__ import annotations

import errno
import importlib.util
import json as json_
import os
import sys
from pathlib import Path

from pneud.config.models import ConfigError
from pneud.rt.outputs import write_whole
from pneud.study.paper import as_json, reproduce
from pneud.study.paper_figures import FiguresError, pictures, require
from pneud.study.paper_page import page, words

PAGE = "paper.html"


def reproduce_paper(output: Path | None, json: bool) -> int:
    """Run the cases, say what came out, and write page and figures where a folder is given.

    Returns:
        Exit status: 0 where every figure is within its bound, 1 where one is not, 3 without matplotlib.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    if output is not None:
        try:
            require()
        except FiguresError as e:
            print(f"pneud: {e}", file=sys.stderr)
            return 3
        _writable(output)
    if importlib.util.find_spec("numba") is None:
        print(
            "pneud: without numba this takes minutes; install it with: pip install 'pneud[sim]'",
            file=sys.stderr,
        )
    found = reproduce()
    if output is not None:
        drawn = pictures(found)
        try:
            for picture in drawn:
                write_whole(output / f"{picture.name}.png", picture.png)
            write_whole(output / PAGE, page(found, drawn))
        except OSError as e:
            raise ConfigError(f"{output}: cannot be written to: {e.strerror}") from None
    if json:
        print(json_.dumps(as_json(found) | {"page": str(output / PAGE) if output is not None else None}))
    else:
        print(words(found))
        if output is not None:
            print(f"\nfigures and tables: {output / PAGE}")
    return 0 if found.good else 1


def _writable(folder: Path) -> None:
    """Found out before half a minute of work, not after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ConfigError(f"{folder}: cannot be made: {e.strerror}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"{folder}: cannot be written to: {os.strerror(errno.EACCES)}")
