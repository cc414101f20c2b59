"""Changes the daemon in one place at a time, and sees whether a test or a seed of `pneud prove` notices.

    .venv/bin/python -m hil.mutants                     # 300 mutants: most of an hour of one core
    .venv/bin/python -m hil.mutants --count 20 --seed 2

What is changed is what mutmut changes, in the rooms that carry, record and command: `bus`, `console`,
`daemon`, `log`, `loop`. Of all mutants those are taken whose digest, with the seed, comes first: so most of
them are the same ones after other code has changed. Each is put into a copy of the sources. First the quick
tests that run the changed line are run, the quickest ones first; where none fails, seeds. Which test runs
which line is measured once, and again where sources or tests have changed. A run that was interrupted goes
on where it was; what survived is tried again where other tests meet it, and with --again in any case.

Exit status: 0 where 85 % of those that were tried were noticed, and all were tried; 1 else.
"""

from __future__ import annotations

import argparse
import compileall
import hashlib
import json
import os
import py_compile
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

from hil.mutant_runs import JOBS, MUTANTS, REACH, RESULTS

ROOT = Path(__file__).resolve().parents[1]
PLACE = ROOT / "build" / "mutants"
ROOMS = ("bus", "console", "daemon", "log", "loop")
LEAST = 0.85
SEEDS = 6
MOST_S = 8.0  # that the tests of a mutant took together when they were measured
# They read sources, need the machine for themselves, or look at the daemon from afar, and take long.
NOT_THESE = re.compile(
    r"test_(adaptation|bench|canopen_live|commission\w*|control_\w+|foreign|fuzz|identify|laws|many_runs|mqtt|notebook"
    r"|offers|other_rigs|progress|prove|report\w*|run|scenarios|screen_\w+|second_rig|soak_logs|verification|view\w*"
    r"|virtual|wear|web_\w+|workbench)"
)
RC = """\
[run]
data_file = {place}/.coverage
source =
{rooms}
parallel = true
patch = _exit
disable_warnings = no-data-collected, module-not-measured, couldnt-parse
"""
# Not one that anybody could notice: what only types read, and what a person reads in a docstring.
UNSEEN = re.compile(r"\bcast\(|^\s*(assert|from|import) |TYPE_CHECKING")


class Mutant(NamedTuple):
    """A change of one function."""

    key: str
    file: str
    function: str  # its qualified name
    line: int  # the first one that is changed
    was: str
    becomes: str
    text: str  # of the whole file


def drawn(seed: int, count: int) -> tuple[list[Mutant], int]:
    """The first ones in the order of the seed, and how many there are in all.

    Args:
        seed: of the order.
        count: of those that are wanted.
    """
    noted = PLACE / f"drawn-{_digest(f'{seed} {count} {_sources()}')}.json"
    if noted.is_file():  # it takes a minute
        lines, total = json.loads(noted.read_text(encoding="utf-8"))
        return [Mutant(*line) for line in lines], total
    from mutmut.mutation.file_mutation import create_mutations, deep_replace  # noqa: PLC0415 - an extra

    ranked = []
    for path in sorted(path for room in ROOMS for path in (ROOT / "src/pneud" / room).rglob("*.py")):
        file = str(path.relative_to(ROOT))
        module, found, _, _ = create_mutations(file, path.read_text(encoding="utf-8"))
        names, numbers = _names(module), Counter[str]()
        for one in found:
            name = names.get(id(one.contained_by_top_level_function))
            if name is None:
                continue  # what is computed when the module is loaded
            numbers[name] += 1
            ranked.append((_digest(f"{seed} {file} {name} {numbers[name]}"), file, name, module, one))
    ranked.sort(key=lambda one: one[0])
    taken: list[Mutant] = []
    for rank, file, name, module, one in ranked:
        if len(taken) == count:
            break
        before, after = module.code, deep_replace(module, one.original_node, one.mutated_node).code
        pairs = zip(before.splitlines(), after.splitlines(), strict=False)
        line = next((number for number, (was, becomes) in enumerate(pairs, 1) if was != becomes), 0)
        was, becomes = (text.splitlines()[line - 1].strip() for text in (before, after))
        never = was.replace("strict=True", "strict=False") == becomes  # what is zipped is as long
        if line and not never and not UNSEEN.search(was):
            key = _digest(f"{rank} {was} {becomes}")
            taken.append(Mutant(key, file, name, line, was, becomes, after))
    noted.write_text(json.dumps([taken, len(ranked)]), encoding="utf-8")
    return taken, len(ranked)


def _sources() -> str:
    """A digest of the rooms."""
    files = (path for room in ROOMS for path in sorted((ROOT / "src/pneud" / room).rglob("*.py")))
    return _digest("".join(path.read_text(encoding="utf-8") for path in files))


def _digest(words: str) -> str:
    return hashlib.sha256(words.encode()).hexdigest()[:12]


