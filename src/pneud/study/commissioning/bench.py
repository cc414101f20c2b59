"""Where a commissioning takes place: the software rig in simulated time, or the axis of a running daemon.

Either plays an operator tick by tick, keeps a log of it, and goes on with another configuration.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from pneud.config.reading import parse
from pneud.config.toml import changed_text
from pneud.config.writing import put_text, with_axis
from pneud.loading import Loaded
from pneud.log.files.naming import new_log
from pneud.log.files.reader import LogReader, read_log
from pneud.log.files.writer import LogWriter
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.signals import Record, Request
from pneud.study.commissioning.movement import Verdict

LONGEST_S = 600.0  # of axis time, for one operator


class Operator(Protocol):
    """Who asks something of the axis in a tick, and sees what becomes of it."""

    @property
    def verdict(self) -> object | None:
        """What came of it, once it is over."""

    def ask(self, state: int, present: int) -> Request | None:
        """What is asked of the axis in this tick."""

    def see(self, record: Record) -> None:
        """What became of it."""


class Bench(Protocol):
    """A rig, and what its controller believes.

    Attributes:
        loaded: the configuration that it runs with.
        axis_s: how long it has been at work.
        tries: it can go on with a configuration that is in no file.
    """

    tries: bool
    loaded: Loaded
    axis_s: float

    @property
    def log_name(self) -> str:
        """Of the log that is being written or was written last."""

    def play(self, operator: Operator) -> None:
        """Let an operator do what he wants to."""

    def logs(self) -> list[LogReader]:
        """What has been recorded since the last configuration was put to use."""

    def prove(self, verdict: Verdict, /) -> None:
        """Keep what the movement test has come to; where it is passed, the axis may be armed."""

    def adopt(self, text: str, keep: bool) -> None:
        """Go on with another configuration, which is kept in its file, or tried."""

    def put_back(self, text: str) -> str:
        """Have the file as it was; nothing that is engaged is disarmed for it.

        Returns:
            What is left to do for a person; empty where nothing is.
        """


class Simulated:
    """The software rig, the same for a seed; it may be unlike what the configuration says of it."""

    tries = True

    def __init__(self, loaded: Loaded, truth: dict[str, Any], seed: int, folder: Path) -> None:
        """A rig that stands still.

        Args:
            loaded: what the controller believes.
            truth: tables laid over it: the rig as it is.
            seed: of the sensors' noise.
            folder: for logs.
        """
        self.loaded, self._truth, self._seed, self._folder = loaded, truth, seed, folder
        self.axis_s = 0.0
        self._logs: list[Path] = []
        self._runs = 0
        self._kept = False

    @property
    def log_name(self) -> str:
        """Of all that is simulated."""
        return f"{self.loaded.config.name}-simulated"

    def play(self, operator: Operator) -> None:
        """Let an operator do what he wants to, from the rig's first state on."""
        real, how = self.loaded, backend_of(self.loaded)
        if self._truth:
            text = changed_text(self.loaded.text, self._truth)
            real = real._replace(config=parse(text, f"{real.path} as it is"), text=text)
        run = Simulation(real, LONGEST_S, self._seed + self._runs, how, operator=operator.ask)
        self._runs += 1
        path = self._folder / f"{self.log_name}-{self._runs}.mcap"
        with new_log(path) as descriptor:
            writer = LogWriter(descriptor, header_of(self.loaded, seed=str(self._seed), law=how.name))
            for record in run.records():
                operator.see(record)
                writer.write(record)
                self.axis_s += 1.0 / real.config.loop.rate_hz
            if not writer.close():
                raise OSError(writer.error, os.strerror(max(writer.error, 0)), str(path))
        self._logs.append(path)

    def logs(self) -> list[LogReader]:
        """What has been recorded since the last configuration was put to use."""
        return [read_log(str(path)) for path in self._logs]

    def prove(self, _verdict: Verdict) -> None:
        """Nothing: a software rig proves nothing, and may be armed."""

    def adopt(self, text: str, keep: bool) -> None:
        """Go on with another configuration, and the same rig."""
        if keep:
            self._kept = True
            path = self.loaded.path
            put_text(path, with_axis(path.read_text(encoding="utf-8-sig"), path, self.loaded.part, text))
        self.loaded = self.loaded._replace(config=parse(text, str(self.loaded.path)), text=text)
        self._logs = []

    def put_back(self, text: str) -> str:
        """Have the file as it was, where it has been written."""
        self.adopt(text, self._kept)
        return ""
