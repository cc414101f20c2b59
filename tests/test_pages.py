"""What the documents have their readers do: every command, file and program, in an empty folder each."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pages import PAGES, ROOT, Desk, Step, steps
from pneud.config.reading import AXIS, parse

# Commands that are not run here, and why. Each line has to fit a command of a document.
NOT_HERE = {
    r"make (test|pages)\b.*": "steps of .ci/run; the pages are compared in tests/test_site.py",
    r"make (vm|systemd|campaign-vm|devices-vm)\b.*|hil/vm/run .*": "need a virtual machine; steps of .ci/run",
    r"python -m hil\.force .*": "minutes; tests/test_hil_commands.py runs a part",
    r"make campaign\b.*": "minutes; a step of .ci/run",
    r"make (devices|device-faults|canopen-starts)\b.*": "minutes; their own tests run a part of each",
    r"make (information|strange)\b.*": "minutes; tests/test_hil_commands.py runs a part of each",
    r"python -m hil\.web\b.*": "minutes, and nothing beside it; tests/test_web_page.py has the crowd",
    r"python -m hil\.second_rig .*": "the rig of another program; tests/test_second_rig.py runs it",
    r"pneud --config axis\.toml --bus unixcan:demo": "the axis of that rig; likewise",
    r"make -C hil/foreign|hil/foreign/node .*": "SocketCAN; tests/vm builds and runs it",
    r"apt install .*": "root and a network",
    r"(ip|sudo) .*": "root",
    r"systemctl .*|python3 -m venv /opt/pneud|/opt/pneud/.*": "root, systemd; tests/vm/test_service.py",
    r"scp .*": "a second machine",
    r"python3 -m venv \.venv && .*|\.venv/bin/python -m hatchling .*": "tests/test_packaging.py does",
    r"make many-runs\b.*": "minutes; tests/test_many_runs.py runs fewer",
    r"make truths\b.*": "minutes; tests/test_truths.py commissions one",
    r"make mutants\b.*": "most of an hour",
    r"pneud campaign .* --scheduler .*": "a cluster; tests/test_many_runs.py begins one",
    r"pneud bench\b.*": "minutes; tests/test_bench.py runs short ones",
    r"pneud commission": "a rig",
    r"pneud commission --virtual .*": "minutes; tests/test_tutorial.py runs one",
    r"pneud reproduce .*": "minutes; tests/test_reproduction.py",
    r"pneud sim --compare.*": "minutes; tests/test_compare.py",
    r"pneud identify ((monday|last|bus)\.mcap.*|.*--against .*)": "ten seconds each; tests/test_identify.py",
    r"pneud report .* --reference .*": "bench takes minutes; tests/test_reporting.py",
    r"pneud mqtt .*mqtts://.*": "a broker with TLS; tests/test_mqtt.py has one",
    r"pneud web .*--tls-cert .*": "a certificate; tests/test_web_page.py makes one",
    r"pneud map --bus socketcan:can0 .*": "a rig; tests/test_map.py listens on unixcan",
    r"candump .*|pneud .*socketcan:vcan0.*": "SocketCAN; tests/vm runs daemon and rig over vcan0",
}
# Pages that take a rig from some command on
RIG = {"rig.md": "pneud --config press.toml --headless"}
# Pages that another test runs as a whole
ELSEWHERE = {
    "tutorial.md": "tests/test_tutorial.py",
    "python.md": "tests/test_python_page.py",
    "hil/bench/README.md": "tests/test_bench.py",
    "src/pure2c/README.md": "tests/test_pure2c_build.py",
}
# What a page takes for granted, made beforehand
GIVEN = {
    "axes.md": [f"cp {ROOT}/configs/axes/two-axes.toml {ROOT}/configs/axes/axes.dbc ."],
    "laws.md": ["pneud --virtual"],
    "force.md": [f"cp {ROOT}/configs/virtual.toml press.toml", f"cp {ROOT}/configs/pneud.dbc ."],
    "identification.md": [
        "pneud sim -o run.mcap --duration 4",
        f"pneud export run.mcap -o bus.log && cp {ROOT}/configs/pneud.dbc .",
        "mkdir logs && cp run.mcap logs/",
    ],
    "inputs-outputs.md": [f"cp {ROOT}/configs/virtual.toml machine.toml"],
    "programs.md": [f"cp {ROOT}/examples/programs/two-axes-pick-and-place.toml ."],
    "log.md": [
        "pneud sim -o run.mcap --duration 6",
        f"ln -s {ROOT}/configs .",
        f"mkdir logs && cp {ROOT}/tests/golden/requests.mcap logs/",
    ],
    "farm.md": [f"mkdir logs && cp {ROOT}/tests/golden/{{virtual,requests}}.mcap logs/"],
}
# Programs of others that a page has its reader start
NEEDS = {"mqtt.md": ("mosquitto", "mosquitto_sub")}
GOES_ON = re.compile(
    r"pneud (--virtual(?!.* --scenario)|--config|plant|web|mqtt)\b(?!.* --duration)|python -m can\.logger"
    r"|mosquitto "
)
MAY_END_WITH_1 = (  # the answer is no, and the page says so
    r"pneud (sim|--virtual) .*--scenario .*",
    r"pneud replay .* --set .*",
    r"pneud doctor.*",
    r"pneud design .* --simulate",
    r"pneud nodes set-id (?!.* --of ).*",
)
IS_REFUSED = {("device.md", "pneud check press.toml"): 1}  # the first so many times, with 2, as the page says
CHECKOUT = {"write-a-law.md"}  # pages that change the program; in a copy of it


def named(page: Path) -> str:
    return page.name if page.parent.name == "docs" else str(page.relative_to(ROOT))


def plain(command: str) -> str:
    return command.partition(" #")[0].strip()


def not_here(command: str) -> bool:
    return any(re.fullmatch(pattern, plain(command)) for pattern in NOT_HERE)


def to_be_done(page: Path) -> Iterator[Step]:
    """Steps of a page, but for those that need what is not here."""
    for step in steps(page):
        if step.kind == "command":
            if plain(step.text) == RIG.get(named(page)):
                return
            if not_here(step.text):
                continue
        yield step


def test_what_is_not_run_is_there() -> None:
    commands = [plain(step.text) for page in PAGES for step in steps(page) if step.kind == "command"]
    assert len(commands) > 100
    for pattern in (*NOT_HERE, *MAY_END_WITH_1, *RIG.values()):
        assert any(re.fullmatch(pattern, command) for command in commands), pattern
    assert {*ELSEWHERE, *GIVEN, *RIG, *CHECKOUT, *NEEDS} <= {named(page) for page in PAGES}


def lively() -> Iterator[Any]:
    """The pages with something to be done; those that start a daemon are a matter of time."""
    for page in PAGES:
        if named(page) not in ELSEWHERE and any(to_be_done(page)):
            typed = [step.text for step in to_be_done(page) if step.kind == "command"]
            timed = any(
                re.search(r"--virtual|--bus|make virtual", words) and not words.startswith("pneud new ")
                for words in typed + GIVEN.get(named(page), [])
            )
            yield pytest.param(page, marks=pytest.mark.realtime if timed else ())


@pytest.mark.slow
@pytest.mark.parametrize("page", [*lively()], ids=named)
def test_a_reader_can_do_what_a_page_says(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if missing := [program for program in NEEDS.get(named(page), ()) if shutil.which(program) is None]:
        pytest.skip(f"no {' and no '.join(missing)} here: apt install mosquitto mosquitto-clients")
    desk = Desk(tmp_path)
    refused = {words: times for (of, words), times in IS_REFUSED.items() if of == named(page)}
    names: dict[str, object] = {"__name__": "__main__"}
    for key in ("XDG_RUNTIME_DIR", "STATE_DIRECTORY"):
        monkeypatch.setenv(key, desk.env[key])
    monkeypatch.chdir(tmp_path)
    if named(page) in CHECKOUT:
        for name in ("src", "configs", "hil"):
            shutil.copytree(ROOT / name, tmp_path / name)
        desk.env["PYTHONPATH"] = str(tmp_path / "src")
    try:
        for words in GIVEN.get(named(page), []):
            typed(desk, words, refused)
        for step in to_be_done(page):
            done(desk, step, names, refused)
        desk.end()
    finally:
        desk.close()


def typed(desk: Desk, words: str, refused: dict[str, int]) -> None:
    # make only makes the environment first
    words = re.sub(r'^make virtual(?: ARGS="(.*)")?', r"pneud --virtual \1", plain(words)).strip()
    if GOES_ON.match(words):
        desk.begin(words)
        return
    if refused.get(words, 0):
        refused[words] -= 1
        desk.command(words, (2,))
        return
    no = any(re.fullmatch(pattern, words) for pattern in MAY_END_WITH_1)
    said = desk.command(words, (0, 1) if no else (0,))
    assert "--scenario" not in words or "as expected" in said, said


def done(desk: Desk, step: Step, names: dict[str, object], refused: dict[str, int]) -> None:
    """One step of a page, done."""
    file = desk.folder / step.name
    if step.kind == "command":
        typed(desk, step.text, refused)
    elif step.kind in ("file", "append"):
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a" if step.kind == "append" else "w", encoding="utf-8") as out:
            out.write(step.text)
    elif step.kind == "python":
        exec(compile(step.text, f"block at line {step.line}", "exec"), names)
    elif step.kind == "toml":
        sections_exist(step.text)
    elif step.kind == "diff":
        subprocess.run(["git", "apply"], input=step.text, text=True, cwd=desk.folder, check=True)
    else:
        assert step.kind == "c", f"nobody knows what to do with {step.kind} at line {step.line}"
        compiles(desk.folder, step.text)


def sections_exist(text: str) -> None:
    """A part of a configuration is one: put over that of the virtual axis, it can be read."""
    from pneud import resources  # noqa: PLC0415
    from pneud.config.toml import changed_text, tables_of  # noqa: PLC0415

    base = (resources.configs() / "virtual.toml").read_text(encoding="utf-8")
    tables = tables_of(text)
    axes = tables.pop(AXIS, [{}])
    for own in axes if isinstance(axes, list) else [axes]:  # or a part of one axis's
        parse(changed_text(changed_text(base, tables), own), "the page")


def compiles(folder: Path, text: str) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    (folder / "block.c").write_text(text)
    subprocess.run([compiler, "-Wall", "-Werror", "-c", "block.c"], cwd=folder, check=True)
