"""What hil/vm/run says when it cannot run anything."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

RUN = Path(__file__).parent.parent / "hil" / "vm" / "run"


def run(*arguments: str, path: str = "/usr/sbin:/usr/bin:/sbin:/bin") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["/bin/bash", RUN, *arguments],
        env={"PATH": path},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )


@pytest.mark.parametrize("arguments", [(), ("-t", "5"), ("-q", "true")])
def test_wrong_usage_shows_how_it_is_used(arguments: tuple[str, ...]) -> None:
    done = run(*arguments)
    assert done.returncode == 2
    assert "hil/vm/run [-s] [-t SECONDS]" in done.stderr
    assert not done.stdout


def test_a_machine_without_user_mode_linux_fails_and_is_told_the_cure(tmp_path: Path) -> None:
    for tool in ("sed", "realpath"):
        (tmp_path / tool).symlink_to(f"/usr/bin/{tool}")
    done = run("true", path=str(tmp_path))
    assert done.returncode == 125
    assert "apt install user-mode-linux" in done.stderr
