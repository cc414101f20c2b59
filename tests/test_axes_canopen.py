"""Several axes whose devices are CANopen nodes of one network."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pneud import resources
from pneud.config import conversions
from pneud.config.sections import ConfigError
from pneud.loading import load_axes, plans_of_plant
from pneud.replay.lockstep import backend_of
from pneud.replay.together import Together
from pneud.rig.canopen import CanopenRig, slaves_of
from pneud.rig.node import PlantNode
from pneud.rig.segment import Rigs, Segment
from pneud.signals import Frame, State

NAME = "canopen-axes.toml"


def test_axes_with_nodes_of_their_own_track_on_one_bus() -> None:
    axes = load_axes(NAME)
    run = Together(axes, 0.5, how=[backend_of(axis) for axis in axes])
    found = list(run.records())
    assert [record.tick.state for record in found[200]] == [State.TRACKING] * 2
    assert not any(record.tick.latched for records in found for record in records)
    worst = max(abs(record.true_error_m) for records in found[100:240] for record in records)
    assert worst < 2e-4


def test_nodes_that_are_not_configured_answer_as_nodes_and_send_no_positions() -> None:
    axes, segment = load_axes(NAME), Segment()
    nodes = [
        PlantNode(conversions.plant_of(axis.config), axis.codecs, n, segment=segment)
        for n, axis in enumerate(axes)
    ]
    plans = [plans_of_plant(axis) for axis in axes]
    rigs = Rigs(nodes, [CanopenRig(n, p, slaves_of(p)) for n, p in zip(nodes, plans, strict=True)])
    sync = axes[0].codecs.sync
    rigs.on_frame(Frame(1_000_000, sync.can_id, sync.encode(counter=1)))
    heard = {frame.can_id for frame in rigs.poll(2_000_000_000)}
    assert {0x700 + node for node in (1, 2, 3, 11, 12, 13)} <= heard  # they have booted
    answers = {answer.codec.can_id for axis in axes for answer in axis.codecs.answers}
    assert answers.isdisjoint(heard)
    for node in (2, 12):  # read the identity of one of each axis
        rigs.on_frame(Frame(2_000_100_000, 0x600 + node, bytes((0x40, 0x18, 0x10, 1, 0, 0, 0, 0))))
    assert rigs.due() is not None
    replies = {frame.can_id for frame in rigs.poll(2_100_000_000)}
    assert {0x582, 0x58C} <= replies


def test_a_node_of_two_axes_is_refused(tmp_path: Path) -> None:
    text = (resources.configs() / "axes" / NAME).read_text().replace("id = 12", "id = 2")
    (tmp_path / "a.toml").write_text(text)
    for eds in resources.configs().glob("*.eds"):
        shutil.copy(eds, tmp_path)
    with pytest.raises(ConfigError, match=r"of axis x and .* of axis y; give each its own"):
        load_axes(tmp_path / "a.toml")
