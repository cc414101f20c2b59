"""Tests in this folder prove something only where they ran: a skipped one counts as failed."""

from __future__ import annotations

import importlib
from collections.abc import Generator

import pytest

# What a daemon, its processes and its plant load. A process of one's own takes seconds to start here.
LOADED = ("cli", "verbs.plant", "verbs.run", "console.server", "log.files.saving")


@pytest.fixture(scope="session", autouse=True)
def _loaded() -> None:
    """For the forks of this process."""
    for name in LOADED:
        importlib.import_module(f"pneud.{name}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Turns a skip into a failure."""
    report = yield
    if report.skipped:
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} was skipped: {report.longrepr}"
    return report
