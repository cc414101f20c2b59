"""Oracles of CANopen nodes: looked up in the nodes of the rig, whatever those who configure them say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pneud.canopen.objects import Nmt
from pneud.canopen.plan import Plan
from pneud.prove.axis_judge import DEATH_S
from pneud.prove.canlib import NAME
from pneud.prove.world import Process
from pneud.rig.canopen import CanopenRig
from pneud.safety.supervisor import is_engaged
from pneud.signals import Host, Tick

if TYPE_CHECKING:
    from pneud.prove.judge import Judge

SILENT_TICKS = 4  # beyond its time-out, after which the loop has to have missed a node
_UNREADY = int(Host.HEARTBEAT_LOST)


class NodeJudge:
    """Looks at the nodes of an axis.

    Attributes:
        front: the nodes of the rig that is there, or was there last.
    """

    def __init__(self, judge: Judge, plans: Sequence[Plan]) -> None:
        """Nothing has happened.

        Args:
            judge: of everything.
            plans: what each node is to be configured to.
        """
        self.front: CanopenRig | None = None
        self._judge, self._world = judge, judge.world
        axis = judge.axes[0]
        self._most = round(DEATH_S * 1e9 / axis.period_ns)
        self._silent = round(1e6 * axis.config.bus.sensor_timeout_ms / axis.period_ns) + SILENT_TICKS
        # some are written twice
        self._values = [{step.object: step for step in plan.steps if step.write} for plan in plans]
        self._names = [plan.name for plan in plans]
        self.begins()

    def begins(self) -> None:
        """A loop is about to run."""
        self._engaged = self._unready = False
        self._down = 0  # ticks in which a node does not run
        self._died = 0  # ticks since the death of who configures them; 0 where it has not died

    @property
    def well(self) -> bool:
        """Whether all of them run."""
        return self.front is not None and all(s.state == Nmt.OPERATIONAL for s in self.front.slaves)

    def lacks(self) -> str:
        """Which node does not run, or is not as it is to be; empty where all are."""
        if self.front is None:
            return "there are no nodes"
        for name, slave, values in zip(self._names, self.front.slaves, self._values, strict=True):
            if slave.state != Nmt.OPERATIONAL:
                return f"{name} is {Nmt(slave.state).name.lower()}"
            for o, step in values.items():
                found = slave.get(o.index, o.sub)
                if (found ^ step.value) & step.mask:
                    return f"{name} has {found} as {o}, and not {step.value}"
        return ""

    def decided(self, tick: Tick) -> None:
        """The loop hands a tick over."""
        engaged, self._unready = is_engaged(tick.state), bool(tick.measurement.host & _UNREADY)
        self._down = 0 if self.well else self._down + 1
        begins, self._engaged = engaged and not self._engaged, engaged
        if begins and (self._down > self._silent or not self._down) and (words := self.lacks()):
            self._judge.says_no("configured", f"the axis engages, and {words}")
        if self._died:
            self._died = 0 if self._unready else self._died + 1
            if self._died > self._most:
                self._judge.says_no(
                    "nodes", f"their keeper has died, and nobody says so for {self._most} ticks"
                )

    def died(self, process: Process) -> None:
        """A process is gone."""
        daemon = self._world.processes.get(process.ppid)
        if process.name == NAME and daemon is not None and daemon.alive:
            session = self._judge.axes[0].session
            if session is not None and not session.ring.closed:
                self._died = 1

    def settled(self) -> bool:
        """Whether there is nothing to wait for: the nodes are ready, or nobody is there to make them so."""
        there = self._world.named((NAME,)) and self._world.named(("daemon",)) and self._judge.rig_is_well()
        return not there or not (self._unready or self.lacks())

    def expects(self, seconds: float) -> None:
        """All has been well for long enough."""
        if not self.settled():
            words = self.lacks() or "the loop does not say so"
            self._judge.says_no("nodes", f"all is well for {seconds:g} s, and they are not ready: {words}")
