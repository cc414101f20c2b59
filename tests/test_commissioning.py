"""The movement test in simulated time: every mistake of wiring is named, and little moves."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from pneud.config import conversions
from pneud.loading import Loaded, load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.signals import Record
from pneud.study.commissioning.movement import CURES, Finding
from pneud.study.commissioning.testing import MovementTest

MOST_S = 120.0


def miswired(wiring: dict[str, Any], rig: str = "virtual.toml") -> Loaded:
    loaded = load(rig)
    plant = loaded.config.plant
    plant = plant.model_copy(update={"wiring": plant.wiring.model_copy(update=wiring)})
    return loaded._replace(config=loaded.config.model_copy(update={"plant": plant}))


def outcome(loaded: Loaded, seed: int = 1) -> tuple[MovementTest, list[Record]]:
    test = MovementTest(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
    records = []
    for record in Simulation(loaded, MOST_S, seed, backend_of(loaded), operator=test.ask).records():
        test.see(record.tick)
        records.append(record)
    return test, records


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wiring", "finding"),
    [
        ({}, None),
        ({"swapped_hoses": True}, Finding.SWAPPED_HOSES),
        ({"encoder_inverted": True}, Finding.ENCODER_INVERTED),
        ({"exchanged_pressures": True}, Finding.EXCHANGED_PRESSURES),
        ({"dead_pressure": "a"}, Finding.DEAD_PRESSURE_1),
        ({"dead_pressure": "b"}, Finding.DEAD_PRESSURE_2),
        ({"supply_shut": True}, Finding.SUPPLY_SHUT),
        ({"valve_unplugged": True}, Finding.VALVE_UNPLUGGED),
        ({"encoder_scale": 10.0}, Finding.ENCODER_SCALE_LARGE),
        ({"encoder_scale": 25.4}, Finding.ENCODER_SCALE_LARGE),
        ({"encoder_scale": 0.1}, Finding.ENCODER_SCALE_SMALL),
        ({"blocked": True}, Finding.BLOCKED),
    ],
)
def test_a_mistake_is_named_and_little_moves(wiring: dict[str, Any], finding: Finding | None) -> None:
    loaded = miswired(wiring)
    test, records = outcome(loaded)
    assert test.verdict is not None
    assert test.verdict.findings == (() if finding is None else (finding,))
    places_m = [r.truth_m for r in records]
    assert max(places_m) - min(places_m) <= 5e-3
    assert max(abs(b - a) for a, b in pairwise(places_m)) <= 0.1 / loaded.config.loop.rate_hz


def test_every_finding_has_its_cure() -> None:
    assert set(CURES) == set(Finding)
