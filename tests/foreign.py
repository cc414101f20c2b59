"""The foreign node of hil/: built here, and an axis that knows its frames."""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path
from typing import IO

import pytest

from pneud.signals import Frame

FOREIGN = Path(__file__).parent.parent / "hil" / "foreign"
CONFIGS = FOREIGN.parent.parent / "configs"
PACKET = struct.Struct("=qIB3x8s")


def built(folder: Path) -> Path:
    """The node, compiled in a folder."""
    if shutil.which("cc") is None or shutil.which("make") is None:
        pytest.skip("no C compiler or make here: the foreign node cannot be built")
    for name in ("node.c", "Makefile"):
        shutil.copy(FOREIGN / name, folder)
    subprocess.run(["make", "-s", "-C", folder, "node"], check=True)
    return folder / "node"


def axis(folder: Path, name: str, *changes: tuple[str, str], frames: tuple[str, str] = ("", "")) -> Path:
    """A configuration of pneud's, changed, with the foreign frames, beside their DBC."""
    shutil.copy(FOREIGN / "foreign.dbc", folder)
    text = (CONFIGS / name).read_text(encoding="utf-8")
    for old, new in (('"pneud.dbc"', '"foreign.dbc"'), *changes):
        assert old in text
        text = text.replace(old, new)
    path = folder / "foreign.toml"
    told = (FOREIGN / "frames.toml").read_text(encoding="utf-8")
    assert frames[0] in told
    path.write_text(f"{text}\n{told.replace(*frames)}", encoding="utf-8")
    return path


class Piped:
    """The node on pipes."""

    def __init__(self, node: Path, timeout_ms: float = 50.0) -> None:
        self.process = subprocess.Popen(
            [node, "-", str(timeout_ms)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
        )

    def __enter__(self) -> Piped:
        return self

    def __exit__(self, *_: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        assert self.process.wait(5) == 0
        self._out.close()

    @property
    def _out(self) -> IO[bytes]:
        assert self.process.stdout is not None
        return self.process.stdout

    def tell(self, frame: Frame, answers: int = 0) -> list[Frame]:
        """A frame at its stamp; what the node answers."""
        assert self.process.stdin is not None
        self.process.stdin.write(
            PACKET.pack(frame.stamp_ns, frame.can_id, len(frame.data), frame.data.ljust(8, b"\0"))
        )
        found = []
        for _ in range(answers):
            t_ns, can_id, length, data = PACKET.unpack(self._out.read(PACKET.size))
            found.append(Frame(t_ns, can_id, data[:length]))
        return found
