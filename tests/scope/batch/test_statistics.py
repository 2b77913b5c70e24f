"""Statistics of a day against closed forms and simulated days."""

from __future__ import annotations

import numpy as np
import pytest

from scope.batch import capability, control_chart, gauge_study
from scope.batch.wording import gauge_of
from scope.errors import MeasurementError


def study(rng: np.random.Generator, sd: tuple[float, float, float, float], shape: tuple[int, int, int]) -> np.ndarray:
    """Values of parts, operators, repeats with these standard deviations: repeats, operators, interaction, parts."""
    p, o, n = shape
    within, operators, crossed, parts = sd
    return (
        rng.normal(0, parts, (p, 1, 1)) + rng.normal(0, operators, (1, o, 1)) + rng.normal(0, crossed, (p, o, 1))
        + rng.normal(0, within, (p, o, n))
    )  # fmt: skip


def test_a_gauge_study_is_unbiased_on_simulated_days() -> None:
    """Means of 400 studies lie within four standard errors of the truth; no variance is cut at 0 at these sizes but rarely."""
    rng, sd = np.random.default_rng(0), (1.0, 1.5, 0.8, 4.0)
    found = np.array([
        [s.repeatability, s.operators, s.interaction, s.parts]
        for s in (gauge_study(study(rng, sd, (10, 8, 4))) for _ in range(400))
    ])  # fmt: skip
    error = np.abs(found.mean(axis=0) - np.square(sd)) / (found.std(axis=0) / 20)
    assert (error < 4.0).all(), error


def test_a_gauge_study_by_hand() -> None:
    """Additive table without interaction: parts 0 and 10, operators 0 and 2, repeats -1 and +1.

    Within: mean square 2. Crossed: 0, so that its component is cut to 0. Operators: n p sum (+-1)^2 = 8, (8 - 0) / 4 = 2.
    Parts: 4 * 2 * 25 = 200, 200 / 4 = 50.
    """
    values = np.array([[[-1.0, 1.0], [1.0, 3.0]], [[9.0, 11.0], [11.0, 13.0]]])
    found = gauge_study(values)
    assert (found.repeatability, found.operators, found.interaction, found.parts) == pytest.approx(
        (2.0, 2.0, 0.0, 50.0)
    )
    assert found.gauge == pytest.approx(2.0)
    assert found.percent == pytest.approx(100 * 2 / np.sqrt(54))


def test_rows_make_a_study_only_where_the_design_is_crossed() -> None:
    rows = [
        {"label.part": p, "label.operator": o, "x": v}
        for p, o, v in [
            ("a", "i", -1),
            ("a", "i", 1),
            ("a", "j", 1),
            ("a", "j", 3),
            ("b", "i", 9),
            ("b", "i", 11),
            ("b", "j", 11),
            ("b", "j", 13),
        ]
    ]
    assert gauge_of(rows, "x").parts == pytest.approx(50.0)
    with pytest.raises(MeasurementError, match="1 to 2 repeats"):
        gauge_of(rows[:-1], "x")


def test_control_limits_of_noise_hold_and_a_jump_shows() -> None:
    """Sigma from the moving range is that of the noise also where the mean drifts; 0.27 % lie outside by chance."""
    rng = np.random.default_rng(1)
    noise = rng.normal(5.0, 0.2, 20_000)
    chart = control_chart(noise)
    assert chart.sigma == pytest.approx(0.2, rel=0.02)
    assert len(chart.outside) / len(noise) == pytest.approx(0.0027, abs=0.0012)
    assert control_chart(noise[:2000] + np.linspace(0, 5, 2000)).sigma == pytest.approx(0.2, rel=0.06)
    day = [*rng.normal(0, 1, 30), 9.0]
    assert 30 in control_chart(day).outside
    assert control_chart([1.0, -1.0] * 2 + [0.5] * 3 + [2.0] * 9).run
    with pytest.raises(ValueError, match="two"):
        control_chart([1.0])


def test_capability_of_a_centred_and_a_shifted_process() -> None:
    values = np.array([-1.0, 1.0]) / np.sqrt(2)  # sd 1
    assert capability(values, -6.0, 6.0) == pytest.approx((2.0, 2.0))
    assert capability(values + 3.0, -6.0, 6.0) == pytest.approx((2.0, 1.0))
    with pytest.raises(ValueError, match="order"):
        capability(values, 1.0, -1.0)
