"""Text for the live screen: rows of exact width, with ASCII stand-ins, and numbers with their units."""

from __future__ import annotations

import math
from enum import IntEnum

from rich.cells import cell_len, set_cell_size
from rich.segment import Segment
from rich.style import Style

LABEL_WIDTH = 10
PLAIN = Style()
DIM = Style(dim=True)
BOLD = Style(bold=True)

# one for one
_ASCII = str.maketrans("µ·─═├┤│┊┄●█▏▎▍▌▋▊▉▁▂▃▄▅▆▇…←→±", "u.-=||||.O########_.:-=+*.<>+")


class Rows:
    """Rows under construction, each cropped to the width."""

    def __init__(self, width: int, ascii_only: bool) -> None:
        self.width = width
        self.ascii_only = ascii_only
        self._rows: list[list[Segment]] = []
        self.room = 0

    def row(self, label: str = "") -> None:
        """Begin a row."""
        self._finish()
        self._rows.append([])
        self.room = self.width
        if label:
            self.put(label, DIM, LABEL_WIDTH)

    def put(self, text: str, style: Style = PLAIN, width: int = 0) -> None:
        """Append text, padded or cropped to a width if one is given, and to what room is left."""
        if self.ascii_only and not text.isascii():
            text = text.translate(_ASCII).encode("ascii", "replace").decode()
        cells = cell_len(text)
        wanted = min(width or cells, self.room)
        if cells != wanted:
            text = set_cell_size(text, wanted)
        self.room -= wanted
        if wanted:
            self._rows[-1].append(Segment(text, style))

    def right(self, text: str, style: Style = PLAIN) -> None:
        """Append text at the right edge."""
        gap = self.room - cell_len(text)
        if gap > 0:
            self.put(" " * gap)
        self.put(text, style)

    def title(self, name: str, *numbers: tuple[str, Style]) -> None:
        """A line across with a name and what is to be said beside it; what does not fit is left out."""
        self.row()
        self.put("── ", DIM)
        self.put(name, BOLD)
        self.put(" ", DIM)
        for text, style in numbers:
            if text and cell_len(text) + 3 <= self.room:
                self.put(" ", DIM)
                self.put(text, style)
                self.put(" ", DIM)
        self.put("─" * self.room, DIM)

    def wrapped(self, text: str, style: Style, most: int) -> None:
        """Whole words in as many rows as they take, `most` at most."""
        words, line = text.split(), ""
        while words and most > 0:
            line = words.pop(0)
            while words and cell_len(line) + 1 + cell_len(words[0]) <= self.width:
                line += f" {words.pop(0)}"
            most -= 1
            cut = words and not most
            self.row()
            self.put(f"{line[: self.width - 2]} …" if cut else line, style)

    @property
    def count(self) -> int:
        """Rows so far."""
        return len(self._rows)

    def extend(self, *parts: Rows) -> None:
        """Append rows made elsewhere, side by side; with the gaps they are as wide as all of this."""
        self._finish()
        self.room = 0
        height = max(part.count for part in parts)
        for line in zip(*(part.filled(height) for part in parts), strict=True):
            row = list(line[0])
            for piece in line[1:]:
                row += [Segment("  ", PLAIN), *piece]
            self._rows.append(row)

    def filled(self, height: int) -> list[list[Segment]]:
        """Exactly `height` rows of the full width, empty ones below."""
        self._finish()
        self.room = 0
        return (self._rows + [[Segment(" " * self.width, PLAIN)]] * (height - self.count))[:height]

    def done(self, height: int) -> list[list[Segment]]:
        """Exactly `height` rows of the full width; the last one stays the last."""
        rows = self.filled(self.count)
        empty = [Segment(" " * self.width, PLAIN)]
        return (rows[:-1] + [empty] * (height - len(rows)))[: height - 1] + rows[-1:]

    def _finish(self) -> None:
        """Pad the row under construction: what stood there before must not show through."""
        if self._rows and self.room:
            self._rows[-1].append(Segment(" " * self.room, PLAIN))


def number(value: float, form: str, unit: str) -> str:
    """A value with its unit; a dash where there is none."""
    return f"{value:{form}} {unit}" if math.isfinite(value) else "-"


def length(metres: float, sign: str = "+") -> str:
    """A small length in the unit that suits it, with the sign always shown unless `sign` is empty."""
    if abs(metres) < 1e-3:
        return number(metres * 1e6, f"{sign}7.1f", "µm")
    return number(metres * 1e3, f"{sign}7.3f", "mm")


def duration(ns: float) -> str:
    """Nanoseconds in the unit that suits them."""
    if not math.isfinite(ns):
        return "-"
    for scale, unit in ((1e3, "µs"), (1e6, "ms")):
        if ns < 1000.0 * scale:
            return f"{ns / scale:.1f} {unit}"
    return f"{ns * 1e-9:.2f} s"


def clock(seconds: float) -> str:
    """Seconds as hours, minutes and seconds."""
    s = int(seconds)
    return f"{s // 3600}:{s // 60 % 60:02}:{s % 60:02}"


def name_of(kind: type[IntEnum], value: int) -> str:
    """The name of a member, or the number where there is no such member."""
    try:
        return kind(value).name.lower().replace("_", " ")
    except ValueError:
        return str(value)


def bit_names(mask: int, names: tuple[str, ...]) -> list[str]:
    """The names of the bits that are set."""
    return [
        clean(names[i]) if i < len(names) else f"bit {i}" for i in range(mask.bit_length()) if mask >> i & 1
    ]


def clean(text: str) -> str:
    """Text from outside without anything that a terminal could take for a command."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)
