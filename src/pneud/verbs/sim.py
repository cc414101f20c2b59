"""The same axis and plant in simulated time, faster than real time, the same for a seed."""

from __future__ import annotations

import json as json_
import os
import shutil
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.axis.stops import soft_limits
from pneud.compiled import slow
from pneud.config.conversions import axis_of, cylinder_of
from pneud.config.sections import ConfigError
from pneud.console import profiles
from pneud.console.profiles import ProfileError
from pneud.control.reference import Bounds, Septic
from pneud.loading import Loaded, Together, load, load_axes
from pneud.log.files.naming import log_path, new_log
from pneud.log.files.writer import LogWriter
from pneud.loop.summary import in_words, summarise
from pneud.replay.following import Following
from pneud.replay.following import in_words as followed
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.moves import Course, MovesError, check, moves_of, steps_of
from pneud.replay.moves import in_words as moves_in_words
from pneud.replay.running import TOLD_TICKS, Ran, through
from pneud.replay.running_together import run_together
from pneud.rt.extras import cure, missing
from pneud.rt.outputs import require_folder, write_whole
from pneud.scenario import verdict
from pneud.scenario.files import in_simulation, load_axis, load_scenario
from pneud.scenario.format import Scenario
from pneud.signals import Record, State
from pneud.study import comparison_page
from pneud.study.comparison import WIDEST, as_json, compare
from pneud.study.comparison import in_words as compared
from pneud.verbs import (
    AxisOption,
    JsonOption,
    ProgressOption,
    ScenarioOption,
    SeedOption,
    VerbError,
    complete_config,
    require_suffix,
)
from pneud.view.progress import Report, progress

DURATION_S = 10.0
MOVE_S = 20.0  # at most, of each
MOST_REST_S = 600.0
NO_LOG = -1
CHIRP_M, CHIRP_HZ, CHIRP_S = 0.01, (0.2, 2.0), 20.0
DWELL_S = 1.0  # at each of the steps
GotoOption = Annotated[
    str | None,
    typer.Option(
        "--goto",
        metavar="MM[@MM_S],…",
        help="Go to positions in turn, in place of tracking; 200N[@N_S] among them presses.",
    ),
]
TrackOption = Annotated[
    str | None,
    typer.Option(
        "--track",
        metavar="PROFILE",
        help="Follow FILE.csv, FILE.json, chirp, or steps:MM,MM,… in place of the reference.",
    ),
]
ConfigArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="FILE", help="Configuration; default virtual.toml.", autocompletion=complete_config
    ),
]
LogOption = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="FILE", help="Write a log (.mcap); with --compare, a page."),
]
DurationOption = Annotated[
    float | None, typer.Option("--duration", metavar="S", help="Simulated time; default 10 s.")
]
CompareOption = Annotated[
    bool,
    typer.Option(
        "--compare", help="The law against its baselines, case by case; --duration is that of the rest."
    ),
]


