"""The command line: the daemon's options, verbs by name, and the border at which errors become one line.

Annotations are no strings here: typer would compile every one of them anew, at every start.
"""

import builtins
import errno
import gc
import importlib
import io
import os
import sys
import types
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

try:
    import typer
    from typer.core import TyperCommand, TyperGroup

    from pneud import __version__
    from pneud.verbs import BusOption, ConfigOption, JsonOption, ScenarioOption, SeedOption, SocketOption
except KeyboardInterrupt:  # nobody waits for the end of a start
    sys.exit(130)

DONE, USAGE, MACHINE, INTERRUPTED = 0, 2, 3, 130
SPACE, HANDLES = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), (errno.EMFILE, errno.ENFILE)
LACKS = (*SPACE, *HANDLES, errno.ENOMEM, errno.EIO)  # what the machine does
LAST_STREAM = 2  # descriptor of standard error
BYTE = 0xDC00  # and more: a byte of a name that is no UTF-8, as Python keeps it
FOLDER = Path(__file__).parent / "verbs"
# of help and completion, what one looks for together; a verb that does not stand here comes last
GROUPS = {
    "Software rig": ("plant", "sim", "scenarios", "campaign", "reproduce"),
    "Logs": ("logs", "replay", "report", "view", "export", "import", "recover", "learnt", "identify"),
    "A rig and its machine": (
        *("new", "map", "nodes", "commission", "check", "design"),
        *("doctor", "install-service", "bench", "prove"),
    ),
    "Running daemon": (
        *("status", "arm", "disarm", "stop", "clear", "home", "hold", "restart"),
        *("goto", "jog", "force", "run", "teach", "mark", "track", "top", "tune", "web", "mqtt"),
    ),
}
ORDER = tuple(name for group in GROUPS.values() for name in group)
OTHERS = "Others"
JSON = "--json"
KINDS = {1: "failed", USAGE: "usage", MACHINE: "machine"}  # of errors
UsageError: type[Exception] = typer.BadParameter.mro()[1]  # typer's, or that of click beside it


def verbs() -> dict[str, Path]:
    """The verbs' modules by their names, none of them loaded."""
    modules = sorted(path for path in FOLDER.glob("[a-z]*.py") if path.stem != "run")
    found = {path.stem.rstrip("_").replace("_", "-"): path for path in modules}
    return {name: found[name] for name in sorted(found, key=[*ORDER, *found].index)}


class Verbs(TyperGroup):
    """A list of verbs that says of each all that its first line says."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list; typer's own cuts lines off."""
        self.write_list("Commands", self.list_commands(ctx), ctx, formatter)

    def write_list(self, title: str, names: Iterable[str], ctx: Any, formatter: Any) -> None:
        """Write a part of it."""
        found = [(name, self.get_command(ctx, name)) for name in names]
        with formatter.section(title):
            formatter.write_dl([(name, verb.help or "") for name, verb in found if verb])


class LoadedVerb(TyperCommand):
    """A verb whose options are known."""

    def invoke(self, ctx: Any) -> NoReturn:
        """Run it."""
        _exit(ctx, super().invoke, ctx)


class Named(TyperCommand):
    """A verb of which only the first line has been read: that does for lists, and all else loads it."""

    def __init__(self, name: str, path: Path) -> None:
        with path.open(encoding="utf-8") as file:
            super().__init__(name, help=file.readline().strip('"\n'))
        self.path = path

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        """Load it, and let it read its arguments; whoever completes a command waits for its options alone."""
        module = _sketched(self.path) if extra.get("resilient_parsing") else None
        return typer.main.get_command(self._load(module)).make_context(info_name, args, parent, **extra)

    def _load(self, module: Any = None) -> typer.Typer:
        module = module or importlib.import_module(f"pneud.verbs.{self.path.stem}")
        if not hasattr(module, "VERBS"):
            app = typer.Typer(add_completion=False, rich_markup_mode=None)
            settings = getattr(module, "SETTINGS", None)
            function = getattr(module, self.path.stem)
            app.command(self.name, cls=LoadedVerb, help=self.help, context_settings=settings)(function)
            return app
        app = typer.Typer(
            cls=Verbs, help=self.help, no_args_is_help=True, add_completion=False, rich_markup_mode=None
        )
        for name, function in module.VERBS.items():
            app.command(name, cls=LoadedVerb, help=function.__doc__.partition("\n")[0])(function)
        return app


