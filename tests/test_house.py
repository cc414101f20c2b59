"""The house rules that a machine can check: who imports whom, and which rooms know neither clock nor I/O."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator, Set
from itertools import chain, permutations, product
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

LINTER = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
CONTRACTS = LINTER["contracts"]


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


def of_type(kind: str) -> list[dict[str, object]]:
    return [contract for contract in CONTRACTS if contract["type"] == kind]


def listed(contract: dict[str, object], key: str) -> list[str]:
    found = contract[key]
    assert isinstance(found, list)
    return found


def rooms(line: str) -> list[str]:
    return [f"pneud.{room.strip()}" for room in re.split(r"[|:]", line)]


(LAYERS,) = of_type("layers")
LINES = [rooms(line) for line in listed(LAYERS, "layers")]
ROOMS = list(chain(*LINES))
VERBS = ["pneud.verbs.run", "pneud.verbs.other"]

Pair = tuple[str, str]  # importer, imported
UPWARD: list[Pair] = [pair for n, line in enumerate(LINES) for pair in product(line, chain(*LINES[:n]))]
BESIDE: list[Pair] = [
    pair for line in listed(LAYERS, "layers") if "|" in line for pair in permutations(rooms(line), 2)
]
PLAINLY: list[Pair] = [
    pair
    for contract in of_type("forbidden")
    for pair in product(listed(contract, "source_modules"), listed(contract, "forbidden_modules"))
]
FORBIDDEN = [*UPWARD, *BESIDE, *PLAINLY, *permutations(VERBS, 2)]


def is_within(module: str, other: str) -> bool:
    return f"{module}.".startswith(f"{other}.")


def is_allowed(pair: Pair) -> bool:
    return not any(is_within(pair[0], a) and is_within(pair[1], b) for a, b in FORBIDDEN)


DOWNWARD: list[Pair] = [
    pair for n, line in enumerate(LINES) for pair in product(line, chain(*LINES[n + 1 :]))
]
OF_VERBS: list[Pair] = [(verb, b) for verb in VERBS for a, b in DOWNWARD if a == "pneud.verbs"]
ALLOWED = [
    *filter(is_allowed, (*DOWNWARD, *OF_VERBS)),
    *(pair for line in LINES for pair in permutations(line, 2) if is_allowed(pair)),
]


# whatever the contracts become, these they forbid
RULES = {
    "signals": "config crew",
    "resources": "signals",
    "rt": "signals",
    "crew": "rt log rig console view scenario",
    "physics": "signals rt",
    "control": "log rt bus",
    "safety": "physics rt log control",
    "log": "config physics rt control safety",
    "axis": "bus rt log resources crew config",
    "config": "bus loading",
    "bus": "control axis safety log",
    "loading": "rig scenario console",
    "rig": "axis control safety log scenario",
    "view": "config bus axis control console",
    "console": "bus loop daemon",
    "compiled": "loop scenario",
    "loop": "scenario replay daemon",
    "scenario": "loop daemon",
    "replay": "daemon study report campaign",
    **dict.fromkeys(
        ("bench", "campaign", "farm", "notebook", "report", "study", "service", "mqtt", "web"), "daemon verbs"
    ),
    "daemon": "prove study bench campaign farm notebook report service mqtt web replay verbs",
    "verbs.run": "prove study bench campaign farm notebook report service mqtt web replay cli verbs.other",
    "verbs": "cli",
}


def part_of(module: str) -> str:
    """What stands for a room in the skeleton: a module in its package, or itself where it is no package."""
    is_package = (ROOT / "src" / module.replace(".", "/") / "__init__.py").is_file()
    return f"{module}.part" if is_package and module != "pneud" else module


def skeleton(
    folder: Path, imports: Iterable[Pair], more: Iterable[str] = ()
) -> subprocess.CompletedProcess[str]:
    """Checks the project's contracts against packages of the same shape that have the given imports."""
    modules = {*LINTER["root_packages"], *ROOMS, *VERBS, *more} - {"pneud"}
    texts = {part_of(module): "" for module in modules}
    for importer, imported in imports:
        texts[part_of(importer)] += f"def _():\n    import {part_of(imported)}\n"
    for module, text in texts.items():
        file = folder / f"{module.replace('.', '/')}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        (file.parent / "__init__.py").touch()
        file.write_text(text)
    (folder / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    return subprocess.run(
        [LINT_IMPORTS, "--no-cache", "--no-logo"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def called_forbidden(result: subprocess.CompletedProcess[str]) -> set[Pair]:
    found = re.findall(r"^-? +(\S+) -> (\S+) \(l", result.stdout, re.MULTILINE)
    return {(a.removesuffix(".part"), b.removesuffix(".part")) for a, b in found}


def test_every_room_is_on_one_line() -> None:
    there = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()}
    assert sorted(ROOMS) == sorted(f"pneud.{name}" for name in there - {"__init__"})


@pytest.mark.parametrize(
    ("importer", "imported"), [(a, b) for a, list_ in RULES.items() for b in list_.split()]
)
def test_a_rule_of_the_house_has_a_contract(importer: str, imported: str) -> None:
    assert not is_allowed((f"pneud.{importer}", f"pneud.{imported}"))


def test_few_modules_have_no_room() -> None:
    loose = {p.stem for p in PACKAGE.glob("*.py")} - {"__init__", "signals"}
    assert loose == {"cli", "crew", "loading", "resources"}


def test_a_room_on_no_line_is_an_error(tmp_path: Path) -> None:
    result = skeleton(tmp_path, (), more=["pneud.attic"])
    assert result.returncode == 1
    assert "not listed as layers:\n\n- pneud.attic\n" in result.stdout, result.stdout


def test_contracts_allow_what_the_house_allows(tmp_path: Path) -> None:
    result = skeleton(tmp_path, ALLOWED)
    assert result.returncode == 0, result.stdout
    assert f"{len(CONTRACTS)} kept, 0 broken" in result.stdout


def test_contracts_forbid_what_the_house_forbids(tmp_path: Path) -> None:
    result = skeleton(tmp_path, FORBIDDEN)
    assert result.returncode == 1
    assert f"0 kept, {len(CONTRACTS)} broken" in result.stdout, result.stdout
    assert set(FORBIDDEN) <= called_forbidden(result), set(FORBIDDEN) - called_forbidden(result)


def test_no_module_and_no_function_is_too_long_to_read_at_once() -> None:
    longest = {"cycle": 80, "run": 80}  # of an axis, and of the loop
    for path in sorted(ROOT.joinpath("src").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert text.count("\n") <= 600, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno is not None
                lines = node.end_lineno - node.lineno + 1
                assert lines <= longest.get(node.name, 100), (path, node.name, lines)
