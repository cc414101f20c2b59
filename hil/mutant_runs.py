"""What runs tests against mutants: a plugin of pytest, in two parts.

As `-p hil.mutant_runs` with PNEUD_REACH=FILE in the environment it notes which lines every test runs, in its
own process and in forks of it, and how long it takes. With PNEUD_MUTANTS=FOLDER it loads all tests once, and
then forks for every mutant: the fork puts the changed function in the place of the one that is loaded, and
runs the tests that are named, until one fails, and then seeds of `pneud prove`.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple, NoReturn

import coverage
import pytest

REACH = "PNEUD_REACH"
MUTANTS = "PNEUD_MUTANTS"
JOBS, RESULTS = "jobs.json", "results.jsonl"
CPU_S = 40  # that tests and seeds of a mutant may take of a processor, alone
ENOUGH_S = 6.0  # that tests may take of it; what they have not noticed until then, they leave to seeds
PATIENCE_S = 45.0  # with them, where they take nothing of it
COLD_S = 90.0
_STEP_S = 0.2
_CO_OPTIMIZED = 1  # functions have it, bodies of classes do not


def pytest_configure(config: pytest.Config) -> None:
    """Take the part that the environment says."""
    if REACH in os.environ:
        config.pluginmanager.register(Reach(Path(os.environ[REACH]), hasattr(config, "workerinput")))
    elif MUTANTS in os.environ:
        config.pluginmanager.register(Runner(Path(os.environ[MUTANTS])))


class Reach:
    """Which lines a test runs, and how long it takes.

    Args:
        rc: configuration of coverage.
        worker: whether another process gathers what is reported.
    """

    def __init__(self, rc: Path, worker: bool) -> None:
        self._rc, self._worker = rc, worker
        self._tests: dict[str, list[Any]] = {}
        self._cov = coverage.Coverage(config_file=str(rc), data_suffix=True)
        self._cov.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Note what it runs under its name."""
        self._cov.switch_context(item.nodeid)
        try:
            return (yield)
        finally:
            self._cov.switch_context("")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add it up."""
        one = self._tests.setdefault(report.nodeid, [0.0, True])
        one[0] += report.duration
        one[1] = one[1] and report.outcome == "passed"

    def pytest_unconfigure(self) -> None:
        """Leave it."""
        self._cov.stop()
        self._cov.save()
        if not self._worker:
            self._rc.with_name("durations.json").write_text(json.dumps(self._tests), encoding="utf-8")


class Verdict(NamedTuple):
    """What a fork says about a mutant."""

    how: str  # "noticed", "survived", "timeout"
    by: str = ""
    words: str = ""


class Runner:
    """Takes one mutant after the other, until there are no more.

    Args:
        folder: where they are, and where results go.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._told: int | None = None
        self._sound: dict[str, bool] = {}
        self._bench: Any = None
        self._functions: dict[tuple[str, str], list[FunctionType]] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Instead of running the tests."""
        jobs = json.loads((self._folder / JOBS).read_text(encoding="utf-8"))
        self._items = {item.nodeid: item for item in session.items}
        self._warm(jobs["warm"])
        for job in jobs["jobs"]:
            try:
                (self._folder / "claims" / job["key"]).open("x").close()
            except FileExistsError:
                continue
            began_s, cpu_s = time.monotonic(), _used_s()
            verdict = self._judge(job)
            told = {
                "key": job["key"],
                "verdict": verdict.how,
                "by": verdict.by,
                "words": verdict.words,
                "tests": len(job["tests"]),
                "asked": job["asked"],
                "s": round(time.monotonic() - began_s, 1),
                "cpu_s": round(_used_s() - cpu_s, 1),
            }
            with (self._folder / RESULTS).open("ab", buffering=0) as out:
                out.write(json.dumps(told, ensure_ascii=False).encode() + b"\n")
        return True

    def _warm(self, tests: list[str]) -> None:
        """Load what is loaded when it is needed, once for all forks."""
        from pneud.prove.plan import plan_of  # noqa: PLC0415
        from pneud.prove.run import Bench  # noqa: PLC0415

        self._bench = Bench(Path(tempfile.mkdtemp(prefix="mutant-bench-")))
        for seed in range(6):
            self._bench.run(plan_of(seed)._replace(length_s=0.1))
        items = [self._items[name] for name in tests if name in self._items]
        for item, following in zip_longest(items, items[1:]):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        gc.unfreeze()
        gc.collect()
        here = f"{Path.cwd()}/src/pneud/"
        for one in gc.get_objects():  # proxies among them raise where they are asked
            if type(one) is FunctionType and one.__code__.co_filename.startswith(here):
                code = one.__code__
                self._functions.setdefault((code.co_filename, code.co_qualname), []).append(one)
        gc.freeze()

    def _judge(self, job: dict[str, Any]) -> Verdict:
        path = Path.cwd() / job["file"]
        honest = path.read_text(encoding="utf-8")
        path.write_text(job["text"], encoding="utf-8")
        try:
            verdict = self._forked(job["tests"], job["seeds"], job, honest)
            cold = job["cold"] or verdict.by == "cold"
            if verdict.how == "survived" and cold and job["tests"]:  # without, all there are would be run
                verdict = _cold(job["tests"])
        finally:
            path.write_text(honest, encoding="utf-8")
        if verdict.how == "noticed" and "::" in verdict.by and not self._is_sound(verdict.by):
            left = [name for name in job["tests"] if name != verdict.by]
            return self._judge({**job, "tests": left})
        return verdict

    def _is_sound(self, name: str) -> bool:
        """Whether a test that fails does not fail here anyway."""
        if name not in self._sound and name in self._items:
            self._sound[name] = self._forked([name], [], None, "").how == "survived"
        return self._sound.get(name, True)

    def _forked(self, tests: list[str], seeds: list[int], job: dict[str, Any] | None, honest: str) -> Verdict:
        ours, theirs = os.pipe()
        scratch = tempfile.mkdtemp(prefix="mutant-")
        child = os.fork()
        if not child:
            os.close(ours)
            self._told = theirs
            try:
                self._live(tests, seeds, job, honest, scratch)
            except BaseException as e:
                self._tell(Verdict("noticed", "run", repr(e)[:300]))
            os._exit(0)
        os.close(theirs)
        try:
            return _heard(ours)
        finally:
            os.close(ours)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            shutil.rmtree(scratch, ignore_errors=True)

    def _tell(self, verdict: Verdict) -> NoReturn:
        assert self._told is not None
        os.write(self._told, json.dumps(verdict).encode())
        os._exit(0)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """In a fork, the first failure is all that is asked for."""
        if self._told is not None and report.failed:
            words = str(report.longrepr).strip().splitlines()
            said = next((line[1:].strip() for line in words if line.startswith("E ")), report.when)
            self._tell(Verdict("noticed", report.nodeid, said[:300]))

    def _live(
        self, tests: list[str], seeds: list[int], job: dict[str, Any] | None, honest: str, scratch: str
    ) -> None:
        os.setpgid(0, 0)
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        if job is not None and not self._put(job, honest):
            self._tell(Verdict("survived", "cold"))
        items = [self._items[name] for name in tests if name in self._items]
        if items:
            factory: Any = items[0].config._tmp_path_factory  # type: ignore[attr-defined]
            factory._basetemp = Path(scratch)
        for item, following in zip_longest(items, items[1:]):
            if _used_s() > ENOUGH_S:
                break
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if seeds:
            from pneud.prove.plan import plan_of  # noqa: PLC0415

            for seed in seeds:
                outcome = self._bench.run(plan_of(seed))
                if outcome.found:
                    self._tell(Verdict("noticed", f"seed {seed}", str(outcome.found[0])[:300]))
        self._tell(Verdict("survived"))

    def _put(self, job: dict[str, Any], honest: str) -> bool:
        """Change the function where it is loaded; where it is not, it will be, from the changed file.

        Returns:
            Whether all who call it call the changed one.
        """
        path = str(Path.cwd() / job["file"])
        before = _codes(compile(honest, path, "exec", dont_inherit=True))
        after = _codes(compile(job["text"], path, "exec", dont_inherit=True))
        put = False
        for name, number in (key for key in before if key[0] == job["function"]):
            new, old = after.get((name, number)), before[name, number]
            for function in self._functions.get((path, name), []):
                if new is not None and function.__code__.co_firstlineno == old.co_firstlineno:
                    if new == old:  # a default has changed
                        return False
                    try:
                        function.__code__ = new
                    except ValueError:  # it needs another closure
                        return False
                    put = True
        for module in [one for name, one in sys.modules.items() if name.startswith("pneud.log.")]:
            for one in vars(module).values():
                if hasattr(one, "cache_clear"):
                    one.cache_clear()
        module_name = job["file"].removeprefix("src/").removesuffix(".py").replace("/", ".")
        return put or module_name not in sys.modules


def _codes(code: CodeType) -> dict[tuple[str, int], CodeType]:
    """The functions and methods of a module, by name, and number among those of one name."""
    found: dict[tuple[str, int], CodeType] = {}
    for one in code.co_consts:
        if not isinstance(one, CodeType):
            continue
        if one.co_flags & _CO_OPTIMIZED:
            number = sum(name == one.co_qualname for name, _ in found)
            found[one.co_qualname, number] = one
        else:
            for (name, number), inner in _codes(one).items():
                found[name, number] = inner
    return found


def _heard(end: int) -> Verdict:
    """What a fork says, or that it is silent for too long; while this process stands, no time passes."""
    waited_s = 0.0
    while waited_s < PATIENCE_S:
        began_s = time.monotonic()
        ready, _, _ = select.select([end], [], [], _STEP_S)
        if ready:
            data = os.read(end, 65536)
            return Verdict(*json.loads(data)) if data else Verdict("noticed", "run", "ended without a word")
        waited_s += min(time.monotonic() - began_s, 2 * _STEP_S)
    return Verdict("timeout", "", f"{PATIENCE_S:g} s")


def _cold(tests: list[str]) -> Verdict:
    """In a process that loads the changed file: it is run when it is loaded, too."""
    env = {key: value for key, value in os.environ.items() if key != MUTANTS}
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-header", *tests]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env, start_new_session=True
    ) as run:
        try:
            said, _ = run.communicate(timeout=COLD_S)
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            return Verdict("timeout", "cold", f"{COLD_S:g} s")
    if run.returncode == 0:
        return Verdict("survived", "cold")
    failed = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    name = failed[0].split(" ", 1)[1].split(" - ")[0] if failed else "run"
    return Verdict("noticed", name, (failed or [said[-300:]])[0][:300])


def _used_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
