"""What an axis has done, in a few words: as an operator wants to see it at a glance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

_KM = 1e3  # metres from which on metres are too many digits
_M3 = 1e3  # likewise of litres


def in_brief(done: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Labels and texts of a status's `mileage`."""
    yield "strokes", f"{done['strokes']:,}"
    travel_m, air_l = done["travel_m"], done["air_normal_l"]
    yield "travel", f"{travel_m / _KM:,.1f} km" if travel_m >= _KM else f"{travel_m:.1f} m"
    yield "air", f"{air_l / _M3:,.1f} m³" if air_l >= _M3 else f"{air_l:.1f} l"
    hours = done["engaged_h"]
    yield "engaged", f"{hours:,.1f} h" if hours >= 1.0 else f"{60.0 * hours:.1f} min"
    yield "hardest stop", f"{done['hardest_stop_m_s2']:.3g} m/s²"


def in_words(done: Mapping[str, Any]) -> str:
    """The same as one line."""
    return ", ".join(f"{label} {text}" for label, text in in_brief(done))


def whence(done: Mapping[str, Any]) -> str:
    """Since when that counts, or why it ends with the run."""
    if done["kept"] == "kept":
        return f"since {done['since'][:10]}"
    return {
        "elsewhere": "in this run; another daemon keeps what an axis of this name does",
        "failing": "not kept: the disk does not take it",
    }.get(done["kept"], "in this run")
