"""The compiled law: the same as Python's to the last bit, also where Python raises; and life without it."""

from __future__ import annotations

import math
import os
import random
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from axis_rig import ARM, CLEAR, DISARM, ENCODER, VALVE, Rig, loaded, ready
from pneud.axis import sensing
from pneud.axis.cycle import Axis, cycle
from pneud.compiled import backend as backend_module
from pneud.compiled.backend import FUNCTIONS, INTERPRETED, Backend, backend, compiled, sample
from pneud.config import conversions
from pneud.config.measured import Places, with_map
from pneud.control.plan import COMING_TO_REST, FOLLOWING, GOING, JOINING, NONE, RESTING
from pneud.control.reference import Septic, at, septic, sine
from pneud.control.step import join
from pneud.control.tunables import tunables
from pneud.loading import load as load_axis
from pneud.physics.gas import iso6358
from pneud.physics.plant import Detail
from pneud.replay.lockstep import Simulation
from pneud.rig import dynamics
from pneud.rt.folders import cache_folder
from pneud.safety.supervisor import INITIAL, advance
from pneud.signals import Frame, Host, Reference, RequestKind, State
from pure2c import BuildError, Built, compile_functions
from pure2c.types import plain
from test_homing import unhomed

PARTS: tuple[Callable[..., Any], ...] = (*FUNCTIONS, sensing.sense, sensing.drive, join, sine, at, advance)
WHERE_PYTHON_RAISES = (0.0, -0.0, math.inf, -math.inf, math.nan, 1e300, -1e300, 5e-324)
PARAMETERS = conversions.axis_of(loaded().config, loaded().codecs.command_lsb_v)
FIRST = (Rig().inbox.measurement(0, 0), None, 1_000_000)


@pytest.fixture(scope="module", autouse=True)
def _compiler() -> None:
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")


def of(function: Callable[..., Any]) -> Callable[..., Any]:
    return parts().functions[PARTS.index(function)]


@cache
def parts() -> Built:
    """The cycle, and the greater functions that it calls, each by itself."""
    return compile_functions(PARTS, cache=cache_folder("compiled"))


def outcome(function: Callable[..., Any], arguments: list[Any]) -> str:
    try:
        return repr(function(*arguments))  # which tells -0.0 from 0.0, True from 1, and a record from a tuple
    except Exception as e:
        return repr(e)


def made_up(hint: Any, r: random.Random, wild: float) -> Any:
    """A value of a type; a part of the floats are those with which Python may raise."""
    if hint is bool:
        return r.random() < 0.5
    if plain(hint) is float:
        if r.random() < wild:
            return r.choice(WHERE_PYTHON_RAISES)
        return r.random() if r.random() < 0.5 else r.uniform(-1.0, 1.0) * 10.0 ** r.uniform(-6.0, 6.0)
    if plain(hint) is int:
        return r.choice((0, 1, 2, 3, 4, 7, 8, -1, 1 << 37, 1 << 62, r.randrange(-(2**65), 2**65)))
    if get_origin(hint) is UnionType:
        return None if r.random() < 0.3 else made_up(get_args(hint)[0], r, wild)
    if get_origin(hint) is tuple:
        inside = get_args(hint)
        inside = inside[:1] * r.choice((0, 1, 3, 9)) if Ellipsis in inside else inside
        return tuple(made_up(inner, r, wild) for inner in inside)
    hints = get_type_hints(hint)
    return hint(*(made_up(hints[name], r, wild) for name in hint._fields))


@pytest.mark.parametrize("index", range(len(PARTS)))
def test_compiled_functions_return_and_raise_what_the_originals_do(index: int) -> None:
    function, made = PARTS[index], parts().functions[index]
    hints = [hint for name, hint in get_type_hints(function).items() if name != "return"]
    r = random.Random(index)
    for i in range(200):
        arguments = [made_up(hint, r, (0.0, 0.02, 0.2)[i % 3]) for hint in hints]
        if function is dynamics.advance:
            arguments[4] = arguments[3] + 1e-3 * r.random()
            arguments[5] = arguments[5]._replace(step_s=1e-4)
        assert outcome(made, arguments) == outcome(function, arguments)


