"""pneud as a systemd service: which files belong where, and what is amiss with those that are there.

The files are those of the folder `systemd`, with the installed command in the place of /opt/pneud/bin/pneud.
The unit of an axis is bound to can0; an axis on another interface gets a unit of its own, the same but for
that name.
"""

from __future__ import annotations

import re
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from pneud import resources
from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.rt.outputs import write_whole
from pneud.service.probe import Finding, Grade, judged

USER = "pneud"
CONFIGS = Path("etc/pneud")
UNITS = Path("usr/local/lib/systemd/system")
NETWORK = Path("usr/local/lib/systemd/network")
AXIS_UNIT = "pneud@.service"
_ELSEWHERE = {
    "pneud.sysusers": Path("usr/local/lib/sysusers.d/pneud.conf"),
    "pneud.tmpfiles": Path("usr/local/lib/tmpfiles.d/pneud.conf"),
    "70-pneud.rules": Path("usr/local/lib/udev/rules.d/70-pneud.rules"),
}
_SHIPPED_COMMAND = "/opt/pneud/bin/pneud"
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # ProtectHome= and PrivateTmp= of the units


class InstallError(Exception):
    """The service cannot be installed; the text is one line for a person."""

    exit_code = 3


class Unit(NamedTuple):
    """What the service has to know of a configuration."""

    name: str  # of the unit's instance and of the file in /etc/pneud
    interface: str


def axis_of(path: Path, config: Config) -> Unit:
    """The axis that a configuration file makes.

    Raises:
        ConfigError: it is none for a service.
    """
    kind, _, interface = config.bus.channel.partition(":")
    if kind != "socketcan":
        raise ConfigError(
            f'{path}: bus.channel = "{config.bus.channel}": a service needs socketcan:IF, such as'
            " socketcan:can0"
        )
    if not re.fullmatch(r"[A-Za-z0-9_.-]+", path.stem):
        raise ConfigError(f"{path}: no name for a unit; letters, digits and _ . - may stand in it")
    return Unit(path.stem, interface)


def command() -> Path:
    """The `pneud` of this installation."""
    return Path(sys.prefix) / "bin" / "pneud"


def unseen(*paths: Path) -> str:
    """Why the service could not start a command that lies here; empty where it could."""
    for path in paths:
        for hidden in _HIDDEN:
            if path.is_relative_to(hidden):
                return f"{path}: hidden from a service; install pneud into /opt/pneud (docs/rig-pc.md)"
    return ""


def files(executable: Path, axis: Unit | None, *, networkd: bool = False) -> dict[Path, str]:
    """The files of a service, by their paths below the root folder.

    Args:
        executable: the command that the units start.
        axis: adds what its interface needs.
        networkd: with the files by which systemd-networkd makes that interface and brings it up.
    """
    folder = resources.systemd()
    units = sorted([*folder.glob("*.service"), *folder.glob("*.timer")])
    found = {UNITS / path.name: _with_command(path, executable) for path in units}
    found |= {place: (folder / name).read_text() for name, place in _ELSEWHERE.items()}
    if axis is not None and axis.interface != "can0":
        unit = found[UNITS / AXIS_UNIT].partition("[Unit]")
        text = (
            f"# {AXIS_UNIT} for the interface {axis.interface}, by `pneud install-service`.\n[Unit]" + unit[2]
        )
        found[UNITS / instance(axis)] = re.sub(r"\bcan0\b", lambda _: escaped(axis.interface), text)
    if axis is not None and networkd:
        kind = "vcan0" if is_virtual(axis.interface) else "can0"
        for path in sorted((folder / "network").glob(f"60-{kind}.*")):
            name = path.name.replace(kind, axis.interface)
            found[NETWORK / name] = re.sub(rf"\b{kind}\b", axis.interface, path.read_text())
    return found


def instance(axis: Unit) -> str:
    """The name of an axis's unit."""
    return AXIS_UNIT.replace("@", f"@{axis.name}")


