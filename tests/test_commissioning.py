"""The movement test in simulated time: every mistake of wiring is named, and little moves."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from axis_rig import ready
from pneud.config import conversions
from pneud.config.proof import Proof, digest, keep, place, proven
from pneud.daemon.preparation import RunOptions, lacks_proof
from pneud.loading import Loaded, load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.safety.faults import names
from pneud.signals import Answer, Host, Record, RequestKind, State
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


def test_a_proof_holds_for_what_was_tried(tmp_path: Path) -> None:
    loaded = load("virtual.toml")
    c, dbc, file = loaded.config, loaded.dbc.read_bytes(), tmp_path / "rig.toml"
    now = digest(c, dbc)
    assert proven(file, now) == Proof.MISSING
    keep(file, now, {"passed": True})
    assert proven(file, now) == Proof.PASSED
    gains = c.control.model_copy(update={"k1": 1.0})
    assert digest(c.model_copy(update={"control": gains}), dbc) == now
    shorter = c.cylinder.model_copy(update={"stroke_m": 0.5})
    assert proven(file, digest(c.model_copy(update={"cylinder": shorter}), dbc)) == Proof.CHANGED
    larger = c.valve.model_copy(update={"orifice_area_m2": None, "nominal_flow_l_min": 700.0})
    assert proven(file, digest(c.model_copy(update={"valve": larger}), dbc)) == Proof.CHANGED
    other = larger.model_copy(update={"nominal_flow_l_min": 350.0})
    assert digest(c.model_copy(update={"valve": other}), dbc) != digest(
        c.model_copy(update={"valve": larger}), dbc
    )
    assert proven(file, digest(c, dbc + b" ")) == Proof.CHANGED
    keep(file, now, {"passed": False})
    assert proven(file, now) == Proof.FAILED
    for text in ("[]", "{", '{"passed": 1}'):
        place(file).write_text(text)
        assert proven(file, now) == Proof.MISSING


@pytest.mark.parametrize(
    ("bus", "kept", "unproven", "lacks"),
    [
        ("socketcan:can0", None, False, True),
        ("socketcan:can0", None, True, False),
        ("socketcan:can0", True, False, False),
        ("socketcan:can0", False, False, True),
        ("socketcan:vcan0", None, False, False),
        ("unixcan:x", None, False, False),
        ("unixcan:x", False, False, True),
    ],
)
def test_a_rig_that_is_not_proven_may_not_be_armed(
    bus: str, kept: bool | None, unproven: bool, lacks: bool, tmp_path: Path
) -> None:
    loaded = load("virtual.toml")._replace(path=tmp_path / "rig.toml")
    if kept is not None:
        keep(loaded.path, digest(loaded.config, loaded.dbc.read_bytes()), {"passed": kept})
    o = RunOptions(
        config=None,
        bus=bus,
        virtual=False,
        arm=False,
        duration_s=None,
        rate_hz=None,
        headless=True,
        json=False,
        log=None,
        scenario=None,
        seed=0,
        socket=None,
        live=None,
        unproven=unproven,
    )
    assert lacks_proof(o, loaded, bus) is lacks


def test_what_is_not_proven_may_be_tested_but_not_armed() -> None:
    rig = ready()
    rig.host = int(Host.UNPROVEN)
    assert names(rig.tick().present) == ["unproven"]
    assert rig.tick(RequestKind.ARM).answer == Answer.BLOCKED
    assert rig.tick(RequestKind.PROBE, 1.0, 0.2, 1e-3, 0.03, 150.0, 100.0).state == State.PROBING


def test_nothing_more_is_asked_for_before_a_slow_loop_has_come_to_it() -> None:
    loaded = load("virtual.toml")
    p = conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)
    test, quiet = MovementTest(p), round(0.31 / p.controller.h)
    asked = [test.ask(State.DISARMED, 0) for _ in range(3 * quiet)]
    assert [a is not None for a in asked].count(True) == 1
    for _ in range(round(3.1 / p.controller.h)):
        test.ask(State.DISARMED, 0)
    assert test.verdict is not None and test.verdict.findings == (Finding.BY_FAULT,)


def test_what_is_blocked_for_a_moment_is_asked_for_again() -> None:
    rig, loaded = ready(), load("virtual.toml")
    p = conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)
    test, quiet = MovementTest(p), round(0.31 / p.controller.h)
    first = next(a for _ in range(quiet) if (a := test.ask(State.DISARMED, 0)) is not None)
    rig.host = int(Host.LINK_DOWN)
    test.see(rig.tick(first.kind, *first.values))
    assert test.verdict is None
    rig.host = 0
    assert first in [test.ask(State.DISARMED, 0) for _ in range(quiet)]
