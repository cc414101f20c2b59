"""Open a log in rerun, or in Foxglove or Lichtblick."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import typer

from pneud.log.files.naming import LogError
from pneud.log.files.reader import read_log
from pneud.replay import viewing
from pneud.replay.exporting import for_viewers
from pneud.verbs import LogArgument, ProgressOption, VerbError, watch
from pneud.view.progress import progress

RERUN = ("rerun",)
FOXGLOVE = ("lichtblick", "foxglove-studio", "foxglove")
AT_ONCE_S = 5.0  # a viewer that ends sooner has handed the file over to one that runs already


def view(
    log: LogArgument,
    rerun: Annotated[bool, typer.Option("--rerun", help="In rerun, arranged by a blueprint.")] = False,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="In Lichtblick, else in Foxglove.")] = False,
    how: ProgressOption = "auto",
) -> int:
    """Start a viewer with a log, its errors and its faults, and wait for it.

    Returns:
        Exit status: 0, or 1 where the viewer says that it failed.

    Raises:
        LogError: not a log that this version reads.
        VerbError: not one viewer was named, or it is not on this machine.
    """
    if rerun == foxglove:
        raise VerbError("view: name one viewer, --rerun or --foxglove")
    reader = read_log(log)
    program = _program(rerun)
    folder = Path(tempfile.mkdtemp(prefix="pneud-view-"))
    taken_over = False
    try:
        with progress(how) as report:
            watch(report, reader)
            file = _recording(log, folder) if rerun else folder / f"{reader.path.stem}.mcap"
            if file.suffix == ".mcap":
                for_viewers(reader, file)
        if foxglove:
            print(f"pneud: a layout to import there: {viewing.layout()}", file=sys.stderr)
        begun_s = time.monotonic()
        status = subprocess.run([program, str(file)], check=False).returncode
        taken_over = foxglove and status == 0 and time.monotonic() - begun_s < AT_ONCE_S
        return int(status != 0)
    finally:
        if not taken_over:
            shutil.rmtree(folder, ignore_errors=True)


def _recording(log: str, folder: Path) -> Path:
    """What rerun gets: a recording with its blueprint; the ticks alone where rerun-sdk is not at hand."""
    reader = read_log(log)
    file = folder / f"{reader.path.stem}.rrd"
    try:
        viewing.write(reader, file)
    except LogError as e:
        print(f"pneud: without a blueprint: {e}", file=sys.stderr)
        return file.with_suffix(".mcap")
    return file


def _program(rerun: bool) -> str:
    """The viewer's program, the first that there is; rerun's may lie beside this Python's."""
    for name in RERUN if rerun else FOXGLOVE:
        if (found := shutil.which(name) or shutil.which(name, path=Path(sys.executable).parent)) is not None:
            return found
    if rerun:
        raise VerbError("there is no rerun here; install it with: pip install rerun-sdk", 3)
    raise VerbError(f"none of {', '.join(FOXGLOVE)} is here; Lichtblick is free: lichtblick-suite", 3)
