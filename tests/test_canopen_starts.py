"""Nodes that misbehave while they are configured: every start ends ready, or with one line for a person."""

from __future__ import annotations

import os
import re
from collections import Counter
from functools import cache

import pytest

pytest.importorskip("canopen")

from canopen_bus import Wire, network_of
from commands import Figures
from pneud.canopen.master import Master, NodeError, Patience
from pneud.canopen.objects import Nmt
from pneud.canopen.plan import Plan, plans_of
from pneud.config.reading import load_config
from pneud.rig.canopen import slaves_of
from pneud.rig.slave import KINDS, Slave

STARTS = int(os.environ.get("PNEUD_STARTS", "1000"))
PATIENCE = Patience(boot_s=3.0)
LINE = re.compile(r"node \d+ \(\w+\), (0x[0-9A-F]{4}:[0-9A-F]{2} \S.*|boot-up): .+; .+")


@cache
def plans() -> tuple[Plan, ...]:
    return plans_of(load_config("canopen.toml"))


def kind_of(seed: int) -> str:
    return KINDS[seed // len(plans()) % len(KINDS)]


def start(seed: int) -> tuple[str, tuple[Slave, ...], Wire]:
    """One start: the line that it ends with, empty where all is ready."""
    slaves = slaves_of(plans(), seed)
    ready = {plan.node.id: slave for plan, slave in zip(plans(), slaves, strict=True)}
    extra: tuple[Slave, ...] = ()
    if kind_of(seed) == "duplicate":
        plan = plans()[seed % len(plans())]
        extra = (Slave(plan.eds, plan.node.id, 7_000_000 + seed),)
    wire = Wire(*slaves, *extra)
    with network_of(wire) as network:
        master = Master(network, PATIENCE, pause=wire.pause, clock=wire.clock)
        try:
            master.configure(plans())
        except NodeError as e:
            assert all(slave.state != Nmt.OPERATIONAL for slave in slaves)  # not half configured
            return str(e), slaves, wire
    for plan in plans():
        slave = ready[plan.node.id]
        assert slave.state == Nmt.OPERATIONAL
        for message in plan.messages:
            assert slave.uses(message.pdo, message.can_id)
        last = {(s.object.index, s.object.sub): s for s in plan.steps}
        for (index, sub), step in last.items():
            if step.write and not (step.may_lack and (index, sub) not in slave.values):
                assert not (slave.get(index, sub) ^ step.value) & step.mask, (plan.name, str(step.object))
    return "", slaves, wire


def test_each_kind_of_misbehaviour_ends_ready_or_with_a_line() -> None:
    for kind in range(len(KINDS)):
        seed = kind * len(plans()) + kind % len(plans())
        line, *_ = start(seed)
        assert not line or LINE.fullmatch(line), (kind_of(seed), line)


@pytest.mark.slow
def test_a_thousand_starts(figures: Figures) -> None:
    found: Counter[tuple[str, bool]] = Counter()
    for seed in range(STARTS):
        line, *_ = start(seed)
        assert not line or LINE.fullmatch(line), (seed, kind_of(seed), line)
        found[kind_of(seed), not line] += 1
    for kind in KINDS:
        figures(f"starts, {kind}: {found[kind, True]} ready, {found[kind, False]} with one line")
    for kind in ("healthy", "slow boot"):
        assert not found[kind, False], kind
    for kind in ("silent", "bootloader", "never ready", "duplicate"):
        assert not found[kind, True], kind
