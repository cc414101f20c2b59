"""A run on a machine that refuses what it needs: lines and a status, never a traceback of a process of it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from commands import PNEUD, background, children, eventually

LIMIT_S = 60.0


def words(log: Path, duration_s: float = 0.5) -> list[str]:
    return ["--virtual", "--headless", "--duration", str(duration_s), "--log", str(log)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "limits",
    [
        *(
            ("", ">/dev/full"),
            ("", "2>/dev/full"),
            ("", ">/dev/full 2>&1"),
            ("", "| true"),
            ("", "2>&1 | true"),
        ),
        *((f"ulimit -n {n};", "") for n in (5, 9, 13, 17, 20, 24)),
        *((f"ulimit -f {n};", "") for n in (0, 1, 16, 200)),
    ],
    ids=" ".join,
)
def test_what_is_refused_is_said_in_lines(limits: tuple[str, str], tmp_path: Path) -> None:
    before, behind = limits
    done = subprocess.run(
        ["sh", "-c", f'{before} "$@" {behind}', "sh", *PNEUD, *words(tmp_path / "x.mcap")],
        capture_output=True, text=True, check=False, timeout=LIMIT_S,
    )  # fmt: skip
    assert "Traceback" not in done.stderr + done.stdout, done
    assert done.returncode in (0, 1, 2, 3) or "ulimit -f" in before, done
    if done.returncode in (2, 3) and "2>" not in behind:
        assert done.stderr.splitlines()[-1].startswith("pneud: ")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("which", range(3), ids=["recorder", "console", "plant"])
def test_a_process_of_the_crew_that_is_killed(which: int, tmp_path: Path) -> None:
    with background(*words(tmp_path / "x.mcap", 2.5)) as process:
        eventually(lambda: len(children(process.pid)) == 3)
        subprocess.run(["kill", "-9", str(children(process.pid)[which])], check=True)
        _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == (0 if which == 1 else 1), err  # an axis that armed itself needs no console
    assert "Traceback" not in err


@pytest.mark.slow
def test_a_folder_of_logs_that_vanishes(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    with background(*words(folder / "", 2.5)) as process:
        eventually(lambda: len(list(folder.glob("*.mcap"))) == 1)
        subprocess.run(["rm", "-r", str(folder)], check=True)
        _, err = process.communicate(timeout=LIMIT_S)
    assert "Traceback" not in err
