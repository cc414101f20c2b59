"""The house rules that a machine can check: who imports whom, and which rooms know neither clock nor I/O."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Set
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "pneud"
LINT_IMPORTS = Path(sys.executable).with_name("lint-imports")

PURE_ROOMS = ("signals", "physics", "control", "safety", "axis")
PURE_MODULES = {
    *("__future__", "collections", "dataclasses", "enum", "functools", "itertools"),
    *("math", "operator", "struct", "typing"),
}
# ruckig plans the reference from numbers to numbers.
PURE_EXCEPTIONS = {"control/reference.py": {"ruckig"}}
IMPURE_CALLS = {"open", "print", "input", "breakpoint", "exec", "eval", "__import__"}

WITHOUT_CONTRACT = {"__init__", "cli"}


def impurities(source: str, exceptions: Set[str] = frozenset()) -> Iterator[str]:
    """Imports and calls of a module's source that a pure room may not have."""
    allowed = PURE_MODULES | {"pneud"} | exceptions
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import():
                names = [alias.name for alias in node.names]
            case ast.ImportFrom(level=0, module=str(module)):
                names = [module]
            case ast.Call(func=ast.Name(id=name)) if name in IMPURE_CALLS:
                yield f"line {node.lineno}: calls {name}()"
                continue
            case _:
                continue
        yield from (
            f"line {node.lineno}: imports {name}" for name in names if name.partition(".")[0] not in allowed
        )


def sources(room: str) -> list[Path]:
    """The files of a room, which is a package or one module."""
    return [p for p in (PACKAGE / f"{room}.py", *(PACKAGE / room).rglob("*.py")) if p.is_file()]


@pytest.mark.parametrize("room", PURE_ROOMS)
def test_pure_rooms_import_neither_clock_nor_io(room: str) -> None:
    files = sources(room)
    assert files, f"{room} is not where the house has it"
    found = {
        str(name): faults
        for path in files
        if (name := path.relative_to(PACKAGE))
        and (faults := list(impurities(path.read_text(), PURE_EXCEPTIONS.get(name.as_posix(), set()))))
    }
    assert not found


@pytest.mark.parametrize(
    "source",
    [
        *(
            "import time",
            "from time import monotonic_ns",
            "def f():\n    import os.path",
            "import math, socket",
        ),
        *(
            "import logging",
            "from datetime import datetime",
            "import random",
            "import threading",
            "import can",
        ),
        *("import importlib", "print(1)", "x = open('f')", "t = __import__('time')", "import ruckig"),
    ],
)
def test_a_clock_or_io_is_noticed(source: str) -> None:
    assert list(impurities(source))


def test_arithmetic_is_not_an_impurity() -> None:
    source = "from __future__ import annotations\nimport math\nfrom pneud.physics import gas\ny = math.sin(1)"
    assert not list(impurities(source))


def contracts() -> list[dict[str, object]]:
    found = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    assert isinstance(found, list)
    return found


def named(contract: dict[str, object]) -> list[str]:
    modules = contract.get("source_modules") or contract["modules"]
    assert isinstance(modules, list)
    return [module.removeprefix("pneud.").removesuffix(".*") for module in modules]


def test_every_room_has_a_contract() -> None:
    rooms = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}
    with_contract = {room for contract in contracts() for room in named(contract)}
    assert rooms - with_contract == WITHOUT_CONTRACT & rooms, "give the new room a contract in pyproject.toml"


