"""A beam between the pistons of two software rigs: a spring and a damper that hold them square."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pneud.physics.plant import BeamParameters
from pneud.rig.dynamics import stroke_position

if TYPE_CHECKING:
    from pneud.rig.node import PlantNode

STEP_NS = 200_000  # in which its force stays the same


class Beam:
    """A beam; it is square where both pistons are at first."""

    def __init__(self, one: PlantNode, other: PlantNode, p: BeamParameters) -> None:
        self._ends = one, other
        self._p = p
        self._square_m = self._apart_m()
        one.beam = other.beam = self

    def _apart_m(self) -> float:
        one, other = self._ends
        return stroke_position(one.state, one.p) - stroke_position(other.state, other.p)

    def carry(self, t_ns: int) -> None:
        """Integrate both rigs to `t_ns`; time begins for both when it does for one."""
        one, other = self._ends
        now_ns = max((end.plant_ns for end in self._ends if end.started), default=t_ns)
        for end in self._ends:
            end.begin(now_ns)
        while now_ns < t_ns:
            next_ns = min(t_ns, now_ns + STEP_NS)
            force_n = self.force_n((next_ns - now_ns) * 1e-9)
            one.march(next_ns, force_n)
            other.march(next_ns, -force_n)
            now_ns = next_ns

    def force_n(self, step_s: float) -> float:
        """The mean force over the next step that the first end feels against positive motion [N]."""
        one, other = self._ends
        apart_m_s = one.state.v - other.state.v
        apart_m = self._apart_m() - self._square_m + 0.5 * step_s * apart_m_s
        return self._p.stiffness_n_m * apart_m + self._p.damping_n_s_m * apart_m_s


def span(nodes: Sequence[PlantNode], names: Sequence[str], beams: Sequence[BeamParameters | None]) -> None:
    """Put the beams between rigs, each but once; one whose other end is not there is left out."""
    for node, beam in zip(nodes, beams, strict=True):
        if beam is not None and node.beam is None and beam.axis in names:
            Beam(node, nodes[names.index(beam.axis)], beam)
