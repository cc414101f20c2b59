"""Which runs a campaign has: each number is a combination and a draw, and so a configuration and a seed.

Runs with the same draw have the same seed whatever their combination, so that combinations are compared on
the same rigs. More runs of a campaign leave those that there are as they are.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from pneud.bus.codec import DatabaseError
from pneud.campaign import unit
from pneud.campaign.draws import drawn
from pneud.campaign.file import Campaign, Lines
from pneud.campaign.unit import ERROR, SEED, Cell, Row
from pneud.config.sections import ConfigError
from pneud.scenario.files import load_scenario

RUN, CONFIG, SCENARIO = "run", "config", "scenario"
NOBODY = "none"  # a scenario in which nothing happens
SEED_BITS = 32  # of a draw, below the campaign's seed
PATHS = ("path", "dbc_path")  # what a campaign is does not depend on where its files lie
MOST_CHECKED = 64  # combinations: one that is wrong behind them has rows with an error


class Plan(NamedTuple):
    """All runs; plain data, which goes to every worker."""

    bases: tuple[dict[str, Any], ...]  # of `unit.config`, by configuration and scenario
    labels: tuple[dict[str, str], ...]  # of these
    lists: tuple[tuple[str, tuple[str, ...], tuple[Any, ...], bool], ...]  # name, keys, values, whether times
    seed: int
    runs: int  # draws
    kept: tuple[str, ...]  # columns

    @property
    def combinations(self) -> int:
        """How many there are."""
        count = len(self.bases)
        for _, _, values, _ in self.lists:
            count *= len(values)
        return count

    @property
    def total(self) -> int:
        """How many runs there are."""
        return self.combinations * self.runs

    def run(self, number: int) -> Row:
        """The row of a run, with its number and what its combination is."""
        config, label = self.config_of(number)
        row: Row = {RUN: number, **label, **unit.run(config, self.seed_of(number))}
        return {name: row.get(name) for name in self.kept}

    def seed_of(self, number: int) -> int:
        """The seed of a run."""
        return (self.seed << SEED_BITS) + number // self.combinations

    def config_of(self, number: int) -> tuple[dict[str, Any], dict[str, Cell]]:
        """What a run is given, and what is told of it: configuration, scenario, values of lists."""
        place = number % self.combinations
        place, base = divmod(place, len(self.bases))
        config, label = self.bases[base], dict[str, Cell](self.labels[base])
        values: dict[str, Any] = {}
        for name, keys, of, times in self.lists:
            place, which = divmod(place, len(of))
            label[name] = of[which]
            for key in keys:
                values[key] = of[which] * unit.base_of(config, key) if times else of[which]
        return {**config, "values": {**config["values"], **values}}, label

    def with_all_columns(self) -> Plan:
        """The same, of whose rows everything is kept."""
        return self._replace(kept=tuple(self._columns()))

    @property
    def columns(self) -> dict[str, type]:
        """The columns of its rows that are kept, and the kind of value in each."""
        found = self._columns()
        return {name: found[name] for name in self.kept}

    def _columns(self) -> dict[str, type]:
        found: dict[str, type] = {RUN: int, **{name: str for label in self.labels[:1] for name in label}}
        for name, _, values, _ in self.lists:
            kinds = {type(value) for value in values}
            found[name] = kinds.pop() if len(kinds) == 1 else float if str not in kinds else str
        for base in self.bases:
            found |= {name: kind for name, kind in unit.columns(base).items() if name != ERROR}
        return found | {ERROR: str}

    @property
    def inputs(self) -> tuple[str, ...]:
        """Columns of what runs are given, beside seed and number."""
        names = (*self.labels[0], *(name for name, *_ in self.lists), *self.bases[0]["spread"])
        return tuple(name for name in names if name in self.kept)

    @property
    def figures(self) -> tuple[str, ...]:
        """Columns of numbers that runs come to."""
        given = {RUN, SEED, *self.inputs}
        return tuple(
            name for name, kind in self.columns.items() if kind in (float, int) and name not in given
        )

    @property
    def digest(self) -> str:
        """What the campaign is, but for how many runs it has."""
        bases = [{key: value for key, value in base.items() if key not in PATHS} for base in self.bases]
        told = [bases, self.labels, self.lists, self.seed, self.kept]
        return hashlib.sha256(json.dumps(told, sort_keys=True, default=repr).encode()).hexdigest()[:32]


def plan_of(c: Campaign, text: str, path: Path) -> Plan:
    """The runs of a campaign; the first one of every combination is checked.

    Args:
        c: the campaign.
        text: of its file, for the lines of errors.
        path: of its file, beside which its configurations may lie.

    Raises:
        ConfigError: it cannot be run; the file and the cure are in it.
        DatabaseError: a DBC cannot be used.
    """
    lines = Lines(text)
    fixed = {name: p for name, p in c.parameters.items() if p.each is not None}
    spread = {name: p.law for name, p in c.parameters.items() if p.each is None}
    bases, labels, played = [], [], _played(c)
    sought = c.tune.parameters.items() if c.tune is not None else ()
    for file, scenario in product(c.config, c.scenarios or ("",)):
        beside = path.parent / file
        try:
            found = unit.config(
                beside if beside.is_file() else file,
                axis=c.axis,
                spread=spread,
                play=played if scenario in ("", NOBODY) else (),
                scenario="" if scenario == NOBODY else scenario,
                how=c.by,
                times=[key for name, p in [*fixed.items(), *sought] if p.times for key in p.keys or (name,)],
            )
        except (ConfigError, DatabaseError) as e:
            raise type(e)(f"{path}: {_where(c, str(e), lines)}{e}") from None
        bases.append(found)
        labels.append(_label(c, file, scenario))
    lists = tuple((name, p.keys or (name,), tuple(p.each or ()), p.times) for name, p in fixed.items())
    plan = Plan(tuple(bases), tuple(labels), lists, c.seed, c.runs, ())
    plan = plan._replace(kept=_kept(plan._columns(), c.metrics, plan, path, lines))
    _check(plan, c, path, lines)
    if c.worst and c.worst not in plan.figures:
        raise ConfigError(f"{path}: {_at(lines, 'worst')}no such figure; has {', '.join(plan.figures)}")
    return plan


def _played(c: Campaign) -> list[dict[str, Any]]:
    """What is done where nothing happens: beside scenarios, as long as the longest of them."""
    if c.scenarios:
        longest_s = max([0.0, *(load_scenario(one).duration_s for one in c.scenarios if one != NOBODY)])
        return [{"do": "sine", "seconds": longest_s, "learn_s": 0.0}] if longest_s else []
    return [part.model_dump(exclude_defaults=True) | {"do": part.do} for part in c.play]


def _label(c: Campaign, file: str, scenario: str) -> dict[str, str]:
    label = {CONFIG: file} if len(c.config) > 1 else {}
    return label | ({SCENARIO: scenario} if len(c.scenarios) > 1 else {})


def _at(lines: Lines, key: str) -> str:
    line = lines.of((key,))
    return f"line {line}: {key}: " if line else f"{key}: "


def _kept(
    found: Mapping[str, type], wanted: Sequence[str], plan: Plan, path: Path, lines: Lines
) -> tuple[str, ...]:
    """The columns that are kept: what a run is, and the figures that end in what is wanted."""
    if not wanted:
        return tuple(found)
    own = {RUN, SEED, ERROR, *plan.labels[0], *(name for name, *_ in plan.lists), *plan.bases[0]["spread"]}
    figures = [name for name in found if name not in own]
    for one in wanted:
        if not any(_is_meant(name, one) for name in figures):
            known = ", ".join(figures)
            raise ConfigError(f"{path}: {_at(lines, 'metrics')}{one}: no such figure; has {known}")
    return tuple(name for name in found if name in own or any(_is_meant(name, one) for one in wanted))


def _is_meant(column: str, wanted: str) -> bool:
    return column == wanted or column.endswith(f"_{wanted}")


def _check(plan: Plan, c: Campaign, path: Path, lines: Lines) -> None:
    """Make sure that every combination has a configuration, and that distributions lead to none that is not.

    Raises:
        ConfigError: one does not.
        DatabaseError: the frames do not go with it.
    """
    for number, found in _firsts(plan):
        config, _ = plan.config_of(number)
        try:
            unit.prepared(config, found).loaded()
        except (ConfigError, DatabaseError) as e:
            raise type(e)(f"{path}: {_where(c, str(e), lines)}{e}") from None


def _where(c: Campaign, text: str, lines: Lines) -> str:
    """Where the parameter stands whose keys an error is about; "" where there is none."""
    for name, p in c.parameters.items():
        if any(key in text for key in p.keys or (name,)):
            return f"{lines.parameter(name)}: "
    return ""


def _firsts(plan: Plan) -> Iterator[tuple[int, dict[str, Any]]]:
    """The first run of each combination, up to a few, with what it draws."""
    for number in range(min(plan.combinations, MOST_CHECKED)):
        config, _ = plan.config_of(number)
        yield number, drawn(config["spread"], plan.seed_of(number))
