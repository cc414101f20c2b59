"""docs/cli.md: every verb with its arguments and options, as the command line itself knows them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer

from generators.tables import HEAD, table
from pneud import cli

_INTRO = """\
# Command line

{head}

`pneud` with options and without a verb is the daemon; `pneud VERB` does one thing and ends. Each has `--help`. Lengths are
millimetres and times seconds unless a name says otherwise. Exit status: 0 done, 1 it ran and the answer is no, 2 usage or
configuration, 3 the machine lacks something. [What scripts need to know](command-line.md) has JSON, progress and completion,
which `pneud --install-completion` sets up.

## The daemon

`pneud --virtual`, or `pneud --config FILE --bus BUS`.
"""
_COLUMNS = ("option", "", "default")
_TYPERS_OWN = ("install_completion", "show_completion", "help")


def _choices(function: Callable[..., Any], name: str) -> str:
    """The words that a parameter may be, where they are a list."""
    kinds: list[Any] = [get_type_hints(function, include_extras=True).get(name)]
    while kinds:
        kind = kinds.pop()
        if get_origin(kind) is Literal:
            return "/".join(map(str, get_args(kind)))
        kinds += get_args(kind)[:1] if get_origin(kind) is Annotated else get_args(kind)
    return ""


def _value(parameter: Any, function: Callable[..., Any]) -> str:
    """What stands behind an option."""
    if getattr(parameter, "is_flag", False):
        return ""
    return (
        parameter.metavar
        or _choices(function, parameter.name)
        or ("N" if isinstance(parameter.default, int) else "TEXT")
    )


def _default(parameter: Any) -> str:
    """What holds where it is left out, if that says anything."""
    value = parameter.default
    if isinstance(value, bool) or not isinstance(value, int | float | str) or value == "":
        return ""
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


def _rows(command: Any, function: Callable[..., Any]) -> Iterator[tuple[str, str, str]]:
    for parameter in command.params:
        if getattr(parameter, "hidden", False) or parameter.name in _TYPERS_OWN:
            continue
        names = (
            ""
            if parameter.param_type_name == "argument"
            else "`, `".join((*parameter.opts, *parameter.secondary_opts))
        )
        words = f"{names} {_value(parameter, function)}".strip()
        yield f"`{words}`", parameter.help or "", _default(parameter)


def _section(words: str, command: Any, function: Callable[..., Any], depth: int) -> Iterator[str]:
    yield f"\n{'#' * depth} pneud {words}\n\n{command.help}\n"
    if rows := list(_rows(command, function)):
        yield table(_COLUMNS, rows)


def _verb(name: str) -> Iterator[str]:
    module = importlib.import_module(f"pneud.verbs.{cli.verbs()[name].stem}")
    main: Any = typer.main.get_command(cli.app)
    named = main.get_command(typer.Context(main), name)
    command: Any = typer.main.get_command(named._load())
    inner = getattr(module, "VERBS", {})
    if not inner:
        yield from _section(name, command, getattr(module, cli.verbs()[name].stem), 3)
        return
    yield f"\n### pneud {name}\n\n{named.help}\n"
    for word, function in inner.items():
        yield from _section(f"{name} {word}", command.commands[word], function, 4)


def text() -> str:
    """The page."""
    rows = list(_rows(typer.main.get_command(cli.app), cli.daemon))
    lines = [_INTRO.format(head=HEAD.format(name="cli")), table(_COLUMNS, rows)]
    for title, names in (*cli.GROUPS.items(), (cli.OTHERS, [n for n in cli.verbs() if n not in cli.ORDER])):
        lines += [f"\n## {title}"] if names else []
        for name in names:
            lines += _verb(name)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(text(), end="")
