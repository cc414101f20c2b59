"""Child processes: the one way to fork, to watch and to end them, and to send them messages. Linux only."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_LOOK_S = 0.005  # how often a child that is to end is looked at
_REAP_S = 1.0  # longest that a killed process should take to go
_LOW = 5  # niceness, as that of whoever looks on
_NAME_LETTERS = 15  # that the kernel takes
_LEAVE_S = 10.0  # patience with a program that has been asked to end

Main = Callable[[], int | None]
"""The whole life of a child; returns its exit status, None for 0."""


def pair() -> tuple[socket.socket, socket.socket]:
    """Two ends of a way for messages between processes; neither waits.

    Raises:
        OSError: no more descriptors.
    """
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    one.setblocking(False)
    other.setblocking(False)
    return one, other


def fork(
    main: Main,
    *,
    keep: Iterable[int] = (),
    terminal: bool = False,
    orphaned: int | None = signal.SIGKILL,
    name: str = "",
    known: tuple[type[Exception], ...] = (),
) -> int:
    """Run `main` in a child process that ends with it.

    What reaches the whole group (Ctrl-C, a closed terminal, a watchdog) is the parent's to act on: the child
    ignores it, but for SIGTERM, which ends a child that does not say otherwise. An exception ends it with 1.

    Args:
        main: what the child does.
        keep: descriptors that it needs; it has no others of its parent's.
        terminal: it needs standard input and output; else they are /dev/null.
        orphaned: the signal that it gets when its parent dies. None for a child that sees by itself when it
            is to go: it ignores SIGTERM, too.
        name: what those who list processes see it as; that of its parent if empty.
        known: errors whose text is all that a person needs; others leave a traceback, but for what the
            machine refuses, which is one line.

    Returns:
        The child's process id.

    Raises:
        OSError: no more processes.
    """
    _flush()
    parent = os.getpid()
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        if name:
            _call_itself(name)
        ignore_group_signals()
        if orphaned is not None:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            die_with_parent(parent, orphaned)
        _close_all_but(keep, terminal)
        status = main() or 0
    except known as e:
        print(f"pneud: {e}", file=sys.stderr)
    except OSError as e:  # what the machine refuses is no mistake of the program
        place = "" if e.filename is None else f"{os.fsdecode(e.filename)}: "
        print(f"pneud: {main.__module__.rpartition('.')[2]}: {place}{e.strerror or e}", file=sys.stderr)
    except Exception:
        traceback.print_exc()
    finally:
        try:
            _flush()
        finally:
            os._exit(status)


def _call_itself(name: str) -> None:
    """Name this process, for those who list processes; pneud stands before it."""
    with contextlib.suppress(OSError):  # a system may show no processes
        Path("/proc/self/comm").write_text(f"pneud-{name}"[:_NAME_LETTERS])


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as it is where the descriptor is closed
            stream.flush()


def _close_all_but(keep: Iterable[int], terminal: bool) -> None:
    """Close what the fork inherited: a socket held open here would seem alive after its owner's death."""
    kept = set(keep)
    for descriptor in sorted(int(entry.name) for entry in Path("/proc/self/fd").iterdir()):
        if descriptor > 2 and descriptor not in kept:
            with contextlib.suppress(OSError):
                os.close(descriptor)
    if terminal:
        return
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in {0, 1} - kept:
        os.dup2(null, descriptor)
    if null > 2:
        os.close(null)


def ignore_group_signals() -> None:
    """Leave it to the parent to act on Ctrl-C, a closed terminal, a watchdog, a kill of the group."""
    for number in (
        *(signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP),
        *(signal.SIGTERM, signal.SIGHUP, signal.SIGABRT),
    ):
        signal.signal(number, signal.SIG_IGN)


def die_with_parent(parent: int, number: int = signal.SIGKILL) -> None:
    """Let the kernel send this process a signal when its parent dies.

    Args:
        parent: os.getpid() of the parent, taken before the fork: it may be dead by now.
        number: the signal.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), number)


def asked_to_leave(*signals: int) -> Callable[[], bool]:
    """Let signals ask this process to leave, instead of ending it.

    Returns:
        What tells whether one has come.
    """
    asked = False

    def ask(*_: object) -> None:
        nonlocal asked
        asked = True

    for number in signals:
        signal.signal(number, ask)
    return lambda: asked


def at_low_priority(work: Callable[[], object]) -> None:
    """Do something that is in no hurry, such as to load modules, and let all others go first.

    It is done in a thread of its own: what this process does afterwards, or forks, has its own priority.
    """

    def low() -> None:
        os.nice(_LOW)  # of this thread alone
        work()

    thread = threading.Thread(target=low)
    thread.start()
    thread.join()


def gone(pid: int) -> bool:
    """Whether a child has ended; never waits."""
    try:
        return os.waitpid(pid, os.WNOHANG)[0] != 0
    except ChildProcessError:
        return True


def wait(pid: int, patience_s: float) -> bool:
    """Wait for a child to end.

    Returns:
        Whether it has.
    """
    deadline = time.monotonic() + patience_s
    while not gone(pid):
        if time.monotonic() > deadline:
            return False
        time.sleep(_LOOK_S)
    return True


def end(pid: int, patience_s: float) -> bool:
    """Ask a child to leave; kill it when it does not.

    Returns:
        Whether it left by itself.
    """
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGTERM)
    if wait(pid, patience_s):
        return True
    kill(pid)
    return False


def kill(pid: int) -> None:
    """End a child whatever it does."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    wait(pid, _REAP_S)


@contextmanager
def program(
    *command: str | Path, out: int | None = None, err: int | None = None
) -> Iterator[subprocess.Popen[str]]:
    """Run another program for as long as a block; afterwards it has ended, whatever it takes."""
    process = subprocess.Popen(command, stdout=out, stderr=err, text=True)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.communicate(timeout=_LEAVE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
