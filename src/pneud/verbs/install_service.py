"""pneud as a systemd service: puts units and what belongs to them in place."""

from __future__ import annotations

import sys
from pathlib import Path

from pneud.loading import Loaded, load
from pneud.service import installation
from pneud.service.installation import InstallError


def install_service(config_file: str | None, destdir: Path | None, networkd: bool) -> int:
    """Write the files, and make systemd and udev read them where they are this machine's own.

    Args:
        config_file: configuration of an axis, to be put into /etc/pneud unless there is one of that name.
        destdir: write below this folder, and nothing else; None for this machine.
        networkd: with the files by which systemd-networkd brings the interface up.

    Raises:
        ConfigError: the configuration cannot be used, or not by a service.
        DatabaseError: its DBC cannot be used.
        InstallError: a file cannot be written, or systemd refuses.
    """
    loaded = load(config_file) if config_file is not None else None
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


def _keep(root: Path, axis: installation.Axis, loaded: Loaded) -> None:
    path, was_there = installation.keep_config(root, axis, loaded.text, loaded.dbc)
    if not was_there:
        print(path)
    elif path.read_text() != loaded.text:
        print(f"{path} is another one and stays; the service uses it", file=sys.stderr)