DETAIL = Detail(
    True,
    0.02,
    0.03,
    0.05,
    0.2,
    4e7,
    2e-7,
    True,
    3e-7,
    0.05,
    1e-3,
    1e-4,
    1e-6,
    1e-4,
    500.0,
    -500.0,
    100.0,
    2e-3,
)


@pytest.mark.parametrize("slips", [True, False])
@pytest.mark.parametrize("places", [(), ((-5.0, -1.0), (-0.2, 0.0), (0.1, 0.0), (1.0, 0.1), (5.0, 1.0))])
def test_a_plant_with_all_details_is_the_same_to_the_last_bit(slips: bool, places: Places) -> None:
    p = conversions.plant_of(loaded().config)
    p = p._replace(
        gas=iso6358(p.gas, 0.3, 0.55),
        cylinder=p.cylinder._replace(exhaust=0.9, vent=iso6358(p.gas, 0.2, 0.5)),
        valve=with_map(p.valve, places),
        detail=DETAIL._replace(slips=slips),
    )
    a = b = dynamics.initial_state(p)
    r, u, made = random.Random(2), 0.0, of(dynamics.advance)
    for i in range(400):
        u = r.uniform(-5.0, 5.0) * r.random() ** 3 if i % 20 == 0 else u
        a, b = (f(s, u, 0.0, i * 1e-3, (i + 1) * 1e-3, p) for f, s in ((dynamics.advance, a), (made, b)))
        assert repr(a) == repr(b)
    assert a.depth.elements.z1 != 0.0 or not slips


def test_whatever_the_c_cannot_do_is_left_to_python() -> None:
    made, p = of(sine), PARAMETERS.reference
    assert made(1, p) == sine(1, p)
    assert made(t=1.0, p=p) == sine(1.0, p)
    with pytest.raises(ZeroDivisionError):
        of(at)(0.0, Septic(*(0.0,) * 9))
    with pytest.raises(TypeError):
        made(1.0)
    with pytest.raises(AttributeError):
        made(1.0, (1.0, 2.0))
    assert of(advance)(INITIAL, 1 << 70, 0, False) == advance(INITIAL, 1 << 70, 0, False)


def silent(can_id: int) -> Callable[[Frame], Frame | None]:
    return lambda frame: None if frame.can_id == can_id else frame


def broken(frame: Frame) -> Frame:
    return frame._replace(data=frame.data[:-1] + b"\x00") if frame.can_id == ENCODER else frame


def with_faults(rig: Rig) -> list[str]:
    """A run with all that a rig may do to an axis, to the last digit."""
    found = []

    def ticks(n: int, kind: int = 0, *values: float, skipped: int = 0) -> None:
        for i in range(n):
            tick = rig.tick(*(kind, *values) if i == 0 else (0,), skipped=skipped if i == 0 else 0)
            found.append(repr((tick, rig.axis.freeze())))

    ticks(80)
    ticks(700, ARM, 1.0)
    ticks(5, skipped=3)
    rig.frame = silent(ENCODER)
    ticks(20)
    rig.frame = silent(VALVE)
    ticks(20)
    rig.frame = lambda frame: frame
    rig.measurement = lambda m: m._replace(p1_pa=math.nan)
    ticks(2)
    rig.measurement = lambda m: m
    ticks(100)
    ticks(100, CLEAR)
    ticks(100, ARM)
    rig.frame = broken
    ticks(80)
    rig.frame = lambda frame: frame
    ticks(60)
    ticks(100, CLEAR)
    rig.node.force_ext_n = 300.0
    ticks(100, ARM)
    ticks(200, RequestKind.GOTO, 0.48, 0.0, 0.0, 0.0)
    ticks(100, RequestKind.STOP)
    ticks(200, RequestKind.JOG, 0.05, 100.0)
    ticks(100, DISARM)
    return found


def test_closed_loops_are_the_same_to_the_last_bit() -> None:
    one, other = Rig(), Rig()
    other.axis = compiled().axis(PARAMETERS)
    a, b = with_faults(one), with_faults(other)
    assert a == b
    states = {int(line.partition("Supervisor(state=")[2].partition(",")[0]) for line in a}
    assert states >= {
        State.DISARMED,
        State.TRACKING,
        State.HOLDING,
        State.MOVING,
        State.STOPPING,
        State.FAULT,
    }


