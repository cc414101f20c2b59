"""What the sections of a configuration are made of: numbers with bounds, the table itself, its error."""

import os
import re
from typing import Annotated, Literal

# what other packages plug into pydantic is none of the controller's, and takes long to look for
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Pressure = Annotated[float, Field(gt=0, le=2.0e6)]
Resolution = Annotated[float, Field(ge=0, le=1e-3)]
Area = Annotated[float, Field(gt=0, le=0.2)]
Stroke = Annotated[float, Field(gt=0, le=20)]
Mass = Annotated[float, Field(gt=0, le=10_000)]
Force = Annotated[float, Field(ge=-100_000, le=100_000)]
Inclination = Annotated[float, Field(ge=-90, le=90)]
HeatRatio = Annotated[float, Field(gt=1, lt=2)]
GasConstant = Annotated[float, Field(ge=50, le=5_000)]
Temperature = Annotated[float, Field(ge=200, le=400)]
Orifice = Annotated[float, Field(gt=0, le=1e-3)]
Flow = Literal["orifice", "iso6358"]
CriticalRatio = Annotated[float, Field(gt=0, lt=0.6)]
Exponent = Annotated[float, Field(ge=0.3, le=1)]
ExhaustRatio = Annotated[float, Field(ge=0.2, le=5)]
Leakage = Annotated[float, Field(ge=0, le=0.2)]
Share = Annotated[float, Field(ge=-0.5, le=0.5)]
Offset = Annotated[float, Field(ge=-1e5, le=1e5)]
Command = Annotated[float, Field(gt=0, le=5)]
Damping = Annotated[float, Field(gt=0, le=5)]
Centre = Annotated[float, Field(gt=-2.5, lt=2.5)]
DeadZone = Annotated[float, Field(ge=0, lt=2.5)]
Timeout = Annotated[float, Field(ge=1, le=1000)]
EncoderKind = Literal["absolute", "incremental"]
MaybeInfinite = Annotated[float, Field(gt=0, allow_inf_nan=True)]

GRAVITY_M_S2 = 9.80665
STOP_M = 0.01  # limits.travel may reach so far behind the end stops


class ConfigError(Exception):
    """A configuration cannot be used; the text is one line for a person."""

    exit_code = 2


class Section(BaseModel):
    """A table of the file: unknown keys, NaN and infinity are errors, and nothing changes afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)


def check_channel(text: str) -> None:
    """Check the form of a bus name: auto, socketcan:IF or unixcan:NAME.

    Raises:
        ValueError: any other form.
    """
    kind, _, name = text.partition(":")
    ok = text == "auto" or (
        kind in ("socketcan", "unixcan") and re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.:@+-]{0,63}", name)
    )
    if not ok:
        raise ValueError(
            f"bus {text!r} is none of auto, socketcan:IF, unixcan:NAME; names are up to 64 letters, digits"
            " and signs such as _ . -"
        )
