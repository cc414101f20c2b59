"""What takes long to make, and several tests look at: made once, by whichever of pytest's workers."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

T = TypeVar("T")


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """What the first worker has made that wanted it; the others wait for it.

    Args:
        factory: of the temporary folders of this session.
        name: of it, among all that are made in this way.
        make: called with a folder of its own; returns what pickle can carry.
    """
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"shared-{name}"
    folder.mkdir(exist_ok=True)
    made = folder / "made.pickle"
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            found = make(folder)
            made.write_bytes(pickle.dumps(found))
            return found
    taken: T = pickle.loads(made.read_bytes())
    return taken
