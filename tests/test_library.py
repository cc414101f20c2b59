"""pneud as a library, as its examples use it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import pneud
from commands import pneud as command
from pneud.signals import State

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_the_documented_names_are_there() -> None:
    assert pneud.load_config("virtual.toml").name == "virtual"
    assert callable(pneud.Axis)
    assert callable(pneud.read_log)
    assert next(iter(pneud.simulate("virtual.toml", 0.01))).tick.state == State.STARTING
    with pytest.raises(AttributeError):
        _ = pneud.nonsense


def test_simulation_is_the_same_for_a_seed_and_differs_for_another() -> None:
    def last(seed: int) -> object:
        *_, record = pneud.simulate("virtual.toml", 0.3, seed)
        return record.tick

    assert repr(last(1)) == repr(last(1))
    assert repr(last(1)) != repr(last(2))


@pytest.mark.slow
def test_the_examples_run(tmp_path: Path) -> None:
    log = tmp_path / "sim.mcap"
    assert command("sim", "virtual.toml", "--duration", 2, "-o", log).returncode == 0
    for script, args in (("tracking_error.py", []), ("log_to_numpy.py", [str(log)])):
        done = subprocess.run(
            [sys.executable, str(EXAMPLES / script), *args], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert "RMS" in done.stdout
