"""Profiles made outside the loop, and what of them an axis accepts."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.console import profiles
from pneud.console.profiles import ProfileError, check, chirp, from_csv, from_samples, requests, steps
from pneud.control.profile import (
    LONGEST_S,
    MOST_PIECES,
    SHORTEST_S,
    ends_at_rest,
    extent,
    is_inside,
    is_within,
    meet,
)
from pneud.control.reference import Bounds, Septic, at, move, rest, septic
from pneud.signals import Reference, Request, RequestKind

BOUNDS = Bounds(0.5, 5.0, 100.0)
WIDE = Bounds(1e6, 1e9, 1e12)

samples = st.lists(st.tuples(st.floats(0.05, 1.0), st.floats(0.1, 0.9)), min_size=2, max_size=12)


def higher(p: Septic, at_end: bool) -> list[float]:
    """Derivatives 4 to 6."""
    c, s = p[1:], 1.0 if at_end else 0.0
    return [sum(math.perm(i, k) * c[i] * s ** (i - k) for i in range(k, 8)) / p.T**k for k in (4, 5, 6)]


@given(steps_=samples)
@settings(max_examples=50, deadline=None)
def test_a_spline_goes_through_its_samples_and_meets_in_six_derivatives(
    steps_: list[tuple[float, float]],
) -> None:
    times = [sum(dt for dt, _ in steps_[: i + 1]) for i in range(len(steps_))]
    pieces = from_samples(times, [x for _, x in steps_])
    assert len(pieces) == len(steps_) - 1
    assert at(0.0, pieces[0]) == pytest.approx(rest(steps_[0][1]), abs=1e-12)
    assert ends_at_rest(tuple(pieces))
    for p, (_, x) in zip(pieces, steps_[1:], strict=True):
        assert at(p.T, p).position_m == pytest.approx(x, abs=1e-9)
    for p, q in pairwise(pieces):
        assert meet(p, q)
        size = max(sum(map(abs, r[1:])) * 5040 / r.T**6 for r in (p, q))
        assert higher(p, True) == pytest.approx(higher(q, False), abs=1e-9 * size)


def test_a_spline_through_a_smooth_motion_is_that_motion() -> None:
    way = move(rest(0.3), 0.6, BOUNDS)
    times = [i * way.T / 100 for i in range(101)]

    def wanted(t: float) -> Reference:
        for p in way.pieces:
            if t <= p.T:
                return at(t, p)
            t -= p.T
        return rest(0.6)

    pieces = from_samples(times, [wanted(t).position_m for t in times])
    check(pieces, Bounds(0.51, 5.1, 120.0), 0.3 - 1e-6, 0.6 + 1e-6)
    for i, p in enumerate(pieces):
        middle, true = at(0.5 * p.T, p), wanted(times[i] + 0.5 * p.T)
        assert middle.position_m == pytest.approx(true.position_m, abs=1e-6)


@pytest.mark.parametrize(
    ("times", "positions", "words"),
    [
        ([0.0, 1.0], [0.5], "2 times but 1 positions"),
        ([0.0], [0.5], "1 samples; a profile has 2 to"),
        ([0.0] * (MOST_PIECES + 2), [0.5] * (MOST_PIECES + 2), "4098 samples"),
        ([0.0, 1.0, 1.0], [0.5, 0.5, 0.5], "sample 3: t = 1 s must be"),
        ([0.0, 2.0, 1.0], [0.5, 0.5, 0.5], "sample 3: t = 1 s must be"),
        ([0.0, 2.0 * LONGEST_S], [0.5, 0.5], "sample 2: t = .* s after the one before it"),
        ([0.0, math.nan], [0.5, 0.5], "sample 2 is no finite number: t = nan s"),
        ([0.0, 1.0], [0.5, math.inf], "sample 2 is no finite number: t = 1 s, x = inf m"),
    ],
)
def test_samples_that_make_no_profile_are_refused_in_one_line(
    times: list[float], positions: list[float], words: str
) -> None:
    with pytest.raises(ProfileError, match=words):
        from_samples(times, positions)


def test_samples_are_as_far_apart_as_a_piece_is_long() -> None:
    assert [piece.T for piece in from_samples([0.0, LONGEST_S], [0.5, 0.5])] == [LONGEST_S]
    assert [piece.T for piece in from_samples([0.0, SHORTEST_S], [0.5, 0.5])] == [SHORTEST_S]


@pytest.mark.parametrize(
    ("text", "positions"),
    [
        ("0,100\n1,200\n", (0.1, 0.2)),
        ("t_s,x_mm\n0, 100\n\n1, 200\n", (0.1, 0.2)),
        ("\ufefft_s, x_m\n0,0.1\n1,0.2\n", (0.1, 0.2)),
    ],
)
def test_a_csv_file_is_read(tmp_path: Path, text: str, positions: tuple[float, float]) -> None:
    file = tmp_path / "p.csv"
    file.write_text(text, encoding="utf-8")
    (piece,) = from_csv(file)
    assert (at(0.0, piece).position_m, at(1.0, piece).position_m) == pytest.approx(positions)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read: No such file"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"", "0 samples"),
        (b"time,x\n0,1\n", "columns are time, x; expected t_s, x_mm"),
        (b"0,1\n1,abc\n", "line 2 is no pair of numbers: 1,abc"),
        (b"0,1\n1,2,3\n", "line 2 is no pair of numbers"),
        (b"0,1\n0,2\n", "sample 2: t = 0 s"),
    ],
)
def test_a_csv_file_that_is_none_is_refused_in_one_line(
    tmp_path: Path, text: bytes | None, words: str
) -> None:
    file = tmp_path / "p.csv"
    if text is not None:
        file.write_bytes(text)
    with pytest.raises(ProfileError, match=words) as caught:
        from_csv(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_chirp_is_one_from_rest_to_rest() -> None:
    pieces = chirp(0.5, 0.01, 0.5, 3.0, 8.0)
    check(pieces, BOUNDS, 0.48999, 0.51001)
    for p, q in pairwise(pieces):
        assert meet(p, q)
    t, low, high = 0.0, 1.0, 0.0
    for p in pieces:
        for i in range(5):
            now = t + p.T * i / 4
            angle = 2.0 * math.pi * (0.5 * now + 0.5 * 2.5 / 8.0 * now * now)
            if 2.0 <= now <= 8.0 - 1.0 / 3.0:
                x = at(p.T * i / 4, p).position_m
                low, high = min(low, x), max(high, x)
                assert x == pytest.approx(0.5 + 0.01 * math.sin(angle), abs=1e-8)
        t += p.T
    assert (t, low, high) == pytest.approx((8.0, 0.49, 0.51), abs=2e-4)
    assert at(0.0, pieces[0]) == pytest.approx(rest(0.5), abs=1e-12)
    assert ends_at_rest(tuple(pieces))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"amplitude_m": 0.0}, "amplitude = 0 must be positive"),
        ({"from_hz": -1.0}, "frequency = -1 must be positive"),
        ({"to_hz": math.nan}, "must be"),
        ({"duration_s": math.inf}, "duration = inf must be positive"),
        ({"centre_m": math.inf}, "must be finite"),
        ({"duration_s": 1e4}, "too long"),
        ({"duration_s": 1.0}, "too short"),
    ],
)
def test_a_chirp_that_cannot_be_is_refused(changed: dict[str, float], words: str) -> None:
    given_ = {"centre_m": 0.5, "amplitude_m": 0.02, "from_hz": 0.2, "to_hz": 2.0, "duration_s": 5.0}
    with pytest.raises(ProfileError, match=words):
        chirp(**{**given_, **changed})


@given(positions=st.lists(st.floats(0.1, 0.9), min_size=2, max_size=5), dwell=st.floats(0.01, 2.0))
@settings(max_examples=50, deadline=None)
def test_steps_keep_the_bounds_and_end_at_rest(positions: list[float], dwell: float) -> None:
    pieces = steps(positions, dwell, BOUNDS)
    check(pieces, BOUNDS, 0.1 - 1e-6, 0.9 + 1e-6)
    assert ends_at_rest(tuple(pieces))
    assert profiles.end_m(pieces) == pytest.approx(positions[-1], abs=1e-9)


@pytest.mark.parametrize(
    ("positions", "dwell", "words"),
    [
        ([0.5], 1.0, "at least two"),
        ([0.5, 0.6], 0.0, "a rest of 0 s"),
        ([0.5, math.nan], 1.0, "finite"),
    ],
)
def test_steps_that_cannot_be_are_refused(positions: list[float], dwell: float, words: str) -> None:
    with pytest.raises(ProfileError, match=words):
        steps(positions, dwell, BOUNDS)


@pytest.mark.parametrize(
    ("pieces", "words"),
    [
        ([], "0 pieces"),
        (
            [septic(0.1, rest(0.5), rest(0.6))],
            "from 0 to 0.1 s: speed of 2.187 m/s, limits.motion allows 0.5",
        ),
        ([septic(0.4, rest(0.5), rest(0.58))], "from 0 to 0.4 s: jerk"),
        ([septic(0.35, rest(0.5), rest(0.585))._replace()], "speed|acceleration"),
        ([septic(9.0, rest(0.5), rest(0.95))], "from 0 to 9 s: 500 … 950 mm, the travel allows 20 … 940 mm"),
        ([septic(1.0, rest(0.5), rest(0.6)), septic(1.0, rest(0.61), rest(0.6))], "at 1 s: position"),
    ],
)
def test_what_a_profile_exceeds_is_said(pieces: list[Septic], words: str) -> None:
    with pytest.raises(ProfileError, match=words):
        check(pieces, BOUNDS._replace(jerk_m_s3=60.0), 0.02, 0.94)


def test_an_upload_empties_fills_and_tracks() -> None:
    pieces = steps([0.3, 0.4], 0.1, BOUNDS)
    first, *middle, last = requests(pieces)
    assert first == Request(RequestKind.PIECE)
    assert [Septic(*r.values) for r in middle] == pieces
    assert last == Request(RequestKind.TRACK, (1.0,))
    assert profiles.duration_s(pieces) == pytest.approx(0.2 + sum(p.T for p in pieces[1:-1]))


motions = st.builds(
    Reference, st.floats(0.1, 0.9), st.floats(-1.0, 1.0), st.floats(-5.0, 5.0), st.floats(-100.0, 100.0)
)


@given(start=motions, end=motions, T=st.floats(0.05, 2.0))
def test_the_extent_of_a_piece_is_no_less_than_what_it_reaches(
    start: Reference, end: Reference, T: float
) -> None:
    p = septic(T, start, end)
    e = extent(p)
    seen = [at(T * i / 999, p) for i in range(1000)]
    room = 0.05 * (e.high_m - e.low_m) + 1e-9
    assert e.low_m - room <= min(r.position_m for r in seen)
    assert max(r.position_m for r in seen) <= e.high_m + room
    for i, most in ((1, e.speed_m_s), (2, e.acceleration_m_s2), (3, e.jerk_m_s3)):
        assert max(abs(r[i]) for r in seen) <= 1.2 * most
    assert is_inside(e, e.low_m, e.high_m)
    assert not is_inside(e, e.low_m + 1e-6, e.high_m + 1.0)
    assert is_within(e, Bounds(*e[2:]))
    for i in range(3 if min(e[2:]) > 1e-9 else 0):
        less = [value * (0.9 if i == n else 1.1) for n, value in enumerate(e[2:])]
        assert not is_within(e, Bounds(*less))


def test_nothing_and_what_moves_on_do_not_end_at_rest() -> None:
    assert not ends_at_rest(())
    assert not ends_at_rest((septic(1.0, rest(0.5), Reference(0.6, 0.1, 0.0, 0.0)),))


@pytest.mark.parametrize("text", ["7", "[[0.5]]", '[["a"]]', "{"])
def test_a_file_of_pieces_that_is_none_is_refused_by_its_name(text: str, tmp_path: Path) -> None:
    path = tmp_path / "pieces.json"
    path.write_text(text)
    with pytest.raises(ProfileError, match=r"pieces\.json: is no list of pieces \[T, c0 … c7\]: "):
        profiles.from_file(path)
