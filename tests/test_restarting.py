"""Waiting for the session that follows another one, and what the processes of a daemon are told by."""

from __future__ import annotations

import os
from typing import Any

import pytest

from pneud.console import restarting
from pneud.console.endpoint import PlaceError
from pneud.console.processes import LOOP, Processes
from pneud.console.restarting import next_session


class Called:
    """A daemon that is not there, then as it was, and then another one."""

    def __init__(self, *logs: str | None) -> None:
        self.logs = list(logs)
        self.left = 0

    def __call__(self) -> Any:
        log = self.logs.pop(0)
        if log is None:
            raise PlaceError("nobody")
        return Told(self, log)


class Told:
    def __init__(self, called: Called, log: str) -> None:
        self._called, self._log = called, log

    def __enter__(self) -> Told:
        return self

    def __exit__(self, *_: object) -> None:
        self._called.left += 1

    def ask(self, _: str) -> dict[str, Any]:
        return {"log": self._log, "state": "disarmed"}


def test_it_waits_for_another_log_and_leaves_all_that_are_not_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restarting, "LOOK_S", 0.0)
    called = Called("a", None, "a", "b", "c")
    client, status = next_session(called, "a", 20.0, lambda status: status["log"] != "b")
    assert (status["log"], called.left, called.logs) == ("c", 3, [])
    assert client.ask("status") == status


def test_it_says_that_none_has_come() -> None:
    with pytest.raises(PlaceError, match=r"not begun anew within 0 s: see its journal"):
        next_session(Called(), "a", 0.0)


def test_the_loop_is_among_the_processes_by_its_name() -> None:
    found = Processes(os.getpid(), lambda: ()).counters()
    assert LOOP in {one["name"] for one in found}
