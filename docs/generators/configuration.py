"""docs/configuration.md: every key of a configuration with its unit, bounds, default and meaning.

    python docs/generators/configuration.py > docs/configuration.md

Units are the ends of the names, bounds and defaults those of the models, meanings the comments behind
the keys.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from pneud.config.bus_tables import FrameConfig, FramesConfig
from pneud.config.mapping import MessageConfig, SignalConfig, SignalsConfig
from pneud.config.models import Config
from pneud.config.sections import Section

HEAD = """\
# Keys of a configuration

<!-- Made by docs/generators/configuration.py; do not edit. `make pages` makes it anew. -->

A configuration is one TOML file. Unknown keys are errors; `pneud check FILE` names the line. Units are part
of the names, all SI; pressures are absolute. A key that is required has to be given where its table is.
"""
UNITS = (
    *(
        ("_per_m", "1/m"),
        ("m_per_count", "m"),
        ("_n_s_m", "N s/m"),
        ("_n_s2", "N/s²"),
        ("_n_rs", "N/√s"),
        ("_j_kg_k", "J/(kg K)"),
        ("_n_m", "N/m"),
    ),
    *(("_rad_s", "rad/s"), ("_bit_s", "bit/s"), ("_m_s3", "m/s³"), ("_m_s2", "m/s²"), ("_m_s", "m/s")),
    *(
        ("_v_s", "V/s"),
        ("_m2", "m²"),
        ("_m", "m"),
        ("_kg", "kg"),
        ("_pa", "Pa"),
        ("_hz", "Hz"),
        ("_ms", "ms"),
        ("_l_min", "l/min"),
        ("_l_s_bar", "l/(s bar)"),
        ("_m3_h", "m³/h"),
        ("_l_min_bar", "l/(min bar)"),
        ("_m3", "m³"),
        ("_bar", "1/bar"),
    ),
    *(("_us", "µs"), ("_s", "s"), ("_n", "N"), ("_v", "V"), ("_k", "K"), ("_mb", "MB")),
)
_DICTS = {int: "whole numbers", bool: "`true`, `false`", str: "texts"}
APART = (SignalsConfig | None, dict[str, MessageConfig])  # in sections of their own
SIGNS = {Gt: ">", Ge: "≥", Lt: "<", Le: "≤"}
KEY = re.compile(r"    (\w+): .*?(?:  # (.+))?$")


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """The comment behind each key in the source of its table, or on the line that ends it."""
    found: dict[str, str] = {}
    key = ""
    if (base := model.__base__) is not None and issubclass(base, Section):
        found = meanings(base)
    for line in inspect.getsource(model).splitlines():
        if match := KEY.match(line):
            key = match.group(1)
            found[key] = match.group(2) or ""
        elif key and line.startswith("    )") and "  # " in line:
            found[key] = line.partition("  # ")[2]
        elif line.startswith("    @"):
            break
    return found


def bounds(metadata: Any) -> str:
    """The bounds among what is said of a type."""
    parts: list[str] = []
    for item in metadata:
        inner = item.metadata if isinstance(item, FieldInfo) else [item]
        parts += [
            f"{SIGNS[type(one)]} {getattr(one, type(one).__name__.lower()):g}"
            for one in inner
            if type(one) in SIGNS
        ]
    return ", ".join(parts)


def kind(annotation: Any, metadata: Any = ()) -> str:
    """What a value may be."""
    origin = get_origin(annotation)
    if origin is Annotated:
        base, *more = get_args(annotation)
        return kind(base, more)
    if origin is Literal:
        return ", ".join(
            f'`"{value}"`' if isinstance(value, str) else f"`{value}`" for value in get_args(annotation)
        )
    if origin in (Union, UnionType) and optional(annotation) is not None:
        return "table"
    if origin in (Union, UnionType):
        return " or ".join(kind(one, metadata) for one in get_args(annotation) if one is not NoneType)
    if (
        origin is tuple
        and isinstance(first := get_args(annotation)[0], type)
        and issubclass(first, BaseModel)
    ):
        return "list of tables"
    if origin is tuple:
        return f"list of: {kind(get_args(annotation)[0])}"
    if origin is dict:
        return f"table of {_DICTS.get(get_args(annotation)[1], 'signals')}"
    if annotation is SignalConfig:
        return "text, table or number"
    if annotation is bool:
        return "`true`, `false`"
    if annotation is str:
        return "text"
    limits = bounds(metadata)
    return limits or ("whole number" if annotation is int else "number")


def unit(name: str) -> str:
    """The unit that a name ends with."""
    return next((text for end, text in UNITS if name.endswith(end)), "")


def default(field: FieldInfo) -> str:
    """The default as it would stand in the file; empty for none."""
    if field.is_required():
        return "**required**"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return "–"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`".replace("()", "[]")


def tables(model: type[BaseModel], path: str = "") -> Iterator[str]:
    """A section for each table, in the order of the models."""
    said = meanings(model)
    plain = [(n, f) for n, f in model.model_fields.items() if not is_table(f) and f.annotation not in APART]
    path, lists = path.strip("[]"), path.startswith("[")
    if plain:
        shown = f"[[{path}]]" if lists else f"[{path}]"
        yield f"\n## {f'`{shown}`' if path else 'At the top'}\n"
        yield f"{inspect.getdoc(model)}\n"
        yield "| key | value | unit | default | |\n|---|---|---|---|---|"
        for name, field in plain:
            cells = (kind(field.annotation, field.metadata), unit(name), default(field), said.get(name, ""))
            yield f"| `{field.alias or name}` | {' | '.join(cells)} |"
    for name, field in model.model_fields.items():
        if field.annotation is FrameConfig:
            continue
        if is_table(field):
            assert isinstance(field.annotation, type)
            yield from tables(field.annotation, f"{path}.{name}" if path else name)
            if field.annotation is FramesConfig:
                yield from frames()
                yield from tables(SignalsConfig, "bus.signals")
                yield from tables(SignalConfig, "bus.signals.VALUE")
                yield from tables(MessageConfig, "bus.messages.MESSAGE")
        elif field.annotation not in APART and (inner := optional(field.annotation)) is not None:
            yield from tables(inner, f"{path}.{name}" if path else name)
        elif (inner := listed(field)) is not None:
            yield from tables(inner, f"[{path}.{name}]" if path else f"[{name}]")


def frames() -> Iterator[str]:
    """One section for the roles that messages play, and what each is by default."""
    yield from tables(FrameConfig, "bus.frames.ROLE")
    yield "\n| role | default message | default signals |\n|---|---|---|"
    for role, frame in FramesConfig():
        signals = ", ".join(f"{name} = `{signal}`" for name, signal in frame.signals.items())
        yield f"| `{role}` | `{frame.message}` | {signals or '–'} |"


def listed(field: FieldInfo) -> type[BaseModel] | None:
    """The model of a key that is a list of tables."""
    of = get_args(field.annotation)
    found = of[0] if get_origin(field.annotation) is tuple and of else None
    return found if isinstance(found, type) and issubclass(found, BaseModel) else None


def optional(annotation: Any) -> type[BaseModel] | None:
    """The model of a table that may be left out."""
    models = [of for of in get_args(annotation) if isinstance(of, type) and issubclass(of, BaseModel)]
    one = len(get_args(annotation)) == 2 and NoneType in get_args(annotation)
    return models[0] if one and models and models[0] is not SignalConfig else None


def is_table(field: FieldInfo) -> bool:
    """Whether a key has a table of its own."""
    kind = field.annotation
    return isinstance(kind, type) and issubclass(kind, BaseModel) and kind is not SignalConfig


def text() -> str:
    """The page."""
    return HEAD + "\n".join(tables(Config)) + "\n"


if __name__ == "__main__":
    print(text(), end="")
