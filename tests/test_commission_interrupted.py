"""What ends a commissioning amid a step leaves configuration and proof as they were, and it goes again."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from axis_rig import CLEAR, Rig, quick, ready, same
from pneud import resources
from pneud.compiled.backend import INTERPRETED
from pneud.config.proof import digest, keep, place
from pneud.loading import Loaded, load
from pneud.log.files.reader import LogReader
from pneud.safety.faults import F, names
from pneud.safety.supervisor import is_engaged
from pneud.signals import Record, RequestKind, State, Tick
from pneud.study.commissioning import procedure, steps, testing
from pneud.study.commissioning.bench import Operator
from pneud.study.commissioning.movement import Finding, Verdict
from pneud.study.commissioning.steps import Step, dynamic, static
from provoked import CENTRING, STOPPING, Case, ids, law_without_number

PATIENT = 600  # ticks until something has to have had its effect
WITHOUT_LOOP = (
    F.TRACKING_ERROR,
    F.COMMAND_RANGE,
    F.SATURATED_LONG,
    F.BRAKING_DISTANCE,
)  # no probe can have these


class Amid(NamedTuple):
    """A step, and how one sees that it is under way."""

    name: str
    movement: bool
    state: State
    after: int = 30  # ticks
    braking: bool = False

    def steps(self, loaded: Loaded) -> list[Step]:
        """Those that are played."""
        p = procedure.axis_of(loaded)
        if self.name == "edges":
            edges = static(p)[1]
            at = next(i for i, act in enumerate(edges.acts) if act.lease)
            return [edges._replace(acts=edges.acts[at : at + 1])]
        return [step for step in static(p) + dynamic(p) if step.name == self.name][:1]

    def is_under_way(self, rig: Rig, tick: Tick) -> bool:
        """As the axis is since the last tick."""
        return tick.state == self.state and (not self.braking or rig.axis.state.probe.braked_ns != 0)


MOVEMENT = Amid("movement test", True, State.PROBING, after=1300)  # the valve's edge is passed
BRAKING = Amid("braking", True, State.PROBING, after=3, braking=True)
FIRST = Amid("first", False, State.PROBING, after=200)
EDGES = Amid("edges", False, State.PROBING, after=1300)
REST = Amid("rest", False, State.MOVING)
MOVES = Amid("moves", False, State.MOVING)
SINE = Amid("sine", False, State.TRACKING)
VERIFICATION = Amid("verification", False, State.TRACKING)
FEW = (
    F.LINK_DOWN,
    F.ENCODER_ERROR,
    F.SUPPLY_PRESSURE,
    F.EMERGENCY,
    F.CONSOLE_LOST,
)  # of the table, or all of it
BRAKED = 4  # ticks, for which it lasts
ALL = (MOVEMENT, BRAKING, FIRST, EDGES, REST, MOVES, SINE, VERIFICATION)


CASES = [
    pytest.param(amid, case, id=f"{amid.name}-{ids(case)}")
    for amid in ALL
    for case in (*CENTRING, *STOPPING)
    if not (
        amid.state == State.PROBING and (case.fault in WITHOUT_LOOP or case.provoke is law_without_number)
    )
    and (amid in (EDGES, MOVES, SINE) or case.fault in FEW or (amid == BRAKING and case.ticks <= BRAKED))
]


class ReachedError(Exception):
    """The step is under way."""


class Bench:
    """The axis of a test's rig; its configuration and proof are kept as those of a daemon are.

    The axis is compiled until something happens, which may be to its functions.
    """

    tries, log_name = False, "run.mcap"

    def __init__(self, amid: Amid, loaded: Loaded, rig: Rig) -> None:
        self.amid, self.loaded, self.rig, self.axis_s = amid, loaded, rig, 0.0
        self.happens: Callable[[], tuple[int, int]] | None = None  # kind of a request, ticks that are skipped

    def play(self, operator: Operator) -> None:
        self.rig.go_on(quick())
        tick, under_way = self.rig.tick(), 0
        while operator.verdict is None:
            asked = operator.ask(tick.state, tick.present)
            kind, values = (0, ()) if asked is None else asked
            skipped = 0
            under_way += under_way > 0 or self.amid.is_under_way(self.rig, tick)
            if under_way == self.amid.after:
                if self.happens is None:
                    raise ReachedError
                self.rig.go_on(INTERPRETED)
                other, skipped = self.happens()
                kind, values = (other, ()) if other else (kind, values)
            tick = self.rig.tick(kind, *values, skipped=skipped)
            operator.see(Record(tick, None, (), 0, (), math.nan))  # type: ignore[arg-type]
            assert under_way < self.amid.after + PATIENT, "nothing has come of it"

    def prove(self, verdict: Verdict) -> None:
        keep(
            self.loaded.path,
            digest(self.loaded.config, self.loaded.dbc.read_bytes()),
            {"passed": verdict.passed},
        )

    def logs(self) -> list[LogReader]:
        raise AssertionError("nobody looks at the log of what was interrupted")

    def adopt(self, text: str, keep: bool) -> None:
        raise AssertionError("nothing is written")

    def put_back(self, text: str) -> str:
        raise AssertionError("nothing has been written")


class Nobody:
    """Asks for nothing, says nothing."""

    def say(self, words: str) -> None: ...

    def agreed(self, changes: list[Any]) -> bool:
        raise AssertionError("nothing is to be written")


@pytest.fixture
def loaded(tmp_path: Path) -> Loaded:
    for name in ("virtual.toml", "pneud.dbc"):
        (tmp_path / name).write_bytes((resources.configs() / name).read_bytes())
    found = load(tmp_path / "virtual.toml")
    keep(found.path, "of another rig", {"passed": True, "date": "2026-11-29"})
    return found


@pytest.fixture
def begun(loaded: Loaded, monkeypatch: pytest.MonkeyPatch) -> Callable[[Amid], Bench]:
    """A bench on which one step is played."""

    def bench(amid: Amid) -> Bench:
        monkeypatch.setattr(procedure, "_steps", lambda p, wishes: amid.steps(loaded))
        monkeypatch.setattr(procedure, "_learnt_edges", lambda *_: False)
        monkeypatch.setattr(procedure, "GENTLER", ())
        if amid != FIRST:
            monkeypatch.setattr(steps, "first", lambda p: [])
        if amid.braking:
            monkeypatch.setattr(testing, "touches", lambda *_: [])
        return Bench(amid, loaded, ready())

    return bench


def commissioned(bench: Bench) -> procedure.Outcome:
    return procedure.commission(bench, procedure.Wishes(movement=bench.amid.movement), Nobody())


def kept(loaded: Loaded) -> list[bytes]:
    return [loaded.path.read_bytes(), place(loaded.path).read_bytes(), loaded.dbc.read_bytes()]


def ended(bench: Bench) -> tuple[procedure.Outcome, Tick]:
    """What it came to, and the axis when it has come to rest; the files are as they were."""
    before = kept(bench.loaded)
    outcome = commissioned(bench)
    assert kept(bench.loaded) == before
    assert not outcome.good
    assert not outcome.written
    for _ in range(2000):
        tick = bench.rig.tick()
        if tick.state == State.HOLDING or not is_engaged(tick.state):
            break
    return outcome, tick


def goes_again(bench: Bench) -> None:
    """Once what was wrong is over, the same step comes to where it was."""
    rig = bench.rig
    rig.frame, rig.measurement, rig.host = same, lambda m: m, 0
    rig.ticks(150)
    rig.tick(RequestKind.DISARM)
    rig.ticks(150)
    rig.tick(CLEAR)
    rig.until(State.DISARMED)
    bench.happens = None
    with pytest.raises(ReachedError):
        commissioned(bench)


@pytest.mark.slow
@pytest.mark.parametrize(("amid", "case"), CASES)
def test_a_fault_ends_a_step_and_leaves_all_as_it_was(
    amid: Amid, case: Case, begun: Callable[[Amid], Bench]
) -> None:
    bench = begun(amid)
    with pytest.MonkeyPatch.context() as patch:

        def happens() -> tuple[int, int]:
            case.provoke(bench.rig, patch)
            return 0, case.skipped

        bench.happens = happens
        outcome, tick = ended(bench)
    assert tick.state == State.FAULT
    assert names(1 << case.fault)[0] in outcome.faults
    if outcome.movement is not None:
        assert outcome.movement.unfinished
    goes_again(bench)


@pytest.mark.slow
@pytest.mark.parametrize("amid", ALL, ids=lambda amid: amid.name)
@pytest.mark.parametrize(
    "kind", [RequestKind.STOP, RequestKind.DISARM, RequestKind.SHUTDOWN], ids=lambda k: k.name
)
def test_somebody_elses_stop_ends_a_step_and_leaves_all_as_it_was(
    amid: Amid, kind: RequestKind, begun: Callable[[Amid], Bench]
) -> None:
    bench = begun(amid)
    bench.happens = lambda: (kind, 0)
    outcome, tick = ended(bench)
    assert tick.latched == 0
    assert tick.state == (
        State.HOLDING if kind == RequestKind.STOP and amid.state != State.PROBING else State.DISARMED
    )
    if amid.movement:
        assert outcome.movement == Verdict((Finding.STOPPED,))
    else:
        assert (outcome.verdict, outcome.failure) == ("interrupted", "stopped")
    if kind != RequestKind.SHUTDOWN:
        goes_again(bench)
