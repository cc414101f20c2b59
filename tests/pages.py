"""What the documents have their readers type, and a folder in which it is typed."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    (ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("hil/**/*.md"), *ROOT.glob("src/**/*.md"))
)
PROGRAMS = (
    *("pneud", "python", "python3", "pip", "pipx", "marimo", "cantools", "candump", "cc", "git", "make"),
    *("apt", "ip", "scp", "sudo", "systemctl", "adduser", "hil/vm/run", "hil/foreign/node"),
    *("/opt/pneud/bin/pneud", ".venv/bin/python", ".venv/bin/pneud", ".venv/bin/pip"),
)
SHELL = ("sh", "bash", "console")
PATIENCE_S = 120.0
FENCE = re.compile(r"( *)(`{3,})(\w*)(.*)")


class Step(NamedTuple):
    """One thing that a page has its reader do."""

    line: int
    kind: str  # "command", "file", "append", or the language of a block of code
    text: str
    name: str = ""  # of a file


def steps(page: Path) -> Iterator[Step]:
    """All of them in order; what is shown and not done is left out.

    A fence with `title="NAME"` is a file that the reader writes, with `title="NAME, appended"` the end of
    one. Lines of a fence of `sh`, and indented ones that begin with a program's name, are commands.
    """
    lines = iter(enumerate(page.read_text(encoding="utf-8").splitlines(), 1))
    for number, line in lines:
        fence = FENCE.fullmatch(line)
        if fence is None:
            if (words := line.split()) and line.startswith("    ") and words[0] in PROGRAMS:
                yield Step(number, "command", line.strip())
            continue
        indent, ticks, language, rest = fence.groups()
        inside = []
        for _, text in lines:
            if text.strip() == ticks:
                break
            inside.append(text.removeprefix(indent))
        yield from _of_fence(number, language, rest, inside)


def _of_fence(number: int, language: str, rest: str, inside: list[str]) -> Iterator[Step]:
    text = "\n".join(inside) + "\n"
    if title := re.search(r'title="([^",]+)(, appended)?"', rest):
        yield Step(number, "append" if title[2] else "file", text, title[1])
    elif language in SHELL:
        for offset, line in enumerate(inside, 1):
            if line.strip() and not line.startswith("#"):
                yield Step(number + offset, "command", line.strip())
    elif language not in ("", "text", "json"):
        yield Step(number, language, text)


def _answers(address: tuple[str, int]) -> bool:
    try:
        socket.create_connection(address, timeout=5.0).close()
    except OSError:
        return False
    return True


class Desk:
    """A folder, and what is typed in it; a daemon goes on beside until the next one or the end.

    Raises:
        AssertionError: a command has failed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.programs = folder / ".bin"
        self.runtime = tempfile.TemporaryDirectory(prefix="pneud-")  # paths of sockets are short
        self.programs.mkdir()
        (folder / ".state").mkdir()
        for name, words in (("pneud", "-m pneud.cli"), ("python", ""), ("python3", "")):
            file = self.programs / name
            file.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {words} "$@"\n')
            file.chmod(0o755)
        beside_python = Path(sys.executable).parent
        self.env = os.environ | {
            "PATH": f"{self.programs}:{beside_python}:{os.environ['PATH']}",
            "XDG_RUNTIME_DIR": self.runtime.name,
            "STATE_DIRECTORY": str(folder / ".state"),
            "COLUMNS": "110",
        }
        self.env.pop("PNEUD_SOCKET", None)
        self.beside: list[tuple[str, subprocess.Popen[str]]] = []

    def command(self, words: str, expected: tuple[int, ...] = (0,)) -> str:
        """Run one to its end.

        Returns:
            What it has printed.
        """
        done = subprocess.run(
            ["/bin/bash", "-c", words], cwd=self.folder, env=self.env, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert done.returncode in expected, f"{words}: {done.returncode}\n{done.stdout}"
        return done.stdout

    def begin(self, words: str) -> None:
        """Start one that goes on; when this ends, the axis of a daemon does what it was started for."""
        plain = words.partition("#")[0].strip()
        daemon = re.match(r"pneud --", plain)
        rig = daemon and "--bus" in plain and any("pneud plant" in words for words, _ in self.beside)
        if (daemon and not rig) or plain.startswith("pneud plant"):
            self.end()  # a plant and the daemon on its bus belong together
        if daemon and "--headless" not in plain:
            plain += " --headless"
        process = subprocess.Popen(
            ["/bin/bash", "-c", f"exec {plain}"], cwd=self.folder, env=self.env, text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        self.beside.append((plain, process))
        wanted = "tracking" if "--virtual" in plain or "--arm" in plain else "disarmed|waiting"
        deadline = time.monotonic() + PATIENCE_S
        while daemon and not re.search(rf'"state": ?"({wanted})"', self._status()):
            assert process.poll() is None, f"{plain}\n{process.communicate()[0]}"
            assert time.monotonic() < deadline, f"{plain}: {self._status()}"
            time.sleep(0.05)
        web = plain.startswith("pneud web")
        if web:
            listen = re.search(r"--listen (\S+):(\d+)", plain)
            address = (listen[1], int(listen[2])) if listen else ("127.0.0.1", 8770)
            while not _answers(address):
                assert process.poll() is None, f"{plain}\n{process.communicate()[0]}"
                assert time.monotonic() < deadline, plain
                time.sleep(0.05)
        if not (daemon or web):
            time.sleep(0.5)  # nobody tells when it is ready

    def _status(self) -> str:
        """What the daemon of this folder says of itself, asked without a process for it."""
        for path in Path(self.runtime.name).rglob("*.sock"):
            with suppress(PlaceError, RefusedError), Client(str(path)) as client:
                return json.dumps(client.ask("status"))
        return ""

    def end(self) -> None:
        """Press Ctrl-C in all that goes on, the last one first."""
        while self.beside:
            words, process = self.beside.pop()
            process.send_signal(signal.SIGINT)
            try:
                said, _ = process.communicate(timeout=PATIENCE_S)
            finally:
                process.kill()
            assert process.returncode in (0, 130), f"{words}: {process.returncode}\n{said}"

    def close(self) -> None:
        """End all, whatever has happened."""
        for _, process in self.beside:
            process.kill()
            process.communicate()
        self.runtime.cleanup()
