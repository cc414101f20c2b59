"""Viewers of a run, in a world: their process is the shipped one; the library that would serve is a door."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from pneud.daemon.places import ViewersPlace
from pneud.log.format.schema import TICK
from pneud.prove.judge import Judge
from pneud.prove.pipes import Listener
from pneud.prove.world import World
from pneud.view.admission import Admission

NAME = "viewers"  # of the process
SEAMS: dict[str, tuple[str, ...]] = {"pneud.view.viewers": ("os", "signal", "sys", "time")}
"""As of `seams`, where somebody looks on."""


def adapters() -> dict[str, Any]:
    """What takes the place of functions, by module and name."""
    return {"pneud.view.viewers.be_alone": lambda: True, "pneud.view.viewers.start_relay": lambda *_: None}


def place(world: World) -> ViewersPlace:
    """Where viewers come to."""
    listener: Any = Listening(world)
    return ViewersPlace(listener, Admission(None, frozenset()), "", "")


class Listening(Listener):
    """An address; nobody gets further than to it."""

    def __enter__(self) -> Listening:
        """It is the process's that is forked."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it here."""
        self.close()


class Viewers:
    """Those who look on: what they have asked for, and what they are shown.

    Attributes:
        shown: ticks that somebody was shown.
    """

    def __init__(self, judge: Judge) -> None:
        self.shown = 0
        self._judge, self._world = judge, judge.world
        self._watchers: Any = None
        self._last_ns: dict[str, int] = {}

    def looks(self, number: int, topic: str, *, on: bool) -> None:
        """Somebody wants to see something, or does not any more."""
        if self._watchers is not None:
            client, channel = SimpleNamespace(id=number), SimpleNamespace(id=topic, topic=topic)
            asks = self._watchers.on_subscribe if on else self._watchers.on_unsubscribe
            asks(client, channel)

    def serves(self, watchers: Any) -> None:
        """A server begins: another one's clients are gone."""
        self._watchers = watchers
        self._last_ns.clear()

    def log(self, topic: str, data: bytes, log_time: int) -> None:
        """Something is shown; ticks one after the other, each one that the loop has come to."""
        self._world.step()
        assert data
        axes = self._judge.axes
        axis = next((one for one in axes if len(axes) == 1 or topic.startswith(f"/{one.name}/")), None)
        if axis is None or axis.session is None or not topic.endswith(TICK):
            return
        self.shown += 1
        t_ns = log_time - axis.session.offset_ns
        before_ns, self._last_ns[topic] = self._last_ns.get(topic, 0), t_ns
        if t_ns <= before_ns:
            self._judge.says_no("shown", f"{topic}: a tick is shown behind a later one")
        if not axis.session.has_decided(t_ns):
            self._judge.says_no("shown", f"{topic}: a tick that the loop has not come to")


@contextmanager
def library(viewers: Viewers) -> Iterator[None]:
    """Have the process of viewers find a library that serves whoever the plan says."""

    def channel(topic: str, **_: Any) -> Any:
        return SimpleNamespace(log=lambda data, *, log_time: viewers.log(topic, data, log_time))

    def start_server(*, server_listener: Any, **_: Any) -> Any:
        viewers.serves(server_listener)
        return SimpleNamespace(port=0, stop=lambda: None)

    something: Any = SimpleNamespace
    found: dict[str, Any] = {
        "foxglove": SimpleNamespace(
            set_log_level=lambda _: None,
            Context=something,
            Channel=channel,
            Schema=something,
            start_server=start_server,
        ),
        "foxglove.websocket": SimpleNamespace(
            Capability=something(Parameters=0),
            Parameter=lambda name, value: something(name=name, value=value),
        ),
    }
    before = {name: sys.modules.get(name) for name in found}
    sys.modules.update(found)
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
