"""Feed a log's frames and requests through the axis again and compare every command."""

from __future__ import annotations

import json as json_
import math
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.bus.link import open_link, refuse_if_driven
from pneud.compiled import slow
from pneud.config.models import Config
from pneud.config.reading import load_with_text as load_text
from pneud.config.reading import parse, with_settings
from pneud.config.sections import ConfigError, check_channel
from pneud.console.tuning import settings_of
from pneud.loading import codecs_of
from pneud.log.files.reader import LogReader, read_log
from pneud.loop.summary import finite
from pneud.replay import courses
from pneud.replay.differences import Differences, compare
from pneud.replay.playing import play
from pneud.replay.replaying import ReplayOutcome
from pneud.replay.replaying import replay as run
from pneud.report.timing import in_words
from pneud.rt.extras import require
from pneud.rt.outputs import require_folder
from pneud.study.running import doubts_of
from pneud.verbs import (
    JsonOption,
    LogsArgument,
    ProgressOption,
    complete_config,
    complete_key,
    complete_log,
    watch,
    whole,
)
from pneud.view.progress import progress

_ROWS = 12  # of the table of differences


def replay(
    logs: LogsArgument,
    config: Annotated[
        str | None,
        typer.Option(
            "--config",
            metavar="FILE",
            help="What if: another configuration.",
            autocompletion=complete_config,
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="What if: another value, by its key or as in tune.",
            autocompletion=complete_key,
        ),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            "--against",
            metavar="LOG2",
            help="Compare with another log instead.",
            autocompletion=complete_log,
        ),
    ] = None,
    begin_s: Annotated[
        float, typer.Option("--from", metavar="S", help="Begin so long after the log's start.")
    ] = 0.0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Both courses as a picture (.png).")
    ] = None,
    bus: Annotated[
        str | None,
        typer.Option("--bus", metavar="BUS", help="Play its frames on vcan0 or unixcan:NAME instead."),
    ] = None,
    speed: Annotated[
        float, typer.Option("--speed", metavar="FACTOR", help="With --bus: how much faster than it was.")
    ] = 1.0,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Replay a log and say how it compares, compare it with another one, or play it on a bus.

    Returns:
        Exit status: 0 where every command is the same (or equivalent on another numeric machine), 1 where
        one differs or the log was never engaged; of a log that is played on a bus 0 if all frames were sent.
    """
    if not begin_s >= 0.0 or not math.isfinite(begin_s):
        raise ConfigError(f"--from {begin_s:g}: must be a time in seconds, not below 0")
    if not speed > 0.0 or not math.isfinite(speed):
        raise ConfigError(f"--speed {speed:g}: must be above 0")
    given = {"--config": config, "--set": settings, "--from": begin_s, "-o": output, "--bus": bus}
    if against is not None:
        _alone("--against compares two logs as they are", given, ("-o",))
    elif bus is not None:
        _alone("--bus plays the log's frames", given, ("--from", "--bus"))
    if output is not None:
        _check_picture(output)
    log = read_log(*logs)
    if bus is not None:
        return _play(log, _channel(bus), speed, begin_s, json, how)
    if against is not None:
        return _against(log, read_log(against), output, json, how)
    return _again(log, _config(log, config, settings or []), begin_s, output, json, how)


def _alone(what: str, given: Mapping[str, object], but: tuple[str, ...]) -> None:
    wrong = [name for name, value in given.items() if value and name not in but]
    if wrong:
        raise ConfigError(f"{what}; {wrong[0]} does not go with it")


def _check_picture(output: Path) -> None:
    if output.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise ConfigError(f"{output}: a picture's name ends in .png, .svg or .pdf")
    require_folder(output)
    require("replay -o", "plots")


def _config(log: LogReader, file: str | None, settings: list[str]) -> Config | None:
    if file is None and not settings:
        return None
    text, name = log.config_text, f"{log.path}:{log.config_name}"
    if file is not None:
        _, text, path = load_text(file)
        name = str(path)
    found = with_settings(text, name, [s for setting in settings for s in settings_of(setting)])
    for doubt in doubts_of(found):
        print(f"pneud: warning: {doubt}", file=sys.stderr)
    return found


def _again(
    log: LogReader, what_if: Config | None, begin_s: float, output: Path | None, json: bool, how: str
) -> int:
    differences = None
    if what_if is not None or output is not None:
        differences = Differences(exact=log.metadata.get("detail") == "full")
    told = differences if what_if is not None else None
    with progress(how) as report:
        watch(report, log)
        outcome = run(log, what_if, begin_s, differences.add if differences is not None else None)
        timing = in_words(log) if not json and told is None and outcome.ticks else []
    if differences is not None and output is not None:
        courses.write(differences.points, ("log", "replay"), output)
    if json:
        more = {} if told is None else {"differences": _spreads(told)}
        print(json_.dumps(_result(outcome) | more | slow.field()))
    else:
        _say(outcome)
        if told is not None:
            _tell(told)
        for line in timing:
            print(line)
    return 0 if outcome.good else 1


def _result(o: ReplayOutcome) -> dict[str, Any]:
    return {
        "schema": 1,
        "ticks": o.ticks,
        "commands": o.commands,
        "mismatches": o.mismatches,
        "first_mismatch_tick": o.first.tick if o.first is not None else None,
        "engaged_ticks": o.engaged_ticks,
        "identical": o.identical,
        "equivalent": o.equivalent,
        "fingerprint": "same" if o.same_fingerprint else "different",
        "truncated": o.truncated,
    }


def _say(o: ReplayOutcome) -> None:
    if o.truncated:
        print(f"not whole: {o.damage}; {o.ticks} ticks could be replayed")
    if o.first is not None:
        print(f"{o.mismatches} of {o.ticks} ticks differ; first at {o.first}")
    if o.identical:
        print(f"identical: {o.commands} commands in {o.ticks} ticks, {o.engaged_ticks} of them engaged")
    elif o.good:
        print(
            f"equivalent on this machine, whose mathematics rounds differently:"
            f" all {o.commands} commands within one step on the wire"
        )
    if o.engaged_ticks == 0:
        print("the axis was never engaged in this log, so the replay proves nothing")


def _spreads(d: Differences) -> dict[str, dict[str, float | None]]:
    found: dict[str, dict[str, float | None]] = finite({n: s._asdict() for n, s in d.spreads().items()})
    return found


def _tell(d: Differences) -> None:
    spreads = d.spreads()
    if not spreads:
        return
    print(f"{'variable':28} {'ticks':>8} {'first at':>9} {'max':>11} {'at':>9} {'rms':>11}")
    for name, s in list(spreads.items())[:_ROWS]:
        print(f"{name:28} {s.ticks:8} {s.first_tick:9} {s.max:11.4g} {s.max_tick:9} {s.rms:11.4g}")
    if len(spreads) > _ROWS:
        print(f"and {len(spreads) - _ROWS} more (--json lists all)")


def _against(one: LogReader, other: LogReader, output: Path | None, json: bool, how: str) -> int:
    with progress(how) as report:
        watch(report, one)
        c = compare(one, other)
    d = c.differences
    if output is not None:
        courses.write(d.points, (one.path.name, other.path.name), output)
    spreads = d.spreads()
    if json:
        first = next(iter(spreads.values())).first_tick if spreads else None
        result = {
            "schema": 1,
            "ticks": d.ticks,
            "mismatches": d.differing,
            "first_mismatch_tick": first,
            "engaged_ticks": c.engaged_ticks,
            "shift_ticks": c.shift_ticks,
            "identical": d.ticks > 0 and not spreads,
            "differences": _spreads(d),
        }
        print(json_.dumps(result))
    elif spreads:
        name, s = next(iter(spreads.items()))
        print(f"{d.differing} of {d.ticks} ticks differ; first at tick {s.first_tick}: {name}")
        _tell(d)
    elif not d.ticks:
        print("there is no tick that both have, so there is nothing to compare")
    else:
        print(f"the same in {d.ticks} ticks, {c.engaged_ticks} of them engaged")
    whole(one, other)
    if c.shift_ticks and not json:
        print(f"the second log is engaged {c.shift_ticks:+} ticks later and was shifted by that")
    return 0 if d.ticks and not spreads else 1


def _channel(name: str) -> str:
    channel = name if ":" in name else f"socketcan:{name}"
    try:
        check_channel(channel)
    except ValueError as e:
        raise ConfigError(f"--bus: {e}") from None
    if channel == "auto":
        raise ConfigError("--bus auto: name the bus that the other program listens on")
    return channel


def _play(log: LogReader, channel: str, speed: float, begin_s: float, json: bool, how: str) -> int:
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    logged = parse(log.config_text, log.config_name)
    fd = codecs_of(logged.bus, log.dbc_name, log.dbc, logged.gas).fd if logged.bus.fd else None
    ids = {frame.can_id for tick in _first(log) for frame in tick}
    with open_link(channel, virtual=True, fd=fd) as link:
        refuse_if_driven(link, ids, what="another node answers there")
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        with progress(how) as report:
            watch(report, log)
            done = play(log, link, speed, begin_s, lambda: stopped)
    if json:
        result = {"schema": 1, "frames": done.frames, "failed": done.failed, "late_ms": done.late_ms}
        print(json_.dumps({**result, "truncated": log.truncated}))
    else:
        print(f"{done.frames} frames on {channel}, the latest {done.late_ms:.1f} ms after its time")
        if done.failed:
            print(f"pneud: {done.failed} frames could not be sent", file=sys.stderr)
        whole(log)
    return 0 if done.frames and not done.failed else 1


def _first(log: LogReader) -> list[tuple[Any, ...]]:
    """The frames of the first ticks, by which one knows who sends on a bus already."""
    found = []
    for tick in log:
        found.append(tick.frames)
        if len(found) == 100:
            break
    return found
