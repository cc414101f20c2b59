"""The verbs: one module each, and here the options that several of them have.

A module's name is the verb's, its first line is what `pneud --help` says of it, and its function of that name
has the options as its signature and returns the exit status. What it raises with an `exit_code`, and what
the machine refuses, ends it with one line: see `cli`. A verb that has verbs of its own names them in `VERBS`.
`run` is the daemon, which is no verb.
"""

import sys
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pneud.log.files.reader import LogReader

ConfigOption = Annotated[
    str | None, typer.Option("--config", metavar="FILE", help="Configuration; default virtual.toml.")
]
BusOption = Annotated[
    str | None, typer.Option("--bus", metavar="BUS", help="auto, socketcan:IF or unixcan:NAME.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
SocketOption = Annotated[str | None, typer.Option("--socket", metavar="PATH", help="The daemon's socket.")]
ScenarioOption = Annotated[
    str | None, typer.Option("--scenario", metavar="NAME", help="Faults to inject: pneud's own, or a file.")
]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of the plant's noise.")]


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


class VerbError(Exception):
    """A verb cannot do what was asked of it; the text is one line for a person.

    Args:
        text: the line.
        exit_code: 2 where the command line is wrong, 3 where the machine lacks something.
    """

    def __init__(self, text: str, exit_code: int = 2) -> None:
        super().__init__(text)
        self.exit_code = exit_code
