"""The notebook in examples: it is in order, runs as a script, and shows what it should as a page."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parent.parent / "examples" / "tuning.py"

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _marimo() -> None:
    if importlib.util.find_spec("marimo") is None:
        pytest.skip("no marimo here: pip install 'pneud[notebook]'")


def run(folder: Path, *args: object) -> subprocess.CompletedProcess[str]:
    """Python's own, to its end."""
    done = subprocess.run(
        [sys.executable, *map(str, args)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done


def test_it_is_in_order(tmp_path: Path) -> None:
    done = run(tmp_path, "-m", "marimo", "check", "--strict", NOTEBOOK)
    assert "warning" not in done.stdout + done.stderr


def test_it_runs_as_a_script_and_tunes(tmp_path: Path) -> None:
    told = run(tmp_path, NOTEBOOK).stdout
    found = re.search(r"^45 rad/s: (\d\.\d+) mm RMS, (\d\.\d+) mm at most$", told, re.MULTILINE)
    assert found is not None, told
    assert 0.0 < float(found[1]) < float(found[2]) < 1.0


def test_it_becomes_a_page_with_its_curves(tmp_path: Path) -> None:
    page = tmp_path / "tuning.html"
    run(tmp_path, "-m", "marimo", "export", "html", NOTEBOOK, "-o", page)
    text = page.read_text(encoding="utf-8")
    for shown in ("data:image/png", "The error of an axis over its bandwidth", "mm RMS", "marimo-slider"):
        assert shown in text, shown
    assert "Traceback" not in text