class _Unknown:
    """Stands for all that a verb has imported, where only its options are asked for."""

    def _itself(self, *_: Any, **__: Any) -> "_Unknown":
        return self

    __getattr__ = __call__ = __getitem__ = __mul__ = __rmul__ = __or__ = __ror__ = _itself

    def __iter__(self) -> Iterator[Any]:
        return iter(())

    def __mro_entries__(self, _: Any) -> tuple[type, ...]:
        return ()


def _sketched(path: Path) -> types.ModuleType:
    """A verb's module with its options, and with nothing loaded that takes time."""

    def load(name: str, _: Any = None, __: Any = None, names: Any = (), level: int = 0) -> Any:
        quick = name.partition(".")[0] in sys.stdlib_module_names or name in ("typer", "pneud.verbs")
        return __import__(name, fromlist=names, level=level) if quick else _Unknown()

    module = types.ModuleType(path.stem)
    module.__dict__["__builtins__"] = {**vars(builtins), "__import__": load}
    exec(compile(path.read_text(encoding="utf-8"), path, "exec"), module.__dict__)
    return module


class VerbsByName(Verbs):
    """All verbs, none of them loaded."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """Their names."""
        if not self.commands:
            self.commands.update({name: Named(name, path) for name, path in verbs().items()})
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The verb of a name, if there is one."""
        return self.commands[cmd_name] if cmd_name in self.list_commands(ctx) else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list, in groups."""
        names = self.list_commands(ctx)
        for title, group in (*GROUPS.items(), (OTHERS, [n for n in names if n not in ORDER])):
            if group:
                self.write_list(title, group, ctx, formatter)

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        """Let the daemon read its options."""
        as_object = JSON in args
        with _usage(as_object):
            ctx = super().make_context(info_name, args, parent, **extra)
        ctx.meta[JSON] = as_object
        return ctx

    def invoke(self, ctx: Any) -> Any:
        """Load the verb and run it."""
        try:
            with _usage(ctx.meta[JSON]):
                return super().invoke(ctx)
        except KeyboardInterrupt:  # while it was being loaded
            sys.exit(INTERRUPTED)


app = typer.Typer(
    name="pneud",
    cls=VerbsByName,
    help="Real-time controller for pneumatic servo axes on a CAN bus.",
    no_args_is_help=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # to load rich takes longer than all the rest of --help
    context_settings={"help_option_names": ["-h", "--help"]},
)


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
    unproven: Annotated[
        bool, typer.Option("--unproven", help="Let it be armed without a movement test.")
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
    live_origin: Annotated[
        list[str] | None,
        typer.Option("--live-origin", metavar="URL", help="A web page elsewhere that may look."),
    ] = None,
    version: Annotated[  # noqa: ARG001
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Without a verb: the daemon."""
    given = [option.opts[0] for option in ctx.command.params if ctx.params.get(option.name or "")]
    if ctx.invoked_subcommand is not None:
        if given:
            verb = ctx.invoked_subcommand
            _fail(ctx, f"{given[0]} belongs to the daemon; options of '{verb}' stand behind it")
        return
    if not virtual and config is None:
        if given:
            _fail(ctx, "needs --virtual, or --config for a rig; see pneud --help")
        typer.echo(ctx.get_help())
        raise typer.Exit(DONE)
    if scenario is not None and not virtual:
        _fail(ctx, "--scenario is for the software rig: pneud --virtual, plant or sim")
    if duration is not None and not 0.0 < duration < 1e9:
        _fail(ctx, f"--duration {duration:g}: must be a positive number of seconds")
    if sys.platform != "linux":
        _fail(ctx, "the loop needs Linux; sim, replay, check and report run anywhere", MACHINE)

    from pneud.verbs.run import RunOptions, run

    _exit(
        ctx,
        run,
        RunOptions(
            config=config,
            bus=bus if bus is not None else ("auto" if virtual else None),
            virtual=virtual,
            arm=arm,
            unproven=unproven,
            duration_s=duration,
            rate_hz=rate,
            headless=headless,
            json=json,
            log=log,
            scenario=scenario,
            seed=seed,
            socket=socket,
            live=live_at or ("127.0.0.1:8765" if live or live_origin else None),
            live_origins=tuple(live_origin or ()),
        ),
    )


@contextmanager
def _usage(as_object: bool) -> Iterator[None]:
    """What is wrong with the words of a command, as an object where one was asked for."""
    try:
        yield
    except UsageError as e:
        if not as_object:
            raise
        _say(getattr(e, "format_message", e.__str__)(), USAGE, as_object)
        raise typer.Exit(USAGE) from None


