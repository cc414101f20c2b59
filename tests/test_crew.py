"""Children: what they inherit, which signals reach them, how they end, and who notices."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from commands import eventually
from pneud import crew

GROUP = (
    *(signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP),
    *(signal.SIGTERM, signal.SIGHUP, signal.SIGABRT),
)


def status_of(pid: int) -> int:
    """Exit status of a child that ends, or minus the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def told_by(
    main: Callable[[Callable[[str], None]], int | None], *keep: int, orphaned: int | None = signal.SIGKILL
) -> tuple[str, int]:
    """What a child says through a pipe, and how it ends."""
    readable, writable = os.pipe()

    def say(words: str) -> None:
        os.write(writable, words.encode())

    child = crew.fork(lambda: main(say), keep=(writable, *keep), orphaned=orphaned)
    os.close(writable)
    with os.fdopen(readable) as pipe:
        return pipe.read(), status_of(child)


class KnownError(Exception):
    pass


def fail(error: Exception) -> int:
    raise error


@pytest.mark.parametrize(
    ("main", "status", "words"),
    [
        (lambda: None, 0, ""),
        (lambda: 3, 3, ""),
        (lambda: fail(KnownError("no such bus")), 1, "pneud: no such bus\n"),
        (lambda: fail(ValueError("what now")), 1, "ValueError: what now\n"),
        (lambda: sys.exit(0), 1, ""),
    ],
)
def test_a_child_ends_with_its_function(
    main: crew.Main, status: int, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    def with_a_plain_standard_error() -> int | None:  # pytest's is a file that the child does not have
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
        return main()

    assert status_of(crew.fork(with_a_plain_standard_error, known=(KnownError,))) == status
    err = capfd.readouterr().err
    assert err.endswith(words)
    assert ("Traceback" in err) == ("ValueError" in words)


def test_a_child_has_none_of_its_parents_files_but_those_it_is_given() -> None:
    lent, kept = os.pipe(), os.pipe()

    def main(say: Callable[[str], None]) -> None:
        for descriptor in (*lent, *kept):
            try:
                os.fstat(descriptor)
                say("open ")
            except OSError:
                say("closed ")
        say(" ".join(str(Path(f"/proc/self/fd/{n}").readlink()) for n in (0, 1)))

    told, status = told_by(main, kept[0])
    assert (told, status) == ("closed closed open closed /dev/null /dev/null", 0)
    for descriptor in (*lent, *kept):
        os.close(descriptor)


def test_a_descriptor_that_is_kept_may_stand_in_a_standard_ones_place() -> None:
    readable, writable = os.pipe()
    os.write(writable, b"A")

    def reads_it() -> int:
        os.dup2(readable, 0)
        return status_of(crew.fork(lambda: len(os.read(0, 9)), keep=(0,)))

    assert status_of(crew.fork(reads_it, keep=(readable,))) == 1
    os.close(readable)
    os.close(writable)


def test_a_child_ends_where_there_is_no_standard_error() -> None:
    words = """
import os
from pneud import crew
child = crew.fork(lambda: 3)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    done = subprocess.run(
        ["sh", "-c", 'exec "$0" -c "$1" 2>&-', sys.executable, words],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    assert done.stdout == "3\n"


def test_what_reaches_the_group_is_left_to_the_parent() -> None:
    def receive_all(say: Callable[[str], None]) -> None:
        for number in GROUP:
            os.kill(os.getpid(), number)
        say("alive")

    assert told_by(receive_all, orphaned=None) == ("alive", 0)
    told, status = told_by(receive_all)
    assert (told, status) == ("", -signal.SIGTERM)


def test_a_child_that_listens_is_asked_to_leave() -> None:
    def main(say: Callable[[str], None]) -> None:
        asked = crew.asked_to_leave(signal.SIGTERM)
        say(f"{asked()} ")
        os.kill(os.getpid(), signal.SIGTERM)
        say(f"{asked()}")

    assert told_by(main) == ("False True", 0)


@pytest.mark.parametrize("dead_already", [False, True])
def test_a_child_dies_with_its_parent(dead_already: bool) -> None:
    readable, writable = os.pipe()
    parent = os.fork()
    if parent == 0:
        me = os.getpid()
        if os.fork() == 0:
            if dead_already:
                while os.getppid() == me:
                    time.sleep(0.001)
            crew.die_with_parent(me)
            os.write(writable, b"A")  # only a child whose parent lives gets here
            while True:
                signal.pause()
        if not dead_already:
            time.sleep(0.2)
        os._exit(0)
    os.close(writable)
    os.waitpid(parent, 0)
    with os.fdopen(readable, "rb") as pipe:
        said = pipe.read()  # ends when the grandchild is dead
    assert said == (b"" if dead_already else b"A")


@pytest.mark.parametrize("orphaned", [signal.SIGKILL, signal.SIGTERM])
def test_a_forked_child_dies_with_its_parent(orphaned: int) -> None:
    readable, writable = os.pipe()

    def sleep() -> None:
        os.write(writable, b"A")
        while True:
            signal.pause()

    def main() -> None:
        crew.fork(sleep, keep=(writable,), orphaned=orphaned)
        os.read(readable, 1)

    parent = crew.fork(main, keep=(readable, writable))
    os.close(writable)
    assert status_of(parent) == 0
    with os.fdopen(readable, "rb") as pipe:
        assert pipe.read() == b""  # ends when the grandchild is dead


def sleeper(*, listens: bool) -> int:
    """A child that leaves when it is asked to, or not; it is ready for either."""
    readable, writable = os.pipe()

    def main() -> None:
        if not listens:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        os.write(writable, b"A")
        while True:
            time.sleep(60)

    child = crew.fork(main, keep=(writable,))
    os.read(readable, 1)
    os.close(readable)
    os.close(writable)
    return child


def test_a_child_is_asked_to_leave_and_made_to() -> None:
    polite, stubborn = sleeper(listens=True), sleeper(listens=False)
    assert not crew.gone(polite)
    assert not crew.wait(polite, 0.01)
    assert crew.end(polite, 30.0)
    assert not crew.end(stubborn, 0.01)
    for child in (polite, stubborn):
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)


def test_a_child_that_is_no_more_is_gone() -> None:
    child = sleeper(listens=False)
    crew.kill(child)
    assert crew.gone(child)
    assert crew.wait(child, 0.0)
    assert crew.end(child, 0.0)
    crew.kill(child)


def test_the_end_of_a_child_is_noticed() -> None:
    child = crew.fork(lambda: None)
    eventually(lambda: crew.gone(child))


@pytest.mark.parametrize("stubborn", [False, True])
def test_a_program_has_ended_after_its_block(stubborn: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew, "_LEAVE_S", 0.2)
    ignoring = "signal.signal(signal.SIGTERM, signal.SIG_IGN);" if stubborn else ""
    words = f"import signal, time;{ignoring}print('there', flush=True);time.sleep(60)"
    with crew.program(sys.executable, "-c", words, out=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        assert process.poll() is None
    assert process.returncode == (-signal.SIGKILL if stubborn else -signal.SIGTERM)


def test_what_is_in_no_hurry_leaves_this_process_its_priority(tmp_path: Path) -> None:
    def main() -> None:
        found: list[int] = []
        crew.at_low_priority(lambda: found.append(os.nice(0)))
        (tmp_path / "nice").write_text(f"{found[0]} {os.nice(0)}")

    assert crew.wait(crew.fork(main), 5.0)
    low, own = map(int, (tmp_path / "nice").read_text().split())
    assert own == os.nice(0) < low
