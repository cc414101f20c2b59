"""A campaign as it stands in its file, checked as configurations are: errors with line and cure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator

from pneud.campaign.draws import LAWS
from pneud.campaign.parts import AnyPart
from pneud.config.places import line_of
from pneud.config.reading import explain, text_of
from pneud.config.sections import ConfigError, Positive, Section
from pneud.config.toml import TomlError, tables_of

Value = float | int | bool | str
Two = tuple[float, float]
MOST_RUNS = 1 << 32
STATISTIC = r"^(mean|max|p[1-9][0-9]?)$"  # over the runs of a trial
NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"


def _rising(bounds: Two | None) -> Two | None:
    if bounds is not None and not bounds[0] < bounds[1]:
        raise ValueError(f"{bounds[0]:g} … {bounds[1]:g}: must rise")
    return bounds


class Parameter(Section):
    """What one thing is in a run: every value of a list in turn, or drawn anew for each run."""

    each: Annotated[tuple[Value, ...], Field(min_length=1)] | None = None
    uniform: Annotated[Two | None, AfterValidator(_rising)] = None
    loguniform: Annotated[tuple[Positive, Positive] | None, AfterValidator(_rising)] = None
    normal: tuple[float, Positive] | None = None  # mean and standard deviation
    within: Annotated[Two | None, AfterValidator(_rising)] = None  # of a normal one: no further
    choice: Annotated[tuple[Value, ...], Field(min_length=1)] | None = None
    weights: tuple[Positive, ...] | None = None  # of a choice
    times: bool = False  # the value is that times what is configured
    keys: tuple[str, ...] = ()  # whose value it is; of one without, its name is the key

    @model_validator(mode="after")
    def _one_law(self) -> Parameter:
        given = [name for name in ("each", *LAWS) if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of each, {', '.join(LAWS)}; has {', '.join(given) or 'none'}")
        if self.within is not None and self.normal is None:
            raise ValueError("within belongs to normal")
        if self.weights is not None and (self.choice is None or len(self.weights) != len(self.choice)):
            raise ValueError("weights belong to choice, one for each value")
        if self.times and any(isinstance(x, str | bool) for x in self.each or self.choice or ()):
            raise ValueError("times takes numbers")
        return self

    @property
    def law(self) -> dict[str, Any]:
        """As `unit.config` takes it."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in self.model_dump(exclude_defaults=True).items()
        }


class Tune(Section):
    """What is looked for: values that make figures small, over all runs together."""

    objectives: Annotated[dict[str, Annotated[str, Field(pattern=STATISTIC)]], Field(min_length=1)]
    parameters: Annotated[dict[str, Parameter], Field(min_length=1)]
    runs: Annotated[int | None, Field(ge=1, le=100_000)] = None  # draws of a trial; those of the file without

    @model_validator(mode="after")
    def _can_be_sought(self) -> Tune:
        for name, p in self.parameters.items():
            if p.normal is not None or p.each is not None or p.weights is not None:
                raise ValueError(f"{name}: is sought in uniform, loguniform, or a choice")
        return self


def _as_table(value: Any) -> Any:
    """A list is each of its values in turn, a value alone is that."""
    if isinstance(value, list):
        return {"each": value}
    return {"each": [value]} if isinstance(value, Value) else value


def _as_tuple(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


class Campaign(Section):
    """The file."""

    schema_: Annotated[Literal[1], Field(alias="schema")]
    name: Annotated[str, Field(pattern=NAME)] = ""
    config: Annotated[tuple[str, ...], BeforeValidator(_as_tuple), Field(min_length=1)] = ("virtual.toml",)
    axis: str | None = None
    by: Literal["law", "axis"] = "law"
    scenarios: tuple[str, ...] = ()
    runs: Annotated[int, Field(ge=1, lt=MOST_RUNS)] = 100  # draws, of every combination
    seed: Annotated[int, Field(ge=0, lt=1 << 31)] = 1
    play: tuple[AnyPart, ...] = ()
    parameters: dict[str, Annotated[Parameter, BeforeValidator(_as_table)]] = Field(default_factory=dict)
    metrics: tuple[str, ...] = ()  # columns or ends of columns that are kept; all without
    tune: Tune | None = None
    worst: str = ""  # column by which runs are looked at, the greatest first; the first figure without

    @model_validator(mode="after")
    def _fits_together(self) -> Campaign:
        if self.scenarios and self.by != "axis":
            raise ValueError('scenarios need the whole axis: by = "axis"')
        if self.scenarios and self.play:
            raise ValueError("scenarios are played along the sine alone: leave out play")
        return self

    @property
    def combinations(self) -> int:
        """Of configurations, scenarios and all lists."""
        lists = [len(p.each) for p in self.parameters.values() if p.each is not None]
        return len(self.config) * max(1, len(self.scenarios)) * math.prod(lists)


def load_campaign(file: str | Path) -> tuple[Campaign, str, Path]:
    """A campaign, the text of its file, and where it was found.

    Raises:
        ConfigError: it is missing, unreadable or wrong.
    """
    text, path = text_of(file)
    try:
        tables = tables_of(text)
    except TomlError as e:
        raise ConfigError(f"{path}: {e}") from None
    try:
        found = Campaign.model_validate({"name": path.stem, **tables})
    except ValidationError as e:
        raise ConfigError(f"{path}: {explain(e, Lines(text).of, Campaign)}") from None
    if found.combinations * found.runs >= MOST_RUNS:
        raise ConfigError(f"{path}: {found.combinations} combinations of {found.runs} runs are too many")
    return found, text, path


class Lines:
    """On which lines of a campaign's file its parameters stand, whose names have dots."""

    def __init__(self, text: str) -> None:
        self._text = text

    def of(self, where: Sequence[str]) -> int:
        """The line of a key, 0 where it is not known."""
        return line_of(self._text, list(_split(where)))

    def parameter(self, name: str) -> str:
        """Where a parameter stands, as errors begin: "line 7: parameters.NAME"."""
        line = self.of(("parameters", name))
        return f"line {line}: parameters.{name}" if line else f"parameters.{name}"


def _split(where: Iterable[str]) -> Iterable[str]:
    for part in where:
        yield from part.split(".")
