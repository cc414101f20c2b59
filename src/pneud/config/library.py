"""Valves and cylinders as one buys them: of `configs/library`, or by the figures of their sheets."""

import math
from typing import Annotated, Any, Self, TypeVar

from pydantic import Field, ValidationError, model_validator

from pneud import resources
from pneud.config.flow import L_MIN, L_S_BAR
from pneud.config.reading import explain
from pneud.config.sections import ConfigError, CriticalRatio, Damping, DeadZone, Positive, Section
from pneud.config.toml import tables_of
from pneud.physics import ratings

RODLESS_FRICTION, ROD_FRICTION = 0.08, 0.06  # typical parts of the piston's force


class ValveSheet(Section):
    """A valve as its sheet rates it."""

    title: str
    source: str
    nominal_flow_l_min: Positive | None = None
    sonic_conductance_l_s_bar: Positive | None = None
    critical_ratio: CriticalRatio = ratings.TYPICAL_CRITICAL_RATIO
    bandwidth_hz: Positive = 100.0  # typical
    damping: Damping = 0.7  # typical
    dead_zone_v: DeadZone = 0.1  # typical

    @model_validator(mode="after")
    def _one_rating(self) -> Self:
        if (self.nominal_flow_l_min is None) == (self.sonic_conductance_l_s_bar is None):
            raise ValueError("give either nominal_flow_l_min or sonic_conductance_l_s_bar")
        return self

    @property
    def conductance(self) -> float:
        """Sonic conductance [m³/(s Pa)]."""
        if self.sonic_conductance_l_s_bar is not None:
            return self.sonic_conductance_l_s_bar * L_S_BAR
        assert self.nominal_flow_l_min is not None
        return ratings.conductance_of_flow(self.nominal_flow_l_min * L_MIN, self.critical_ratio)

    @property
    def flow_l_min(self) -> float:
        """Nominal flow [l/min ANR]."""
        return ratings.nominal_flow(self.conductance, self.critical_ratio) / L_MIN

    @property
    def size(self) -> str:
        """In words."""
        return f"{self.flow_l_min:.4g} l/min"


class CylinderSheet(Section):
    """A cylinder as its sheet has it."""

    title: str
    source: str
    bore_mm: Annotated[float, Field(ge=4, le=400)]
    rod_mm: Annotated[float, Field(ge=0)] = 0.0  # 0: rodless
    friction: Annotated[float, Field(gt=0, lt=0.5)]  # typical part of the piston's force

    @model_validator(mode="after")
    def _rod_within_bore(self) -> Self:
        if self.rod_mm >= self.bore_mm:
            raise ValueError("the rod must be thinner than the bore")
        return self

    @property
    def areas_m2(self) -> tuple[float, float]:
        """Of the piston, at the cap end and at the rod end [m²]."""
        bore_m2 = 0.25e-6 * math.pi * self.bore_mm**2
        return bore_m2, bore_m2 - 0.25e-6 * math.pi * self.rod_mm**2

    @property
    def size(self) -> str:
        """In words."""
        return f"{self.bore_mm:g}/{self.rod_mm:g}" if self.rod_mm else f"{self.bore_mm:g} rodless"


S = TypeVar("S", bound=Section)
VALVES, CYLINDERS = "valves.toml", "cylinders.toml"
FORMS = {
    VALVES: "a flow in l/min (350), kv=0.3, cv=0.35, c=1.4 or c=1.4,b=0.25",
    CYLINDERS: "bore/rod in mm (32/12), or the bore of a rodless one (32)",
}  # in which one may describe what is not in the library


def names(file: str) -> list[str]:
    """What stands in a file of the library."""
    return list(_tables(file))


def choices(file: str) -> str:
    """The same, each with its size, and how to describe another; for somebody who has to choose."""
    sheet: type[ValveSheet | CylinderSheet] = ValveSheet if file == VALVES else CylinderSheet
    sizes = {name: sheet.model_validate(table).size for name, table in _tables(file).items()}
    return f"{', '.join(f'{name} ({size})' for name, size in sizes.items())}; or {FORMS[file]}"


def valve(text: str) -> ValveSheet:
    """A valve of the library by its name, or one by a rating of its sheet.

    Raises:
        ConfigError: neither.
    """
    text = _plain(text)
    if (table := _tables(VALVES).get(text)) is not None:
        return ValveSheet.model_validate(table)
    own: dict[str, Any] = {"title": f"valve of {text}", "source": "as given"}
    parts = [part.partition("=")[::2] for part in text.split(",")]
    given = {key if value else "flow": _number(value or key) for key, value in parts}
    if given.keys() == {"flow"}:
        own["nominal_flow_l_min"] = given["flow"]
    elif given.keys() == {"kv"}:
        own["nominal_flow_l_min"] = ratings.flow_of_kv(given["kv"]) / L_MIN
    elif given.keys() == {"cv"}:
        own["nominal_flow_l_min"] = ratings.flow_of_kv(ratings.KV_OF_CV * given["cv"]) / L_MIN
    elif given.keys() in ({"c"}, {"c", "b"}):
        own["sonic_conductance_l_s_bar"] = given.pop("c")
        if "b" in given:
            own["critical_ratio"] = given["b"]
    return _sheet(ValveSheet, VALVES, text, own)


def cylinder(text: str) -> CylinderSheet:
    """A cylinder of the library by its name, or one by bore and rod [mm].

    Raises:
        ConfigError: neither.
    """
    text = _plain(text)
    if (table := _tables(CYLINDERS).get(text)) is not None:
        return CylinderSheet.model_validate(table)
    bore, slash, rod = text.partition("/")
    own = {
        "title": f"bore {bore} mm, {f'rod {rod} mm' if rod else 'rodless'}",
        "source": "as given",
        "bore_mm": _number(bore),
        "rod_mm": _number(rod) if slash else 0.0,
        "friction": ROD_FRICTION if rod else RODLESS_FRICTION,
    }
    return _sheet(CylinderSheet, CYLINDERS, text, own)


def _tables(file: str) -> dict[str, Any]:
    return tables_of((resources.configs() / "library" / file).read_text(encoding="utf-8"))


def _plain(text: str) -> str:
    """Without spaces and ends of lines: it may stand in a comment."""
    return "".join(text.split()).lower()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _sheet(sheet: type[S], file: str, text: str, own: dict[str, Any]) -> S:
    numbers = [value for value in own.values() if isinstance(value, float)]
    if not numbers or not all(map(math.isfinite, numbers)):
        raise ConfigError(f"{text!r}: none of {', '.join(names(file))}, nor {FORMS[file]}")
    try:
        return sheet.model_validate(own)
    except ValidationError as e:
        raise ConfigError(f"{text!r}: {explain(e)}") from None