def skeleton(folder: Path, imports: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Checks the project's contracts against a package of the same shape that has the given imports."""
    packages = {
        "physics",
        "control",
        "safety",
        "bus",
        "rt",
        "log",
        "plant",
        "compiled",
        "console",
        "sim",
        "exchange",
        "reporting",
        "workbench",
        "verbs",
        "view",
    }
    rooms = {room for contract in contracts() for room in named(contract)} | {"cli"}
    root = folder / "pneud"
    files = {f"{room}/__init__.py" if room in packages else f"{room}.py" for room in rooms}
    files |= {f"{room}/part.py" for room in packages} | {
        "plant/parameters.py",
        "verbs/other.py",
        "__init__.py",
    }
    for name in files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("")
    for room, imported in imports.items():
        name = f"{room}/part.py" if room in packages else f"{room}.py"
        assert name in files
        (root / name).write_text(imported)
    (folder / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    return subprocess.run(
        [LINT_IMPORTS, "--no-cache", "--no-logo"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


ALLOWED = {
    "control": "from pneud.physics import part\nfrom pneud import signals",
    "safety": "from pneud.signals import x",
    "axis": "from pneud.control import part\nimport pneud.safety.part\nfrom pneud.physics.part import y",
    "config": "from pneud.physics.plant import z\nfrom pneud import resources",
    "parameters": "from pneud import axis, config\nfrom pneud.control import part",
    "profiles": "from pneud.control import part",
    "asking": "from pneud.control import part\nfrom pneud.safety import part as s",
    "design": "from pneud import chatter, config, parameters\nfrom pneud.control import part",
    "chatter": "from pneud import config, parameters\nfrom pneud.physics import part",
    "compiled": "from pneud import axis\nfrom pneud.control import part\nfrom pneud.rig import part as p",
    "installation": "from pneud import config, resources\nfrom pneud.rt import part",
    "loading": "from pneud.bus.part import x\nfrom pneud import config, resources",
    "processes": "from pneud.rig import part\nfrom pneud.view import x",
    "replaying": "from pneud.log import part\nfrom pneud import axis, loading",
    "live": "from pneud.log import part\nfrom pneud.rt import part as r",
    "exchange": "from pneud.log import part\nfrom pneud import axis",
    "reporting": "from pneud.log import part\nfrom pneud import loading",
    "workbench": "from pneud.log import part\nfrom pneud import replaying",
    "summary": "from pneud.bus import part\nfrom pneud.rt import part as r",
    "bus": "from pneud import config, signals",
    "log": "from pneud import signals",
    "plant": "from pneud.physics import part\nfrom pneud.bus import part as b",
    "sim": "from pneud.rig import part\nfrom pneud import axis\nfrom pneud.compiled import part as c",
    "console": "from pneud import config, signals\nfrom pneud.log import part",
    "daemon": "from pneud import axis, processes\nfrom pneud.log import part",
    "benchmark": "from pneud import control, loading\nfrom pneud.log import part",
    "verbs": "from pneud import daemon\nfrom pneud.study import part",
    "cli": "from pneud.verbs import part, other",
}
FORBIDDEN = {
    "signals": "from pneud import config",
    "resources": "from pneud import signals",
    "physics": "from pneud import signals",
    "control": "def f():\n    from pneud.log import part",
    "safety": "from pneud.physics import part",
    "axis": "from pneud.bus import part",
    "config": "from pneud.bus import part",
    "bus": "from pneud.control import part",
    "parameters": "from pneud.bus import part",
    "replaying": "from pneud import daemon",
    "live": "from pneud import config",
    "exchange": "from pneud import replaying",
    "reporting": "from pneud import replaying",
    "workbench": "from pneud import axis",
    "summary": "from pneud.log import part",
    "profiles": "from pneud import config",
    "asking": "from pneud import axis",
    "design": "from pneud.study import part",
    "chatter": "from pneud import design",
    "compiled": "from pneud import config",
    "installation": "from pneud import loading",
    "loading": "from pneud.rig import part",
    "processes": "from pneud import daemon",
    "trial": "from pneud.rig import part",
    "sabotage": "from pneud import config",
    "rt": "from pneud import signals",
    "log": "from pneud import config",
    "plant": "from pneud import axis",
    "sim": "from pneud import daemon",
    "view": "from pneud import config",
    "console": "from pneud import daemon",
    "daemon": "from pneud.study import part",
    "benchmark": "from pneud.verbs import part",
    "verbs": "from pneud import cli\nfrom pneud.verbs import other",
}


def test_contracts_allow_what_the_house_allows(tmp_path: Path) -> None:
    result = skeleton(tmp_path, ALLOWED)
    assert result.returncode == 0, result.stdout
    assert f"{len(contracts())} kept, 0 broken" in result.stdout


def test_contracts_forbid_what_the_house_forbids(tmp_path: Path) -> None:
    result = skeleton(tmp_path, FORBIDDEN)
    assert result.returncode == 1
    assert f"0 kept, {len(contracts())} broken" in result.stdout, result.stdout
    caught = set(re.findall(r"^pneud\.(\w+)\S* is not allowed to import", result.stdout, re.MULTILINE))
    assert caught == set(FORBIDDEN)
