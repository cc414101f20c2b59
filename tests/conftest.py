"""What all tests share: what was collected is no garbage, and figures stand at the end of the output."""

from __future__ import annotations

import gc
import importlib
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from commands import Figures

gc.disable()  # until all tests are collected, a second sooner: they stay, and so does what they import
settings.register_profile("busy", deadline=None)  # how long an example takes is the machine's matter
settings.load_profile("busy")


@pytest.fixture
def figures(record_property: Callable[[str, object], None]) -> Figures:
    """Takes a line about what a test has found."""
    return lambda words: record_property("figures", words)


def pytest_sessionstart(session: pytest.Session) -> None:
    """What tells a second try across processes sends two small messages a test, the first without an answer.

    Held back until the first is acknowledged, the other one costs 40 ms: more than most of the tests.
    """
    kept = getattr(getattr(session.config, "failures_db", None), "sock", None)
    if kept is not None:
        kept.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    config, worker = session.config, getattr(session.config, "workerinput", {"workercount": 0})
    if worker["workercount"] > 1 and config.args_source == config.ArgsSource.TESTPATHS:
        load_share(int(worker["workerid"].removeprefix("gw")), worker["workercount"])


def load_share(number: int, workers: int) -> None:
    """Load a part of the tests first: in a fresh checkout no worker compiles what another one does."""
    for file in sorted(Path(__file__).parent.glob("test_*.py"))[number % workers :: workers]:
        with suppress(Exception, pytest.skip.Exception):  # which is told when it is collected
            importlib.import_module(file.stem)


@pytest.fixture(autouse=True)
def _nothing_said() -> None:
    """A command is a process of its own, which says once what it has to say once."""
    slow = sys.modules.get("pneud.compiled.slow")
    if slow is not None:
        slow.__dict__.update(_said={}, _hushed=False)


def pytest_collection_finish() -> None:
    """Thousands of collected tests stay: whoever looks for garbage need not go through them each time.

    Nor need anybody look often: cycles that tests leave behind are few.
    """
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)
    gc.enable()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    lines = [
        f"{report.nodeid.partition('::')[2]}: {words}"
        for reports in terminalreporter.stats.values()
        for report in reports
        if getattr(report, "when", "") == "call"
        for name, words in report.user_properties
        if name == "figures"
    ]
    if lines:
        terminalreporter.section("figures")
        for line in lines:
            terminalreporter.line(line)
