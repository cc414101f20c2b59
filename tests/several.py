"""Axes on one bus, as many as a test wants."""

from __future__ import annotations

import shutil
from pathlib import Path

from pneud import resources
from pneud.loading import Together, load_axes

FOLDER = resources.configs() / "axes"
TEXT = (FOLDER / "two-axes.toml").read_text()
SHARED = TEXT[: TEXT.index("\n[[axis]]")]
ROLES = ("encoder", "pressure", "valve_status", "valve_command")


def text_of(axes: int, rate_hz: float = 500.0, others: str = "") -> str:
    """A file with axes a1, a2, …, all alike."""
    text = SHARED.replace("rate_hz = 500.0", f"rate_hz = {rate_hz}")
    text = text[: text.index("[faults.others]")] + (f"[faults.others]\n{others}\n" if others else "")
    for k in range(axes):
        text += f'\n[[axis]]\nname = "a{k + 1}"\n'
        for n, role in enumerate(ROLES if k else ()):
            node = f", node = {3 * k + n + 1}" if n < 3 else ""
            text += f'bus.frames.{role} = {{ message = "{role.upper()}_{k + 1}"{node} }}\n'
    return text


def several(folder: Path, axes: int, rate_hz: float = 500.0, others: str = "") -> Together:
    """Axes of such a file."""
    shutil.copy(FOLDER / "axes.dbc", folder)
    file = folder / "several.toml"
    file.write_text(text_of(axes, rate_hz, others))
    return load_axes(file)
