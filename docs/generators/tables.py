"""What the generated pages have in common."""

from __future__ import annotations

from collections.abc import Sequence

HEAD = """<!-- Made by docs/generators/{name}.py; do not edit. `make pages` makes it anew. -->"""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of Markdown."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
