"""Verification as a judge: gains that are beyond their limits on the rig give way to slower ones."""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.loading import load
from pneud.study import fastest
from pneud.study.commissioning import page, procedure, trying
from pneud.study.commissioning.gains import Chosen, slower
from pneud.study.commissioning.playing import Played
from pneud.study.commissioning.procedure import NO_BETTER, Outcome
from pneud.study.commissioning.verification import Verified
from pneud.study.judging import Figure

BEFORE, CHOSEN = "as it was", 228.0
LOOP, STOPPED = Verified((), "a fault", ("tracking_error",)), Verified((), "stopped")


def worth(step: float, sine: float = 0.5) -> Verified:
    """An axis whose steps and sine take so much of their limits."""
    return Verified((Figure("sine", "rms_m", sine, 1.0), Figure("1 mm", "overshoot_m", step, 1.0)))


class Gains(NamedTuple):
    """What was found, as far as it is asked for."""

    chosen: Chosen | None
    believed: Any = None
    changes: tuple[Any, ...] = ()
    cautions: list[str] = []  # noqa: RUF012 - nobody changes it

    @property
    def text(self) -> str:
        return "plain" if self.chosen is None else f"{self.chosen.bandwidth_rad_s:g}"

    def with_gains(self, chosen: Chosen) -> Gains:
        return self._replace(chosen=chosen)


class Loaded(NamedTuple):
    text: str


class Bench:
    """A rig on which verifications come to what is given; each takes some of the time."""

    tries = True

    def __init__(self, axis_s: float = 0.0) -> None:
        self.loaded, self.axis_s = Loaded(BEFORE), axis_s
        self.put: list[str] = []

    def adopt(self, text: str, keep: bool) -> None:
        assert keep
        self.loaded = Loaded(text)

    def put_back(self, text: str) -> str:
        self.put.append(text)
        self.loaded = Loaded(text)
        return "pneud restart"


class Quiet:
    """Somebody who listens."""

    def __init__(self, agrees: bool = False) -> None:
        self.said: list[str] = []
        self._agrees = agrees

    def say(self, words: str) -> None:
        self.said.append(words)

    def agreed(self, changes: list[Any]) -> bool:
        assert self._agrees, "nobody is asked twice"
        return True


def gains_for(omega_rad_s: float) -> Chosen:
    return Chosen(None, omega_rad_s, (), ())  # type: ignore[arg-type]


def settled(
    came_to: list[Verified], before: Verified | None, axis_s: float = 0.0, dynamic: bool = True
) -> tuple[Outcome, str, Quiet]:
    """What a commissioning comes to, what the rig runs with in the end, and what was said."""
    found = Gains(gains_for(CHOSEN) if dynamic else None)
    so_far = Outcome("identified", found=found, before=before)  # type: ignore[arg-type]
    bench, talk, left = Bench(axis_s), Quiet(), list(came_to)

    def verified(bench: Bench, _talk: Quiet) -> Verified:
        bench.axis_s += 45.0
        return left.pop(0) if left else worth(9.0)

    def next_one(_: Any, chosen: Chosen) -> Chosen | None:
        assert chosen.bandwidth_rad_s is not None
        omega_rad_s = chosen.bandwidth_rad_s / 2.0
        return gains_for(omega_rad_s) if omega_rad_s > 20.0 else None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(procedure, "_verified", verified)
        patch.setattr("pneud.study.commissioning.gains.slower", next_one)
        outcome = procedure._settled(bench, so_far, True, talk)  # type: ignore[arg-type]
    return outcome, bench.loaded.text, talk


@pytest.mark.parametrize(
    ("came_to", "verdict", "text", "tries"),
    [
        ([worth(0.5)], "passed", "228", 1),
        ([worth(2.0), worth(0.9)], "passed", "114", 2),
        ([worth(3.0), worth(2.0), worth(2.5)], "missed", "114", 3),
        ([worth(2.0), worth(3.0)], "missed", "228", 2),
        ([LOOP, worth(0.5)], "passed", "114", 2),
        ([worth(2.0), LOOP, worth(0.5)], "missed", "228", 2),
        ([LOOP, worth(2.0), worth(1.5), worth(1.2)], "missed", "28.5", 4),
        ([LOOP, LOOP, worth(0.5)], "passed", "57", 3),
        ([LOOP, LOOP, LOOP, LOOP], "worse", BEFORE, 4),
        ([worth(2.0, sine=4.8), worth(2.0, sine=5.2)], "worse", BEFORE, 2),
        ([worth(2.0, sine=4.2), worth(2.0, sine=5.2)], "missed", "228", 2),
        ([STOPPED], "interrupted", "228", 1),
        ([worth(2.0), STOPPED], "interrupted", "114", 2),
        ([Verified((), "a fault", ("tracking_error", "supply_pressure"))], "interrupted", "228", 1),
    ],
)
def test_gains_step_down_as_long_as_that_helps(
    came_to: list[Verified], verdict: str, text: str, tries: int
) -> None:
    outcome, runs, talk = settled(came_to, Verified((Figure("sine", "rms_m", 1.5, 1.0),)))
    assert (outcome.verdict, runs, len(outcome.tried)) == (verdict, text, tries)
    assert outcome.after in came_to
    assert outcome.good is (verdict == "passed")
    assert outcome.written is (verdict in ("passed", "missed"))
    assert outcome.warnings == ([NO_BETTER] if verdict == "worse" else [])
    assert outcome.failure == (outcome.after.failure if outcome.after else "")
    assert len(talk.said) == tries - 1


