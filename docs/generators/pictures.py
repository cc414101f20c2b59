"""The pictures of the documents, taken of the real thing: `python -m generators.pictures` in `docs` makes them anew.

What a terminal shows is what the command prints, drawn by rich; pages are drawn by Chromium. What takes no browser is the
same each time.
"""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.text import Text

FOLDER = Path(__file__).parent.parent / "pictures"
COLUMNS = 90
TERMINALS = {
    "moves": ["pneud sim --goto 450,550@200,500"],
    "fault": ["pneud sim --scenario encoder-missing -o fault.mcap", "pneud replay fault.mcap"],
    "burst": ["pneud sim --scenario hose-burst -o night.mcap"],
    "check": [
        "pneud new press --cylinder dsbc-32 --valve mpye-5-1-8-lf --stroke 300 --mass 8",
        "pneud check press.toml",
        "pneud sim press.toml --goto 50,250@200,150",
    ],
}
# fonts that rich would have fetched from elsewhere
FORMAT = re.sub(r"\n *@font-face \{\{.*?\}\}", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL)

QUIET = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


class Page(NamedTuple):
    """A picture of a page."""

    commands: tuple[str, ...]
    page: str  # that they write
    width: int  # of the window, and of the picture [px]
    height: int
    section: str = ""  # of the page, the only one in the picture
    dark: bool = False


_MOVES = ("pneud sim -o moves.mcap --goto 450,550@200,500", "pneud report moves.mcap")
_SINE = ("pneud sim -o sine.mcap", "pneud report sine.mcap")
PAGES = {
    "report": Page(_MOVES, "moves.html", 1100, 680),
    "report-run": Page(_MOVES, "moves.html", 1100, 880, "s-run", dark=True),
    "report-maps": Page(_SINE, "sine.html", 1100, 1300, "s-maps"),
}


def run(command: str, folder: Path) -> str:
    """What a command of pneud prints in a folder, whatever its exit status; on standard error, too."""
    words = command.split()
    assert words[0] == "pneud"
    done = subprocess.run(
        [sys.executable, "-m", "pneud.cli", *words[1:]], cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, env=os.environ | {"COLUMNS": str(COLUMNS)}, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stdout
    return done.stdout


def terminal(name: str, folder: Path) -> str:
    """The picture of a terminal in which commands were typed."""
    console = Console(
        record=True, file=io.StringIO(), width=COLUMNS, force_terminal=True, color_system="truecolor"
    )
    for command in TERMINALS[name]:
        console.print(Text.assemble(("$ ", "green"), (command, "bold")))
        console.print(Text.from_ansi(run(command, folder).rstrip()))
    return console.export_svg(title="", code_format=FORMAT, unique_id=name)


def browser() -> str | None:
    """Chromium, where there is one."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def drawn(page: Page, folder: Path, picture: Path) -> None:
    """A picture of the top of a page, or of one of its sections, in few colours."""
    from PIL import Image  # noqa: PLC0415 - comes with matplotlib

    for command in page.commands:
        run(command, folder)
    program = browser()
    assert program is not None, "needs Chromium"
    if page.section:
        with (folder / page.page).open("a", encoding="utf-8") as file:
            file.write(f"<style>header, nav, section:not(#{page.section}) {{ display: none }}</style>")
    subprocess.run(
        [program, *QUIET, f"--user-data-dir={folder / 'profile'}", f"--window-size={page.width},{page.height}",
         *(["--blink-settings=preferredColorScheme=0"] if page.dark else []),
         "--virtual-time-budget=8000", f"--screenshot={picture}", (folder / page.page).as_uri()],
        capture_output=True, timeout=120, check=True,
    )  # fmt: skip
    with Image.open(picture) as image:
        image.convert("RGB").quantize(96).save(picture, optimize=True)


def make(into: Path) -> None:
    """All of them but those of the screen, which `screens` makes."""
    into.mkdir(exist_ok=True)
    for name in TERMINALS:
        with tempfile.TemporaryDirectory() as folder:
            (into / f"{name}.svg").write_text(terminal(name, Path(folder)), encoding="utf-8")
    for name, page in PAGES.items():
        with tempfile.TemporaryDirectory() as folder:
            drawn(page, Path(folder), into / f"{name}.png")


if __name__ == "__main__":
    from generators import screens

    screens.write(FOLDER.parent)
    make(FOLDER)