def units_of(axis: Unit, *, networkd: bool = False) -> list[str]:
    """What to enable, in the order of need."""
    interface = escaped(axis.interface)
    virtual = is_virtual(axis.interface)
    if networkd:
        first = ["systemd-networkd", f"systemd-networkd-wait-online@{interface}"]
    else:
        first = [f"pneud-vcan@{interface}" if virtual else f"pneud-can@{interface}"]
    return [
        *first,
        *([f"pneud-plant@{axis.name}"] if axis.interface == "vcan0" else []),
        f"pneud@{axis.name}",
    ]


def is_virtual(interface: str) -> bool:
    """Whether an interface is, by its name, of kind vcan; it need not exist yet."""
    return interface.startswith("vcan")


def escaped(interface: str) -> str:
    """An interface's name as it stands in names of units."""
    return re.sub(r"[^A-Za-z0-9:_.]", lambda found: f"\\x{ord(found[0]):02x}", interface)


def _with_command(path: Path, executable: Path) -> str:
    return path.read_text().replace(_SHIPPED_COMMAND, str(executable))


def keep_config(root: Path, axis: Unit, text: str, dbc: Path) -> tuple[Path, bool]:
    """Put a configuration where the service looks for it, with a DBC that is not pneud's own; change none.

    Returns:
        Where it is, and whether one was there before.

    Raises:
        InstallError: it cannot be written.
    """
    place = CONFIGS / f"{axis.name}.toml"
    own = {} if dbc.parent == resources.configs() else {CONFIGS / dbc.name: dbc.read_text()}
    was_there = (root / place).exists()
    put(root, {there: what for there, what in (own | {place: text}).items() if not (root / there).exists()})
    return root / place, was_there


def put(root: Path, contents: dict[Path, str]) -> list[Path]:
    """Write files below a root folder.

    Returns:
        The files that were missing or different.

    Raises:
        InstallError: one cannot be written.
    """
    changed = []
    for place, text in contents.items():
        path = root / place
        try:
            if path.is_file() and path.read_text() == text:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, text)
            path.chmod(0o644)
        except OSError as e:
            raise InstallError(
                f"{path}: {e.strerror}; install as root, or elsewhere with --destdir"
            ) from None
        changed.append(path)
    return changed


def call(words: Sequence[str]) -> str:
    """Standard output of a command.

    Raises:
        InstallError: it is not there, or fails.
    """
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError as e:
        raise InstallError(f"{words[0]}: {e.strerror}; a service needs systemd") from None
    if done.returncode:
        raise InstallError(f"{' '.join(words)}: {done.stderr.strip() or f'exit {done.returncode}'}")
    return done.stdout


def activate(root: Path = Path("/"), run: Callable[[Sequence[str]], str] = call) -> None:
    """Make the user and the folders, and let the running systemd and udev read what has been put in place.

    Raises:
        InstallError: one of them refuses.
    """
    run(["systemd-sysusers", str(root / _ELSEWHERE["pneud.sysusers"])])
    run(["systemd-tmpfiles", "--create", str(root / _ELSEWHERE["pneud.tmpfiles"])])
    if (root / "run/systemd/system").is_dir():  # else it is not what runs here, as in a container
        run(["systemctl", "daemon-reload"])
    if (root / "run/udev/control").exists():
        run(["udevadm", "control", "--reload"])


def examine(
    axis: Unit | None,
    priority: int,
    root: Path = Path("/"),
    run: Callable[[Sequence[str]], str] = call,
    executable: Path | None = None,
) -> Iterator[Finding]:
    """What is amiss with the service on this machine; nothing where none is installed.

    Args:
        axis: of the configuration that is asked about; None where it is none for a service.
        priority: real-time priority that it wants.
        root: what to take for /.
        run: runs a command, as `call` does.
        executable: the command that the units ought to start; that of this installation if None.
    """
    if not (root / UNITS / AXIS_UNIT).is_file():
        return
    executable = executable or command()
    stale = [
        str(place)
        for place, text in files(executable, axis).items()
        if not (root / place).is_file() or (root / place).read_text() != text
    ]
    yield judged(
        not stale,
        "service units",
        f"missing, or not of this pneud: {', '.join(stale)}" if stale else f"those of {executable}",
        "systemd may start another pneud, or with other rights",
        "pneud install-service" + (f" --config /{CONFIGS}/{axis.name}.toml" if axis is not None else ""),
    )
    yield _user(root, executable)
    if axis is None:
        return
    yield _readable(root, CONFIGS / f"{axis.name}.toml")
    if (root / "run/systemd/system").is_dir():
        yield from _loaded(axis, priority, run)


