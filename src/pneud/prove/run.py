"""One seed: a world, what happens in it, and what the judge finds; and the fewest faults that still do it."""

from __future__ import annotations

import gc
import hashlib
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.bus.shared import identifiers
from pneud.config.toml import changed_text, tables_of
from pneud.loading import load_axes
from pneud.prove import logs, lookers
from pneud.prove.canbus import CanBus
from pneud.prove.cast import CREW, Begin, Cast
from pneud.prove.disk import Disk
from pneud.prove.doors import doors
from pneud.prove.judge import END_S, Finding, Judge
from pneud.prove.manager import ENVIRON
from pneud.prove.plan import Plan
from pneud.prove.program_judge import START
from pneud.prove.seams import SEAMS, opened
from pneud.prove.troubles import Troubles
from pneud.prove.world import START_NS, World
from pneud.replay.lockstep import backend_of
from pneud.resources import find

if TYPE_CHECKING:
    from pneud.prove.node_judge import NodeJudge

MOST_STEPS = 20_000_000
SETTLE_S = 15.0  # after which nodes to which nothing happens any more are ready
COLLECT = 8  # runs, from one collection of what is left of them to the next
_NAME = "prove.toml"
_LIMITS = {"slew_v_s": 500.0}  # so that it bounds the command


_STATION = {
    "bus": {
        "dbc": "station.dbc",
        "inputs": {START: "INPUTS.Start"},
        "messages": {"INPUTS": {"counter": "Counter"}},
    },
    "io": {"start": "program", "start_cycles": 2},
}


class Outcome(NamedTuple):
    """What a seed comes to."""

    plan: Plan
    found: tuple[Finding, ...]
    steps: int
    simulated_s: float
    ticks: int
    sessions: int
    engaged_ticks: int
    digest: str  # of trace and logs
    trace: tuple[str, ...]


class Bench:
    """A folder with a configuration, in which one run after the other is made."""

    def __init__(self, folder: Path) -> None:
        """Begin.

        Args:
            folder: an empty one.

        Raises:
            ConfigError, DatabaseError, BuildError: as for a simulation.
        """
        self.folder = folder
        self.file = folder / _NAME
        self._begins: dict[Any, Begin] = {}
        self._runs = 0

    def _begin(self, plan: Plan) -> Begin:
        """What a run begins with; its text is in the file afterwards."""
        key = plan.file, plan.detail, plan.rate_hz, plan.others, plan.pressed
        if key not in self._begins:
            text = _text(plan)
            self.file.write_text(text, encoding="utf-8")
            axes = load_axes(self.file)
            self._begins[key] = Begin(self.file, text, axes, tuple(map(backend_of, axes)))
        begin = self._begins[key]
        self.file.write_text(begin.text, encoding="utf-8")
        return begin

    def run(self, plan: Plan, most_steps: int | None = None, keep: Path | None = None) -> Outcome:
        """Make a run.

        Args:
            plan: of it.
            most_steps: end after so many; what is judged at the end is not, then.
            keep: an empty folder for its logs; without, they go.
        """
        begin = self._begin(plan)
        self._runs += 1
        if self._runs % COLLECT == 1:
            gc.collect()
        enabled = gc.isenabled()
        gc.disable()  # a world is one knot, which is looked at when it is over
        try:
            with _folder(keep) as folder:
                return _run(plan, begin, folder, most_steps)
        finally:
            if enabled:
                gc.enable()


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="pneud-prove-") as folder:
        yield Path(folder)


def _text(plan: Plan) -> str:
    """Of the configuration."""
    change: dict[str, Any] = {
        "loop": {"rate_hz": plan.rate_hz},
        "limits": _LIMITS,
        "log": {"detail": plan.detail},
    }
    if plan.pressed:
        change |= _STATION
    text = find(plan.file).read_text(encoding="utf-8")
    if not plan.others:
        return changed_text(text, change)
    change["axis"] = [
        axis | {"faults": {"others": {"centre": centre, "stop": stop}}}
        for axis, (centre, stop) in zip(tables_of(text)["axis"], plan.others, strict=True)
    ]
    return changed_text(text, change)