def sim(
    config_file: ConfigArgument = None,
    output: LogOption = None,
    duration_s: DurationOption = None,
    goto: GotoOption = None,
    track: TrackOption = None,
    scenario_file: ScenarioOption = None,
    axis: AxisOption = None,
    seed: SeedOption = 0,
    laws: CompareOption = False,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Simulate an axis, or compare its laws.

    Returns:
        Exit status: 0 where the axis tracks until the end, or has come to all positions, or to the end of the
        profile; 1 where not.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        LogError: the log cannot be written.
        BuildError: the compiled law is required and cannot be had.
        MovesError: the positions make no sense, or the axis may not go there.
        VerbError: an option does not go with another.
    """
    if laws:
        if seed or any(given is not None for given in (scenario_file, goto, track)):
            raise VerbError(
                "--compare has its own seed and cases; leave out --seed, --scenario, --goto, --track"
            )
        if output is not None:
            require_suffix(output, ".html", "--compare writes no log but a page of HTML")
            require_folder(output)
        rest_s = DURATION_S if duration_s is None else duration_s
        return _compare(load(config_file or "virtual.toml", axis=axis), rest_s, output, json, how)
    if axis is None and len(axes := load_axes(config_file or "virtual.toml")) > 1:
        if not [scenario_file, goto, track].count(None) == 3 or (output is not None and output.suffix):
            raise VerbError("of several axes, tracking is simulated, with -o FOLDER; choose one with --axis")
        return _together(axes, DURATION_S if duration_s is None else duration_s, seed, output, json, how)
    if output is not None and output.suffix and not output.is_dir():  # else it is a folder
        require_suffix(output, ".mcap", "a log is an MCAP file")
    if [scenario_file, goto, track].count(None) < 2:
        raise VerbError("--goto, --track: a scenario's verdict is on tracking; give one of the three")
    scenario = in_simulation(load_scenario(scenario_file)) if scenario_file is not None else None
    loaded = load_axis(config_file, None, scenario, axis)
    course = _operator(goto, track, loaded)
    if duration_s is None:
        duration_s = _usual_s(scenario, course)
    _check_duration(duration_s)
    law = backend_of(loaded)
    operator = course.ask if course is not None else None
    run = Simulation(loaded, duration_s, seed, law, scenario=scenario, operator=operator)
    path = log_path(str(output), loaded.config.name) if output is not None else None
    with (
        new_log(path) if path is not None else nullcontext(NO_LOG) as descriptor,
        progress(how) as report,
    ):
        played = {"scenario": scenario.name} if scenario is not None else {}
        header = header_of(loaded, seed=str(seed), law=law.name, **played)
        writer = LogWriter(descriptor, header) if path is not None else None
        tally, seen = _run(run, duration_s, loaded.config.loop.rate_hz, writer, course, report)
        whole = writer is None or (writer.close() and not writer.unwritten)
    if writer is not None and not whole:
        why = os.strerror(writer.error) if writer.error > 0 else "some ticks fit into no log"
        print(f"pneud: {path}: could not be written whole: {why}", file=sys.stderr)
    summary = summarise(
        tally,
        bus="simulated",
        rate_hz=loaded.config.loop.rate_hz,
        counts=run.inbox.counts(),
        tx=run.tx,
        rx_dropped=0,
        log=str(path) if path is not None else None,
        log_dropped=writer.unwritten if writer is not None else 0,
    )
    summary |= slow.field()
    if run.engine is not None and scenario is not None:
        run.engine.settle()
        effects, blind = run.engine.effects.as_dict(), verdict.blind_spots(loaded)
        summary["scenario"] = verdict.judge(scenario, loaded.config, seen, effects, blind)
    if course is not None:
        summary["moves" if isinstance(course, Course) else "profile"] = course.results
    never = tally.never_armed() if course is None or not course.begun else None
    if never is not None:
        summary["never_armed"] = never
        print(f"pneud: never armed: {', '.join(never)}", file=sys.stderr)
    print(json_.dumps(summary) if json else _in_words(summary))
    good = course.good if course is not None else tally.state == State.TRACKING
    return 0 if good and not tally.ever_latched and whole else 1


def _check_duration(duration_s: float) -> None:
    if not 0.0 < duration_s <= 1e6:
        raise ConfigError(f"--duration {duration_s:g}: must lie between 0 and 1,000,000 s")


def _together(axes: Together, duration_s: float, seed: int, output: Path | None, json: bool, how: str) -> int:
    """Have all axes track on one bus, each with a log of its own in a folder."""
    _check_duration(duration_s)
    rate_hz = axes[0].config.loop.rate_hz
    with progress(how) as report:

        def look(number: int) -> None:
            if number % TOLD_TICKS == 0:
                report("simulating", number / rate_hz, duration_s, "s")

        found = run_together(axes, duration_s, seed, output, look)
    if json:
        print(json_.dumps({"schema": 1, "bus": "simulated", "axes": found, **slow.field()}))
    else:
        print("\n".join(f"axis {name}: {in_words(summary)}" for name, summary in found.items()))
    tracked = State.TRACKING.label
    return 0 if all(one["state"] == tracked and not one["faults"] for one in found.values()) else 1


def _course(goto: str, loaded: Loaded) -> Course:
    """Who asks for moves one after the other; all of them are such as the axis may make."""
    steps = steps_of(goto)
    try:
        check(steps, axis_of(loaded.config, loaded.codecs.command_lsb_v))
    except MovesError as e:
        raise MovesError(f"--goto {goto}: {e}") from None
    return Course(steps, cylinder_of(loaded.config).rod_force_n)


def _operator(goto: str | None, track: str | None, loaded: Loaded) -> Course | Following | None:
    """Who asks for something else than to track the reference."""
    if goto is not None:
        return _course(goto, loaded)
    if track is None:
        return None
    c = loaded.config
    p = axis_of(c, loaded.codecs.command_lsb_v)
    try:
        pieces = _profile(track, c.plant.initial_x1_m - c.cylinder.dead_length_1_m, p.motion)
        profiles.check(pieces, p.motion, *soft_limits(p))
    except ProfileError as e:
        raise VerbError(f"--track {track}: {e}") from None
    return Following(profiles.requests(pieces), profiles.duration_s(pieces))


def _profile(text: str, stands_m: float, bounds: Bounds) -> list[Septic]:
    if text == "chirp":
        return profiles.chirp(stands_m, CHIRP_M, *CHIRP_HZ, CHIRP_S)
    if text.startswith("steps:"):
        places_m = [move.to_m for move in moves_of(text.removeprefix("steps:"))]
        return profiles.steps(places_m, DWELL_S, bounds)
    return profiles.from_file(Path(text))


def _usual_s(scenario: Scenario | None, course: Course | Following | None) -> float:
    """How long a run is, unless `--duration` says otherwise [s]; moves and profiles end it before."""
    if isinstance(course, Following):
        return DURATION_S + MOVE_S + course.lasts_s
    if course is not None:
        return DURATION_S + MOVE_S * len(course.results) + course.longest_s
    return scenario.duration_s if scenario is not None else DURATION_S


def _in_words(summary: dict[str, Any]) -> str:
    lines = [in_words(summary)]
    if "scenario" in summary:
        lines.append(verdict.in_words(summary["scenario"]))
    if "moves" in summary:
        lines.append(moves_in_words(summary["moves"]))
    if "profile" in summary:
        lines.append(followed(summary["profile"]))
    return "\n".join(lines)


def _run(
    run: Simulation,
    duration_s: float,
    rate_hz: float,
    writer: LogWriter | None,
    course: Course | Following | None,
    report: Report,
) -> Ran:
    """All ticks, counted and written down."""

    def told(ticks: int) -> None:
        report("simulating", ticks / rate_hz, duration_s, "s")

    def see(_: int, record: Record) -> None:
        if course is not None:
            course.see(record)

    ran = through(run, rate_hz, writer, None if course is None else see, told)
    if run.axis.failure is not None:
        print(f"pneud: exception in the cycle: {run.axis.failure!r}", file=sys.stderr)
    return ran


def _compare(loaded: Loaded, rest_s: float, output: Path | None, json: bool, how: str) -> int:
    """Run every law through every case and print the tables, folded on a terminal; write the page."""
    if not 1.0 <= rest_s <= MOST_REST_S:
        raise ConfigError(f"--duration {rest_s:g}: with --compare, between 1 and {MOST_REST_S:g} s")
    compiled = not missing("sim")
    if not compiled:
        print(f"pneud: three cases only without numba; for all: {cure('sim')}", file=sys.stderr)
    with progress(how) as report:
        found = compare(loaded, rest_s, compiled, report=report)
    if output is not None:
        write_whole(output, comparison_page.page(found))
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else WIDEST
    print(json_.dumps(as_json(found)) if json else compared(found, width))
    return 0
