"""A scenario on the software rig: played by the plant's process, its effects told to the daemon's."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

from pneud.rig.node import PlantNode
from pneud.rig.plant_process import Rig
from pneud.rig.segment import Segment

if TYPE_CHECKING:
    from pneud.scenario.engine import Engine
    from pneud.scenario.format import Scenario

_MOST_BYTES = 4096


class Stage:
    """One scenario; `node` and `over` are for the plant's process, which may be this one."""

    def __init__(self, scenario: Scenario, rate_hz: float) -> None:
        """Pipes between those who play.

        Raises:
            OSError: no more descriptors.
        """
        self.scenario = scenario
        self._rate_hz = rate_hz
        self._effects, self._tell = os.pipe()
        self.orders, self._order = os.pipe()
        """To read the numbers of faults of the machine from."""
        self._engine: Engine | None = None

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Those that the plant's process needs."""
        return self._tell, self._order

    def node(self, rig: Rig, segment: Segment) -> PlantNode:
        """A plant that the scenario happens to, on a bus."""
        from pneud.scenario.engine import Engine  # noqa: PLC0415 - for the plant's process only

        def order(number: int) -> None:
            os.write(self._order, bytes((number,)))

        seed, rate_hz = rig.seed, self._rate_hz
        engine = Engine(self.scenario, rig.plant, rig.codecs, seed, rate_hz, order, rig.advance, segment)
        self._engine = engine
        return engine.node

    def over(self) -> None:
        """The controller has left: watch the load come to rest, and tell what has been shown."""
        assert self._engine is not None
        self._engine.settle()
        os.write(self._tell, json.dumps(self._engine.effects.as_dict()).encode())

    def effects(self) -> dict[str, Any] | None:
        """What the plant's process has told; to be called once, after its end.

        Returns:
            None where it could tell nothing.
        """
        os.close(self._tell)
        effects: dict[str, Any] | None = json.loads(os.read(self._effects, _MOST_BYTES) or b"null")
        return effects
