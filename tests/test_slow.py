"""What runs in Python that could run in C is said once, with why and the cure, and stands in results."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest

from commands import object_of, pneud_here
from pneud.campaign import workers
from pneud.compiled import backend, slow
from pneud.replay import running, striding
from pneud.study import trial
from pure2c import BuildError, compile_functions

WHY = "there is no C compiler: apt install gcc libc6-dev"
PROGRAM = 'schema = 1\n[[record]]\ndo = "wait"\nfor_s = 0.01\n'


def fails(*_: object) -> NoReturn:
    raise BuildError(WHY)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "compiled", fails)


@pytest.mark.usefixtures("no_compiler")
@pytest.mark.parametrize("verb", ["sim", "run", "replay", "several"])
def test_a_verb_that_falls_back_to_python_says_so_once(verb: str, tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(PROGRAM)
    log = tmp_path / "x.mcap"
    words: dict[str, tuple[object, ...]] = {
        "sim": ("sim", "--duration", 0.1),
        "run": ("run", tmp_path / "p.toml", "--dry-run"),
        "several": ("sim", "two-axes.toml", "--duration", 0.1),
        "replay": ("replay", log),
    }
    if verb == "replay":
        pneud_here("sim", "--duration", 0.1, "-o", log)
        slow._said.clear()
    said = pneud_here(*words[verb])
    assert said.stderr.count(f"pneud: the law runs in Python: {WHY}\n") == 1
    slow._said.clear()
    found = pneud_here(*words[verb], "--json")
    assert object_of(found)["in_python"] == [f"the law runs in Python: {WHY}"]


def test_who_wants_python_or_has_c_is_told_nothing() -> None:
    assert "in_python" not in object_of(pneud_here("sim", "--duration", 0.1, "--json"))
    assert not slow.field()
    assert backend.backend("off", None) is backend.INTERPRETED  # type: ignore[arg-type]
    assert not slow.field()


def test_a_simulation_that_goes_tick_by_tick_says_so_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if backend.lacking():
        pytest.skip("there is no C compiler")
    monkeypatch.setattr(running, "WORTH_TICKS", 1)
    monkeypatch.setattr(striding, "strides", fails)
    found = pneud_here("sim", "--duration", 0.1, "--json")
    assert found.stderr.count(f"pneud: the simulation runs in Python: {WHY}\n") == 1
    assert object_of(found)["in_python"] == [f"the simulation runs in Python: {WHY}"]
    again = pneud_here("sim", "--duration", 0.1)
    assert "in Python" not in again.stderr


@pytest.mark.usefixtures("no_compiler")
@pytest.mark.parametrize("how", [("law",), ("axis",), ("law", "axis")])
def test_a_campaign_says_so_before_there_are_processes_which_say_nothing(
    how: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(trial, "compiled", lambda: (trial.trial, WHY))
    plan: Any = SimpleNamespace(bases=[{"how": one} for one in how])
    workers.make_ready(plan)
    workers.make_ready(plan)
    assert capsys.readouterr().err == f"pneud: the law runs in Python: {WHY}\n"
    slow.hush()
    slow.say("the law", "the compiled law does not compute what Python does")
    assert capsys.readouterr().err == ""


HALF = "def half(x: float) -> float:\n    return 0.5 * x\n"


@pytest.mark.parametrize(
    "now",
    [
        "",
        "x = 1\n\ndef other(x: float) -> float:\n    return x\n",
        "def half(",
        HALF.replace("0.5", "0.25"),
        HALF.replace("*", "/"),
        HALF.replace("return 0.5", "return abs(0.5)"),
    ],
)
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_source_that_is_another_one_by_now_is_not_compiled_as_what_runs(tmp_path: Path, now: str) -> None:
    file = tmp_path / "was_changed.py"
    file.write_text(HALF)
    with loaded(file) as module:
        file.write_text(now)
        with pytest.raises(BuildError, match=r"py is not what was loaded of it, at half: begin anew"):
            compile_functions([module.half], cache=tmp_path / "cache")


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_it_is_no_branch_that_could_be_left_to_python(tmp_path: Path) -> None:
    file = tmp_path / "was_changed.py"
    whole = (
        f"{HALF}\n\ndef whole(x: float) -> float:\n    if x < 0.0:\n        return half(x)\n    return x\n"
    )
    file.write_text(whole)
    with loaded(file) as module:
        file.write_text(whole.replace("0.5", "0.25"))
        with pytest.raises(BuildError, match="at half: begin anew"):
            compile_functions([module.whole], cache=tmp_path / "cache")


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_what_others_have_built_of_another_source_is_not_taken_for_what_runs(tmp_path: Path) -> None:
    file, cache = tmp_path / "was_changed.py", tmp_path / "cache"
    file.write_text(HALF)
    with loaded(file) as module:
        before = module.half
        file.write_text(HALF.replace("0.5 *", "0.125 *"))
        with loaded(file) as changed:
            assert compile_functions([changed.half], cache=cache).functions[0](8.0) == 1.0
        with pytest.raises(BuildError, match="begin anew"):
            compile_functions([before], cache=cache)
        file.write_text(f"{HALF}# and a remark\n")
        assert compile_functions([before], cache=cache).functions[0](8.0) == 4.0


@contextmanager
def loaded(file: Path) -> Iterator[Any]:
    """What is in a file now, as a module of its name."""
    before = sys.modules.get(file.stem)
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = sys.modules[file.stem] = importlib.util.module_from_spec(spec)
    try:
        sys.dont_write_bytecode, kept = True, sys.dont_write_bytecode
        try:
            spec.loader.exec_module(module)
        finally:
            sys.dont_write_bytecode = kept
        yield module
    finally:
        del sys.modules[file.stem]
        if before is not None:
            sys.modules[file.stem] = before
