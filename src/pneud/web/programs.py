"""The programs that a page may have an axis go through: the files of one folder, by their names alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from pneud.console.programs import tree_of
from pneud.console.records import ProgramError

SHOWN = 100


class Listed(NamedTuple):
    """A program of the folder."""

    name: str  # of its file, without the end
    title: str
    records: int
    trouble: str  # why it cannot be read; empty where it can


class Programs:
    """Those of a folder, read anew whenever somebody asks."""

    def __init__(self, folder: Path | None) -> None:
        """Nothing is read yet.

        Args:
            folder: has them; None for no programs.
        """
        self._folder = folder

    def listed(self) -> list[Listed]:
        """Those that there are, and what of them cannot be read; blocks.

        Files without records, such as points, are none.
        """
        return [found for path in self._files() if (found := _listed(path)) is not None]

    def tree(self, name: object) -> dict[str, Any]:
        """What a program says, as the console takes it; blocks.

        Args:
            name: as in the list.

        Raises:
            ProgramError: there is no such program, or it cannot be read.
        """
        for path in self._files():
            if path.stem == name:
                tree = tree_of(path)
                if not _records(tree):
                    break
                tree.setdefault("name", path.stem)
                return tree
        raise ProgramError(f"no program of that name: {name}")

    def _files(self) -> list[Path]:
        if self._folder is None:
            return []
        try:
            return sorted(self._folder.glob("*.toml"))[:SHOWN]
        except OSError:
            return []


def _listed(path: Path) -> Listed | None:
    try:
        tree = tree_of(path)
    except ProgramError as e:
        return Listed(path.stem, path.stem, 0, str(e))
    if not (records := _records(tree)):
        return None
    return Listed(path.stem, str(tree.get("name", path.stem)), records, "")


def _records(tree: dict[str, Any]) -> int:
    found = tree.get("record")
    return len(found) if isinstance(found, list) else 0
