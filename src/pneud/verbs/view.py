"""Open a log in rerun, or in Foxglove or Lichtblick."""

from __future__ import annotations

import shutil
import subprocess
import sys
from typing import Annotated

import typer

from pneud import resources
from pneud.log.files.reader import read_log
from pneud.verbs import LogArgument, VerbError

RERUN = ("rerun",)
FOXGLOVE = ("lichtblick", "foxglove-studio", "foxglove")


def view(
    log: LogArgument,
    rerun: Annotated[bool, typer.Option("--rerun", help="In rerun.")] = False,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="In Lichtblick, else in Foxglove.")] = False,
) -> int:
    """Start a viewer with a log, and wait for it.

    Returns:
        Exit status: 0, or 1 where the viewer says that it failed.

    Raises:
        LogError: not a log that this version reads.
        VerbError: not one viewer was named, or it is not on this machine.
    """
    if rerun == foxglove:
        raise VerbError("view: name one viewer, --rerun or --foxglove")
    paths = read_log(log).paths
    program = _program(rerun)
    if foxglove:
        layout = resources.configs() / "viewers" / "foxglove.json"
        print(f"pneud: a layout to import there: {layout}", file=sys.stderr)
    return int(subprocess.run([program, *map(str, paths)], check=False).returncode != 0)


def _program(rerun: bool) -> str:
    """The viewer's program, the first that there is."""
    for name in RERUN if rerun else FOXGLOVE:
        if (found := shutil.which(name)) is not None:
            return found
    if rerun:
        raise VerbError("there is no rerun here; install it with: pip install rerun-sdk", 3)
    raise VerbError(f"none of {', '.join(FOXGLOVE)} is here; Lichtblick is free: lichtblick-suite", 3)
