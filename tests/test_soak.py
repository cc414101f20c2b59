"""The long runs of hil/: faults without end, kills, the whole campaign."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from commands import Figures

HIL = Path(__file__).parent.parent / "hil"


def run(script: str, *arguments: object, timeout_s: float) -> str:
    """The last line of one of the scripts, which must have found nothing wrong."""
    command = [sys.executable, str(HIL / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.splitlines()[-1]


def sizes(few: int, all_of_them: int) -> pytest.MarkDecorator:
    return pytest.mark.parametrize(
        "count",
        [
            pytest.param(few, id="few", marks=pytest.mark.slow),
            pytest.param(all_of_them, id="all", marks=pytest.mark.soak),
        ],
    )


@sizes(120, 3600)
def test_random_faults_in_simulated_time_leave_nothing_stuck(count: int, figures: Figures) -> None:
    figures(run("soak.py", "--sim", count, timeout_s=60 + 2 * count))


@pytest.mark.realtime
@sizes(20, 600)
def test_random_faults_in_real_time_leave_nothing_stuck(count: int, figures: Figures) -> None:
    figures(run("soak.py", "--real", count, timeout_s=120 + 2 * count))


@pytest.mark.realtime
@sizes(2, 200)
def test_kills_in_motion_are_survived(count: int, figures: Figures) -> None:
    words = run("kills.py", count, timeout_s=120 + 20 * count)
    assert f"{count} kills" in words
    figures(words)


@pytest.mark.realtime
@sizes(4, 100)
def test_consoles_taken_away_leave_an_axis_at_rest(count: int, figures: Figures) -> None:
    words = run("console_kills.py", count, timeout_s=180 + 30 * count)
    assert f"{count} consoles taken away, 0 problems" in words
    figures(words)


@pytest.mark.soak
def test_every_scenario_in_real_time_comes_as_expected(figures: Figures) -> None:
    figures(run("campaign.py", "--bus", "unixcan", "-o", HIL.parent / "build" / "campaign", timeout_s=3600))
