"""The one door to the valve."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pneud.safety.faults import F
from pneud.safety.output import CEILING_V, CENTRED, Output, OutputLimits, emit

LSB = 0.0005
any_float = st.floats(allow_nan=True, allow_infinity=True)
limits = st.builds(
    OutputLimits,
    u_max_v=st.floats(0.01, CEILING_V),
    slew_v_s=st.floats(1.0, 1e6),
    lsb_v=st.sampled_from([LSB, 0.001, 1 / 3, 0.1, 5 / 2048]),
)
WIDE = OutputLimits(5.0, 1e6, LSB)


@given(law=any_float, share=st.floats(-1.0, 1.0), h=st.floats(1e-4, 1.0), p=limits)
@example(law=math.nan, share=1.0, h=1e-3, p=WIDE)
@example(law=math.inf, share=-1.0, h=1e-3, p=WIDE)
@example(law=-math.inf, share=0.0, h=1e-3, p=WIDE)
@example(law=1.7e308, share=-1.0, h=1e-3, p=WIDE)
def test_whatever_the_law_says_what_leaves_is_a_command(
    law: float, share: float, h: float, p: OutputLimits
) -> None:
    last = int(share * p.u_max_v / p.lsb_v) * p.lsb_v
    out = emit(law, last, h, p)
    if not math.isfinite(law):
        assert out == Output(0.0, 0, 0, 1 << F.NOT_FINITE)
        return
    assert (out.enable, out.faults) == (1, 0)
    assert math.isfinite(out.voltage_v)
    assert abs(out.voltage_v) <= p.u_max_v <= CEILING_V
    assert out.voltage_v == round(out.voltage_v / p.lsb_v) * p.lsb_v
    assert abs(out.voltage_v - last) <= p.slew_v_s * h + 0.5000001 * p.lsb_v + 1e-12
    reached = abs(law) <= p.u_max_v and abs(law - last) <= p.slew_v_s * h
    assert out.saturated in (0, 1)
    if out.saturated == 0:
        assert reached or math.isclose(law, last + math.copysign(p.slew_v_s * h, law - last))
        assert abs(out.voltage_v - law) <= 1.0000001 * p.lsb_v


@example(law=0.0, last=0.0, h=0.0, p=OutputLimits(-9e304, 0.0, LSB))
@example(law=5.5, last=5.4, h=1.0, p=OutputLimits(math.nan, 1e6, LSB))
@given(
    law=any_float, last=any_float, h=any_float, p=st.builds(OutputLimits, any_float, any_float, st.just(LSB))
)
def test_no_parameters_let_more_than_the_ceiling_out(
    law: float, last: float, h: float, p: OutputLimits
) -> None:
    out = emit(law, last, h, p)
    assert abs(out.voltage_v) <= CEILING_V
    assert out.enable == 0 or out.faults == 0
    assert out.enable == 1 or (out.voltage_v == 0.0 and out.faults)


@given(law=st.floats(-4.9, 4.9))
def test_a_command_within_all_bounds_passes_to_the_nearest_step(law: float) -> None:
    out = emit(law, 0.0, 1.0, WIDE)
    assert abs(out.voltage_v - law) <= 0.5000001 * LSB
    assert (out.enable, out.saturated, out.faults) == (1, 0, 0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("law", "voltage", "saturated"),
    [
        (math.nextafter(5.0, 0.0), 5.0, 0),
        (5.0, 5.0, 0),
        (math.nextafter(5.0, 6.0), 5.0, 1),
        (1e300, 5.0, 1),
    ],
)
def test_around_the_greatest_command(sign: float, law: float, voltage: float, saturated: int) -> None:
    assert emit(sign * law, 0.0, 1.0, WIDE) == Output(sign * voltage, 1, saturated, 0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("law", "saturated"), [(0.999, 0), (1.0, 0), (1.001, 1)])
def test_around_the_greatest_change(sign: float, law: float, saturated: int) -> None:
    out = emit(sign * law, 0.0, 0.5, OutputLimits(5.0, 2.0, LSB))
    assert out.voltage_v == pytest.approx(sign * min(law, 1.0), abs=1e-12)
    assert out.saturated == saturated


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_last_step_never_rounds_beyond_the_greatest_command(sign: float) -> None:
    # 4.9999 V lies nearest to 5.0 V, which is more than allowed
    out = emit(sign * 5.0, 0.0, 1.0, OutputLimits(4.9999, 1e6, LSB))
    assert out.voltage_v == pytest.approx(sign * 4.9995, abs=1e-12)


def test_where_one_step_is_too_much_nothing_leaves_but_zero() -> None:
    for sign in (1.0, -1.0):
        assert emit(sign * 5.0, 0.0, 1.0, OutputLimits(0.6 * LSB, 1e6, LSB)) == Output(0.0, 1, 1, 0)


@pytest.mark.parametrize("u_max", [6.0, -1.0, math.nan])
def test_a_bound_that_is_wrong_centres(u_max: float) -> None:
    assert emit(5.5, 5.4, 1.0, OutputLimits(u_max, 1e6, LSB)) == Output(0.0, 0, 0, 1 << F.COMMAND_RANGE)


def test_the_centre_is_disabled() -> None:
    assert Output(0.0, 0, 0, 0) == CENTRED
