"""What a start does without: how long it takes depends on the machine, what it loads does not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pneud.loading import load

HEAVY = {"can", "cantools", "google", "mcap", "numpy", "rich", "textual", "zstandard"}
LATER = {  # loaded by the processes and the runs that need them
    "pneud.console.protocol",
    "pneud.console.server",
    "pneud.service.installation",
    "pneud.log.files.writer",
    "pneud.scenario.engine",
    "pneud.scenario.format",
    "pneud.scenario.sabotage",
    "pneud.scenario.stage",
    "pneud.view.app",
    "pneud.view.screen",
    "pneud.view.show",
    "pneud.view.terminal",
    "pneud.view.viewers",
}
# leaves with what is loaded, and with the collections of garbage, when the loop lays its grid
FIRST_TICK = """
import gc, sys
from pneud.cli import main
from pneud.loop.pacer import Pacer
go_on = Pacer.next
def first(self):
    Pacer.next = go_on
    print(*sys.modules)
    print(gc.isenabled(), gc.get_freeze_count() > 0)
    sys.stdout.flush()
    return go_on(self)
Pacer.next = first
main()
"""


def loaded(program: str, *args: object, cache: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, args)],
        env={**os.environ, "XDG_CACHE_HOME": str(cache), "CACHE_DIRECTORY": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout, done.stderr
    return done.stdout.splitlines()


def test_help_loads_nothing_but_the_command_line(tmp_path: Path) -> None:
    program = """
import sys
from pneud.cli import main
try:
    main()
except SystemExit:
    print(*sys.modules)
"""
    modules = loaded(program, "--help", cache=tmp_path)[-1].split()
    assert "pneud.cli" in modules
    assert not {name.partition(".")[0] for name in modules} & (HEAVY | {"pydantic", "asyncio"})
    assert {name for name in modules if name.startswith("pneud.")} == {"pneud.cli", "pneud.verbs"}


def test_completion_of_verbs_loads_none_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_PNEUD_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "pneud ")
    monkeypatch.setenv("COMP_CWORD", "1")
    program = """
import sys
sys.argv[0] = "pneud"
from pneud.cli import main
try:
    main()
except SystemExit:
    print()
    print(*sys.modules)
"""
    *offered, names = loaded(program, cache=tmp_path)
    assert {"sim", "install-service", "import", "tune"} <= set(offered)
    assert {name for name in names.split() if name.startswith("pneud.")} == {"pneud.cli", "pneud.verbs"}


@pytest.mark.slow
def test_the_loop_ticks_without_what_others_need(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    load("virtual.toml")  # what its DBC says is known from now on
    words = ("--virtual", "--duration", 0.05, "--headless", "--json", "--log", tmp_path)
    names, collector, *_ = loaded(FIRST_TICK, *words, cache=tmp_path)
    modules = names.split()
    assert "pneud.loop.loop" in modules
    assert not {name.partition(".")[0] for name in modules} & (HEAVY | {"asyncio"})
    assert not LATER & set(modules)
    assert collector == "False True", "no garbage is looked for in the loop"
