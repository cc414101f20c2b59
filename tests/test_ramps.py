"""The valve's edges before a loop is closed, from the first step of a commissioning alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pneud.loading import load
from pneud.study.commissioning import procedure
from pneud.study.commissioning.bench import Simulated
from pneud.study.commissioning.playing import Player
from pneud.study.commissioning.steps import first, static
from pneud.study.commissioning.truths import TWELVE, Truth, drawn, rig_text
from pneud.study.identification import parameters as key
from pneud.study.identification import ramps, table
from pneud.study.identification.table import Piece, Table

WITHIN_V = 0.015


def put(truth: Truth, folder: Path) -> tuple[Simulated, float, float]:
    """The rig of a truth, and its edges as commands."""
    file = folder / "axis.toml"
    file.write_text(rig_text(truth.rig), encoding="utf-8")
    loaded = load(file)
    hidden = drawn(loaded.config, truth.seed)
    v = hidden["plant"]["valve"]
    edges = v["centre_v"] - v["dead_zone_negative_v"], v["centre_v"] + v["dead_zone_positive_v"]
    return Simulated(loaded, hidden, truth.seed, folder), *edges


@pytest.mark.parametrize(
    "truth", [t if t.seed == 6 else pytest.param(t, marks=pytest.mark.slow) for t in TWELVE], ids=str
)
def test_the_first_step_tells_the_edges(truth: Truth, tmp_path: Path) -> None:
    """Of valves that are open at 0 V, too, whose load has drifted to an end."""
    rig, minus_v, plus_v = put(truth, tmp_path)
    p = procedure.axis_of(rig.loaded)
    player = Player(first(p), p.controller.h, lambda _: None)
    rig.play(player)
    assert player.verdict is not None
    assert player.verdict.whole
    measured, c = table.read(rig.logs())
    found = ramps.edges(measured, c)
    half, centre = found[key.HALF], found[key.CENTRE]
    assert centre.value - half.value == pytest.approx(minus_v, abs=WITHIN_V)
    assert centre.value + half.value == pytest.approx(plus_v, abs=WITHIN_V)
    assert half.low <= 0.5 * (plus_v - minus_v) <= half.high
    assert centre.low <= 0.5 * (plus_v + minus_v) <= centre.high


def test_a_log_without_openings_tells_no_edges() -> None:
    c, full = load("virtual.toml").config, np.full(3000, 3e5)
    shut = Piece(np.full(3000, 0.4), full, full, 2.0 * full, 0.0 * full)
    assert ramps.edges(Table(1e-3, 5e-4, (shut,)), c) == {}
    assert ramps.edges(Table(1e-3, 5e-4, ()), c) == {}


def test_an_axis_whose_valve_is_open_at_rest_is_not_disarmed_on_its_way() -> None:
    shut = procedure.axis_of(load("virtual.toml"))
    off = procedure.axis_of(load("virtual.toml", None, {"valve": {"centre_v": 0.2}}))
    assert [step.name for step in static(shut)] == ["rest", "edges"]
    (rest,) = static(off)
    assert "centred" not in rest.words
    assert len(rest.acts) == 2
