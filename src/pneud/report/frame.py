"""The skeleton of every page of pneud: head, verdict, sections; one file that needs nothing beside it."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from importlib.resources import files
from itertools import zip_longest
from typing import NamedTuple

from pneud import __version__

GOOD, LOOK, BAD = "good", "look here", "bad"
LONG = 60  # characters: a fact that takes the room of two
_LEVELS = {GOOD: "good", LOOK: "look", BAD: "bad"}  # classes


class Drawn(str):
    """A cell that is markup."""


class Verdict(NamedTuple):
    """What comes of it all, in a word, and why."""

    level: str = GOOD
    reasons: tuple[str, ...] = ()

    def and_then(self, level: str, reason: str) -> Verdict:
        """With one more reason; the worst level stays, and its reasons come first."""
        order = list(_LEVELS)
        if order.index(level) > order.index(self.level):
            return Verdict(level, (reason, *self.reasons))
        return Verdict(self.level, (*self.reasons, reason))


class Section(NamedTuple):
    """A part of the page below a heading; one without content is left out."""

    title: str
    content: str


def document(
    title: str,
    heading: str,
    sections: Iterable[Section],
    *,
    lead: str = "",
    styles: Sequence[str] = (),
    ends: Sequence[str] = (),
) -> str:
    """The page.

    Args:
        title: of the window.
        heading: above all.
        sections: with ways to them where they are more than a few.
        lead: markup below the heading, such as the verdict.
        styles: more style sheets.
        ends: markup at the end of the body.
    """
    shown = [s for s in sections if s.content]
    marks = [section_id(s.title) for s in shown]
    ways = "".join(
        f'<a href="#{mark}">{html.escape(s.title)}</a>' for s, mark in zip(shown, marks, strict=True)
    )
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        f"<title>{html.escape(title)}</title>",
        *(f"<style>{style}</style>" for style in (*styles, asset("page.css"))),
        f"</head><body><header><h1>{html.escape(heading)}</h1>{lead}</header>",
        f'<nav aria-label="Sections">{ways}</nav>' if len(shown) > 3 else "",
        "<main>",
        *(
            f'<section id="{mark}"><h2>{html.escape(s.title)}</h2>{s.content}</section>'
            for s, mark in zip(shown, marks, strict=True)
        ),
        f"</main><footer>pneud {__version__}</footer>",
        *ends,
        "</body></html>\n",
    ]
    return "\n".join(parts)


def facts_list(facts: Iterable[tuple[str, str]]) -> str:
    """Facts beside each other, as many as fit."""
    told = "".join(
        f"<div{' class=long' if len(value) > LONG else ''}>"
        f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
        for name, value in facts
    )
    return f'<dl class="facts">{told}</dl>'


def asset(name: str) -> str:
    """The text of a file that comes with the report."""
    return (files("pneud.report") / "assets" / name).read_text(encoding="utf-8").strip()


def section_id(title: str) -> str:
    """What a link to a section says."""
    return "s-" + re.sub("[^a-z0-9]+", "-", title.lower()).strip("-")


def strip(verdict: Verdict, facts: Sequence[tuple[str, str]] = ()) -> str:
    """The verdict with its reasons, and facts beside it."""
    why = "".join(f"<li>{html.escape(reason)}</li>" for reason in verdict.reasons)
    return (
        f'<div class="verdict {_LEVELS[verdict.level]}"><p><b>{verdict.level}</b></p>'
        f"<ul>{why}</ul></div>{facts_list(facts) if facts else ''}"
    )


def badge(level: str, words: str = "") -> Drawn:
    """The verdict in a cell, in its own words or in others."""
    return Drawn(f'<b class="badge {_LEVELS[level]}">{html.escape(words or level)}</b>')


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    label: str = "table",
    words: int = 1,
    last: int = 0,
    classes: Sequence[str] = (),
    name: str = "",
) -> str:
    """A table, which scrolls where the window is narrow.

    Args:
        head: of its columns.
        rows: their cells.
        label: what it is, for those who do not see it.
        words: so many columns at first are words,
        last: and so many at last.
        classes: of the rows, where they have any.
        name: by which it is saved as CSV, where it can be.
    """

    def cells(row: Sequence[str], tag: str) -> str:
        left = set(range(words)) | set(range(len(row) - last, len(row)))
        return "".join(
            f"<{tag}{' class=w' if i in left else ' class=n' if '-' in cell and ' ' not in cell else ''}>"
            f"{cell if isinstance(cell, Drawn) else html.escape(cell)}</{tag}>"
            for i, cell in enumerate(row)
        )

    body = "".join(
        f"<tr{f' class={html.escape(kind, quote=True)}' if kind else ''}>{cells(row, 'td')}</tr>"
        for row, kind in zip_longest(rows, classes, fillvalue="")
    )
    saved = f' data-name="{html.escape(name, quote=True)}"' if name else ""
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{html.escape(label, quote=True)}">'
        f"<table{saved}><thead><tr>{cells(head, 'th')}</tr></thead><tbody>{body}</tbody></table></div>"
    )