@pytest.mark.slow
@pytest.mark.parametrize("config", ["virtual.toml", "paper-case1.toml", "paper-case2.toml"])
def test_simulations_are_the_same_to_the_last_bit(config: str) -> None:
    axis = load_axis(config)
    runs = [Simulation(axis, 8.0, 1, how) for how in (INTERPRETED, compiled())]
    tracking = 0
    for a, b in zip(runs[0].records(), runs[1].records(), strict=True):
        assert repr(a) == repr(b)
        tracking += a.tick.state == State.TRACKING
    assert tracking > 500
    assert runs[0].axis.freeze() == runs[1].axis.freeze()


def test_a_run_may_go_on_in_the_other() -> None:
    rig, other = ready(), compiled().axis(PARAMETERS)
    rig.tick(ARM, 1.0)
    rig.ticks(20)
    other.thaw(rig.axis.freeze())
    axis = rig.axis
    expected = rig.tick()
    assert other.cycle(expected.measurement, None, expected.t_ns) == expected
    assert other.freeze() == axis.freeze()


def test_the_sample_begins_to_track() -> None:
    assert "Supervisor(state=3" in sample(INTERPRETED, PARAMETERS)[-1]
    assert backend("auto", PARAMETERS).name == backend("required", PARAMETERS).name == "compiled"


def test_off_is_python() -> None:
    assert backend("off", PARAMETERS) == INTERPRETED
    assert type(INTERPRETED.axis(PARAMETERS)) is Axis


@pytest.fixture
def made() -> Backend:
    """From the usual cache; ask for it before `elsewhere`."""
    return compiled()


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "pneud" / "compiled"


@pytest.fixture
def unloaded() -> Iterator[None]:
    """Nothing is loaded yet, and what a test loads does not stay."""
    backend_module.built.cache_clear()
    yield
    backend_module.built.cache_clear()


@pytest.mark.usefixtures("unloaded")
def test_a_machine_without_compiler_computes_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    found = backend("auto", PARAMETERS)
    assert (found.axis, found.name) == (Axis, "python")
    assert found.reason == "there is no C compiler: apt install gcc libc6-dev"
    with pytest.raises(BuildError, match="no C compiler"):
        backend("required", PARAMETERS)


def test_a_cache_that_others_may_write_to_is_not_used(elsewhere: Path) -> None:
    elsewhere.mkdir(parents=True)
    elsewhere.chmod(0o777)
    assert "others may enter it" in backend("auto", PARAMETERS).reason


@pytest.mark.skipif(os.geteuid() != 0, reason="needs to give a folder away")
def test_root_in_the_home_of_another_user_computes_in_python(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    os.chown(home, 12345, 12345)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    assert backend("auto", PARAMETERS).reason == f"{home}: belongs to user 12345, not to 0 or root"
    assert not list(home.iterdir())


def test_without_a_home_it_computes_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "~nosuchuser")
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    assert backend("auto", PARAMETERS).reason.startswith("no place for a cache: ")


@pytest.mark.slow
def test_a_law_that_was_cut_short_is_built_anew(elsewhere: Path) -> None:
    made = compiled()
    for library in elsewhere.iterdir():
        os.truncate(library, 4096)
    assert made.axis(PARAMETERS).cycle(*FIRST).t_ns == FIRST[2], "and what runs goes on"
    again = [sys.executable, "-c", "from pneud.compiled.backend import compiled; print(compiled().name)"]
    assert subprocess.run(again, capture_output=True, text=True, check=True).stdout == "compiled\n"
    assert all(library.stat().st_size > 4096 for library in elsewhere.iterdir())


@pytest.mark.usefixtures("unloaded")
def test_a_law_that_computes_something_else_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def off_by_one_bit(*arguments: Any) -> Any:
        state, tick = cycle(*arguments)
        e = tick.estimate
        return state, tick._replace(estimate=e._replace(x3_n=math.nextafter(e.x3_n, math.inf)))

    built = Built((off_by_one_bit, dynamics.advance), tuple, b"another", (off_by_one_bit,))
    monkeypatch.setattr(backend_module, "compile_functions", lambda *_, **__: built)
    assert backend("auto", PARAMETERS).reason == "the compiled law does not compute what Python does"