@pytest.mark.parametrize(
    "came_to",
    [
        [STOPPED],
        [worth(0.5), STOPPED],
        [worth(0.5), worth(2.0), STOPPED],
        [worth(0.5), worth(2.0), KeyboardInterrupt()],
    ],
    ids=["before", "first try", "second try", "Ctrl-C"],
)
def test_what_is_interrupted_leaves_all_as_it_was(
    came_to: list[Verified | KeyboardInterrupt], monkeypatch: pytest.MonkeyPatch
) -> None:
    def verified(*_: object) -> Verified:
        one = came_to.pop(0)
        if isinstance(one, KeyboardInterrupt):
            raise one
        return one

    def stepped(bench: Bench, *_: object) -> Played:
        bench.adopt("with other edges", True)
        return Played()

    monkeypatch.setattr(procedure, "_stepped", stepped)
    monkeypatch.setattr(procedure, "_verified", verified)
    monkeypatch.setattr(procedure, "_found", lambda *_: Gains(gains_for(CHOSEN)))
    monkeypatch.setattr("pneud.study.commissioning.gains.slower", lambda *_: gains_for(114.0))
    bench, talk = Bench(), Quiet(agrees=True)
    with contextlib.suppress(KeyboardInterrupt):
        outcome = procedure.commission(bench, procedure.Wishes(movement=False), talk)  # type: ignore[arg-type]
        assert (outcome.verdict, outcome.failure, outcome.written) == ("interrupted", "stopped", False)
    assert not came_to
    assert (bench.loaded.text, bench.put) == (BEFORE, [BEFORE])
    assert talk.said[-1] == "the configuration is as it was; pneud restart"


def test_there_is_no_more_motion_than_five_minutes() -> None:
    outcome, _, _ = settled([worth(9.0 - i) for i in range(4)], None, axis_s=160.0)
    assert len(outcome.tried) == 2


def test_gains_of_which_nothing_was_found_out_stay() -> None:
    outcome, runs, _ = settled([worth(3.0)], None, dynamic=False)
    assert (outcome.verdict, runs, len(outcome.tried)) == ("missed", "plain", 1)
    assert settled([LOOP], None, dynamic=False)[1] == BEFORE


WORTH = st.one_of(
    st.just(LOOP), st.builds(worth, st.floats(0.1, 20.0), st.floats(0.1, 20.0)), st.just(STOPPED)
)


@given(st.lists(WORTH, min_size=1, max_size=5), st.one_of(st.none(), WORTH))
@settings(max_examples=30, deadline=None)
def test_an_axis_is_never_left_with_what_has_proven_worse(
    came_to: list[Verified], before: Verified | None
) -> None:
    outcome, runs, _ = settled(came_to, before)
    assert outcome.after is not None
    if outcome.verdict == "interrupted":
        assert outcome.after == STOPPED
        return
    assert all(outcome.after.failure == "" or one.after.failure for one in outcome.tried)
    assert trying.excess(outcome.after) == min(
        trying.excess(one.after)
        for one in outcome.tried
        if bool(one.after.failure) is bool(outcome.after.failure)
    )
    assert (runs == BEFORE) is trying.is_worse(outcome.after, before) is (outcome.verdict == "worse")


def test_what_was_tried_is_told_where_it_was_more_than_one() -> None:
    outcome, _, _ = settled([LOOP, worth(2.0), worth(3.0)], None)
    assert page.tried(outcome.tried) == [
        "tried on the rig: gains for 228 rad/s: ended by tracking_error",
        "tried on the rig: gains for 114 rad/s: 1 of 2 figures missed",
        "tried on the rig: gains for 57 rad/s: 1 of 2 figures missed",
    ]
    assert [one.as_json()["bandwidth_rad_s"] for one in outcome.tried] == [228.0, 114.0, 57.0]
    assert page.tried(outcome.tried[:1]) == []


@pytest.mark.parametrize("law", ["composite", "pid"])
def test_slower_gains_come_to_an_end(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fastest, "SLOWEST_RAD_S", 30.0)
    c = load("virtual.toml", None, {"control": {"law": law}}).config
    chosen: Chosen | None = Chosen(c, None, (), ())
    bandwidths = []
    while chosen is not None and (chosen := slower(c, chosen)) is not None:
        assert chosen.bandwidth_rad_s is not None
        assert chosen.config.reference == c.reference
        assert chosen.config.control.law == law
        assert all(name.startswith("control.") for name in chosen.values(c))
        bandwidths.append(chosen.bandwidth_rad_s)
    assert bandwidths == sorted(bandwidths, reverse=True)
    assert bandwidths[0] < 200.0
    assert fastest.SLOWEST_RAD_S <= bandwidths[-1] < fastest.RATIO * fastest.SLOWEST_RAD_S