def _names(module: Any) -> dict[int, str]:
    """Of functions and methods of a module, by where they are in memory."""
    found = {}
    for node in module.body:
        if type(node).__name__ == "FunctionDef":
            found[id(node)] = str(node.name.value)
        elif type(node).__name__ == "ClassDef":
            for inner in node.body.body:
                if type(inner).__name__ == "FunctionDef":
                    found[id(inner)] = f"{node.name.value}.{inner.name.value}"
    return found


def made_copy(folder: Path) -> None:
    """A copy of all that tests need; its compiled modules are those of what is written, whenever it was."""
    shutil.rmtree(folder, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    compileall.compile_dir(
        folder / "src", quiet=1, invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH
    )


def begun(folder: Path, words: list[str], **more: str) -> subprocess.Popen[bytes]:
    """Tests in a copy."""
    path = os.pathsep.join(filter(None, (str(folder / "src"), os.environ.get("PYTHONPATH", ""))))
    env = {
        key: value for key, value in os.environ.items() if not key.startswith(("PYTEST_", "COVERAGE_"))
    } | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", **more}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "hil.mutant_runs"]
    command += ["-p", "no:cacheprovider", "-m", "not (slow or vm or systemd or soak or realtime)"]
    with (folder / "said.txt").open("wb") as said:
        return subprocess.Popen(
            [*command, *words], cwd=folder, env=env, stdout=said, stderr=said, start_new_session=True
        )


class Known(NamedTuple):
    """What was measured."""

    lines: dict[str, dict[int, list[str]]]  # of a file, the tests that run one; "" is when it is loaded
    seconds: dict[str, float]  # of a test that passes


def test_files() -> list[str]:
    """Those whose tests are run: the ones that name one of the rooms."""
    rooms = re.compile(rf"\bpneud\.({'|'.join(ROOMS)})\b")
    return sorted(
        f"tests/{path.name}"
        for path in (ROOT / "tests").glob("test_*.py")
        if not NOT_THESE.fullmatch(path.stem) and rooms.search(path.read_text(encoding="utf-8"))
    )


def known(workers: int) -> Known:
    """Which tests run a line; measured where that is not known of the files of tests as they are."""
    place = PLACE / "reach"
    noted = place / "known.json"
    sources = _sources()
    now = {file: _digest((ROOT / file).read_text("utf-8")) for file in test_files()}
    before = json.loads(noted.read_text("utf-8")) if noted.is_file() else {}
    if before.get("sources") != sources:
        before = {"sources": sources, "files": {}, "lines": {}, "seconds": {}}
    stale = [file for file in now if before["files"].get(file) != now[file]]
    if stale:
        print(
            f"mutants: measures which lines the tests of {len(stale)} files run", file=sys.stderr, flush=True
        )
        lines, seconds = _measured(place, stale, workers)
        old = tuple(f"{file}::" for file in stale)
        for of_file in before["lines"].values():
            for number, names in of_file.items():
                of_file[number] = [name for name in names if not name.startswith(old)]
        for file, of_file in lines.items():
            into = before["lines"].setdefault(file, {})
            for number, names in of_file.items():
                into[number] = sorted({*into.get(number, []), *names})
        before["seconds"] = {k: v for k, v in before["seconds"].items() if not k.startswith(old)} | seconds
        before["files"] = now
        noted.write_text(json.dumps(before), encoding="utf-8")
    return Known(
        {file: {int(n): names for n, names in lines.items()} for file, lines in before["lines"].items()},
        before["seconds"],
    )


def _measured(
    place: Path, files: list[str], workers: int
) -> tuple[dict[str, dict[str, list[str]]], dict[str, float]]:
    copy = place / "copy"
    made_copy(copy)
    for path in place.glob(".coverage*"):
        path.unlink()
    rc = place / "coverage.rc"
    rooms = "\n".join(f"    {copy}/src/pneud/{room}" for room in ROOMS)
    rc.write_text(RC.format(place=place, rooms=rooms), encoding="utf-8")
    begun(copy, ["-n", str(workers), "--dist", "worksteal", *files], **{REACH: str(rc)}).wait()
    return _read(place, copy)


def _read(place: Path, copy: Path) -> tuple[dict[str, dict[str, list[str]]], dict[str, float]]:
    """What a measurement has left."""
    import coverage  # noqa: PLC0415

    durations = json.loads((place / "durations.json").read_text(encoding="utf-8"))
    if not durations:
        raise SystemExit(f"mutants: no test ran; {copy / 'said.txt'} says why")
    data = coverage.CoverageData(basename=str(place / "all"))
    data.erase()
    for path in sorted(place.glob(".coverage*")):
        one = coverage.CoverageData(basename=str(path))
        try:
            one.read()
            data.update(one)
        except coverage.CoverageException:  # of a process that was killed while it wrote
            continue
    lines: dict[str, dict[str, list[str]]] = {}
    for measured in data.measured_files():
        file = str(Path(measured).relative_to(copy))
        for number, names in data.contexts_by_lineno(measured).items():
            lines.setdefault(file, {})[str(number)] = sorted(set(names))
    return lines, {name: seconds for name, (seconds, passed) in durations.items() if passed}


def job_of(mutant: Mutant, what: Known) -> dict[str, Any]:
    """What a worker is to do about a mutant."""
    of_file = what.lines.get(mutant.file, {})
    names = set(of_file.get(mutant.line, []))
    if not names:  # a line in the midst of a statement
        names = next((set(of_file[n]) for n in range(mutant.line, 0, -1) if of_file.get(n)), set())
    tests: list[str] = []
    sum_s = 0.0
    for name in sorted(names & what.seconds.keys(), key=lambda name: what.seconds[name]):
        sum_s += what.seconds[name]
        if sum_s > MOST_S and tests:
            break
        tests.append(name)
    # Tests of a file that are equally quick stay together: what they share is made once.
    tests.sort(key=lambda name: (_tier(what.seconds[name]), name.partition("::")[0]))
    return {
        "key": mutant.key, "file": mutant.file, "function": mutant.function, "text": mutant.text,
        "tests": tests, "asked": _digest(" ".join(tests)), "seeds": list(range(SEEDS)), "cold": "" in names,
    }  # fmt: skip


def _tier(seconds: float) -> int:
    return sum(seconds > limit for limit in (0.02, 0.1, 0.5, 2.0))


def results() -> dict[str, dict[str, Any]]:
    """What is known of mutants, by key: the last word about each."""
    path = PLACE / RESULTS
    if not path.is_file():
        return {}
    return {one["key"]: one for one in map(json.loads, path.read_text(encoding="utf-8").splitlines())}


def ran(jobs: list[dict[str, Any]], what: Known, workers: int) -> None:
    """All of them, by processes that take one after the other."""
    shutil.rmtree(PLACE / "claims", ignore_errors=True)
    (PLACE / "claims").mkdir(parents=True)
    quickest: dict[str, str] = {}
    for name in sorted(what.seconds, key=lambda name: what.seconds[name]):
        quickest.setdefault(name.partition("::")[0], name)
    warm = [name for name in quickest.values() if what.seconds[name] < 0.2]
    files = sorted(
        {name.partition("::")[0] for names in (warm, *(j["tests"] for j in jobs)) for name in names}
    )
    (PLACE / JOBS).write_text(json.dumps({"warm": warm, "jobs": jobs}), encoding="utf-8")
    running = []
    for number in range(min(workers, len(jobs))):
        copy = PLACE / f"copy-{number}"
        made_copy(copy)
        running.append(begun(copy, files, **{MUTANTS: str(PLACE)}))
    for one in running:
        one.wait()


def main() -> int:
    """Draw, run, and say what is left."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=300, metavar="N", help="how many mutants (300)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="which ones (1)")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), metavar="N", help="workers")
    parser.add_argument("--again", action="store_true", help="try what survived once more")
    parser.add_argument("--fresh", action="store_true", help="forget what is known")
    args = parser.parse_args()
    if args.count < 1 or args.jobs < 1:
        parser.error("--count and --jobs are 1 or more")
    if args.fresh:
        shutil.rmtree(PLACE, ignore_errors=True)
    (PLACE / "reach").mkdir(parents=True, exist_ok=True)
    taken, total = drawn(args.seed, args.count)
    what = known(args.jobs)
    before = results()
    jobs = [
        job
        for job in (job_of(mutant, what) for mutant in taken)
        if _is_open(job, before.get(job["key"]), again=args.again)
    ]
    if jobs:
        ran(jobs, what, args.jobs)
    return told(taken, total)


def _is_open(job: dict[str, Any], found: dict[str, Any] | None, *, again: bool) -> bool:
    """Whether a mutant is to be tried."""
    if found is None:
        return True
    return bool(found["verdict"] == "survived" and (again or found["asked"] != job["asked"]))


def told(taken: list[Mutant], total: int) -> int:
    """Print what no test noticed, and the share.

    Returns:
        Exit status.
    """
    found = results()
    done = [mutant for mutant in taken if mutant.key in found]
    ways = Counter(
        "a seed" if found[one.key]["by"].startswith("seed") else found[one.key]["verdict"] for one in done
    )
    for mutant in sorted(done, key=lambda one: (one.file, one.line)):
        one = found[mutant.key]
        if one["verdict"] == "survived":
            print(f"{mutant.file}:{mutant.line} {mutant.function} ({one['tests']} tests)")
            print(f"- {mutant.was}\n+ {mutant.becomes}\n")
    noticed = len(done) - ways["survived"]
    for room in ROOMS:
        here = [found[one.key]["verdict"] != "survived" for one in done if f"/pneud/{room}/" in one.file]
        print(f"{room:8} {sum(here):4} of {len(here)}")
    print(
        f"{noticed} of {len(done)} mutants noticed, {100 * noticed / max(1, len(done)):.1f} %"
        f" (tests {ways['noticed']}, seeds {ways['a seed']}, no end {ways['timeout']}); drawn from {total}"
    )
    return int(noticed < LEAST * len(done) or len(done) < len(taken))


if __name__ == "__main__":
    sys.exit(main())
