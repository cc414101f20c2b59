"""Functions compiled and kept: what is built when, what is not believed, what is said where it cannot be."""

from __future__ import annotations

import importlib
import math
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import pure2c
from pure2c import BuildError, TranslationError, build, compile_functions, load_source
from pure2c.cache import Cache

DOMAIN = r"math domain|nonnegative"  # as Python says it
README = Path(pure2c.__file__).with_name("README.md")
ABROAD = """
#include <Python.h>
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, .m_name = "abroad", .m_size = -1};
PyMODINIT_FUNC PyInit_abroad(void) {
  PyObject *made = PyModule_Create(&module);
  if (made) PyModule_AddIntConstant(made, "answer", 42);
  return made;
}
"""


@pytest.fixture(autouse=True)
def _compiler() -> None:
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")


class Pair(NamedTuple):
    a: float
    b: float = 2.0


def swapped(p: Pair) -> Pair:
    return Pair(p.b, p.a)


def root(x: float) -> float:
    return math.sqrt(x)


def of_lists(x: float) -> float:
    return sum([x, x])


def unknown(x: Nothing) -> float:  # type: ignore[name-defined]  # noqa: F821
    return 1.0


# Entry points


def test_there_are_two_entry_points() -> None:
    functions = [name for name in pure2c.__all__ if not isinstance(getattr(pure2c, name), type)]
    assert functions == ["compile_functions", "load_source"]


def test_what_the_c_cannot_do_the_original_does_and_it_is_counted(tmp_path: Path) -> None:
    functions, left, *_ = compile_functions((swapped, root), cache=tmp_path / "cache")
    before = left()
    assert functions[0](Pair(1.0)) == Pair(2.0, 1.0)
    assert functions[1](4.0) == 2.0
    assert left() == before
    assert functions[0](Pair(1.0, 2)) == Pair(2, 1.0)
    assert functions[0](p=Pair(1.0)) == Pair(2.0, 1.0)
    with pytest.raises(ValueError, match=DOMAIN):
        functions[1](-1.0)
    assert [now - then for now, then in zip(left(), before, strict=True)] == [2, 1]


def test_what_has_no_counterpart_is_named(tmp_path: Path) -> None:
    with pytest.raises(TranslationError, match="of_lists: no counterpart in C for"):
        compile_functions((of_lists,), cache=tmp_path / "cache")
    with pytest.raises(TranslationError, match="'Nothing' is not defined"):
        compile_functions((unknown,), cache=tmp_path / "cache")
    made: dict[str, Any] = {"__name__": "nowhere"}
    exec("def f(x: float) -> float:\n    return x", made)
    with pytest.raises(TranslationError, match="could not get source code"):
        compile_functions((made["f"],), cache=tmp_path / "cache")


def test_a_source_is_loaded_by_the_name_it_gives_itself(tmp_path: Path) -> None:
    (tmp_path / "x.c").write_text(ABROAD)
    module = load_source(tmp_path / "x.c", cache=tmp_path / "cache")
    assert (module.__name__, module.answer) == ("abroad", 42)
    (tmp_path / "x.c").write_text(ABROAD.replace("42", "43"))
    assert load_source(tmp_path / "x.c", cache=tmp_path / "cache").answer == 43
    assert module.answer == 42


def test_a_source_that_is_none_is_named(tmp_path: Path) -> None:
    for content, why in ((b"int x;", "has no PyInit_ function"), (b"\xff", "decode"), (None, "No such file")):
        if content is None:
            (tmp_path / "x.c").unlink()
        else:
            (tmp_path / "x.c").write_bytes(content)
        with pytest.raises(BuildError, match=f"x.c: .*{why}|{why}"):
            load_source(tmp_path / "x.c", cache=tmp_path / "cache")


def test_the_example_of_the_readme_prints_what_it_says(tmp_path: Path) -> None:
    program, printed = re.findall(r"```(?:python|text)\n(.*?)```", README.read_text(), re.DOTALL)[:2]
    (tmp_path / "example.py").write_text(program)
    (tmp_path / "fast.c").write_text(ABROAD.replace("abroad", "fast"))
    environment = {**os.environ, "HOME": str(tmp_path)}
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "example.py"],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.stdout, done.stderr) == (printed, "")


def test_it_knows_no_other_package_of_this_repository() -> None:
    for file in README.parent.glob("*.py"):
        assert "pneud" not in file.read_text()