def _fail(ctx: typer.Context, text: str, status: int = USAGE) -> NoReturn:
    _say(text, status, ctx.meta[JSON])
    raise typer.Exit(status)


def _say(text: str, status: int, as_object: bool) -> None:
    """A line on standard error, which is an object for those who asked for one."""
    import json

    error = {"schema": 1, "ok": False, "error": {"type": KINDS.get(status, "failed"), "message": text}}
    typer.echo(json.dumps(error) if as_object else f"pneud: {printable(text)}", err=True)


def printable(text: str) -> str:
    """A text on one line of a terminal: what ends lines, moves cursors or is no UTF-8 stands as escapes."""
    return text if text.isprintable() else "".join(map(_shown, text))


def _shown(c: str) -> str:
    if c.isprintable():
        return c
    byte = ord(c) - BYTE
    return f"\\x{byte:02x}" if 0x80 <= byte <= 0xFF else ascii(c)[1:-1]


def _exit(ctx: typer.Context, run: Callable[..., int], *args: Any) -> NoReturn:
    """Run, and turn what people can do something about into one line and an exit status.

    That is what is raised with an `exit_code`, what the machine refuses (files, folders, names, devices), and
    text that is none; all else is a mistake of the program and shows where it is.
    """
    gc.freeze()  # what has been imported stays
    gc.enable()
    try:
        status = run(*args)
    except MemoryError:
        _fail(ctx, "not enough memory", MACHINE)
    except KeyboardInterrupt:
        status = INTERRUPTED
    except BrokenPipeError:
        status = DONE
    except OSError as e:
        _fail(ctx, refusal_of(e), MACHINE if e.errno in LACKS else getattr(e, "exit_code", USAGE))
    except UnicodeError as e:
        _fail(
            ctx, f"{type(e).__name__}: {e.reason if hasattr(e, 'reason') else e}; names and texts are UTF-8"
        )
    except Exception as e:
        if not hasattr(e, "exit_code"):
            raise
        _fail(ctx, str(e), e.exit_code)
    raise typer.Exit(status)


def refusal_of(e: OSError) -> str:
    """What the machine has refused, in one line: the file, and why."""
    names = " → ".join(
        os.fsdecode(name) for name in (e.filename, e.filename2) if isinstance(name, str | bytes)
    )
    return f"{names}: {e.strerror or e}" if names else str(e.strerror or e)


class OutputError(OSError):
    """Standard output takes no more."""

    exit_code = MACHINE


class Output(io.TextIOWrapper):
    """Standard output that is named where it takes no more; a closed pipe is as ever."""

    def write(self, text: str) -> int:
        """Write.

        Raises:
            OutputError: it cannot be written.
        """
        with _named():
            return super().write(text)

    def flush(self) -> None:
        """Write out what is kept back; raises as `write` does."""
        with _named():
            super().flush()


@contextmanager
def _named() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as e:
        raise OutputError(e.errno, e.strerror, "standard output") from None


def main() -> None:
    """Entry point of the `pneud` command."""
    fill_closed_streams()
    # a terminal without Greek letters is no reason to fail
    if isinstance(out := sys.stdout, io.TextIOWrapper):
        lines, through = out.line_buffering, out.write_through
        sys.stdout = Output(out.buffer, out.encoding, "replace", None, lines, through)
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.reconfigure(errors="replace")
    gc.disable()  # else a sixth of the start would be a search for garbage in what is being imported
    said = False  # a second line would be one too many
    try:
        app()
    except SystemExit as e:
        said = e.code in (USAGE, MACHINE)
        raise
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except BrokenPipeError:
        sys.exit(DONE)
    except OSError as e:  # what is raised out of a verb does not get here, but help and version do
        said = True
        _say(refusal_of(e), MACHINE, JSON in sys.argv)
        sys.exit(MACHINE)
    finally:
        _flush(said)


def fill_closed_streams() -> None:
    """Open standard streams that are closed: a run's first files would take their numbers, and be lost."""
    while (opened := os.open(os.devnull, os.O_RDWR)) <= LAST_STREAM:
        os.set_inheritable(opened, True)
    os.close(opened)


def _flush(said: bool) -> None:
    """Write out what was printed; what cannot be written ends the program with a line, not in silence.

    Args:
        said: there has been one.
    """
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    except OSError as e:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if sys.stderr is not None and not said:
            _say(refusal_of(e), MACHINE, JSON in sys.argv)
        os._exit(MACHINE)


if __name__ == "__main__":
    main()
