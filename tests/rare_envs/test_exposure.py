"""Rates against the worked example of an IDM ego, computed by hand, and against limits known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from rare_envs.distributions.events import EventFrequency
from rare_envs.exposure import CollisionRate, TotalRate


def frequency(count=1221, hours=112.0, km=3900.0, share=1.0, share_events=None):
    return EventFrequency(
        count=count, hours=hours, km=km, share=share, share_events=share_events, definition="events", source="a count"
    )


def rate(p=7.83e-4, cov=0.02, counted=None, spread=0.0, scenario="cut_in", **more):
    counted = counted or frequency()
    return CollisionRate(scenario=scenario, frequency=counted, p=p, sampling_log_sd=cov, base_log_sd=spread, **more)


WORKED_EXAMPLE = {
    "cut-in, us101": (frequency(1221, 112.0, 3900.0, 0.83, 46), 7.83e-4, 9.0, 0.26, 2.0e-4, 0.15),
    "cut-in, I-80": (frequency(1693, 122.5, 2860.0, 63 / 77, 77), 6.1e-3, 11.3, 0.49, 3.0e-3, 0.12),
    "following, us101": (frequency(153, 5.98, 169.7), 1.23e-4, 25.6, 0.90, 1.1e-4, 0.16),
    "hard brake, all": (frequency(268, 5.64, 218.0), 1.8e-5, 47.5, 1.23, 2.2e-5, 0.13),
    "hard brake, standstill": (frequency(268, 5.64, 218.0, 42 / 268, 268), 1.8e-5, 7.4, 0.19, 3.5e-6, 0.31),
}
"""Frequency, p; then events per hour and km, collisions per km, and half the width of the interval from
counts and 2 % of sampling, as two digits in the table say."""


@pytest.mark.parametrize("row", WORKED_EXAMPLE.values(), ids=WORKED_EXAMPLE.keys())
def test_the_worked_example(row) -> None:
    counted, p, per_hour, per_km, rate_per_km, half = row
    found = rate(p, counted=counted)
    assert counted.per_hour == pytest.approx(per_hour, rel=0.02)
    assert counted.per_km == pytest.approx(per_km, rel=0.02)
    assert found.per_million_km == pytest.approx(1e6 * rate_per_km, rel=0.04)
    assert 1.96 * math.sqrt(sum(found.log_variance.values())) == pytest.approx(half, abs=0.0065)


def test_each_side_of_an_interval_of_p_adds_up_with_the_other_errors() -> None:
    """Zou and Donner 2008: log 4 below and log 10 above, counts 1 / 100 and sites .3^2 on both sides."""
    found = rate(1e-4, counted=frequency(100), site_log_sd=0.3, spread=1.0, interval=(2.5e-5, 1e-3))
    other = 1.959964 * math.sqrt(0.01 + 0.09)
    low, high = found.interval_per_million_km
    assert math.log(found.per_million_km / low) == pytest.approx(math.hypot(math.log(4), other))
    assert math.log(high / found.per_million_km) == pytest.approx(math.hypot(math.log(10), other))
    assert found.to_dict()["p_interval"] == [2.5e-5, 1e-3]


def test_parts_of_the_variance_add_up_in_logarithms() -> None:
    found = rate(cov=0.1, counted=frequency(100), site_log_sd=1.5, spread=0.7)
    assert list(found.log_variance.values()) == pytest.approx([0.01, 0.01, 0.49, 2.25])
    assert sum(each.share for each in TotalRate((found,)).shares) == pytest.approx(1.0)
    assert TotalRate((found,)).shares[0] == ("site", "cut_in", pytest.approx(2.25 / 2.76))
    low, _ = found.interval_per_million_km
    assert math.log(found.per_million_km / low) == pytest.approx(1.959964 * math.sqrt(2.76))


def test_a_probability_that_is_not_determined_has_an_upper_end_only() -> None:
    found = rate(8e-14, spread=5.6, interval=(0.0, 1e-8), counted=frequency(100, 10.0, 100.0))
    assert found.interval_per_million_km == pytest.approx((0.0, 1e6 * 1e-8 * math.exp(1.959964 * 0.1)))
    assert TotalRate((found,)).shares == ()
    assert not found.determined


def test_few_events_are_gamma_distributed() -> None:
    """With p known, the interval is that of Gamma(n + 1/2) over the kilometres."""
    found = rate(0.5, cov=0.0, counted=frequency(3, 2.0, 40.0))
    expected = 1e6 * stats.gamma.ppf([0.025, 0.975], 3.5) * 0.5 / 40.0
    assert found.interval_per_million_km == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    "known",
    [
        {"cov": 0.1, "counted": frequency(100), "spread": 1.0, "site_log_sd": 0.3},
        {"cov": 0.2, "counted": frequency(10**12), "spread": 1.0, "interval": (2.5e-5, 1e-3)},  # of its own
    ],
)
def test_draws_have_the_quantiles_of_the_interval(known) -> None:
    """Of 200,000 draws, the standard error of a level of 2.5 % is 0.035 %."""
    found = rate(1e-4, **known)
    rng = np.random.default_rng(1)
    drawn = found.draw(rng.standard_normal(200_000), rng)
    low, high = found.interval_per_million_km
    assert np.mean(drawn < low) == pytest.approx(0.025, abs=0.0014)
    assert np.mean(drawn > high) == pytest.approx(0.025, abs=0.0014)
    assert np.median(drawn) == pytest.approx(found.per_million_km, rel=0.01)


@pytest.mark.parametrize("known", [{"spread": 0.5}, {"interval": (0.0, 0.2)}])
def test_no_rate_is_higher_than_that_of_its_events(known) -> None:
    """Another site may have a p a thousand times as high, but not above 1; the count errs by 10 %: exp(1.96 x .1)."""
    found = rate(0.1, counted=frequency(100, 100.0, 1000.0), site_log_sd=5.0, **known)
    assert found.interval_per_million_km[1] == pytest.approx(1e5 * math.exp(1.96 * 0.1), rel=1e-3)
    drawn = found.draw(np.zeros(10_000), np.random.default_rng(0))
    assert drawn.max() < 1e5 * math.exp(5 * 0.1)


SURE = frequency(10**12, 1e11, 1e12)
"""Known without error: an event per km."""


def test_small_independent_errors_add_as_variances_of_the_rates() -> None:
    """3 and 1 (times 1e5) with 4 % and 8 %: sd = sqrt(.12^2 + .08^2) of 4; ends are good to 1 %."""
    total = TotalRate((rate(0.3, 0.04, SURE), rate(0.1, 0.08, SURE, scenario="b")))
    low, high = total.interval_per_million_km
    assert (high - low) / 2 == pytest.approx(1.96e5 * math.hypot(0.12, 0.08), rel=0.02)
    assert total.per_million_km == pytest.approx(4e5)


def test_bases_fitted_to_the_same_events_err_together() -> None:
    """Then the sum has the relative error of each: its interval is 400 exp(-+ 1.96 s)."""
    alone = TotalRate((rate(3e-4, 0.0, SURE, spread=0.5), rate(1e-4, 0.0, SURE, spread=0.5, scenario="b")))
    same = [
        rate(p, 0.0, SURE, spread=0.5, scenario=name, fitted_to="38 events") for p, name in ((3e-4, "a"), (1e-4, "b"))
    ]
    together = TotalRate(tuple(same))
    low, high = together.interval_per_million_km
    assert (low, high) == pytest.approx((400.0 * math.exp(-0.98), 400.0 * math.exp(0.98)), rel=0.02)
    assert alone.interval_per_million_km[1] < 0.9 * high


def test_a_scenario_that_is_not_determined_raises_the_upper_end_alone() -> None:
    known = rate(3e-4, 0.05, SURE)
    unknown = rate(1e-14, 0.05, SURE, scenario="b", spread=5.0, interval=(0.0, 1e-6))
    total = TotalRate((known, unknown))
    low, high = total.interval_per_million_km
    assert low == pytest.approx(known.interval_per_million_km[0], rel=0.01)
    assert high == pytest.approx(known.interval_per_million_km[1] + 1.0, rel=0.01)
    assert {each.scenario for each in total.shares} <= {"cut_in", ""}


@pytest.mark.parametrize("interval", [(1e-7, 1e-3), (1e-5, 1.2e-5)])
def test_no_end_of_a_sum_is_below_that_of_a_rate_in_it(interval: tuple[float, float]) -> None:
    parts = (rate(1.1e-5, 0.5, frequency(40, 10, 25), interval=interval), rate(1e-12, 0.1, scenario="b"))
    ends = np.array([each.interval_per_million_km for each in parts])
    assert (np.array(TotalRate(parts).interval_per_million_km) >= ends.max(axis=0)).all()


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
