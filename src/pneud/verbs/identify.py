"""Parameters of a rig with their intervals from logs of any run, and what has changed."""

from __future__ import annotations

import json as json_
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pneud.config.reading import load_config
from pneud.log.files.reader import LogReader, read_log
from pneud.rt.extras import require
from pneud.rt.outputs import require_folder, write_whole
from pneud.verbs import JsonOption, LogsArgument, ProgressOption, VerbError, require_suffix, watch, whole
from pneud.view.progress import progress

if TYPE_CHECKING:
    from pneud.study.identification.comparing import Row
    from pneud.study.identification.estimating import Identified


def identify(
    logs: LogsArgument,
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="Compare with this one, not with that in the log."),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option("--against", metavar="FILE", help="What 'pneud identify --json' printed before."),
    ] = None,
    kept: Annotated[
        Path | None,
        typer.Option(
            "--wear",
            metavar="FILE",
            help="Keep it in this file, a line each time, and compare with its first ones; of a folder, the"
            " newest logs.",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="A page with pictures (.html).")
    ] = None,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Estimate what a rig is like, and compare that with its configuration and with an earlier estimate.

    Returns:
        Exit status: 0 where all that the logs tell is as configured and as before, within the tolerances, and
        the model explains the rig; 1 where not, or where a log could not be read to its end. With `--wear` 1
        means that something has worn, and nothing else.

    Raises:
        ConfigError: a configuration, or the earlier estimate, cannot be used.
        LogError: not logs that this version reads, or too little in them.
        ExtraError: scipy is missing.
        OSError: the page, or what is kept, cannot be written.
    """
    require("identify", "identify")
    from pneud.study.identification import (  # noqa: PLC0415
        comparing,
        courses,
        estimating,
        explaining,
        page,
        table,
        wear,
        words,
    )

    if kept is not None and against is not None:
        raise VerbError(
            "--wear compares with what it has kept, --against with another file; give one of them"
        )

    if output is not None:
        require_suffix(output, ".html", "the report is a page of HTML")
        require_folder(output)
    earlier = comparing.earlier(against) if against is not None else comparing.Earlier("", {})
    before = earlier.parameters
    given = load_config(config) if config is not None else None
    if kept is not None:
        require_folder(kept)
    entries = wear.history(kept) if kept is not None else []
    readers = _readers(logs, newest=kept is not None)
    with progress(how) as report:
        watch(report, *readers)
        measured, own = table.read(readers, given)
        c = given or own
        for path, axis in ((against, earlier.axis), *((kept, entry.axis) for entry in entries)):
            if path is not None:
                comparing.check_axis(path, axis, own.name)
        report("estimating", 0, 0, "")
        found = estimating.identify(measured, c)
    if kept is not None:
        now = wear.entry(readers, found.parameters, own.name)
        entries = [e for e in entries if e.logs != now.logs]
        before = wear.at_first(entries)
        entries.append(now)
        wear.write(kept, entries)
    elif given is None:
        _say_whose(readers, table.differing(readers))
    rows = comparing.rows(found.parameters, before)
    unexplained = explaining.unexplained(found.valved, found.moved, found.noise_pa, c)
    verdict = words.verdict(rows, unexplained)
    if json:
        print(json_.dumps({**_as_json(found, rows, unexplained, verdict), "axis": own.name}))
    else:
        print("\n".join([*words.table(rows), *_said(found, unexplained, verdict)]))
    if output is not None:
        title = f"{c.name}: {', '.join(reader.path.name for reader in readers)}"
        said = _said(found, unexplained, verdict)
        more = [courses.section(entries)]
        write_whole(output, page.page(title, said, [page.parameters(rows)], page.maps(found, c), more))
    undamaged = whole(*readers)
    if kept is not None:
        return 1 if verdict == "worn" else 0
    return 0 if undamaged and verdict in ("agrees", "unknown") else 1


def _readers(logs: Sequence[str], newest: bool) -> list[LogReader]:
    """The logs; of a folder all parts of the one in it, or the newest logs in it.

    Raises:
        LogError: there is none.
    """
    from pneud.study.identification import wear  # noqa: PLC0415

    found: list[LogReader] = []
    for log in map(Path, logs):
        found += wear.newest(log) if newest and log.is_dir() else [read_log(log)]
    return found


def _say_whose(readers: Sequence[LogReader], differing: Sequence[tuple[LogReader, Sequence[str]]]) -> None:
    """With which configuration is compared, where the logs have several."""
    for log, keys in differing:
        last = readers[-1].path.name
        words = f"{', '.join(keys)}; compared with that of {last}"
        print(f"pneud: {log.path}: was configured otherwise than {last}: {words}", file=sys.stderr)


def _said(found: Identified, unexplained: Sequence[str], verdict: str) -> list[str]:
    lines = [f"verdict: {verdict}"]
    lines += [f"the model cannot explain {text}" for text in unexplained]
    lines += [f"hardly told apart: {one} and {other} ({r:+.2f})" for one, other, r in found.linked]
    return lines + [f"not told: {note}" for note in found.notes]


def _as_json(
    found: Identified, rows: Sequence[Row], unexplained: Sequence[str], verdict: str
) -> dict[str, Any]:
    from pneud.study.identification.comparing import SCHEMA, as_json  # noqa: PLC0415

    return {
        "schema": SCHEMA,
        "verdict": verdict,
        "parameters": {
            row.key: {**as_json(row.estimate), "verdict": row.verdict, "worn": row.worn} for row in rows
        },
        "before": {row.key: as_json(row.before) for row in rows if row.before is not None},
        "after": {},
        "faults": [],
        "unexplained": list(unexplained),
        "linked": [{"keys": [one, other], "correlation": r} for one, other, r in found.linked],
        "notes": found.notes,
        "left": {
            "pressure_pa": None if found.valved is None else found.valved.misfit_pa,
            "noise_pa": found.noise_pa,
            "force_n": None if found.moved is None else found.moved.misfit_n,
        },
    }
