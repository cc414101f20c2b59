"""The verbs: one module each, and here the options that several of them have.

A module's name is the verb's, its first line is what `pneud --help` says of it, and its function of that name
has the options as its signature and returns the exit status. What it raises with an `exit_code`, and what
the machine refuses, ends it with one line: see `cli`. A verb that has verbs of its own names them in `VERBS`.
`run` is the daemon, which is no verb.
"""

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from pneud.log.files.reader import LogReader
    from pneud.view.progress import Report


def _files(incomplete: str, suffix: str, *folders: Path) -> Iterator[str]:
    """Files that begin so: here, or where a path leads; or in folders by their paths or bare names."""
    here = Path(incomplete)
    stem = "" if incomplete.endswith("/") else here.name
    for path in sorted((here if not stem else here.parent).glob(f"{stem}*")):
        if (path.is_dir() or path.suffix == suffix) and not path.name.startswith("."):
            yield f"{path}/" if path.is_dir() else str(path)
    for folder in folders if "/" not in incomplete else ():
        yield from (str(path) for path in sorted(folder.glob(f"{incomplete}*{suffix}"), reverse=True))


def complete_log(incomplete: str) -> list[str]:
    """Logs here, and those of the daemon, the newest first."""
    from pneud.log.files.naming import LogError, log_folder  # noqa: PLC0415 - whoever completes waits

    try:
        return [*_files(incomplete, ".mcap", log_folder(None))]
    except LogError:
        return [*_files(incomplete, ".mcap")]


def complete_config(incomplete: str) -> list[str]:
    """Configurations here, and the bare names of those that come with pneud."""
    from pneud import resources  # noqa: PLC0415 - whoever completes waits

    own = (path.name for path in sorted(resources.configs().glob("*.toml")))
    return [*_files(incomplete, ".toml"), *(name for name in own if name.startswith(incomplete))]


def complete_scenario(incomplete: str) -> list[str]:
    """The names of pneud's scenarios, and files here."""
    from pneud import resources  # noqa: PLC0415 - whoever completes waits

    own = sorted(path.stem for path in resources.scenarios().glob("*.toml"))
    return [*(name for name in own if name.startswith(incomplete)), *_files(incomplete, ".toml")]


def complete_key(incomplete: str) -> list[str]:
    """Keys of the configurations that come with pneud, ready for their values."""
    from pneud import resources  # noqa: PLC0415 - whoever completes waits
    from pneud.config.toml import flat, tables_of  # noqa: PLC0415

    texts = (path.read_text(encoding="utf-8-sig") for path in resources.configs().glob("*.toml"))
    keys = {key for text in texts for key in flat(tables_of(text))}
    return sorted(f"{key}=" for key in keys if key.startswith(incomplete))


def complete_tunable(incomplete: str) -> list[str]:
    """Names of what may be tuned, ready for their values."""
    from pneud.control.model import NAMES  # noqa: PLC0415 - whoever completes waits
    from pneud.control.tunables import LAWS, names_of  # noqa: PLC0415

    names = (*dict.fromkeys(name for law in LAWS for name in names_of(law)), *NAMES)
    found = [f"{name}=" for name in names if name.startswith(incomplete)]
    return found + [key for key in complete_key(incomplete) if key.startswith("reference.")]


ConfigOption = Annotated[
    str | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="Configuration; default virtual.toml.",
        autocompletion=complete_config,
    ),
]
FileArgument = Annotated[
    str, typer.Argument(metavar="FILE", help="Configuration.", autocompletion=complete_config)
]
LogArgument = Annotated[
    str, typer.Argument(metavar="LOG", help="A log, or the folder of its parts.", autocompletion=complete_log)
]
LogsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="LOG…",
        help="Logs, parts of one, or the folder that they are in.",
        autocompletion=complete_log,
    ),
]
BusOption = Annotated[
    str | None, typer.Option("--bus", metavar="BUS", help="auto, socketcan:IF or unixcan:NAME.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
AxisOption = Annotated[
    str | None, typer.Option("--axis", metavar="NAME", help="Which one, where there are several.")
]
SocketOption = Annotated[str | None, typer.Option("--socket", metavar="PATH", help="The daemon's socket.")]
ScenarioOption = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        metavar="NAME",
        help="Faults to inject: pneud's own, or a file.",
        autocompletion=complete_scenario,
    ),
]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of the plant's noise.")]
ProgressOption = Annotated[
    Literal["auto", "json", "off"],
    typer.Option("--progress", help="On standard error: a bar on a terminal, or a line a second."),
]


# of a verb that names it as its `SETTINGS`
NEGATIVE_NUMBERS = {"ignore_unknown_options": True}  # numbers with a minus sign are no options


def whole(*logs: "LogReader") -> bool:
    """Say of logs that have been read what is wrong with them.

    Returns:
        Whether nothing is.
    """
    for log in logs:
        if log.truncated:
            saved = "pneud recover may save more"
            print(f"pneud: {log.path}: not whole: {log.damage}; {saved}", file=sys.stderr)
    return not any(log.truncated for log in logs)


def watch(report: "Report", *logs: "LogReader") -> None:
    """Have it told how far each reading of a log is."""
    for log in logs:
        log.watch = partial(_read, report, log.path.name)


def _read(report: "Report", name: str, read: int, size: int) -> None:
    report(name, 1e-6 * read, 1e-6 * size, "MB")


def require_suffix(path: Path, suffix: str, what: str) -> None:
    """Refuse a name that says something else than what is to be written; a pipe or a device may have any.

    Raises:
        VerbError: it does.
    """
    if path.suffix.lower() != suffix and (path.is_file() or not path.exists()):
        raise VerbError(f"{path}: {what}, and no other format; its name must end in {suffix}")


class VerbError(Exception):
    """A verb cannot do what was asked of it; the text is one line for a person.

    Args:
        text: the line.
        exit_code: 2 where the command line is wrong, 3 where the machine lacks something.
    """

    def __init__(self, text: str, exit_code: int = 2) -> None:
        super().__init__(text)
        self.exit_code = exit_code
