"""CANopen nodes and axes that are led, in seeded simulation: what is owed, and that it is seen if lacking."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

pytest.importorskip("greenlet")
pytest.importorskip("canopen")

from pneud import resources
from pneud.canopen.keeper import Keeper, Readiness
from pneud.canopen.master import Master
from pneud.loop import company
from pneud.prove.plan import CANOPEN, GANTRY, LED, OTHERS, Item, Plan
from pneud.prove.run import Bench, Outcome

LOST = {"trouble": "drop", "for_s": 0.1, "share": 1.0, "by_s": 0.0, "towards": "nodes"}
READY = "configured and started"


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    yield Bench(tmp_path_factory.mktemp("prove"))


def plan_with(*items: Item, file: str = CANOPEN, length_s: float = 2.5, seed: int = 4) -> Plan:
    others = () if file == CANOPEN else OTHERS[0]
    return Plan(seed, length_s, False, False, "compact", 1.0, 100.0, items, others=others, file=file)


def asks(at_s: float, verb: str, **fields: Any) -> Item:
    return Item(at_s, "operator", {"who": 0, "verb": verb, **fields})


def reboots(at_s: float, node: int = 0) -> Item:
    return Item(at_s, "slave", {"node": node, "boot_s": 0.0})


def lines(outcome: Outcome, *words: str) -> list[str]:
    return [line for line in outcome.trace if all(word in line for word in words)]


REBOOTS = plan_with(asks(1.4, "arm"), reboots(1.6), asks(1.72, "arm"), length_s=1.9)
UNHEARD = plan_with(Item(1.4, "bus", LOST), reboots(1.45), length_s=1.9)
KILLED = plan_with(asks(1.4, "arm"), Item(1.5, "kill", {"who": "nodes", "step": 0}), length_s=2.5)
HALF_LOST = plan_with(
    asks(0.6, "arm"), Item(0.8, "bus", {**LOST, "towards": "", "axis": 1}), file=GANTRY, length_s=1.0
)
WAY = asks(0.7, "track", what="reference", axis="y"), asks(0.8, "goto", x_mm=480.0, axis="x")
COUPLED = plan_with(asks(0.6, "arm"), *WAY, file=LED, length_s=2.9)


def test_a_node_that_reboots_is_configured_anew_before_anything_arms(bench: Bench) -> None:
    outcome = bench.run(REBOOTS)
    assert not outcome.found
    assert lines(outcome, "holding")
    assert lines(outcome, "node 1 (encoder406) has rebooted")
    assert lines(outcome, "refused")
    assert lines(outcome, "nodes: 1 configured")


@pytest.mark.parametrize("at_s", [0.4, 0.5])
def test_a_node_that_reboots_while_others_are_configured_is_not_left_out(at_s: float, bench: Bench) -> None:
    outcome = bench.run(plan_with(reboots(at_s), length_s=1.0))
    assert not outcome.found
    assert float(lines(outcome, READY)[-1].split()[0]) < 1.2  # s: nobody has waited for one that is not


def test_a_node_whose_reboot_is_not_heard_is_missed(bench: Bench) -> None:
    outcome = bench.run(UNHEARD)
    assert not outcome.found
    assert lines(outcome, "node 1 (encoder406) sends no heartbeat")


def test_guarded_nodes_are_not_missed_while_another_one_is_configured(bench: Bench, tmp_path: Path) -> None:
    text = resources.find(CANOPEN).read_text()
    for profile in ("encoder406", "analog404", "valve408"):
        text = text.replace(
            f'profile = "{profile}"', f'profile = "{profile}"\nguard = true\nheartbeat_ms = 45'
        )
    guarded = tmp_path / "guarded.toml"
    guarded.write_text(text)
    outcome = bench.run(plan_with(reboots(1.4), length_s=2.0)._replace(file=str(guarded)))
    assert not outcome.found
    assert [line.split("nodes: ")[-1] for line in lines(outcome, READY)] == [
        "1, 2, 3 configured and started",
        "1 configured and started",
    ]


def test_the_death_of_who_configures_nodes_is_told_and_stops_the_axis(bench: Bench) -> None:
    outcome = bench.run(KILLED)
    assert not outcome.found
    assert lines(outcome, "stopping")


def test_halves_of_a_gantry_are_engaged_together(bench: Bench) -> None:
    outcome = bench.run(HALF_LOST)
    assert not outcome.found
    assert len(lines(outcome, "holding")) == 2


class Mistake(NamedTuple):
    """Something that would be wrong, and how it is seen."""

    plan: Plan
    oracle: str
    make: Callable[[pytest.MonkeyPatch], None]


def _elsewhere(patch: pytest.MonkeyPatch) -> None:
    said = company.said

    def off(*args: Any) -> Any:
        told = said(*args)
        return told._replace(position_m=told.position_m + 0.004)

    patch.setattr(company, "said", off)


def _without_a_time_out(patch: pytest.MonkeyPatch) -> None:
    take = Master._take

    def some(self: Master, plan: Any, step: Any, boots: int) -> str:
        o = step.object
        return "" if (o.index, o.sub) == (0x1400, 5) else take(self, plan, step, boots)

    patch.setattr(Master, "_take", some)


def _replacing(where: Any, name: str, what: Any) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setattr(where, name, what)


MISTAKES = {
    "a silent node is not missed": Mistake(UNHEARD, "nodes", _replacing(Keeper, "_miss", lambda _: None)),
    "who configures is not watched": Mistake(KILLED, "nodes", _replacing(Readiness, "look", lambda _: None)),
    "values are not written": Mistake(REBOOTS, "nodes", _replacing(Master, "_take", lambda *_: "")),
    "a value is left out": Mistake(REBOOTS, "configured", _without_a_time_out),
    "a half goes on alone": Mistake(
        HALF_LOST, "gantry", _replacing(company, "_keep_together", lambda *_: None)
    ),
    "it is led elsewhere": Mistake(COUPLED, "led", _elsewhere),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_found(name: str, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    mistake = MISTAKES[name]
    if name == "it is led elsewhere":
        assert not bench.run(mistake.plan).found
    mistake.make(monkeypatch)
    assert [finding.oracle for finding in bench.run(mistake.plan).found] == [mistake.oracle]
