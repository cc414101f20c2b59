"""The long runs of hil/: faults without end, kills, the whole campaign."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HIL = Path(__file__).parent.parent / "hil"


def run(script: str, *arguments: object, timeout_s: float) -> str:
    """The output of one of the scripts, which must have found nothing wrong."""
    command = [sys.executable, str(HIL / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_random_faults_for_two_simulated_minutes_leave_nothing_stuck() -> None:
    assert "simulated: 120 s" in run("soak.py", "--sim", 120, timeout_s=300)


@pytest.mark.slow
def test_two_kills_in_motion_are_survived() -> None:
    assert "2 kills, 0 bad" in run("kills.py", 2, timeout_s=120)


@pytest.mark.soak
def test_random_faults_for_a_simulated_hour_leave_nothing_stuck() -> None:
    run("soak.py", "--sim", 3600, timeout_s=7200)


@pytest.mark.soak
def test_random_faults_for_ten_minutes_leave_nothing_stuck() -> None:
    run("soak.py", "--real", 600, timeout_s=1200)


@pytest.mark.soak
def test_two_hundred_kills_in_motion_are_survived() -> None:
    assert "200 kills, 0 bad" in run("kills.py", 200, timeout_s=3600)