def _number(path: Path) -> int | None:
    """The number of user or group pneud in a file like /etc/passwd."""
    found = re.search(rf"^{USER}:[^:]*:(\d+):", path.read_text() if path.is_file() else "", re.MULTILINE)
    return int(found[1]) if found else None


def _user(root: Path, executable: Path) -> Finding:
    name, reason = "service user", "the service runs as a user of its own"
    user, group = _number(root / "etc/passwd"), _number(root / "etc/group")
    if user is None or group is None:
        return Finding(name, Grade.LACK, f"there is no user or no group {USER}", reason, "systemd-sysusers")
    found, _, cure = unseen(executable, Path(sys.base_prefix)).partition("; ")
    there = f"{USER} ({user}:{group})"
    return judged(not cure, name, f"{there}; {found}" if cure else there, reason, cure, Grade.LACK)


def _readable(root: Path, path: Path) -> Finding:
    name, reason = "service configuration", "the unit is named after the file that it starts the daemon with"
    try:
        mode = (root / path).stat()
    except OSError as e:
        cure = "pneud install-service --config F puts it there"
        return Finding(name, Grade.LACK, f"/{path}: {e.strerror}", reason, cure)
    ours = mode.st_gid == _number(root / "etc/group")
    ok = bool(mode.st_mode & (stat.S_IROTH | (stat.S_IRGRP if ours else 0)))
    found = f"/{path}" if ok else f"/{path}: user {USER} may not read it"
    return judged(ok, name, found, reason, f"chmod a+r /{path}", Grade.LACK)


def _loaded(axis: Unit, priority: int, run: Callable[[Sequence[str]], str]) -> Iterator[Finding]:
    unit = instance(axis)
    wanted = ("NeedDaemonReload", "UnitFileState", "ActiveState", "StatusText", "LimitRTPRIO", "LimitMEMLOCK")
    try:
        text = run(["systemctl", "show", unit, *(f"--property={name}" for name in wanted)])
    except InstallError as e:
        yield Finding("service", Grade.WARNING, str(e), "systemd runs it", "see systemctl status " + unit)
        return
    values = dict(line.partition("=")[::2] for line in text.splitlines())
    state = values.get("ActiveState", "")
    told = f" ({values['StatusText']})" if values.get("StatusText") else ""
    enabled = values.get("UnitFileState") == "enabled"
    reload = values.get("NeedDaemonReload") == "yes"
    cure = "systemctl daemon-reload" if reload else f"systemctl enable --now {' '.join(units_of(axis))}"
    if state == "failed":
        cure = f"journalctl -u {unit}; then systemctl reset-failed {unit} and systemctl start {unit}"
    found = f"{unit}: {values.get('UnitFileState') or 'not there'}, {state}{told}"
    yield judged(
        enabled and not reload and state != "failed",
        "service",
        found + (", the unit changed since systemd read it" if reload else ""),
        "systemd starts it with its interface",
        cure,
    )
    rtprio, memlock = values.get("LimitRTPRIO", ""), values.get("LimitMEMLOCK", "")
    granted = rtprio == "infinity" or (rtprio.isdigit() and int(rtprio) >= priority)
    yield judged(
        granted and memlock == "infinity",
        "service limits",
        f"LimitRTPRIO={rtprio}, LimitMEMLOCK={memlock}",
        "they allow the loop its scheduling and its memory",
        f"a drop-in changes them: systemctl cat {unit}; wanted are LimitRTPRIO=98 and LimitMEMLOCK=infinity",
        Grade.LACK,
    )
