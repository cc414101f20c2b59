"""Libraries that a part of pneud needs: one that is missing is one line, status 3, and what installs it."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from commands import pneud_here
from pneud.rt import extras
from pneud.rt.extras import EXTRAS, ExtraError, cure, missing, require
from pneud.study.jit import jitted

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden" / "composite.mcap"
CAMPAIGNS = ROOT / "examples" / "campaigns"
# how each extra is asked for, and what of pneud says that it needs it
ASKED: list[tuple[str, str, tuple[object, ...]]] = [
    ("web", "web", ("web",)),
    ("mqtt", "mqtt", ("mqtt",)),
    ("identify", "identify", ("identify", GOLDEN)),
    ("identify", "commission", ("commission", "--virtual", "--yes")),
    ("prove", "prove", ("prove",)),
    ("canopen", "[[bus.nodes]]", ("nodes", "list", "--bus", "unixcan:x")),
    ("plots", "report --png", ("report", GOLDEN, "--png", "-o", "x.html")),
    ("plots", "replay -o", ("replay", GOLDEN, "--against", GOLDEN, "-o", "x.png")),
    ("plots", "reproduce -o", ("reproduce", "-o", "x")),
    ("parquet", "Parquet", ("export", GOLDEN, "-o", "x.parquet")),
    ("tune", "--tune", ("campaign", CAMPAIGNS / "tune.toml", "--tune", 1, "-o", "x")),
    (
        "cluster",
        "--scheduler",
        ("campaign", CAMPAIGNS / "spread.toml", "--scheduler", "tcp://x:1", "-o", "x"),
    ),
    (
        "live",
        "--live",
        ("--virtual", "--live", "--bus", "unixcan:extras", "--log", "x", "--socket", "x.sock"),
    ),
]


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Makes modules look as if they were not installed."""
    there = importlib.util.find_spec

    def lacks(*modules: str) -> None:
        monkeypatch.setattr(extras, "find_spec", lambda name: None if name in modules else there(name))

    return lacks


@pytest.mark.parametrize(("extra", "needer", "words"), ASKED, ids=[f"{e}-{n}" for e, n, _ in ASKED])
def test_a_missing_library_is_one_line_with_its_cure(
    extra: str,
    needer: str,
    words: tuple[object, ...],
    without: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    without(*EXTRAS[extra])
    done = pneud_here(*words)
    packages = ", ".join(EXTRAS[extra].values())
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr == f"pneud: {needer} needs {packages}; install it with: pip install 'pneud[{extra}]'\n"


def test_only_what_is_missing_is_named(without: Callable[..., None]) -> None:
    without("uvicorn")
    assert missing("web") == ["uvicorn"]
    with pytest.raises(ExtraError, match=r"^web needs uvicorn; install it with: pip install 'pneud\[web\]'$"):
        require("web", "web")
    require("mqtt", "mqtt")


def test_what_is_to_be_compiled_by_a_library_needs_it(without: Callable[..., None]) -> None:
    without("numba")
    with pytest.raises(ExtraError, match=re.escape(cure("sim"))) as e:
        jitted(test_only_what_is_missing_is_named)
    assert e.value.name == "numba"


def test_extras_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = {
        name: {re.split(r"[<>=\[]", one)[0] for one in needs}
        for name, needs in project["optional-dependencies"].items()
        if name not in ("dev", "docs", "mutation", "notebook")
    }
    assert asked.keys() == EXTRAS.keys()
    for name, packages in asked.items():
        assert set(EXTRAS[name].values()) <= packages
    assert {extra for extra, _, _ in ASKED} | {"sim", "frames", "screen"} == EXTRAS.keys()
