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
    assert {path.name for path in written} == {path.name for path in DOCS.glob("pictures/screen-*.svg")}
    for path in written:
        now, kept = words(path.read_text()), words((DOCS / "pictures" / path.name).read_text())
        assert now == kept, f"{path.name}: python docs/generators/screens.py"
    first = DOCS / "pictures" / written[0].name
    assert (DOCS / "screen.svg").read_text() == first.read_text()
