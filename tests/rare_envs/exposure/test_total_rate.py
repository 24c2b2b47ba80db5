"""Sums of rates: closed forms for small errors, limits of dependence, and what the uncertainty comes from."""

from __future__ import annotations

import math

import pytest

from rare_envs.exposure import TotalRate
from tests.rare_envs.exposure.test_rate import frequency, rate

SURE = frequency(10**12, 1e11, 2.5e12)
"""Known without error: 10 events an hour, 0.4 per km."""


def test_the_worked_example_adds_up() -> None:
    """Cut-in and brakings to a standstill, us101: 7.2e-3 per h, 2.0e-4 per km."""
    cut_in = rate(7.83e-4, counted=frequency(1221, 112.0, 3900.0, 0.83, 46))
    brake = rate(1.8e-5, counted=frequency(268, 5.64, 218.0, 42 / 268, 268), scenario="hard_brake")
    total = TotalRate((cut_in, brake))
    assert total.per_hour == pytest.approx(7.2e-3, rel=0.01)
    assert total.per_million_km == pytest.approx(200, rel=0.04)


def test_small_independent_errors_add_as_variances_of_the_rates() -> None:
    """3 and 1 with 4 % and 8 %: sd = sqrt(.12^2 + .08^2) of 4; ends of 200,000 draws are good to 1 % of it."""
    total = TotalRate((rate(0.3, 0.04, SURE), rate(0.1, 0.08, SURE, scenario="b")))
    low, high = total.interval_per_hour
    assert (high - low) / 2 == pytest.approx(1.96 * math.hypot(0.12, 0.08), rel=0.02)
    assert total.per_hour == pytest.approx(4.0)


def test_bases_fitted_to_the_same_events_err_together() -> None:
    """Then the sum has the relative error of each: its interval is 4 exp(-+ 1.96 s)."""
    alone = TotalRate((rate(3e-4, 0.0, SURE, spread=0.5), rate(1e-4, 0.0, SURE, spread=0.5, scenario="b")))
    same = [
        rate(p, 0.0, SURE, spread=0.5, scenario=name, fitted_to="38 events") for p, name in ((3e-4, "a"), (1e-4, "b"))
    ]
    together = TotalRate(tuple(same))
    low, high = together.interval_per_hour
    assert (low, high) == pytest.approx((4e-3 * math.exp(-0.98), 4e-3 * math.exp(0.98)), rel=0.02)
    assert alone.interval_per_hour[1] < 0.9 * high


def test_a_scenario_that_is_not_determined_raises_the_upper_end_alone() -> None:
    known = rate(3e-4, 0.05, SURE)
    unknown = rate(1e-14, 0.05, SURE, scenario="b", spread=5.0, upper=1e-6, determined=False)
    total = TotalRate((known, unknown))
    low, high = total.interval_per_hour
    assert low == pytest.approx(known.interval_per_hour[0], rel=0.01)
    assert high == pytest.approx(known.interval_per_hour[1] + 1e-5, rel=0.01)
    assert {each.scenario for each in total.shares} <= {"cut_in", ""}


def test_shares_of_the_variance_by_hand() -> None:
    """Weights 3 and 1: 9 (1.96 + .01) and 1 (.25 + .01), counts 9 / 100 + 1 / 100."""
    counted = frequency(100, 10.0, 25.0)
    total = TotalRate(
        (rate(3e-4, 0.1, counted, spread=1.4), rate(1e-4, 0.1, counted, spread=0.5, scenario="hard_brake"))
    )
    parts = {(each.source, each.scenario): each.share for each in total.shares}
    whole = 9 * 1.96 + 0.25 + 0.1 + 0.1
    assert parts == pytest.approx(
        {
            ("base", "cut_in"): 9 * 1.96 / whole,
            ("base", "hard_brake"): 0.25 / whole,
            ("counts", ""): 0.1 / whole,
            ("sampling", ""): 0.1 / whole,
        }
    )
    assert total.shares[0].scenario == "cut_in"


def test_further_events_halve_the_width() -> None:
    """A base alone: 38 events with s fall to s / 2 at 4 x 38; with other parts more are needed, or none suffice."""
    alone = TotalRate((rate(3e-4, 0.0, SURE, spread=1.4),))
    needed = alone.further_events({"cut_in": 38})
    assert needed is not None
    assert (needed.scenario, needed.number, needed.own) == ("cut_in", pytest.approx(3 * 38, abs=1), 3 * 38)
    mixed = TotalRate((rate(3e-4, 0.0, SURE, spread=1.4, site_log_sd=0.6),))
    more = mixed.further_events({"cut_in": 38})
    assert more is not None and more.number is not None
    before, after = mixed.rates[0].log_variance.total, 1.96 * 38 / (38 + more.number) + 0.36
    assert math.sqrt(after / before) == pytest.approx(0.5, abs=0.002)
    hopeless = TotalRate((rate(3e-4, 0.0, SURE, spread=1.4, site_log_sd=1.4),)).further_events({"cut_in": 38})
    assert hopeless is not None and hopeless.number is None
    assert alone.further_events({}) is None


def test_no_further_events_halve_a_width_that_a_bound_is_part_of() -> None:
    known, unknown = rate(3e-4, 0.0, SURE, spread=1.4), rate(0.0, math.inf, SURE, upper=1e-3, scenario="b")
    assert TotalRate((known,)).further_events({"cut_in": 38}) is not None
    assert TotalRate((known, unknown)).further_events({"cut_in": 38, "b": 20}) is None
