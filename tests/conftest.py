"""What all tests share: figures that stand at the end of the output."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from commands import Figures


@pytest.fixture
def figures(record_property: Callable[[str, object], None]) -> Figures:
    """Takes a line about what a test has found."""
    return lambda words: record_property("figures", words)


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
