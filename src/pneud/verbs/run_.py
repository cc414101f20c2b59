"""Go through a program: record by record, as its file says."""

import json as json_
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.console import programs
from pneud.console.client import Client, RefusedError
from pneud.console.going import Sharing, go_through
from pneud.console.records import UNUSABLE, ProgramError
from pneud.console.results import refused, show
from pneud.control.program import MOST_STEPS
from pneud.verbs import (
    AxisOption,
    ConfigOption,
    JsonOption,
    ProgressOption,
    SeedOption,
    SocketOption,
    VerbError,
)
from pneud.view.progress import Report, progress


def run_(
    program: Annotated[
        Path | None, typer.Argument(metavar="[PROGRAM]", help="File (.toml); not with --resume.")
    ] = None,
    record: Annotated[
        str | None, typer.Option("--from", metavar="RECORD", help="Begin there: a number or a label.")
    ] = None,
    cycles: Annotated[
        int | None, typer.Option("--cycles", metavar="N", help="So often; 0: until it is stopped. Default 1.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on in the record that was stopped.")] = False,
    detach: Annotated[
        bool, typer.Option("--detach", help="Do not wait for the end; it goes on without this terminal.")
    ] = False,
    load: Annotated[
        bool, typer.Option("--load", help="Hand it over, for the input start to begin it.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Simulate it, and tell what each record comes to.")
    ] = False,
    config: ConfigOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="With --dry-run: write a log.")
    ] = None,
    seed: SeedOption = 0,
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Have it done, and wait for the end; Ctrl-C has the axis hold.

    Returns:
        Exit status: 0, or 1 where it was refused or has not come to its end.

    Raises:
        ProgramError: the program cannot be used, as this process finds it or the daemon.
    """
    _check_options(program, record, cycles, resume=resume, dry_run=dry_run, load=load)
    if cycles is not None and not 0 <= cycles <= 1_000_000_000:
        raise VerbError(f"run: --cycles {cycles}: is a number from 0 (until it is stopped) to 1,000,000,000")
    tree = programs.tree_of(program) if program is not None else {}
    if program is not None:
        tree.setdefault("name", program.stem)
    first = _first(tree, record)
    if dry_run:
        rounds = 1 if cycles is None else cycles
        with _named(program):
            return _simulate(tree, first, rounds, config, axis, seed, output, json, how)
    if config is not None or output is not None:
        raise VerbError("run: --config and -o are for --dry-run; the daemon has its own")
    fields: dict[str, Any] = {"attended": not detach}
    if not resume:
        fields |= {"program": tree, "record": first, "cycles": 1 if cycles is None else cycles}
    with _named(program), Client(socket, axis) as client:
        try:
            if load:
                reply = client.ask("run", program=tree, load=True)
                show(reply, json, f"{reply['state']}: loaded; the input start begins it")
                return 0
            reply = client.ask("run", **fields)
            if detach:
                show(reply, json, f"{reply['state']}: runs on; pneud status tells where it is")
                return 0
            with progress(how) as report:
                words = f"run {tree['name']}" if program is not None else "run"
                told = Sharing(client, reply["axes"]) if "axes" in reply else client
                found = go_through(told, reply["order"], words, lambda p: _tell(p, cycles, report))
        except RefusedError as e:
            if e.kind == UNUSABLE:
                raise ProgramError(str(e).removeprefix("run: ")) from None
            return refused(e, json)
    show({**reply, "state": found["state"], "program": found["program"]}, json, f"{found['state']}: ended")
    return 0


@contextmanager
def _named(program: Path | None) -> Iterator[None]:
    """What is wrong with a program is told with its file, whoever has found it."""
    try:
        yield
    except ProgramError as e:
        raise ProgramError(f"{program}: {e}") from None


def _check_options(
    program: Path | None, record: str | None, cycles: int | None, *, resume: bool, dry_run: bool, load: bool
) -> None:
    if load and (record is not None or cycles is not None or dry_run):
        raise VerbError("run: --load begins nothing; io.start_cycles says how often the input has it done")
    if resume and (program is not None or record is not None or cycles is not None or dry_run or load):
        raise VerbError("run: --resume goes on with the program that was stopped, as it was begun")
    if program is None and not resume:
        raise VerbError("run: give PROGRAM, a file, or --resume")


def _first(tree: dict[str, Any], record: str | None) -> int:
    """The number of the record to begin with."""
    if record is None:
        return 1
    if record.isdecimal():
        if not 1 <= int(record) <= MOST_STEPS:
            raise VerbError(f"run: --from {record}: records count from 1 to {MOST_STEPS} at most")
        return int(record)
    listed = tree.get("record")
    labels = (
        [r.get("label") if isinstance(r, dict) else None for r in listed] if isinstance(listed, list) else []
    )
    if record not in labels:
        raise VerbError(f"run: --from {record}: no record has that label")
    return labels.index(record) + 1


def _tell(program: dict[str, Any], cycles: int | None, report: Report) -> None:
    of, done = program["of"] or 1, program["cycle"]
    total = math.inf if cycles is None else cycles * of
    report(
        str(program["words"] or "record"), done * of + program["record"], total if cycles else of, "records"
    )


def _simulate(
    tree: dict[str, Any],
    first: int,
    cycles: int,
    config: str | None,
    axis: str | None,
    seed: int,
    output: Path | None,
    json: bool,
    how: str,
) -> int:
    """Do it in simulated time."""
    from pneud.compiled import slow  # noqa: PLC0415
    from pneud.loading import load, load_axes  # noqa: PLC0415 - a simulation, which others need not load
    from pneud.replay import dry_run  # noqa: PLC0415

    if cycles == 0:
        raise VerbError("run: --dry-run ends: give --cycles a number from 1 on")
    axes = load_axes(config or "virtual.toml")
    if len(axes) > 1 and axis is None:
        found = programs.compiled(tree, [programs.facts_of(one.config) for one in axes])
        with progress(how) as report:
            each = dry_run.dry_run_together(axes, found, first, cycles, seed, output, report)
        if json:
            found_each = {name: one.summary for name, one in each.items()}
            print(json_.dumps({"schema": 1, "axes": found_each, **slow.field()}))
        else:
            print("\n\n".join(f"axis {name}:\n{dry_run.in_words(one)}" for name, one in each.items()))
        return 0 if all(one.good for one in each.values()) else 1
    loaded = load(config or "virtual.toml", axis=axis)
    found = programs.compiled(tree, [programs.facts_of(loaded.config)])
    with progress(how) as report:
        ran = dry_run.dry_run(loaded, found, first, cycles, seed, output, report)
    print(json_.dumps(ran.summary | slow.field()) if json else dry_run.in_words(ran))
    return 0 if ran.good else 1
