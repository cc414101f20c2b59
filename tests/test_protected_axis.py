"""Axis and node by the same rule agree on who is engaged; by different ones nothing moves, and it is said."""

from __future__ import annotations

import math
import random
import shutil
from pathlib import Path

import pytest

from commands import pneud_here as pneud
from foreign import axis
from pneud.config import conversions
from pneud.loading import Loaded, load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.rig.node import PlantNode
from pneud.safety.faults import FAULT_NAMES
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, Record, ValveState

SHORT = ("rate_hz = 1000", "rate_hz = 500")
WITHIN = 2  # ticks


class Lossy(PlantNode):
    """A plant whose valve node does not hear some of the commands; it notes what the valve's state was."""

    lost: tuple[range, ...] = ()
    commands = 0
    states: list[int]

    def on_frame(self, frame: Frame, *, carried: bool = True) -> None:
        if frame.can_id == self._command_id:
            self.commands += 1
            if any(self.commands in span for span in self.lost):
                return
        super().on_frame(frame, carried=carried)


def run(loaded: Loaded, node: Lossy, seconds: float) -> tuple[list[Record], list[int]]:
    """Records, and the valve node's state after each."""
    simulation = Simulation(loaded, seconds, how=backend_of(loaded))
    simulation.node = node
    records, states = [], []
    for record in simulation.records():
        records.append(record)
        states.append(int(node.valve.state))
    return records, states


def faults(records: list[Record]) -> set[str]:
    return {name for i, name in enumerate(FAULT_NAMES) if any(r.tick.latched >> i & 1 for r in records)}


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Loaded:
    return load(axis(tmp_path_factory.mktemp("same"), "virtual.toml", SHORT))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_engaged_is_enabled_within_two_ticks(loaded: Loaded, seed: int) -> None:
    chance = random.Random(seed)
    node = Lossy(conversions.plant_of(loaded.config), loaded.codecs, seed)
    node.lost = tuple(range(at, at + chance.choice((1, 2, 20))) for at in chance.sample(range(400, 1200), 6))
    records, states = run(loaded, node, 2.6)
    engaged = [is_engaged(record.tick.state) for record in records]
    assert any(engaged)
    for i in range(WITHIN, len(records)):
        if any(n + 1 in span for span in node.lost for n in range(i - WITHIN - 3, i + 1)):
            continue  # not heard: what was said last holds, until its time-out
        steady = engaged[i - WITHIN : i + 1]
        if all(steady):
            assert states[i] == ValveState.ENABLED, i
        elif not any(steady):
            assert states[i] != ValveState.ENABLED, i


def another(tmp_path: Path, loaded: Loaded, old: str, new: str) -> Lossy:
    """A node that has another rule for commands."""
    path = axis(tmp_path, "virtual.toml", SHORT, frames=(old, new))
    other = load(path)
    return Lossy(conversions.plant_of(loaded.config), other.codecs, 0)


@pytest.mark.slow
def test_by_another_rule_nothing_moves_and_it_is_said(loaded: Loaded, tmp_path: Path) -> None:
    node = another(tmp_path, loaded, 'protection = "e2e-p02"\ndata_id = [', 'protection = "crc8-h2f"\n# [')
    records, states = run(loaded, node, 1.5)
    assert ValveState.ENABLED not in states
    assert not is_engaged(records[-1].tick.state)
    begin = records[0].truth_m
    assert max(abs(record.truth_m - begin) for record in records) < 2e-3
    assert faults(records) == {"valve_rebooted"}, "it is not enabled, though it should be"


@pytest.mark.slow
def test_two_identifiers_of_sixteen_the_other_way_round_cost_two_commands(
    loaded: Loaded, tmp_path: Path
) -> None:
    node = another(tmp_path, loaded, "data_id = [0x30, 0x31", "data_id = [0x31, 0x30")
    records, states = run(loaded, node, 1.5)
    assert states[-100] == ValveState.ENABLED and not faults(records), "the others hold it"


@pytest.mark.slow
def test_what_map_finds_on_a_bus_is_enough_to_run_on_it(loaded: Loaded, tmp_path: Path) -> None:
    log, config = tmp_path / "run.mcap", tmp_path / "found.toml"
    done = pneud("sim", loaded.path, "--duration", "4", "-o", log)
    assert done.returncode == 0, done.stderr
    for source in (loaded.path, loaded.dbc):
        shutil.copy(source, tmp_path)
    (tmp_path / loaded.path.name).rename(config)
    done = pneud("map", log, "--dbc", tmp_path / loaded.dbc.name, "-o", config, "--yes")
    assert done.returncode == 0, done.stderr
    found = load(config)
    assert found.config.bus.messages["LINEAR_POSITION"].protection == "e2e-p01"
    assert found.config.bus.messages["DRIVE_SETPOINT"].data_id == tuple(range(0x30, 0x40))
    node = Lossy(conversions.plant_of(loaded.config), loaded.codecs, 0)
    records, states = run(found, node, 2.0)
    assert not faults(records)
    assert states[-100] == ValveState.ENABLED
    assert simulated_rms_mm(records[-500:]) < 0.1


def simulated_rms_mm(records: list[Record]) -> float:
    off = [1e3 * (r.tick.reference.position_m - r.truth_m) for r in records if is_engaged(r.tick.state)]
    return math.sqrt(sum(e * e for e in off) / len(off))
