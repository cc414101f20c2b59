"""The paper's two cases, composite law against ISMC: tables, verdicts and Figures 3 to 8."""

from __future__ import annotations

import errno
import json as json_
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from pneud.config.sections import ConfigError
from pneud.rt.extras import cure, missing, require
from pneud.rt.outputs import write_whole
from pneud.study import paper
from pneud.study.paper_figures import pictures
from pneud.study.paper_page import page, words
from pneud.verbs import JsonOption, ProgressOption
from pneud.view.progress import progress

PAGE = "paper.html"


def reproduce(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write page and figures here.")
    ] = None,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Run the cases, say what came out, and write page and figures where a folder is given.

    Returns:
        Exit status: 0 where every figure is within its bound, 1 where one is not.
    """
    if output is not None:
        require("reproduce -o", "plots")
        _writable(output)
    if missing("sim"):
        print(f"pneud: without numba this takes minutes: {cure('sim')}", file=sys.stderr)
    with progress(how) as report:
        found = paper.reproduce(report)
    if output is not None:
        drawn = pictures(found)
        for picture in drawn:
            write_whole(output / f"{picture.name}.png", picture.png)
        write_whole(output / PAGE, page(found, drawn))
    if json:
        print(
            json_.dumps(paper.as_json(found) | {"page": str(output / PAGE) if output is not None else None})
        )
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
