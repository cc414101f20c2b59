"""From a rig as it was put together to an axis that works: movement test, estimates, gains, verification.

The axis of the running daemon is asked for one motion after another; with `--virtual` it is the software rig,
in simulated time, which is no proof.
"""

from __future__ import annotations

import json as json_
import os
import signal
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pneud import resources
from pneud.config.models import Config
from pneud.config.proof import Proof, digest, proven
from pneud.console.client import Client, RefusedError
from pneud.loading import Loaded, load
from pneud.rt.extras import require
from pneud.rt.outputs import require_folder, write_whole
from pneud.safety.supervisor import is_engaged
from pneud.signals import State
from pneud.study.commissioning.movement import CURES, Verdict
from pneud.verbs import AxisOption, ConfigOption, JsonOption, SocketOption, VerbError, require_suffix

if TYPE_CHECKING:
    from pneud.study.commissioning.procedure import Outcome, Wishes
    from pneud.study.commissioning.written import Change


MISSED = (
    "the axis can be used, and its file fits the rig; what is starred lies beyond its limit; where that"
    " matters: slower limits.motion, a finer encoder or another valve (docs/commissioning.md, missed)"
)


def commission(
    config_file: ConfigOption = None,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="The software rig, in simulated time; it proves nothing.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write nothing.")] = False,
    test_only: Annotated[
        bool, typer.Option("--movement-test", help="No more than the movement test.")
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Do the movement test though it has been passed.")
    ] = False,
    skip_dynamic: Annotated[
        bool, typer.Option("--skip-dynamic", help="Slow motion only; limits.motion become slow, too.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option("--seed", help="With --virtual: a rig unlike its configuration, drawn from it."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="A page with pictures (.html).")
    ] = None,
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Find out what a rig is like, and make its configuration so.

    Returns:
        Exit status: 0 where all that was done holds, 1 where not, or where it was ended.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        BuildError: the compiled law is required and cannot be had.
        PlaceError: no daemon to talk to.
        LogError: the log cannot be read or written.
        VerbError: nobody agrees, the axis is not at rest, something is missing, or the proof cannot be kept.
        OSError: a file cannot be written.
    """
    if not test_only:
        require("commission", "identify")
    from pneud.study.commissioning.procedure import Wishes, as_json  # noqa: PLC0415

    _agreeing(virtual, test_only, {"--socket": socket, "--again": again}, {
        "-o": output, "--skip-dynamic": skip_dynamic,
    })  # fmt: skip
    if output is not None:
        require_suffix(output, ".html", "the report is a page of HTML")
        require_folder(output)
    wishes = Wishes(steps=not test_only, dynamic=not skip_dynamic, write=not dry_run)
    if not virtual and seed is not None:
        raise VerbError("--seed: draws a software rig; give --virtual, too")
    if virtual:
        outcome, c = _simulated(config_file, axis, seed, wishes, yes)
    else:
        outcome, c = _on_the_rig(socket, axis, config_file, wishes, again, yes)
    findings = _findings(outcome.movement)
    if output is not None:
        if outcome.found is not None:
            write_whole(output, _page(outcome, c))
        else:
            print(f"pneud: {output}: not written: nothing has been estimated", file=sys.stderr)
    if json:
        print(json_.dumps({**as_json(outcome), "findings": findings}))
    else:
        print("\n".join(_in_words(outcome, findings)))
    return 0 if outcome.good else 1


def _agreeing(virtual: bool, test_only: bool, of_a_rig: dict[str, Any], of_steps: dict[str, Any]) -> None:
    """Refuse what would be left out of account.

    Raises:
        VerbError: something would.
    """
    for given, what, others in (
        (virtual, "--virtual: a software rig", of_a_rig),
        (test_only, "--movement-test: that alone", of_steps),
    ):
        if given and (idle := [name for name, value in others.items() if value]):
            raise VerbError(f"{what} has no use for {', '.join(idle)}")


def _require_writable(path: Path) -> None:
    """Find out before the motion, not after it, that what comes of it cannot be written.

    Raises:
        VerbError: so it is.
    """
    if path.resolve().is_relative_to(resources.configs().resolve()):
        words = "comes with pneud and stays as it is; copy it, and run the daemon with the copy"
        raise VerbError(f"{path}: {words}; --dry-run does without")
    if not os.access(path.resolve().parent, os.W_OK):
        raise VerbError(
            f"{path}: cannot be written by this user, and neither could what is found;"
            " --dry-run does without, another user may", 3
        )  # fmt: skip


class _Talk:
    """Whoever has called the verb."""

    def __init__(self, yes: bool) -> None:
        self._yes = yes

    def say(self, words: str) -> None:
        print(words, file=sys.stderr, flush=True)

    def agreed(self, changes: list[Change]) -> bool:
        self.say("\n".join(_table(changes)))
        return self._yes or (sys.stdin.isatty() and typer.confirm("write that?", err=True))


def _simulated(
    config_file: str | None, axis: str | None, seed: int | None, wishes: Wishes, yes: bool
) -> tuple[Outcome, Config]:
    from pneud.study.commissioning import procedure, truths  # noqa: PLC0415
    from pneud.study.commissioning.bench import Simulated  # noqa: PLC0415

    loaded = load(config_file or "virtual.toml", axis=axis)
    packaged = loaded.path.is_relative_to(resources.configs())
    if wishes.write and wishes.steps:
        if packaged:
            print("pneud: nothing is written into a configuration that comes with pneud", file=sys.stderr)
        else:
            _require_writable(loaded.path)
    truth = truths.drawn(loaded.config, seed) if seed is not None else {}
    with tempfile.TemporaryDirectory(prefix="pneud-") as folder:
        rig = Simulated(loaded, truth, seed or 0, Path(folder))
        wishes = wishes._replace(write=wishes.write and not packaged)
        return procedure.commission(rig, wishes, _Talk(yes)), loaded.config


def _on_the_rig(
    socket: str | None, axis: str | None, config_file: str | None, wishes: Wishes, again: bool, yes: bool
) -> tuple[Outcome, Config]:
    from pneud.study.commissioning import procedure  # noqa: PLC0415
    from pneud.study.commissioning.live import Live  # noqa: PLC0415

    with Client(socket, axis) as client:
        status = client.ask("status")
    if "axes" in status:
        raise VerbError(f"commission: name one of the axes {', '.join(status['axes'])} with --axis")
    if status["config_changed"]:
        raise VerbError("commission: the daemon's file has changed since it began: pneud restart", 1)
    if status["state"] != State.DISARMED.label:
        cure = "pneud clear" if status["state"] == State.FAULT.label else "pneud disarm"
        raise VerbError(f"commission: the axis is {status['state']}, not disarmed: {cure}", 1)
    for name, state in (status.get("others") or {}).items():
        if is_engaged(State[state.upper()]):
            words = f"commission: {name} is {state}; the daemon begins anew meanwhile, so disarm all"
            raise VerbError(f"{words}: pneud disarm", 1)
    loaded = load(status["config"], axis=axis)
    if config_file is not None and load(config_file, axis=axis).text != loaded.text:
        raise VerbError(f"commission: the daemon runs {status['config']}, another configuration")
    passed = proven(loaded.proof_file, digest(loaded.config, loaded.dbc.read_bytes())) == Proof.PASSED
    wishes = wishes._replace(movement=again or not passed or not wishes.steps)
    if wishes.write and wishes.steps:
        _require_writable(loaded.path)
    _agreed(loaded, wishes, yes)
    _end_in_order()
    rig = Live(lambda: Client(socket, axis), loaded)
    try:
        return procedure.commission(rig, wishes, _Talk(yes)), loaded.config
    except RefusedError as e:
        raise VerbError(f"commission: {e}", 1) from None
    finally:
        rig.close()


def _end_in_order() -> None:
    """Have whoever is asked to leave, or whose terminal has gone, end as by Ctrl-C: the axis stops."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, interrupt)


def _agreed(loaded: Loaded, wishes: Wishes, yes: bool) -> None:
    """Say what will move, and ask.

    Raises:
        VerbError: nobody agrees.
    """
    from pneud.study.commissioning.procedure import planned  # noqa: PLC0415

    print("\n".join(planned(loaded, wishes)), file=sys.stderr)
    if not yes and not (sys.stdin.isatty() and typer.confirm("go on?", err=True)):
        raise VerbError("commission: nobody agreed; --yes does without")


def _table(changes: list[Change]) -> list[str]:
    """What is to be written, a line for each key."""
    rows = [("", "configured", "found", "95 % interval")]
    rows += [(c.key, _short(c.was), _short(c.value), c.interval) for c in changes]
    wide = [max(len(row[i]) for row in rows) for i in range(4)]
    return [
        f"{key:<{wide[0]}}  {was:>{wide[1]}}  {value:>{wide[2]}}  {interval:>{wide[3]}}".rstrip()
        for key, was, value, interval in rows
    ]


def _short(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _findings(movement: Verdict | None) -> list[dict[str, str]]:
    found = () if movement is None else movement.findings
    return [{"name": str(f), "cure": CURES[f]} for f in found]


def _in_words(o: Outcome, findings: list[dict[str, str]]) -> list[str]:
    lines = []
    if o.movement is not None:
        lines.append(f"movement test: {'passed' if o.movement.passed else 'failed'}")
        lines += [f"{f['name']}: {f['cure']}" for f in findings]
    if o.failure:
        lines.append(f"ended: {o.failure}")
    lines += [f"faults: {', '.join(o.faults)}"] if o.faults else []
    lines += _worth(o)
    if o.verdict == "missed":
        lines.append(f"next: {MISSED}")
    return [*lines, f"commission: {o.verdict}{', written' if o.written else ''}"]


def _worth(o: Outcome) -> list[str]:
    """What was found, and what the axis is worth."""
    if o.found is None:
        return []
    from pneud.study.commissioning import page  # noqa: PLC0415

    lines = [f"warning: {text}" for text in o.warnings]
    lines += [f"not told: {note}" for note in o.found.identified.notes]
    lines += [f"the model cannot explain {text}" for text in o.found.unexplained]
    lines += [page.gains(o.found.chosen)] if o.found.chosen is not None else []
    lines += page.tried(o.tried)
    if o.after is not None:
        table = [page.HEAD, *page.beside(o.before, o.after)]
        wide = max(len(row[0]) for row in table)
        lines += [f"{name:<{wide}}  " + "  ".join(f"{cell:>8}" for cell in cells) for name, *cells in table]
        lines.append(page.verdict(o.after))
    return lines


def _page(o: Outcome, c: Config) -> str:
    from pneud.study.commissioning import page  # noqa: PLC0415
    from pneud.study.identification import comparing  # noqa: PLC0415

    assert o.found is not None
    found = o.found.identified
    lines = [f"commission: {o.verdict}", *_worth(o)]
    return page.page(
        f"{c.name}: commission", lines, comparing.rows(found.parameters, {}), found, c, o.before, o.after
    )
