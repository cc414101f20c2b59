"""Building and loading an extension module, once for all runs of a user."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import subprocess
import sysconfig
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any, NamedTuple

from pneud.rt.folders import cache_folder

EXACT = (
    "-O2",
    "-ffp-contract=off",  # no fused operations
    *(f"-fno-builtin-{name}" for name in ("cos", "exp", "expm1", "log", "log1p", "pow", "sin", "tanh")),
)
"""Options with which a compiler keeps every bit: libm is asked for values that it might know better."""

MODULE = "pneud_compiled"
_PACKAGE = Path(__file__).resolve().parent.parent
_SOURCES = ("signals.py", "physics", "control", "safety", "axis", "rig", "compiled")
_KEPT = 16  # builds of other interpreters, compilers and versions that stay
_PATIENCE_S = 60.0


class BuildError(Exception):
    """There is no compiled law; the text is one line for a person."""

    exit_code = 3


def compiler() -> Path:
    """The system's C compiler.

    Raises:
        BuildError: there is none.
    """
    for name in ("cc", "gcc", "clang"):
        found = shutil.which(name)
        if found is not None:
            return Path(found).resolve()
    raise BuildError("there is no C compiler: apt install gcc libc6-dev")


class Built(NamedTuple):
    """Compiled functions."""

    functions: list[Callable[..., Any]]
    originals: list[Callable[..., Any]]  # what each of them calls where it cannot do as Python does


def load(functions: Sequence[Callable[..., Any]]) -> Built:
    """The compiled versions of pure functions of this package, built if need be.

    What was built is used again as long as the sources of these functions, the compiler, its options and the
    interpreter are the same.

    Raises:
        BuildError: it cannot be built or loaded.
    """

    def translated() -> str:
        # slow to import, and seldom needed
        from pneud.compiled.extension import Extension  # noqa: PLC0415

        return Extension(functions, MODULE).source

    module = _module(MODULE, _files(), translated)
    names = (name.split(":") for name in module.CLASSES.split())
    originals = list(functions)
    module.bind(originals, tuple(getattr(import_module(where), name) for where, name in names))
    return Built([getattr(module, f"f{i}") for i in range(len(functions))], originals)


def load_source(source: Path) -> Any:
    """The extension module pneud_STEM of a C file, built if need be.

    Raises:
        BuildError: it cannot be built or loaded.
    """
    return _module(f"pneud_{source.stem}", [source], source.read_text)


def _files() -> list[Path]:
    """All that a translation depends on."""
    paths = [_PACKAGE / part for part in _SOURCES]
    found = [path for path in paths if path.is_file()]
    return found + sorted(file for path in paths for file in (*path.glob("*.py"), *path.glob("*.h")))


def _module(name: str, files: Sequence[Path], source: Callable[[], str]) -> Any:
    """A module made of a C source that depends on some files."""
    cc = compiler()
    try:
        folder = cache_folder("compiled")
        library = folder / f"{_key(cc, files)}.so"
        if library.exists():
            with contextlib.suppress(ImportError):  # as a power cut may leave it
                return _loaded(name, library)
        _build(source, cc, library)
        for old in sorted(folder.glob("*.so"), key=lambda path: path.stat().st_mtime)[:-_KEPT]:
            old.unlink(missing_ok=True)
        return _loaded(name, library)
    except ImportError as e:
        raise BuildError(f"{library} cannot be loaded: {e}") from None
    except (OSError, RuntimeError) as e:  # RuntimeError: no home
        raise BuildError(str(e)) from None


def _loaded(name: str, library: Path) -> Any:
    spec = spec_from_loader(name, ExtensionFileLoader(name, str(library)))
    assert spec is not None
    return module_from_spec(spec)


def _key(cc: Path, files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    found = cc.stat()
    words = (*EXACT, sysconfig.get_config_var("SOABI"), str(cc), str(found.st_mtime_ns), str(found.st_size))
    digest.update(repr(words).encode())
    return digest.hexdigest()[:24]


def _build(make: Callable[[], str], cc: Path, library: Path) -> None:
    include = sysconfig.get_path("include")
    if not (Path(include) / "Python.h").exists():
        raise BuildError(f"{include} has no Python.h: apt install python3-dev")
    source, made = (library.with_suffix(f".{os.getpid()}.{kind}") for kind in ("c", "tmp"))
    try:
        try:
            text = make()
        except Exception as e:  # the law in Python is better than none
            raise BuildError(str(e)) from None
        source.write_text(text)
        command: list[str | Path] = [cc, *EXACT, "-shared", "-fPIC", "-I", include, "-o", made, source, "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
        if done.returncode:
            raise BuildError(f"{cc} fails: {(done.stderr.splitlines() or ['it gives no reason'])[0]}")
        made.replace(library)
    except subprocess.TimeoutExpired:
        raise BuildError(f"{cc} takes longer than {_PATIENCE_S:g} s") from None
    finally:
        source.unlink(missing_ok=True)
        made.unlink(missing_ok=True)
