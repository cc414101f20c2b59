"""Programs from their files: what may stand in one, and what is refused, in one line with the cure."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from axis_rig import loaded
from pneud.config.toml import tables_of, toml_text
from pneud.console import programs, records
from pneud.console.programs import AxisFacts, compiled
from pneud.console.records import ProgramError
from pneud.control import program
from pneud.control.program import Step
from pneud.control.reference import Bounds
from pneud.loading import load_axes
from pneud.signals import Request, RequestKind

ROOT = Path(__file__).parent.parent
X = AxisFacts(
    *("x", 0.02, 0.98, Bounds(0.5, 5.0, 100.0), 2e-5, 2e-3, 0.05),
    *(("start", "part"), ("lamp",), 560.0, 470.0, 2.0),
)
Y = X._replace(name="y", inputs=("gate",), outputs=())
GOTO, WAIT = {"do": "goto", "to_mm": 100.0}, {"do": "wait", "for_s": 0.1}
PRESS = {"do": "force", "force_n": 100.0}


def tree(*listed: Any, **more: Any) -> dict[str, Any]:
    return {"schema": 1, "record": list(listed), **more}


def test_records_become_steps_in_si() -> None:
    found = compiled(
        tree(
            {**GOTO, "speed_mm_s": 200.0, "class": "fast", "tolerance_mm": 0.5, "label": "a", "mass_kg": 2.0},
            {"do": "move", "by_mm": 10, "settle_s": 0.1},
            {"do": "until", "above_mm": 105.0, "for_s": 0.2, "timeout_s": 3.0, "otherwise": "a"},
            {"do": "until", "input": "part"},
            {"do": "output", "output": "lamp", "on": True},
            {"do": "repeat", "to": "a", "times": 3},
            {"do": "track", "for_s": 2.0},
            points={},
            name="p",
        ),
        [X],
    )
    (steps,) = found.steps
    assert steps[0] == Step(
        program.GOTO,
        0.1,
        0.2,
        ends=program.FAST,
        tolerance_m=5e-4,
        velocity_m_s=2e-3,
        timeout_s=60.0,
        mass_kg=2.0,
    )
    assert steps[1][:2] == (program.MOVE, 0.01)
    assert (steps[1].ends, steps[1].tolerance_m, steps[1].time_s) == (program.EXACT, 2e-5, 0.1)
    assert (steps[2].what, steps[2].low, steps[2].high) == (program.POSITION, 0.105, programs.FAR)
    assert (steps[2].time_s, steps[2].timeout_s, steps[2].otherwise) == (0.2, 3.0, 1)
    assert (steps[3].what, steps[3].bit, steps[3].on) == (program.INPUT, 1, 1)
    assert (steps[5].to, steps[5].times) == (1, 3)
    assert all(program.step_of(tuple(map(float, step))) == step for step in steps)
    assert [step.mass_kg for step in steps] == [2.0] * 7
    assert found.words[0] == "goto 100 mm, fast"
    assert programs.requests(found)[0] == Request(RequestKind.RECORD, (7.0, 2.0))
    assert [program.step_of(request.values) for request in programs.requests(found)[1:]] == list(steps)
    assert programs.begun(found, 2, 5) == Request(RequestKind.RUN, (2.0, 5.0, 0.0))
    assert programs.run_in_words(found, 2, 5) == "run p from record 2, 5 times"


def test_points_and_defaults_stand_in_for_numbers() -> None:
    found = compiled(
        tree(
            {"do": "goto", "to_mm": "a"},
            {"do": "goto", "to_mm": "b", "class": "start"},
            WAIT,
            points={"a": 50.0, "b": 60},
            defaults={"speed_mm_s": 100.0, "settle_s": 0.02},
        )
        | {"defaults": {"speed_mm_s": 100.0}},
        [X],
    )
    assert [(s.target_m, s.speed_m_s) for s in found.steps[0][:2]] == [(0.05, 0.1), (0.06, 0.1)]


REFUSED = [
    ({"record": [WAIT]}, "schema = 1 has to stand in a program, not None"),
    (tree(WAIT, steps=1), "a program has no 'steps'; it takes schema, name, points, defaults, record"),
    (tree(), "a program has 1 to 256 records"),
    (tree(*[WAIT] * 257), "a program has 1 to 256 records"),
    (tree(WAIT, name=7), "name is a text"),
    (tree(WAIT, points=[1]), "points and defaults are tables"),
    (tree(WAIT, defaults={"to_mm": 1}), "defaults: has no 'to_mm'"),
    (tree(WAIT, 7), "record 2: is a table"),
    (tree({"do": "dance"}), "record 1: do is one of goto, move,"),
    (tree({"do": "goto"}), "record 1 (goto): needs to_mm"),
    (tree({**GOTO, "to": 1}), "record 1 (goto): has no 'to'; a goto takes label, axis, to_mm,"),
    (tree({**GOTO, "to_mm": True}), "record 1 (goto): to_mm is a number"),
    (
        tree({**GOTO, "to_mm": "up"}),
        "record 1 (goto): to_mm: no point 'up'; there are no points: pneud teach up",
    ),
    (tree({**GOTO, "to_mm": "up"}, points={"a": 1}), "no point 'up'; there is a"),
    (tree({**GOTO, "to_mm": "-3.5"}), "to_mm: '-3.5' is a text; a number has no quotation marks"),
    (tree({**GOTO, "to_mm": {"z": 1}}), "is a position, or one by axis (x)"),
    (tree({**GOTO, "axis": "z"}), "record 1 (goto): no axis 'z'; there is x"),
    (tree({**GOTO, "speed_mm_s": 0}), "speed_mm_s is a number from 0.001"),
    (
        tree({**GOTO, "speed_mm_s": 501}),
        "record 1 (goto): 501 is more than limits.motion.speed_m_s allows; at most 500",
    ),
    (tree({**GOTO, "class": "slow"}), "class is one of start, fast, exact, not 'slow'"),
    (tree({**GOTO, "class": "fast", "settle_s": 1}), "settle_s is for class = 'exact'; this one is 'fast'"),
    (tree({**GOTO, "class": "start", "tolerance_mm": 1}), "leave out tolerance_mm"),
    (tree({**GOTO, "label": ""}), "label is a name of at most 64 characters"),
    (
        tree({**GOTO, "label": "a"}, {**WAIT, "label": "a"}),
        "record 2 (wait), 'a': record 1 has that label, too",
    ),
    (tree(GOTO, {"do": "jump", "to": "b"}), "record 2 (jump): to: no label 'b'; no record has one"),
    (tree({**GOTO, "label": "a", "otherwise": "b"}), "otherwise: no label 'b'; there is a"),
    (tree({"do": "track", "for_s": 1, "otherwise": "a"}, {**WAIT, "label": "a"}), "give timeout_s, too"),
    (tree({"do": "until"}), "waits for one thing"),
    (tree({"do": "until", "above_mm": 1, "above_n": 1}), "waits for one thing"),
    (tree({"do": "until", "above_mm": 100, "on": True}), "waits for one thing"),
    (tree({"do": "until", "above_mm": 200, "below_mm": 100}), "nothing is above 200 and below 100"),
    (tree({"do": "until", "above_mm": 990}), "the axis never comes there; it goes from 20 to 980 mm"),
    (tree({"do": "until", "input": "stop"}), "no input 'stop'; there is start, part"),
    (tree({"do": "output", "output": "horn", "on": True}), "no output 'horn'; there is lamp"),
    (tree({"do": "output", "output": "lamp", "on": 1}), "on is true or false, not 1"),
    (tree({"do": "force", "force_n": 2000}), "2000 N are more than limits.force and the supply allow"),
    (tree({**PRESS, "ramp_n_s": 0.5}), "ramp_n_s is a number from 1 to"),
    (tree({**PRESS, "low_mm": 100}), "record 1 (force): low_mm and high_mm go together"),
    (tree({**PRESS, "low_mm": 200, "high_mm": 100}), "the window 200 … 100 mm has to lie within the travel"),
    (tree({**PRESS, "low_mm": 200, "high_mm": 200}), "the window 200 … 200 mm has to lie within the travel"),
    (tree({**PRESS, "low_mm": 0, "high_mm": 100}), "within the travel 20 … 980 mm"),
    (tree({**PRESS, "speed_mm_s": 2100}), "2100 mm/s is faster than limits.speed_m_s, 2000 mm/s"),
    (
        tree(GOTO, WAIT, {**PRESS, "low_mm": 150, "high_mm": 200}),
        "record 3 (force): the load is at 100 mm by then, outside the window 150 … 200 mm",
    ),
    (tree(WAIT, {"do": "repeat", "to": "a", "times": 1.5}), "times is a whole number, not 1.5"),
    (
        tree({**GOTO, "to_mm": 990}),
        "990 mm lies outside the travel 20 … 980 mm; the nearest allowed is 980 mm",
    ),
    (tree(GOTO, {"do": "move", "by_mm": -90}), "record 2 (move): 10 mm lies outside the travel"),
    (
        tree(
            {**GOTO, "label": "a"},
            {"do": "move", "by_mm": 200},
            {"do": "move", "by_mm": 300, "label": "b"},
            {"do": "repeat", "to": "b", "times": 3},
        ),
        "record 3 (move), 'b': 1200 mm lies outside",
    ),
    (
        tree({"do": "jump", "to": "b"}, {**GOTO}, {"do": "move", "by_mm": 500, "label": "b"}),
        "record 2 (goto): is never reached",
    ),
    (
        tree(GOTO, {**WAIT, "label": "a"}, WAIT, {"do": "jump", "to": "a"}),
        "records 2 to 4 go round without end",
    ),
    (tree({"do": "jump", "to": "a", "label": "a"}), "record 1 goes round without end"),
]


@pytest.mark.parametrize(("given_", "words"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_wrong_is_told_with_the_record_and_the_cure(given_: dict[str, Any], words: str) -> None:
    with pytest.raises(ProgramError, match=re.escape(words)) as e:
        compiled(given_, [X])
    assert "\n" not in str(e.value)
    assert e.value.exit_code == 2


def test_where_a_load_is_that_has_only_set_out_is_not_known() -> None:
    there = {**PRESS, "low_mm": 150, "high_mm": 200}
    compiled(tree({**GOTO, "class": "start"}, {"do": "until", "above_mm": 90}, there), [X])
    compiled(tree({**GOTO, "class": "fast", "tolerance_mm": 50}, there, there), [X])


def test_relative_ways_are_followed_for_two_rounds() -> None:
    with pytest.raises(ProgramError, match=r"record 2 \(move\): 1080 mm in round 2 lies outside"):
        compiled(tree({"do": "wait", "for_s": 1}, {"do": "move", "by_mm": 980}, {**GOTO}), [X])
    assert compiled(tree({"do": "move", "by_mm": 300}), [X])  # from where nobody knows


def test_a_program_of_several_axes_says_who_does_what() -> None:
    found = compiled(
        tree(
            {"do": "goto", "to_mm": {"x": 100, "y": 200}},
            {"do": "goto", "to_mm": 300, "axis": "y", "mass_kg": 1.0},
            {"do": "until", "input": "gate"},
            {"do": "output", "output": "lamp", "on": False},
            WAIT,
        ),
        [X, Y],
    )
    x, y = found.steps
    assert [s.kind for s in x] == [program.GOTO, program.PASS, program.PASS, program.OUTPUT, program.WAIT]
    assert [s.kind for s in y] == [program.GOTO, program.GOTO, program.UNTIL, program.PASS, program.WAIT]
    assert (x[0].target_m, y[0].target_m) == (0.1, 0.2)
    assert (x[-1].mass_kg, y[-1].mass_kg) == (0.0, 1.0)
    assert found.words[:2] == ("goto x=100 y=200 mm", "y: goto 300 mm")
    assert programs.begun(found, 1, 1).values[2] == 1.0
    for record, words in (
        (GOTO, "say which axis: axis = 'x'"),
        ({"do": "goto", "to_mm": {"x": 100}, "axis": "x"}, "names its axes twice"),
        ({**GOTO, "axis": "x", "timeout_s": 1, "otherwise": "a", "label": "a"}, "otherwise is for one axis"),
    ):
        with pytest.raises(ProgramError, match=re.escape(words)):
            compiled(tree(record), [X, Y])


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
FIELDS = sorted({name for fields in records.FIELDS.values() for name in fields})
RECORD = st.fixed_dictionaries(
    {"do": st.sampled_from(sorted(records.FIELDS))},
    optional={name: ANYTHING | st.sampled_from([1, 0.5, 100.0, "a", True]) for name in FIELDS},
)


@settings(max_examples=100, deadline=None)
@given(st.lists(RECORD | ANYTHING, max_size=4), ANYTHING, ANYTHING)
def test_whatever_stands_in_a_file_is_a_program_or_told_in_one_line(
    listed: list[Any], points: Any, defaults: Any
) -> None:
    try:
        found = compiled({"schema": 1, "record": listed, "points": points, "defaults": defaults}, [X])
    except ProgramError as e:
        assert "\n" not in str(e)
    else:
        assert program.leads(found.steps[0])


def test_a_force_has_its_window_and_its_ways_in_si() -> None:
    record = {"do": "force", "force_n": 100, "ramp_n_s": 50, "low_mm": 200, "high_mm": 300, "speed_mm_s": 20}
    ((step,),) = compiled(tree({**record, "settle_s": 0.2}), [X]).steps
    assert (step.force_n, step.rate_n_s, step.time_s) == (100, 50, 0.2)
    assert (step.low_m, step.high_m, step.speed_m_s) == pytest.approx((0.2, 0.3, 0.02))


def test_half_a_gantry_presses_nothing() -> None:
    assert programs.facts_of(loaded().config).in_n > 0.0
    for half in load_axes("gantry.toml"):
        assert (programs.facts_of(half.config).out_n, programs.facts_of(half.config).in_n) == (0.0, 0.0)


def test_the_programs_that_come_with_pneud_are_ones() -> None:
    facts = programs.facts_of(loaded().config)
    for path in sorted((ROOT / "examples" / "programs").glob("*.toml")):
        tree_ = programs.tree_of(path)
        if "axis" not in path.read_text():
            assert len(compiled(tree_, [facts]).records) >= 1


def test_a_file_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    with pytest.raises(ProgramError, match="cannot be read: No such file"):
        programs.tree_of(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("schema = ")
    with pytest.raises(ProgramError, match="not valid TOML"):
        programs.tree_of(tmp_path / "bad.toml")
    (tmp_path / "p.toml").write_text('points = "q.toml"')
    (tmp_path / "q.toml").write_text("a = 1.5")
    assert programs.tree_of(tmp_path / "p.toml") == {"points": {"a": 1.5}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[points]\na = nan", "p.toml: points.a is nan, neither"),
        ("[[record]]\n[[record]]\nto_mm = { x = -inf }", "p.toml: record 2: to_mm.x is -inf, neither"),
        ("schema = 1979-05-27", "p.toml: schema is 1979-05-27, neither a number nor a text"),
    ],
)
def test_what_no_field_takes_is_told_by_its_place(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(ProgramError, match=re.escape(words)):
        programs.tree_of(tmp_path / "p.toml")


NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=9)


@settings(max_examples=50, deadline=None)
@given(
    st.dictionaries(
        NAMES, st.floats(allow_nan=False) | NAMES | st.dictionaries(NAMES, st.booleans()), max_size=5
    )
)
def test_tables_of_any_names_are_read_as_they_were_written(tables: dict[str, Any]) -> None:
    assert tables_of(toml_text(tables)) == tables


@pytest.mark.parametrize(
    ("record", "words"),
    [
        ({"do": "until", "above_n": 140.0, "below_n": 200.0}, "until above 140 N and below 200 N"),
        ({"do": "until", "above_mm": 5.0, "axis": "x"}, "x: until above 5 mm"),
        ({"do": "until", "input": "part"}, "until part on"),
    ],
)
def test_what_is_waited_for_is_told_with_its_unit(record: dict[str, Any], words: str) -> None:
    assert programs.in_words(record) == words


def test_the_page_names_every_record_and_field() -> None:
    text = (ROOT / "docs" / "programs.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(\w+)`", text))
    assert set(records.FIELDS) <= named
    assert {name for fields in records.FIELDS.values() for name in fields} - {"axis"} <= named
    blocks = re.findall(r'```toml title="[\w.-]+"\n(.*?)```', text, re.DOTALL)
    assert all(tables_of(block) for block in blocks)
