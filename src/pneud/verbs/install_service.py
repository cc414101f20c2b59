"""Put the systemd units of this installation in place (see docs/rig-pc.md)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pneud.config.reading import text_of
from pneud.loading import Loaded, load_axes
from pneud.service import installation
from pneud.service.installation import InstallError
from pneud.verbs import VerbError


def install_service(
    config_file: Annotated[
        str | None,
        typer.Option(
            "--config", metavar="FILE", help="Also an axis: its unit, its configuration in /etc/pneud."
        ),
    ] = None,
    networkd: Annotated[
        bool, typer.Option("--networkd", help="Also files by which systemd-networkd brings its interface up.")
    ] = False,
    destdir: Annotated[
        Path | None, typer.Option("--destdir", metavar="DIR", help="Only write files, below this folder.")
    ] = None,
) -> int:
    """Write the files, and make systemd and udev read them where they are this machine's own.

    A configuration is put into /etc/pneud unless there is one of that name.
    """
    if networkd and config_file is None:
        raise VerbError("--networkd is about the interface of an axis; name its --config")
    if config_file is not None and Path(config_file).is_dir():
        raise VerbError("--config: a service takes one file; write its axes as [[axis]]")
    loaded = load_axes(config_file)[0] if config_file is not None else None
    axis = installation.axis_of(loaded.path, loaded.config) if loaded is not None else None
    executable, root = installation.command(), destdir or Path("/")
    if destdir is None and (why := installation.unseen(executable, Path(sys.base_prefix))):
        raise InstallError(why)
    changed = installation.put(root, installation.files(executable, axis, networkd=networkd))
    for path in changed:
        print(path)
    if not changed:
        print("all files are in place")
    if loaded is not None and axis is not None:
        _keep(root, axis, loaded)
    if destdir is None:
        installation.activate()
    if axis is not None:
        print(f"then: systemctl enable --now {' '.join(installation.units_of(axis, networkd=networkd))}")
    return 0


def _keep(root: Path, axis: installation.Unit, loaded: Loaded) -> None:
    text, _ = text_of(loaded.path)  # with all axes that it has
    path, was_there = installation.keep_config(root, axis, text, loaded.dbc)
    if not was_there:
        print(path)
    elif path.read_text() != text:
        print(f"{path} is another one and stays; the service uses it", file=sys.stderr)
