"""All pages that are made from the code: `python -m generators.pages` in `docs` writes them."""

from __future__ import annotations

from pathlib import Path

from generators import cli, configuration, firmware, frames, log, protocol, safety

FOLDER = Path(__file__).parent.parent
MADE = {
    "cli.md": cli.text,
    "configuration.md": configuration.text,
    "firmware.md": firmware.text,
    "frames.md": frames.text,
    "log.md": log.text,
    "protocol.md": protocol.text,
    "safety.md": safety.text,
}

if __name__ == "__main__":
    for name, text in MADE.items():
        (FOLDER / name).write_text(text(), encoding="utf-8")
