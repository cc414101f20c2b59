"""What is on a bus, live or recorded, beside a DBC, and the table that says which signal is what."""

from __future__ import annotations

import json as json_
import signal
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud import resources
from pneud.bus.link import open_link
from pneud.bus.wire import Fd
from pneud.config.reading import load_with_text
from pneud.config.sections import ConfigError, check_channel
from pneud.config.toml import TomlError, tables_of
from pneud.config.writing import rewrite
from pneud.crew import asked_to_leave
from pneud.replay.remarks import Remarks
from pneud.rt.outputs import replacing
from pneud.study.mapping import found as shown
from pneud.study.mapping.decoding import Decoder
from pneud.study.mapping.found import Found, look
from pneud.study.mapping.guessing import VALUES
from pneud.study.mapping.sources import heard, recorded
from pneud.study.mapping.watching import Watch
from pneud.verbs import JsonOption, ProgressOption, VerbError, complete_config
from pneud.view.progress import each, progress

LOOK_S = 1.0  # between two looks at a bus that is listened to


def _of(option: str, what: str) -> Any:
    return typer.Option(option, metavar="M.S", help=f"MESSAGE.SIGNAL that is {what}; or none.")


def map_(
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Recording: .log (candump -l), .asc, .blf, or a log of pneud."),
    ] = None,
    bus: Annotated[
        str | None,
        typer.Option("--bus", metavar="BUS", help="To listen on: socketcan:IF or unixcan:NAME."),
    ] = None,
    dbc: Annotated[
        Path | None, typer.Option("--dbc", metavar="FILE", help="The messages; default the configuration's.")
    ] = None,
    config_file: Annotated[
        str | None,
        typer.Option("--config", metavar="FILE", help="Of the axis.", autocompletion=complete_config),
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", help="How long to listen; push the rod meanwhile.")
    ] = 10.0,
    position: Annotated[str | None, _of("--position", "the position")] = None,
    p1: Annotated[str | None, _of("--p1", "the pressure at the cap end")] = None,
    p2: Annotated[str | None, _of("--p2", "the pressure at the rod end")] = None,
    supply: Annotated[str | None, _of("--supply", "the supply's pressure")] = None,
    voltage: Annotated[str | None, _of("--voltage", "the command")] = None,
    fill: Annotated[
        list[str] | None,
        typer.Option("--fill", metavar="KEY=M.S", help="Likewise of any other value, such as applied_v."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="Where the table goes; a configuration keeps the rest."
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Replace a table without asking.")] = False,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Listen, say what was heard, and what the mapping may be. It sends nothing.

    Returns:
        Exit status: 0, or 1 where nothing was heard.

    Raises:
        ConfigError: an option cannot be used.
        DatabaseError: the DBC cannot be used.
        LinkError: the bus cannot be used.
        LogError: the recording cannot be read.
        VerbError: there is no source, or nobody to ask whether a table may be replaced.
    """
    given = _given(
        {"position_m": position, "p1_pa": p1, "p2_pa": p2, "supply_pa": supply, "voltage_v": voltage}, fill
    )
    decoder = _decoder(dbc, config_file)
    _check_names(given, decoder)
    watch = Watch(_sync_id(decoder))
    remarks = Remarks()
    if recording is not None:
        with progress(how) as report:
            watch.add(each(recorded(recording, remarks), report, recording.name, 0, "frames"))
    elif bus is not None:
        _listen(watch, bus, seconds, decoder, given, quiet=json)
    else:
        raise VerbError("name a recording, or a bus with --bus")
    for line in remarks.lines():
        print(line, file=sys.stderr)
    if not watch.frames:
        print(f"pneud: nothing was heard on {bus or recording}", file=sys.stderr)
    found = look(watch, decoder, given)
    if output is not None and watch.frames:
        _write(output, found, decoder, yes)
    if json:
        print(json_.dumps({"schema": 1, "source": str(bus or recording)} | shown.as_json(found)))
    elif watch.frames:
        _print(found, decoder, written=output is not None)
    return 0 if watch.frames else 1


def _given(options: dict[str, str | None], fill: list[str] | None) -> dict[str, str]:
    """What a person says fills the values."""
    given = {key: name for key, name in options.items() if name is not None}
    for text in fill or ():
        key, _, name = text.partition("=")
        if key not in VALUES or not name:
            raise ConfigError(f"--fill {text}: KEY=MESSAGE.SIGNAL, with KEY one of {', '.join(VALUES)}")
        given[key] = name
    return given


def _check_names(given: dict[str, str], decoder: Decoder | None) -> None:
    for key, name in given.items():
        if name == "none":
            continue
        message, dot, of_it = name.partition(".")
        specs = [] if decoder is None else [m for m in decoder.messages.values() if m.name == message]
        if not dot or not any(s.name == of_it for m in specs for s in m.signals):
            where = (
                "there is no DBC; name one with --dbc" if decoder is None else f"not in {decoder.path.name}"
            )
            raise ConfigError(f"{key} = {name}: {where}; it is MESSAGE.SIGNAL")


def _decoder(dbc: Path | None, config_file: str | None) -> Decoder | None:
    if dbc is not None:
        return Decoder(dbc)
    if config_file is None:
        return None
    config, _, path = load_with_text(config_file)
    try:
        return Decoder(resources.find(config.bus.dbc, path.parent))
    except FileNotFoundError as e:
        raise ConfigError(f"{path}: bus.dbc: {e}") from None


def _sync_id(decoder: Decoder | None) -> int:
    named = (i for i, m in (decoder.messages if decoder else {}).items() if m.name.upper() == "SYNC")
    return next(named, 0x080)


def _listen(
    watch: Watch, bus: str, seconds: float, decoder: Decoder | None, given: dict[str, str], *, quiet: bool
) -> None:
    """Hear a bus, and show now and then what moves."""
    try:
        check_channel(bus)
    except ValueError as e:
        raise ConfigError(f"--bus: {e}") from None
    if bus == "auto":
        raise ConfigError(
            "--bus auto would find another bus than the one meant; name one, such as socketcan:can0"
        )
    stop = asked_to_leave(signal.SIGINT, signal.SIGTERM)
    known = () if decoder is None else decoder.messages.values()
    fd = Fd(frozenset(), False) if any(m.fd or m.length > 8 for m in known) else None
    with open_link(bus, listens=True, fd=fd) as link:
        print(
            f"listening on {bus} for {seconds:g} s; push the rod; Ctrl-C ends it", file=sys.stderr, flush=True
        )
        portions = heard(link, seconds, stop)
        if quiet:
            for frames in portions:
                watch.add(frames)
        elif sys.stderr.isatty():
            _watch_live(watch, portions, decoder, given)
        else:
            _watch_plainly(watch, portions, decoder, given)


def _looks(
    watch: Watch, portions: Iterable[Sequence[Any]], decoder: Decoder | None, given: dict[str, str]
) -> Iterable[Found]:
    """What was found so far, about once a second."""
    due = 0.0
    for frames in portions:
        watch.add(frames)
        if watch.frames and watch.seconds >= due:
            due = watch.seconds + LOOK_S
            yield look(watch, decoder, given)


def _watch_live(
    watch: Watch, portions: Iterable[Sequence[Any]], decoder: Decoder | None, given: dict[str, str]
) -> None:
    from rich.console import Console, Group  # noqa: PLC0415 - for a terminal alone
    from rich.live import Live  # noqa: PLC0415

    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:
        for found in _looks(watch, portions, decoder, given):
            rows = shown.signal_rows(found, now=True)[:15]
            live.update(
                Group(
                    _rich("on the bus", shown.MESSAGES_HEAD, shown.message_rows(found)),
                    _rich("what moves now", shown.SIGNALS_HEAD, rows),
                ),
                refresh=True,
            )


def _rich(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Any:
    from rich.table import Table  # noqa: PLC0415 - for a terminal alone

    table = Table(*head, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    return table


def _watch_plainly(
    watch: Watch, portions: Iterable[Sequence[Any]], decoder: Decoder | None, given: dict[str, str]
) -> None:
    for found in _looks(watch, portions, decoder, given):
        moving = [row[0] for row in shown.signal_rows(found, now=True) if row[5]]
        names = ", ".join(moving) or "nothing"
        told = f"{found.seconds:5.1f} s  {len(found.messages)} messages; moving: {names}"
        print(told, file=sys.stderr, flush=True)


def _print(found: Found, decoder: Decoder | None, *, written: bool) -> None:
    print(f"{len(found.messages)} messages in {found.seconds:.3g} s")
    _lines(shown.MESSAGES_HEAD, shown.message_rows(found))
    if decoder is not None:
        print()
        _lines(shown.SIGNALS_HEAD, shown.signal_rows(found))
        for doubt in found.guess.doubts:
            print(f"pneud: {doubt}", file=sys.stderr)
        if not written:
            print()
            print(shown.table(found, decoder.path.name), end="")


def _lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _write(path: Path, found: Found, decoder: Decoder | None, yes: bool) -> None:
    """Write the table: into a configuration, or as a file of its own."""
    if decoder is None:
        raise VerbError("there is nothing to write without a DBC; name one with --dbc")
    if path.exists() and not yes:
        if not sys.stdin.isatty():
            raise VerbError(
                f"{path}: is there already; nobody is there to ask, and --yes replaces its mapping"
            )
        print(f"{path}: replace its mapping? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise VerbError(f"{path}: left as it is")
    if path.exists() and not _is_table(path):
        rewrite(path, lambda tables: shown.put(tables.setdefault("bus", {}), found, decoder.path.name))
        return
    with replacing(path) as beside:
        beside.write_text(shown.table(found, decoder.path.name), encoding="utf-8")


def _is_table(path: Path) -> bool:
    """Whether a file has a mapping and nothing else."""
    try:
        return tables_of(path.read_text(encoding="utf-8-sig")).keys() == {"bus"}
    except (TomlError, UnicodeDecodeError) as e:
        raise ConfigError(f"{path}: {e}") from None
