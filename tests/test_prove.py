"""The whole daemon in seeded simulation: the same seed does the same, mistakes are found, and shrunk."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("greenlet")

from historical import MISTAKES
from pneud.loop.loop import Loop
from pneud.prove.plan import NAMES, OTHERS, TWO, Item, Plan, plan_of
from pneud.prove.program_judge import ProgramJudge
from pneud.prove.run import Bench, shrunk
from pneud.rt.outputs import write_whole
from pneud.verbs import VerbError
from pneud.verbs.prove import prove
from pneud.view.viewers import TOPICS, _Publisher

CI_SEEDS = 200
SOAK_SEEDS = int(os.environ.get("PNEUD_SEEDS", "100000"))
ROOT = Path(__file__).parents[1]
SO_FAR = ROOT / "build" / "soak" / "seeds.txt"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    yield Bench(tmp_path_factory.mktemp("prove"))


def short(seed: int, length_s: float = 0.6) -> Plan:
    return plan_of(seed)._replace(length_s=length_s)


def test_a_seed_is_the_same_again_to_the_last_byte(bench: Bench) -> None:
    one, again = bench.run(short(3)), bench.run(short(3))
    assert one.trace == again.trace
    assert one.digest == again.digest
    assert one.ticks > 20


def test_a_run_in_which_nothing_goes_wrong_arms_and_ends(bench: Bench) -> None:
    plan = next(p for p in map(plan_of, range(100)) if p.virtual)
    outcome = bench.run(plan.only(())._replace(length_s=1.5))
    assert not outcome.found
    assert outcome.engaged_ticks > 100
    assert "is gone, 0" in outcome.trace[-1]


def test_a_run_ends_after_so_many_steps(bench: Bench) -> None:
    outcome = bench.run(short(3), most_steps=2000)
    assert 2000 <= outcome.steps < 2100
    assert not outcome.found


@pytest.mark.slow
def test_a_mistake_is_found_and_shrunk_to_what_it_takes(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    MISTAKES["the wall clock is not followed"].make(monkeypatch)
    plan = plan_of(1)._replace(length_s=1.0)
    outcome = bench.run(plan)
    left, smallest = shrunk(bench, outcome)
    assert [plan.items[number].kind for number in left] == ["clock"]
    assert smallest.found[0].oracle == outcome.found[0].oracle == "heard"


def test_a_daemon_that_begins_anew_ends_where_it_is_told_to_meanwhile(bench: Bench) -> None:
    restart = Item(0.6, "operator", {"who": 0, "verb": "restart"})
    plans = [Plan(seed, 0.74, False, False, "compact", 1.0, 200.0, (restart,)) for seed in range(4)]
    outcomes = [bench.run(plan) for plan in plans]
    assert not any(outcome.found for outcome in outcomes)
    assert any("restart is done" in words for outcome in outcomes for words in outcome.trace)


def test_a_wall_clock_that_is_set_does_not_take_the_software_rig_along(bench: Bench) -> None:
    off = {"trouble": "stamp", "for_s": 0.1, "share": 0.5, "by_s": 6.0, "towards": "rig"}
    plan = Plan(4, 1.2, False, False, "compact", 1.0, 200.0, (Item(0.5, "bus", off),))
    assert not bench.run(plan).found


def plan_with(*items: Item, length_s: float = 1.5, **more: Any) -> Plan:
    return Plan(4, length_s, True, False, "compact", 1.0, 100.0, items, **more)


@pytest.mark.parametrize(
    ("others", "whose", "then"),
    [(0, 0, "y stopping"), (1, 0, ""), (1, 1, "x disarmed"), (2, 1, "")],
)
def test_a_fault_of_one_axis_touches_the_other_as_its_table_says(
    others: int, whose: int, then: str, bench: Bench
) -> None:
    lost = {"trouble": "drop", "for_s": 0.2, "share": 1.0, "by_s": 0.0, "towards": "", "axis": whose}
    outcome = bench.run(plan_with(Item(0.8, "bus", lost), length_s=1.2, others=OTHERS[others], file=TWO))
    assert not outcome.found
    assert all(any(f"{name} tracking" in line for line in outcome.trace) for name in NAMES)
    until_end = outcome.trace[: next(n for n, line in enumerate(outcome.trace) if "all is well" in line)]
    one, other = NAMES[whose], NAMES[1 - whose]
    assert any(f": {one} fault" in line for line in until_end)
    after = [line for line in until_end if f": {other} " in line][4:]  # starting to tracking
    assert (then in after[0]) if then else not after


def test_start_begins_nothing_while_a_program_is_handed_over(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = {"schema": 1, "record": [{"do": "wait", "for_s": 0.01}] * 30}
    asks = {"who": 0, "verb": "run", "program": tree, "load": True}
    halts = Item(0.85, "stop", {"who": "console", "step": 0, "for_s": 0.15})
    arms = Item(0.6, "operator", {"who": 0, "verb": "arm", "unproven": True})
    during, after = (Item(at_s, "press", {"for_s": 0.05}) for at_s in (0.88, 1.45))
    plan = plan_with(arms, Item(0.75, "operator", asks), halts, during, length_s=1.8, pressed=True)
    plan = plan._replace(virtual=False)
    judged: list[ProgramJudge] = []
    monkeypatch.setattr(ProgramJudge, "__init__", _noted(ProgramJudge.__init__, judged))
    assert not bench.run(plan).found
    assert (judged[-1].pressed, judged[-1].begun) == (1, 0)
    assert not bench.run(plan._replace(items=(*plan.items, after))).found
    assert (judged[-1].pressed, judged[-1].begun) == (2, 1)
    MISTAKES["half a program begins"].make(monkeypatch)
    assert [finding.oracle for finding in bench.run(plan).found] == ["program"]


def _noted(make: Any, judged: list[Any]) -> Any:
    def noted(self: Any, *args: Any) -> None:
        make(self, *args)
        judged.append(self)

    return noted


def test_the_manager_is_told_again_what_it_had_no_room_for(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_with(Item(0.5, "deaf", {"for_s": 0.6}), length_s=2.0, service=True)
    outcome = bench.run(plan)
    assert not outcome.found
    assert any("is ready" in line for line in outcome.trace)
    MISTAKES["words without room are lost"].make(monkeypatch)
    assert [finding.oracle for finding in bench.run(plan._replace(length_s=3.5)).found] == ["service"]


def test_who_begins_anew_has_time_for_its_log(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Item(1.0, "disk", {"state": "slow", "for_s": 3.0, "room": 0})
    restart = Item(1.2, "operator", {"who": 0, "verb": "restart"})
    plan = plan_with(slow, restart, length_s=5.0, service=True)._replace(virtual=False)
    assert not bench.run(plan).found
    monkeypatch.setattr(Loop, "_say_end", lambda _: None)
    assert [finding.oracle for finding in bench.run(plan).found] == ["service"]


def test_a_screen_that_hangs_or_dies_is_nothing_to_the_loop(bench: Bench) -> None:
    stands = Item(0.1, "terminal", {"for_s": 0.9})
    outcome = bench.run(plan_with(stands, shown=True))
    assert not outcome.found
    assert any("screen: is gone, -14" in line for line in outcome.trace)


def test_what_viewers_are_shown_are_the_ticks_in_their_order(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    topics = [f"/{name}{topic}" for name in NAMES for topic in TOPICS]
    looks = [Item(0.4, "look", {"who": 1, "topic": topic, "on": True}) for topic in topics]
    more = Item(0.6, "kill", {"who": "viewers", "step": 0})
    plan = plan_with(*looks, length_s=0.7, others=OTHERS[0], file=TWO, viewed=True)
    outcome = bench.run(plan._replace(items=(*plan.items, more)))
    assert not outcome.found
    assert outcome.engaged_ticks > 50
    publish = _Publisher.publish

    def twice(self: Any, wanted: frozenset[str]) -> None:
        poll, records = self._poll, self._poll()
        self._poll = lambda: records * 2
        publish(self, wanted)
        self._poll = poll

    monkeypatch.setattr(_Publisher, "publish", twice)
    assert {finding.oracle for finding in bench.run(plan).found} == {"shown"}


def test_what_a_console_has_asked_is_not_done_where_it_dies_before_the_loop_comes_to_it(bench: Bench) -> None:
    plan = plan_with(
        Item(1.601, "stop", {"who": "daemon", "step": 0, "for_s": 0.03}),
        Item(1.602, "operator", {"who": 0, "verb": "arm"}),
        Item(1.606, "kill", {"who": "console", "step": 0}),
        length_s=2.0,
    )
    outcome = bench.run(plan._replace(virtual=False))
    assert not outcome.found
    assert any("not heard" in line for line in outcome.trace)
    assert not any("holding" in line for line in outcome.trace)


def test_nothing_is_armed_for_who_has_given_up_while_there_was_no_console(bench: Bench) -> None:
    asks = {"who": 0, "verb": "arm", "patience_s": 0.1}
    plan = plan_with(
        Item(0.6, "kill", {"who": "console", "step": 0}), Item(0.7, "operator", asks), length_s=1.8
    )
    outcome = bench.run(plan._replace(virtual=False))
    assert not outcome.found
    assert any("does not answer" in line for line in outcome.trace)
    assert not any("holding" in line for line in outcome.trace)


@pytest.mark.parametrize("happens", ["removed", "failing"])
def test_a_log_is_none_if_it_goes_while_the_last_of_it_is_synced(happens: str, bench: Bench) -> None:
    plan = plan_with(
        Item(0.4, "disk", {"state": "slow", "for_s": 1.5, "room": 0}),
        Item(0.5, "terminate", {"step": 0}),
        Item(2.0, "disk", {"state": happens, "for_s": 0.7, "room": 0}),
        length_s=2.8,
    )
    outcome = bench.run(plan._replace(virtual=False))
    assert not outcome.found
    assert any("daemon: is gone, 1" in line for line in outcome.trace)


def test_who_has_said_that_no_movement_test_is_asked_for_need_not_say_it_again(bench: Bench) -> None:
    verbs: tuple[tuple[float, str, dict[str, bool]], ...] = (
        (0.6, "arm", {}),
        (0.7, "arm", {"unproven": True}),
        (0.8, "disarm", {}),
        (1.0, "arm", {}),
    )
    items = [Item(at_s, "operator", {"who": 0, "verb": verb, **more}) for at_s, verb, more in verbs]
    outcome = bench.run(plan_with(*items, length_s=1.1)._replace(virtual=False, unproven=True))
    assert not outcome.found
    assert sum("told: arm is done" in line for line in outcome.trace) == 2
    assert sum("refused: blocked" in line for line in outcome.trace) == 1


@pytest.mark.slow
def test_a_rig_that_has_stood_for_long_is_given_time_to_pass_over_what_it_was_asked(bench: Bench) -> None:
    assert not bench.run(plan_of(1070).only((7, 17))).found


def test_options_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    (tmp_path / "something").touch()
    for options in (
        {"seeds": 0},
        {"minutes": 0.0},
        {"steps": 0},
        {"seeds": 2, "only": "1"},
        {"only": "a"},
        {"only": "999"},
        {"keep": tmp_path},
    ):
        with pytest.raises(VerbError, match=r"^prove: "):
            prove(**options)


def test_a_seed_leaves_its_logs_and_its_trace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "kept"
    assert prove(seed=3, steps=8000, keep=folder, json=True, how="off") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["finding"] is None
    assert told["steps"] >= 8000
    assert (folder / "trace.txt").read_text().startswith("0.000000 0 world: starts ")
    assert list(folder.glob("*.mcap"))


@pytest.mark.slow
def test_another_process_makes_the_same_of_a_seed() -> None:
    def told(hashing: str) -> dict[str, object]:
        done = subprocess.run(
            [sys.executable, "-m", "pneud.cli", "prove", "--seed", "5", "--json"],
            capture_output=True,
            timeout=120,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": hashing},
        )
        found: dict[str, object] = json.loads(done.stdout)
        return found

    one, other = told("1"), told("2")
    assert (one["digest"], one["steps"]) == (other["digest"], other["steps"])


@pytest.mark.slow
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_of_the_past_is_found(name: str, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    mistake = MISTAKES[name]
    mistake.make(monkeypatch)
    outcome = bench.run(plan_of(mistake.seed))
    assert outcome.found, name
    assert outcome.found[0].oracle in mistake.oracles
    assert outcome.steps <= 100_000


def program() -> str:
    """Names all that seeds hang on."""
    files = [path for folder in ("src", "configs") for path in (ROOT / folder).rglob("*") if path.is_file()]
    found = hashlib.sha256()
    for path in sorted(path for path in files if path.suffix in (".py", ".toml", ".dbc", ".eds")):
        found.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return found.hexdigest()[:16]


def left_of(seeds: range, file: Path, program: str) -> Iterator[int]:
    """Those that the program has not been through; whatever ends it, it goes on behind the last one."""
    known, _, done = (file.read_text(encoding="utf-8") if file.exists() else "").partition(" ")
    begin = int(done) if known == program and done.isdecimal() else seeds.start
    file.parent.mkdir(parents=True, exist_ok=True)
    for seed in range(max(begin, seeds.start), seeds.stop):
        yield seed
        write_whole(file, f"{program} {seed + 1}")


def test_seeds_that_were_interrupted_go_on_where_they_were(tmp_path: Path) -> None:
    file, seeds = tmp_path / "soak" / "seeds.txt", range(200, 205)
    assert next(left_of(seeds, file, "a")) == 200, "killed in the first"
    for seed in left_of(seeds, file, "a"):
        if seed == 203:
            break  # and in this one, or it has found something
    assert list(left_of(seeds, file, "a")) == [203, 204]
    assert list(left_of(seeds, file, "a")) == []
    assert list(left_of(range(200, 206), file, "a")) == [205]
    assert next(left_of(seeds, file, "b")) == 200, "another program"
    file.write_text("")
    assert next(left_of(seeds, file, "a")) == 200


def find_nothing(bench: Bench, seeds: Iterable[int]) -> None:
    for seed in seeds:
        outcome = bench.run(plan_of(seed))
        assert not outcome.found, f"{outcome.found[0]}; pneud prove --seed {seed}"


@pytest.mark.slow
def test_seeds_find_nothing(bench: Bench) -> None:
    find_nothing(bench, range(CI_SEEDS))


@pytest.mark.soak
def test_many_seeds_find_nothing(bench: Bench) -> None:
    find_nothing(bench, left_of(range(CI_SEEDS, CI_SEEDS + SOAK_SEEDS), SO_FAR, program()))
