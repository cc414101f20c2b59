"""The pictures of the screen in the documents are those that the generator makes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from generators.screens import DOCS, write

pytestmark = pytest.mark.slow
_TEXT = re.compile(r">([^<>]*)</text>")
_NUMBER = re.compile(r"[+\-\d.,]+|[\u2800-\u28ff█▏▎▍▌▋▊▉▁▂▃▄▅▆▇─═●│·┄ \u00a0…]+")


def words(svg: str) -> list[str]:
    """What a picture says, but for numbers and curves, which differ a little from machine to machine."""
    texts = (_NUMBER.sub("", text.replace("&#160;", " ")) for text in _TEXT.findall(svg))
    return [text for text in texts if text]


def test_pictures_are_as_the_screen_draws_them(tmp_path: Path) -> None:
    written = write(tmp_path)
    kept = {path.relative_to(DOCS) for path in DOCS.rglob("screen*.svg")}
    assert {path.relative_to(tmp_path) for path in written} == kept
    for path in written:
        before = (DOCS / path.relative_to(tmp_path)).read_text()
        assert words(path.read_text()) == words(before), f"{path.name}: python -m generators.screens, in docs"
