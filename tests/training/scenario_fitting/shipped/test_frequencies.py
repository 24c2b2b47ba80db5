"""Frequencies of the shipped events, by hand."""

import pytest

from training.scenario_fitting.shipped.frequencies import CUT_INS_I80, CUT_INS_US101, braking_frequency


def test_rates_of_the_shipped_cut_ins():
    """10.9 per hour times 38 of 46, 13.8 times 63 of 77."""
    assert CUT_INS_US101.per_hour == pytest.approx(1221 / 112 * 38 / 46)
    assert CUT_INS_I80.per_hour == pytest.approx(1693 / 122.5 * 63 / 77)


def test_brakings_to_a_standstill():
    assert braking_frequency(42, 6.0, 230.0, "US 101").per_hour == pytest.approx(7.0)
