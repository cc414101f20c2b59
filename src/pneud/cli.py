"""The command line: options in, one call for each verb out.

Annotations are no strings here: typer would compile every one of them anew, at every start.
"""

import gc
import io
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from pneud import __version__

DONE, ANSWER_IS_NO, USAGE, MACHINE = 0, 1, 2, 3


class Verbs(TyperGroup):
    """A list of verbs that says of each all that its first line says."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list; typer's own cuts lines off."""
        verbs = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl([(name, (verb.help or "").partition("\n")[0]) for name, verb in verbs if verb])


app = typer.Typer(
    name="pneud",
    cls=Verbs,
    help="Real-time controller for pneumatic servo axes on a CAN bus.",
    no_args_is_help=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # to load rich takes longer than all the rest of --help
    context_settings={"help_option_names": ["-h", "--help"]},
)

tune = typer.Typer(
    cls=Verbs,
    help="Gains and reference of the running daemon.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(tune, name="tune")

ConfigOption = Annotated[
    str | None, typer.Option("--config", metavar="FILE", help="Configuration; default virtual.toml.")
]
BusOption = Annotated[
    str | None, typer.Option("--bus", metavar="BUS", help="auto, socketcan:IF or unixcan:NAME.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
SocketOption = Annotated[
    str | None,
    typer.Option("--socket", metavar="PATH", help="The daemon's socket."),
]
ScenarioOption = Annotated[
    str | None, typer.Option("--scenario", metavar="NAME", help="Faults to inject: pneud's own, or a file.")
]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of the plant's noise.")]


def _version(value: bool) -> None:
    if value:
        typer.echo(f"pneud {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def daemon(
    ctx: typer.Context,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Run with the software plant on a virtual bus.")
    ] = False,
    config: ConfigOption = None,
    bus: BusOption = None,
    arm: Annotated[
        bool, typer.Option("--arm", help="Arm once when everything allows it (benches and tests).")
    ] = False,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="Stop after this time.")
    ] = None,
    rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Ticks per second.")] = None,
    headless: Annotated[bool, typer.Option("--headless", help="No live screen.")] = False,
    json: JsonOption = False,
    log: Annotated[
        str | None, typer.Option("--log", metavar="PATH", help="Log file (.mcap) or folder.")
    ] = None,
    scenario: ScenarioOption = None,
    seed: SeedOption = 0,
    socket: SocketOption = None,
    live: Annotated[
        bool, typer.Option("--live", help="Serve Foxglove and Lichtblick on this machine.")
    ] = False,
    live_at: Annotated[
        str | None, typer.Option("--live-at", metavar="ADDRESS:PORT", help="Where; default 127.0.0.1:8765.")
    ] = None,
    version: Annotated[  # noqa: ARG001
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Without a verb: the daemon."""
    given = [
        name
        for name, value in (
            ("--virtual", virtual),
            ("--config", config),
            ("--bus", bus),
            ("--arm", arm),
            ("--duration", duration),
            ("--rate", rate),
            ("--headless", headless),
            ("--json", json),
            ("--log", log),
            ("--scenario", scenario),
            ("--seed", seed),
            ("--socket", socket),
            ("--live", live),
            ("--live-at", live_at),
        )
        if value
    ]
    if ctx.invoked_subcommand is not None:
        if given:
            verb = ctx.invoked_subcommand
            _fail(f"{given[0]} belongs to the daemon; options of '{verb}' stand behind it")
        return
    if not virtual and config is None:
        if given:
            _fail("needs --virtual, or --config for a rig; see pneud --help")
        typer.echo(ctx.get_help())
        raise typer.Exit(DONE)
    if scenario is not None and not virtual:
        _fail("--scenario is for the software rig: pneud --virtual, plant or sim")
    if duration is not None and not 0.0 < duration < 1e9:
        _fail(f"--duration {duration:g}: must be a positive number of seconds")
    if sys.platform != "linux":
        _fail("the loop needs Linux; sim, replay, check and report run anywhere", MACHINE)

    from pneud.verbs.run import RunOptions, run

    _exit(
        run,
        RunOptions(
            config=config,
            bus=bus if bus is not None else ("auto" if virtual else None),
            virtual=virtual,
            arm=arm,
            duration_s=duration,
            rate_hz=rate,
            headless=headless,
            json=json,
            log=log,
            scenario=scenario,
            seed=seed,
            socket=socket,
            live=live_at or ("127.0.0.1:8765" if live else None),
        ),
    )


@app.command()
def plant(
    bus: Annotated[str, typer.Option("--bus", metavar="BUS", help="socketcan:IF (a vcan) or unixcan:NAME.")],
    config: ConfigOption = None,
    scenario: ScenarioOption = None,
    seed: SeedOption = 0,
) -> None:
    """The software plant node alone."""
    from pneud.verbs.plant import plant as verb

    _exit(verb, config, bus, scenario, seed)


@app.command()
def sim(
    file: Annotated[
        str | None, typer.Argument(metavar="FILE", help="Configuration; default virtual.toml.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="LOG", help="Write a log (.mcap).")
    ] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="Simulated time; default 10 s.")
    ] = None,
    scenario: ScenarioOption = None,
    seed: SeedOption = 0,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare", help="The law against its baselines, case by case; --duration is that of the rest."
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """The same axis and plant in simulated time, faster than real time, the same for a seed."""
    if compare:
        if output is not None or seed or scenario is not None:
            _fail("--compare writes no log and has its own seed; leave out -o, --seed and --scenario")
        from pneud.verbs.compare import compare_laws

        _exit(compare_laws, file or "virtual.toml", 10.0 if duration is None else duration, json)
    from pneud.verbs.simulate import simulate as verb

    _exit(verb, file, output, duration, seed, scenario, json)


@app.command()
def reproduce(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write page and figures here.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """The paper's two cases, composite law against ISMC: tables, verdicts and Figures 3 to 8."""
    from pneud.verbs.reproduce import reproduce_paper as verb

    _exit(verb, output, json)


@app.command()
def replay(
    logs: Annotated[
        list[str], typer.Argument(metavar="LOG…", help="A log, its parts, or the folder that they are in.")
    ],
    config: Annotated[
        str | None, typer.Option("--config", metavar="FILE", help="What if: another configuration.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="What if: another value.")
    ] = None,
    against: Annotated[
        str | None, typer.Option("--against", metavar="LOG2", help="Compare with another log instead.")
    ] = None,
    begin: Annotated[
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
) -> None:
    """Feed a log's frames and requests through the axis again and compare every command."""
    from pneud.verbs.replay import ReplayOptions
    from pneud.verbs.replay import replay as verb

    _exit(verb, ReplayOptions(logs, config, settings or [], against, begin, output, bus, speed, json))


@app.command()
def report(
    logs: Annotated[list[str], typer.Argument(metavar="LOG…", help="Logs; several are compared.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The page (.html).")],
    png: Annotated[
        bool, typer.Option("--png", help="Write the figures as PNG beside the page, too.")
    ] = False,
    reference: Annotated[
        Path | None,
        typer.Option("--reference", metavar="FILE", help="What 'pneud bench --json' printed here."),
    ] = None,
    begin: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Begin so long after the first tick.")
    ] = None,
    end: Annotated[
        float | None, typer.Option("--to", metavar="S", help="End so long after the first tick.")
    ] = None,
) -> None:
    """Logs as one page of figures and tables that needs nothing beside it."""
    from pneud.verbs.report import ReportOptions
    from pneud.verbs.report import report as verb

    _exit(verb, ReportOptions(logs, output, png, reference, begin, end))


@app.command()
def export(
    log: Annotated[str, typer.Argument(metavar="LOG", help="Log to hand to other tools.")],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Frames as .log (candump), .asc or .blf; ticks as .csv or .parquet.",
        ),
    ],
) -> None:
    """A log's frames as a recording of the bus, or its ticks as a table."""
    from pneud.verbs.export import export as verb

    _exit(verb, log, output)


@app.command("import")
def import_(
    recording: Annotated[
        Path, typer.Argument(metavar="FILE", help="Recording: .log (candump -l), .asc or .blf.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOG", help="The log (.mcap).")],
    dbc: Annotated[
        Path | None, typer.Option("--dbc", metavar="FILE", help="Its messages; an exported log has them.")
    ] = None,
    config: Annotated[
        str | None,
        typer.Option("--config", metavar="FILE", help="Of the axis; default the exported, else rig.toml."),
    ] = None,
) -> None:
    """A recording of a bus as a log that replay and report understand."""
    from pneud.verbs.import_ import import_recording as verb

    _exit(verb, recording, dbc, output, config)


@app.command()
def recover(
    log: Annotated[str, typer.Argument(metavar="LOG", help="Log that was cut short.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="The mended log.")],
) -> None:
    """Mend a log that was cut short."""
    from pneud.verbs.recover import recover as verb

    _exit(verb, log, output)


@app.command()
def check(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Configuration.")],
    json: JsonOption = False,
) -> None:
    """Validate a configuration and everything it names; say what is wrong where."""
    from pneud.verbs.check import check as verb

    _exit(verb, file, json)


@app.command()
def design(
    bandwidth: Annotated[float, typer.Option("--bandwidth", metavar="RAD_S", help="Of the closed loop.")],
    error_mm: Annotated[
        float, typer.Option("--error-mm", metavar="A", help="Error at which the gains are those of a line.")
    ],
    file: Annotated[str, typer.Argument(metavar="FILE", help="Configuration.")] = "virtual.toml",
    law: Annotated[
        str | None,
        typer.Option("--law", metavar="LAW", help="As control.law; default the configuration's."),
    ] = None,
    alpha: Annotated[
        float | None, typer.Option("--alpha", metavar="X", help="Exponent; default the configuration's.")
    ] = None,
    rate: Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Ticks per second.")] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Try them, also from a start error of 0.4 strokes.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Gains for a bandwidth, as TOML, with what they will do and what is wrong with them."""
    from pneud.verbs.design import DesignOptions
    from pneud.verbs.design import design as verb

    _exit(verb, DesignOptions(file, bandwidth, error_mm, alpha, rate, simulate, json, law))


@app.command()
def doctor(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Configuration.")] = "virtual.toml",
    json: JsonOption = False,
) -> None:
    """Say what this machine can and cannot do in real time, worst first, and what helps."""
    if sys.platform != "linux":
        _fail("the loop needs Linux, and so does its doctor", MACHINE)
    from pneud.verbs.doctor import doctor as verb

    _exit(verb, file, json)


@app.command()
def install_service(
    config: Annotated[
        str | None,
        typer.Option(
            "--config", metavar="FILE", help="Also an axis: its unit, its configuration in /etc/pneud."
        ),
    ] = None,
    networkd: Annotated[
        bool, typer.Option("--networkd", help="Also files by which systemd-networkd brings its interface up.")
    ] = False,
    destdir: Annotated[
        Path | None, typer.Option("--destdir", metavar="DIR", help="Only write files, below this folder.")
    ] = None,
) -> None:
    """Put the systemd units of this installation in place (see docs/rig-pc.md)."""
    if networkd and config is None:
        _fail("--networkd is about the interface of an axis; name its --config")
    from pneud.service.installation import InstallError
    from pneud.verbs.install_service import install_service as verb

    try:
        _exit(verb, config, destdir, networkd)
    except InstallError as e:
        _fail(str(e), e.exit_code)


@app.command()
def bench(
    config: ConfigOption = None,
    bus: BusOption = None,
    pairs: Annotated[int, typer.Option("--pairs", metavar="N", help="Turns for each.")] = 20,
    rate_seconds: Annotated[
        float,
        typer.Option("--rate-seconds", metavar="S", help="How long a rate must be held; 0 leaves that out."),
    ] = 3.0,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Another rate, on a bus whose frames take no time."),
    ] = None,
    turn: Annotated[float, typer.Option("--turn", metavar="S", help="Length of a turn.")] = 1.0,
    disturb: Annotated[
        bool, typer.Option("--disturb", help="Pneud with and without disturbances, instead of references.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write the report as HTML, too.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure how punctual the loop is here, taking turns with cyclictest and other references."""
    if sys.platform != "linux":
        _fail("the loop needs Linux, and so does its benchmark", MACHINE)
    from pneud.verbs.bench import BenchOptions
    from pneud.verbs.bench import bench as verb

    options = BenchOptions(
        config or "virtual.toml", bus, pairs, rate_seconds, output, json, rate, turn, disturb
    )
    _exit(verb, options)


NEGATIVE = {"ignore_unknown_options": True}  # numbers with a minus sign are no options


@app.command()
def status(socket: SocketOption = None, json: JsonOption = False) -> None:
    """How the axis of the running daemon is: state, faults with cures, position, pressures, timing, log."""
    from pneud.verbs.operate import status as verb

    _exit(verb, socket, json)


@app.command()
def arm(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Engage the axis and hold where it is."""
    _ask(socket, json, "arm")


@app.command()
def disarm(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Stop the axis and centre its valve; needs no lease, as stop."""
    _ask(socket, json, "disarm")


@app.command()
def stop(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Stop the axis, whoever commands it."""
    _ask(socket, json, "stop")


@app.command()
def clear(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Clear latched faults whose causes are gone."""
    _ask(socket, json, "clear")


@app.command()
def home(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Find the encoder's reference."""
    _ask(socket, json, "home")


@app.command()
def hold(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Come to rest and hold there."""
    _ask(socket, json, "hold")


@app.command(context_settings=NEGATIVE)
def goto(
    x: Annotated[float, typer.Argument(metavar="MM", help="Position in the stroke coordinate [mm].")],
    speed: Annotated[float | None, typer.Option("--speed", metavar="MM_S", help="At most.")] = None,
    accel: Annotated[float | None, typer.Option("--accel", metavar="MM_S2", help="At most.")] = None,
    jerk: Annotated[float | None, typer.Option("--jerk", metavar="MM_S3", help="At most.")] = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Go to a position and hold there; a later one redirects it in motion."""
    given = (("speed_mm_s", speed), ("acceleration_mm_s2", accel), ("jerk_mm_s3", jerk))
    fields = {name: value for name, value in given if value is not None}
    if not all(0.0 < value <= 1e9 for value in fields.values()) or not abs(x) <= 1e6:
        _fail("goto: MM is a position, --speed, --accel and --jerk are positive numbers")
    _ask(socket, json, "goto", x_mm=x, **fields)


@app.command(context_settings=NEGATIVE)
def jog(
    velocity: Annotated[float, typer.Argument(metavar="MM_S", help="Signed speed [mm/s].")],
    duration: Annotated[
        float | None, typer.Option("--for", metavar="S", help="Default: until Ctrl-C.")
    ] = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Move for as long as this command runs, then hold."""
    if not abs(velocity) <= 1e6 or (duration is not None and not 0.0 < duration < 1e6):
        _fail("jog: MM_S is a speed, --for a positive number of seconds")
    from pneud.verbs.operate import jog as verb

    _exit(verb, socket, json, velocity, duration)


@app.command()
def mark(
    text: Annotated[str, typer.Argument(metavar="TEXT", help="For the log.")],
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Leave a remark in the log."""
    if not 0 < len(text) <= 200:
        _fail("mark: TEXT has 1 to 200 characters")
    _ask(socket, json, "mark", text=text)


@app.command(context_settings=NEGATIVE)
def track(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="sine (the configured one), chirp, steps, profile, FILE.csv or FILE.json."
        ),
    ],
    positions: Annotated[list[float] | None, typer.Argument(metavar="[MM]...", help="Of steps.")] = None,
    centre: Annotated[
        float | None, typer.Option("--centre", metavar="MM", help="Of a chirp; default where it stands.")
    ] = None,
    amplitude: Annotated[float, typer.Option("--amplitude", metavar="MM", help="Of a chirp.")] = 10.0,
    from_hz: Annotated[float, typer.Option("--from", metavar="HZ", help="First frequency of a chirp.")] = 0.2,
    to_hz: Annotated[float, typer.Option("--to", metavar="HZ", help="Last frequency of a chirp.")] = 2.0,
    duration: Annotated[float, typer.Option("--duration", metavar="S", help="Of a chirp.")] = 20.0,
    dwell: Annotated[float, typer.Option("--dwell", metavar="S", help="Rest at each of the steps.")] = 1.0,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Follow the configured reference, a chirp, steps, or a profile from a file."""
    from pneud.verbs.track import TrackOptions
    from pneud.verbs.track import track as verb

    _exit(
        verb,
        TrackOptions(name, positions or [], centre, amplitude, from_hz, to_hz, duration, dwell, socket, json),
    )


@tune.command("get")
def tune_get(socket: SocketOption = None, json: JsonOption = False) -> None:
    """The running gains and reference."""
    from pneud.verbs.tune import get

    _exit(get, socket, json)


@tune.command("set")
def tune_set(
    settings: Annotated[list[str], typer.Argument(metavar="NAME=VALUE...", help="As in tune get.")],
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Change gains and reference, all or none, without a step of the command."""
    from pneud.verbs.tune import change

    _exit(change, socket, json, settings)


@tune.command("diff")
def tune_diff(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Where the running gains and reference differ from the file."""
    from pneud.verbs.tune import diff

    _exit(diff, socket, json)


@tune.command("save")
def tune_save(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Write the running gains and reference into the daemon's configuration; comments stay."""
    from pneud.verbs.tune import save

    _exit(save, socket, json)


@tune.command("reload")
def tune_reload(socket: SocketOption = None, json: JsonOption = False) -> None:
    """Take gains and reference of the daemon's configuration, as SIGHUP does."""
    from pneud.verbs.tune import reload

    _exit(reload, socket, json)


@app.command()
def top(
    read_only: Annotated[bool, typer.Option("--read-only", help="Look only: no keys but q.")] = False,
    socket: SocketOption = None,
) -> None:
    """The live screen of the running daemon; keys stop, arm, disarm, clear, hold and jog."""
    from pneud.verbs.top import top as verb

    _exit(verb, socket, read_only)


def _ask(socket: str | None, json: bool, verb: str, **fields: object) -> NoReturn:
    from pneud.console.endpoint import PlaceError
    from pneud.verbs.operate import ask

    try:  # not `_exit`, which loads more than a stop has time for
        status = ask(socket, json, verb, **fields)
    except PlaceError as e:
        _fail(str(e), e.exit_code)
    except KeyboardInterrupt:
        status = 130
    raise typer.Exit(status)


def _fail(text: str, status: int = USAGE) -> NoReturn:
    typer.echo(f"pneud: {text}", err=True)
    raise typer.Exit(status)


def _exit(verb: object, *args: object) -> NoReturn:
    """Run a verb and turn what people can do something about into one line and an exit status."""
    from pneud.bus.codec import DatabaseError
    from pneud.bus.link import LinkError
    from pneud.compiled.build import BuildError
    from pneud.config.models import ConfigError
    from pneud.console.endpoint import PlaceError
    from pneud.log.files.naming import LogError

    assert callable(verb)
    gc.freeze()  # what has been imported stays
    gc.enable()
    try:
        status = verb(*args)
    except (ConfigError, DatabaseError, LogError) as e:
        _fail(str(e))
    except (LinkError, PlaceError) as e:
        _fail(str(e), e.exit_code)
    except BuildError as e:
        _fail(f"loop.compiled: {e}", MACHINE)
    except MemoryError:
        _fail("not enough memory", MACHINE)
    except KeyboardInterrupt:
        status = 130
    except BrokenPipeError:
        status = DONE
    raise typer.Exit(status)


def main() -> None:
    """Entry point of the `pneud` command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters is no reason to fail
    gc.disable()  # else a sixth of the start would be a search for garbage in what is being imported
    app()


if __name__ == "__main__":
    main()
