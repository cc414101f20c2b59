"""A tuning as a page: what cannot be had better without something else being worse, and why."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from pneud.campaign.page import scaled
from pneud.campaign.rows import Rows
from pneud.campaign.sensitivities import strongest
from pneud.campaign.tuning import NEVER, Trial, Value, front
from pneud.config.toml import toml_text
from pneud.report.frame import GOOD, LOOK, Drawn, Section, Verdict, document, strip, table

NAME = "index.html"
_WIDTH, _HEIGHT, _EDGE = 320.0, 220.0, 34.0
_RANKS = 30


class Tuned(NamedTuple):
    """What a page says of a tuning."""

    name: str
    folder: Path
    objectives: Mapping[str, str]  # column → statistic
    trials: Sequence[Trial]
    runs: int  # of each
    texts: Mapping[int, Mapping[str, Value]]  # by trial of the front: keys of the configuration

    @property
    def columns(self) -> list[str]:
        """Of a trial's figures."""
        return [f"{column} {which}" for column, which in self.objectives.items()]

    @property
    def rows(self) -> Rows:
        """A row for each trial."""
        best = {t.number for t in front(self.trials)}
        kinds = {name: type(value) for t in self.trials for name, value in t.values.items()}
        floats = dict.fromkeys(self.columns, float)
        found = Rows({"trial": int, **kinds, **floats, "front": int, "configured": int}, len(self.trials))
        for place, t in enumerate(self.trials):
            figures = (x if x < NEVER else None for x in t.figures)
            own = (*t.values.values(), *figures, int(t.number in best), int(t.configured))
            found.put(place, (t.number, *own))
        return found


def shown(column: str, value: float) -> str:
    """A figure in the unit that people have for it; of one that some run lacks, that it is not there."""
    return "–" if value >= NEVER else f"{scaled(column)[1] * value:.4g}"


def titles(objectives: Mapping[str, str]) -> list[str]:
    """What the objectives are called, with their units."""
    return [f"{which} of {scaled(column)[0]}" for column, which in objectives.items()]


def told(trials: Sequence[Trial]) -> list[Trial]:
    """What is configured, and the front."""
    return [*(t for t in trials if t.configured), *(t for t in front(trials) if not t.configured)]


def better(trials: Sequence[Trial]) -> list[Trial]:
    """Those of the front that beat what is configured."""
    own = next((t for t in trials if t.configured), None)
    return [t for t in front(trials) if own is not None and t.beats(own)]


def page(t: Tuned) -> str:
    """The page."""
    facts = [
        ("trials", str(len(t.trials))),
        ("runs of each", str(t.runs)),
        ("on the front", str(len(front(t.trials)))),
    ]
    return document(
        f"pneud campaign: {t.name} tuned",
        f"Campaign {t.name} tuned",
        [
            Section("The front", _front(t)),
            Section("Trade-offs", _clouds(t)),
            Section("What objectives depend on", _dependences(t)),
        ],
        lead=strip(_verdict(t), facts),
    )


def _verdict(t: Tuned) -> Verdict:
    found, best = Verdict(), better(t.trials)
    if not any(one.configured for one in t.trials):
        found = found.and_then(LOOK, "what is configured lies beyond what was looked through")
    elif best:
        found = found.and_then(GOOD, f"{len(best)} trials are better in everything than what is configured")
    else:
        found = found.and_then(GOOD, "nothing is better in everything than what is configured")
    bad = sum(not one.whole for one in t.trials)
    return found.and_then(LOOK, f"{bad} trials had runs that failed or never settled") if bad else found


def _front(t: Tuned) -> str:
    columns, parameters = list(t.objectives), list(t.trials[0].values) if t.trials else []
    lines = []
    for one in told(t.trials):
        figures = (shown(c, x) for c, x in zip(columns, one.figures, strict=True))
        given = (_value(one.values[name]) for name in parameters)
        text = Drawn(f"<pre>{html.escape(toml(t.texts.get(one.number, {})))}</pre>")
        lines.append(("configured" if one.configured else str(one.number), *figures, *given, text))
    head = ("trial", *titles(t.objectives), *parameters, "for the configuration")
    hint = '<p class="hint">None of them can be had better in one figure without being worse in another.</p>'
    return table(head, lines, label="the front", last=1, name="front") + hint if lines else ""


def toml(values: Mapping[str, Value]) -> str:
    """Keys with dots as tables of TOML."""
    whole: dict[str, dict[str, Value]] = {}
    for key, value in values.items():
        place, _, last = key.rpartition(".")
        whole.setdefault(place, {})[last] = value
    return "\n".join(f"[{place}]\n{toml_text(dict(some)).strip()}" for place, some in whole.items())


def _clouds(t: Tuned) -> str:
    """Every two objectives against each other."""
    return "".join(_cloud(t, i, j) for i, j in combinations(range(len(t.objectives)), 2))


def _cloud(t: Tuned, across: int, up: int) -> str:
    whole, names = [one for one in t.trials if one.whole], titles(t.objectives)
    if not whole:
        return ""
    best = {one.number for one in front(t.trials)}
    xs, ys = ([one.figures[i] for one in whole] for i in (across, up))

    def place(value: float, values: Sequence[float], length: float) -> float:
        low, high = min(values), max(values)
        return length * (value - low) / ((high - low) or 1.0)

    dots = []
    for one in sorted(whole, key=lambda one: (one.configured, one.number in best)):
        x = _EDGE + place(one.figures[across], xs, _WIDTH - _EDGE - 8.0)
        y = _HEIGHT - _EDGE - place(one.figures[up], ys, _HEIGHT - _EDGE - 8.0)
        colour = "#d55e00" if one.configured else "#0072b2" if one.number in best else "#999999"
        radius = 5.0 if one.configured else 3.5 if one.number in best else 2.0
        dots.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{colour}">'
            f"<title>{'configured' if one.configured else f'trial {one.number}'}</title></circle>"
        )
    columns = list(t.objectives)
    ends = f"{shown(columns[across], min(xs))} … {shown(columns[across], max(xs))}"
    rise = f"{shown(columns[up], min(ys))} … {shown(columns[up], max(ys))}"
    label = html.escape(f"{names[up]} over {names[across]}")
    axes = f"M{_EDGE:g},4V{_HEIGHT - _EDGE:g}H{_WIDTH - 4:g}"
    return (
        f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" width="{_WIDTH:g}" role="img" aria-label="{label}">'
        f'<path d="{axes}" stroke="#999999" fill="none"/>{"".join(dots)}'
        f'<text x="{_EDGE:g}" y="{_HEIGHT - 8:g}" font-size="11" fill="currentColor">'
        f"{html.escape(names[across])}: {ends}</text>"
        f'<text transform="translate(12,{_HEIGHT - _EDGE:g}) rotate(-90)" font-size="11" fill="currentColor">'
        f"{html.escape(names[up])}: {rise}</text></svg>"
    )


def _dependences(t: Tuned) -> str:
    parameters = list(t.trials[0].values) if t.trials else []
    found = [r for r in strongest(t.rows, t.columns, parameters) if abs(r.correlation) > 0.2][:_RANKS]
    lines = [(r.figure, r.given, f"{r.correlation:+.2f}") for r in found]
    hint = '<p class="hint">Rank correlations over all trials, which crowd where things are good.</p>'
    return table(("figure", "goes with", "by"), lines, label="dependences", words=2) + hint if lines else ""


def _value(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
