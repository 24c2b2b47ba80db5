"""Text of rates."""

from __future__ import annotations

import math

import pytest

from rare_envs.exposure import TotalRate
from rare_envs.study.text import (
    describe_uncertainty,
    format_rate,
    format_with_interval,
)
from tests.rare_envs.exposure.test_rate import frequency, rate


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (12345.0, "12,000"),
        (99.6, "100"),
        (9.99, "10"),
        (0.0123, "0.012"),
        (0.00999, "1.0e-02"),
    ],
)
def test_two_digits(value: float, text: str) -> None:
    assert format_rate(value) == text


@pytest.mark.parametrize(
    ("value", "interval", "text"),
    [
        (0.011, (0.001, 0.12), "0.011 (0.0010 to 0.12)"),
        (0.003, (0.0004, 0.012), "3.0e-03 (4.0e-04 to 1.2e-02)"),
        (11.0, (0.16, 820.0), "11 (0.16 to 820)"),
        (2e-7, (0.0, 1700.0), "2.0e-07 (below 1.7e+03)"),
        (math.nan, (0.0, 5e-4), "nan (below 5.0e-04)"),
    ],
)
def test_a_rate_and_its_interval_have_one_form(value: float, interval: tuple[float, float], text: str) -> None:
    assert format_with_interval(value, interval) == text


def test_the_line_of_a_total_names_the_largest_source_first() -> None:
    total = TotalRate((rate(spread=1.4, counted=frequency(100)),))
    text = describe_uncertainty(total, {"cut_in": 38})
    assert text.startswith("the uncertainty is 99 % the cut-in distribution, 0.5 % event counts, 0.02 % simulation;")
    assert "120 further recorded cut-ins would halve it (a spread falls with 1 / sqrt(events))" in text
    assert "further" not in describe_uncertainty(total, {})