def test_what_has_been_compared_is_compared_again_only_where_something_differs(
    made: Backend, elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = list[str]()
    monkeypatch.setattr(backend_module, "compiled", lambda: made)
    monkeypatch.setattr(backend_module, "sample", lambda one, _: compared.append(one.name))
    for _ in range(2):
        assert backend("required", PARAMETERS) is made
    assert compared == ["compiled", "python"]
    other = PARAMETERS._replace(limits=PARAMETERS.limits._replace(travel_max_m=0.5))
    backend("required", other)
    made = made._replace(identity=b"another")
    backend("required", PARAMETERS)
    assert len(compared) == 6
    for note in elsewhere.with_name("compared").iterdir():
        note.write_bytes(b"")
    backend("required", PARAMETERS)
    assert len(compared) == 8, "a note that is not as it was written is none"


def test_a_law_that_differs_is_not_noted(
    made: Backend, elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backend_module, "compiled", lambda: made._replace(identity=b"another"))
    monkeypatch.setattr(backend_module, "sample", lambda one, _: one.name)
    for _ in range(2):
        assert backend("auto", PARAMETERS).reason == "the compiled law does not compute what Python does"
    assert not list(elsewhere.with_name("compared").iterdir())


@pytest.mark.slow
def test_a_compiled_cycle_takes_less_than_half_the_time() -> None:
    ticks = [record.tick for record in Simulation(loaded(), 1.0, 0, INTERPRETED).records()]

    def seconds(how: Backend) -> float:
        axis = how.axis(PARAMETERS)
        begin = time.process_time()
        for tick in ticks:
            axis.cycle(tick.measurement, tick.request, tick.t_ns)
        return time.process_time() - begin

    made = compiled()
    assert statistics.median(seconds(made) / seconds(INTERPRETED) for _ in range(9)) < 0.5


@pytest.mark.slow
def test_what_was_built_is_used_again(elsewhere: Path) -> None:
    compiled()
    before = {path: path.stat().st_mtime_ns for path in elsewhere.iterdir()}
    again = [sys.executable, "-c", "from pneud.compiled.backend import compiled; print(compiled().name)"]
    assert subprocess.run(again, capture_output=True, text=True, check=True).stdout == "compiled\n"
    assert {path: path.stat().st_mtime_ns for path in elsewhere.iterdir()} == before


def test_python_is_called_for_requests_and_changes_of_state_only() -> None:
    left = compile_functions(FUNCTIONS, cache=cache_folder("compiled")).left
    rig, seen = Rig(), set()

    def run(ticks: int, request: int = 0, *values: float) -> None:
        for i in range(ticks):
            was, before = rig.axis.state, left()
            rig.tick(*(request, *values) if i == 0 else (0,))
            now = rig.axis.state
            if i and (was.supervisor.state, was.plan.phase) == (now.supervisor.state, now.plan.phase):
                assert left() == before, (now.supervisor, now.plan.phase)
                seen.add((now.supervisor.state, now.plan.phase))

    rig.axis = compiled().axis(PARAMETERS)
    run(80)
    run(700, ARM, 1.0)
    run(200, RequestKind.GAINS, *tunables(PARAMETERS.controller), 0.45, 0.03, 3.0)
    assert rig.axis.state.reference is not None
    run(200, RequestKind.GOTO, 0.48)
    run(1500, RequestKind.HOLD)
    run(200, RequestKind.JOG, 0.03, 1000.0)
    run(100, RequestKind.STOP)
    run(200, DISARM)
    assert {state for state, _ in seen} >= {
        State.DISARMED,
        State.TRACKING,
        State.MOVING,
        State.HOLDING,
        State.STOPPING,
    }
    assert {phase for _, phase in seen} >= {NONE, JOINING, FOLLOWING, COMING_TO_REST, GOING, RESTING}


def test_c_goes_on_whatever_the_machine_lacks() -> None:
    left = compile_functions(FUNCTIONS, cache=cache_folder("compiled")).left
    rig, python = Rig(), Rig()
    rig.axis = compiled().axis(PARAMETERS)
    for condition in (one for one in Host if one != Host.SYNC_LOST):
        rig.host = python.host = int(condition)
        for i in range(5):
            before = left()
            assert repr(rig.tick()) == repr(python.tick())
            assert i < 2 or left() == before, condition.name


def test_a_tick_can_be_rehearsed_and_changes_nothing() -> None:
    rig, python = Rig(), Rig()
    rig.axis = compiled().axis(PARAMETERS)
    rig.tick()
    python.tick()
    for i in range(300):
        request = (ARM, 1.0) if i == 100 else (0,)
        tick = rig.tick(*request)
        assert repr(tick) == repr(python.tick(*request))
        assert rig.axis.rehearse(tick.measurement, tick.t_ns)
        assert not python.axis.rehearse(tick.measurement, tick.t_ns)
    assert tick.state == State.TRACKING


def test_c_follows_a_long_profile() -> None:
    left = compile_functions(FUNCTIONS, cache=cache_folder("compiled")).left
    rig, other = Rig(), Rig()
    rig.axis = compiled().axis(PARAMETERS)
    low = Reference(PARAMETERS.reference.centre_m, 0.0, 0.0, 0.0)
    high = low._replace(position_m=low.position_m + 1e-3)
    profile = [septic(0.1, low, high), septic(0.1, high, low)] * 20

    def run(ticks: int, request: int = 0, *values: float) -> None:
        for i in range(ticks):
            asked = (request, *values) if i == 0 else (0,)
            assert repr(rig.tick(*asked)) == repr(other.tick(*asked))

    run(80)
    for piece in profile:
        run(1, RequestKind.PIECE, *piece)
    run(100, ARM, 1.0)
    run(800, RequestKind.TRACK, 1.0)
    before = left()
    run(600)
    assert left() == before
    plan = rig.axis.state.plan
    assert plan.uploaded and plan.phase == FOLLOWING and plan.piece > 1
    assert rig.axis.freeze() == other.axis.freeze()


def test_c_homes() -> None:
    left = compile_functions(FUNCTIONS, cache=cache_folder("compiled")).left
    rig, other = unhomed(0.02, speed_m_s=0.05), unhomed(0.02, speed_m_s=0.05)
    axis = compiled().axis(rig.axis.parameters)
    axis.thaw(rig.axis.freeze())
    rig.axis = axis
    assert repr(rig.tick(RequestKind.HOME)) == repr(other.tick(RequestKind.HOME))
    before = left()
    ticks = 0
    while rig.axis.state.supervisor.state == State.HOMING:
        assert repr(rig.tick()) == repr(other.tick())
        ticks += 1
    assert left()[0] - before[0] == 1, "which is the last"
    assert rig.axis.state.supervisor.state == State.HOLDING
    assert ticks > 1000


@pytest.mark.parametrize(
    ("armed", "asked", "state"),
    [
        (True, (RequestKind.FORCE, 30.0, 0.0, 0.0, 0.0, 0.0, 0.0), State.PRESSING),
        (False, (RequestKind.PROBE, 1.0, 0.2, 2e-3, 0.05, 150.0, 5000.0), State.PROBING),
    ],
)
def test_c_presses_and_probes(armed: bool, asked: tuple[float, ...], state: State) -> None:
    left = compile_functions(FUNCTIONS, cache=cache_folder("compiled")).left
    rig, other = Rig(), Rig()
    rig.axis = compiled().axis(PARAMETERS)

    def run(ticks: int, request: int = 0, *values: float) -> None:
        for i in range(ticks):
            words = (request, *values) if i == 0 else (0,)
            assert repr(rig.tick(*words)) == repr(other.tick(*words))

    run(80)
    if armed:
        run(50, ARM)
    kind, *values = asked
    run(2, int(kind), *values)
    before = left()
    run(300)
    assert rig.axis.state.supervisor.state == state
    assert left() == before
    run(2, RequestKind.STOP)
    assert rig.axis.freeze() == other.axis.freeze()
