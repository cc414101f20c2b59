"""What completion offers: verbs, options, scenarios, logs, files and keys; and what it loads for that."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from pneud import cli, resources
from pneud.config.reading import load_config
from pneud.config.toml import flat
from pneud.console.tuning import NAMES, keys
from pneud.verbs import complete_config, complete_key, complete_log, complete_scenario, complete_tunable

# typer looks for pydantic by itself where it is there
HEAVY = {"can", "cantools", "google", "mcap", "numpy", "asyncio", "zstandard", "numba", "scipy"}
PROGRAM = """
import sys
sys.argv[0] = "pneud"
from pneud.cli import main
try:
    main()
except SystemExit:
    print()
    print(*sys.modules)
"""


def completed(words: str) -> tuple[list[str], set[str]]:
    """What is offered at the end of a command line, and the modules that are loaded then."""
    asked = {
        "_PNEUD_COMPLETE": "complete_bash",
        "COMP_WORDS": f"pneud {words}",
        "COMP_CWORD": str(len(f"pneud {words}.".split()) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout, done.stderr
    *offered, modules = done.stdout.splitlines()
    return [line for line in offered if line], set(modules.split())


def options(command: object) -> set[str]:
    inner = list(getattr(command, "commands", {}).values())
    return {opt for c in (command, *inner) for p in getattr(c, "params", ()) for opt in p.opts}


@pytest.mark.parametrize("verb", cli.verbs())
def test_a_verb_that_is_not_loaded_has_the_same_options(verb: str) -> None:
    named = cli.Named(verb, cli.verbs()[verb])
    sketch, loaded = (
        typer.main.get_command(named._load(module)) for module in (cli._sketched(named.path), None)
    )
    assert options(sketch) == options(loaded)
    assert [p.name for p in sketch.params] == [p.name for p in loaded.params]


@pytest.mark.parametrize(
    ("words", "offers"),
    [
        ("replay --", {"--set", "--against", "--progress", "--help"}),
        ("tune ", {"get", "set", "diff", "save", "reload"}),
        ("tune set k", {"k1=", "k2=", "k3="}),
        ("--virtual --scenario hose", {"hose-burst", "hose-burst-rod-side"}),
        ("replay x.mcap --set control.k", {"control.k1=", "control.k2=", "control.k3="}),
        ("sim --progress ", {"auto", "json", "off"}),
        ("check virt", {"virtual.toml"}),
    ],
)
def test_what_a_shell_is_offered_and_what_that_loads(words: str, offers: set[str]) -> None:
    found, modules = completed(words)
    assert offers <= set(found)
    assert not {name.partition(".")[0] for name in modules} & HEAVY
    assert not {name for name in modules if name.startswith("pneud.verbs.")}


def test_logs_are_those_here_and_those_of_the_daemon_the_newest_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, state = tmp_path / "here", tmp_path / "state"
    for folder in (here / "old", here / ".git", state):
        folder.mkdir(parents=True)
    names = "axis-20260101T000000Z.mcap", "axis-20260202T000000Z.mcap"
    for name in names:
        (state / name).touch()
    for name in ("a.mcap", "a.txt", "old/b.mcap"):
        (here / name).touch()
    monkeypatch.chdir(here)
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    newest_first = [str(state / name) for name in reversed(names)]
    assert complete_log("") == ["a.mcap", "old/", *newest_first]
    assert complete_log("old/") == ["old/b.mcap"]
    assert complete_log("axis-20260101") == newest_first[1:]
    assert complete_log(f"{here}/a") == [f"{here}/a.mcap"]
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("HOME", str(tmp_path / "nobody"))
    assert complete_log("") == ["a.mcap", "old/"]


def test_scenarios_and_configurations_by_their_bare_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert complete_scenario("") == sorted(p.stem for p in resources.scenarios().glob("*.toml"))
    (tmp_path / "my.toml").touch()
    assert complete_scenario("my") == complete_config("my") == ["my.toml"]
    assert "paper-case1.toml" in complete_config("paper")


def test_keys_that_are_offered_exist() -> None:
    known = {key for p in resources.configs().glob("*.toml") for key in flat(load_config(p).model_dump())}
    offered = {key.removesuffix("=") for key in complete_key("")}
    assert len(offered) > 50
    tables = {key.rpartition(".")[0] for key in known}
    assert {key for key in offered if key not in known and key.rpartition(".")[0] not in tables} <= {"schema"}
    gains = [name for name in complete_tunable("") if not name.startswith("reference.")]
    assert gains == [f"{name}=" for name in NAMES if not name.startswith("reference.")]
    assert {f"{'.'.join(keys(n)[0])}=" for n in ("k1", "lambda0", "gain_n_s2")} <= set(
        complete_key("control.")
    )


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_by_the_script_that_is_installed(tmp_path: Path) -> None:
    command = tmp_path / "pneud"
    command.write_text(f"#!{sys.executable}\nfrom pneud.cli import main\nmain()\n")
    command.chmod(0o755)
    script = (
        'source <(_PNEUD_COMPLETE=source_bash pneud); COMP_WORDS=(pneud "$@"); COMP_CWORD=$#;'
        ' _pneud_completion pneud; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "--norc", "-c", script, "bash", "sim", "--scenario", "hose"],
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["hose-burst", "hose-burst-rod-side"], done.stderr