def _run(plan: Plan, begin: Begin, folder: Path, most_steps: int | None) -> Outcome:
    world = World(plan.seed, most_steps=most_steps or MOST_STEPS, slowness=plan.slowness)
    trace: list[str] = []
    world.on_note = lambda who, words: trace.append(
        f"{(world.now_ns - START_NS) * 1e-9:.6f} {world.steps} {who}: {words}"
    )
    own = [frozenset(identifiers(axis.config, axis.codecs)) for axis in begin.axes]
    bus, disk = CanBus(world, own), Disk(world, folder)
    judge = Judge(world, bus, begin.axes, by_itself=plan.virtual)
    bus.on_frame = judge.on_frame
    cast = Cast(plan, world, bus, disk, judge, begin)
    troubles = Troubles(cast)
    opens = doors(world, disk)
    opens["socket"].manager = cast.manager.hear
    seams = SEAMS
    if judge.nodes is not None:
        from pneud.prove import canlib  # noqa: PLC0415 - what it takes is loaded for few seeds only

        seams = SEAMS | canlib.SEAMS
    library: AbstractContextManager[None] = nullcontext()
    if plan.viewed:
        seams, library = seams | lookers.SEAMS, lookers.library(cast.viewers)
    with library, opened(opens, cast.adapters(), ENVIRON if plan.service else {}, seams):
        try:
            cast.start()
            troubles.begin()
            _live(plan, world, judge, troubles, cut_short=most_steps is not None)
        finally:
            world.end()
            disk.close()
    if not judge.found and most_steps is None:
        for session in judge.sessions:
            wrong = logs.wrong_with(session)
            if wrong:
                judge.says_no("log", f"{session.log.name}: {wrong}")
                break
    return Outcome(
        plan,
        tuple(judge.found),
        world.steps,
        (world.now_ns - START_NS) * 1e-9,
        sum(len(session.ticks) for session in judge.sessions),
        len(judge.sessions),
        sum(axis.engaged_ticks for axis in judge.axes),
        _digest(trace, folder),
        tuple(trace),
    )


def _live(plan: Plan, world: World, judge: Judge, troubles: Troubles, *, cut_short: bool) -> None:
    """Until something is found: faults for as long as the plan says, then none, and everything has to end."""
    end_ns = START_NS + round(plan.length_s * 1e9)
    world.at(end_ns, lambda: None)
    world.run(lambda: bool(judge.found) or world.now_ns >= end_ns)
    if judge.found:
        return
    troubles.heal()
    if judge.nodes is not None:
        _settle(world, judge, judge.nodes)
    world.note("all is well, and ends")
    for daemon in world.named(("daemon",)):
        world.send(daemon, signal.SIGTERM)
    last_ns = world.now_ns + round(END_S * 1e9)
    world.at(last_ns, lambda: None)
    world.run(lambda: bool(judge.found) or world.now_ns >= last_ns or not world.named(CREW))
    left = world.named(CREW)
    if left and not judge.found and not cut_short:
        judge.says_no("end", f"{', '.join(one.name for one in left)} run {END_S:g} s after they were to end")
    judge.look()


def _settle(world: World, judge: Judge, nodes: NodeJudge) -> None:
    """Wait until nodes to which nothing happens any more are ready."""
    last_ns = world.now_ns + round(SETTLE_S * 1e9)
    world.at(last_ns, lambda: None)
    world.run(lambda: bool(judge.found) or world.now_ns >= last_ns or nodes.settled())
    if not judge.found:
        nodes.expects(SETTLE_S)


def _digest(trace: Sequence[str], folder: Path) -> str:
    """Of all that a run has left."""
    found = hashlib.sha256("\n".join(trace).encode())
    for path in sorted(folder.glob("*.mcap")):
        found.update(path.name.encode() + path.read_bytes())
    return found.hexdigest()[:16]


def shrunk(
    bench: Bench, outcome: Outcome, look: Callable[[int], None] = lambda _: None
) -> tuple[tuple[int, ...], Outcome]:
    """The fewest of a plan's faults and operations with which the same oracle says no.

    Args:
        bench: to run at.
        outcome: that a plan has come to.
        look: told how many are left.

    Returns:
        Their numbers in the plan, and what it comes to with these.
    """
    plan, oracle = outcome.plan, outcome.found[0].oracle
    left = list(range(len(plan.items)))
    best = outcome
    size = max(1, len(left) // 2)
    while size:
        begin = 0
        while begin < len(left):
            fewer = left[:begin] + left[begin + size :]
            tried = bench.run(plan.only(fewer))
            if tried.found and tried.found[0].oracle == oracle:
                left, best = fewer, tried
                look(len(left))
            else:
                begin += size
        size //= 2
    return tuple(left), best
