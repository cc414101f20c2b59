"""The page in textual: it reads keys, follows the terminal's size, and writes what has changed."""

from __future__ import annotations

import os
import signal
import sys

from rich.segment import Segment
from textual import events
from textual.app import App, ComposeResult
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from pneud.view.several import Several
from pneud.view.show import Show, is_ascii
from pneud.view.terminal import FRAME_S

_NAMED = {"left", "right", "enter", "escape", "backspace", "ctrl+d", "tab"}


_REPEATED = {"left", "right"}  # many times a second, each of which is not worth a picture
_ANEW = 10  # pictures, after which all rows are drawn: others may have written to the terminal


class Picture(Widget):
    """Rows of the page; of most pictures, those that differ from the one before are drawn."""

    DEFAULT_CSS = "Picture { width: 100%; height: 100%; }"

    def __init__(self, show: Show | Several, ascii_only: bool) -> None:
        super().__init__()
        self._show = show
        self._ascii_only = ascii_only
        self._rows: list[list[Segment]] = []
        self._count = 0
        self._strips: list[Strip] = []

    def draw(self) -> None:
        """Make the next picture."""
        width, height = self.size
        if not width or not height:
            return
        rows = self._show.picture((width, height), self._ascii_only)
        self._count += 1
        anew = self._count % _ANEW == 0 or len(self._rows) != len(rows)
        before = [[]] * len(rows) if anew else self._rows
        changed = [y for y, (old, now) in enumerate(zip(before, rows, strict=True)) if old != now]
        if not changed:
            return
        self._rows = rows
        if len(self._strips) != len(rows):
            self._strips = [Strip.blank(width)] * len(rows)
        for y in changed:
            self._strips[y] = Strip(rows[y], width)
        self.refresh(*(Region(0, y, width, 1) for y in changed))

    def render_line(self, y: int) -> Strip:
        """A row for textual."""
        return self._strips[y] if y < len(self._strips) else Strip.blank(self.size.width)


class ScreenApp(App[None], inherit_bindings=False):
    """The screen; every key goes to the show, and Ctrl-C to whoever started it."""

    ENABLE_COMMAND_PALETTE = False
    CSS = "Screen { layers: base; }"

    def __init__(self, show: Show | Several, ascii_only: bool) -> None:
        super().__init__(ansi_color=True)
        self.show = show
        self.picture = Picture(show, ascii_only)

    def compose(self) -> ComposeResult:
        """The picture is all there is."""
        yield self.picture

    def on_mount(self) -> None:
        """Begin, with the terminal's own colours."""
        self.theme = "ansi-dark"
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # stopped, it would be in the way of whoever goes on
        self.set_interval(FRAME_S, self.step)
        self.call_after_refresh(self.step)

    def step(self) -> None:
        """Take what has come, and draw it."""
        if self.show.attend():
            self.picture.draw()
        else:
            self.exit()

    def on_resize(self, _: events.Resize) -> None:
        """Fill the terminal at once."""
        self.call_after_refresh(self.picture.draw)

    def on_key(self, event: events.Key) -> None:
        """Hand a key on."""
        event.stop()
        event.prevent_default()
        key = event.key if event.key in _NAMED else event.character
        if key:
            self.show.hands.press(key)
            if key not in _REPEATED:
                self.step()


def run_app(show: Show | Several) -> None:
    """Show an axis until it is over."""
    os.environ["TEXTUAL_ALLOW_SIGNALS"] = "1"  # Ctrl-C reaches the daemon even where nobody reads keys here
    os.dup2(1, 2)  # textual writes to standard error, which may be somebody's file
    app = ScreenApp(show, is_ascii(sys.stdout.encoding))
    app.run(mouse=False)
    if app.return_code:
        raise OSError("the screen has failed")
