"""Rigs that differ from the plain model, or are of another structure, and what their logs make of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import pytest

from pneud.config.models import Config
from pneud.loading import load
from pneud.log.files.naming import new_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.physics.friction import Friction, stribeck
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.moves import Course, moves_of
from pneud.rig import dynamics
from pneud.signals import Record, State
from pneud.study.commissioning import estimated
from pneud.study.identification import estimating, explaining, table
from pneud.study.identification import parameters as key
from pneud.study.identification.estimating import Identified
from test_identify import TRUTH

pytestmark = pytest.mark.slow
PLACES = "100@500,900@400,300@200,350@30,340@10,345@10,150@500"
WAYS = "200@500,800@500,400@300,500@100"
LOGGED_S, WAYS_S = 20.0, 8.0


def true(**tables: dict[str, Any]) -> dict[str, Any]:
    """The truth with something else in its tables; None takes a key out."""
    return {"plant": {name: {**TRUTH[name], **tables.get(name, {})} for name in TRUTH}}


class Rig(NamedTuple):
    """A rig that the controller of virtual.toml knows nothing of."""

    tables: dict[str, Any]
    plain: bool = False  # its plant is interpreted, so that a test may change it

    def run(self, c: Config, seconds: float, course: Course) -> Iterator[Record]:
        """Ways, with what a controller believes."""
        loaded = load("virtual.toml", None, self.tables)
        loaded = loaded._replace(config=c.model_copy(update={"plant": loaded.config.plant}))
        how = backend_of(loaded)
        if self.plain:
            how = how._replace(advance=dynamics.advance)
        for record in Simulation(loaded, seconds, 1, how, operator=course.ask).records():
            course.see(record)
            yield record


def identified(rig: Rig, path: Path) -> tuple[Identified, list[str], Config]:
    """What a log of it tells, and what the model cannot explain."""
    believed = load("virtual.toml")
    with new_log(path) as descriptor:
        writer = LogWriter(descriptor, header_of(believed))
        for record in rig.run(believed.config, LOGGED_S, Course(moves_of(PLACES))):
            writer.write(record)
        writer.close()
    measured, c = table.read([read_log(path)])
    found = estimating.identify(measured, c)
    return found, explaining.unexplained(found.valved, found.moved, found.noise_pa, c), c


def error_m(rig: Rig, c: Config) -> float:
    """RMS of the true error on quick ways, from the first one on."""
    squares = []
    for record in rig.run(c, WAYS_S, Course(moves_of(WAYS))):
        tick = record.tick
        if tick.state == State.MOVING:
            squares.append((tick.reference.position_m - record.truth_m) ** 2)
    return math.sqrt(fmean(squares))


def improved(rig: Rig, found: Identified, c: Config) -> float:
    """The error with what has been found, over that before."""
    after = estimated.changed(c, estimated.believed(found.parameters, 0.0, c))
    return error_m(rig, after) / error_m(rig, c)


def test_friction_that_differs_by_direction_is_no_load(tmp_path: Path) -> None:
    rig = Rig(true(friction={"forward_share": 0.2}))
    found, odd, c = identified(rig, tmp_path / "run.mcap")
    assert odd == []
    share, load_n = found.parameters[key.FORWARD], found.parameters[key.LOAD]
    assert share.told
    assert share.value == pytest.approx(0.2, abs=0.05)
    assert share.low <= 0.2 <= share.high
    assert load_n.low <= 12.0 <= load_n.high
    assert load_n.value == pytest.approx(12.0, abs=3.0)
    assert found.parameters[key.COULOMB].value == pytest.approx(55.0, rel=0.1)
    values = estimated.rig(found.parameters, 0.0, found.noise_pa, c)
    assert values["plant.friction"]["forward_share"] == pytest.approx(share.value, rel=1e-4)


def test_friction_that_is_the_same_both_ways_has_no_direction(tmp_path: Path) -> None:
    found, odd, _ = identified(Rig(true()), tmp_path / "run.mcap")
    assert odd == []
    assert key.FORWARD not in found.parameters
    assert key.CRITICAL_OUT not in found.parameters
    assert found.parameters[key.LOAD].value == pytest.approx(12.0, abs=3.0)


def karnopp(
    v: float, z: float, guess: float, force_n: float, mass_kg: float, h: float, f: Friction
) -> tuple[float, float]:
    """A step of Karnopp's friction: it holds whatever is slower than a limit, and has no bristles."""
    if abs(v) < 1e-4 and abs(force_n) <= f.static_n:
        return 0.5 * v, 0.0
    way = math.copysign(1.0, v if abs(v) >= 1e-4 else force_n)
    after = v + h / mass_kg * (force_n - way * stribeck(v, f) - f.viscous_n_s_m * v)
    return 0.5 * (v + (0.0 if after * way < 0.0 else after)), 0.0


def test_friction_of_another_kind_is_told_and_the_axis_is_better_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dynamics, "slide", karnopp)
    rig = Rig(true(), plain=True)
    found, odd, c = identified(rig, tmp_path / "run.mcap")
    assert any(words.startswith(("forces", "friction")) for words in odd)
    assert improved(rig, found, c) < 0.7


BENT = [
    [-5.0, -1.0],
    [-2.5, -0.35],
    [-1.0, -0.08],
    [-0.15, 0.0],
    [0.15, 0.0],
    [1.0, 0.08],
    [2.5, 0.35],
    [5.0, 1.0],
]


def test_a_bent_flow_is_told_and_the_axis_is_better_all_the_same(tmp_path: Path) -> None:
    valve = dict.fromkeys(("dead_zone_positive_v", "dead_zone_negative_v", "centre_v", "dead_zone_v"))
    rig = Rig(true(valve={**valve, "map": BENT}))
    found, odd, c = identified(rig, tmp_path / "run.mcap")
    assert any(words.startswith(("flow map", "pressures")) for words in odd)  # both are of the flow
    assert improved(rig, found, c) < 0.7