# What is built when


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """A function `f` made anew of some files, with a name that no other test has."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    package = f"made_{tmp_path.name}"

    def made(**files: str) -> Any:
        (tmp_path / package).mkdir(exist_ok=True)
        for name, text in {"__init__": "", **files}.items():
            (tmp_path / package / f"{name}.py").write_text(text.replace("PACKAGE", package))
        for name in [name for name in sys.modules if name.partition(".")[0] == package]:
            del sys.modules[name]
        importlib.invalidate_caches()
        return importlib.import_module(f"{package}.main").f

    return made


MAIN = """
from typing import NamedTuple
from PACKAGE import other, constants
from PACKAGE.constants import GAIN
from PACKAGE.types import Record
def f(x: float) -> float:
    return GAIN * other.g(Record(x).x) + constants.OFFSET
"""
FILES = {
    "main": MAIN,
    "other": "def g(x: float) -> float:\n    return x + 1.0\n",
    "constants": "GAIN = 2.0\nOFFSET = 0.5\n",
    "types": "from typing import NamedTuple\nclass Record(NamedTuple):\n    x: float\n",
    "unrelated": "",
}


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("main", "GAIN *", "GAIN +"),
        ("other", "1.0", "2.0"),
        ("constants", "GAIN = 2.0", "GAIN = 3.0"),
        ("constants", "OFFSET = 0.5", "OFFSET = 1.5"),
        ("types", "x: float", "x: float\n    y: float = 0.0"),
    ],
)
def test_a_change_of_anything_that_it_reaches_is_noticed(
    tmp_path: Path, module: Callable[..., Any], name: str, old: str, new: str
) -> None:
    cache = tmp_path / "cache"
    changed = FILES | {name: FILES[name].replace(old, new)}
    for files in (FILES, FILES | {"unrelated": "x = 1"}, changed):
        f = module(**files)
        built = compile_functions((f,), cache=cache)
        assert (built.functions[0](1.25), built.left()) == (f(1.25), (0,))
    assert len(list(cache.iterdir())) == 2


def test_a_source_that_cannot_be_read_is_named(tmp_path: Path, module: Callable[..., Any]) -> None:
    f = module(**FILES)
    gone = Path(f.__code__.co_filename).with_name("other.py")
    gone.unlink()
    with pytest.raises(BuildError) as caught:
        compile_functions((f,), cache=tmp_path / "cache")
    assert str(caught.value) == f"{gone}: No such file or directory"


def test_other_functions_are_another_library(tmp_path: Path) -> None:
    for functions in ((swapped, root), (root, swapped), (root,), (swapped, root)):
        compile_functions(functions, cache=tmp_path / "cache")
    assert len(list((tmp_path / "cache").iterdir())) == 3


# What is not believed


def library(cache: Path) -> Path:
    """The one that is kept; what is loaded from now on is loaded anew."""
    (found,) = cache.iterdir()
    build._loaded.clear()
    return found


def in_a_process_of_its_own(cache: Path) -> str:
    """What a compiled function says there; a process that dies says nothing."""
    program = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from pathlib import Path\n"
        "from pure2c import compile_functions; from test_pure2c_build import root\n"
        f"built = compile_functions((root,), cache=Path({str(cache)!r}))\n"
        "print(built.functions[0](4.0), built.left())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


@pytest.mark.parametrize("size", [0, 31, 32, 4096, -1])
def test_a_library_that_was_cut_short_is_made_anew(tmp_path: Path, size: int) -> None:
    cache = tmp_path / "cache"
    compile_functions((root,), cache=cache)
    whole = library(cache).read_bytes()
    os.truncate(library(cache), size % len(whole))
    assert in_a_process_of_its_own(cache) == "2.0 (0,)\n"
    assert library(cache).read_bytes() == whole


def test_a_library_that_is_cut_short_while_it_runs_runs_on(tmp_path: Path) -> None:
    built = compile_functions((root,), cache=tmp_path / "cache")
    os.truncate(library(tmp_path / "cache"), 0)
    assert built.functions[0](4.0) == 2.0
    with pytest.raises(ValueError, match=DOMAIN):
        built.functions[0](-4.0)


@pytest.mark.parametrize("garbage", [b"\x7fELF" + bytes(range(256)) * 64, b"no library"])
def test_garbage_is_made_anew(tmp_path: Path, garbage: bytes) -> None:
    cache = tmp_path / "cache"
    compile_functions((root,), cache=cache)
    library(cache).write_bytes(garbage)
    assert compile_functions((root,), cache=cache).functions[0](4.0) == 2.0
    assert library(cache).read_bytes()[:4] == b"\x7fELF"
    with Cache(cache, keep=9) as whole:  # as it was put there, and yet no library that loads
        whole.put(library(cache).name, garbage)
    assert in_a_process_of_its_own(cache) == "2.0 (0,)\n"


def test_a_library_exchanged_for_a_link_is_made_anew(tmp_path: Path) -> None:
    cache, elsewhere = tmp_path / "cache", tmp_path / "elsewhere.so"
    compile_functions((root,), cache=cache)
    library(cache).rename(elsewhere)
    planted = elsewhere.read_bytes()
    (cache / "x.so").symlink_to(elsewhere)
    (cache / "x.so").rename(cache / self_name(cache, elsewhere, planted))
    assert compile_functions((root,), cache=cache).functions[0](4.0) == 2.0
    assert not library(cache).is_symlink()
    assert elsewhere.read_bytes() == planted


def self_name(cache: Path, elsewhere: Path, planted: bytes) -> str:
    """What the library is called that functions look for."""
    compile_functions((root,), cache=cache.with_name("other"))
    (found,) = cache.with_name("other").iterdir()
    assert found.read_bytes() == planted == elsewhere.read_bytes()
    return found.name


def test_a_folder_that_others_have_a_hand_in_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(BuildError, match="open: others may write to it; chmod go-w "):
        compile_functions((root,), cache=tmp_path / "open" / "cache")
    assert not list((tmp_path / "open").iterdir())


def test_builders_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    cache = tmp_path / "made" / "cache"
    program = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from pathlib import Path\n"
        "from pure2c import compile_functions; from test_pure2c_build import root, swapped\n"
        f"print(compile_functions((root, swapped), cache=Path({str(cache)!r})).functions[0](4.0))"
    )
    builders = [
        subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for _ in range(3)
    ]
    assert [builder.communicate()[0] for builder in builders] == [b"2.0\n"] * 3
    assert library(cache).suffix == ".so"


def test_a_cache_that_is_read_only_serves_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    compile_functions((root,), cache=cache)

    def read_only(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "mkdir", read_only)
    build._loaded.clear()
    assert compile_functions((root,), cache=cache).functions[0](4.0) == 2.0
    with pytest.raises(BuildError) as caught:
        compile_functions((swapped,), cache=cache)
    assert str(caught.value) == f"{cache}: Read-only file system"


# What keeps it from being built


def why_not(cache: Path) -> str:
    with pytest.raises(BuildError) as caught:
        compile_functions((root,), cache=cache)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_keeps_it_from_being_built_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as m:
        m.setattr(shutil, "which", lambda _: None)
        assert why_not(tmp_path / "cache") == "there is no C compiler: apt install gcc libc6-dev"
    with monkeypatch.context() as m:
        m.setattr(shutil, "which", lambda _: "/bin/false")
        assert why_not(tmp_path / "cache").endswith("false fails: it gives no reason")
    with monkeypatch.context() as m:
        m.setattr(sysconfig, "get_path", lambda _: "/nowhere")
        assert why_not(tmp_path / "cache") == "/nowhere has no Python.h: apt install python3-dev"
    with monkeypatch.context() as m:
        m.setattr(build, "_PATIENCE_S", 1e-6)
        assert "takes longer" in why_not(tmp_path / "cache")


@pytest.mark.parametrize(
    ("script", "why"),
    [
        (r"printf 'Fehler: \374nerwartet\n' >&2; exit 1", "cc fails: Fehler: \ufffdnerwartet"),
        ("exit 0", "No such file or directory"),
        ("echo x > made.so", "cannot be loaded"),
    ],
)
def test_a_compiler_that_is_none_is_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, why: str
) -> None:
    (tmp_path / "cc").write_text(f"#!/bin/sh\n{script}\n")
    (tmp_path / "cc").chmod(0o755)
    monkeypatch.setattr(shutil, "which", lambda _: str(tmp_path / "cc"))
    assert why in why_not(tmp_path / "cache")


def test_the_compiler_keeps_its_passing_files_to_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", "/nowhere")
    (tmp_path / "cc").write_text(
        f'#!/bin/sh\necho "$TMPDIR" "$PWD" > {tmp_path}/told\nexec {shutil.which("cc")} "$@"\n'
    )
    (tmp_path / "cc").chmod(0o755)
    monkeypatch.setattr(shutil, "which", lambda _: str(tmp_path / "cc"))
    compile_functions((root,), cache=tmp_path / "cache")
    where, folder = (tmp_path / "told").read_text().split()
    assert where == "."
    assert Path(folder).parent == tmp_path / "cache"
    assert not Path(folder).exists()


def test_a_library_is_loaded_once_and_its_descriptor_is_nobody_elses(tmp_path: Path) -> None:
    compile_functions((root,), cache=tmp_path / "cache")
    descriptors = Path("/proc/self/fd")
    before = {path.name for path in descriptors.iterdir()}
    held = [path for path in descriptors.iterdir() if path.is_symlink() and "memfd:" in str(path.readlink())]
    assert held
    assert not any(os.get_inheritable(int(path.name)) for path in held)
    for _ in range(3):
        compile_functions((root,), cache=tmp_path / "cache")
    assert {path.name for path in descriptors.iterdir()} == before
