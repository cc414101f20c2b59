"""Styles of the page: the terminal's own colours, by names that it knows, for dark and for light ones."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from rich.style import Style

from pneud.signals import State
from pneud.view.banner import Level

_BADGES = {
    State.STARTING: "yellow",
    State.WAITING: "yellow",
    State.DISARMED: "",
    State.STOPPING: "magenta",
    State.FAULT: "red",
}


class Palette(NamedTuple):
    """What is drawn how."""

    good: Style
    warn: Style
    bad: Style
    error: Style
    position: Style
    reference: Style
    p1: Style
    p2: Style
    supply: Style
    command: Style
    key: Style
    prompt: Style
    hunting: Style

    def of(self, level: Level) -> Style:
        """Of what matters so much."""
        return {Level.GOOD: self.good, Level.LOOK: self.warn, Level.BAD: self.bad}[level]

    @staticmethod
    def badge(state: int) -> Style:
        """Of a state."""
        return _badge(_BADGES.get(state, "green"))  # type: ignore[call-overload]


@cache
def _badge(color: str) -> Style:
    """Reversed, so that it stands out without colours, too."""
    return Style(color=color or None, reverse=True, bold=True)


def _style(color: str, bold: bool = True) -> Style:
    return Style(color=color, bold=bold)


@cache
def palette(light: bool) -> Palette:
    """For a dark or a light terminal."""
    return Palette(
        good=_style("green"),
        warn=_style("dark_orange3" if light else "yellow"),
        bad=_style("red"),
        error=_style("dark_cyan" if light else "cyan", bold=False),
        position=_style("blue" if light else "bright_blue", bold=False),
        reference=_style("grey50", bold=False),
        p1=_style("blue" if light else "bright_blue", bold=False),
        p2=_style("magenta", bold=False),
        supply=_style("grey50", bold=False),
        command=_style("dark_orange3" if light else "yellow", bold=False),
        key=Style(reverse=True),
        prompt=_badge(""),
        hunting=_badge("yellow"),
    )
