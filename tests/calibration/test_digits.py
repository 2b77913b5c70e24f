"""As many digits as are true."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from calibration.digits import decimals, rounded, two_digits
from calibration.reason import TROUBLES, Reason, see


@given(st.floats(-1e3, 1e3), st.floats(1e-4, 90.0))
def test_what_is_written_is_within_a_twentieth_of_the_uncertainty(value: float, uncertainty: float) -> None:
    """The second digit of an uncertainty is at least a hundredth of it, at most a tenth: half of that is what rounding costs."""
    text = rounded(value, uncertainty)
    assert abs(float(text) - value) <= 0.051 * uncertainty
    places = len(text.partition(".")[2])
    assert places == 0 or 10.0**-places >= 0.0099 * uncertainty
    assert abs(float(two_digits(uncertainty)) - uncertainty) <= 0.051 * uncertainty


def test_examples_and_what_is_not_known() -> None:
    assert rounded(40.0081, 0.2327) == "40.01"
    assert rounded(0.0081, 0.2327, sign=True) == "+0.01"
    assert (two_digits(0.2327), two_digits(0.0999), two_digits(123.4), two_digits(1e-9)) == (
        "0.23",
        "0.10",
        "123",
        "0.000000",
    )
    assert (rounded(math.nan, 1.0), two_digits(math.inf)) == ("-", "-")
    assert rounded(1.23456, math.nan) == "1.2346"
    assert decimals(0.0, usual=2) == 2


def test_reasons_are_seen_under_their_own_word() -> None:
    assert see() == ""
    assert see(Reason.EDGE.key, "slip", "edge") == f"{TROUBLES}#edge, #slip"
