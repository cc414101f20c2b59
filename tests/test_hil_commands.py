"""The commands of hil/ and of the examples say what they take, and what they do not take is no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
COMMANDS = sorted(
    path.stem for path in (ROOT / "hil").glob("*.py") if "__main__" in path.read_text(encoding="utf-8")
)


def run(*words: str) -> subprocess.CompletedProcess[str]:
    source = os.pathsep.join(filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH", ""))))
    return subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": source},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_of_hil_says_what_it_takes(name: str) -> None:
    done = run("-m", f"hil.{name}", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: ")
    refused = run("-m", f"hil.{name}", "--nonsense")
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr


@pytest.mark.slow
def test_the_example_that_takes_a_log_says_so() -> None:
    done = run("examples/log_to_numpy.py")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("A log as numpy columns; usage: ")
