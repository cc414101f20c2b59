"""Texts that stay as they are: beside the tests as files, written anew with PNEUD_SNAPSHOTS=write."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

FOLDER = Path(__file__).parent / "snapshots"


def assert_same(name: str, text: str) -> None:
    """Compare with the file of that name; lines keep no blanks at their ends."""
    lines = [line.rstrip() for line in text.splitlines()]
    path = FOLDER / f"{name}.txt"
    if os.environ.get("PNEUD_SNAPSHOTS") == "write":
        FOLDER.mkdir(exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    before = path.read_text(encoding="utf-8").splitlines()
    difference = "\n".join(difflib.unified_diff(before, lines, name, "now", lineterm=""))
    assert not difference, f"{difference}\nPNEUD_SNAPSHOTS=write takes it as it is now"
