"""The whole daemon in seeded simulation: the same seed does the same, faults are found, and shrunk."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("greenlet")

from pneud.prove.plan import Plan, plan_of
from pneud.prove.run import Bench, shrunk


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    yield Bench(tmp_path_factory.mktemp("prove"))


def prove(*args: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pneud.cli", "prove", *args],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, **environ},
    )


def short(seed: int, length_s: float = 1.0) -> Plan:
    return plan_of(seed)._replace(length_s=length_s)


def test_a_seed_is_the_same_again_to_the_last_byte(bench: Bench) -> None:
    one, again = bench.run(short(3)), bench.run(short(3))
    assert one.trace == again.trace
    assert one.digest == again.digest
    assert one.ticks > 100


@pytest.mark.slow
def test_another_process_makes_the_same_of_a_seed(tmp_path: Path) -> None:
    found = [
        json.loads(prove("--seed", "5", "--json", PYTHONHASHSEED=hashing).stdout) for hashing in ("1", "2")
    ]
    assert found[0]["digest"] == found[1]["digest"]
    assert found[0]["steps"] == found[1]["steps"]


@pytest.mark.slow
def test_two_hundred_seeds_find_nothing(bench: Bench) -> None:
    for seed in range(200):
        outcome = bench.run(plan_of(seed))
        assert not outcome.found, f"{outcome.found[0]}; pneud prove --seed {seed}"
