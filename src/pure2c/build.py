"""Building and loading extension modules, once for all runs of a user."""

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sysconfig
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any, NamedTuple

from pure2c.cache import Cache
from pure2c.reach import Reach
from pure2c.types import BuildError, TranslationError

EXACT = (
    "-O2",
    "-ffp-contract=off",  # no fused operations
    *(
        f"-fno-builtin-{name}"
        for name in ("atan", "atan2", "cos", "exp", "expm1", "log", "log1p", "pow", "sin", "tanh")
    ),
)
"""Options with which a compiler keeps every bit: libm is asked for values that it might know better."""

MODULE = "pure2c_compiled"
_OWN = Path(__file__).parent
_KEPT = 16  # builds of other interpreters, compilers and versions that stay
_PATIENCE_S = 60.0
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL

_loaded: dict[bytes, Any] = {}  # by what is in their libraries


class Built(NamedTuple):
    """Compiled functions."""

    functions: tuple[Callable[..., Any], ...]  # in the order of the originals
    left: Callable[[], tuple[int, ...]]  # how often each has been left to its original
    identity: bytes  # of all that they depend on, and of the library itself
    rehearsals: tuple[Callable[..., bool], ...]  # as those do it that hold, and for nothing
    series: tuple[Callable[..., Any] | None, ...] = ()  # as often as there is something given


def compile_functions(
    functions: Sequence[Callable[..., Any]], *, cache: Path, holding: bool = False
) -> Built:
    """The compiled versions of pure functions, built if need be.

    What was built is used again as long as all that these functions reach, this package, the compiler and the
    interpreter are the same.

    Args:
        functions: as in the README; only calls with all arguments by position are fast.
        cache: folder for what is built; only this user may have a hand in it.
        holding: a record that a function takes and gives first, as a state is, stays in C: see the README.

    Raises:
        TranslationError: one of them does something that has no counterpart in C.
        BuildError: they cannot be built or loaded.
    """
    try:
        reach = Reach(functions)
        own = [file.read_bytes() for file in sorted((*_OWN.glob("*.py"), *_OWN.glob("*.h")))]
    except OSError as e:
        raise BuildError(f"{e.filename}: {e.strerror}") from None

    def translated() -> str:
        from pure2c.extension import Extension  # noqa: PLC0415 - slow to import, and seldom needed

        try:
            return Extension(functions, MODULE).source
        except BuildError:
            raise
        except Exception as e:  # whatever a source that is not there, or a hint that means nothing, leads to
            raise TranslationError(f"{type(e).__name__}: {e}") from None

    depends_on = reach.digest(), *own
    module = _module(MODULE, depends_on, translated, cache)
    module.bind(tuple(functions), tuple(reach.classes[name] for name in module.CLASSES.split()))
    plain = [getattr(module, f"f{i}") for i in range(len(functions))]
    made = [getattr(module, f"h{i}", f) for i, f in enumerate(plain)] if holding else plain
    identity = hashlib.sha256(b"".join(depends_on) + Path(module.__file__).read_bytes()).digest()
    rehearsals = tuple(getattr(module, f"r{i}", _nothing) for i in range(len(functions)))
    series = tuple(getattr(module, f"s{i}", None) for i in range(len(functions)))
    return Built(tuple(made), module.left, identity, rehearsals, series)


def _nothing(*_: object) -> bool:
    """The rehearsal of a function that holds no record."""
    return False


def load_source(source: Path, *, cache: Path) -> Any:
    """The extension module of a C file, built if need be, with the same options.

    Args:
        source: the file; its module's name is that of its one `PyInit_` function.
        cache: folder for what is built; only this user may have a hand in it.

    Raises:
        BuildError: it cannot be built or loaded.
    """
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise BuildError(f"{source}: {e}") from None
    name = re.search(r"\bPyInit_(\w+)", text)
    if name is None:
        raise BuildError(f"{source}: has no PyInit_ function")
    return _module(name[1], (text.encode(),), lambda: text, cache)


def _module(name: str, depends_on: Sequence[bytes], source: Callable[[], str], folder: Path) -> Any:
    """A module made of a C source that depends on something."""
    cc = _compiler()
    try:
        file = f"{_key(cc, depends_on)}.so"
        with Cache(folder, keep=_KEPT) as cache:
            library = cache.get(file)
            if library is not None:
                with suppress(ImportError):  # libraries that it needs may have gone
                    return _load(name, library)
            library = _build(cc, source(), cache)
            cache.put(file, library)
        return _load(name, library)
    except ImportError as e:
        raise BuildError(f"what {cc} makes cannot be loaded: {e}") from None
    except OSError as e:
        raise BuildError(f"{folder}: {e.strerror}" if e.strerror else str(e)) from None


def _compiler() -> Path:
    for name in ("cc", "gcc", "clang"):
        found = shutil.which(name)
        if found is not None:
            return Path(found).absolute()
    raise BuildError("there is no C compiler: apt install gcc libc6-dev")


def _key(cc: Path, depends_on: Sequence[bytes]) -> str:
    found = cc.stat()
    words = (*EXACT, sysconfig.get_config_var("SOABI"), str(cc), found.st_mtime_ns, found.st_size)
    digest = hashlib.sha256(repr(words).encode())
    for part in depends_on:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()[:24]


def _build(cc: Path, source: str, cache: Cache) -> bytes:
    """The shared library of a source."""
    include = sysconfig.get_path("include")
    if not os.access(Path(include) / "Python.h", os.R_OK):
        raise BuildError(f"{include} has no Python.h: apt install python3-dev")
    with cache.workshop() as folder:
        here = Path(f"/proc/self/fd/{folder}")
        (here / "made.c").write_text(source, encoding="utf-8")
        options = (*EXACT, "-shared", "-fPIC", "-I", include)
        command: list[str | Path] = [cc, *options, "-o", "made.so", "made.c", "-lm"]
        try:
            done = subprocess.run(
                command,
                cwd=here,
                env={**os.environ, "TMPDIR": "."},  # the compiler's own passing files, too, are nobody else's
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_PATIENCE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise BuildError(f"{cc} takes longer than {_PATIENCE_S:g} s") from None
        if done.returncode:
            said = done.stderr.decode(errors="replace").splitlines()
            raise BuildError(f"{cc} fails: {(said or ['it gives no reason'])[0]}")
        return (here / "made.so").read_bytes()


def _load(name: str, library: bytes) -> Any:
    """The module in a library.

    It is loaded from memory: what was checked is what runs, and nothing that is done to a file afterwards
    reaches a process in which it runs. The descriptor stays open, because Python and the dynamic linker take
    a second library of the same path for the first.
    """
    found = hashlib.sha256(name.encode() + library).digest()
    if found not in _loaded:
        memory = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        with os.fdopen(memory, "wb", closefd=False) as file:
            file.write(library)
        fcntl.fcntl(memory, fcntl.F_ADD_SEALS, _SEALS)
        spec = spec_from_loader(name, ExtensionFileLoader(name, f"/proc/self/fd/{memory}"))
        assert spec is not None
        try:
            _loaded[found] = module_from_spec(spec)
        except ImportError:
            os.close(memory)
            raise
    return _loaded[found]
